"""Clouds in plain arrays: KITTI and nuScenes records without a header, `.npy` and `.npz`."""

import string
from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcover.files import NpyHeader, check_memory, guard_reader, read_npy, read_npz, read_npz_headers
from torchcover.geometry.arrays import Float32, Float64, Int64
from torchcover.geometry.rigid import iterate_blocks

Points = NDArray[np.floating]

# float32 does not resolve a centimeter beyond this coordinate, and no sensor has this range.
MAX_COORDINATE_M = 1e5
# A share of points may have x = y = z; in files of another layout the share is larger.
MAX_DIAGONAL_SHARE = 0.1
# First bytes of files in other formats.
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


def check_records(data: bytes, num_columns: int) -> Float32:
    """Check that bytes can be records of little-endian float32 that begin with x y z.

    Args:
        data: Content of a file.
        num_columns: Numbers per point: 4 (KITTI) or 5 (nuScenes).

    Returns:
        (N, num_columns) records.

    Raises:
        ValueError: Bytes are left over, or the numbers cannot be coordinates.
    """
    other_format = next((name for start, name in SIGNATURES.items() if data.startswith(start)), None)
    if other_format is None and not data[:1024].translate(None, string.printable.encode()):
        other_format = "text (.csv or .xyz?)"
    if other_format is not None:
        raise ValueError(
            f"the content is {other_format}, not {num_columns} float32 a point; give it the suffix of its format"
        )
    record_bytes = 4 * num_columns
    if len(data) % record_bytes:
        raise ValueError(
            f"{len(data)} bytes are no whole number of {record_bytes}-byte points ({num_columns} float32 each), "
            f"{len(data) % record_bytes} bytes are left over: truncated, or of another format"
        )
    records = np.frombuffer(data, "<f4").reshape(-1, num_columns)
    if not any(data):
        raise ValueError(f"all of its {len(data)} bytes are zero: it was never written")
    complaint = None if _are_plausible(records) else _describe_bad_points(records[:, :3])
    complaint = complaint or _describe_other_layout(records)
    if complaint:
        suffixes = {4: ".bin (x y z intensity)", 5: ".pcd.bin (x y z intensity ring)"}
        layout = suffixes.pop(num_columns)
        raise ValueError(
            f"{complaint}, so it holds no {layout} of little-endian float32: give it the suffix of its "
            f"format, as {' or '.join(suffixes.values())}, or write its points as .npy (N, 3 or more)"
        )
    return records


def check_trailing_bytes(trailing_bytes: bytes) -> None:
    """Check that only padding (zeros and line ends) follows the points.

    Args:
        trailing_bytes: Bytes after the points that the header claims.

    Raises:
        ValueError: Other bytes follow.
    """
    if trailing_bytes.strip(b"\0\r\n"):
        raise ValueError(
            f"{len(trailing_bytes)} bytes follow the points that the header claims, and they are not all zero"
        )


def _describe_bad_points(points: Float32) -> str | None:
    """Describe why numbers cannot be coordinates; the bits of other types rarely pass."""
    smallest_normal = float(np.finfo(np.float32).tiny)
    max_partly_finite_share = 0.05  # single coordinates are lost at times
    min_points = 16  # fewer points allow no statistics
    magnitude = np.abs(points)
    is_finite = np.isfinite(points)
    is_far = ((magnitude > MAX_COORDINATE_M) & is_finite).any(axis=1)
    is_denormal = ((magnitude > 0) & (magnitude < smallest_normal)).any(axis=1)
    is_partly_finite = is_finite.any(axis=1) & ~is_finite.all(axis=1)
    is_diagonal = (points == points[:, :1]).all(axis=1) & (points[:, 0] != 0)
    total = f"of {len(points)} points"
    if is_far.any():
        first = points[is_far][0].tolist()
        return f"{is_far.sum()} {total} lie beyond {MAX_COORDINATE_M:g} m, the first at {first}"
    if is_denormal.any():
        return f"{is_denormal.sum()} {total} have denormal coordinates, the first {points[is_denormal][0].tolist()}"
    if is_partly_finite.sum() > max_partly_finite_share * len(points):
        return f"{is_partly_finite.sum()} {total} are finite in one coordinate and not in another"
    if len(points) >= min_points and is_diagonal.sum() > MAX_DIAGONAL_SHARE * len(points):
        return f"{is_diagonal.sum()} {total} have x = y = z"
    return None


