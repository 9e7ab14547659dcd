"""Bounding boxes of objects and conversions from the layouts of OpenPCDet and KITTI."""

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
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

# KITTI labels are fully visible, partly or largely occluded, without numbers. The values are the centers of the
# corresponding visibility intervals of nuScenes; its second and third level are one level in KITTI.
VISIBLE_SHARE_BY_KITTI_OCCLUSION = {0.0: 0.9, 1.0: 0.6, 2.0: 0.2}


@dataclass(frozen=True, eq=False, repr=False)
class Boxes:
    """Upright bounding boxes of the objects of one frame in the vehicle frame (x forward, y left, z up).

    Args:
        center_m: (K, 3) centers of the boxes.
        size_m: (K, 3) length along the heading, width, height.
        yaw_rad: (K,) heading: 0 along x, positive to the left.
        velocity_mps: (K, 2) velocity over ground along x and y of the vehicle frame, not relative to the ego vehicle
            (same as nuScenes). NaN if unknown.
        ids: K names that are constant over the frames of a run; empty strings if unknown.
        categories: K categories ("car", "pedestrian", ...); empty strings if unknown.
        points_in_box: Name of a rig -> (K,) int64 number of its points in each box.
        sampled_points: (K,) int64 number of points that the reference sampled on each object to test its visibility;
            zeros if it sampled none, for example in recordings.
        bottom_heights_m: (K,) height of the bottom of each box above local ground at its center; NaN if unknown.
        visibility: (K,) visible share of the surface from `measure_box_visibility`, or the center of the interval
            that a label gives (`visibility_token`, `occluded`); NaN if unknown.

    Raises:
        ValueError: Shapes that do not fit, NaN or infinite positions, a length, width or height that is not positive.
        TypeError: A tensor that is not floating-point.

    Warns:
        UserWarning: A yaw beyond a full turn, probably in degrees.

    Example:
        >>> car = Boxes(torch.tensor([[10.0, 2.0, 0.75]]), torch.tensor([[4.5, 1.8, 1.5]]), torch.tensor([0.1]))
        >>> len(car), car.rows.shape
        (1, torch.Size([1, 7]))
    """

    center_m: Tensor
    size_m: Tensor
    yaw_rad: Tensor
    velocity_mps: Tensor = None  # type: ignore[assignment]  # set in __post_init__
    ids: tuple[str, ...] = ()
    categories: tuple[str, ...] = ()
    points_in_box: Mapping[str, Tensor] = field(default_factory=dict)
    sampled_points: Tensor = None  # type: ignore[assignment]  # set in __post_init__
    bottom_heights_m: Tensor = None  # type: ignore[assignment]  # set in __post_init__
    visibility: Tensor = None  # type: ignore[assignment]  # set in __post_init__

    __repr__ = format_short_repr

    def __post_init__(self) -> None:
        for name in ("center_m", "size_m", "yaw_rad"):
            tensor = getattr(self, name)
            check_tensor(tensor, name, is_floating=True)
            if not tensor.isfinite().all():
                bad = int((~tensor.reshape(len(tensor), -1).isfinite()).any(dim=1).sum())
                raise ValueError(f"{name}: {bad} of {len(tensor)} boxes have NaN or infinite numbers; remove them")
        count = len(self.yaw_rad)
        unknown_values = {
            "velocity_mps": self.center_m.new_full((count, 2), math.nan),
            "ids": ("",) * count,
            "categories": ("",) * count,
            "sampled_points": torch.zeros(count, dtype=torch.int64, device=self.yaw_rad.device),
            "bottom_heights_m": self.center_m.new_full((count,), math.nan),
            "visibility": self.center_m.new_full((count,), math.nan),
        }
        for name, unknown in unknown_values.items():
            value = getattr(self, name)
            object.__setattr__(self, name, unknown if value is None or value == () else value)
        self._check_shapes(count)
        is_flat = ~(self.size_m > 0).all(dim=1)
        if is_flat.any():
            first = int(is_flat.nonzero()[0])
            raise ValueError(
                f"size_m: {int(is_flat.sum())} of {count} boxes have a length, width or height that is not positive, "
                f"the first is box {first} with {self.size_m[first].tolist()}; remove them"
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
        sequences: dict[str, tuple[str, ...] | Tensor] = {"ids": self.ids, "categories": self.categories}
        sequences |= {f"points_in_box[{rig!r}]": counts for rig, counts in self.points_in_box.items()}
        for name, entries in sequences.items():
            if len(entries) != count:
                raise ValueError(f"{name}: one entry for each of {count} boxes is needed; got {len(entries)}")

    @classmethod
    def from_rows(cls, rows: Tensor, **other_fields: object) -> "Boxes":
        """Build boxes from rows in the layout of OpenPCDet.

        Args:
            rows: (K, 7) center x, y, z, length, width, height, yaw in meters and radians.
            other_fields: Further fields: `velocity_mps`, `ids`, `categories`, `points_in_box`, `sampled_points`,
                `bottom_heights_m`, `visibility`.

        Returns:
            The boxes.

        Raises:
            ValueError: Another shape, or the conditions of the constructor.
        """
        check_tensor(rows, "rows")
        if rows.ndim != 2 or rows.shape[1] != 7:
            raise ValueError(f"rows: shape (K, 7) is needed, x y z length width height yaw; got {tuple(rows.shape)}")
        return cls(rows[:, :3], rows[:, 3:6], rows[:, 6], **other_fields)  # type: ignore[arg-type]

    @classmethod
    def from_kitti_label(
        cls, label_values: ArrayLike, vehicle_T_camera: Float64 | None = None, **other_fields: object
    ) -> "Boxes":
        """Build boxes from the numbers of a KITTI label file (`label_2`).

        KITTI gives the center of the bottom of each box in the rectified camera frame.

        Args:
            label_values: (K, 14) columns after the type: truncated, occluded, alpha, four image coordinates, height,
                width, length, x, y, z, rotation about the y axis of the camera.
            vehicle_T_camera: (4, 4) pose of the rectified camera in the vehicle frame; in the LiDAR frame it is
                inv(R0_rect Tr_velo_to_cam).
            other_fields: Further fields, see `from_rows`.

        Returns:
            The boxes; their visibility follows from `occluded`.

        Raises:
            ValueError: Another shape, or the conditions of the constructor.
        """
        values = np.asarray(label_values, dtype=np.float64)
        values = values.reshape(0, 14) if values.size == 0 else values
        if values.ndim != 2 or values.shape[1] != 14:
            raise ValueError(
                f"label_values: shape (K, 14) is needed, the columns after the type without a score; got {values.shape}"
            )
        height, width, length, x, y, z, rotation = values[:, 7:].T
        center = np.column_stack([x, y - height / 2, z])  # y of the camera points down
        heading = np.column_stack([np.cos(rotation), np.zeros_like(rotation), -np.sin(rotation)])
        rows = build_upright_rows(center, np.column_stack([length, width, height]), heading, vehicle_T_camera)
        shares = [VISIBLE_SHARE_BY_KITTI_OCCLUSION.get(occluded, math.nan) for occluded in values[:, 1].tolist()]
        return cls.from_rows(rows, visibility=rows.new_tensor(shares), **other_fields)

    @property
    def rows(self) -> Tensor:
        """(K, 7) x, y, z of the center, length, width, height, yaw: the layout of OpenPCDet."""
        return torch.cat([self.center_m, self.size_m, self.yaw_rad[:, None]], dim=1)

    def __len__(self) -> int:
        return len(self.yaw_rad)

    def select(self, selection: Tensor) -> "Boxes":
        """Select some of the boxes.

        Args:
            selection: (K,) bool mask, or int64 indices of boxes.

        Returns:
            The selected boxes, in the order of the indices.
        """
        selection = selection.to(self.yaw_rad.device)
        indices = (selection.nonzero().squeeze(1) if selection.dtype == torch.bool else selection).tolist()
        return self._transform_tensors(
            lambda tensor: tensor[selection],
            ids=tuple(self.ids[index] for index in indices),
            categories=tuple(self.categories[index] for index in indices),
        )

    def select_categories(self, *categories: str) -> "Boxes":
        """Select the boxes of some categories.

        Args:
            categories: Names of the categories.

        Returns:
            The selected boxes.
        """
        return self.select(
            torch.tensor([category in categories for category in self.categories], dtype=torch.bool, device="cpu")
        )

    def pin_memory(self) -> "Boxes":
        """Copy the boxes to page-locked memory."""
        return self._transform_tensors(Tensor.pin_memory)

    def to(self, device: torch.device | str) -> "Boxes":
        """Copy the boxes to a device.

        Args:
            device: Target device.

        Returns:
            The copy; its tensors are float32 if the device does not support float64.
        """
        return self._transform_tensors(partial(move_tensor, device=device))

    def _transform_tensors(self, transform: Callable[[Tensor], Tensor], **names: tuple[str, ...]) -> "Boxes":
        """Copy the boxes with every tensor transformed, and with other names if the number of boxes changes."""
        tensors = ("center_m", "size_m", "yaw_rad", "velocity_mps", "sampled_points", "bottom_heights_m", "visibility")
        changed: dict[str, Any] = {name: transform(getattr(self, name)) for name in tensors} | names
        points_in_box = {rig: transform(count) for rig, count in self.points_in_box.items()}
        return replace(self, **changed, points_in_box=points_in_box)


def check_boxes(boxes: object) -> None:
    """Raise a TypeError unless the argument is `Boxes`; frames without known objects have None.

    Args:
        boxes: Argument to check.
    """
    if not isinstance(boxes, Boxes):
        raise TypeError(
            f"boxes: Boxes are needed, possibly empty; got {type(boxes).__name__}; "
            "SimulatedFrames(..., boxes=True) makes them"
        )


def build_upright_rows(
    center_m: ArrayLike, size_m: ArrayLike, heading_vectors: ArrayLike, vehicle_T_source: Matrix | None
) -> Tensor:
    """Build rows of upright boxes in the vehicle frame; tilted boxes become upright and keep their heading.

    Args:
        center_m: (K, 3) centers in the source frame.
        size_m: (K, 3) length, width, height.
        heading_vectors: (K, 3) direction of the length axis in the source frame.
        vehicle_T_source: (4, 4) pose of the source frame; None: the source is the vehicle frame.

    Returns:
        (K, 7) float32 center x, y, z, length, width, height, yaw.

    Raises:
        ValueError: Numbers that are not finite, or shapes that do not fit.
    """
    center, size = _to_rows("centers", center_m), _to_rows("sizes", size_m)
    heading = _to_rows("headings", heading_vectors)
    if not len(center) == len(size) == len(heading):
        counts = f"{len(center)}, {len(size)} and {len(heading)}"
        raise ValueError(f"boxes: equal numbers of centers, sizes and headings are needed; got {counts}")
    if vehicle_T_source is not None:
        center, heading = transform_points(vehicle_T_source, center), heading @ vehicle_T_source[:3, :3].T
    yaw = np.arctan2(heading[:, 1], heading[:, 0])
    return torch.from_numpy(np.column_stack([center, size, yaw])).float()


def _to_rows(name: str, values: ArrayLike) -> Float64:
    array = np.asarray(values, dtype=np.float64)
    array = array.reshape(0, 3) if array.size == 0 else array
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"{name} of boxes: shape (K, 3) is needed; got {array.shape}")
    if not np.isfinite(array).all():
        bad = int((~np.isfinite(array)).any(axis=1).sum())
        raise ValueError(f"{name} of boxes: {bad} of {len(array)} are not finite")
    return array


# Classes on this list load with `torch.load(weights_only=True)`, the default.
torch.serialization.add_safe_globals([Boxes])
