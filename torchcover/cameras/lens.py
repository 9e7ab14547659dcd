"""What a lens model is made of: a chart of the directions, and a distortion of that chart: Brown-Conrady and fisheyes.

A direction (x, y, z) is drawn on a plane by a *chart* (`a`, `b`); the *distortion* moves the drawn point to the
normalised image (`u`, `v`); focal lengths and principal point make pixels of it. Every model is such a pair, so the
inverse of the lens is one problem, solved once (`inverse.py`), and the chart goes back in closed form.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import pi
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

import torchcover.geometry.tensors  # noqa: F401
from torchcover.geometry.arrays import Float64

# A coefficient is a float where a lens is only evaluated, and a 0-d tensor where gradients flow into it.
Scalar = float | Tensor


class Chart(Protocol):
    """How directions are drawn on a plane, and read back from it."""

    @property
    def limit(self) -> float:
        """Radius on the plane at which the drawing ends; infinity where it does not."""

    def project(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Points (N,) each -> `a`, `b` (N,) and a mask (N,) of those that the chart can show."""

    def unproject(self, a: Tensor, b: Tensor) -> Tensor:
        """Drawn points (N,) each -> unit directions (N, 3)."""


class Linearization(NamedTuple):
    """A distortion at a point: the value (`u`, `v`) and the four partial derivatives."""

    u: Float64
    v: Float64
    u_a: Float64
    u_b: Float64
    v_a: Float64
    v_b: Float64

    @property
    def determinant(self) -> Float64:
        """Area that the distortion makes of a unit of area; it changes sign at a fold."""
        return self.u_a * self.v_b - self.u_b * self.v_a


