"""Unified and fisheye lenses, and all lens models by name with the number and order of their coefficients.

The unified models (sphere of MEI, extended unified model EUCM, double sphere) have an inverse in closed form; only MEI
adds a distortion, that of Brown-Conrady. Their charts show no directions beyond the fold of their own image.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, pi, sqrt

import numpy as np
import torch
from torch import Tensor

from torchcover.cameras.lens import (
    BrownConrady,
    Lens,
    Linearization,
    PlaneChart,
    Scalar,
    SensorTilt,
    find_positive_roots,
    to_float,
)
from torchcover.geometry.arrays import Float64


def _compute_norm(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    return _compute_root(x * x + y * y + z * z)


def _compute_root(value: Tensor) -> Tensor:
    """Compute the square root of values that rounding may have moved below 0; its gradient at 0 is 0, not infinite."""
    is_positive = value > 0
    return torch.where(is_positive, torch.sqrt(torch.where(is_positive, value, 1.0)), 0.0)


def _normalize(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    norm = _compute_norm(x, y, z)
    return torch.stack((x / norm, y / norm, z / norm), dim=-1)


def _divide(x: Tensor, y: Tensor, divisor: Tensor, is_shown: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    divisor = torch.where(is_shown, divisor, 1.0)  # keeps NaN out of the gradients
    return x / divisor, y / divisor, is_shown


@dataclass(frozen=True)
class SphereChart:
    """Unit sphere seen from a distance xi behind its center, (x, y) / (z + xi |p|) (Mei and Rives 2007).

    Args:
        xi: Distance of the viewpoint from the center, at least 0; 0 is the pinhole.
    """

    xi: Scalar

    @property
    def limit(self) -> float:
        """Radius of the rim of the sphere as seen from outside, else infinity."""
        xi = to_float(self.xi)
        return 1.0 / sqrt(xi * xi - 1.0) if xi > 1.0 else inf

    def project(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Map directions on the near side of the rim; see `Chart`."""
        xi, norm = to_float(self.xi), _compute_norm(x, y, z)
        is_shown = z > -norm * (1.0 / xi if xi > 1.0 else xi)
        return _divide(x, y, z + self.xi * norm, is_shown)

    def unproject(self, a: Tensor, b: Tensor) -> Tensor:
        """Compute the nearer intersection of the line of sight with the sphere; see `Chart`."""
        s = a * a + b * b
        reach = (self.xi + _compute_root(1.0 + (1.0 - self.xi * self.xi) * s)) / (s + 1.0)
        return _normalize(a * reach, b * reach, reach - self.xi)


