"""Ground truth for training: the objects that a rig could show."""

from collections.abc import Sequence
from dataclasses import replace

from torch.utils.data import Dataset

from torchcover.detection.visibility import box_visibility
from torchcover.frames.frame import Frame


class VisibleTargets(Dataset[Frame]):
    """Frames without the objects that a rig could hardly show, and with `boxes.visibility` of the others, as weights.

    What is hidden, or of unknown visibility, is left out too; `counts["targets_left_out"]` says how many in all. It
    is measured each time that a frame is asked for: `list(VisibleTargets(...))` does so once.

    Args:
        frames: A data set or a list of frames with boxes and a reference; `SurfaceReference(object_points=...)` asks
            about every object.
        least: Share of an object's visible surface, as of `box_visibility`, below which it is left out.
        rig: Which of several rigs; the only one if not given.
        threshold_m: As of `box_visibility`.

    Raises:
        ValueError: A share beyond 0 to 1; when a frame is asked for, one without boxes or without a reference.

    Example:
        >>> import torch
        >>> from torchcover.detection import Boxes
        >>> boxes = Boxes.from_rows(torch.tensor([[10.0, 0, 1, 4, 2, 2, 0], [30.0, 0, 1, 4, 2, 2, 0]]))
        >>> reference = torch.tensor([[8.0, 0.0, 0.5], [8.0, 0.0, 1.5], [28.0, 0.0, 1.0]])
        >>> frame = Frame({"rig": torch.tensor([[8.0, 0.0, 0.6]])}, reference, index=0, name="a", boxes=boxes)
        >>> (seen,) = VisibleTargets([frame], least=0.2)
        >>> len(seen.boxes), seen.boxes.visibility, seen.counts
        (1, tensor([0.5000], dtype=torch.float64), {'targets_left_out': 1})
    """

    def __init__(
        self,
        frames: "Dataset[Frame] | Sequence[Frame]",
        least: float = 0.2,
        *,
        rig: str | None = None,
        threshold_m: float = 0.4,
    ) -> None:
        if not 0.0 <= least <= 1.0:
            raise ValueError(f"least: a share from 0 to 1 is needed; got {least}")
        self.frames, self.least, self.rig, self.threshold_m = frames, least, rig, threshold_m

    def __len__(self) -> int:
        return len(self.frames)  # type: ignore[arg-type]  # of a map-style data set

    def __getitem__(self, index: int) -> Frame:
        frame = self.frames[index]
        if frame.boxes is None:
            raise ValueError(f"frame {frame.name!r} has no boxes: SimulatedFrames(..., boxes=True) makes them")
        seen = box_visibility(
            frame.cloud_of(self.rig),
            frame.reference,
            frame.boxes,
            self.threshold_m,
            reference_weights=frame.reference_weights,
        )
        boxes = replace(frame.boxes, visibility=seen.share.to(frame.boxes.yaw_rad.device))
        kept = boxes.select(boxes.visibility >= self.least)
        left_out = frame.counts.get("targets_left_out", 0) + len(boxes) - len(kept)
        return replace(frame, boxes=kept, counts={**frame.counts, "targets_left_out": left_out})