class Distortion(Protocol):
    """A smooth map of the plane that keeps the origin in place.

    `distort` is torch's, for users and gradients. The rest is the solver's, in numpy: on chunks that fit into the
    cache its plain loops beat torch's, which wait for each other at the end of every operation.
    """

    @property
    def is_radial(self) -> bool:
        """Whether it only moves points along their radius, the same in all directions."""

    def distort(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """The map, differentiable in the points and in the coefficients."""

    def linearize(self, a: Float64, b: Float64) -> Linearization:
        """The map with its exact Jacobian; for coefficients that are floats."""

    def distort_radius(self, radius: Float64) -> Float64:
        """Distorted radius of the radial part; for coefficients that are floats."""

    def find_critical_radii(self) -> Float64:
        """Every radius at which the radial part may stop being monotonic, in any order."""


@dataclass(frozen=True)
class Lens:
    """A lens model with its coefficients.

    `chart`: directions <-> plane; `distortion`: plane -> normalised image; None where they are the same, and then no
    solver ever runs; `tilt`: tilt of the sensor; None where there is none.
    """

    chart: Chart
    distortion: Distortion | None = None
    tilt: "SensorTilt | None" = None


def to_vector(values: Sequence[Scalar], like: Tensor | None = None) -> Tensor:
    """Numbers, or tensors with their gradients, as a vector, float64 or beside another tensor."""
    empty = torch.empty(0, dtype=torch.float64, device="cpu") if like is None else like.new_empty(0)
    parts = [torch.as_tensor(value, dtype=empty.dtype, device=empty.device) for value in values]
    return torch.stack(parts) if parts else empty


def to_float(value: Scalar) -> float:
    """A coefficient's value, whether or not gradients flow into it."""
    return float(value.detach()) if isinstance(value, Tensor) else float(value)


def find_positive_roots(coefficients: Sequence[float]) -> Float64:
    """Positive real roots of a polynomial whose coefficients start with the constant term.

    Nearly real pairs are kept: a double root comes out of the eigenvalue solver as a pair with a tiny imaginary part,
    and a radius that turns out to be harmless costs nothing. Leading coefficients below 1e-60 only make roots farther
    out than any ray, and overflows.
    """
    significant = np.array([value if abs(value) > 1e-60 else 0.0 for value in coefficients] + [0.0])
    roots = np.polynomial.Polynomial(np.trim_zeros(significant, "b")).roots()
    near_real = np.abs(roots.imag) < 1e-6 * (1.0 + np.abs(roots.real))
    return np.asarray(roots.real[near_real & (roots.real > 0)], dtype=np.float64)


@dataclass(frozen=True)
class PlaneChart:
    """The plane z = 1 of pinhole and Brown-Conrady lenses: a = x / z, b = y / z, for z > 0, before 90 degrees."""

    limit: float = torch.inf

    def project(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Points in front of the camera, drawn where their ray meets z = 1."""
        front = z > 0
        depth = torch.where(front, z, 1.0)  # a division by 0 behind the camera would put NaN into the gradients
        return x / depth, y / depth, front

    def unproject(self, a: Tensor, b: Tensor) -> Tensor:
        """(a, b, 1), normalised."""
        norm = torch.sqrt(a * a + b * b + 1.0)
        return torch.stack((a / norm, b / norm, 1.0 / norm), dim=-1)


@dataclass(frozen=True)
class BrownConrady:
    """Brown-Conrady distortion with up to twelve coefficients in OpenCV's order.

    u = a g + 2 p1 a b + p2 (s + 2 a^2) + s1 s + s2 s^2, v likewise, with s = a^2 + b^2.

    g = (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3).

    The forward model is kornia's `distort_points`. The solver needs the Jacobian with the value, which kornia does not
    give, so `linearize` states the formula once more; a test holds the two together.

    `coefficients`: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]]: 4, 5, 8 or 12 numbers.
    """

    coefficients: Sequence[Scalar]

    @cached_property
    def _padded(self) -> tuple[float, ...]:
        values = [to_float(value) for value in self.coefficients]
        return (*values, *[0.0] * (12 - len(values)))

    @property
    def is_radial(self) -> bool:
        """Whether tangential and prism coefficients are all zero."""
        return not any((*self._padded[2:4], *self._padded[8:]))

    def distort(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """By kornia, with the identity for its camera matrix."""
        from kornia.geometry.calibration import distort_points

        points = torch.stack((a, b), dim=-1)
        identity = torch.eye(3, dtype=a.dtype, device=a.device)
        distorted = distort_points(points, identity, to_vector(self.coefficients, a))
        return distorted[..., 0], distorted[..., 1]

    def linearize(self, a: Float64, b: Float64) -> Linearization:
        """Value and Jacobian; the terms of coefficients that are zero are left out."""
        _, _, p1, p2, *_ = self._padded
        s = a * a + b * b
        gain, slope = self._gain(s)
        slope = 2.0 * slope
        along = slope * a  # dg/da, and dg/db = slope * b
        twist = along * b
        u, v = a * gain, b * gain
        u_a, u_b = gain + along * a, twist
        v_a, v_b = twist, gain + slope * b * b
        if p1 or p2:
            shift, cross = (2.0 * p1) * b + (2.0 * p2) * a, (2.0 * p1) * a + (2.0 * p2) * b
            u, v = u + a * shift + p2 * s, v + b * shift + p1 * s
            u_a, u_b = u_a + shift + (4.0 * p2) * a, u_b + cross
            v_a, v_b = v_a + cross, v_b + shift + (4.0 * p1) * b
        return self._with_prism(Linearization(u, v, u_a, u_b, v_a, v_b), a, b, s)

    def _with_prism(self, bare: Linearization, a: Float64, b: Float64, s: Float64) -> Linearization:
        s1, s2, s3, s4 = self._padded[8:]
        if not any((s1, s2, s3, s4)):
            return bare
        u_slope, v_slope = 2.0 * s1 + (4.0 * s2) * s, 2.0 * s3 + (4.0 * s4) * s
        return Linearization(
            bare.u + s * (s1 + s2 * s),
            bare.v + s * (s3 + s4 * s),
            bare.u_a + a * u_slope,
            bare.u_b + b * u_slope,
            bare.v_a + a * v_slope,
            bare.v_b + b * v_slope,
        )

    def _gain(self, s: Float64) -> tuple[Float64, Float64]:
        """g(s) and dg/ds."""
        k1, k2, _, _, k3, k4, k5, k6, *_ = self._padded
        gain = 1.0 + s * (k1 + s * (k2 + s * k3))
        slope = k1 + s * (2.0 * k2 + s * (3.0 * k3))
        if not any((k4, k5, k6)):
            return gain, slope
        below = 1.0 + s * (k4 + s * (k5 + s * k6))
        gain = gain / below
        return gain, (slope - gain * (k4 + s * (2.0 * k5 + s * (3.0 * k6)))) / below

    def distort_radius(self, radius: Float64) -> Float64:
        """The radius times g."""
        k1, k2, _, _, k3, k4, k5, k6, *_ = self._padded
        s = radius * radius
        return radius * (1.0 + s * (k1 + s * (k2 + s * k3))) / (1.0 + s * (k4 + s * (k5 + s * k6)))

    def find_critical_radii(self) -> Float64:
        """Where d(r g)/dr is 0, where g is, and the poles."""
        k1, k2, _, _, k3, k4, k5, k6, *_ = self._padded
        above = np.polynomial.Polynomial([1.0, k1, k2, k3])
        below = np.polynomial.Polynomial([1.0, k4, k5, k6])
        s = np.polynomial.Polynomial([0.0, 1.0])
        slope = (above + 2.0 * s * above.deriv()) * below - 2.0 * s * above * below.deriv()
        roots = [find_positive_roots(polynomial.coef.tolist()) for polynomial in (slope, above, below)]
        return np.sqrt(np.concatenate(roots))


@dataclass(frozen=True)
class SensorTilt:
    """The projective map of a sensor turned by tau_x about x, then tau_y about y, from kornia's `tilt_projection`."""

    tau_x: Scalar
    tau_y: Scalar

    def apply(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Distorted points -> tilted ones and a mask of those in front of the tilted plane."""
        return self._map(u, v, inverse=False)

    def remove(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Tilted points -> distorted ones and a mask of those that come from the front."""
        return self._map(u, v, inverse=True)

    def _map(self, u: Tensor, v: Tensor, inverse: bool) -> tuple[Tensor, Tensor, Tensor]:
        from kornia.geometry.calibration import tilt_projection

        tau_x, tau_y = to_vector([self.tau_x, self.tau_y], u)
        # Of kornia's two maps this one is right in all versions; the other turns the wrong way before 0.9.
        undo = tilt_projection(tau_x, tau_y, True)
        rows = undo if inverse else torch.linalg.inv(undo)
        x, y, w = (row[0] * u + row[1] * v + row[2] for row in rows)
        front = w > 0
        w = torch.where(front, w, 1.0)
        return x / w, y / w, front


# Below this squared angle sine and cosine are taken from their series: exact in float64, and smooth at the axis.
_SERIES = 1e-8
# Odd powers of the angle have a kink at the axis; this floor, far below any pixel, keeps their derivatives finite.
_KINK = 1e-40


@dataclass(frozen=True)
class AngleChart:
    """(a, b) = angle from the axis times the unit vector towards (x, y): equidistant, up to 180 degrees off axis.

    Nothing here passes through z = 1, so 180 degrees are nothing special. kornia's `distort_points_kannala_brandt`
    starts from z = 1 and cannot show 90 degrees off the axis; below a radius of 1e-4 it drops the polynomial, which is
    7e-9 px off at a focal length of 20,000 px. Where both are defined a test holds the two together.
    """

    limit: float = pi

    def project(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Every direction but the one straight back, whose azimuth is unknown."""
        squared = x * x + y * y
        off_axis = squared > 0
        radius = torch.sqrt(torch.where(off_axis, squared, 1.0))
        # On the axis angle / radius tends to 1 / z.
        stretch = torch.where(off_axis, torch.atan2(radius, z) / radius, 1.0 / torch.where(z > 0, z, 1.0))
        return x * stretch, y * stretch, off_axis | (z > 0)

    def unproject(self, a: Tensor, b: Tensor) -> Tensor:
        """(a sin(t)/t, b sin(t)/t, cos t) with t = |(a, b)|."""
        squared = a * a + b * b
        small = squared < _SERIES
        angle = torch.sqrt(torch.where(small, 1.0, squared))
        ratio = torch.where(small, 1.0 - squared / 6.0, torch.sin(angle) / angle)
        forward = torch.where(small, 1.0 - squared / 2.0, torch.cos(angle))
        return torch.stack((a * ratio, b * ratio, forward), dim=-1)


def _stretched(a: Float64, b: Float64, gain: Float64, slope: Float64) -> Linearization:
    """A radial map (a, b) * gain whose gain has the gradient slope * (a, b)."""
    twist = slope * a * b
    return Linearization(a * gain, b * gain, gain + slope * a * a, twist, twist, gain + slope * b * b)


@dataclass(frozen=True)
class KannalaBrandt:
    """t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8): OpenCV's fisheye, Kalibr's equidistant."""

    coefficients: Sequence[Scalar]
    is_radial: bool = True

    def distort(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """The map, along the radius."""
        k1, k2, k3, k4 = self.coefficients
        s = a * a + b * b
        gain = 1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4)))
        return a * gain, b * gain

    def linearize(self, a: Float64, b: Float64) -> Linearization:
        """Value and Jacobian."""
        k1, k2, k3, k4 = (to_float(k) for k in self.coefficients)
        s = a * a + b * b
        gain = 1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4)))
        slope = 2.0 * (k1 + s * (2.0 * k2 + s * (3.0 * k3 + s * (4.0 * k4))))
        return _stretched(a, b, gain, slope)

    def distort_radius(self, radius: Float64) -> Float64:
        """Distorted angle."""
        k1, k2, k3, k4 = (to_float(k) for k in self.coefficients)
        s = radius * radius
        return radius * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))))

    def find_critical_radii(self) -> Float64:
        """Where the derivative of the distorted angle is 0."""
        k1, k2, k3, k4 = (to_float(k) for k in self.coefficients)
        return np.sqrt(find_positive_roots([1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3, 9.0 * k4]))


@dataclass(frozen=True)
class ThetaPolynomial:
    """k1 t + k2 t^2 + k3 t^3 + k4 t^4: WoodScape's surround-view fisheyes (there in pixels, with fx = fy = 1)."""

    coefficients: Sequence[Scalar]
    is_radial: bool = True

    def distort(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """The map, along the radius."""
        k1, k2, k3, k4 = self.coefficients
        angle = torch.sqrt((a * a + b * b).clamp(min=_KINK))
        gain = k1 + angle * (k2 + angle * (k3 + angle * k4))
        return a * gain, b * gain

    def linearize(self, a: Float64, b: Float64) -> Linearization:
        """Value and Jacobian."""
        k1, k2, k3, k4 = (to_float(k) for k in self.coefficients)
        angle = np.sqrt(np.maximum(a * a + b * b, _KINK))
        gain = k1 + angle * (k2 + angle * (k3 + angle * k4))
        return _stretched(a, b, gain, (k2 + angle * (2.0 * k3 + angle * (3.0 * k4))) / angle)

    def distort_radius(self, radius: Float64) -> Float64:
        """Distorted angle."""
        k1, k2, k3, k4 = (to_float(k) for k in self.coefficients)
        return radius * (k1 + radius * (k2 + radius * (k3 + radius * k4)))

    def find_critical_radii(self) -> Float64:
        """Where the derivative of the distorted angle is 0."""
        k1, k2, k3, k4 = (to_float(k) for k in self.coefficients)
        return find_positive_roots([k1, 2.0 * k2, 3.0 * k3, 4.0 * k4])
