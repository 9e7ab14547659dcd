"""The rays of all pixels of an image, solved once and kept for each device and type."""

from typing import Any

import torch
from torch import Tensor

from torchcover.cameras.inverse import ANSWERED, OUTSIDE, UNCONVERGED
from torchcover.cameras.optics import Optics
from torchcover.cameras.unprojection import DepthKind
from torchcover.devices import has_float64

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

    def points(self, device: str, dtype: torch.dtype, kind: DepthKind) -> tuple[Tensor, Tensor]:
        """(H, W, 3) points, NaN where there is none, and (H, W) bool; made once unless gradients flow through them.

        They are at depth 1 along the ray ("distance") or along the axis ("z"). The lens is solved in float64 whatever
        the type.
        """
        if not has_float64(torch.device(device)):
            rays, valid = self.points("cpu", dtype, kind)
            return rays.to(device), valid.to(device)
        trace = self._trace_image if kind == "distance" else self._plane
        if self._optics.differentiable and torch.is_grad_enabled():
            return trace(device, dtype)
        key = (device, dtype, kind)
        if key not in self._tables:
            self._tables[key] = trace(device, dtype)
        return self._tables[key]

    def pixel_counts(self) -> dict[str, int]:
        """How many pixels have a ray, and why the others have none; see `Camera.pixel_counts`."""
        if self._pixel_counts is None:
            self.points("cpu", torch.float32, "distance")
        return dict(self._pixel_counts or {})

    def _plane(self, device: str, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Rays scaled to z = 1; at and beyond 90 degrees there is no z-depth."""
        rays, valid = self.points(device, dtype, "distance")
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
        directions, status = self._optics.directions(torch.stack((x, y), dim=-1).reshape(-1, 2))
        return directions.to(dtype).reshape(*y.shape, 3), status.reshape(y.shape)
