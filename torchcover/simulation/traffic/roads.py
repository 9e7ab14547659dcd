"""Lines that bodies follow: from a way along the line to a pose."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from torchcover.geometry.arrays import Float64


@dataclass(frozen=True, eq=False)
class Polyline:
    """A polyline through (K, 2) corners on the ground that goes on straight beyond its ends, or a loop.

    Curves need corners close to each other. The seam of a loop, whose last corner equals the first, lies on a straight
    part.
    """

    points_m: Float64
    closed: bool = False

    @cached_property
    def arc_m(self) -> Float64:
        """(K,) way along the line at each corner."""
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.points_m, axis=0), axis=1))])

    @property
    def length_m(self) -> float:
        """Length, of a loop once around."""
        return float(self.arc_m[-1])

    def poses(self, place_m: ArrayLike) -> Float64:
        """(..., 3) x and y in metres, and yaw in degrees, after (...) ways along the line; on a loop of any size."""
        place = np.asarray(place_m, dtype=np.float64)
        place = np.mod(place, self.length_m) if self.closed else place
        segment = np.clip(np.searchsorted(self.arc_m, place, side="right") - 1, 0, len(self.arc_m) - 2)
        along = (place - self.arc_m[segment])[..., None]
        position = self.points_m[segment] + along * self._directions[segment]
        yaw = np.rad2deg(np.interp(place, self.arc_m, self.headings))
        return np.concatenate([position, yaw[..., None]], axis=-1)

    @cached_property
    def _directions(self) -> Float64:
        steps = np.diff(self.points_m, axis=0)
        return np.asarray(steps / np.linalg.norm(steps, axis=1, keepdims=True))

    @cached_property
    def headings(self) -> Float64:
        """(K,) heading at each corner in radians, halfway between the pieces that meet there, without jumps."""
        pieces = np.unwrap(np.arctan2(self._directions[:, 1], self._directions[:, 0]))
        return np.concatenate([pieces[:1], (pieces[:-1] + pieces[1:]) / 2, pieces[-1:]])


def loop(length_m: float, width_m: float, corner_radius_m: float) -> Polyline:
    """A rounded rectangle about the origin, run counter-clockwise from the middle of its lower side."""
    across, up = length_m / 2 - corner_radius_m, width_m / 2 - corner_radius_m
    points = [np.array([[0.0, -width_m / 2]])]
    for quarter, (x, y) in enumerate([(across, -up), (across, up), (-across, up), (-across, -up)]):
        angle = np.linspace(quarter - 1, quarter, 17) * np.pi / 2
        points.append(np.array([x, y]) + corner_radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return Polyline(np.concatenate([*points, points[0]]), closed=True)
