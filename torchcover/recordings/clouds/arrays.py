"""Clouds that are bare arrays: KITTI and nuScenes records, which no header describes, `.npy`, `.npz`."""

import string
from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcover.files import NpyHeader, check_memory, guard_reader, read_npy, read_npz, read_npz_headers
from torchcover.geometry.rigid import iterate_blocks

# Beyond, float32 does not resolve a centimetre; no sensor reaches as far.
MAX_COORDINATE_M = 1e5
SMALLEST_NORMAL = float(np.finfo(np.float32).tiny)
FIRST_NORMAL = np.uint32(0x0080_0000)  # its bits
# Largest shares of points in a cloud. A few coordinates are lost alone, and a few points lie on the diagonal.
MAX_PARTLY_FINITE = 0.05
MAX_DIAGONAL = 0.1
# Fewer points are no statistics.
MIN_POINTS = 16
MIN_STATISTICS = 100
MAX_INTENSITY, MAX_RING = 255, 255
# A column in which more than a share lies this far on either side of 0 holds coordinates.
FAR_M, MIN_FAR = 2.0, 0.05
PRINTABLE = string.printable.encode()
SIGNATURES = {
    b"\x93NUMPY": "a .npy",
    b"PK\x03\x04": "a .npz (or another ZIP archive)",
    b"ply\n": "a .ply",
    b"ply\r": "a .ply",
    b"# .PCD": "a .pcd",
    b"VERSION": "a .pcd",
    b"LASF": "a LAS file",
    b"\x89PNG": "a PNG image",
    b"\x1f\x8b": "a gzip file",
}
# Layouts with a suffix of their own, by their number of columns.
SUFFIXES = {4: ".bin (x y z intensity)", 5: ".pcd.bin (x y z intensity ring)"}


def check_records(data: bytes, num_columns: int) -> NDArray[np.float32]:
    """(N, columns) little-endian float32, x y z first, if the bytes may be such.

    ValueError: bytes are left over, or the numbers are no coordinates.
    """
    known = next((name for start, name in SIGNATURES.items() if data.startswith(start)), None)
    if known is None and all(byte in PRINTABLE for byte in data[:1024]):
        known = "text (.csv or .xyz?)"
    if known is not None:
        raise ValueError(f"the content is {known}, not {num_columns} float32 a point; give it the suffix of its format")
    record_bytes = 4 * num_columns
    if len(data) % record_bytes:
        raise ValueError(
            f"{len(data)} bytes are no whole number of {record_bytes}-byte points ({num_columns} float32 each), "
            f"{len(data) % record_bytes} bytes are left over: truncated, or of another format"
        )
    records = np.frombuffer(data, "<f4").reshape(-1, num_columns)
    if not any(data):
        raise ValueError(f"all of its {len(data)} bytes are zero: it was never written")
    coordinates = _plainly_coordinates(records)
    complaint = (None if coordinates else _complaint(records[:, :3])) or _of_other_columns(records)
    if complaint:
        others = " or ".join(suffix for width, suffix in SUFFIXES.items() if width != num_columns)
        raise ValueError(
            f"{complaint}, so it holds no {SUFFIXES[num_columns]} of little-endian float32: give it the suffix of its "
            f"format, as {others}, or write its points as .npy (N, 3 or more)"
        )
    return records


def check_trailing_bytes(trailing_bytes: bytes) -> None:
    """Refuse bytes behind the points that no header speaks of; zeros and line ends are padding."""
    if trailing_bytes.strip(b"\0\r\n"):
        raise ValueError(
            f"{len(trailing_bytes)} bytes follow the points that the header claims, and they are not all zero"
        )


def _complaint(points: NDArray[np.float32]) -> str | None:
    """Why numbers cannot be coordinates, as the bits of other types are not."""
    size = np.abs(points)
    finite = np.isfinite(points)
    whole = finite.all(axis=1)
    far = ((size > MAX_COORDINATE_M) & finite).any(axis=1)
    denormal = ((size > 0) & (size < SMALLEST_NORMAL)).any(axis=1)
    partly = finite.any(axis=1) & ~whole
    diagonal = (points == points[:, :1]).all(axis=1) & (points[:, 0] != 0)
    of_all = f"of {len(points)} points"
    if far.any():
        return f"{far.sum()} {of_all} lie beyond {MAX_COORDINATE_M:g} m, the first at {points[far][0].tolist()}"
    if denormal.any():
        return f"{denormal.sum()} {of_all} have denormal coordinates, the first {points[denormal][0].tolist()}"
    if partly.sum() > MAX_PARTLY_FINITE * len(points):
        return f"{partly.sum()} {of_all} are finite in one coordinate and not in another"
    if len(points) >= MIN_POINTS and diagonal.sum() > MAX_DIAGONAL * len(points):
        return f"{diagonal.sum()} {of_all} have x = y = z"
    return None


