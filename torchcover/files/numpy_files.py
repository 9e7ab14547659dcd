"""NumPy's `.npy` and `.npz`, without trust in what their headers claim."""

import math
import warnings
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.files.bad_file import check_memory

# Deflate spends at least 2 bits on 258 bytes.
DEFLATE_MAX_RATIO = 1032
# How often its compressed size a member can have.
MAX_RATIOS = {zipfile.ZIP_STORED: 1, zipfile.ZIP_DEFLATED: DEFLATE_MAX_RATIO}
_HEADER_READERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


class NpyHeader(NamedTuple):
    """What a `.npy` says about its array. `dtype`: of its elements, never Python objects."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]


def check_kind(kinds: str, header: NpyHeader) -> None:
    """Raise unless an array is of one of these kinds, by their letters in `numpy.dtype.kind`."""
    if header.dtype.kind not in kinds:
        raise ValueError(f"an array of {header.dtype}")


def read_npy(path: Path, check: Callable[[NpyHeader], None]) -> NDArray[Any]:
    """Read a `.npy`.

    `check`: called with the header, before memory is reserved; raises ValueError if it is not what is needed. Returns
    the array. ValueError: not such a file, Python objects, an array of another size than the file, or too large a one.
    """
    return _load(lambda: path.open("rb"), path.stat().st_size, check)


def read_npz(
    path: Path,
    check: Callable[[NpyHeader], None],
    choose: Callable[[Collection[str]], Collection[str]] = lambda names: names,
) -> dict[str, NDArray[Any]]:
    """Read arrays of a `.npz` by name, compressed or not; those that `choose` returns of all names, else all.

    `check` gets each header before memory is reserved, and raises ValueError if it is not what is needed. ValueError:
    not such an archive, a damaged one, or one that grows beyond what a file may take.
    """
    # zipfile raises, beside its own: RuntimeError (encrypted), NotImplementedError (a compression it lacks),
    # zlib.error, EOFError, OSError on offsets that lead out of the file.
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            if len(members) < len(archive.infolist()):
                raise ValueError("two arrays of one name")
            wanted = {name: members[name] for name in choose(members)}
            for member in wanted.values():
                _check_growth(member)
            check_memory(sum(member.file_size for member in wanted.values()))
            return {
                name: _load(partial(archive.open, member), member.file_size, check) for name, member in wanted.items()
            }
    except (ValueError, MemoryError):
        raise
    except Exception as error:
        # A damaged name may be as long as the rest of the archive.
        raise ValueError(f"not a readable .npz archive ({str(error)[:100]})") from error


def npz_headers(path: Path) -> dict[str, NpyHeader]:
    """What the arrays of a `.npz` are, unread; members that are no arrays are left out.

    ValueError: not such an archive, or a damaged one.
    """
    found = {}
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            _check_growth(member)
            with archive.open(member) as stream, suppress(ValueError):
                found[member.filename.removesuffix(".npy")] = _npy_header(stream)
    return found


def write_npz(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays to a compressed `.npz`, as NumPy reads it.

    `arrays`: by their names; no Python objects. ValueError: an array of Python objects.
    """
    # `numpy.savez_compressed` knows the slow default only, which takes twice as long for an eighth less.
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)


def _check_growth(member: zipfile.ZipInfo) -> None:
    if member.compress_type not in MAX_RATIOS:  # Python decompresses megabytes of these at once, without a bound
        raise ValueError(f"{member.filename} is compressed otherwise than NumPy does it; use numpy.savez_compressed")
    largest_bytes = MAX_RATIOS[member.compress_type] * member.compress_size
    if member.file_size > largest_bytes:
        raise ValueError(
            f"{member.filename} claims {member.file_size} bytes out of {member.compress_size} compressed ones; "
            f"at most {largest_bytes} are possible"
        )


def _load(open_stream: Callable[[], IO[bytes]], size_bytes: int, check: Callable[[NpyHeader], None]) -> NDArray[Any]:
    with open_stream() as stream:
        header = _npy_header(stream)
        data_bytes = size_bytes - stream.tell()
    if header.dtype.hasobject:
        raise ValueError("an array of numbers is needed; got pickled Python objects")
    check(header)
    # Before NumPy sees it: it reserves memory for whatever shape the header claims.
    shape, dtype = header
    claimed_bytes = math.prod(shape) * dtype.itemsize
    if claimed_bytes != data_bytes:
        raise ValueError(f"the header claims {shape} {dtype} = {claimed_bytes} bytes; {data_bytes} bytes follow it")
    check_memory(2 * claimed_bytes)  # whoever takes some columns copies them
    with open_stream() as stream, _quiet():
        array: NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
    return array


def _npy_header(stream: IO[bytes]) -> NpyHeader:
    # The header is a Python literal: NumPy, the parser and the tokenizer each fail with exceptions of their own.
    try:
        version = np.lib.format.read_magic(stream)
        if version not in _HEADER_READERS:
            raise ValueError(f"version {version[0]}.{version[1]} of the format")
        with _quiet():
            shape, _, dtype = _HEADER_READERS[version](stream)
    except Exception as error:
        raise ValueError(f"not a readable .npy header ({error})") from error
    return NpyHeader(shape, dtype)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence NumPy on headers that Python 2 wrote (they read well) and Python on doubtful literals in them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