def _are_plausible(records: Float32) -> bool:
    """Test whether all numbers are plain coordinates, much faster than `_describe_bad_points`."""
    first_normal_bits = np.uint32(0x0080_0000)
    num_diagonal = 0
    for rows in iterate_blocks(len(records)):
        block = records[rows]
        if not (block.max() <= MAX_COORDINATE_M and block.min() >= -MAX_COORDINATE_M):
            return False  # includes NaN
        magnitude_bits = block.view("<u4") & np.uint32(0x7FFF_FFFF)
        if (magnitude_bits - np.uint32(1)).min() < first_normal_bits - 1:  # 0 wraps around to the largest number
            return False
        candidates = block[np.flatnonzero(block[:, 0] == block[:, 1])]
        num_diagonal += int(np.count_nonzero((candidates[:, 0] == candidates[:, 2]) & (candidates[:, 0] != 0)))
    return num_diagonal <= MAX_DIAGONAL_SHARE * len(records)


def _describe_other_layout(records: Float32) -> str | None:
    """Describe why the rows have 4 instead of 5 columns, or the reverse, or another layout."""
    num_columns = records.shape[1]
    numbers = records.ravel()
    if len(records) < 16:  # fewer points allow no statistics
        return None
    if numbers.size % (9 - num_columns):
        return _describe_unknown_layout(records)
    as_four = numbers[: numbers.size // 4 * 4].reshape(-1, 4)
    as_five = numbers[: numbers.size // 5 * 5].reshape(-1, 5)
    if num_columns == 4 and not _are_intensities(as_four[:, 3]) and _are_rings(as_five[:, 4]):
        return "every fourth number is no intensity, and every fifth is a ring"
    if num_columns == 5 and not _are_rings(as_five[:, 4]) and _are_intensities(as_four[:, 3]):
        return "every fifth number is no ring, and every fourth is an intensity"
    return _describe_unknown_layout(records)


def _describe_unknown_layout(records: Float32) -> str | None:
    """Describe why the last column holds coordinates or the rows alternate."""
    if len(records) < 100:  # fewer points allow no statistics
        return None
    last_column = records[:, -1]
    last_name = {4: "an intensity", 5: "a ring"}[records.shape[1]]
    # A column with more than this share of numbers beyond 2 m on both sides of 0 holds coordinates.
    min_far_share, far_m = 0.05, 2.0
    if np.mean(last_column < -far_m) > min_far_share and np.mean(last_column > far_m) > min_far_share:
        return f"its last column is not {last_name} but has coordinates in it"
    if records.shape[1] == 4:  # rows of eight numbers, cut in halves
        negative_shares = []
        for first in (0, 1):
            halves = records[first::2]
            negative_shares.append(min(np.mean(halves[:, 1] < 0), np.mean(halves[:, 2] < 0)))
        if min(negative_shares) == 0 and max(negative_shares) > min_far_share:
            return "every second point has no negative y or z, and the others have"
    return None


def _are_intensities(values: Float32) -> bool:
    """Test whether all values lie in [0, 255]."""
    return bool(((values >= 0) & (values <= 255)).all())


def _are_rings(values: Float32) -> bool:
    """Test whether all values are integers in [0, 255]."""
    return bool(((values >= 0) & (values <= 255) & (values == np.round(values))).all())


def read_float32_cloud(path: Path, num_columns: int) -> Points:
    """Read rows of little-endian float32 without a header.

    Args:
        path: File.
        num_columns: Numbers per point: 4 (KITTI) or 5 (nuScenes), x y z first.

    Returns:
        (N, 3) points.

    Raises:
        ValueError: The numbers cannot be coordinates.
    """
    size_bytes = path.stat().st_size
    check_memory(2 * size_bytes)
    return check_records(path.read_bytes(), num_columns)[:, :3]


@guard_reader("a point cloud with rings")
def read_cloud_with_rings(path: Path) -> tuple[Points, Int64]:
    """Read rows x y z intensity ring of nuScenes.

    Args:
        path: File of float32 without a header.

    Returns:
        (N, 3) points and (N,) rings.

    Raises:
        BadFileError: The numbers cannot be coordinates.
    """
    check_memory(2 * path.stat().st_size)
    records = check_records(path.read_bytes(), 5)
    return records[:, :3], np.nan_to_num(records[:, 4]).astype(np.int64)


def read_npy_cloud(path: Path) -> Points:
    """Read a `.npy` file of shape (N, 3) or wider, x y z first.

    Args:
        path: File.

    Returns:
        (N, 3) points.
    """
    return _extract_coordinates(read_npy(path, _check_cloud_header))


def read_npz_cloud(path: Path) -> Points:
    """Read the array `points` of a `.npz` file, or the only array, or the only one of shape (N, 3).

    Args:
        path: File.

    Returns:
        (N, 3) points.
    """
    (points,) = read_npz(path, _check_cloud_header, partial(_choose_array, path)).values()
    return _extract_coordinates(points)


@guard_reader("a point cloud with weights")
def read_cloud_with_weights(path: Path) -> tuple[Points, Float64]:
    """Read a cloud with area weights: the arrays `points` and `weights` of a `.npz`.

    Args:
        path: File.

    Returns:
        (N, 3) points and (N,) float64 weights.

    Raises:
        FileNotFoundError: The file does not exist.
        BadFileError: Arrays are missing or differ in length, or a weight is not positive and finite.
    """
    if path.suffix.lower() != ".npz":
        raise ValueError("weights need a .npz with the arrays points and weights")
    (points,) = read_npz(path, _check_cloud_header, partial(_require_array, "points")).values()
    (weights,) = read_npz(path, partial(_check_values_header, "weights"), partial(_require_array, "weights")).values()
    if len(points) != len(weights):
        raise ValueError(f"one weight for each point is needed; got {len(weights)} for {len(points)}")
    bad = int((~(np.isfinite(weights) & (weights > 0))).sum())
    if bad:
        raise ValueError(f"weights have to be positive and finite; {bad} of {len(weights)} are not")
    return _extract_coordinates(points), weights.astype(np.float64)


@guard_reader("a point cloud with heights")
def read_heights(path: Path, num_points: int) -> Float32 | None:
    """Read the heights of a cloud above the local ground: the array `heights_m` of a `.npz`.

    Args:
        path: File of the cloud.
        num_points: Number of points of the cloud.

    Returns:
        (N,) heights in meters, NaN where there is no ground; None if the file has none.

    Raises:
        BadFileError: The number of heights is wrong, or some are infinite.
    """
    if path.suffix.lower() != ".npz" or "heights_m" not in read_npz_headers(path):
        return None
    check_header = partial(_check_values_header, "heights_m")
    (heights_m,) = read_npz(path, check_header, partial(_require_array, "heights_m")).values()
    if len(heights_m) != num_points:
        raise ValueError(f"one of heights_m for each point is needed; got {len(heights_m)} for {num_points}")
    bad = int(np.isinf(heights_m).sum())
    if bad:
        raise ValueError(
            f"heights_m: meters are needed, NaN where there is no ground; {bad} of {num_points} are infinite"
        )
    return heights_m.astype(np.float32)


def _extract_coordinates(points: Points) -> Points:
    """Extract x, y and z; float16 becomes float32."""
    xyz = points[:, :3]
    return xyz.astype(np.float32) if xyz.dtype.itemsize < np.dtype(np.float32).itemsize else xyz


def _require_array(name: str, names: Collection[str]) -> Collection[str]:
    """Choose an array that has to exist."""
    if name not in names:
        raise ValueError(f"the arrays points and weights are needed; got {_format_names(names)}")
    return (name,)


def _choose_array(path: Path, names: Collection[str]) -> Collection[str]:
    """Choose the array of points: `points`, else the only array, else the only one of shape (N, 3)."""
    if "points" in names:
        return ("points",)
    if len(names) == 1:
        return names
    candidates = []
    for name, (shape, dtype) in read_npz_headers(path).items():
        if shape[1:] == (3,) and _is_float(dtype):
            candidates.append(name)
    if len(candidates) != 1:
        raise ValueError(
            f"an array called points, a single array, or a single one of shape (N, 3) is needed; got {len(names)} "
            f"arrays: {_format_names(names)}"
        )
    return candidates


def _format_names(names: Collection[str]) -> str:
    """Format up to ten names for a message."""
    return ", ".join(sorted(names)[:10]) or "none"


def _is_float(dtype: np.dtype[Any]) -> bool:
    """Test for float16, float32 and float64 in any byte order."""
    return dtype.newbyteorder("=") in (np.float16, np.float32, np.float64)


def _check_cloud_header(header: NpyHeader) -> None:
    """Check that an array is floating point of shape (N, 3) or slightly wider."""
    max_columns = 16  # a transposed (3, N) cloud must not pass for 3 points with N columns
    shape, dtype = header
    if not _is_float(dtype):
        raise ValueError(f"an array of float16, float32 or float64 is needed; got {dtype}")
    if len(shape) != 2 or not 3 <= shape[1] <= max_columns:
        raise ValueError(f"shape (N, 3), or up to (N, {max_columns}) with x y z first, is needed; got {shape}")


def _check_values_header(name: str, header: NpyHeader) -> None:
    """Check that an array is floating point of shape (N,)."""
    shape, dtype = header
    if not _is_float(dtype) or len(shape) != 1:
        raise ValueError(f"{name}: shape (N,) of float16, float32 or float64 is needed; got {shape} of {dtype}")
