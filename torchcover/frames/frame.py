"""One instant: what the rig saw and what was there to be seen."""

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchcover.coverage.grid import BandFrame
from torchcover.detection.boxes import Boxes
from torchcover.devices import move_tensor
from torchcover.notebooks import format_short_repr


class Measurement(NamedTuple):
    """What sensors that err made of the points of a rig.

    Args:
        points: (N, 3) float32 where they landed, in the vehicle frame.
        error_m: (N,) float32 how far off they were measured, along their rays.
    """

    points: Tensor
    error_m: Tensor


@dataclass(frozen=True, repr=False)
class Frame:
    """The clouds of one time step, in the vehicle frame (x forward, y left, z up, metres).

    A point is a place on a surface, measured with an error. What it covers is what was truly hit: a point that lands in
    a gap fills none.

    Args:
        clouds: Name of each rig -> (N, 3) float32 points of all its sensors, where they truly are; one rig, unless
            several were simulated side by side. Of a recording only `get_measured_points` is known, and stands for it.
        reference: (M, 3) float32 points of the reference sensor.
        index: Position in its dataset.
        name: What a user calls it: a file stem, or scenario and step.
        counts: What was left out on the way here, by name (`sensor_self_hits`, `reference_nonfinite`, ...).
        reference_weights: (M,) float32 visible square metres that each reference point stands for, as a
            `SurfaceReference` gives them; None if they are unknown, and all points count the same.
        reference_heights_m: (M,) float32 heights of the reference points above the local ground, NaN where there is
            none at or below; None if they are unknown: then height bands are those of the vehicle frame.
        boxes: The objects of that instant; None if they are unknown, which is not the same as none being there.
        sensor_point_counts: Name of each rig -> name of each of its sensors -> how many of the rig's points are its own, in
            their order; None if it is unknown which points are whose.
        block_index: Number of what it shows, for standard errors: frames that share it, as of an instant that is
            seen again or of one city, do not count as independent. Not given: `index`, every frame is its own.
        measurements: Name of a rig -> what its sensors made of its points, if they err; the others land where they are.
    """

    clouds: Mapping[str, Tensor]
    reference: Tensor
    index: int
    name: str
    counts: Mapping[str, int] = field(default_factory=dict)
    reference_weights: Tensor | None = None
    boxes: Boxes | None = None
    block_index: int = None  # type: ignore[assignment]  # filled in at once
    sensor_point_counts: Mapping[str, Mapping[str, int]] | None = None
    reference_heights_m: Tensor | None = None
    measurements: Mapping[str, Measurement] = field(default_factory=dict)

    __repr__ = format_short_repr

    def __post_init__(self) -> None:
        # Plain numbers: those of NumPy would not be equal to them as text, nor load with `weights_only=True`.
        for name in ("index", "block_index"):
            number = getattr(self, name)
            object.__setattr__(self, name, self.index if number is None else operator.index(number))
        for rig in self.measurements.keys() & self.clouds.keys():
            sizes = [len(self.clouds[rig]), *map(len, self.measurements[rig])]
            if len(set(sizes)) > 1:
                raise ValueError(
                    f"frame {self.name!r}: {rig!r} has {sizes[0]} points, {sizes[1]} that were measured and {sizes[2]} "
                    "errors; give `clouds` and `measured` together"
                )

    @property
    def sensor(self) -> Tensor:
        """(N, 3) points of the only rig, where they truly are.

        Raises:
            ValueError: There are several rigs: say which, `frame.cloud_of(name)`.
        """
        return self.get_cloud()

    def get_cloud(self, rig_name: str | None = None, *, max_error_m: float = math.inf) -> Tensor:
        """(N, 3) points of one rig, where they truly are.

        Args:
            rig_name: Which of several rigs; the only one if not given.
            max_error_m: Only those that were measured with no larger error.

        Raises:
            ValueError: The frame has no such rig, or several, and none was named.
        """
        rig_name = self._named(rig_name)
        cloud = self.clouds[rig_name]
        return (
            cloud[self._is_within(rig_name, max_error_m)]
            if rig_name in self.measurements and max_error_m < math.inf
            else cloud
        )

    def get_errors_m(self, rig_name: str | None = None) -> Tensor | None:
        """(N,) how far off the points of one rig were measured, along their rays; None if where they are.

        It takes and refuses a `rig_name` as `get_cloud` does.
        """
        rig_name = self._named(rig_name)
        return self.measurements[rig_name].error_m if rig_name in self.measurements else None

    def get_measured_points(self, rig_name: str | None = None) -> Tensor:
        """(N, 3) points of one rig as they were measured: what a network is fed with, or a file holds.

        Args:
            rig_name: Which of several rigs; the only one if not given.

        Raises:
            ValueError: As `get_cloud`.

        Example:
            >>> true, off = torch.tensor([[5.0, 0.0, 0.0]]), torch.tensor([[5.1, 0.0, 0.0]])
            >>> measured = {"rig": Measured(off, torch.tensor([0.1]))}
            >>> frame = Frame({"rig": true}, torch.zeros(1, 3), index=0, name="a", measured=measured)
            >>> frame.landed() is off, frame.cloud_of(within_m=0.4), len(frame.cloud_of(within_m=0.05))
            (True, tensor([[5., 0., 0.]]), 0)
        """
        rig_name = self._named(rig_name)
        return self.measurements[rig_name].points if rig_name in self.measurements else self.clouds[rig_name]

    def _named(self, rig: str | None) -> str:
        if rig is None and len(self.clouds) != 1:
            raise ValueError(f"the frame has clouds of {len(self.clouds)} rigs ({', '.join(self.clouds)}): say which")
        if rig is not None and rig not in self.clouds:
            raise ValueError(f"frame {self.name!r} has no rig {rig!r}; it has {', '.join(self.clouds)}")
        return next(iter(self.clouds)) if rig is None else rig

    def _is_within(self, rig: str, within_m: float) -> Tensor:
        return self.measurements[rig].error_m.abs() <= within_m

    def get_clouds_by_sensor(self, rig_name: str | None = None, *, max_error_m: float = math.inf) -> dict[str, Tensor]:
        """(N, 3) points of each sensor of a rig, where they truly are.

        Args:
            rig_name: Which of several rigs; the only one if not given.
            max_error_m: As in `get_cloud`.

        Raises:
            ValueError: No such rig, or it is unknown which points are whose.
        """
        name = self._named(rig_name)
        if self.sensor_point_counts is None or name not in self.sensor_point_counts:
            raise ValueError(
                f"frame {self.name!r}: it is unknown which points of {name!r} are of which sensor (sensor_points), as "
                "redundancy needs"
            )
        points = self.sensor_point_counts[name]
        sizes = list(points.values())
        clouds = dict(zip(points, torch.split(self.clouds[name], sizes), strict=True))
        if name not in self.measurements or max_error_m == math.inf:
            return clouds
        within = torch.split(self._is_within(name, max_error_m), sizes)
        return {sensor: cloud[kept] for (sensor, cloud), kept in zip(clouds.items(), within, strict=True)}

    def pin_memory(self) -> "Frame":
        """A copy in page-locked memory; DataLoader calls it when `pin_memory=True`."""
        return self._each(Tensor.pin_memory, None if self.boxes is None else self.boxes.pin_memory())

    def to(self, device: torch.device | str) -> "Frame":
        """A copy on another device, in float32 where that has no float64."""
        return self._each(
            lambda cloud: move_tensor(cloud, device), None if self.boxes is None else self.boxes.to(device)
        )

    def get_heights_m(self, band_frame: BandFrame) -> Tensor | None:
        """The heights of the reference points that such height bands need: None for those over z of the vehicle.

        Raises:
            ValueError: Bands over the ground, and the heights above it are unknown; bands over z, and the points have
                square metres and heights: that is how points are drawn within bands over the ground.
        """
        if band_frame == "vehicle":
            if None not in (self.reference_weights, self.reference_heights_m):
                raise ValueError(
                    f"frame {self.name!r}: its reference points have heights above the ground, and square metres: they "
                    "were drawn for bands over the ground; use the band frame ground"
                )
            return None
        if self.reference_heights_m is None:
            raise ValueError(
                f"frame {self.name!r}: the heights of its reference points above the ground (reference_heights_m) are "
                "unknown; use the band frame vehicle"
            )
        return self.reference_heights_m

    def _each(self, change: Callable[[Tensor], Tensor], boxes: Boxes | None) -> "Frame":
        clouds = {name: change(cloud) for name, cloud in self.clouds.items()}
        weights, heights_m = self.reference_weights, self.reference_heights_m
        return replace(
            self,
            clouds=clouds,
            reference=change(self.reference),
            reference_weights=None if weights is None else change(weights),
            reference_heights_m=None if heights_m is None else change(heights_m),
            boxes=boxes,
            measurements={name: Measurement(*map(change, measured)) for name, measured in self.measurements.items()},
        )


