"""Lens models: charts of directions and distortions of these charts; unified and fisheye lenses are in `models`.

A *chart* maps a direction (x, y, z) to a plane (`a`, `b`); the *distortion* moves that point to the normalized image
(`u`, `v`); focal lengths and principal point convert it to pixels. Every model is such a pair, so that the inverse of a
lens is one problem, solved once (`inverse.py`), and the chart has an inverse in closed form.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

import torchcover.geometry.tensors  # noqa: F401
from torchcover.geometry.arrays import Float64

# Coefficients are floats if a lens is only evaluated, and 0-d tensors if gradients flow into them.
Scalar = float | Tensor


class Chart(Protocol):
    """Map between directions and a plane."""

    @property
    def limit(self) -> float:
        """Radius on the plane at which the chart ends, or infinity."""

    def project(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Map directions of any length to the plane.

        Args:
            x: (N,) components to the right.
            y: (N,) components downwards.
            z: (N,) components forward.

        Returns:
            `a` and `b` (N,), and a mask (N,) of the directions that the chart can show.
        """

    def unproject(self, a: Tensor, b: Tensor) -> Tensor:
        """Map points of the plane to (N, 3) unit directions.

        Args:
            a: (N,) first coordinates.
            b: (N,) second coordinates.
        """


class Linearization(NamedTuple):
    """Distortion at N points.

    Args:
        u: (N,) first coordinate of the image.
        v: (N,) second coordinate.
        u_a: (N,) partial derivative of `u` by `a`, and likewise the others.
        u_b: (N,) of `u` by `b`.
        v_a: (N,) of `v` by `a`.
        v_b: (N,) of `v` by `b`.
    """

    u: Float64
    v: Float64
    u_a: Float64
    u_b: Float64
    v_a: Float64
    v_b: Float64

    @property
    def determinant(self) -> Float64:
        """Determinant of the Jacobian: area per unit of area, which changes its sign at a fold."""
        return self.u_a * self.v_b - self.u_b * self.v_a


