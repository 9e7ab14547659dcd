"""Transforms of frames: augmentations that move clouds and boxes together, and targets that a rig could show."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from torchcover.detection.boxes import Boxes
from torchcover.detection.visibility import measure_box_visibility
from torchcover.devices import run_with_float64
from torchcover.frames.frame import Frame, Measurement


def flip(frame: Frame) -> Frame:
    """Mirror a frame left to right: y becomes -y.

    Example:
        >>> frame = Frame({"rig": torch.tensor([[5.0, 2.0, 1.0]])}, torch.zeros(1, 3), index=0, name="a")
        >>> flip(frame).sensor
        tensor([[ 5., -2.,  1.]])
    """
    return _moved(frame, torch.diag(torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64, device="cpu")))


def rotate(frame: Frame, yaw_rad: float) -> Frame:
    """Turn everything about the vehicle's z axis, to the left if positive.

    Example:
        >>> frame = Frame({"rig": torch.tensor([[5.0, 0.0, 1.0]])}, torch.zeros(1, 3), index=0, name="a")
        >>> rotate(frame, math.pi / 2).sensor.round(decimals=4).abs()
        tensor([[0., 5., 1.]])
    """
    if not math.isfinite(yaw_rad):
        raise ValueError(f"yaw_rad: a finite angle is needed; got {yaw_rad}")
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return _moved(frame, torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64, device="cpu"))


def scale(frame: Frame, factor: float) -> Frame:
    """Make everything larger about the vehicle's origin: places, sizes, velocities, weights in square metres.

    Blind spot radii grow as well.

    Example:
        >>> frame = Frame({"rig": torch.tensor([[5.0, 0.0, 1.0]])}, torch.zeros(1, 3), index=0, name="a")
        >>> scale(frame, 2.0).sensor
        tensor([[10.,  0.,  2.]])
    """
    if not (math.isfinite(factor) and factor > 0):
        raise ValueError(f"factor: a finite number > 0 is needed; got {factor}")
    return _moved(frame, factor * torch.eye(3, dtype=torch.float64, device="cpu"))


@dataclass(frozen=True)
class Augmentation:
    """A random flip, then rotation, then scaling of a frame, drawn from the seed, the epoch and the frame's index.

    Nothing else decides: not workers, ranks or the order of access. Use it where the epoch is known, in the training
    step or in the collate function; coverage metrics are for frames as they are.

    Args:
        flip_probability: Probability of a flip.
        max_yaw_rad: The rotation is uniform between this to the right and this to the left.
        scale_range: The scaling is uniform between these two.
        seed: Seed.

    Raises:
        ValueError: A probability outside [0, 1], a negative angle, or factors that are not positive and ascending.

    Example:
        >>> frame = Frame({"rig": torch.rand(9, 3)}, torch.rand(9, 3), index=4, name="a")
        >>> augment = Augmentation(seed=1)
        >>> torch.equal(augment(frame, epoch=2).sensor, augment(frame, epoch=2).sensor)
        True
    """

    flip_probability: float = 0.5
    max_yaw_rad: float = math.pi / 4
    scale_range: tuple[float, float] = (0.95, 1.05)
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.flip_probability <= 1:
            raise ValueError(f"flip: a probability in [0, 1] is needed; got {self.flip_probability}")
        if not 0 <= self.max_yaw_rad < math.inf:
            raise ValueError(f"max_yaw_rad: an angle >= 0 is needed; got {self.max_yaw_rad}")
        if not 0 < self.scale_range[0] <= self.scale_range[1] < math.inf:
            raise ValueError(f"factors: two numbers 0 < lowest <= highest are needed; got {self.scale_range}")
        if self.seed < 0:
            raise ValueError(f"seed: a number >= 0 is needed; got {self.seed}")

    def __call__(self, frame: Frame, epoch: int = 0) -> Frame:
        """The frame as it is in one epoch. ValueError: a frame without an index (-1), or a negative epoch."""
        if frame.index < 0 or epoch < 0:
            raise ValueError(
                f"frame {frame.name!r}, index {frame.index}, epoch {epoch}: numbers >= 0 are needed, for the draw "
                "depends on them; use dataclasses.replace(frame, index=...)"
            )
        generator = np.random.default_rng([self.seed, epoch, frame.index])
        flipped = generator.random() < self.flip_probability
        yaw_rad = float(generator.uniform(-self.max_yaw_rad, self.max_yaw_rad))
        factor = float(generator.uniform(*self.scale_range))
        return scale(rotate(flip(frame) if flipped else frame, yaw_rad), factor)


def _moved(frame: Frame, similarity: Tensor) -> Frame:
    """Apply a (3, 3) float64 matrix that keeps shapes and z upright: a rotation about z, a mirror, a scale."""
    weights, heights_m, factor = frame.reference_weights, frame.reference_heights_m, float(similarity[2, 2])
    if weights is not None:
        weights = weights * factor**2
    if heights_m is not None:
        heights_m = heights_m * factor
    return replace(
        frame,
        clouds={name: _times(similarity, cloud) for name, cloud in frame.clouds.items()},
        reference=_times(similarity, frame.reference),
        reference_weights=weights,
        reference_heights_m=heights_m,
        boxes=None if frame.boxes is None else _moved_boxes(frame.boxes, similarity),
        measurements={
            name: Measurement(_times(similarity, measured.points), measured.error_m * factor)
            for name, measured in frame.measurements.items()
        },
    )


def _moved_boxes(boxes: Boxes, similarity: Tensor) -> Boxes:
    heading = _times(similarity[:2, :2], torch.stack([boxes.yaw_rad.cos(), boxes.yaw_rad.sin()], dim=1))
    factor = float(similarity[2, 2])
    return replace(
        boxes,
        center_m=_times(similarity, boxes.center_m),
        size_m=boxes.size_m * factor,
        yaw_rad=torch.atan2(heading[:, 1], heading[:, 0]).to(boxes.yaw_rad.dtype),
        velocity_mps=_times(similarity[:2, :2], boxes.velocity_mps),
        bottom_heights_m=boxes.bottom_heights_m * factor,
    )


@run_with_float64
def _times(matrix: Tensor, vectors: Tensor) -> Tensor:
    return (vectors.double() @ matrix.T.to(vectors.device)).to(vectors.dtype)


class VisibleBoxes(Dataset[Frame]):
    """Frames without the objects that a rig could hardly show, and with `boxes.visibility` of the others, as weights.

    What is hidden, or of unknown visibility, is left out too; `counts["targets_omitted"]` says how many in all. It
    is measured each time that a frame is asked for: `list(VisibleBoxes(...))` does so once.

    Args:
        frames: A data set or a list of frames with boxes and a reference; `SurfaceReference(object_points=...)` asks
            about every object.
        min_visibility: Share of an object's visible surface, as of `measure_box_visibility`, below which it is left out.
        rig_name: Which of several rigs; the only one if not given.
        threshold_m: As of `measure_box_visibility`.

    Raises:
        ValueError: A share beyond 0 to 1; when a frame is asked for, one without boxes or without a reference.

    Example:
        >>> import torch
        >>> from torchcover.detection import Boxes
        >>> boxes = Boxes.from_rows(torch.tensor([[10.0, 0, 1, 4, 2, 2, 0], [30.0, 0, 1, 4, 2, 2, 0]]))
        >>> reference = torch.tensor([[8.0, 0.0, 0.5], [8.0, 0.0, 1.5], [28.0, 0.0, 1.0]])
        >>> frame = Frame({"rig": torch.tensor([[8.0, 0.0, 0.6]])}, reference, index=0, name="a", boxes=boxes)
        >>> (seen,) = VisibleBoxes([frame], least=0.2)
        >>> len(seen.boxes), seen.boxes.visibility, seen.counts
        (1, tensor([0.5000], dtype=torch.float64), {'targets_omitted': 1})
    """

    def __init__(
        self,
        frames: "Dataset[Frame] | Sequence[Frame]",
        min_visibility: float = 0.2,
        *,
        rig_name: str | None = None,
        threshold_m: float = 0.4,
    ) -> None:
        if not 0.0 <= min_visibility <= 1.0:
            raise ValueError(f"least: a share from 0 to 1 is needed; got {min_visibility}")
        self.frames, self.min_visibility, self.rig_name, self.threshold_m = (
            frames,
            min_visibility,
            rig_name,
            threshold_m,
        )

    def __len__(self) -> int:
        return len(self.frames)  # type: ignore[arg-type]  # of a map-style data set

    def __getitem__(self, index: int) -> Frame:
        frame = self.frames[index]
        if frame.boxes is None:
            raise ValueError(f"frame {frame.name!r} has no boxes: SimulatedFrames(..., boxes=True) makes them")
        seen = measure_box_visibility(
            frame.get_cloud(self.rig_name),
            frame.reference,
            frame.boxes,
            self.threshold_m,
            reference_weights=frame.reference_weights,
        )
        boxes = replace(frame.boxes, visibility=seen.share.to(frame.boxes.yaw_rad.device))
        kept = boxes.select(boxes.visibility >= self.min_visibility)
        left_out = frame.counts.get("targets_omitted", 0) + len(boxes) - len(kept)
        return replace(frame, boxes=kept, counts={**frame.counts, "targets_omitted": left_out})
