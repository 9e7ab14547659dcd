"""Clouds that are bare arrays: KITTI and nuScenes records, `.npy`, `.npz`."""

from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchcover.data.formats.binary import check_records
from torchcover.files import NpyHeader, check_memory, read_npy, read_npz

Points = NDArray[np.floating]

# x, y, z and whatever else a sensor reports. A transposed (3, N) cloud must not pass for 3 points with N columns.
MAX_COLUMNS = 16


def read_records(path: Path, columns: int) -> Points:
    """Read rows of little-endian float32 without a header, x y z first."""
    size_bytes = path.stat().st_size
    check_memory(2 * size_bytes)
    return check_records(path.read_bytes(), columns)[:, :3]


def read_array(path: Path) -> Points:
    """Read a `.npy` file of shape (N, 3) or wider, x y z first."""
    return read_npy(path, _check)[:, :3]


def read_archive(path: Path) -> Points:
    """Read the array `points`, or the only array, of a `.npz` file."""
    (points,) = read_npz(path, _check, _choose).values()
    return points[:, :3]


def _choose(names: Collection[str]) -> Collection[str]:
    if "points" in names:
        return ("points",)
    if len(names) != 1:
        listed = ", ".join(sorted(names)[:10]) or "none"
        raise ValueError(f"an array called points, or a single array, is needed; got {len(names)} arrays: {listed}")
    return names


def _check(header: NpyHeader) -> None:
    shape, dtype = header
    if dtype.newbyteorder("=") not in (np.float32, np.float64):
        raise ValueError(f"an array of float32 or float64 is needed; got {dtype}")
    if len(shape) != 2 or not 3 <= shape[1] <= MAX_COLUMNS:
        raise ValueError(f"shape (N, 3), or up to (N, {MAX_COLUMNS}) with x y z first, is needed; got {shape}")
