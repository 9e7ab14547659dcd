"""Fisheyes: the chart of angles, and distortions that are polynomials of the angle.

Nothing here passes through z = 1, so 180 degrees are nothing special. kornia's `distort_points_kannala_brandt` starts
from z = 1 and cannot show 90 degrees off the axis; below a radius of 1e-4 it drops the polynomial, which is 7e-9 px
off at a focal length of 20,000 px. Where both are defined a test holds the two together.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi

import numpy as np
import torch
from torch import Tensor

from torchcover.cameras.lens import Linear, Scalar, number, positive_roots
from torchcover.geometry.arrays import Float64

# Below this squared angle sine and cosine are taken from their series: exact in float64, and smooth at the axis.
_SERIES = 1e-8
# Odd powers of the angle have a kink at the axis; this floor, far below any pixel, keeps their derivatives finite.
_KINK = 1e-40


@dataclass(frozen=True)
class AngleChart:
    """(a, b) = angle from the axis times the unit vector towards (x, y): equidistant, up to 180 degrees off axis."""

    limit: float = pi

    def draw(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Every direction but the one straight back, whose azimuth is unknown."""
        squared = x * x + y * y
        off_axis = squared > 0
        radius = torch.sqrt(torch.where(off_axis, squared, 1.0))
        # On the axis angle / radius tends to 1 / z.
        stretch = torch.where(off_axis, torch.atan2(radius, z) / radius, 1.0 / torch.where(z > 0, z, 1.0))
        return x * stretch, y * stretch, off_axis | (z > 0)

    def lift(self, a: Tensor, b: Tensor) -> Tensor:
        """(a sin(t)/t, b sin(t)/t, cos t) with t = |(a, b)|."""
        squared = a * a + b * b
        small = squared < _SERIES
        angle = torch.sqrt(torch.where(small, 1.0, squared))
        ratio = torch.where(small, 1.0 - squared / 6.0, torch.sin(angle) / angle)
        forward = torch.where(small, 1.0 - squared / 2.0, torch.cos(angle))
        return torch.stack((a * ratio, b * ratio, forward), dim=-1)


def _stretched(a: Float64, b: Float64, gain: Float64, slope: Float64) -> Linear:
    """A radial map (a, b) * gain whose gain has the gradient slope * (a, b)."""
    twist = slope * a * b
    return Linear(a * gain, b * gain, gain + slope * a * a, twist, twist, gain + slope * b * b)


@dataclass(frozen=True)
class KannalaBrandt:
    """t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8): OpenCV's fisheye, Kalibr's equidistant."""

    coefficients: Sequence[Scalar]
    symmetric: bool = True

    def distort(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """The map, along the radius."""
        k1, k2, k3, k4 = self.coefficients
        s = a * a + b * b
        gain = 1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4)))
        return a * gain, b * gain

    def linearise(self, a: Float64, b: Float64) -> Linear:
        """Value and Jacobian."""
        k1, k2, k3, k4 = (number(k) for k in self.coefficients)
        s = a * a + b * b
        gain = 1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4)))
        slope = 2.0 * (k1 + s * (2.0 * k2 + s * (3.0 * k3 + s * (4.0 * k4))))
        return _stretched(a, b, gain, slope)

    def radial(self, radius: Float64) -> Float64:
        """Distorted angle."""
        k1, k2, k3, k4 = (number(k) for k in self.coefficients)
        s = radius * radius
        return radius * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))))

    def critical_radii(self) -> Float64:
        """Where the derivative of the distorted angle is 0."""
        k1, k2, k3, k4 = (number(k) for k in self.coefficients)
        return np.sqrt(positive_roots([1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3, 9.0 * k4]))


@dataclass(frozen=True)
class ThetaPolynomial:
    """k1 t + k2 t^2 + k3 t^3 + k4 t^4: WoodScape's surround-view fisheyes (there in pixels, with fx = fy = 1)."""

    coefficients: Sequence[Scalar]
    symmetric: bool = True

    def distort(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """The map, along the radius."""
        k1, k2, k3, k4 = self.coefficients
        angle = torch.sqrt((a * a + b * b).clamp(min=_KINK))
        gain = k1 + angle * (k2 + angle * (k3 + angle * k4))
        return a * gain, b * gain

    def linearise(self, a: Float64, b: Float64) -> Linear:
        """Value and Jacobian."""
        k1, k2, k3, k4 = (number(k) for k in self.coefficients)
        angle = np.sqrt(np.maximum(a * a + b * b, _KINK))
        gain = k1 + angle * (k2 + angle * (k3 + angle * k4))
        return _stretched(a, b, gain, (k2 + angle * (2.0 * k3 + angle * (3.0 * k4))) / angle)

    def radial(self, radius: Float64) -> Float64:
        """Distorted angle."""
        k1, k2, k3, k4 = (number(k) for k in self.coefficients)
        return radius * (k1 + radius * (k2 + radius * (k3 + radius * k4)))

    def critical_radii(self) -> Float64:
        """Where the derivative of the distorted angle is 0."""
        k1, k2, k3, k4 = (number(k) for k in self.coefficients)
        return positive_roots([k1, 2.0 * k2, 3.0 * k3, 4.0 * k4])
