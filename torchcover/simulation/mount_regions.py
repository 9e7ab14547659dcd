"""Regions of the surface of a vehicle on which sensors can be mounted."""

from functools import cached_property
from typing import Literal, NamedTuple, Self

import numpy as np
from pydantic import model_validator

from torchcover.geometry.arrays import Float64
from torchcover.simulation.documents import Bounds, Document
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.scene_snapshot import is_enclosed
from torchcover.simulation.shapes import Mesh

MountSide = Literal["above", "front", "rear", "left", "right"]


class SideView(NamedTuple):
    """View of a vehicle from one side.

    Args:
        axis: Index of the axis of the view: x, y or z.
        sign: End of this axis at which the viewer is.
        heading_deg: Heading of a level sensor of yaw 0 that is mounted there.
    """

    axis: int
    sign: int
    heading_deg: float


SIDE_VIEWS: dict[MountSide, SideView] = {
    "above": SideView(2, 1, 0.0),
    "front": SideView(0, 1, 0.0),
    "rear": SideView(0, -1, 180.0),
    "left": SideView(1, 1, 90.0),
    "right": SideView(1, -1, -90.0),
}


class SkinPoint(NamedTuple):
    """Point on the surface of a body.

    Args:
        position_m: (3,) position.
        normal: (3,) unit normal, outwards.
    """

    position_m: Float64
    normal: Float64


class Skin:
    """Outer surface of a body: the first hits of straight lines from outside.

    Args:
        mesh: Mesh of the body.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._corners_m: Float64 = mesh.vertices_m[mesh.faces]

    def __reduce__(self) -> tuple[type["Skin"], tuple[Mesh]]:
        return Skin, (self.mesh,)

    def find_surface_point(self, side: MountSide, cross_coordinates_m: tuple[float, float]) -> SkinPoint | None:
        """Find the first hit of a line that is parallel to an axis, exactly on the mesh, in float64.

        Args:
            side: Side from which the line comes.
            cross_coordinates_m: Position of the line on the two other axes, in the order x, y, z.

        Returns:
            The hit, with the normal of its face; None without a hit.
        """
        view = SIDE_VIEWS[side]
        cross_axes = [axis for axis in range(3) if axis != view.axis]
        flat_m = self._corners_m[:, :, cross_axes] - np.asarray(cross_coordinates_m)
        next_m, last_m = np.roll(flat_m, -1, axis=1), np.roll(flat_m, -2, axis=1)
        # Twice the signed areas of the triangles between the line and an edge, each opposite to a corner.
        areas = next_m[..., 0] * last_m[..., 1] - next_m[..., 1] * last_m[..., 0]
        face_area = areas.sum(axis=1)
        # Hits at a tiny distance outside of a face count, because neighboring faces share their edges.
        relative_tolerance = 1e-9
        face_extent_m = np.ptp(self._corners_m[:, :, cross_axes], axis=1).max(axis=1)
        tolerance = relative_tolerance * face_extent_m**2
        oriented_areas = areas * np.sign(face_area)[:, None]
        is_hit = (oriented_areas >= -tolerance[:, None]).all(axis=1) & (np.abs(face_area) > tolerance)
        hit_faces = np.flatnonzero(is_hit)
        if len(hit_faces) == 0:
            return None
        corner_depths_m = self._corners_m[hit_faces][:, :, view.axis]
        depth_m = (areas[hit_faces] * corner_depths_m).sum(axis=1) / face_area[hit_faces]
        first_hit = int(np.argmax(view.sign * depth_m))
        position_m = np.empty(3)
        position_m[cross_axes], position_m[view.axis] = cross_coordinates_m, depth_m[first_hit]
        a, b, c = self._corners_m[hit_faces[first_hit]]
        normal = np.cross(b - a, c - a)
        # The normal points to where the line came from, whatever the order of the corners.
        outward = np.sign(view.sign * normal[view.axis])
        return SkinPoint(position_m, normal / np.linalg.norm(normal) * outward + 0.0)

    def is_inside(self, position_m: Float64) -> bool:
        """Test whether a position is inside the body, so that no ray leaves it.

        Args:
            position_m: (3,) position.

        Returns:
            True inside the body.
        """
        return is_enclosed(self._caster, position_m)

    @cached_property
    def _caster(self) -> RayCaster:
        return RayCaster([self.mesh])


class MountRegion(Document):
    """Region of a vehicle's surface on which sensors can be mounted: the visible surface in a window, from one side.

    Args:
        side: "above", "front", "rear", "left" or "right".
        x_m: Lower and upper bound forward; not for the front and the rear.
        y_m: Lower and upper bound to the left; not for the left and the right.
        z_m: Lower and upper bound upwards; not for a view from above.
        facing_deg: Heading of a sensor of yaw 0. Default: forward from above, else away from the side: 0 at the front,
            90 on the left, 180 at the rear, -90 on the right.

    Example:
        >>> from torchcover.simulation.shapes import Box
        >>> skin = Skin(Box(type="box", size_m=(4.0, 2.0, 1.5)).build_mesh())
        >>> left = MountRegion(side="left", x_m=(1.0, 2.0), z_m=(0.5, 1.0))
        >>> point = left.find_mount_point(skin, u=0.5, v=0.0)
        >>> point.position_m.tolist(), point.normal.tolist()
        ([1.5, 1.0, 0.5], [0.0, 1.0, 0.0])
    """

    side: MountSide
    x_m: Bounds | None = None
    y_m: Bounds | None = None
    z_m: Bounds | None = None
    facing_deg: float | None = None

    @model_validator(mode="after")
    def _check_window(self) -> Self:
        view_axis = "xyz"[SIDE_VIEWS[self.side].axis]
        first, second = (axis for axis in "xyz" if axis != view_axis)
        if list(self._window) != [first, second]:
            keys = " and ".join(f"{axis}_m" for axis in self._window)
            raise ValueError(f"seen from {self.side}, a window has {first}_m and {second}_m; got {keys or 'neither'}")
        return self

    @property
    def _window(self) -> dict[str, Bounds]:
        """Bounds by the name of the axis."""
        bounds = {"x": self.x_m, "y": self.y_m, "z": self.z_m}
        return {axis: axis_bounds for axis, axis_bounds in bounds.items() if axis_bounds is not None}

    @property
    def heading_deg(self) -> float:
        """Heading of a sensor of yaw 0."""
        return SIDE_VIEWS[self.side].heading_deg if self.facing_deg is None else self.facing_deg

    def find_mount_point(self, skin: Skin, u: float, v: float) -> SkinPoint:
        """Find a point of the region.

        Args:
            skin: Surface of the vehicle.
            u: Position along the first axis of the window, in the order x, y, z, from 0 to 1.
            v: Position along the second axis, from 0 to 1.

        Returns:
            The point.

        Raises:
            ValueError: There is no surface at this position.
        """
        coordinates_m = {}
        for share, (axis, (low, high)) in zip((u, v), self._window.items(), strict=True):
            coordinates_m[axis] = low + share * (high - low)
        first_m, second_m = coordinates_m.values()
        point = skin.find_surface_point(self.side, (first_m, second_m))
        if point is None:
            position = ", ".join(f"{axis} = {value:.3f} m" for axis, value in coordinates_m.items())
            raise ValueError(
                f"at {position} (u = {u:g}, v = {v:g}) the body has no surface that is visible from {self.side}"
            )
        return point
