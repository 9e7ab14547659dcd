"""The two directions of one lens, in float64: pixels to directions and points to pixels. Knows no image borders."""

from math import frexp
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcover.cameras import inverse
from torchcover.cameras.depth import DepthKind
from torchcover.cameras.inverse import (
    ANSWERED,
    HORIZON,
    OUTSIDE,
    UNCONVERGED,
    StartTable,
    ValidRegion,
    build_start_table,
    find_valid_region,
)
from torchcover.cameras.lens import Distortion
from torchcover.cameras.models import build_lens
from torchcover.devices import has_float64
from torchcover.geometry.arrays import Float64


class Optics:
    """A lens with its intrinsics, (4,) float64 fx, fy, cx, cy."""

    def __init__(self, intrinsics: Tensor, model: str, coefficients: Tensor) -> None:
        trainable = coefficients.requires_grad
        self.intrinsics = intrinsics
        # One lens carries the gradients, its twin in floats is the solver's: no graph, no waiting for a GPU.
        self._solver = build_lens(model, coefficients.tolist(), is_trainable=trainable)
        self._lens = build_lens(model, coefficients.unbind(), is_trainable=True) if trainable else self._solver
        self.is_differentiable = trainable or intrinsics.requires_grad
        self._found_region: ValidRegion | None = None
        self._start_tables: dict[int, StartTable] = {}

    def unproject(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 3) float64 unit directions that the lens maps to (N, 2) columns and rows; status of `inverse.solve`.

        Directions are NaN where there is none.
        """
        fx, fy, cx, cy = self.intrinsics.to(pixels.device).unbind()
        u, v = (pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy
        front = None
        if self._lens.tilt is not None:
            u, v, front = self._lens.tilt.remove(u, v)
        a, b, status = self._undistort(u, v)
        if front is not None:
            status = torch.where(front, status, OUTSIDE)
        rays = self._lens.chart.unproject(a, b)
        return torch.where((status == ANSWERED)[:, None], rays, torch.nan), status

    def _undistort(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        chart, distortion, solver = self._lens.chart, self._lens.distortion, self._solver.distortion
        if distortion is None or solver is None:
            shown = torch.hypot(u, v) <= min(chart.limit, HORIZON)
            status = torch.where(shown, ANSWERED, OUTSIDE).to(torch.uint8)
            return torch.where(shown, u, 0.0), torch.where(shown, v, 0.0), status
        a, b, status = self._solve(solver, u.detach(), v.detach())
        if u.requires_grad or self.is_differentiable:
            a, b = inverse.attach_gradients(solver, distortion, a, b, u, v)
        return a, b, status

    def _solve(self, solver: Distortion, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Through numpy, on the CPU, wherever the pixels are: a table is made once."""
        fx, fy = self.intrinsics[:2].tolist()
        images = u.numpy(force=True), v.numpy(force=True)
        table = self._start_table(solver, np.hypot(*images))
        solution = inverse.solve(solver, self._region(solver), table, *images, (fx, fy))
        a, b, status = (torch.from_numpy(values).to(u.device) for values in solution)
        return a, b, status

    def _region(self, solver: Distortion) -> ValidRegion:
        if self._found_region is None:
            self._found_region = find_valid_region(solver, self._solver.chart.limit)
        return self._found_region

    def _start_table(self, solver: Distortion, distorted: Float64) -> StartTable:
        """A table up to the next power of two: what a pixel gets must not depend on what was asked before."""
        farthest = float(distorted[np.isfinite(distorted)].max(initial=0.0))
        exponent = max(frexp(farthest)[1], -60)
        if exponent not in self._start_tables:
            self._start_tables[exponent] = build_start_table(solver, self._solver.chart.limit, 2.0**exponent)
        return self._start_tables[exponent]

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) float64 pixels that (N, 3) points are seen at, NaN if at none; (N,) bool if at any."""
        finite = torch.isfinite(points).all(dim=1)
        safe = torch.where(finite[:, None], points, points.new_tensor([0.0, 0.0, 1.0]))
        a, b, shown = self._lens.chart.project(*safe.unbind(dim=1))
        shown = shown & finite & self._inside(a.detach(), b.detach())
        # Points that are not shown go along the axis, lest their infinities reach the gradients.
        u, v = torch.where(shown, a, 0.0), torch.where(shown, b, 0.0)
        if self._lens.distortion is not None:
            u, v = self._lens.distortion.distort(u, v)
        if self._lens.tilt is not None:
            u, v, front = self._lens.tilt.apply(u, v)
            shown = shown & front
        fx, fy, cx, cy = self.intrinsics.to(points.device).unbind()
        image = torch.stack((fx * u + cx, fy * v + cy), dim=-1)
        return torch.where(shown[:, None], image, torch.nan), shown

    def _inside(self, a: Tensor, b: Tensor) -> Tensor:
        """Whether drawn points lie before the fold."""
        solver = self._solver.distortion
        if solver is None:
            return torch.ones_like(a, dtype=torch.bool)
        drawn = a.numpy(force=True), b.numpy(force=True)
        with np.errstate(all="ignore"):  # far outside the region the polynomials overflow
            inside = self._region(solver).contains(*drawn, solver.linearize(*drawn).determinant)
        return torch.from_numpy(inside).to(a.device)


# Pixels whose float64 rays exist at the same time while a table is made.
_BAND = 1 << 20
_STATUS_NAMES = {"pixels_valid": ANSWERED, "pixels_outside": OUTSIDE, "pixels_unconverged": UNCONVERGED}


class RayTable:
    """For each pixel the point at depth 1, and whether there is one."""

    def __init__(self, optics: Optics, width: int, height: int) -> None:
        self._optics = optics
        self._size = (width, height)
        self._tables: dict[tuple[str, torch.dtype, str], tuple[Tensor, Tensor]] = {}
        self._pixel_counts: dict[str, int] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Without the tables: a worker process makes its own, which is faster than receiving them."""
        return {**self.__dict__, "_tables": {}}

    def get_points(self, device: str, dtype: torch.dtype, depth_kind: DepthKind) -> tuple[Tensor, Tensor]:
        """(H, W, 3) points, NaN where there is none, and (H, W) bool; made once unless gradients flow through them.

        They are at depth 1 along the ray ("distance") or along the axis ("z"). The lens is solved in float64 whatever
        the type.
        """
        if not has_float64(torch.device(device)):
            rays, valid = self.get_points("cpu", dtype, depth_kind)
            return rays.to(device), valid.to(device)
        trace = self._trace_image if depth_kind == "distance" else self._plane
        if self._optics.is_differentiable and torch.is_grad_enabled():
            return trace(device, dtype)
        key = (device, dtype, depth_kind)
        if key not in self._tables:
            self._tables[key] = trace(device, dtype)
        return self._tables[key]

    def count_pixels(self) -> dict[str, int]:
        """How many pixels have a ray, and why the others have none; see `Camera.pixel_counts`."""
        if self._pixel_counts is None:
            self.get_points("cpu", torch.float32, "distance")
        return dict(self._pixel_counts or {})

    def _plane(self, device: str, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Rays scaled to z = 1; at and beyond 90 degrees there is no z-depth."""
        rays, valid = self.get_points(device, dtype, "distance")
        valid = valid & (rays[..., 2] > 0)
        return rays / torch.where(valid, rays[..., 2], torch.nan)[..., None], valid

    def _trace_image(self, device: str, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        width, height = self._size
        rows = torch.arange(height, dtype=torch.float64, device=device)
        columns = torch.arange(width, dtype=torch.float64, device=device)
        parts = torch.split(rows, max(1, _BAND // width))
        bands = [self._trace_rows(part, columns, dtype) for part in parts]
        status = torch.cat([band[1] for band in bands])
        self._pixel_counts = {name: int((status == code).sum()) for name, code in _STATUS_NAMES.items()}
        return torch.cat([band[0] for band in bands]), status == ANSWERED

    def _trace_rows(self, rows: Tensor, columns: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        y, x = torch.meshgrid(rows, columns, indexing="ij")
        directions, status = self._optics.unproject(torch.stack((x, y), dim=-1).reshape(-1, 2))
        return directions.to(dtype).reshape(*y.shape, 3), status.reshape(y.shape)
