"""Depth images: the encodings they come in, to metres, and which of their pixels say nothing.

Every reader returns metres as float32, with infinity where nothing was hit within the sensor's range.
"""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.cameras.isolated_images import read_exr_image, read_png_image
from torchcover.files import DEFLATE_MAX_RATIO, NpyHeader, check_memory, guard_reader, read_npy

CARLA_FAR_M = 1000.0
_CARLA_FULL_CODE = 2**24 - 1
_CHANNELS = ("BGRA", "RGBA", "BGR", "RGB")
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
# Bits of a channel and colour type -> bytes of a pixel.
_PNG_BYTES = {(8, 2): 3, (8, 6): 4, (16, 0): 2}
# At its largest: as stored and copied, the code, float64 and float32 metres.
_BYTES_PER_PIXEL = 32


def decode_carla(image: NDArray[np.uint8], channel_order: str) -> Tensor:
    """Decode CARLA's 24-bit depth: 1000 m * (R + 256 G + 65536 B) / (2^24 - 1), measured along the optical axis.

    Args:
        image: (H, W, 3 or 4) uint8 as the simulator's buffer or a PNG of it holds it.
        channel_order: Meaning of the channels: "BGRA" (carla.Image.raw_data), "RGBA", "BGR" or "RGB" (PNG files).

    Returns:
        (H, W) float32 z-depth in metres; infinity where the code is full: sky, nothing hit.

    Raises:
        ValueError: The order is unknown, or the image is not uint8 or has other channels than the order says.

    Example:
        >>> decode_carla(np.array([[[232, 3, 0], [255, 255, 255]]], dtype=np.uint8), "RGB")
        tensor([[0.0596,    inf]])
    """
    if channel_order not in _CHANNELS:
        raise ValueError(f"channel order {channel_order!r} is unknown; allowed: {', '.join(_CHANNELS)}")
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != len(channel_order):
        raise ValueError(
            f"CARLA depth in order {channel_order!r} is an (H, W, {len(channel_order)}) uint8 image; "
            f"got shape {image.shape}, dtype {image.dtype}"
        )
    code = np.zeros(image.shape[:2], dtype=np.int32)
    for bits, channel in enumerate("RGB"):
        code += image[..., channel_order.index(channel)].astype(np.int32) << 8 * bits
    metres = code * (CARLA_FAR_M / _CARLA_FULL_CODE)
    metres[code == _CARLA_FULL_CODE] = np.inf
    return torch.from_numpy(metres.astype(np.float32))


@guard_reader("a depth image")
def read_depth(path: Path, *, meters_per_unit: float | None = None) -> Tensor:
    """Read a depth image.

    Args:
        path: A PNG (8-bit RGB or RGBA: CARLA's encoding; 16-bit grey: integers), an NPY or an EXR file.
        meters_per_unit: What one step of an integer image means: 0.001 for millimetres, 1/256 for KITTI. Needed for
            integers, and only for them.

    Returns:
        (H, W) float32 depth in metres. The largest code of an integer image means "out of range" and becomes infinity.

    Raises:
        FileNotFoundError: There is no such file.
        IsADirectoryError: A folder.
        BadFileError: An encoding that is not one of these, a missing or superfluous scale, not one channel, damage, or
            an image that takes more memory than `TORCHCOVER_MAX_FILE_GB` allows.
        ImportError: An EXR file without the optional package `OpenEXR`.
    """
    if path.suffix.lower() not in _READERS:
        raise ValueError(f"a depth image is one of {', '.join(_READERS)}; got {path.suffix!r}")
    values = _READERS[path.suffix.lower()](path)
    if values.ndim == 3 and values.dtype == np.uint8:
        _refuse_scale(meters_per_unit, "CARLA's 24-bit encoding")
        return decode_carla(values, "RGBA" if values.shape[2] == 4 else "RGB")
    _check_shape(values.shape)
    if np.issubdtype(values.dtype, np.floating):
        _refuse_scale(meters_per_unit, f"{values.dtype} metres")
        return torch.from_numpy(values.astype(np.float32))
    return _scaled(values, meters_per_unit)


def _refuse_scale(scale: float | None, encoding: str) -> None:
    if scale is not None:
        raise ValueError(f"holds {encoding}, which takes no meters_per_unit; got {scale}")


def _check_shape(shape: tuple[int, ...]) -> None:
    if len(shape) != 2 or 0 in shape:
        raise ValueError(f"a depth image has shape (H, W); got {shape}")


def _scaled(values: NDArray[Any], scale: float | None) -> Tensor:
    if not np.issubdtype(values.dtype, np.integer):
        raise ValueError(f"depths are integers or floats; got {values.dtype}")
    if scale is None or not 0.0 < scale < np.inf:
        raise ValueError(f"{values.dtype} depth needs meters_per_unit > 0 (0.001 for millimetres); got {scale}")
    metres = values.astype(np.float64) * scale
    metres[values == np.iinfo(values.dtype).max] = np.inf
    return torch.from_numpy(metres.astype(np.float32))


def _read_png(path: Path) -> NDArray[Any]:
    """(H, W, 3 or 4) uint8 or (H, W) uint16; the header decides, because Pillow would narrow 16-bit colour silently."""
    with path.open("rb") as file:
        header = file.read(26)
    known = len(header) == 26 and header.startswith(_PNG_SIGNATURE)
    width, height, bits, colour = struct.unpack(">IIBB", header[16:]) if known else (0, 0, 0, 0)
    if (bits, colour) not in _PNG_BYTES:
        raise ValueError(
            f"a depth PNG is 8-bit RGB or RGBA (CARLA) or 16-bit grey; got {bits} bits, colour type {colour} "
            "(CARLA's logarithmic 8-bit images are for the eye and hold no depth)"
        )
    claimed_bytes, file_bytes = width * height * _PNG_BYTES[bits, colour], path.stat().st_size
    if claimed_bytes > DEFLATE_MAX_RATIO * file_bytes:
        raise ValueError(f"truncated: the header claims {width}x{height} pixels, of which {file_bytes} bytes are not")
    check_memory(width * height * _BYTES_PER_PIXEL)
    return read_png_image(path)["pixels"].astype(np.uint8 if bits == 8 else np.uint16)


