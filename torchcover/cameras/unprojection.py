"""Depth images times rays: checking what arrives, choosing pixels, making points."""

from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

DepthKind = Literal["z", "distance"]
_KINDS = ("z", "distance")


class Selection(NamedTuple):
    """The pixels of every stride-th row and column: (h, w, 3) points at depth 1, which (h, w) have a ray.

    `allowed` and `depth`, (h, w) or (B, h, w), are of one image or a batch; what has a ray and is not masked is
    allowed.
    """

    rays: Tensor
    has_ray: Tensor
    allowed: Tensor
    depth: Tensor


def check_depth(
    depth: Tensor, kind: str, stride: int, valid: Tensor | None, size: tuple[int, int], name: str
) -> Tensor:
    """The depth in float32 or float64, once all arguments of `Camera.unproject` are known to fit."""
    if not depth.is_floating_point():
        raise TypeError(
            f"{name}: depth is {depth.dtype}, whose unit is unknown; scale it to metres: depth * 0.001 for mm"
        )
    if depth.ndim not in (2, 3) or tuple(depth.shape[-2:]) != size:
        raise ValueError(f"{name}: depth must be {size} or (B, {size[0]}, {size[1]}); got {tuple(depth.shape)}")
    if kind not in _KINDS:
        raise ValueError(f"{name}: depth kind {kind!r} is unknown; allowed: {', '.join(_KINDS)}")
    if isinstance(stride, bool) or not isinstance(stride, int) or stride < 1:
        raise ValueError(f"{name}: stride must be an integer of at least 1; got {stride!r}")
    if valid is not None:
        _check_mask(valid, depth, size, name)
    return depth if depth.dtype in (torch.float32, torch.float64) else depth.float()


def _check_mask(valid: Tensor, depth: Tensor, size: tuple[int, int], name: str) -> None:
    if valid.dtype != torch.bool:
        raise TypeError(f"{name}: valid must be boolean; got {valid.dtype}")
    if tuple(valid.shape) not in (size, tuple(depth.shape)):
        raise ValueError(f"{name}: valid must be {size} or {tuple(depth.shape)}; got {tuple(valid.shape)}")


def select(rays: Tensor, has_ray: Tensor, depth: Tensor, stride: int, valid: Tensor | None) -> Selection:
    """Every stride-th row and column of everything."""
    rays, has_ray, depth = rays[::stride, ::stride], has_ray[::stride, ::stride], depth[..., ::stride, ::stride]
    allowed = has_ray if valid is None else has_ray & valid[..., ::stride, ::stride]
    return Selection(rays, has_ray, allowed, depth)


def scale_rays(rays: Tensor, depth: Tensor, keep: Tensor) -> Tensor:
    """Points (N, 3) = ray (h, w, 3) * depth (h, w) where keep (h, w)."""
    if bool(keep.all()):
        return (rays * depth[..., None]).reshape(-1, 3)
    chosen = _indices(keep)
    # index_select copies whole rows; indexing with a tensor goes entry by entry and is several times slower
    return rays.reshape(-1, 3).index_select(0, chosen) * depth.flatten().index_select(0, chosen)[:, None]


def _indices(mask: Tensor) -> Tensor:
    """Flat indices of what is True; on the CPU by numpy, which takes a twentieth of torch's time on two busy cores."""
    if mask.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return mask.flatten().nonzero().squeeze(1)
