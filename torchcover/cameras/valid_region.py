"""Valid region of a lens: the part of its chart in which the distortion is one-to-one."""

from dataclasses import dataclass

import numpy as np

from torchcover.cameras.lens import Distortion
from torchcover.geometry.arrays import Bools, Float64

# Radius on the plane z = 1 that stands for infinity, since tables must be interpolated: such a ray runs along z = 0.
HORIZON = 1e9


@dataclass(frozen=True)
class AzimuthFunction:
    """Positive function of the azimuth.

    Args:
        values: One number, or a table over -pi..pi whose last entry repeats the first.
    """

    values: Float64

    @property
    def minimum(self) -> float:
        """Smallest value of the function."""
        return float(self.values.min())

    def __call__(self, a: Float64, b: Float64) -> Float64:
        """Interpolate the function linearly in the direction of each (a, b)."""
        if len(self.values) == 1:
            return np.broadcast_to(self.values, a.shape)
        position = (np.arctan2(b, a) + np.pi) * ((len(self.values) - 1) / (2.0 * np.pi))
        low = np.nan_to_num(position).astype(np.int64).clip(0, len(self.values) - 2)
        left = self.values[low]
        return np.asarray(left + (position - low) * (self.values[low + 1] - left))

    def contains(self, radius: Float64, a: Float64, b: Float64) -> Bools:
        """Test which radii are at most the function, which is evaluated only beyond its minimum.

        Args:
            radius: (N,) radii.
            a: (N,) first coordinates of the directions.
            b: (N,) second coordinates.
        """
        is_inside: Bools = radius <= self.minimum
        unsure = np.flatnonzero(~is_inside)
        if len(unsure) and len(self.values) > 1:
            is_inside[unsure] = radius[unsure] <= self(a[unsure], b[unsure])
        return is_inside


@dataclass(frozen=True)
class ValidRegion:
    """Part of the chart around the optical axis in which a distortion is one-to-one.

    In each direction it ends at the first radius at which the determinant of the Jacobian is not positive, or where the
    chart ends. Behind such a fold the same pixels appear again; no solution lies there.

    Args:
        edge_radius: Radius of the edge, over the azimuth.
        guard_radius: Radius behind the edge up to which a positive determinant means "inside", so that the determinant
            decides and not the table.
        max_distorted_radius: Largest distorted radius of a pixel that can have a solution, over the azimuth of the
            distorted point.
    """

    edge_radius: AzimuthFunction
    guard_radius: AzimuthFunction
    max_distorted_radius: AzimuthFunction

    def contains(self, a: Float64, b: Float64, determinant: Float64) -> Bools:
        """Test which chart points lie in the region.

        Args:
            a: (N,) first coordinates.
            b: (N,) second coordinates.
            determinant: (N,) determinant of the Jacobian there.
        """
        return (determinant > 0.0) & self.guard_radius.contains(np.sqrt(a * a + b * b), a, b)


def find_valid_region(distortion: Distortion, limit: float) -> ValidRegion:
    """Find the valid region of a distortion.

    Args:
        distortion: The distortion, with coefficients that are floats.
        limit: Radius at which the chart ends, or infinity.
    """
    limit = min(limit, HORIZON)
    azimuth = np.linspace(-np.pi, np.pi, 1 if distortion.is_radial else 361)
    cosine, sine = np.cos(azimuth), np.sin(azimuth)
    radii = _list_test_radii(distortion, limit)
    is_positive = _compute_determinant(distortion, cosine[:, None] * radii, sine[:, None] * radii) > 0.0
    is_positive[:, 0] = True  # the axis, around which every lens is one-to-one
    first_bad = np.where(is_positive.all(axis=1), len(radii), (~is_positive).argmax(axis=1))
    ends = np.append(radii, HORIZON)
    edge = _bisect_sign_change(distortion, cosine, sine, ends[first_bad - 1], ends[first_bad])
    edge = np.where(first_bad == len(radii), limit, edge).clip(max=limit)
    is_positive_again = is_positive & (radii > edge[:, None])
    next_radius = np.where(is_positive_again.any(axis=1), radii[is_positive_again.argmax(axis=1)], 2.0 * limit)
    guard = ((edge + next_radius) / 2.0).clip(max=limit)
    max_distorted = _compute_distorted_edge(distortion, edge * cosine, edge * sine)
    return ValidRegion(AzimuthFunction(edge), AzimuthFunction(guard), AzimuthFunction(max_distorted))


def _list_test_radii(distortion: Distortion, limit: float) -> Float64:
    """List the radii at which the determinant is tested.

    A plain grid (even in angle over the plane z = 1, then on to the horizon), critical radii, and the middles between
    those, so that no fold is stepped over.
    """
    critical = np.sort(distortion.find_critical_radii())
    middles = (critical[:-1] + critical[1:]) / 2.0
    if limit >= HORIZON:
        even_in_angle = np.tan(np.linspace(0.0, np.pi / 2, 512, endpoint=False))
        plain = np.concatenate([even_in_angle, np.geomspace(400.0, 1e8, 32), [HORIZON]])
    else:
        plain = np.linspace(0.0, limit, 512)
    radii = np.unique(np.concatenate([plain, critical, middles]))
    return radii[radii <= limit]


def _compute_determinant(distortion: Distortion, a: Float64, b: Float64) -> Float64:
    with np.errstate(all="ignore"):
        return np.nan_to_num(distortion.linearize(a, b).determinant, nan=-1.0)


def _bisect_sign_change(distortion: Distortion, cosine: Float64, sine: Float64, low: Float64, high: Float64) -> Float64:
    """Bisect to the radius between `low` and `high` at which the determinant changes its sign, to the last bits."""
    for _ in range(64):
        middle = (low + high) / 2.0
        is_positive = _compute_determinant(distortion, middle * cosine, middle * sine) > 0.0
        low, high = np.where(is_positive, middle, low), np.where(is_positive, high, middle)
    return low


def _compute_distorted_edge(distortion: Distortion, a: Float64, b: Float64) -> Float64:
    """Compute the distorted radius of the edge over the azimuth of the image, slightly enlarged."""
    if np.hypot(a, b).max() >= HORIZON:
        return np.array([np.inf])
    image = distortion.linearize(a, b)
    radius = np.hypot(image.u, image.v)
    if distortion.is_radial:
        return radius * (1.0 + 1e-14)
    azimuth = np.arctan2(image.v, image.u)
    turns = np.diff(np.unwrap(azimuth))
    if not (turns > 0.0).all():  # cusps: there is no single distance per direction
        return np.array([radius.max()])
    order = np.argsort(azimuth[:-1])
    grid = np.linspace(-np.pi, np.pi, len(azimuth))
    margin = 1.0005  # more than the error of interpolation between entries; the solver decides about the rest
    return margin * np.interp(grid, azimuth[order], radius[order], period=2.0 * np.pi)
