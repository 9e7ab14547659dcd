"""Inverse of a lens: damped Newton steps with the exact Jacobian, from a tabulated start, inside the valid region.

Everything is float64. A pixel gets a direction only if that direction reproduces the pixel and lies in the valid
region; every other pixel gets a reason. Gradients come from the implicit function theorem at the solution, not from the
iterations.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchcover.cameras.lens import Distortion
from torchcover.cameras.valid_region import HORIZON, ValidRegion
from torchcover.geometry.arrays import Bools, Float64

SolverStatus = NDArray[np.uint8]

# Values of the status of a pixel: solved,
ANSWERED = 0
# outside the image of the valid region,
OUTSIDE = 1
# or without convergence.
UNCONVERGED = 2

# Pixels that are solved together: few enough for the cache, many enough to outweigh the interpreter.
_PIXELS_PER_CHUNK = 1 << 15


@dataclass(frozen=True)
class InversionParams:
    """Parameters of Newton's method.

    Args:
        stop_px: Iterations go on while the residual is above this.
        accept_px: A pixel whose final residual is above this has no solution; below, rounding of large coefficients
            that cancel may be left.
        quick_steps: Nearly all pixels are solved after this many iterations; the others are collected and go on
            together.
        max_steps: Largest number of iterations.
        min_damping: Smallest share of a Newton step.
    """

    stop_px: float = 1e-10
    accept_px: float = 5e-10
    quick_steps: int = 6
    max_steps: int = 80
    min_damping: float = 2.0**-20


@dataclass(frozen=True)
class StartTable:
    """Table of the undistorted radius over the distorted radius.

    Args:
        radius_step: Distorted radius from one entry to the next.
        radii: (K,) undistorted radii.
    """

    radius_step: float
    radii: Float64

    def __call__(self, distorted: Float64) -> Float64:
        """Interpolate the undistorted radius linearly, with a constant beyond the end."""
        position = np.minimum(distorted / self.radius_step, len(self.radii) - 1.001)
        low = position.astype(np.int64)
        left = self.radii[low]
        return left + (position - low) * (self.radii[low + 1] - left)


def build_start_table(
    distortion: Distortion, limit: float, max_distorted_radius: float, *, num_entries: int = 4096
) -> StartTable:
    """Tabulate the inverse of the radial part up to its fold, or up to the farthest pixel.

    Args:
        distortion: The distortion, with coefficients that are floats.
        limit: Radius at which the chart ends, or infinity.
        max_distorted_radius: Distorted radius of the farthest pixel.
        num_entries: Entries of the table.
    """
    fold = _find_radial_fold(distortion, limit)
    max_radius = _find_radius_beyond(distortion, max_distorted_radius) if np.isinf(fold) else fold
    even = np.linspace(0.0, 1.0, num_entries)
    # Towards a fold the inverse has the slope of a square root; without one the radii are even in angle.
    radii = np.tan(even * np.arctan(max_radius)) if np.isinf(fold) else max_radius * (1.0 - (1.0 - even) ** 2)
    with np.errstate(all="ignore"):  # a pole at the very end
        distorted = np.maximum.accumulate(np.nan_to_num(distortion.distort_radius(radii)))
    end = max(min(max_distorted_radius, float(distorted[-1])), 1e-30)
    table = np.interp(np.linspace(0.0, end, num_entries), distorted, radii)
    return StartTable(end / (num_entries - 1), table)


def _find_radial_fold(distortion: Distortion, limit: float) -> float:
    """Find the first critical radius after which the radial part does not grow, or comes back from a pole."""
    critical = np.sort(distortion.find_critical_radii())
    after = np.append((critical[:-1] + critical[1:]) / 2.0, critical[-1:] * 1.01)
    value = distortion.distort_radius(after)
    folds = critical[(value < 0.0) | (distortion.distort_radius(after * (1.0 + 1e-6)) <= value)]
    return min(float(folds[0]) if len(folds) else np.inf, limit)


def _find_radius_beyond(distortion: Distortion, distorted: float) -> float:
    """Find a radius whose image is at least this far out, or the horizon."""
    radius = 1.0
    while radius < HORIZON and not distortion.distort_radius(np.array([radius]))[0] >= distorted:
        radius *= 2.0
    return radius


def find_nearest_seeds(distortion: Distortion, region: ValidRegion, u: Float64, v: Float64) -> tuple[Float64, Float64]:
    """Find second starts: of points spread over the valid region, those whose images are nearest.

    Strong tangential terms make the region so irregular that Newton's method can end in a bay of its edge if it starts
    at the solution of the radial part.

    Args:
        distortion: The distortion, with coefficients that are floats.
        region: Its valid region.
        u: (N,) first normalized image coordinates.
        v: (N,) second ones.

    Returns:
        (N,) and (N,) coordinates on the chart.
    """
    azimuth = np.linspace(-np.pi, np.pi, 96, endpoint=False)
    cosine, sine = np.cos(azimuth)[:, None], np.sin(azimuth)[:, None]
    # Radius 500 is a tenth of a degree short of the horizon of the plane z = 1.
    edge = np.minimum(0.999 * region.edge_radius(cosine, sine), 500.0)
    radius = np.tan(np.linspace(0.02, 1.0, 48) * np.arctan(edge))
    seed_a, seed_b = (radius * cosine).ravel(), (radius * sine).ravel()
    image = distortion.linearize(seed_a, seed_b)
    half_square = (image.u**2 + image.v**2) / 2.0
    nearest = np.empty(len(u), dtype=np.int64)
    for start in range(0, len(u), 1024):  # half the squared distance, without the term that is the same for all seeds
        part = slice(start, start + 1024)
        nearest[part] = np.argmin(half_square - u[part, None] * image.u - v[part, None] * image.v, axis=1)
    return seed_a[nearest], seed_b[nearest]


class _NewtonSearch:
    """Newton's method on many points side by side, each with its own damping.

    A step that leaves the region or does not reduce the residual is halved and tried again; after an accepted one the
    next may be twice as long. The determinant is positive in the whole region, so the residual has no other minimum.
    """

    def __init__(
        self,
        distortion: Distortion,
        region: ValidRegion,
        focal: tuple[float, float],
        params: InversionParams,
        u: Float64,
        v: Float64,
        a: Float64,
        b: Float64,
    ) -> None:
        self.distortion, self.region, self.focal, self.params = distortion, region, focal, params
        self.u, self.v, self.a, self.b = u, v, a, b
        self.step_a, self.step_b, self.error, _ = self._compute_step(a, b, u, v)
        self.damping = np.ones_like(a)

    def run(self, num_steps: int) -> None:
        """Iterate until every point has converged or is stuck, or the steps are used up."""
        for _ in range(num_steps):
            active = np.flatnonzero((self.error > self.params.stop_px) & (self.damping > self.params.min_damping))
            if len(active) == 0:
                return
            self._advance(slice(None) if len(active) == len(self.a) else active)

    def retry(self, failed: NDArray[np.intp], a: Float64, b: Float64) -> None:
        """Start again from other points where the first start failed."""
        u, v = self.u[failed], self.v[failed]
        second = _NewtonSearch(self.distortion, self.region, self.focal, self.params, u, v, a, b)
        second.run(self.params.max_steps)
        is_better = second.error < self.error[failed]
        improved = failed[is_better]
        self.a[improved], self.b[improved] = second.a[is_better], second.b[is_better]
        self.error[improved] = second.error[is_better]

    def _advance(self, active: "slice | NDArray[np.intp]") -> None:
        damping = self.damping[active]
        a = self.a[active] - damping * self.step_a[active]
        b = self.b[active] - damping * self.step_b[active]
        step_a, step_b, error, is_inside = self._compute_step(a, b, self.u[active], self.v[active])
        is_better = is_inside & (error < self.error[active])
        next_damping = np.where(is_better, np.minimum(2.0 * damping, 1.0), damping / 2.0)
        states = {"a": a, "b": b, "step_a": step_a, "step_b": step_b, "error": error}
        if len(is_better) == len(self.a) and is_better.all():  # the first steps of nearly every lens
            self.__dict__.update(states, damping=next_damping)
            return
        self.damping[active] = next_damping
        for name, value in states.items():
            state = getattr(self, name)
            state[active] = np.where(is_better, value, state[active])

    def _compute_step(self, a: Float64, b: Float64, u: Float64, v: Float64) -> tuple[Float64, Float64, Float64, Bools]:
        """Compute the full Newton step, the residual in pixels, and whether the point lies in the region."""
        image = self.distortion.linearize(a, b)
        du, dv = image.u - u, image.v - v
        determinant = image.determinant
        inverse = 1.0 / determinant
        step_a = (image.v_b * du - image.u_b * dv) * inverse
        step_b = (image.u_a * dv - image.v_a * du) * inverse
        du, dv = self.focal[0] * du, self.focal[1] * dv
        return step_a, step_b, np.sqrt(du * du + dv * dv), self.region.contains(a, b, determinant)


def solve(
    distortion: Distortion,
    region: ValidRegion,
    start_table: StartTable,
    u: Float64,
    v: Float64,
    focal: tuple[float, float],
    params: InversionParams = InversionParams(),
) -> tuple[Float64, Float64, SolverStatus]:
    """Find the points of the valid region whose distorted images are (u, v), on the threads that torch may use.

    Args:
        distortion: The distortion, with coefficients that are floats.
        region: Its valid region.
        start_table: Table of starts up to the farthest pixel.
        u: (N,) float64 first normalized image coordinates.
        v: (N,) second ones.
        focal: Pixels per unit of u and v, because the residual is measured in pixels.
        params: Parameters of Newton's method.

    Returns:
        `a` and `b` (N,) float64, 0 without a solution, and (N,) uint8: `ANSWERED`, `OUTSIDE` (no point of the valid
        region has this image) or `UNCONVERGED`.
    """

    def solve_quickly(u: Float64, v: Float64) -> tuple[Float64, ...]:
        distorted = np.sqrt(u * u + v * v)
        reachable = np.flatnonzero(region.max_distorted_radius.contains(distorted, u, v))
        if len(reachable) < len(u):
            solution = solve_quickly(u[reachable], v[reachable]) if len(reachable) else ()
            return _scatter_solution(len(u), reachable, solution)
        start = _compute_start(region, start_table, u, v, distorted)
        search = _NewtonSearch(distortion, region, focal, params, u, v, *start)
        search.run(params.quick_steps)
        return search.a, search.b, search.error

    def solve_thoroughly(u: Float64, v: Float64, a: Float64, b: Float64) -> tuple[Float64, ...]:
        search = _NewtonSearch(distortion, region, focal, params, u, v, a, b)
        search.run(params.max_steps)
        failed = np.flatnonzero(search.error > params.accept_px)
        if len(failed) and not distortion.is_radial:
            search.retry(failed, *find_nearest_seeds(distortion, region, u[failed], v[failed]))
        return search.a, search.b, search.error

    a, b, error = _run_in_chunks(solve_quickly, u, v)
    failed = np.flatnonzero(error > params.accept_px)
    if len(failed):
        a[failed], b[failed], error[failed] = _run_in_chunks(
            solve_thoroughly, u[failed], v[failed], a[failed], b[failed]
        )
    status = _compute_status(region, a, b, error, params.accept_px)
    return np.where(status == ANSWERED, a, 0.0), np.where(status == ANSWERED, b, 0.0), status


def _run_in_chunks(function: Callable[..., tuple[Float64, ...]], *arrays: Float64) -> tuple[Float64, ...]:
    """Run a function on chunks of its arguments in parallel, and concatenate the results."""

    def run_chunk(start: int) -> tuple[Float64, ...]:
        with np.errstate(all="ignore"):  # steps that diverge are rejected by their residual
            return function(*(array[start : start + _PIXELS_PER_CHUNK] for array in arrays))

    starts = range(0, max(len(arrays[0]), 1), _PIXELS_PER_CHUNK)
    if len(starts) == 1:
        return run_chunk(0)
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:  # numpy computes without the interpreter's lock
        results = list(pool.map(run_chunk, starts))
    return tuple(np.concatenate(parts) for parts in zip(*results, strict=True))


def _scatter_solution(count: int, reachable: NDArray[np.intp], solution: tuple[Float64, ...]) -> tuple[Float64, ...]:
    """Scatter points and errors of the reachable pixels among all; the others have the error NaN."""
    result = np.zeros(count), np.zeros(count), np.full(count, np.nan)
    for values, solved_values in zip(result, solution, strict=False):
        values[reachable] = solved_values
    return result


def _compute_status(region: ValidRegion, a: Float64, b: Float64, error: Float64, accept_px: float) -> SolverStatus:
    status = np.full(error.shape, ANSWERED, np.uint8)
    failed = np.flatnonzero(~(error <= accept_px))
    # A point that is stuck at the edge of the region has its image behind the fold.
    is_at_edge = ~region.edge_radius.contains(np.hypot(a[failed], b[failed]) / 0.98, a[failed], b[failed])
    status[failed] = np.where(is_at_edge | np.isnan(error[failed]), OUTSIDE, UNCONVERGED)
    return status


def _compute_start(
    region: ValidRegion, table: StartTable, u: Float64, v: Float64, distorted: Float64
) -> tuple[Float64, Float64]:
    """Compute the solution of the radial part alone, moved inside the region."""
    radius = table(distorted)
    if not (radius <= 0.999 * region.edge_radius.minimum).all():
        radius = np.minimum(radius, 0.999 * region.edge_radius(u, v))
    ratio = np.where(distorted > 0.0, radius / distorted, 1.0)
    return u * ratio, v * ratio


class _ImplicitSolution(torch.autograd.Function):
    """Solution p of F(p, parameters) = 0 with dp = -(dF/dp)^-1 dF, by the implicit function theorem."""

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
    float_distortion: Distortion, distortion: Distortion, a: Tensor, b: Tensor, u: Tensor, v: Tensor
) -> tuple[Tensor, Tensor]:
    """Make solved points a differentiable function of the coefficients and of their images.

    Args:
        float_distortion: The distortion with coefficients that are floats.
        distortion: The distortion with coefficients that carry gradients.
        a: (N,) first coordinates of the solved points.
        b: (N,) second ones.
        u: (N,) first coordinates of their images.
        v: (N,) second ones.

    Returns:
        `a` and `b` with gradients of first order; second-order gradients raise an error.
    """
    image = float_distortion.linearize(a.numpy(force=True), b.numpy(force=True))
    rows = np.stack((image.u_a, image.u_b, image.v_a, image.v_b), axis=-1).reshape(-1, 2, 2)
    jacobian = torch.from_numpy(rows).to(a.device)
    image_u, image_v = distortion.distort(a, b)
    residual = torch.stack((image_u - u, image_v - v), dim=-1)
    point: Tensor = _ImplicitSolution.apply(torch.stack((a, b), dim=-1), jacobian, residual)  # type: ignore[no-untyped-call]
    return point[..., 0], point[..., 1]
