"""Boxes around objects, and the points in them."""

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from torch import Tensor

# A body's points lie on its box as often as in it; rounding of coordinates may put them on either side.
SKIN_M = 0.01


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes that stand upright in the vehicle frame (x forward, y left, z up), around the objects of one frame.

    Args:
        centre_m: (K, 3) centres, half-way up.
        size_m: (K, 3) length along the heading, width, height.
        yaw_rad: (K,) heading: 0 along x, positive to the left.
        velocity_mps: (K, 2) velocity over ground along the vehicle's x and y: that of the object itself, not its motion
            relative to the ego (as in nuScenes). NaN where unknown.
        ids: K names, the same for an object in all frames of a run; empty strings where unknown.
        categories: K categories ("car", "pedestrian", ...); empty strings where unknown.
        hits: Name of a rig -> (K,) int64 how many of its points lie in each box.
        drawn_points: (K,) int64 how many points the reference drew on each object, to ask whether they are seen; zeros
            where none were, as in recordings.

    Raises:
        ValueError: Shapes that do not fit, NaN or infinite places, a length, width or height that is not positive.
        TypeError: What is no floating-point tensor.

    Warns:
        UserWarning: A yaw beyond a full turn: probably in degrees.

    Example:
        >>> car = Boxes(torch.tensor([[10.0, 2.0, 0.75]]), torch.tensor([[4.5, 1.8, 1.5]]), torch.tensor([0.1]))
        >>> len(car), car.rows.shape
        (1, torch.Size([1, 7]))
    """

    centre_m: Tensor
    size_m: Tensor
    yaw_rad: Tensor
    velocity_mps: Tensor = None  # type: ignore[assignment]  # never stays None, see __post_init__
    ids: tuple[str, ...] = ()
    categories: tuple[str, ...] = ()
    hits: Mapping[str, Tensor] = field(default_factory=dict)
    drawn_points: Tensor = None  # type: ignore[assignment]  # nor this

    def __post_init__(self) -> None:
        for name in ("centre_m", "size_m", "yaw_rad"):
            _check_numbers(name, getattr(self, name))
        count = len(self.yaw_rad)
        fill = {
            "velocity_mps": self.centre_m.new_full((count, 2), math.nan),
            "ids": ("",) * count,
            "categories": ("",) * count,
            "drawn_points": torch.zeros(count, dtype=torch.int64, device=self.yaw_rad.device),
        }
        for name, unknown in fill.items():
            given = getattr(self, name)
            object.__setattr__(self, name, unknown if given is None or given == () else given)
        self._check_shapes(count)
        flat = ~(self.size_m > 0).all(dim=1)
        if flat.any():
            first = int(flat.nonzero()[0])
            raise ValueError(
                f"size_m: {int(flat.sum())} of {count} boxes have a length, width or height that is not positive, the "
                f"first is box {first} with {self.size_m[first].tolist()}; leave them out"
            )
        if (self.yaw_rad.abs() > 2 * math.pi).any():
            warnings.warn(
                "yaw_rad goes beyond a full turn, so it may be in degrees: radians are needed (torch.deg2rad)",
                stacklevel=3,
            )

    def _check_shapes(self, count: int) -> None:
        expected = {"centre_m": (count, 3), "size_m": (count, 3), "yaw_rad": (count,), "velocity_mps": (count, 2)}
        expected["drawn_points"] = (count,)
        for name, shape in expected.items():
            if tuple(getattr(self, name).shape) != shape:
                raise ValueError(
                    f"{name}: shape {shape} is needed for {count} boxes; got {tuple(getattr(self, name).shape)}"
                )
        lengths = {
            "ids": self.ids,
            "categories": self.categories,
            **{f"hits[{rig!r}]": n for rig, n in self.hits.items()},
        }
        for name, entries in lengths.items():
            if len(entries) != count:
                raise ValueError(f"{name}: one entry for each of {count} boxes is needed; got {len(entries)}")

    @classmethod
    def from_rows(cls, rows: Tensor, **others: object) -> "Boxes":
        """From (K, 7) rows x, y, z of the centre, length, width, height, yaw: the layout of OpenPCDet.

        Args:
            rows: Metres and radians; further columns are not allowed.
            others: `velocity_mps`, `ids`, `categories`, `hits`, `drawn_points`.

        Raises:
            ValueError: Another shape, or as the constructor.
        """
        if rows.ndim != 2 or rows.shape[1] != 7:
            raise ValueError(f"rows: shape (K, 7) is needed, x y z length width height yaw; got {tuple(rows.shape)}")
        return cls(rows[:, :3], rows[:, 3:6], rows[:, 6], **others)  # type: ignore[arg-type]

    @property
    def rows(self) -> Tensor:
        """(K, 7) x, y, z of the centre, length, width, height, yaw: the layout of OpenPCDet."""
        return torch.cat([self.centre_m, self.size_m, self.yaw_rad[:, None]], dim=1)

    def __len__(self) -> int:
        return len(self.yaw_rad)

    def select(self, which: Tensor) -> "Boxes":
        """Some of them.

        Args:
            which: (K,) bool mask, or int64 numbers of boxes.
        """
        which = which.to(self.yaw_rad.device)
        numbers = (which.nonzero().squeeze(1) if which.dtype == torch.bool else which).tolist()
        return replace(
            self,
            centre_m=self.centre_m[which],
            size_m=self.size_m[which],
            yaw_rad=self.yaw_rad[which],
            velocity_mps=self.velocity_mps[which],
            ids=tuple(self.ids[number] for number in numbers),
            categories=tuple(self.categories[number] for number in numbers),
            hits={rig: count[which] for rig, count in self.hits.items()},
            drawn_points=self.drawn_points[which],
        )

    def of_category(self, *categories: str) -> "Boxes":
        """Those of the given categories."""
        return self.select(torch.tensor([category in categories for category in self.categories], dtype=torch.bool))

    def with_hits(self, clouds: Mapping[str, Tensor]) -> "Boxes":
        """The same with `hits`: how many points of each rig lie in each box.

        Args:
            clouds: Name of each rig -> (N, 3) its points in the vehicle frame.
        """
        inside = {rig: points_in_boxes(cloud, self).box for rig, cloud in clouds.items()}
        return replace(self, hits={rig: torch.bincount(box, minlength=len(self)) for rig, box in inside.items()})

    def pin_memory(self) -> "Boxes":
        """A copy in page-locked memory."""
        return self._moved(Tensor.pin_memory)

    def to(self, device: torch.device | str) -> "Boxes":
        """A copy on another device."""
        return self._moved(lambda tensor: tensor.to(device))

    def _moved(self, move: Callable[[Tensor], Tensor]) -> "Boxes":
        return replace(
            self,
            centre_m=move(self.centre_m),
            size_m=move(self.size_m),
            yaw_rad=move(self.yaw_rad),
            velocity_mps=move(self.velocity_mps),
            hits={rig: move(count) for rig, count in self.hits.items()},
            drawn_points=move(self.drawn_points),
        )


class Inside(NamedTuple):
    """Pairs of a box and a point in it: `box` (P,) and `point` (P,) int64, by ascending box."""

    box: Tensor
    point: Tensor


def points_in_boxes(points: Tensor, boxes: Boxes) -> Inside:
    """Which points lie in which boxes; a point may lie in several.

    A body touches its box: the wall of a box-shaped truck lies on the box's side. Sides and top are therefore closed,
    and `SKIN_M` = 1 cm thicker than given. The bottom is raised by as much: what the body stands on is not the body.

    Args:
        points: (N, 3) points in the vehicle frame in metres.
        boxes: K boxes in the same frame, on the same device.

    Returns:
        `Inside(box, point)`.

    Example:
        >>> boxes = Boxes.from_rows(torch.tensor([[10.0, 0.0, 1.0, 4.0, 2.0, 2.0, 0.0]]))
        >>> points_in_boxes(torch.tensor([[11.9, 0.9, 1.9], [12.1, 0.0, 1.0], [10.0, 0.0, 0.0]]), boxes)
        Inside(box=tensor([0]), point=tensor([0]))
    """
    if len(boxes) == 0 or len(points) == 0:
        none = torch.empty(0, dtype=torch.int64, device=points.device)
        return Inside(none, none)
    points = points.detach().to(torch.promote_types(points.dtype, torch.float32))
    # Sorted by x, the points that a box can hold are next to each other.
    x_m, order = points[:, 0].contiguous().sort()
    y_m = points[order, 1]
    reach_m = torch.linalg.vector_norm(boxes.size_m[:, :2].double(), dim=1) / 2 + 2 * SKIN_M
    first = torch.searchsorted(x_m, (boxes.centre_m[:, 0].double() - reach_m).to(x_m.dtype)).tolist()
    end = torch.searchsorted(x_m, (boxes.centre_m[:, 0].double() + reach_m).to(x_m.dtype)).tolist()
    near = []
    for start, stop, centre_y_m, reach in zip(first, end, boxes.centre_m[:, 1].tolist(), reach_m.tolist(), strict=True):
        near.append(order[start:stop][(y_m[start:stop] - centre_y_m).abs() < reach])
    point = torch.cat(near)
    counts = torch.tensor([len(some) for some in near], device=point.device)
    box = torch.arange(len(boxes), device=point.device).repeat_interleave(counts)
    inside = _is_inside(points[point], boxes.rows[box])
    return Inside(box[inside], point[inside])


def _is_inside(points: Tensor, rows: Tensor) -> Tensor:
    """(N,) whether each of (N, 3) points lies in the box of its (N, 7) row."""
    x, y, z = (points.double() - rows[:, :3].double()).T
    half_length, half_width, half_height = rows[:, 3:6].double().T / 2
    cosine, sine = rows[:, 6].double().cos(), rows[:, 6].double().sin()
    beside = ((x * cosine + y * sine).abs() <= half_length + SKIN_M) & (
        (y * cosine - x * sine).abs() <= half_width + SKIN_M
    )
    inside: Tensor = beside & (z > SKIN_M - half_height) & (z <= half_height + SKIN_M)
    return inside


def check_boxes(boxes: object) -> None:
    """Refuse what is no `Boxes`, such as the None of a frame in which nobody looked for objects."""
    if not isinstance(boxes, Boxes):
        raise TypeError(
            f"boxes: Boxes are needed, if only an empty list of them; got {type(boxes).__name__}; "
            "SimulatedFrames(..., boxes=True) makes them"
        )


def _check_numbers(name: str, tensor: Tensor) -> None:
    if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
        arrived = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
        raise TypeError(f"{name}: a floating-point torch tensor is needed; got {arrived}")
    if not tensor.isfinite().all():
        bad = int((~tensor.reshape(len(tensor), -1).isfinite()).any(dim=1).sum())
        raise ValueError(f"{name}: {bad} of {len(tensor)} boxes have NaN or infinite numbers; leave them out")