def _plainly_coordinates(records: NDArray[np.float32]) -> bool:
    """Whether there is nothing to complain of; in a fraction of the time, for numbers are looked at side by side."""
    diagonal = 0
    for rows in iterate_blocks(len(records)):
        part = records[rows]
        if not (part.max() <= MAX_COORDINATE_M and part.min() >= -MAX_COORDINATE_M):
            return False  # NaN is neither
        magnitude = part.view("<u4") & np.uint32(0x7FFF_FFFF)
        if (magnitude - np.uint32(1)).min() < FIRST_NORMAL - 1:  # 0 becomes the largest
            return False
        alike = part[np.flatnonzero(part[:, 0] == part[:, 1])]
        diagonal += int(np.count_nonzero((alike[:, 0] == alike[:, 2]) & (alike[:, 0] != 0)))
    return diagonal <= MAX_DIAGONAL * len(records)


def _of_other_columns(records: NDArray[np.float32]) -> str | None:
    """Why the rows have another number of columns; only where they lack what theirs would have."""
    columns = records.shape[1]
    numbers = records.ravel()
    if len(records) < MIN_POINTS:
        return None
    if numbers.size % (9 - columns):
        return _of_unknown_columns(records)
    as_four, as_five = (numbers[: numbers.size // width * width].reshape(-1, width) for width in (4, 5))
    if columns == 4 and not _is_intensity(as_four[:, 3]) and _is_ring(as_five[:, 4]):
        return "every fourth number is no intensity, and every fifth is a ring"
    if columns == 5 and not _is_ring(as_five[:, 4]) and _is_intensity(as_four[:, 3]):
        return "every fifth number is no ring, and every fourth is an intensity"
    return _of_unknown_columns(records)


def _of_unknown_columns(records: NDArray[np.float32]) -> str | None:
    """Why the rows are of columns that no suffix stands for."""
    last, name = records[:, -1], {4: "an intensity", 5: "a ring"}[records.shape[1]]
    if len(records) < MIN_STATISTICS:
        return None
    if _share(last < -FAR_M) > MIN_FAR and _share(last > FAR_M) > MIN_FAR:
        return f"its last column is not {name} but has coordinates in it"
    if records.shape[1] == 4:  # rows of eight, cut in halves
        signs = [min(_share(records[side::2, axis] < 0) for axis in (1, 2)) for side in (0, 1)]
        if min(signs) == 0 and max(signs) > MIN_FAR:
            return "every second point has no negative y or z, and the others have"
    return None


def _share(which: NDArray[np.bool_]) -> float:
    return np.count_nonzero(which) / len(which)


def _is_intensity(values: NDArray[np.float32]) -> bool:
    return bool(((values >= 0) & (values <= MAX_INTENSITY)).all())


def _is_ring(values: NDArray[np.float32]) -> bool:
    return bool(((values >= 0) & (values <= MAX_RING) & (values == np.round(values))).all())


Points = NDArray[np.floating]

# x, y, z and whatever else a sensor reports. A transposed (3, N) cloud must not pass for 3 points with N columns.
MAX_COLUMNS = 16


def read_float32_cloud(path: Path, num_columns: int) -> Points:
    """Read rows of little-endian float32 without a header, x y z first."""
    size_bytes = path.stat().st_size
    check_memory(2 * size_bytes)
    return check_records(path.read_bytes(), num_columns)[:, :3]


@guard_reader("a point cloud with rings")
def read_cloud_with_rings(path: Path) -> tuple[Points, NDArray[np.int64]]:
    """(N, 3) points and (N,) rings of rows x y z intensity ring, as those of nuScenes."""
    check_memory(2 * path.stat().st_size)
    records = check_records(path.read_bytes(), 5)
    return records[:, :3], np.nan_to_num(records[:, 4]).astype(np.int64)


def read_npy_cloud(path: Path) -> Points:
    """Read a `.npy` file of shape (N, 3) or wider, x y z first."""
    return _coordinates(read_npy(path, _check))


def read_npz_cloud(path: Path) -> Points:
    """Read the array `points` of a `.npz` file, or the only array, or the only one of shape (N, 3)."""
    (points,) = read_npz(path, _check, partial(_choose, path)).values()
    return _coordinates(points)


@guard_reader("a point cloud with weights")
def read_cloud_with_weights(path: Path) -> tuple[Points, NDArray[np.float64]]:
    """Read a cloud and what each of its points counts for: the arrays `points` and `weights` of a `.npz`.

    Returns (N, 3) points, and (N,) float64 weights. FileNotFoundError: there is no such file. BadFileError: not such a
    file; a weight that is not positive and finite, or another number of them.
    """
    if path.suffix.lower() != ".npz":
        raise ValueError("weights are read from a .npz with the arrays points and weights only")
    (points,) = read_npz(path, _check, partial(_only, "points")).values()
    (weights,) = read_npz(path, partial(_check_values, "weights"), partial(_only, "weights")).values()
    if len(points) != len(weights):
        raise ValueError(f"one weight for each point is needed; got {len(weights)} for {len(points)}")
    bad = int((~(np.isfinite(weights) & (weights > 0))).sum())
    if bad:
        raise ValueError(f"weights have to be positive and finite; {bad} of {len(weights)} are not")
    return _coordinates(points), weights.astype(np.float64)


@guard_reader("a point cloud with heights")
def read_heights(path: Path, num_points: int) -> NDArray[np.float32] | None:
    """Read how high above the local ground the points of a cloud are: the array `heights_m` of a `.npz`.

    Returns (N,) metres, NaN where there is no ground at or below; None if the file does not say. BadFileError: another
    number of them, or infinite ones.
    """
    if path.suffix.lower() != ".npz" or "heights_m" not in read_npz_headers(path):
        return None
    (heights_m,) = read_npz(path, partial(_check_values, "heights_m"), partial(_only, "heights_m")).values()
    if len(heights_m) != num_points:
        raise ValueError(f"one of heights_m for each point is needed; got {len(heights_m)} for {num_points}")
    bad = int(np.isinf(heights_m).sum())
    if bad:
        raise ValueError(
            f"heights_m: metres are needed, NaN where there is no ground; {bad} of {num_points} are infinite"
        )
    return heights_m.astype(np.float32)


def _coordinates(points: NDArray[np.floating]) -> Points:
    xyz = points[:, :3]
    return xyz.astype(np.float32) if xyz.dtype.itemsize < np.dtype(np.float32).itemsize else xyz


def _only(wanted: str, names: Collection[str]) -> Collection[str]:
    if wanted not in names:
        raise ValueError(f"the arrays points and weights are needed; got {_listed(names)}")
    return (wanted,)


def _choose(path: Path, names: Collection[str]) -> Collection[str]:
    if "points" in names:
        return ("points",)
    if len(names) == 1:
        return names
    fit = [name for name, (shape, dtype) in read_npz_headers(path).items() if shape[1:] == (3,) and _is_float(dtype)]
    if len(fit) != 1:
        raise ValueError(
            f"an array called points, a single array, or a single one of shape (N, 3) is needed; got {len(names)} "
            f"arrays: {_listed(names)}"
        )
    return fit


def _listed(names: Collection[str]) -> str:
    return ", ".join(sorted(names)[:10]) or "none"


def _is_float(dtype: np.dtype[Any]) -> bool:
    return dtype.newbyteorder("=") in (np.float16, np.float32, np.float64)


def _check(header: NpyHeader) -> None:
    shape, dtype = header
    if not _is_float(dtype):
        raise ValueError(f"an array of float16, float32 or float64 is needed; got {dtype}")
    if len(shape) != 2 or not 3 <= shape[1] <= MAX_COLUMNS:
        raise ValueError(f"shape (N, 3), or up to (N, {MAX_COLUMNS}) with x y z first, is needed; got {shape}")


def _check_values(name: str, header: NpyHeader) -> None:
    shape, dtype = header
    if not _is_float(dtype) or len(shape) != 1:
        raise ValueError(f"{name}: shape (N,) of float16, float32 or float64 is needed; got {shape} of {dtype}")
