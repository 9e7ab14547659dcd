"""Depth images: readers of their encodings, and pixels without a measurement.

Every reader returns meters as float32, with infinity where the sensor hit nothing within its range.
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

DepthKind = Literal["z", "distance"]

# Memory while a depth image is decoded: values as stored and copied, code, float64 and float32 meters.
_BYTES_PER_PIXEL = 32


def decode_carla(image: NDArray[np.uint8], channel_order: str) -> Tensor:
    """Decode the 24-bit depth of CARLA: 1000 m * (R + 256 G + 65536 B) / (2^24 - 1) along the optical axis.

    Args:
        image: (H, W, 3 or 4) uint8 image from the buffer of the simulator or a PNG file.
        channel_order: Meaning of the channels: "BGRA" (carla.Image.raw_data), "RGBA", "BGR" or "RGB" (PNG files).

    Returns:
        (H, W) float32 z depth in meters; infinity at the largest code, where nothing was hit.

    Raises:
        ValueError: The order is unknown, or the image is not uint8 or has other channels.

    Example:
        >>> decode_carla(np.array([[[232, 3, 0], [255, 255, 255]]], dtype=np.uint8), "RGB")
        tensor([[0.0596,    inf]])
    """
    channel_orders = ("BGRA", "RGBA", "BGR", "RGB")
    if channel_order not in channel_orders:
        raise ValueError(f"channel order {channel_order!r} is unknown; allowed: {', '.join(channel_orders)}")
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != len(channel_order):
        raise ValueError(
            f"CARLA depth in order {channel_order!r} is an (H, W, {len(channel_order)}) uint8 image; "
            f"got shape {image.shape}, dtype {image.dtype}"
        )
    code = np.zeros(image.shape[:2], dtype=np.int32)
    for bits, channel in enumerate("RGB"):
        code += image[..., channel_order.index(channel)].astype(np.int32) << 8 * bits
    max_code = 2**24 - 1
    depth_m = code * (1000.0 / max_code)
    depth_m[code == max_code] = np.inf
    return torch.from_numpy(depth_m.astype(np.float32))


@guard_reader("a depth image")
def read_depth(path: Path, *, meters_per_unit: float | None = None) -> Tensor:
    """Read a depth image.

    Args:
        path: A PNG (8-bit RGB or RGBA: encoding of CARLA; 16-bit gray: integers), NPY or EXR file.
        meters_per_unit: Unit of an integer image in meters: 0.001 for millimeters, 1/256 for KITTI. Required for
            integers, and only for them.

    Returns:
        (H, W) float32 depth in meters. The largest code of an integer image means "out of range" and becomes infinity.

    Raises:
        FileNotFoundError: There is no such file.
        IsADirectoryError: A folder.
        BadFileError: Another encoding, a missing or superfluous unit, several channels, damage, or an image that needs
            more memory than `TORCHCOVER_MAX_FILE_GB` allows.
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
        _refuse_scale(meters_per_unit, f"{values.dtype} meters")
        return torch.from_numpy(values.astype(np.float32))
    return _scale_to_meters(values, meters_per_unit)


def _refuse_scale(scale: float | None, encoding: str) -> None:
    if scale is not None:
        raise ValueError(f"holds {encoding}, which takes no meters_per_unit; got {scale}")


def _check_shape(shape: tuple[int, ...]) -> None:
    if len(shape) != 2 or 0 in shape:
        raise ValueError(f"a depth image has shape (H, W); got {shape}")


def _scale_to_meters(values: NDArray[Any], scale: float | None) -> Tensor:
    if not np.issubdtype(values.dtype, np.integer):
        raise ValueError(f"depths are integers or floats; got {values.dtype}")
    if scale is None or not 0.0 < scale < np.inf:
        raise ValueError(f"{values.dtype} depth needs meters_per_unit > 0 (0.001 for millimeters); got {scale}")
    depth_m = values.astype(np.float64) * scale
    depth_m[values == np.iinfo(values.dtype).max] = np.inf
    return torch.from_numpy(depth_m.astype(np.float32))


def _read_png(path: Path) -> NDArray[Any]:
    """Read (H, W, 3 or 4) uint8 or (H, W) uint16; the header decides, since Pillow narrows 16-bit color silently."""
    with path.open("rb") as file:
        header = file.read(26)
    bytes_per_pixel = {(8, 2): 3, (8, 6): 4, (16, 0): 2}  # by bits of a channel and color type
    is_png = len(header) == 26 and header.startswith(b"\x89PNG\r\n\x1a\n")
    width, height, bits, color_type = struct.unpack(">IIBB", header[16:]) if is_png else (0, 0, 0, 0)
    if (bits, color_type) not in bytes_per_pixel:
        raise ValueError(
            f"a depth PNG is 8-bit RGB or RGBA (CARLA) or 16-bit gray; got {bits} bits, color type {color_type} "
            "(the logarithmic 8-bit images of CARLA contain no depth)"
        )
    claimed_bytes, file_bytes = width * height * bytes_per_pixel[bits, color_type], path.stat().st_size
    if claimed_bytes > DEFLATE_MAX_RATIO * file_bytes:
        raise ValueError(f"truncated: the header claims {width}x{height} pixels, too many for {file_bytes} bytes")
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


