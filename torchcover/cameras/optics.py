"""Projection and unprojection of one lens in float64, without image borders."""

from math import frexp
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcover.cameras import inverse
from torchcover.cameras.depth import DepthKind
from torchcover.cameras.inverse import ANSWERED, OUTSIDE, UNCONVERGED, StartTable, build_start_table
from torchcover.cameras.lens import Distortion
from torchcover.cameras.models import build_lens
from torchcover.cameras.valid_region import HORIZON, ValidRegion, find_valid_region
from torchcover.devices import has_float64
from torchcover.geometry.arrays import Float64


class Optics:
    """Lens with its intrinsics.

    Args:
        intrinsics: (4,) float64 fx, fy, cx, cy in pixels.
        model: Name of the model, see `models`.
        coefficients: (K,) float64 coefficients of the model.
    """

    def __init__(self, intrinsics: Tensor, model: str, coefficients: Tensor) -> None:
        is_trainable = coefficients.requires_grad
        self.intrinsics = intrinsics
        # One lens carries the gradients, its twin with floats is for the solver: no graph, no waiting for a GPU.
        self._solver = build_lens(model, coefficients.tolist(), is_trainable=is_trainable)
        self._lens = build_lens(model, coefficients.unbind(), is_trainable=True) if is_trainable else self._solver
        self.is_differentiable = is_trainable or intrinsics.requires_grad
        self._valid_region: ValidRegion | None = None
        self._start_tables: dict[int, StartTable] = {}

    def unproject(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the directions that the lens maps to pixels.

        Args:
            pixels: (N, 2) float64 columns and rows.

        Returns:
            (N, 3) float64 unit directions, NaN without a solution, and the (N,) status of `inverse.solve`.
        """
        fx, fy, cx, cy = self.intrinsics.to(pixels.device).unbind()
        u, v = (pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy
        is_in_front = None
        if self._lens.tilt is not None:
            u, v, is_in_front = self._lens.tilt.remove(u, v)
        a, b, status = self._undistort(u, v)
        if is_in_front is not None:
            status = torch.where(is_in_front, status, OUTSIDE)
        rays = self._lens.chart.unproject(a, b)
        return torch.where((status == ANSWERED)[:, None], rays, torch.nan), status

    def _undistort(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        chart, distortion, solver = self._lens.chart, self._lens.distortion, self._solver.distortion
        if distortion is None or solver is None:
            is_inside = torch.hypot(u, v) <= min(chart.limit, HORIZON)
            status = torch.where(is_inside, ANSWERED, OUTSIDE).to(torch.uint8)
            return torch.where(is_inside, u, 0.0), torch.where(is_inside, v, 0.0), status
        a, b, status = self._solve(solver, u.detach(), v.detach())
        if u.requires_grad or self.is_differentiable:
            a, b = inverse.attach_gradients(solver, distortion, a, b, u, v)
        return a, b, status

    def _solve(self, solver: Distortion, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Solve in numpy on the CPU, on whichever device the pixels are, since a table is made once."""
        fx, fy = self.intrinsics[:2].tolist()
        images = u.numpy(force=True), v.numpy(force=True)
        table = self._get_start_table(solver, np.hypot(*images))
        solution = inverse.solve(solver, self._get_valid_region(solver), table, *images, (fx, fy))
        a, b, status = (torch.from_numpy(values).to(u.device) for values in solution)
        return a, b, status

    def _get_valid_region(self, solver: Distortion) -> ValidRegion:
        if self._valid_region is None:
            self._valid_region = find_valid_region(solver, self._solver.chart.limit)
        return self._valid_region

    def _get_start_table(self, solver: Distortion, distorted: Float64) -> StartTable:
        """Get a table up to the next power of two, so that the result of a pixel does not depend on earlier calls."""
        max_distorted = float(distorted[np.isfinite(distorted)].max(initial=0.0))
        exponent = max(frexp(max_distorted)[1], -60)
        if exponent not in self._start_tables:
            self._start_tables[exponent] = build_start_table(solver, self._solver.chart.limit, 2.0**exponent)
        return self._start_tables[exponent]

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Project points.

        Args:
            points: (N, 3) float64 points in the camera frame.

        Returns:
            (N, 2) float64 pixels, NaN for points that the lens cannot show, and (N,) bool: shown.
        """
        is_finite = torch.isfinite(points).all(dim=1)
        safe = torch.where(is_finite[:, None], points, points.new_tensor([0.0, 0.0, 1.0]))
        a, b, is_shown = self._lens.chart.project(*safe.unbind(dim=1))
        is_shown = is_shown & is_finite & self._is_inside(a.detach(), b.detach())
        # Points that are not shown are moved to the axis, so that their infinities do not reach the gradients.
        u, v = torch.where(is_shown, a, 0.0), torch.where(is_shown, b, 0.0)
        if self._lens.distortion is not None:
            u, v = self._lens.distortion.distort(u, v)
        if self._lens.tilt is not None:
            u, v, is_in_front = self._lens.tilt.apply(u, v)
            is_shown = is_shown & is_in_front
        fx, fy, cx, cy = self.intrinsics.to(points.device).unbind()
        image = torch.stack((fx * u + cx, fy * v + cy), dim=-1)
        return torch.where(is_shown[:, None], image, torch.nan), is_shown

    def _is_inside(self, a: Tensor, b: Tensor) -> Tensor:
        """Test which chart points lie before the fold."""
        solver = self._solver.distortion
        if solver is None:
            return torch.ones_like(a, dtype=torch.bool)
        points = a.numpy(force=True), b.numpy(force=True)
        with np.errstate(all="ignore"):  # far outside the region the polynomials overflow
            is_inside = self._get_valid_region(solver).contains(*points, solver.linearize(*points).determinant)
        return torch.from_numpy(is_inside).to(a.device)


class RayTable:
    """Tables of the points at depth 1 of all pixels of an image.

    Args:
        optics: The lens.
        width: Columns of the image.
        height: Rows of the image.
    """

    def __init__(self, optics: Optics, width: int, height: int) -> None:
        self._optics = optics
        self._size = (width, height)
        self._tables: dict[tuple[str, torch.dtype, str], tuple[Tensor, Tensor]] = {}
        self._pixel_counts: dict[str, int] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without the tables: a worker process makes its own faster than it receives them."""
        return {**self.__dict__, "_tables": {}}

    def get_points(self, device: str, dtype: torch.dtype, depth_kind: DepthKind) -> tuple[Tensor, Tensor]:
        """Get the point at depth 1 of each pixel; it is computed once unless gradients flow through it.

        Args:
            device: Device of the result.
            dtype: Type of the result; the lens is solved in float64 in any case.
            depth_kind: Depth along the ray ("distance") or along the axis ("z").

        Returns:
            (H, W, 3) points, NaN without one, and (H, W) bool.
        """
        if not has_float64(torch.device(device)):
            rays, valid = self.get_points("cpu", dtype, depth_kind)
            return rays.to(device), valid.to(device)
        trace = self._trace_image if depth_kind == "distance" else self._scale_to_plane
        if self._optics.is_differentiable and torch.is_grad_enabled():
            return trace(device, dtype)
        key = (device, dtype, depth_kind)
        if key not in self._tables:
            self._tables[key] = trace(device, dtype)
        return self._tables[key]

    def count_pixels(self) -> dict[str, int]:
        """Count the pixels with a ray, and those without by reason; see `Camera.count_pixels`."""
        if self._pixel_counts is None:
            self.get_points("cpu", torch.float32, "distance")
        return dict(self._pixel_counts or {})

    def _scale_to_plane(self, device: str, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Scale the rays to z = 1; at and beyond 90 degrees there is no z depth."""
        rays, valid = self.get_points(device, dtype, "distance")
        valid = valid & (rays[..., 2] > 0)
        return rays / torch.where(valid, rays[..., 2], torch.nan)[..., None], valid

    def _trace_image(self, device: str, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        width, height = self._size
        rows = torch.arange(height, dtype=torch.float64, device=device)
        columns = torch.arange(width, dtype=torch.float64, device=device)
        max_pixels = 1 << 20  # limits the memory of the float64 rays while a table is made
        parts, statuses = [], []
        for rows_of_part in torch.split(rows, max(1, max_pixels // width)):
            y, x = torch.meshgrid(rows_of_part, columns, indexing="ij")
            directions, part_status = self._optics.unproject(torch.stack((x, y), dim=-1).reshape(-1, 2))
            parts.append(directions.to(dtype).reshape(*y.shape, 3))
            statuses.append(part_status.reshape(y.shape))
        status = torch.cat(statuses)
        codes = {"pixels_valid": ANSWERED, "pixels_outside": OUTSIDE, "pixels_unconverged": UNCONVERGED}
        self._pixel_counts = {name: int((status == code).sum()) for name, code in codes.items()}
        return torch.cat(parts), status == ANSWERED
