"""Fisheye lenses: the equidistant chart and its distortions."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi

import numpy as np
import torch
from torch import Tensor

from torchcover.cameras.lens import Linearization, Scalar, find_positive_roots, to_float
from torchcover.geometry.arrays import Float64


@dataclass(frozen=True)
class AngleChart:
    """Equidistant chart up to 180 degrees: (a, b) is the angle from the axis times the unit vector towards (x, y).

    It does not use the plane z = 1. `distort_points_kannala_brandt` of kornia does, and cannot show directions of 90
    degrees and more; below a radius of 1e-4 it ignores the polynomial, an error of 7e-9 px at a focal length of
    20,000 px. A test compares both where both are defined.
    """

    limit: float = pi

    def project(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Map every direction except the one straight back, whose azimuth is undefined; see `Chart`."""
        squared = x * x + y * y
        off_axis = squared > 0
        radius = torch.sqrt(torch.where(off_axis, squared, 1.0))
        # On the axis angle / radius tends to 1 / z.
        stretch = torch.where(off_axis, torch.atan2(radius, z) / radius, 1.0 / torch.where(z > 0, z, 1.0))
        return x * stretch, y * stretch, off_axis | (z > 0)

    def unproject(self, a: Tensor, b: Tensor) -> Tensor:
        """Compute (a sin(t)/t, b sin(t)/t, cos t) with t = |(a, b)|; see `Chart`."""
        squared = a * a + b * b
        small = squared < 1e-8  # there the first terms of the series are exact in float64, and smooth at the axis
        angle = torch.sqrt(torch.where(small, 1.0, squared))
        ratio = torch.where(small, 1.0 - squared / 6.0, torch.sin(angle) / angle)
        forward = torch.where(small, 1.0 - squared / 2.0, torch.cos(angle))
        return torch.stack((a * ratio, b * ratio, forward), dim=-1)


def _linearize_radial(a: Float64, b: Float64, gain: Float64, slope: Float64) -> Linearization:
    """Linearize the radial map (a, b) * gain, where gain has the gradient slope * (a, b)."""
    twist = slope * a * b
    return Linearization(a * gain, b * gain, gain + slope * a * a, twist, twist, gain + slope * b * b)


@dataclass(frozen=True)
class KannalaBrandt:
    """Distortion t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8): fisheye of OpenCV, equidistant of Kalibr.

    Args:
        coefficients: k1 k2 k3 k4.
        is_radial: Always True.
    """

    coefficients: Sequence[Scalar]
    is_radial: bool = True

    def distort(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """Distort points along their radius; see `Distortion`."""
        k1, k2, k3, k4 = self.coefficients
        s = a * a + b * b
        gain = 1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4)))
        return a * gain, b * gain

    def linearize(self, a: Float64, b: Float64) -> Linearization:
        """Compute value and Jacobian; see `Distortion`."""
        k1, k2, k3, k4 = (to_float(k) for k in self.coefficients)
        s = a * a + b * b
        gain = 1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4)))
        slope = 2.0 * (k1 + s * (2.0 * k2 + s * (3.0 * k3 + s * (4.0 * k4))))
        return _linearize_radial(a, b, gain, slope)

    def distort_radius(self, radius: Float64) -> Float64:
        """Compute the distorted angles in radians of (N,) incidence angles in radians, the radii of this chart."""
        k1, k2, k3, k4 = (to_float(k) for k in self.coefficients)
        s = radius * radius
        return radius * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))))

    def find_critical_radii(self) -> Float64:
        """Find the zeros of the derivative of the distorted angle."""
        k1, k2, k3, k4 = (to_float(k) for k in self.coefficients)
        return np.sqrt(find_positive_roots([1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3, 9.0 * k4]))


@dataclass(frozen=True)
class ThetaPolynomial:
    """Distortion k1 t + k2 t^2 + k3 t^3 + k4 t^4: fisheyes of WoodScape (there in pixels, with fx = fy = 1).

    Args:
        coefficients: k1 k2 k3 k4.
        is_radial: Always True.
    """

    coefficients: Sequence[Scalar]
    is_radial: bool = True

    def distort(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """Distort points along their radius; see `Distortion`."""
        k1, k2, k3, k4 = self.coefficients
        angle = torch.sqrt((a * a + b * b).clamp(min=1e-40))  # keeps derivatives finite at the kink of odd powers
        gain = k1 + angle * (k2 + angle * (k3 + angle * k4))
        return a * gain, b * gain

    def linearize(self, a: Float64, b: Float64) -> Linearization:
        """Compute value and Jacobian; see `Distortion`."""
        k1, k2, k3, k4 = (to_float(k) for k in self.coefficients)
        angle = np.sqrt(np.maximum(a * a + b * b, 1e-40))  # as in `distort`
        gain = k1 + angle * (k2 + angle * (k3 + angle * k4))
        return _linearize_radial(a, b, gain, (k2 + angle * (2.0 * k3 + angle * (3.0 * k4))) / angle)

    def distort_radius(self, radius: Float64) -> Float64:
        """Compute the distorted angles in radians of (N,) incidence angles in radians, the radii of this chart."""
        k1, k2, k3, k4 = (to_float(k) for k in self.coefficients)
        return radius * (k1 + radius * (k2 + radius * (k3 + radius * k4)))

    def find_critical_radii(self) -> Float64:
        """Find the zeros of the derivative of the distorted angle."""
        k1, k2, k3, k4 = (to_float(k) for k in self.coefficients)
        return find_positive_roots([k1, 2.0 * k2, 3.0 * k3, 4.0 * k4])
