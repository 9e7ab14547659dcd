"""Whether a place lies on a face, as far as float32 can tell."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from torchcover.simulation.shapes import Mesh

# An origin lies on a face if it is no farther from its plane than this many times what rounding makes of that.
CONTACT_ROUNDINGS = 4
# Origins are rounded too, before they come here: in float64, as a share of the largest coordinate.
MIN_CONTACT = 1e-12


class Faces:
    """The faces of all bodies, one after the other, and how far from each a place counts as on it.

    `contact_m` (F,) bounds the distance from its plane at which float32 may find a place that lies on it, unless it is
    a sliver.
    """

    def __init__(self, bodies: Sequence[Mesh], reach_m: float) -> None:
        first, second, third = np.concatenate([body.vertices_m[body.faces] for body in bodies]).transpose(1, 2, 0)
        (ax, ay, az), (bx, by, bz) = np.abs(second - first), np.abs(third - first)
        across = np.cross(second - first, third - first, axis=0)
        length = np.linalg.norm(across, axis=0)
        length[length == 0] = np.inf  # Embree does not hit a face without an area
        # To first order, the roundings of n . x, where n = a x b, are the sum of all its products.
        products = np.stack([ay * bz + az * by, az * bx + ax * bz, ax * by + ay * bx])
        largest = np.abs([first, second, third]).max(axis=0)
        rounding_m = (products * largest).sum(axis=0) / length
        # The plane of a sliver is anybody's guess, but the sliver is not far from where it is.
        rounding_m = np.minimum(rounding_m, largest.max(axis=0)) * np.finfo(np.float32).eps
        self.contact_m = np.maximum(CONTACT_ROUNDINGS * rounding_m, MIN_CONTACT * reach_m)
        self._normals = across / length
        self._corner_m = first
        self._lower_m = np.min([first, second, third], axis=0) - 2 * self.contact_m
        self._upper_m = np.max([first, second, third], axis=0) + 2 * self.contact_m
        self._least_m, self._most_m = (
            self._lower_m.min(axis=1, initial=np.inf),
            self._upper_m.max(axis=1, initial=-np.inf),
        )

    def holding(self, place_m: NDArray[np.floating]) -> NDArray[np.int64]:
        """Numbers of those that a (3,) place lies on."""
        if ((place_m < self._least_m) | (place_m > self._most_m)).any():
            return np.empty(0, dtype=np.int64)
        x, y, z = place_m
        # One axis after the other: the first, which asks all faces, leaves few to the second.
        near = np.flatnonzero((self._lower_m[2] <= z) & (z <= self._upper_m[2]))
        for axis, coordinate_m in ((0, x), (1, y)):
            near = near[(self._lower_m[axis, near] <= coordinate_m) & (coordinate_m <= self._upper_m[axis, near])]
        held: NDArray[np.int64] = near[self.from_plane_m(place_m, near) <= 2 * self.contact_m[near]]
        return held

    def from_plane_m(self, place_m: NDArray[np.floating], faces: NDArray[np.int64]) -> NDArray[np.float64]:
        """Distance of a (3,) place from the planes of some of them."""
        along_normal = (place_m[:, None] - self._corner_m[:, faces]) * self._normals[:, faces]
        distance_m: NDArray[np.float64] = np.abs(along_normal.sum(axis=0))
        return distance_m
