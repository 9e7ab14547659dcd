"""The inverse of a lens: damped Newton with the exact Jacobian, from a tabulated start, inside the valid region.

All of it is float64. A pixel gets an answer only if the answer reproduces it and lies in the valid region; every other
pixel gets a reason. Gradients come from the implicit function theorem at the solution, not from the iterations.
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
from torchcover.geometry.arrays import Bools, Float64

# A ray at this radius of the plane z = 1 runs along the plane z = 0: infinity, for tables that have to be interpolated.
HORIZON = 1e9
_DIRECTIONS = 360
# More than a table of that many entries is off by; for what lies between, the solver is asked.
_MARGIN = 1.0005
# Radii at which the determinant is looked at: evenly in angle over the plane z = 1, then on to the horizon.
_PLANE_RADII = np.concatenate([np.tan(np.linspace(0.0, np.pi / 2, 512, endpoint=False)), np.geomspace(400.0, 1e8, 32)])


@dataclass(frozen=True)
class AzimuthFunction:
    """A positive function of the azimuth: one number, or a table over -pi..pi whose last entry repeats the first."""

    values: Float64

    @property
    def minimum(self) -> float:
        """Its minimum."""
        return float(self.values.min())

    def __call__(self, a: Float64, b: Float64) -> Float64:
        """Value in the direction of each (a, b), linearly interpolated."""
        if len(self.values) == 1:
            return np.broadcast_to(self.values, a.shape)
        place = (np.arctan2(b, a) + np.pi) * ((len(self.values) - 1) / (2.0 * np.pi))
        low = np.nan_to_num(place).astype(np.int64).clip(0, len(self.values) - 2)
        left = self.values[low]
        return np.asarray(left + (place - low) * (self.values[low + 1] - left))

    def contains(self, radius: Float64, a: Float64, b: Float64) -> Bools:
        """Whether the radii of (a, b) are at most the function; it is looked up only where its minimum is passed."""
        held: Bools = radius <= self.minimum
        unsure = np.flatnonzero(~held)
        if len(unsure) and len(self.values) > 1:
            held[unsure] = radius[unsure] <= self(a[unsure], b[unsure])
        return held


@dataclass(frozen=True)
class ValidRegion:
    """The part of the chart around the optical axis in which a distortion is one-to-one.

    In every direction it ends at the radius `edge_radius`: the first at which the determinant of the Jacobian is not positive,
    or where the chart ends. Behind a fold the same pixels are met again; nothing there is an answer.
    Up to `guard_radius`, which lies behind the edge, a positive determinant means "inside", so that it decides, not the table.
    `max_distorted_radius` is the largest distorted radius of any pixel worth solving, over the azimuth of the distorted point.
    """

    edge_radius: AzimuthFunction
    guard_radius: AzimuthFunction
    max_distorted_radius: AzimuthFunction

    def contains(self, a: Float64, b: Float64, determinant: Float64) -> Bools:
        """Whether drawn points lie in the region; `determinant` is that of the Jacobian at them."""
        return (determinant > 0.0) & self.guard_radius.contains(np.sqrt(a * a + b * b), a, b)


def find_valid_region(distortion: Distortion, limit: float) -> ValidRegion:
    """Find the valid region."""
    limit = min(limit, HORIZON)
    count = 1 if distortion.is_radial else _DIRECTIONS + 1
    azimuth = np.linspace(-np.pi, np.pi, count)
    cosine, sine = np.cos(azimuth), np.sin(azimuth)
    radii = _radii(distortion, limit)
    good = _determinant(distortion, cosine[:, None] * radii, sine[:, None] * radii) > 0.0
    good[:, 0] = True  # the axis, around which every lens is one-to-one
    first_bad = np.where(good.all(axis=1), len(radii), (~good).argmax(axis=1))
    ends = np.append(radii, HORIZON)
    edge = _bisect(distortion, cosine, sine, ends[first_bad - 1], ends[first_bad])
    edge = np.where(first_bad == len(radii), limit, edge).clip(max=limit)
    again = good & (radii > edge[:, None])
    next_good = np.where(again.any(axis=1), radii[again.argmax(axis=1)], 2.0 * limit)
    guard = ((edge + next_good) / 2.0).clip(max=limit)
    return ValidRegion(
        AzimuthFunction(edge), AzimuthFunction(guard), AzimuthFunction(_reach(distortion, edge * cosine, edge * sine))
    )


def _radii(distortion: Distortion, limit: float) -> Float64:
    """Radii to look at: critical ones, the middles between them so that no fold is stepped over, and a plain grid."""
    critical = np.sort(distortion.find_critical_radii())
    middles = (critical[:-1] + critical[1:]) / 2.0
    plain = np.append(_PLANE_RADII, HORIZON) if limit >= HORIZON else np.linspace(0.0, limit, 512)
    radii = np.unique(np.concatenate([plain, critical, middles]))
    return radii[radii <= limit]


def _determinant(distortion: Distortion, a: Float64, b: Float64) -> Float64:
    with np.errstate(all="ignore"):
        return np.nan_to_num(distortion.linearize(a, b).determinant, nan=-1.0)


def _bisect(distortion: Distortion, cosine: Float64, sine: Float64, low: Float64, high: Float64) -> Float64:
    """Radius of the sign change between `low` and `high`, to the last bits."""
    for _ in range(64):
        middle = (low + high) / 2.0
        positive = _determinant(distortion, middle * cosine, middle * sine) > 0.0
        low, high = np.where(positive, middle, low), np.where(positive, high, middle)
    return low


def _reach(distortion: Distortion, a: Float64, b: Float64) -> Float64:
    """Distorted radius of the edge over the azimuth of the image, a little widened for what lies between entries."""
    if np.hypot(a, b).max() >= HORIZON:
        return np.array([np.inf])
    image = distortion.linearize(a, b)
    radius = np.hypot(image.u, image.v)
    if distortion.is_radial:
        return radius * (1.0 + 1e-14)
    azimuth = np.arctan2(image.v, image.u)
    turns = np.diff(np.unwrap(azimuth))
    if not (turns > 0.0).all():  # cusps: no single distance in every direction
        return np.array([radius.max()])
    order = np.argsort(azimuth[:-1])
    grid = np.linspace(-np.pi, np.pi, len(azimuth))
    return _MARGIN * np.interp(grid, azimuth[order], radius[order], period=2.0 * np.pi)


_ENTRIES = 4096
# Seeds stop a tenth of a degree short of the horizon of the plane z = 1.
_FARTHEST_SEED = 500.0


@dataclass(frozen=True)
class StartTable:
    """Undistorted radius over distorted radius.

    `radius_step`: distorted radius from one entry to the next; `radii`: (K,) undistorted radii.
    """

    radius_step: float
    radii: Float64

    def __call__(self, distorted: Float64) -> Float64:
        """Undistorted radius, linearly interpolated and held at the end."""
        place = np.minimum(distorted / self.radius_step, len(self.radii) - 1.001)
        low = place.astype(np.int64)
        left = self.radii[low]
        return left + (place - low) * (self.radii[low + 1] - left)


def build_start_table(distortion: Distortion, limit: float, max_distorted_radius: float) -> StartTable:
    """Tabulate the inverse of the radial part up to its own fold, or as far as the pixels go."""
    fold = _radial_fold(distortion, limit)
    top = _radius_for(distortion, max_distorted_radius) if np.isinf(fold) else fold
    even = np.linspace(0.0, 1.0, _ENTRIES)
    # Towards a fold the inverse has the slope of a square root; without one the radii run evenly in angle.
    radii = np.tan(even * np.arctan(top)) if np.isinf(fold) else top * (1.0 - (1.0 - even) ** 2)
    with np.errstate(all="ignore"):  # a pole at the very end
        distorted = np.maximum.accumulate(np.nan_to_num(distortion.distort_radius(radii)))
    end = max(min(max_distorted_radius, float(distorted[-1])), 1e-30)
    table = np.interp(np.linspace(0.0, end, _ENTRIES), distorted, radii)
    return StartTable(end / (_ENTRIES - 1), table)


def _radial_fold(distortion: Distortion, limit: float) -> float:
    """First critical radius after which the radial part does not grow, or comes back from a pole."""
    critical = np.sort(distortion.find_critical_radii())
    after = np.append((critical[:-1] + critical[1:]) / 2.0, critical[-1:] * 1.01)
    value = distortion.distort_radius(after)
    folds = critical[(value < 0.0) | (distortion.distort_radius(after * (1.0 + 1e-6)) <= value)]
    return min(float(folds[0]) if len(folds) else np.inf, limit)


def _radius_for(distortion: Distortion, distorted: float) -> float:
    """A radius whose image is at least this far out, or the horizon."""
    radius = 1.0
    while radius < HORIZON and not distortion.distort_radius(np.array([radius]))[0] >= distorted:
        radius *= 2.0
    return radius


def find_nearest_seeds(distortion: Distortion, region: ValidRegion, u: Float64, v: Float64) -> tuple[Float64, Float64]:
    """The second try: of points spread over the valid region, those whose images lie nearest.

    Strong tangential terms bend the region so far from round that Newton's method, coming from the radial part's
    answer, can end in a bay of its edge.
    """
    azimuth = np.linspace(-np.pi, np.pi, 96, endpoint=False)
    cosine, sine = np.cos(azimuth)[:, None], np.sin(azimuth)[:, None]
    edge = np.minimum(0.999 * region.edge_radius(cosine, sine), _FARTHEST_SEED)
    radius = np.tan(np.linspace(0.02, 1.0, 48) * np.arctan(edge))
    seed_a, seed_b = (radius * cosine).ravel(), (radius * sine).ravel()
    image = distortion.linearize(seed_a, seed_b)
    half_square = (image.u**2 + image.v**2) / 2.0
    nearest = np.empty(len(u), dtype=np.int64)
    for start in range(0, len(u), 1024):  # |m|^2 - 2 m.s + |s|^2, less what is the same for all seeds
        part = slice(start, start + 1024)
        nearest[part] = np.argmin(half_square - u[part, None] * image.u - v[part, None] * image.v, axis=1)
    return seed_a[nearest], seed_b[nearest]


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

SolverStatus = NDArray[np.uint8]


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
        at = self.distortion.linearize(a, b)
        du, dv = at.u - u, at.v - v
        determinant = at.determinant
        inverse = 1.0 / determinant
        step_a, step_b = (at.v_b * du - at.u_b * dv) * inverse, (at.u_a * dv - at.v_a * du) * inverse
        du, dv = self.focal[0] * du, self.focal[1] * dv
        return step_a, step_b, np.sqrt(du * du + dv * dv), self.region.contains(a, b, determinant)


def solve(
    distortion: Distortion,
    region: ValidRegion,
    start_table: StartTable,
    u: Float64,
    v: Float64,
    focal: tuple[float, float],
) -> tuple[Float64, Float64, SolverStatus]:
    """Find the points of the valid region whose distorted images are (u, v), on as many threads as torch may use.

    `u` and `v` are (N,) float64 normalised image coordinates, `focal` is pixels per unit of both, for the residual is
    measured in pixels; the coefficients of `distortion` are floats.

    Returns `a`, `b` (N,) float64, 0 where there is no answer, and (N,) uint8: `ANSWERED`, `OUTSIDE` (no point of the
    valid region has this image) or `UNCONVERGED`.
    """

    def quick(u: Float64, v: Float64) -> tuple[Float64, ...]:
        distorted = np.sqrt(u * u + v * v)
        reached = np.flatnonzero(region.max_distorted_radius.contains(distorted, u, v))
        if len(reached) < len(u):
            return _scatter(len(u), reached, quick(u[reached], v[reached]) if len(reached) else ())
        search = _Search(distortion, region, focal, u, v, *_first_guess(region, start_table, u, v, distorted))
        search.run(_QUICK_STEPS)
        return search.a, search.b, search.error

    def thorough(u: Float64, v: Float64, a: Float64, b: Float64) -> tuple[Float64, ...]:
        search = _Search(distortion, region, focal, u, v, a, b)
        search.run(_MAX_STEPS)
        lost = np.flatnonzero(search.error > ACCEPT_PX)
        if len(lost) and not distortion.is_radial:
            search.retry(lost, *find_nearest_seeds(distortion, region, u[lost], v[lost]))
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


def _status(region: ValidRegion, a: Float64, b: Float64, error: Float64) -> SolverStatus:
    status = np.full(error.shape, ANSWERED, np.uint8)
    failed = np.flatnonzero(~(error <= ACCEPT_PX))
    # Stuck at the edge of the region: the image lies behind the fold.
    at_edge = ~region.edge_radius.contains(np.hypot(a[failed], b[failed]) / 0.98, a[failed], b[failed])
    status[failed] = np.where(at_edge | np.isnan(error[failed]), OUTSIDE, UNCONVERGED)
    return status


def _first_guess(
    region: ValidRegion, table: StartTable, u: Float64, v: Float64, distorted: Float64
) -> tuple[Float64, Float64]:
    """The answer of the radial part alone, pulled inside the region."""
    radius = table(distorted)
    if not (radius <= 0.999 * region.edge_radius.minimum).all():
        radius = np.minimum(radius, 0.999 * region.edge_radius(u, v))
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
    float_distortion: Distortion, distortion: Distortion, a: Tensor, b: Tensor, u: Tensor, v: Tensor
) -> tuple[Tensor, Tensor]:
    """Make answered points `a`, `b` (N,) a function of the coefficients in `distortion` and of their images (u, v).

    `float_distortion` is the same distortion with coefficients that are floats. Gradients are of first order; second-order ones
    raise.
    """
    at = float_distortion.linearize(a.numpy(force=True), b.numpy(force=True))
    rows = np.stack((at.u_a, at.u_b, at.v_a, at.v_b), axis=-1).reshape(-1, 2, 2)
    jacobian = torch.from_numpy(rows).to(a.device)
    image_u, image_v = distortion.distort(a, b)
    residual = torch.stack((image_u - u, image_v - v), dim=-1)
    point: Tensor = _ImplicitSolution.apply(torch.stack((a, b), dim=-1), jacobian, residual)  # type: ignore[no-untyped-call]
    return point[..., 0], point[..., 1]