class FrameBatch:
    """Frames side by side, in order, as `CoverageMetric.update` takes them.

    It is no dataclass and cannot be iterated over, so that Lightning neither casts the clouds to the precision of the
    model nor takes their sizes for the size of the batch: give `self.log(..., batch_size=len(batch))`.

    `metric.update(batch.sensor, batch.reference, error=batch.errors_of(), weights=batch.weights,
    height=batch.heights_in(grid.band_frame), block_index=batch.block_index)`.
    """

    def __init__(self, frames: Sequence[Frame]) -> None:
        self.frames = tuple(frames)

    def __repr__(self) -> str:
        return f"FrameBatch({len(self.frames)} frames)"

    @property
    def sensor(self) -> list[Tensor]:
        """One (N, 3) cloud a frame, of the only rig, where its points truly are; N differs."""
        return [frame.sensor for frame in self.frames]

    def get_clouds(self, rig_name: str | None = None) -> list[Tensor]:
        """One (N, 3) cloud a frame, as `Frame.cloud_of`.

        Raises:
            ValueError: A frame has no such rig.
        """
        return [frame.get_cloud(rig_name) for frame in self.frames]

    def get_errors_m(self, rig_name: str | None = None) -> list[Tensor] | None:
        """One (N,) tensor a frame, as `Frame.error_of`, zeros of points that are where they were; None if all are.

        Raises:
            ValueError: A frame has no such rig.
        """
        pairs = [(frame.get_cloud(rig_name), frame.get_errors_m(rig_name)) for frame in self.frames]
        if all(error is None for _, error in pairs):
            return None
        return [cloud.new_zeros(len(cloud)) if error is None else error for cloud, error in pairs]

    def get_measured_points(self, rig_name: str | None = None) -> list[Tensor]:
        """One (N, 3) cloud a frame, as `Frame.landed`.

        Raises:
            ValueError: A frame has no such rig.
        """
        return [frame.get_measured_points(rig_name) for frame in self.frames]

    @property
    def reference(self) -> list[Tensor]:
        """One (M, 3) cloud a frame; M differs."""
        return [frame.reference for frame in self.frames]

    @property
    def weights(self) -> list[Tensor] | None:
        """One (M,) tensor a frame, the square metres of its reference points; None if no frame has any.

        Raises:
            ValueError: Some frames have them, and others have not.
        """
        given = [frame.reference_weights for frame in self.frames if frame.reference_weights is not None]
        if given and len(given) < len(self.frames):
            named = {frame.reference_weights is None: frame.name for frame in self.frames}
            raise ValueError(
                f"weights: frame {named[False]!r} has the square metres of its reference points, and {named[True]!r} "
                "has none; batch each kind of frames by itself"
            )
        return given or None

    def get_heights_m(self, band_frame: BandFrame) -> list[Tensor] | None:
        """One (M,) tensor a frame, as `Frame.heights_in`; None for bands over z of the vehicle.

        Raises:
            ValueError: As there.
        """
        given = [frame.get_heights_m(band_frame) for frame in self.frames]
        return [heights_m for heights_m in given if heights_m is not None] or None

    @property
    def block_indices(self) -> list[int]:
        """That of each frame."""
        return [frame.block_index for frame in self.frames]

    @property
    def boxes(self) -> list[Boxes]:
        """The objects of each frame.

        Raises:
            ValueError: A frame has no boxes, not even an empty list of them.
        """
        found = [frame.boxes for frame in self.frames if frame.boxes is not None]
        if len(found) < len(self.frames):
            without = next(frame.name for frame in self.frames if frame.boxes is None)
            raise ValueError(
                f"{len(self.frames) - len(found)} of {len(self.frames)} frames have no boxes, such as {without!r}: "
                "SimulatedFrames(..., boxes=True) makes them; for a recording use dataclasses.replace(frame, boxes=...)"
            )
        return found

    def pad_boxes(self, categories: Sequence[str]) -> Tensor:
        """The objects as one tensor, as OpenPCDet's detectors take them.

        Args:
            categories: The classes, from number 1; objects of other categories are left out.

        Returns:
            (B, most boxes of a frame, 8): x, y, z of the centre, length, width, height, yaw, class; zeros where a frame
            has fewer.
        """
        rows = []
        for boxes in self.boxes:
            wanted = boxes.select_categories(*categories)
            numbers = [categories.index(category) + 1 for category in wanted.categories]
            rows.append(torch.cat([wanted.rows, wanted.rows.new_tensor(numbers)[:, None]], dim=1))
        return torch.nn.utils.rnn.pad_sequence(rows, batch_first=True)

    def stack_points(self, rig_name: str | None = None) -> Tensor:
        """The clouds of one rig as they landed in one tensor, as voxel and pillar encoders take them.

        Args:
            rig_name: Which of several rigs; the only one if not given.

        Returns:
            (points of all frames, 4): number of the frame in the batch, x, y, z.
        """
        landed = enumerate(self.get_measured_points(rig_name))
        numbered = [torch.nn.functional.pad(cloud, (1, 0), value=number) for number, cloud in landed]
        return torch.cat(numbered)

    def __len__(self) -> int:
        return len(self.frames)

    def pin_memory(self) -> "FrameBatch":
        """A copy in page-locked memory; DataLoader calls it when `pin_memory=True`."""
        return FrameBatch(tuple(frame.pin_memory() for frame in self.frames))

    def to(self, device: torch.device | str) -> "FrameBatch":
        """A copy on another device."""
        return FrameBatch(tuple(frame.to(device) for frame in self.frames))


def collate_frames(frames: Sequence[Frame]) -> FrameBatch:
    """Batch frames without padding, for `DataLoader(..., collate_fn=collate_frames)`.

    Args:
        frames: Frames whose clouds may differ in size.

    Returns:
        A `FrameBatch` of all of them.

    Example:
        >>> frame = Frame({"rig": torch.zeros(5, 3)}, torch.zeros(9, 3), index=0, name="a")
        >>> [len(cloud) for cloud in collate_frames([frame, frame]).reference]
        [9, 9]
    """
    return FrameBatch(tuple(frames))


# `torch.load` gives them back with weights_only=True, its default.
torch.serialization.add_safe_globals([Frame, FrameBatch, Measurement])
