"""Brown-Conrady distortion with up to twelve coefficients, and the tilted sensor, in OpenCV's order.

The forward model is kornia's `distort_points`. The solver needs the Jacobian with the value, which kornia does not
give, so `linearise` states the formula once more; a test holds the two together.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from torchcover.cameras.lens import Linear, Scalar, as_vector, number, positive_roots
from torchcover.geometry.arrays import Float64


@dataclass(frozen=True)
class PlaneChart:
    """The plane z = 1 of pinhole and Brown-Conrady lenses: a = x / z, b = y / z, for z > 0, before 90 degrees."""

    limit: float = torch.inf

    def draw(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Points in front of the camera, drawn where their ray meets z = 1."""
        front = z > 0
        depth = torch.where(front, z, 1.0)  # a division by 0 behind the camera would put NaN into the gradients
        return x / depth, y / depth, front

    def lift(self, a: Tensor, b: Tensor) -> Tensor:
        """(a, b, 1), normalised."""
        norm = torch.sqrt(a * a + b * b + 1.0)
        return torch.stack((a / norm, b / norm, 1.0 / norm), dim=-1)


@dataclass(frozen=True)
class BrownConrady:
    """u = a g + 2 p1 a b + p2 (s + 2 a^2) + s1 s + s2 s^2, v likewise, with s = a^2 + b^2.

    g = (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3).

    `coefficients`: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]]: 4, 5, 8 or 12 numbers.
    """

    coefficients: Sequence[Scalar]

    @cached_property
    def _padded(self) -> tuple[float, ...]:
        values = [number(value) for value in self.coefficients]
        return (*values, *[0.0] * (12 - len(values)))

    @property
    def symmetric(self) -> bool:
        """Whether tangential and prism coefficients are all zero."""
        return not any((*self._padded[2:4], *self._padded[8:]))

    def distort(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """By kornia, with the identity for its camera matrix."""
        from kornia.geometry.calibration import distort_points

        points = torch.stack((a, b), dim=-1)
        identity = torch.eye(3, dtype=a.dtype, device=a.device)
        distorted = distort_points(points, identity, as_vector(self.coefficients, a))
        return distorted[..., 0], distorted[..., 1]

    def linearise(self, a: Float64, b: Float64) -> Linear:
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
        return self._with_prism(Linear(u, v, u_a, u_b, v_a, v_b), a, b, s)

    def _with_prism(self, bare: Linear, a: Float64, b: Float64, s: Float64) -> Linear:
        s1, s2, s3, s4 = self._padded[8:]
        if not any((s1, s2, s3, s4)):
            return bare
        u_slope, v_slope = 2.0 * s1 + (4.0 * s2) * s, 2.0 * s3 + (4.0 * s4) * s
        return Linear(
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

    def radial(self, radius: Float64) -> Float64:
        """The radius times g."""
        k1, k2, _, _, k3, k4, k5, k6, *_ = self._padded
        s = radius * radius
        return radius * (1.0 + s * (k1 + s * (k2 + s * k3))) / (1.0 + s * (k4 + s * (k5 + s * k6)))

    def critical_radii(self) -> Float64:
        """Where d(r g)/dr is 0, where g is, and the poles."""
        k1, k2, _, _, k3, k4, k5, k6, *_ = self._padded
        above = np.polynomial.Polynomial([1.0, k1, k2, k3])
        below = np.polynomial.Polynomial([1.0, k4, k5, k6])
        s = np.polynomial.Polynomial([0.0, 1.0])
        slope = (above + 2.0 * s * above.deriv()) * below - 2.0 * s * above * below.deriv()
        roots = [positive_roots(polynomial.coef.tolist()) for polynomial in (slope, above, below)]
        return np.sqrt(np.concatenate(roots))


@dataclass(frozen=True)
class SensorTilt:
    """The projective map of a sensor turned by tau_x about x, then tau_y about y, from kornia's `tilt_projection`."""

    tau_x: Scalar
    tau_y: Scalar

    def apply(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Distorted points -> tilted ones and a mask of those in front of the tilted plane."""
        return self._map(u, v, inverse=False)

    def undo(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Tilted points -> distorted ones and a mask of those that come from the front."""
        return self._map(u, v, inverse=True)

    def _map(self, u: Tensor, v: Tensor, inverse: bool) -> tuple[Tensor, Tensor, Tensor]:
        from kornia.geometry.calibration import tilt_projection

        tau_x, tau_y = as_vector([self.tau_x, self.tau_y], u)
        # Of kornia's two maps this one is right in all versions; the other turns the wrong way before 0.9.
        undo = tilt_projection(tau_x, tau_y, True)
        rows = undo if inverse else torch.linalg.inv(undo)
        x, y, w = (row[0] * u + row[1] * v + row[2] for row in rows)
        front = w > 0
        w = torch.where(front, w, 1.0)
        return x / w, y / w, front
