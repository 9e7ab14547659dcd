"""Readers of images in a process of their own, as `apart` does it: nothing that loads torch is imported here."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcover.files import check_memory, run_isolated


@run_isolated
def read_exr_image(path: Path, bytes_per_pixel: int) -> dict[str, NDArray[Any]]:
    """(H, W) `pixels` of an EXR image with one channel, each of which may take so much memory."""
    try:
        import OpenEXR  # type: ignore[import-not-found, unused-ignore]
    except ImportError as error:
        raise ImportError(f"{path}: reading EXR needs the package OpenEXR: pip install 'torchcover[exr]'") from error
    # The header alone first: with the pixels, memory is reserved for as many as it claims.
    with OpenEXR.File(str(path), header_only=True) as file:
        headers = [file.header(part) for part in range(len(file.parts))]
        channels = [channel.name for header in headers for channel in header["channels"]]
        if len(channels) != 1:
            raise ValueError(f"a depth EXR has one channel; got {', '.join(channels)[:80] or 'none'}")
        low, high = headers[0]["dataWindow"]
        width, height = (int(last) - int(first) + 1 for first, last in zip(low, high, strict=True))
    check_memory(width * height * bytes_per_pixel)
    with OpenEXR.File(str(path)) as file:
        # It prints what is wrong with the pixels, and leaves them out.
        values = [np.array(channel.pixels) for part in file.parts for channel in part.channels.values()]
    if len(values) != 1 or values[0].shape != (height, width):
        raise ValueError(f"truncated or damaged: {width}x{height} pixels are claimed and cannot be read")
    return {"pixels": values[0]}


@run_isolated
def read_png_image(path: Path) -> dict[str, NDArray[Any]]:
    """Read the `pixels` of a PNG image, whose header was checked before."""
    from PIL import Image

    try:
        with Image.open(path, formats=["PNG"]) as image:
            return {"pixels": np.asarray(image)}
    except (OSError, SyntaxError) as error:  # the latter is Pillow's for chunks that do not hold together
        raise ValueError(f"truncated or damaged: {error}") from error
