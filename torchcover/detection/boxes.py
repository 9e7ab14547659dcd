"""Boxes around objects, and how others write them down."""

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchcover.devices import move_tensor
from torchcover.geometry.arrays import Float64
from torchcover.geometry.rigid import Matrix, transform_points
from torchcover.neighbors import check_tensor
from torchcover.notebooks import format_short_repr

# The middles of what labels of KITTI call fully visible, partly and largely occluded, which has no numbers for them: by
# the borders of nuScenes, whose second and third level are one here.
SHARE_OCCLUDED = {0.0: 0.9, 1.0: 0.6, 2.0: 0.2}


@dataclass(frozen=True, eq=False, repr=False)
class Boxes:
    """Boxes that stand upright in the vehicle frame (x forward, y left, z up), around the objects of one frame.

    Args:
        center_m: (K, 3) centres, half-way up.
        size_m: (K, 3) length along the heading, width, height.
        yaw_rad: (K,) heading: 0 along x, positive to the left.
        velocity_mps: (K, 2) velocity over ground along the vehicle's x and y: that of the object itself, not its motion
            relative to the ego (as in nuScenes). NaN where unknown.
        ids: K names, the same for an object in all frames of a run; empty strings where unknown.
        categories: K categories ("car", "pedestrian", ...); empty strings where unknown.
        points_in_box: Name of a rig -> (K,) int64 how many of its points lie in each box.
        sampled_points: (K,) int64 how many points the reference drew on each object, to ask whether they are seen; zeros
            where none were, as in recordings.
        bottom_heights_m: (K,) height of the bottom of each box above the local ground, that is the highest ground below
            its centre; NaN where unknown.
        visibility: (K,) share of what can be seen of it that a rig shows, as `measure_box_visibility` measures it, or the
            middle of the level that a label says (`visibility_token`, `occluded`); NaN where unknown.

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

    center_m: Tensor
    size_m: Tensor
    yaw_rad: Tensor
    velocity_mps: Tensor = None  # type: ignore[assignment]  # never stays None, see __post_init__
    ids: tuple[str, ...] = ()
    categories: tuple[str, ...] = ()
    points_in_box: Mapping[str, Tensor] = field(default_factory=dict)
    sampled_points: Tensor = None  # type: ignore[assignment]  # nor this
    bottom_heights_m: Tensor = None  # type: ignore[assignment]  # nor this
    visibility: Tensor = None  # type: ignore[assignment]  # nor this

    __repr__ = format_short_repr

    def __post_init__(self) -> None:
        for name in ("center_m", "size_m", "yaw_rad"):
            tensor = getattr(self, name)
            check_tensor(tensor, name, is_floating=True)
            if not tensor.isfinite().all():
                bad = int((~tensor.reshape(len(tensor), -1).isfinite()).any(dim=1).sum())
                raise ValueError(f"{name}: {bad} of {len(tensor)} boxes have NaN or infinite numbers; leave them out")
        count = len(self.yaw_rad)
        fill = {
            "velocity_mps": self.center_m.new_full((count, 2), math.nan),
            "ids": ("",) * count,
            "categories": ("",) * count,
            "sampled_points": torch.zeros(count, dtype=torch.int64, device=self.yaw_rad.device),
            "bottom_heights_m": self.center_m.new_full((count,), math.nan),
            "visibility": self.center_m.new_full((count,), math.nan),
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
        expected = {"center_m": (count, 3), "size_m": (count, 3), "yaw_rad": (count,), "velocity_mps": (count, 2)}
        expected |= dict.fromkeys(("sampled_points", "bottom_heights_m", "visibility"), (count,))
        for name, shape in expected.items():
            if tuple(getattr(self, name).shape) != shape:
                raise ValueError(
                    f"{name}: shape {shape} is needed for {count} boxes; got {tuple(getattr(self, name).shape)}"
                )
        lengths = {
            "ids": self.ids,
            "categories": self.categories,
            **{f"points_in_box[{rig!r}]": n for rig, n in self.points_in_box.items()},
        }
        for name, entries in lengths.items():
            if len(entries) != count:
                raise ValueError(f"{name}: one entry for each of {count} boxes is needed; got {len(entries)}")

    @classmethod
    def from_rows(cls, rows: Tensor, **other_fields: object) -> "Boxes":
        """From (K, 7) rows x, y, z of the centre, length, width, height, yaw: the layout of OpenPCDet.

        Args:
            rows: Metres and radians; further columns are not allowed.
            other_fields: `velocity_mps`, `ids`, `categories`, `hits`, `drawn_points`, `bottom_heights_m`, `visibility`.

        Raises:
            ValueError: Another shape, or as the constructor.
        """
        check_tensor(rows, "rows")
        if rows.ndim != 2 or rows.shape[1] != 7:
            raise ValueError(f"rows: shape (K, 7) is needed, x y z length width height yaw; got {tuple(rows.shape)}")
        return cls(rows[:, :3], rows[:, 3:6], rows[:, 6], **other_fields)  # type: ignore[arg-type]

    @classmethod
    def from_kitti_label(
        cls, label_values: ArrayLike, vehicle_T_camera: Float64 | None = None, **other_fields: object
    ) -> "Boxes":
        """From the numbers of KITTI's `label_2`: places in the rectified camera frame, at the bottom of the box.

        Args:
            label_values: (K, 14) what follows the type: truncated, occluded, alpha, four of the image, height, width,
                length, x, y, z, rotation about the camera's y.
            vehicle_T_camera: (4, 4) where the rectified camera is: of the LiDAR frame it is
                inv(R0_rect Tr_velo_to_cam).
            other_fields: As `from_rows`.

        Raises:
            ValueError: Another shape, or as the constructor.
        """
        given = np.asarray(label_values, dtype=np.float64)
        given = given.reshape(0, 14) if given.size == 0 else given
        if given.ndim != 2 or given.shape[1] != 14:
            raise ValueError(
                f"numbers: shape (K, 14) is needed, what follows the type without a score; got {given.shape}"
            )
        height, width, length, x, y, z, turn = given[:, 7:].T
        centre = np.column_stack([x, y - height / 2, z])  # the camera's y points down
        ahead = np.column_stack([np.cos(turn), np.zeros_like(turn), -np.sin(turn)])
        rows = build_upright_rows(centre, np.column_stack([length, width, height]), ahead, vehicle_T_camera)
        shares = [SHARE_OCCLUDED.get(occluded, math.nan) for occluded in given[:, 1].tolist()]
        return cls.from_rows(rows, visibility=rows.new_tensor(shares), **other_fields)

    @property
    def rows(self) -> Tensor:
        """(K, 7) x, y, z of the centre, length, width, height, yaw: the layout of OpenPCDet."""
        return torch.cat([self.center_m, self.size_m, self.yaw_rad[:, None]], dim=1)

    def __len__(self) -> int:
        return len(self.yaw_rad)

    def select(self, selection: Tensor) -> "Boxes":
        """Some of them.

        Args:
            selection: (K,) bool mask, or int64 numbers of boxes.
        """
        selection = selection.to(self.yaw_rad.device)
        numbers = (selection.nonzero().squeeze(1) if selection.dtype == torch.bool else selection).tolist()
        return self._each(
            lambda tensor: tensor[selection],
            ids=tuple(self.ids[number] for number in numbers),
            categories=tuple(self.categories[number] for number in numbers),
        )

    def select_categories(self, *categories: str) -> "Boxes":
        """Those of the given categories."""
        return self.select(
            torch.tensor([category in categories for category in self.categories], dtype=torch.bool, device="cpu")
        )

    def pin_memory(self) -> "Boxes":
        """A copy in page-locked memory."""
        return self._each(Tensor.pin_memory)

    def to(self, device: torch.device | str) -> "Boxes":
        """A copy on another device, in float32 where that has no float64."""
        return self._each(lambda tensor: move_tensor(tensor, device))

    def _each(self, change: Callable[[Tensor], Tensor], **names: tuple[str, ...]) -> "Boxes":
        """With all tensors changed, and other names where their number changes."""
        tensors = ("center_m", "size_m", "yaw_rad", "velocity_mps", "sampled_points", "bottom_heights_m", "visibility")
        changed: dict[str, Any] = {name: change(getattr(self, name)) for name in tensors} | names
        return replace(self, **changed, points_in_box={rig: change(count) for rig, count in self.points_in_box.items()})


def check_boxes(boxes: object) -> None:
    """Refuse what is no `Boxes`, such as the None of a frame in which nobody looked for objects."""
    if not isinstance(boxes, Boxes):
        raise TypeError(
            f"boxes: Boxes are needed, if only an empty list of them; got {type(boxes).__name__}; "
            "SimulatedFrames(..., boxes=True) makes them"
        )


def build_upright_rows(
    center_m: ArrayLike, size_m: ArrayLike, heading_vectors: ArrayLike, vehicle_T_source: Matrix | None
) -> Tensor:
    """(K, 7) rows of boxes in the vehicle frame; what leans is put upright, its heading, (K, 3) vectors, kept.

    `vehicle_T_source` is where the frame of the centres and headings is; None: it is the vehicle frame.

    ValueError: numbers that are not finite, or shapes that do not fit.
    """
    centre, size, ahead = _rows("centres", center_m), _rows("sizes", size_m), _rows("headings", heading_vectors)
    if not len(centre) == len(size) == len(ahead):
        counts = f"{len(centre)}, {len(size)} and {len(ahead)}"
        raise ValueError(f"boxes: as many centres, sizes and headings are needed; got {counts}")
    if vehicle_T_source is not None:
        centre, ahead = transform_points(vehicle_T_source, centre), ahead @ vehicle_T_source[:3, :3].T
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    return torch.from_numpy(np.column_stack([centre, size, yaw])).float()


def _rows(name: str, given: ArrayLike) -> Float64:
    array = np.asarray(given, dtype=np.float64)
    array = array.reshape(0, 3) if array.size == 0 else array
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"{name} of boxes: shape (K, 3) is needed; got {array.shape}")
    if not np.isfinite(array).all():
        bad = int((~np.isfinite(array)).any(axis=1).sum())
        raise ValueError(f"{name} of boxes: {bad} of {len(array)} are not finite")
    return array


# `torch.load` gives them back with weights_only=True, its default.
torch.serialization.add_safe_globals([Boxes])
