"""Batches of frames without padding."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchcover.coverage.grid import BandFrame
from torchcover.detection.boxes import Boxes
from torchcover.frames.frame import Frame


class FrameBatch:
    """Batch of frames whose clouds differ in size, as `CoverageMetric.update` accepts them.

    The class is neither a dataclass nor iterable, so that Lightning does not cast the clouds to the precision of the
    model and does not infer a batch size from their lengths: use `self.log(..., batch_size=len(batch))`.

    `metric.update(batch.sensor, batch.reference, errors_m=batch.get_errors_m(), weights=batch.weights,
    heights_m=batch.get_heights_m(grid.band_frame), block_index=batch.block_indices)`.

    Args:
        frames: Frames in the order of the batch.
    """

    def __init__(self, frames: Sequence[Frame]) -> None:
        self.frames = tuple(frames)

    def __repr__(self) -> str:
        return f"FrameBatch({len(self.frames)} frames)"

    @property
    def sensor(self) -> list[Tensor]:
        """(N, 3) true hit points of the only rig for each frame; N differs."""
        return [frame.sensor for frame in self.frames]

    def get_clouds(self, rig_name: str | None = None) -> list[Tensor]:
        """Return the true hit points of one rig for each frame.

        Args:
            rig_name: Name of the rig; may be omitted if there is only one.

        Returns:
            (N, 3) points for each frame, see `Frame.get_cloud`.

        Raises:
            ValueError: A frame has no such rig.
        """
        return [frame.get_cloud(rig_name) for frame in self.frames]

    def get_errors_m(self, rig_name: str | None = None) -> list[Tensor] | None:
        """Return the measurement errors of one rig for each frame.

        Args:
            rig_name: Name of the rig; may be omitted if there is only one.

        Returns:
            (N,) errors for each frame, see `Frame.get_errors_m`; zeros for frames without measurement errors; None if
            no frame has any.

        Raises:
            ValueError: A frame has no such rig.
        """
        errors_m = [frame.get_errors_m(rig_name) for frame in self.frames]
        if all(error_m is None for error_m in errors_m):
            return None
        filled_m = []
        for frame, error_m in zip(self.frames, errors_m, strict=True):
            cloud = frame.get_cloud(rig_name)
            filled_m.append(cloud.new_zeros(len(cloud)) if error_m is None else error_m)
        return filled_m

    def get_measured_points(self, rig_name: str | None = None) -> list[Tensor]:
        """Return the measured points of one rig for each frame.

        Args:
            rig_name: Name of the rig; may be omitted if there is only one.

        Returns:
            (N, 3) points for each frame, see `Frame.get_measured_points`.

        Raises:
            ValueError: A frame has no such rig.
        """
        return [frame.get_measured_points(rig_name) for frame in self.frames]

    @property
    def reference(self) -> list[Tensor]:
        """(M, 3) reference points for each frame; M differs."""
        return [frame.reference for frame in self.frames]

    @property
    def weights(self) -> list[Tensor] | None:
        """(M,) visible areas of the reference points in square meters for each frame; None if no frame has any.

        Raises:
            ValueError: Only some of the frames have areas.
        """
        weights = [frame.reference_weights for frame in self.frames if frame.reference_weights is not None]
        if weights and len(weights) < len(self.frames):
            names = {frame.reference_weights is None: frame.name for frame in self.frames}
            raise ValueError(
                f"weights: frame {names[False]!r} has the areas of its reference points (square meters), frame "
                f"{names[True]!r} has none; use separate batches"
            )
        return weights or None

    def get_heights_m(self, band_frame: BandFrame) -> list[Tensor] | None:
        """Return the heights by which reference points are assigned to height bands, for each frame.

        Args:
            band_frame: "ground" or "vehicle", see `Frame.get_heights_m`.

        Returns:
            (M,) heights for each frame; None for "vehicle".

        Raises:
            ValueError: Same conditions as `Frame.get_heights_m`.
        """
        heights_m = [frame.get_heights_m(band_frame) for frame in self.frames]
        return [height_m for height_m in heights_m if height_m is not None] or None

    @property
    def block_indices(self) -> list[int]:
        """Block index of each frame."""
        return [frame.block_index for frame in self.frames]

    @property
    def boxes(self) -> list[Boxes]:
        """Objects of each frame.

        Raises:
            ValueError: The boxes of a frame are None.
        """
        boxes = [frame.boxes for frame in self.frames if frame.boxes is not None]
        if len(boxes) < len(self.frames):
            example = next(frame.name for frame in self.frames if frame.boxes is None)
            raise ValueError(
                f"{len(self.frames) - len(boxes)} of {len(self.frames)} frames have no boxes, for example {example!r}: "
                "use SimulatedFrames(..., boxes=True), for a recording dataclasses.replace(frame, boxes=...)"
            )
        return boxes

    def pad_boxes(self, categories: Sequence[str]) -> Tensor:
        """Stack the objects into one tensor, the input of detectors of OpenPCDet.

        Args:
            categories: Classes, numbered from 1; objects of other categories are excluded.

        Returns:
            (B, K, 8) center x, y, z, length, width, height, yaw, class; K is the largest number of objects in a frame,
            missing objects are zeros.
        """
        rows = []
        for boxes in self.boxes:
            selected = boxes.select_categories(*categories)
            classes = [categories.index(category) + 1 for category in selected.categories]
            rows.append(torch.cat([selected.rows, selected.rows.new_tensor(classes)[:, None]], dim=1))
        return torch.nn.utils.rnn.pad_sequence(rows, batch_first=True)

    def stack_points(self, rig_name: str | None = None) -> Tensor:
        """Stack the measured points of one rig into one tensor, the input of voxel and pillar encoders.

        Args:
            rig_name: Name of the rig; may be omitted if there is only one.

        Returns:
            (points of all frames, 4) index of the frame in the batch, x, y, z.
        """
        clouds = []
        for index, cloud in enumerate(self.get_measured_points(rig_name)):
            clouds.append(torch.nn.functional.pad(cloud, (1, 0), value=index))
        return torch.cat(clouds)

    def __len__(self) -> int:
        return len(self.frames)

    def pin_memory(self) -> "FrameBatch":
        """Copy the batch to page-locked memory; DataLoader calls this if `pin_memory=True`."""
        return FrameBatch([frame.pin_memory() for frame in self.frames])

    def to(self, device: torch.device | str) -> "FrameBatch":
        """Copy the batch to a device.

        Args:
            device: Target device.

        Returns:
            The copy, see `Frame.to`.
        """
        return FrameBatch([frame.to(device) for frame in self.frames])


def collate_frames(frames: Sequence[Frame]) -> FrameBatch:
    """Batch frames without padding, for `DataLoader(..., collate_fn=collate_frames)`.

    Args:
        frames: Frames whose clouds may differ in size.

    Returns:
        Batch of all frames.

    Example:
        >>> frame = Frame({"rig": torch.zeros(5, 3)}, torch.zeros(9, 3), index=0, name="a")
        >>> [len(cloud) for cloud in collate_frames([frame, frame]).reference]
        [9, 9]
    """
    return FrameBatch(tuple(frames))


# Classes on this list load with `torch.load(weights_only=True)`, the default.
torch.serialization.add_safe_globals([FrameBatch])