def _read_exr(path: Path) -> NDArray[Any]:
    return read_exr_image(path, _BYTES_PER_PIXEL)["pixels"]


_READERS: dict[str, Callable[[Path], NDArray[Any]]] = {".png": _read_png, ".npy": _read_npy, ".exr": _read_exr}


def mask_usable_depths(depth: Tensor, max_depth_m: float) -> Tensor:
    """Mark the depths that become points: above 0, finite, and at most the maximum.

    Args:
        depth: Depth in meters, any shape.
        max_depth_m: Largest depth that is a measurement.
    """
    return (depth > 0) & (depth <= min(max_depth_m, torch.finfo(depth.dtype).max))


def count_unusable_depths(depth: Tensor, max_depth_m: float) -> dict[str, int]:
    """Count the depths that do not become points, by reason.

    Args:
        depth: Depth in meters, any shape.
        max_depth_m: Largest depth that is a measurement.

    Returns:
        `depth_zero`, `depth_negative` (with minus infinity), `depth_nan`, `depth_infinite`, `depth_beyond_range`.

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


class PixelSelection(NamedTuple):
    """Pixels of every stride-th row and column of an image or a batch.

    Args:
        rays: (h, w, 3) points at depth 1.
        has_ray: (h, w) bool.
        mask: (h, w) or (B, h, w) bool: has a ray and is not masked by the user.
        depth: (h, w) or (B, h, w) depth in meters.
    """

    rays: Tensor
    has_ray: Tensor
    mask: Tensor
    depth: Tensor


def check_depth(
    depth: Tensor, depth_kind: str, stride: int, valid_mask: Tensor | None, size: tuple[int, int], name: str
) -> Tensor:
    """Check the arguments of `Camera.unproject`.

    Args:
        depth: Depth image or batch.
        depth_kind: "z" or "distance".
        stride: Step between rows and columns.
        valid_mask: Pixels to use, or None.
        size: Height and width of the camera.
        name: Name of the camera for messages.

    Returns:
        The depth in float32 or float64.

    Raises:
        TypeError: The depth is not of floats, or the mask not boolean.
        ValueError: A shape, the kind or the stride is wrong.
    """
    if not depth.is_floating_point():
        raise TypeError(
            f"{name}: depth is {depth.dtype}, whose unit is unknown; scale it to meters: depth * 0.001 for mm"
        )
    if depth.ndim not in (2, 3) or tuple(depth.shape[-2:]) != size:
        raise ValueError(f"{name}: depth must be {size} or (B, {size[0]}, {size[1]}); got {tuple(depth.shape)}")
    if depth_kind not in ("z", "distance"):
        raise ValueError(f"{name}: depth kind {depth_kind!r} is unknown; allowed: z, distance")
    if isinstance(stride, bool) or not isinstance(stride, int) or stride < 1:
        raise ValueError(f"{name}: stride must be an integer of at least 1; got {stride!r}")
    if valid_mask is not None:
        _check_mask(valid_mask, depth, size, name)
    return depth if depth.dtype in (torch.float32, torch.float64) else depth.float()


def _check_mask(valid_mask: Tensor, depth: Tensor, size: tuple[int, int], name: str) -> None:
    if valid_mask.dtype != torch.bool:
        raise TypeError(f"{name}: valid_mask must be boolean; got {valid_mask.dtype}")
    if tuple(valid_mask.shape) not in (size, tuple(depth.shape)):
        raise ValueError(f"{name}: valid_mask must be {size} or {tuple(depth.shape)}; got {tuple(valid_mask.shape)}")


def select_pixels(
    rays: Tensor, has_ray: Tensor, depth: Tensor, stride: int, valid_mask: Tensor | None
) -> PixelSelection:
    """Select every stride-th row and column.

    Args:
        rays: (H, W, 3) points at depth 1.
        has_ray: (H, W) bool.
        depth: (H, W) or (B, H, W) depth in meters.
        stride: Step between rows and columns.
        valid_mask: (H, W) or (B, H, W) bool, or None.
    """
    rays, has_ray, depth = rays[::stride, ::stride], has_ray[::stride, ::stride], depth[..., ::stride, ::stride]
    allowed = has_ray if valid_mask is None else has_ray & valid_mask[..., ::stride, ::stride]
    return PixelSelection(rays, has_ray, allowed, depth)


def scale_rays(rays: Tensor, depth: Tensor, mask: Tensor) -> Tensor:
    """Compute the (N, 3) points of an image.

    Args:
        rays: (h, w, 3) points at depth 1.
        depth: (h, w) depth in meters.
        mask: (h, w) pixels that become points.
    """
    if bool(mask.all()):
        return (rays * depth[..., None]).reshape(-1, 3)
    chosen = _find_true_indices(mask)
    # Indexing with a tensor copies entry by entry, several times slower than `index_select`, which copies rows.
    return rays.reshape(-1, 3).index_select(0, chosen) * depth.flatten().index_select(0, chosen)[:, None]


def _find_true_indices(mask: Tensor) -> Tensor:
    """Find the flat indices of True; numpy takes a twentieth of the time of torch on two busy CPU cores."""
    if mask.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return mask.flatten().nonzero().squeeze(1)