@dataclass(frozen=True)
class ExtendedChart:
    """Extended unified model (x, y) / (alpha d + (1 - alpha) z), d = sqrt(beta (x^2 + y^2) + z^2).

    Khomutenko et al. (2016).

    Args:
        alpha: 0, the pinhole, to 1.
        beta: Above 0; 1 is the sphere.
    """

    alpha: Scalar
    beta: Scalar

    @property
    def limit(self) -> float:
        """Radius at which the image folds; infinity for alpha up to 0.5."""
        alpha, beta = to_float(self.alpha), to_float(self.beta)
        return 1.0 / sqrt(beta * (2.0 * alpha - 1.0)) if alpha > 0.5 else inf

    def project(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Map directions before the fold; see `Chart`."""
        alpha = to_float(self.alpha)
        d = _compute_root(self.beta * (x * x + y * y) + z * z)
        is_shown = z > -d * (min(alpha, 1.0 - alpha) / max(alpha, 1.0 - alpha))
        return _divide(x, y, self.alpha * d + (1.0 - self.alpha) * z, is_shown)

    def unproject(self, a: Tensor, b: Tensor) -> Tensor:
        """Compute the closed form of the paper; see `Chart`."""
        s = self.beta * (a * a + b * b)
        below = self.alpha * _compute_root(1.0 - (2.0 * self.alpha - 1.0) * s) + 1.0 - self.alpha
        return _normalize(a, b, (1.0 - self.alpha * self.alpha * s) / below)


@dataclass(frozen=True)
class DoubleSphereChart:
    """Double sphere (x, y) / (alpha |(x, y, xi d + z)| + (1 - alpha) (xi d + z)), d = |p| (Usenko et al. 2018).

    Args:
        xi: Distance between the two centers, -1 to 1.
        alpha: 0 to 1.
    """

    xi: Scalar
    alpha: Scalar

    @property
    def limit(self) -> float:
        """Radius at which the image folds; infinity for alpha up to 0.5."""
        alpha = to_float(self.alpha)
        return 1.0 / sqrt(2.0 * alpha - 1.0) if alpha > 0.5 else inf

    def project(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Map directions before the fold; see `Chart`."""
        xi, alpha = to_float(self.xi), to_float(self.alpha)
        # The image folds where the direction has the cosine -w1 at the second center, and -w2 at the first. (The w2 of
        # the paper assumes the distance 1 from both centers, and ends some degrees too early.)
        w1 = min(alpha, 1.0 - alpha) / max(alpha, 1.0 - alpha)
        squared_sine = 1.0 - w1 * w1
        w2 = xi * squared_sine + w1 * sqrt(1.0 - xi * xi * squared_sine)
        norm = _compute_norm(x, y, z)
        second_z = self.xi * norm + z
        divisor = self.alpha * _compute_norm(x, y, second_z) + (1.0 - self.alpha) * second_z
        return _divide(x, y, divisor, z > -w2 * norm)

    def unproject(self, a: Tensor, b: Tensor) -> Tensor:
        """Compute the closed form of the paper; see `Chart`."""
        s = a * a + b * b
        below = self.alpha * _compute_root(1.0 - (2.0 * self.alpha - 1.0) * s) + 1.0 - self.alpha
        z = (1.0 - self.alpha * self.alpha * s) / below
        reach = (z * self.xi + _compute_root(z * z + (1.0 - self.xi * self.xi) * s)) / (z * z + s)
        return _normalize(a * reach, b * reach, reach * z - self.xi)


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


# Allowed numbers and order of the coefficients of each model.
COEFFICIENTS = {
    "pinhole": ((0,), "none"),
    "brown_conrady": ((4, 5, 8, 12, 14), "k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tau_x tau_y]]]]"),
    "kannala_brandt": ((4,), "k1 k2 k3 k4"),
    "theta_polynomial": ((4,), "k1 k2 k3 k4"),
    "mei": ((1, 5), "xi [k1 k2 p1 p2]"),
    "eucm": ((2,), "alpha beta"),
    "double_sphere": ((2,), "xi alpha"),
}


# Index, name, smallest and largest value of the coefficients with limits.
_RANGES = {
    "mei": [(0, "xi", 0.0, float("inf"))],
    "eucm": [(0, "alpha", 0.0, 1.0), (1, "beta", 1e-12, float("inf"))],
    # At xi = -1 the second center is where the optical axis meets the sphere, which has no pixel then.
    "double_sphere": [(0, "xi", -1.0 + 1e-12, 1.0), (1, "alpha", 0.0, 1.0)],
}


def check_model(model: str, coefficients: Sequence[float]) -> None:
    """Check that a model exists and takes these coefficients.

    Args:
        model: Name of the model.
        coefficients: Its coefficients.

    Raises:
        ValueError: Unknown model, wrong number of coefficients, or a value out of range.
    """
    if model not in COEFFICIENTS:
        raise ValueError(f"camera model {model!r} is unknown; allowed: {', '.join(COEFFICIENTS)}")
    counts, order = COEFFICIENTS[model]
    if len(coefficients) not in counts:
        allowed = " or ".join(str(count) for count in counts)
        raise ValueError(f"camera model {model!r} takes {allowed} coefficients ({order}); got {len(coefficients)}")
    if not all(abs(value) < float("inf") for value in coefficients):
        raise ValueError(f"camera model {model!r}: coefficients must be finite; got {list(coefficients)}")
    for index, name, low, high in _RANGES.get(model, []):
        if not low <= coefficients[index] <= high:
            raise ValueError(
                f"camera model {model!r}: {name} must lie in [{low:g}, {high:g}]; got {coefficients[index]}"
            )
    if model == "theta_polynomial" and coefficients[0] <= 0:
        raise ValueError(f"camera model {model!r}: k1 must be positive; got {coefficients[0]}")


def build_lens(model: str, coefficients: Sequence[Scalar], *, is_trainable: bool) -> Lens:
    """Build the lens of a model that `check_model` has accepted, without a distortion that does nothing.

    Args:
        model: Name of the model.
        coefficients: Its coefficients.
        is_trainable: Whether to include a distortion whose coefficients are zero, since its derivatives are not.
    """
    if model in ("eucm", "double_sphere"):
        chart = ExtendedChart if model == "eucm" else DoubleSphereChart
        return Lens(chart(coefficients[0], coefficients[1]))
    if model == "theta_polynomial":
        return Lens(AngleChart(), ThetaPolynomial(coefficients))
    if model == "kannala_brandt":
        return Lens(AngleChart(), KannalaBrandt(coefficients) if is_trainable or any(coefficients) else None)
    chart_coefficients = 1 if model == "mei" else 0
    polynomial, angles = coefficients[chart_coefficients : chart_coefficients + 12], coefficients[12:]
    has_distortion = len(polynomial) > 0 and (is_trainable or any(polynomial))
    distortion = BrownConrady(polynomial) if has_distortion else None
    tilt = SensorTilt(angles[0], angles[1]) if angles and (is_trainable or any(angles)) else None
    return Lens(SphereChart(coefficients[0]) if model == "mei" else PlaneChart(), distortion, tilt)


def check_image(name: str, width: int, height: int, intrinsics: Tensor) -> None:
    """Check the size of an image and the intrinsics of a camera.

    Args:
        name: Name of the camera for messages.
        width: Columns of the image.
        height: Rows of the image.
        intrinsics: (4,) fx, fy, cx, cy in pixels.

    Raises:
        ValueError: A value is not finite, or a size or focal length not positive.
    """
    for side, size in (("width", width), ("height", height)):
        if isinstance(size, bool) or not isinstance(size, int) or size <= 0:
            raise ValueError(f"{name}: {side} must be a positive integer; got {size!r}")
    if not torch.isfinite(intrinsics).all():
        raise ValueError(f"{name}: fx, fy, cx, cy must be finite; got {intrinsics.tolist()}")
    if not (intrinsics[:2] > 0).all():
        raise ValueError(f"{name}: fx and fy must be positive; got {intrinsics[:2].tolist()}")
