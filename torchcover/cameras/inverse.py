"""The inverse of a lens: damped Newton with the exact Jacobian, from a tabulated start, inside the valid region.

All of it is float64. A pixel gets an answer only if the answer reproduces it and lies in the valid region; every other
pixel gets a reason. Gradients come from the implicit function theorem at the solution, not from the iterations.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchcover.cameras.lens import Distortion
from torchcover.cameras.start import StartTable, nearest_seeds
from torchcover.cameras.valid_region import ValidRegion
from torchcover.geometry.arrays import Bools, Float64

# What became of a pixel.
ANSWERED, OUTSIDE, UNCONVERGED = 0, 1, 2

# Newton goes on while the residual is above the first; a pixel whose residual ends above the second has no answer.
# Between the two lies what rounding leaves when large coefficients cancel.
STOP_PX, ACCEPT_PX = 1e-10, 5e-10
_MAX_STEPS = 80
# Nearly all pixels are done after these; the others are collected and go on together.
_QUICK_STEPS = 6
_MIN_DAMPING = 2.0**-20
# Pixels solved side by side: few enough for the cache, many enough to outweigh the interpreter.
_CHUNK = 1 << 15

Status = NDArray[np.uint8]


class _Search:
    """Newton's method on many points side by side, each with a damping of its own.

    A step that leaves the region or does not reduce the residual is halved and tried again; an accepted one lets the
    next be twice as long. The determinant is positive all over the region, so the residual has no other minimum there.
    """

    def __init__(
        self,
        distortion: Distortion,
        region: ValidRegion,
        focal: tuple[float, float],
        u: Float64,
        v: Float64,
        a: Float64,
        b: Float64,
    ) -> None:
        self.distortion, self.region, self.focal = distortion, region, focal
        self.u, self.v, self.a, self.b = u, v, a, b
        self.step_a, self.step_b, self.error, _ = self._newton(a, b, u, v)
        self.damping = np.ones_like(a)

    def run(self, steps: int) -> None:
        """Iterate until every point has converged or is stuck, or the steps are used up."""
        for _ in range(steps):
            going = np.flatnonzero((self.error > STOP_PX) & (self.damping > _MIN_DAMPING))
            if len(going) == 0:
                return
            self._advance(slice(None) if len(going) == len(self.a) else going)

    def retry(self, lost: NDArray[np.intp], a: Float64, b: Float64) -> None:
        """Start again from other points where the first start led nowhere."""
        second = _Search(self.distortion, self.region, self.focal, self.u[lost], self.v[lost], a, b)
        second.run(_MAX_STEPS)
        better = second.error < self.error[lost]
        self.a[lost[better]], self.b[lost[better]] = second.a[better], second.b[better]
        self.error[lost[better]] = second.error[better]

    def _advance(self, going: "slice | NDArray[np.intp]") -> None:
        damping = self.damping[going]
        a = self.a[going] - damping * self.step_a[going]
        b = self.b[going] - damping * self.step_b[going]
        step_a, step_b, error, inside = self._newton(a, b, self.u[going], self.v[going])
        better = inside & (error < self.error[going])
        longer = np.where(better, np.minimum(2.0 * damping, 1.0), damping / 2.0)
        states = (("a", a), ("b", b), ("step_a", step_a), ("step_b", step_b), ("error", error))
        if len(better) == len(self.a) and better.all():  # the first steps of nearly every lens: nothing to sort out
            self.__dict__.update(states, damping=longer)
            return
        self.damping[going] = longer
        for name, value in states:
            kept = getattr(self, name)
            kept[going] = np.where(better, value, kept[going])

    def _newton(self, a: Float64, b: Float64, u: Float64, v: Float64) -> tuple[Float64, Float64, Float64, Bools]:
        """Full Newton step, residual in pixels, and whether the point lies in the region."""
        at = self.distortion.linearise(a, b)
        du, dv = at.u - u, at.v - v
        determinant = at.determinant
        inverse = 1.0 / determinant
        step_a, step_b = (at.v_b * du - at.u_b * dv) * inverse, (at.u_a * dv - at.v_a * du) * inverse
        du, dv = self.focal[0] * du, self.focal[1] * dv
        return step_a, step_b, np.sqrt(du * du + dv * dv), self.region.contains(a, b, determinant)


def solve(
    distortion: Distortion, region: ValidRegion, table: StartTable, u: Float64, v: Float64, focal: tuple[float, float]
) -> tuple[Float64, Float64, Status]:
    """Find the points of the valid region whose distorted images are (u, v), on as many threads as torch may use.

    `u` and `v` are (N,) float64 normalised image coordinates, `focal` is pixels per unit of both, for the residual is
    measured in pixels; the coefficients of `distortion` are floats.

    Returns `a`, `b` (N,) float64, 0 where there is no answer, and (N,) uint8: `ANSWERED`, `OUTSIDE` (no point of the
    valid region has this image) or `UNCONVERGED`.
    """

    def quick(u: Float64, v: Float64) -> tuple[Float64, ...]:
        distorted = np.sqrt(u * u + v * v)
        reached = np.flatnonzero(region.reach.holds(distorted, u, v))
        if len(reached) < len(u):
            return _scatter(len(u), reached, quick(u[reached], v[reached]) if len(reached) else ())
        search = _Search(distortion, region, focal, u, v, *_first_guess(region, table, u, v, distorted))
        search.run(_QUICK_STEPS)
        return search.a, search.b, search.error

    def thorough(u: Float64, v: Float64, a: Float64, b: Float64) -> tuple[Float64, ...]:
        search = _Search(distortion, region, focal, u, v, a, b)
        search.run(_MAX_STEPS)
        lost = np.flatnonzero(search.error > ACCEPT_PX)
        if len(lost) and not distortion.symmetric:
            search.retry(lost, *nearest_seeds(distortion, region, u[lost], v[lost]))
        return search.a, search.b, search.error

    a, b, error = _in_chunks(quick, u, v)
    lost = np.flatnonzero(error > ACCEPT_PX)
    if len(lost):
        a[lost], b[lost], error[lost] = _in_chunks(thorough, u[lost], v[lost], a[lost], b[lost])
    status = _status(region, a, b, error)
    return np.where(status == ANSWERED, a, 0.0), np.where(status == ANSWERED, b, 0.0), status


def _in_chunks(function: Callable[..., tuple[Float64, ...]], *arrays: Float64) -> tuple[Float64, ...]:
    """Apply a function to pieces of its arguments, side by side, and put the pieces of its results together."""

    def run(start: int) -> tuple[Float64, ...]:
        with np.errstate(all="ignore"):  # steps that fly off are caught by their residual
            return function(*(array[start : start + _CHUNK] for array in arrays))

    starts = range(0, max(len(arrays[0]), 1), _CHUNK)
    if len(starts) == 1:
        return run(0)
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:  # numpy computes without the interpreter's lock
        return tuple(np.concatenate(parts) for parts in zip(*pool.map(run, starts), strict=True))


def _scatter(count: int, reached: NDArray[np.intp], found: tuple[Float64, ...]) -> tuple[Float64, ...]:
    """Points and errors of the reached pixels among all; the others lie nowhere, with an error that is NaN."""
    result = np.zeros(count), np.zeros(count), np.full(count, np.nan)
    for whole, part in zip(result, found, strict=False):
        whole[reached] = part
    return result


def _status(region: ValidRegion, a: Float64, b: Float64, error: Float64) -> Status:
    status = np.full(error.shape, ANSWERED, np.uint8)
    failed = np.flatnonzero(~(error <= ACCEPT_PX))
    # Stuck at the edge of the region: the image lies behind the fold.
    at_edge = ~region.edge.holds(np.hypot(a[failed], b[failed]) / 0.98, a[failed], b[failed])
    status[failed] = np.where(at_edge | np.isnan(error[failed]), OUTSIDE, UNCONVERGED)
    return status


def _first_guess(
    region: ValidRegion, table: StartTable, u: Float64, v: Float64, distorted: Float64
) -> tuple[Float64, Float64]:
    """The answer of the radial part alone, pulled inside the region."""
    radius = table(distorted)
    if not (radius <= 0.999 * region.edge.least).all():
        radius = np.minimum(radius, 0.999 * region.edge(u, v))
    ratio = np.where(distorted > 0.0, radius / distorted, 1.0)
    return u * ratio, v * ratio


class _ImplicitSolution(torch.autograd.Function):
    """The solution p of F(p, parameters) = 0: by the implicit function theorem dp = -(dF/dp)^-1 dF."""

    @staticmethod
    def forward(ctx: Any, point: Tensor, jacobian: Tensor, residual: Tensor) -> Tensor:  # noqa: ANN401
        ctx.save_for_backward(jacobian)
        return point.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, None, Tensor]:  # noqa: ANN401
        (jacobian,) = ctx.saved_tensors
        return None, None, -torch.linalg.solve(jacobian.mT, gradient)


def attach_gradients(
    solver: Distortion, distortion: Distortion, a: Tensor, b: Tensor, u: Tensor, v: Tensor
) -> tuple[Tensor, Tensor]:
    """Make answered points `a`, `b` (N,) a function of the coefficients in `distortion` and of their images (u, v).

    `solver` is the same distortion with coefficients that are floats. Gradients are of first order; second-order ones
    raise.
    """
    at = solver.linearise(a.numpy(force=True), b.numpy(force=True))
    rows = np.stack((at.u_a, at.u_b, at.v_a, at.v_b), axis=-1).reshape(-1, 2, 2)
    jacobian = torch.from_numpy(rows).to(a.device)
    image_u, image_v = distortion.distort(a, b)
    residual = torch.stack((image_u - u, image_v - v), dim=-1)
    point: Tensor = _ImplicitSolution.apply(torch.stack((a, b), dim=-1), jacobian, residual)  # type: ignore[no-untyped-call]
    return point[..., 0], point[..., 1]
