"""Clouds that are bare arrays: KITTI and nuScenes records, `.npy`, `.npz`."""

from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcover.files import NpyHeader, check_memory, npz_headers, read_npy, read_npz, reads
from torchcover.recordings.clouds.binary import check_records

Points = NDArray[np.floating]

# x, y, z and whatever else a sensor reports. A transposed (3, N) cloud must not pass for 3 points with N columns.
MAX_COLUMNS = 16


def read_records(path: Path, columns: int) -> Points:
    """Read rows of little-endian float32 without a header, x y z first."""
    size_bytes = path.stat().st_size
    check_memory(2 * size_bytes)
    return check_records(path.read_bytes(), columns)[:, :3]


@reads("a point cloud with rings")
def read_ringed_cloud(path: Path) -> tuple[Points, NDArray[np.int64]]:
    """(N, 3) points and (N,) rings of rows x y z intensity ring, as those of nuScenes."""
    check_memory(2 * path.stat().st_size)
    records = check_records(path.read_bytes(), 5)
    return records[:, :3], np.nan_to_num(records[:, 4]).astype(np.int64)


def read_array(path: Path) -> Points:
    """Read a `.npy` file of shape (N, 3) or wider, x y z first."""
    return _coordinates(read_npy(path, _check))


def read_archive(path: Path) -> Points:
    """Read the array `points` of a `.npz` file, or the only array, or the only one of shape (N, 3)."""
    (points,) = read_npz(path, _check, partial(_choose, path)).values()
    return _coordinates(points)


@reads("a point cloud with weights")
def read_weighted_cloud(path: Path) -> tuple[Points, NDArray[np.float64]]:
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


@reads("a point cloud with heights")
def read_heights(path: Path, count: int) -> NDArray[np.float32] | None:
    """Read how high above the local ground the points of a cloud are: the array `heights_m` of a `.npz`.

    Returns (N,) metres, NaN where there is no ground at or below; None if the file does not say. BadFileError: another
    number of them, or infinite ones.
    """
    if path.suffix.lower() != ".npz" or "heights_m" not in npz_headers(path):
        return None
    (heights_m,) = read_npz(path, partial(_check_values, "heights_m"), partial(_only, "heights_m")).values()
    if len(heights_m) != count:
        raise ValueError(f"one of heights_m for each point is needed; got {len(heights_m)} for {count}")
    bad = int(np.isinf(heights_m).sum())
    if bad:
        raise ValueError(f"heights_m: metres are needed, NaN where there is no ground; {bad} of {count} are infinite")
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
    fit = [name for name, (shape, dtype) in npz_headers(path).items() if shape[1:] == (3,) and _is_float(dtype)]
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
