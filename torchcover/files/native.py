"""What libraries that are not Python read, in a process of their own; see `apart`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcover.files.bad_file import check_memory, reads
from torchcover.files.own_process import apart


@reads("a feather table")
@apart
def read_feather(path: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Read columns of a feather table.

    Returns name -> numbers, or text. BadFileError: no such table, a column that is missing or has holes, or no rows.
    ImportError: pyarrow is not installed.
    """
    try:
        from pyarrow import feather
    except ImportError as error:
        raise ImportError(f"{path}: a feather table needs pyarrow: pip install 'torchcover[av2]'") from error
    check_memory(4 * path.stat().st_size)
    table = feather.read_table(path)
    table.validate(full=True)  # pyarrow believes the lengths and places in the file, and reads there
    missing = [name for name in names if name not in table.column_names]
    if missing:
        raise ValueError(f"the columns {', '.join(names)} are needed; {', '.join(missing)} are missing")
    if table.num_rows == 0:
        raise ValueError("a table without rows")
    holes = [name for name in names if table.column(name).null_count]
    if holes:
        raise ValueError(f"the columns {', '.join(holes)} have holes")
    return {name: table.column(name).to_numpy() for name in names}


@apart
def exr_image(path: Path, bytes_per_pixel: int) -> dict[str, NDArray[Any]]:
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


@apart
def laz_points(path: Path, points: int) -> dict[str, NDArray[Any]]:
    """(N, 3) int32 `xyz` as they are written in a LAZ file, of so many points."""
    try:
        import laspy
        import lazrs  # noqa: F401  (which laspy decompresses with)
    except ImportError as error:
        raise ImportError(f"{path}: LAZ needs laspy: pip install 'torchcover[las]'") from error
    with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False) as reader:
        found = reader.read_points(points)
    if len(found) != points:
        raise ValueError(f"the header claims {points} points; {len(found)} are there")
    return {"xyz": np.column_stack([found.X, found.Y, found.Z])}


@apart
def png_image(path: Path) -> dict[str, NDArray[Any]]:
    """Read the `pixels` of a PNG image, whose header was checked before."""
    from PIL import Image

    try:
        with Image.open(path, formats=["PNG"]) as image:
            return {"pixels": np.asarray(image)}
    except (OSError, SyntaxError) as error:  # the latter is Pillow's for chunks that do not hold together
        raise ValueError(f"truncated or damaged: {error}") from error


@apart
def lzf_block(path: Path, start: int, compressed_bytes: int, plain_bytes: int) -> dict[str, NDArray[Any]]:
    """Decompress the block of a file that begins at the byte `start`, into `plain` (plain_bytes,) uint8."""
    import lzf

    with path.open("rb") as file:
        file.seek(start)
        plain = lzf.decompress(file.read(compressed_bytes), plain_bytes)
    if plain is None or len(plain) != plain_bytes:
        raise ValueError(f"the compressed block does not grow to the {plain_bytes} bytes that it claims")
    return {"plain": np.frombuffer(plain, np.uint8)}
