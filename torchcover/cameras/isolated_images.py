"""Readers of images for isolated processes, see `run_isolated`; nothing that loads torch is imported here."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcover.files import check_memory, run_isolated


@run_isolated
def read_exr_image(path: Path, bytes_per_pixel: int) -> dict[str, NDArray[Any]]:
    """Read the pixels of an EXR image with one channel.

    Args:
        path: The file.
        bytes_per_pixel: Memory that each pixel needs later.

    Returns:
        `pixels`: (H, W) values.

    Raises:
        ImportError: OpenEXR is not installed.
        ValueError: Several channels, damage, or too many pixels for the memory limit.
    """
    try:
        import OpenEXR  # type: ignore[import-not-found, unused-ignore]
    except ImportError as error:
        raise ImportError(f"{path}: reading EXR needs the package OpenEXR: pip install 'torchcover[exr]'") from error
    # The header is read first, because reading pixels reserves memory for as many as it claims.
    with OpenEXR.File(str(path), header_only=True) as file:
        headers = [file.header(part) for part in range(len(file.parts))]
        channels = [channel.name for header in headers for channel in header["channels"]]
        if len(channels) != 1:
            raise ValueError(f"a depth EXR has one channel; got {', '.join(channels)[:80] or 'none'}")
        low, high = headers[0]["dataWindow"]
        width, height = (int(last) - int(first) + 1 for first, last in zip(low, high, strict=True))
    check_memory(width * height * bytes_per_pixel)
    with OpenEXR.File(str(path)) as file:
        # OpenEXR prints errors of pixels and skips the channel.
        values = [np.array(channel.pixels) for part in file.parts for channel in part.channels.values()]
    if len(values) != 1 or values[0].shape != (height, width):
        raise ValueError(f"truncated or damaged: the header claims {width}x{height} pixels that cannot be read")
    return {"pixels": values[0]}


@run_isolated
def read_png_image(path: Path) -> dict[str, NDArray[Any]]:
    """Read the pixels of a PNG image whose header was checked before.

    Args:
        path: The file.

    Returns:
        `pixels`: (H, W) or (H, W, channels) values.

    Raises:
        ValueError: The file is damaged.
    """
    from PIL import Image

    try:
        with Image.open(path, formats=["PNG"]) as image:
            return {"pixels": np.asarray(image)}
    except (OSError, SyntaxError) as error:  # Pillow raises the latter for inconsistent chunks
        raise ValueError(f"truncated or damaged: {error}") from error