def _read_npy(path: Path) -> NDArray[Any]:
    def check(header: NpyHeader) -> None:
        _check_shape(header.shape)
        if header.dtype.kind not in "fiu":
            raise ValueError(f"depths are integers or floats; got {header.dtype}")

    values = read_npy(path, check)
    check_memory(values.size * _BYTES_PER_PIXEL)
    return values


_READERS: dict[str, Callable[[Path], NDArray[Any]]] = {
    ".png": _read_png,
    ".npy": _read_npy,
    ".exr": lambda path: read_exr_image(path, _BYTES_PER_PIXEL)["pixels"],
}


def mask_usable_depths(depth: Tensor, max_depth_m: float) -> Tensor:
    """Which depths can become points: above 0, finite, and at most `max_depth_m`; NaN fails every comparison."""
    return (depth > 0) & (depth <= min(max_depth_m, torch.finfo(depth.dtype).max))


def count_unusable_depths(depth: Tensor, max_depth_m: float) -> dict[str, int]:
    """How many depths `usable` refuses, by reason.

    Returns `depth_zero`, `depth_negative` (with minus infinity), `depth_nan`, `depth_infinite`, `depth_beyond_range`.

    Example:
        >>> count_unusable_depths(torch.tensor([0.0, 2.0, 90.0, torch.inf]), 50.0)["depth_beyond_range"]
        1
    """
    reasons = {
        "depth_zero": depth == 0,
        "depth_negative": depth < 0,
        "depth_nan": torch.isnan(depth),
        "depth_infinite": depth == torch.inf,
        "depth_beyond_range": (depth > max_depth_m) & (depth < torch.inf),
    }
    return {name: int(mask.sum()) for name, mask in reasons.items()}


DepthKind = Literal["z", "distance"]
_KINDS = ("z", "distance")


class PixelSelection(NamedTuple):
    """The pixels of every stride-th row and column: (h, w, 3) points at depth 1, which (h, w) have a ray.

    `mask` and `depth`, (h, w) or (B, h, w), are of one image or a batch; what has a ray and is not masked is
    allowed.
    """

    rays: Tensor
    has_ray: Tensor
    mask: Tensor
    depth: Tensor


def check_depth(
    depth: Tensor, depth_kind: str, stride: int, valid_mask: Tensor | None, size: tuple[int, int], name: str
) -> Tensor:
    """The depth in float32 or float64, once all arguments of `Camera.unproject` are known to fit."""
    if not depth.is_floating_point():
        raise TypeError(
            f"{name}: depth is {depth.dtype}, whose unit is unknown; scale it to metres: depth * 0.001 for mm"
        )
    if depth.ndim not in (2, 3) or tuple(depth.shape[-2:]) != size:
        raise ValueError(f"{name}: depth must be {size} or (B, {size[0]}, {size[1]}); got {tuple(depth.shape)}")
    if depth_kind not in _KINDS:
        raise ValueError(f"{name}: depth kind {depth_kind!r} is unknown; allowed: {', '.join(_KINDS)}")
    if isinstance(stride, bool) or not isinstance(stride, int) or stride < 1:
        raise ValueError(f"{name}: stride must be an integer of at least 1; got {stride!r}")
    if valid_mask is not None:
        _check_mask(valid_mask, depth, size, name)
    return depth if depth.dtype in (torch.float32, torch.float64) else depth.float()


def _check_mask(valid: Tensor, depth: Tensor, size: tuple[int, int], name: str) -> None:
    if valid.dtype != torch.bool:
        raise TypeError(f"{name}: valid must be boolean; got {valid.dtype}")
    if tuple(valid.shape) not in (size, tuple(depth.shape)):
        raise ValueError(f"{name}: valid must be {size} or {tuple(depth.shape)}; got {tuple(valid.shape)}")


def select_pixels(
    rays: Tensor, has_ray: Tensor, depth: Tensor, stride: int, valid_mask: Tensor | None
) -> PixelSelection:
    """Every stride-th row and column of everything."""
    rays, has_ray, depth = rays[::stride, ::stride], has_ray[::stride, ::stride], depth[..., ::stride, ::stride]
    allowed = has_ray if valid_mask is None else has_ray & valid_mask[..., ::stride, ::stride]
    return PixelSelection(rays, has_ray, allowed, depth)


def scale_rays(rays: Tensor, depth: Tensor, mask: Tensor) -> Tensor:
    """Points (N, 3) = ray (h, w, 3) * depth (h, w) where keep (h, w)."""
    if bool(mask.all()):
        return (rays * depth[..., None]).reshape(-1, 3)
    chosen = _indices(mask)
    # index_select copies whole rows; indexing with a tensor goes entry by entry and is several times slower
    return rays.reshape(-1, 3).index_select(0, chosen) * depth.flatten().index_select(0, chosen)[:, None]


def _indices(mask: Tensor) -> Tensor:
    """Flat indices of what is True; on the CPU by numpy, which takes a twentieth of torch's time on two busy cores."""
    if mask.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return mask.flatten().nonzero().squeeze(1)