class Distortion(Protocol):
    """Smooth map of the plane that keeps the origin in place.

    `distort` uses torch, for users and gradients. The other methods serve the solver and use numpy: on chunks that fit
    into the cache its loops are faster than those of torch, whose threads synchronize after every operation.
    """

    @property
    def is_radial(self) -> bool:
        """Whether points only move along their radius, equally in all directions."""

    def distort(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """Distort points, differentiably in the points and in the coefficients.

        Args:
            a: (N,) first coordinates on the chart.
            b: (N,) second coordinates.

        Returns:
            `u` and `v`, (N,) coordinates of the normalized image.
        """

    def linearize(self, a: Float64, b: Float64) -> Linearization:
        """Compute the map with its exact Jacobian; coefficients are floats.

        Args:
            a: (N,) first coordinates on the chart.
            b: (N,) second coordinates.
        """

    def distort_radius(self, radius: Float64) -> Float64:
        """Compute the distorted radius of the radial part; coefficients are floats.

        Args:
            radius: (N,) radii on the chart.
        """

    def find_critical_radii(self) -> Float64:
        """Find every radius at which the radial part may stop being monotonic, in any order."""


@dataclass(frozen=True)
class Lens:
    """Lens model with its coefficients.

    Args:
        chart: Map between directions and plane.
        distortion: Map from the plane to the normalized image; None for the identity, which needs no solver.
        tilt: Tilt of the sensor; None without one.
    """

    chart: Chart
    distortion: Distortion | None = None
    tilt: "SensorTilt | None" = None


def to_vector(values: Sequence[Scalar], like: Tensor | None = None) -> Tensor:
    """Stack numbers, or 0-d tensors with their gradients, to a vector.

    Args:
        values: The numbers.
        like: Tensor whose type and device the vector gets; float64 on the CPU if not given.
    """
    empty = torch.empty(0, dtype=torch.float64, device="cpu") if like is None else like.new_empty(0)
    parts = [torch.as_tensor(value, dtype=empty.dtype, device=empty.device) for value in values]
    return torch.stack(parts) if parts else empty


def to_float(value: Scalar) -> float:
    """Convert a coefficient to a float.

    Args:
        value: A number, or a 0-d tensor with or without gradients.
    """
    return float(value.detach()) if isinstance(value, Tensor) else float(value)


def find_positive_roots(coefficients: Sequence[float]) -> Float64:
    """Find the positive real roots of a polynomial.

    Nearly real pairs are included: the eigenvalue solver returns a double root as a pair with a tiny imaginary part,
    and a superfluous radius does no harm. Leading coefficients below 1e-60 only cause roots farther out than any ray,
    and overflows.

    Args:
        coefficients: Coefficients, the constant term first.
    """
    significant = np.append(coefficients, 0.0)
    significant[~(np.abs(significant) > 1e-60)] = 0.0
    roots = np.polynomial.Polynomial(np.trim_zeros(significant, "b")).roots()
    near_real = np.abs(roots.imag) < 1e-6 * (1.0 + np.abs(roots.real))
    return np.asarray(roots.real[near_real & (roots.real > 0)], dtype=np.float64)


@dataclass(frozen=True)
class PlaneChart:
    """Plane z = 1 of pinhole and Brown-Conrady lenses: a = x / z, b = y / z, for z > 0, up to 90 degrees."""

    limit: float = torch.inf

    def project(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Map directions in front of the camera to the intersection of their ray with z = 1; see `Chart`."""
        is_in_front = z > 0
        depth = torch.where(is_in_front, z, 1.0)  # a division by 0 behind the camera would put NaN into the gradients
        return x / depth, y / depth, is_in_front

    def unproject(self, a: Tensor, b: Tensor) -> Tensor:
        """Normalize (a, b, 1); see `Chart`."""
        norm = torch.sqrt(a * a + b * b + 1.0)
        return torch.stack((a / norm, b / norm, 1.0 / norm), dim=-1)


@dataclass(frozen=True)
class BrownConrady:
    """Brown-Conrady distortion with up to twelve coefficients in the order of OpenCV.

    u = a g + 2 p1 a b + p2 (s + 2 a^2) + s1 s + s2 s^2, v likewise, with s = a^2 + b^2.

    g = (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3).

    The forward model is `distort_points` of kornia. The solver needs the Jacobian with the value, which kornia does not
    provide, so `linearize` repeats the formula; a test compares both.

    Args:
        coefficients: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]]: 4, 5, 8 or 12 numbers.
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
        """Distort points with kornia and the identity as camera matrix; see `Distortion`."""
        from kornia.geometry.calibration import distort_points

        points = torch.stack((a, b), dim=-1)
        identity = torch.eye(3, dtype=a.dtype, device=a.device)
        distorted = distort_points(points, identity, to_vector(self.coefficients, a))
        return distorted[..., 0], distorted[..., 1]

    def linearize(self, a: Float64, b: Float64) -> Linearization:
        """Compute value and Jacobian without the terms of coefficients that are zero; see `Distortion`."""
        _, _, p1, p2, *_ = self._padded
        s = a * a + b * b
        gain, slope = self._compute_gain(s)
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
        return self._add_prism(Linearization(u, v, u_a, u_b, v_a, v_b), a, b, s)

    def _add_prism(self, bare: Linearization, a: Float64, b: Float64, s: Float64) -> Linearization:
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

    def _compute_gain(self, s: Float64) -> tuple[Float64, Float64]:
        """Compute g(s) and dg/ds."""
        k1, k2, _, _, k3, k4, k5, k6, *_ = self._padded
        gain = 1.0 + s * (k1 + s * (k2 + s * k3))
        slope = k1 + s * (2.0 * k2 + s * (3.0 * k3))
        if not any((k4, k5, k6)):
            return gain, slope
        below = 1.0 + s * (k4 + s * (k5 + s * k6))
        gain = gain / below
        return gain, (slope - gain * (k4 + s * (2.0 * k5 + s * (3.0 * k6)))) / below

    def distort_radius(self, radius: Float64) -> Float64:
        """Compute the distorted radii r g(r) of (N,) radii r = tan(incidence angle); tangential terms are left out."""
        k1, k2, _, _, k3, k4, k5, k6, *_ = self._padded
        s = radius * radius
        return radius * (1.0 + s * (k1 + s * (k2 + s * k3))) / (1.0 + s * (k4 + s * (k5 + s * k6)))

    def find_critical_radii(self) -> Float64:
        """Find the zeros of d(r g)/dr and of g, and the poles."""
        k1, k2, _, _, k3, k4, k5, k6, *_ = self._padded
        above = np.polynomial.Polynomial([1.0, k1, k2, k3])
        below = np.polynomial.Polynomial([1.0, k4, k5, k6])
        s = np.polynomial.Polynomial([0.0, 1.0])
        slope = (above + 2.0 * s * above.deriv()) * below - 2.0 * s * above * below.deriv()
        roots = [find_positive_roots(polynomial.coef.tolist()) for polynomial in (slope, above, below)]
        return np.sqrt(np.concatenate(roots))


@dataclass(frozen=True)
class SensorTilt:
    """Projective map of a tilted sensor, from `tilt_projection` of kornia.

    Args:
        tau_x: Rotation about x in radians, applied first.
        tau_y: Rotation about y in radians.
    """

    tau_x: Scalar
    tau_y: Scalar

    def apply(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Map distorted points to the tilted sensor.

        Args:
            u: (N,) first coordinates of the normalized image.
            v: (N,) second coordinates.

        Returns:
            (N,) and (N,) coordinates, and a mask (N,) of the points in front of the tilted plane.
        """
        return self._map(u, v, inverse=False)

    def remove(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Map points of the tilted sensor back, the inverse of `apply`.

        Args:
            u: (N,) first coordinates on the tilted sensor.
            v: (N,) second coordinates.

        Returns:
            (N,) and (N,) coordinates, and a mask (N,) of the points that come from the front.
        """
        return self._map(u, v, inverse=True)

    def _map(self, u: Tensor, v: Tensor, inverse: bool) -> tuple[Tensor, Tensor, Tensor]:
        from kornia.geometry.calibration import tilt_projection

        tau_x, tau_y = to_vector([self.tau_x, self.tau_y], u)
        # This map of kornia is right in all versions; its inverse rotates the wrong way before 0.9.
        inverse_tilt = tilt_projection(tau_x, tau_y, True)
        rows = inverse_tilt if inverse else torch.linalg.inv(inverse_tilt)
        x, y, w = (row[0] * u + row[1] * v + row[2] for row in rows)
        is_in_front = w > 0
        w = torch.where(is_in_front, w, 1.0)
        return x / w, y / w, is_in_front
