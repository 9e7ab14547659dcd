"""The skin of a body, where straight lines from outside first meet it, and patches of it that carry sensors."""

from functools import cached_property
from typing import Literal, NamedTuple, Self

import numpy as np
from pydantic import model_validator

from torchcover.geometry.arrays import Float64
from torchcover.simulation.documents import Bounds, Document
from torchcover.simulation.instant import is_enclosed
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.shapes import Mesh

MountSide = Literal["above", "front", "rear", "left", "right"]

# Which axis one looks along, and on which end of it one is.
SEEN_FROM: dict[MountSide, tuple[int, int]] = {
    "above": (2, 1),
    "front": (0, 1),
    "rear": (0, -1),
    "left": (1, 1),
    "right": (1, -1),
}
# Where a level sensor of yaw 0 looks.
FACING_DEG: dict[MountSide, float] = {"above": 0.0, "front": 0.0, "rear": 180.0, "left": 90.0, "right": -90.0}
AXES = "xyz"
# A line counts as through a triangle if it passes it no farther out than this share of its extent: edges are shared.
EDGE_SHARE = 1e-9


class SkinPoint(NamedTuple):
    """A place on a body, `position_m` (3,), and the direction `normal` (3,) in which its skin faces there."""

    position_m: Float64
    normal: Float64


class Skin:
    """The outside of a body: where straight lines from outside first meet it."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._corners_m: Float64 = mesh.vertices_m[mesh.faces]

    def __reduce__(self) -> tuple[type["Skin"], tuple[Mesh]]:
        return Skin, (self.mesh,)

    def find_surface_point(self, side: MountSide, cross_coordinates_m: tuple[float, float]) -> SkinPoint | None:
        """Where a line along an axis first meets the body, and the normal of that face; None if it meets nothing.

        Exactly on the mesh, in float64. The line comes from the side, at `cross_coordinates_m` on the two other axes in the order
        x, y, z.
        """
        axis, sign = SEEN_FROM[side]
        others = [other for other in range(3) if other != axis]
        corners = self._corners_m
        flat = corners[:, :, others] - np.asarray(cross_coordinates_m)
        following, last = np.roll(flat, -1, axis=1), np.roll(flat, -2, axis=1)
        # Twice the signed areas of the three triangles between the line and an edge, each opposite to a corner.
        areas = following[..., 0] * last[..., 1] - following[..., 1] * last[..., 0]
        whole = areas.sum(axis=1)
        slack = EDGE_SHARE * np.ptp(corners[:, :, others], axis=1).max(axis=1) ** 2
        turned = areas * np.sign(whole)[:, None]
        met = np.flatnonzero((turned >= -slack[:, None]).all(axis=1) & (np.abs(whole) > slack))
        if len(met) == 0:
            return None
        depth_m = (areas[met] * corners[met][:, :, axis]).sum(axis=1) / whole[met]
        nearest = int(np.argmax(sign * depth_m))
        place_m = np.empty(3)
        place_m[others], place_m[axis] = cross_coordinates_m, depth_m[nearest]
        first, second, third = corners[met[nearest]]
        normal = np.cross(second - first, third - first)
        # Outwards is where the line came from, whichever way the face's corners turn.
        return SkinPoint(place_m, normal / np.linalg.norm(normal) * np.sign(sign * normal[axis]) + 0.0)

    def is_inside(self, position_m: Float64) -> bool:
        """Whether a (3,) place lies inside the body, so that no ray gets out."""
        return is_enclosed(self._caster, position_m)

    @cached_property
    def _caster(self) -> RayCaster:
        return RayCaster([self.mesh])


class MountRegion(Document):
    """A patch of a vehicle's skin that sensors can be mounted on: what is seen of the body in a window, from one side.

    Args:
        side: "above", "front", "rear", "left" or "right".
        x_m: Lower and upper bound forward; not for the front and the rear.
        y_m: Lower and upper bound to the left; not for the left and the right.
        z_m: Lower and upper bound upwards; not for what is seen from above.
        facing_deg: Heading of a sensor of yaw 0. Not given: forward on top, else to where the side faces: 0 at the
            front, 90 on the left, 180 at the rear, -90 on the right.

    Example:
        >>> from torchcover.simulation.shapes import Box
        >>> from torchcover.simulation.mount_regions import Skin
        >>> skin = Skin(Box(type="box", size_m=(4.0, 2.0, 1.5)).build_mesh())
        >>> left = MountRegion(side="left", x_m=(1.0, 2.0), z_m=(0.5, 1.0))
        >>> point = left.find_mount_point(skin, u=0.5, v=0.0)
        >>> point.position_m, point.normal
        (array([1.5, 1. , 0.5]), array([0., 1., 0.]))
    """

    side: MountSide
    x_m: Bounds | None = None
    y_m: Bounds | None = None
    z_m: Bounds | None = None
    facing_deg: float | None = None

    @model_validator(mode="after")
    def _check_window(self) -> Self:
        along = AXES[SEEN_FROM[self.side][0]]
        given = [axis for axis in AXES if getattr(self, f"{axis}_m") is not None]
        needed = [axis for axis in AXES if axis != along]
        if given != needed:
            raise ValueError(
                f"seen from {self.side}, a window has {needed[0]}_m and {needed[1]}_m; "
                f"got {' and '.join(f'{axis}_m' for axis in given) or 'neither'}"
            )
        return self

    @property
    def heading_deg(self) -> float:
        """Heading of a sensor of yaw 0."""
        return FACING_DEG[self.side] if self.facing_deg is None else self.facing_deg

    def find_mount_point(self, skin: Skin, u: float, v: float) -> SkinPoint:
        """A place on the skin, `u` and `v` from 0 to 1 along the window's axes in the order x, y, z.

        ValueError: nothing of the body is there.
        """
        window = [bounds for bounds in (self.x_m, self.y_m, self.z_m) if bounds is not None]
        (x, y) = (low + share * (high - low) for share, (low, high) in zip((u, v), window, strict=True))
        point = skin.find_surface_point(self.side, (x, y))
        if point is None:
            axes = [axis for axis in AXES if getattr(self, f"{axis}_m") is not None]
            raise ValueError(
                f"at {axes[0]} = {x:.3f} m, {axes[1]} = {y:.3f} m (u = {u:g}, v = {v:g}) nothing of the body is seen "
                f"from {self.side}"
            )
        return point
