"""Clouds that are bare arrays: KITTI and nuScenes records, `.npy`, `.npz`."""

import math
import warnings
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.floating]

# x, y, z and whatever else a sensor reports. A transposed (3, N) cloud must not pass for 3 points with N columns.
MAX_COLUMNS = 16
# Deflate spends at least 2 bits on 258 bytes, so a member that claims to grow more than this is lying.
DEFLATE_MAX_RATIO = 1032
_HEADER_READERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def read_records(path: Path, columns: int) -> Points:
    """Read rows of little-endian float32 without a header, x y z first."""
    record_bytes = 4 * columns
    size_bytes = path.stat().st_size
    if size_bytes % record_bytes:
        raise ValueError(
            f"{size_bytes} bytes are no whole number of {record_bytes}-byte points ({columns} float32 each), "
            f"{size_bytes % record_bytes} bytes are left over: truncated, or another format"
        )
    return np.fromfile(path, dtype="<f4").reshape(-1, columns)[:, :3]


def read_npy(path: Path) -> Points:
    """Read a `.npy` file of shape (N, 3) or wider, x y z first."""
    return _load(lambda: path.open("rb"), path.stat().st_size)


def read_npz(path: Path) -> Points:
    """Read the array `points`, or the only array, of a `.npz` file."""
    # zipfile raises, beside its own: RuntimeError (encrypted), NotImplementedError (a compression it lacks),
    # zlib.error, EOFError, OSError on offsets that lead out of the file.
    try:
        with zipfile.ZipFile(path) as archive:
            member = _member(archive)
            if member.file_size > DEFLATE_MAX_RATIO * member.compress_size:
                raise ValueError(
                    f"{member.filename} claims {member.file_size} bytes out of {member.compress_size} compressed "
                    f"ones; at most {DEFLATE_MAX_RATIO} times as many are possible"
                )
            return _load(lambda: archive.open(member), member.file_size)
    except ValueError:
        raise
    except Exception as error:
        raise ValueError(f"not a readable .npz archive ({error})") from error


def _member(archive: zipfile.ZipFile) -> zipfile.ZipInfo:
    members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
    if "points" in members:
        return members["points"]
    if len(members) == 1:
        return next(iter(members.values()))
    names = ", ".join(sorted(members)[:10]) or "none"
    raise ValueError(f"an array called points, or a single array, is needed; got {len(members)} arrays: {names}")


def _load(open_stream: Callable[[], IO[bytes]], size_bytes: int) -> Points:
    with open_stream() as stream:
        shape, dtype = _npy_header(stream)
        data_bytes = size_bytes - stream.tell()
    if dtype.newbyteorder("=") not in (np.float32, np.float64):
        kind = "pickled Python objects" if dtype.hasobject else str(dtype)
        raise ValueError(f"an array of float32 or float64 is needed; got {kind}")
    if len(shape) != 2 or not 3 <= shape[1] <= MAX_COLUMNS:
        raise ValueError(f"shape (N, 3), or up to (N, {MAX_COLUMNS}) with x y z first, is needed; got {shape}")
    # Before NumPy sees it: it reserves memory for whatever shape the header claims.
    claimed_bytes = math.prod(shape) * dtype.itemsize
    if claimed_bytes != data_bytes:
        raise ValueError(f"the header claims {shape} {dtype} = {claimed_bytes} bytes; {data_bytes} bytes follow it")
    with open_stream() as stream, _quiet():
        array: Points = np.lib.format.read_array(stream, allow_pickle=False)
    return array[:, :3]


def _npy_header(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[np.generic]]:
    # The header is a Python literal: NumPy, the parser and the tokenizer each fail with exceptions of their own.
    try:
        version = np.lib.format.read_magic(stream)
        with _quiet():
            shape, _, dtype = _HEADER_READERS[version](stream)
    except Exception as error:
        raise ValueError(f"not a readable .npy header ({error})") from error
    return shape, dtype


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence NumPy on headers that Python 2 wrote (they read well) and Python on doubtful literals in them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
