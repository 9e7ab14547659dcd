"""What a lens model is made of: a chart of the directions, and a distortion of that chart.

A direction (x, y, z) is drawn on a plane by a *chart* (`a`, `b`); the *distortion* moves the drawn point to the
normalised image (`u`, `v`); focal lengths and principal point make pixels of it. Every model is such a pair, so the
inverse of the lens is one problem, solved once (`inverse.py`), and the chart goes back in closed form.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

import torchcover.geometry.first_calls  # noqa: F401
from torchcover.geometry.arrays import Float64

if TYPE_CHECKING:
    from torchcover.cameras.brown_conrady import SensorTilt

# A coefficient is a float where a lens is only evaluated, and a 0-d tensor where gradients flow into it.
Scalar = float | Tensor


class Chart(Protocol):
    """How directions are drawn on a plane, and read back from it."""

    @property
    def limit(self) -> float:
        """Radius on the plane at which the drawing ends; infinity where it does not."""

    def draw(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Points (N,) each -> `a`, `b` (N,) and a mask (N,) of those that the chart can show."""

    def lift(self, a: Tensor, b: Tensor) -> Tensor:
        """Drawn points (N,) each -> unit directions (N, 3)."""


class Linear(NamedTuple):
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
    def symmetric(self) -> bool:
        """Whether it only moves points along their radius, the same in all directions."""

    def distort(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """The map, differentiable in the points and in the coefficients."""

    def linearise(self, a: Float64, b: Float64) -> Linear:
        """The map with its exact Jacobian; for coefficients that are floats."""

    def radial(self, radius: Float64) -> Float64:
        """Distorted radius of the radial part; for coefficients that are floats."""

    def critical_radii(self) -> Float64:
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


def as_vector(values: Sequence[Scalar], like: Tensor | None = None) -> Tensor:
    """Numbers, or tensors with their gradients, as a vector, float64 or beside another tensor."""
    empty = torch.empty(0, dtype=torch.float64, device="cpu") if like is None else like.new_empty(0)
    parts = [torch.as_tensor(value, dtype=empty.dtype, device=empty.device) for value in values]
    return torch.stack(parts) if parts else empty


def number(value: Scalar) -> float:
    """A coefficient's value, whether or not gradients flow into it."""
    return float(value.detach()) if isinstance(value, Tensor) else float(value)


def positive_roots(coefficients: Sequence[float]) -> Float64:
    """Positive real roots of a polynomial whose coefficients start with the constant term.

    Nearly real pairs are kept: a double root comes out of the eigenvalue solver as a pair with a tiny imaginary part,
    and a radius that turns out to be harmless costs nothing. Leading coefficients below 1e-60 only make roots farther
    out than any ray, and overflows.
    """
    significant = np.array([value if abs(value) > 1e-60 else 0.0 for value in coefficients] + [0.0])
    roots = np.polynomial.Polynomial(np.trim_zeros(significant, "b")).roots()
    near_real = np.abs(roots.imag) < 1e-6 * (1.0 + np.abs(roots.real))
    return np.asarray(roots.real[near_real & (roots.real > 0)], dtype=np.float64)
