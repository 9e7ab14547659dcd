"""Where a distortion is one-to-one: the part of the chart around the optical axis before the first fold.

Along every direction from the axis the region ends at the first radius at which the determinant of the Jacobian is
not positive, or where the chart ends. Behind a fold the same pixels are met a second time; nothing there is an answer.
"""

from dataclasses import dataclass

import numpy as np

from torchcover.cameras.lens import Distortion
from torchcover.geometry.arrays import Bools, Float64

# A ray at this radius of the plane z = 1 runs along the plane z = 0: infinity, for tables that have to be interpolated.
HORIZON = 1e9
_DIRECTIONS = 360
# More than a table of that many entries is off by; for what lies between, the solver is asked.
_MARGIN = 1.0005
# Radii at which the determinant is looked at: evenly in angle over the plane z = 1, then on to the horizon.
_PLANE_RADII = np.concatenate([np.tan(np.linspace(0.0, np.pi / 2, 512, endpoint=False)), np.geomspace(400.0, 1e8, 32)])


@dataclass(frozen=True)
class Polar:
    """A positive function of the azimuth: one number, or a table over -pi..pi whose last entry repeats the first."""

    values: Float64

    @property
    def least(self) -> float:
        """Its minimum."""
        return float(self.values.min())

    def __call__(self, a: Float64, b: Float64) -> Float64:
        """Value in the direction of each (a, b), linearly interpolated."""
        if len(self.values) == 1:
            return np.broadcast_to(self.values, a.shape)
        place = (np.arctan2(b, a) + np.pi) * ((len(self.values) - 1) / (2.0 * np.pi))
        low = np.nan_to_num(place).astype(np.int64).clip(0, len(self.values) - 2)
        left = self.values[low]
        return np.asarray(left + (place - low) * (self.values[low + 1] - left))

    def holds(self, radius: Float64, a: Float64, b: Float64) -> Bools:
        """Whether the radii of (a, b) are at most the function; it is looked up only where its minimum is passed."""
        held: Bools = radius <= self.least
        unsure = np.flatnonzero(~held)
        if len(unsure) and len(self.values) > 1:
            held[unsure] = radius[unsure] <= self(a[unsure], b[unsure])
        return held


@dataclass(frozen=True)
class ValidRegion:
    """The valid region of a distortion, which ends at the radius `edge` over the azimuth.

    Up to `guard`, which lies behind the edge, a positive determinant means "inside", so that it decides, not the table.
    `reach` is the largest distorted radius of any pixel worth solving, over the azimuth of the distorted point.
    """

    edge: Polar
    guard: Polar
    reach: Polar

    def contains(self, a: Float64, b: Float64, determinant: Float64) -> Bools:
        """Whether drawn points lie in the region; `determinant` is that of the Jacobian at them."""
        return (determinant > 0.0) & self.guard.holds(np.sqrt(a * a + b * b), a, b)


def find_region(distortion: Distortion, limit: float) -> ValidRegion:
    """Find the valid region."""
    limit = min(limit, HORIZON)
    count = 1 if distortion.symmetric else _DIRECTIONS + 1
    azimuth = np.linspace(-np.pi, np.pi, count)
    cosine, sine = np.cos(azimuth), np.sin(azimuth)
    radii = _radii(distortion, limit)
    good = _determinant(distortion, cosine[:, None] * radii, sine[:, None] * radii) > 0.0
    good[:, 0] = True  # the axis, around which every lens is one-to-one
    first_bad = np.where(good.all(axis=1), len(radii), (~good).argmax(axis=1))
    ends = np.append(radii, HORIZON)
    edge = _bisect(distortion, cosine, sine, ends[first_bad - 1], ends[first_bad])
    edge = np.where(first_bad == len(radii), limit, edge).clip(max=limit)
    again = good & (radii > edge[:, None])
    next_good = np.where(again.any(axis=1), radii[again.argmax(axis=1)], 2.0 * limit)
    guard = ((edge + next_good) / 2.0).clip(max=limit)
    return ValidRegion(Polar(edge), Polar(guard), Polar(_reach(distortion, edge * cosine, edge * sine)))


def _radii(distortion: Distortion, limit: float) -> Float64:
    """Radii to look at: critical ones, the middles between them so that no fold is stepped over, and a plain grid."""
    critical = np.sort(distortion.critical_radii())
    middles = (critical[:-1] + critical[1:]) / 2.0
    plain = np.append(_PLANE_RADII, HORIZON) if limit >= HORIZON else np.linspace(0.0, limit, 512)
    radii = np.unique(np.concatenate([plain, critical, middles]))
    return radii[radii <= limit]


def _determinant(distortion: Distortion, a: Float64, b: Float64) -> Float64:
    with np.errstate(all="ignore"):
        return np.nan_to_num(distortion.linearise(a, b).determinant, nan=-1.0)


def _bisect(distortion: Distortion, cosine: Float64, sine: Float64, low: Float64, high: Float64) -> Float64:
    """Radius of the sign change between `low` and `high`, to the last bits."""
    for _ in range(64):
        middle = (low + high) / 2.0
        positive = _determinant(distortion, middle * cosine, middle * sine) > 0.0
        low, high = np.where(positive, middle, low), np.where(positive, high, middle)
    return low


def _reach(distortion: Distortion, a: Float64, b: Float64) -> Float64:
    """Distorted radius of the edge over the azimuth of the image, a little widened for what lies between entries."""
    if np.hypot(a, b).max() >= HORIZON:
        return np.array([np.inf])
    image = distortion.linearise(a, b)
    radius = np.hypot(image.u, image.v)
    if distortion.symmetric:
        return radius * (1.0 + 1e-14)
    azimuth = np.arctan2(image.v, image.u)
    turns = np.diff(np.unwrap(azimuth))
    if not (turns > 0.0).all():  # cusps: no single distance in every direction
        return np.array([radius.max()])
    order = np.argsort(azimuth[:-1])
    grid = np.linspace(-np.pi, np.pi, len(azimuth))
    return _MARGIN * np.interp(grid, azimuth[order], radius[order], period=2.0 * np.pi)
