"""The skin of a body: where straight lines from outside first meet it."""

from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.simulation.instant import ALL_AROUND_RAYS
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.shapes import Mesh

Vector = NDArray[np.float64]
Side = Literal["above", "front", "rear", "left", "right"]

# Which axis one looks along, and on which end of it one is.
SEEN_FROM: dict[Side, tuple[int, int]] = {
    "above": (2, 1),
    "front": (0, 1),
    "rear": (0, -1),
    "left": (1, 1),
    "right": (1, -1),
}
# A line counts as through a triangle if it passes it no farther out than this share of its extent: edges are shared.
EDGE_SHARE = 1e-9


class SkinPoint(NamedTuple):
    """A place on a body, `place_m` (3,), and the direction `outward` (3,) in which its skin faces there."""

    place_m: Vector
    outward: Vector


class Skin:
    """The outside of a body: where straight lines from outside first meet it.

    Args:
        mesh: The body.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._corners_m: Vector = mesh.vertices_m[mesh.faces]

    def __reduce__(self) -> tuple[type["Skin"], tuple[Mesh]]:
        return Skin, (self.mesh,)

    def seen_from(self, side: Side, across_m: tuple[float, float]) -> SkinPoint | None:
        """Where a line along an axis first meets the body: exactly on the mesh, in float64.

        Args:
            side: Where the line comes from.
            across_m: Its coordinates on the two other axes, in the order x, y, z.

        Returns:
            The place, and the normal of the face that it lies on; None if the line meets nothing.

        Example:
            >>> from torchcover.simulation.shapes import Box
            >>> Skin(Box(type="box", size_m=(4.0, 2.0, 1.5)).mesh()).seen_from("above", (1.0, 0.5)).place_m
            array([1. , 0.5, 1.5])
        """
        axis, sign = SEEN_FROM[side]
        others = [other for other in range(3) if other != axis]
        corners = self._corners_m
        flat = corners[:, :, others] - np.asarray(across_m)
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
        place_m[others], place_m[axis] = across_m, depth_m[nearest]
        first, second, third = corners[met[nearest]]
        normal = np.cross(second - first, third - first)
        # Outwards is where the line came from, whichever way the face's corners turn.
        return SkinPoint(place_m, normal / np.linalg.norm(normal) * np.sign(sign * normal[axis]) + 0.0)

    def encloses(self, place_m: Vector) -> bool:
        """Whether a (3,) place lies inside the body, so that no ray gets out."""
        limit_m = np.full(ALL_AROUND_RAYS.shape[1], np.inf, dtype=np.float32)
        return bool((self._caster.cast(place_m, ALL_AROUND_RAYS, limit_m).body >= 0).all())

    @cached_property
    def _caster(self) -> RayCaster:
        return RayCaster([self.mesh])
