"""KD-tree search on the CPU with pykdtree, on as many threads as OpenMP is given (`OMP_NUM_THREADS`)."""

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pykdtree.kdtree import KDTree
from torch import Tensor

# About how many points are looked at for equal ones.
SAMPLE = 1024
# Points in a leaf of the tree. Large leaves are built in less than half the time, small ones sooner asked.
LARGE_LEAF, SMALL_LEAF = 64, 16
# Few queries: at least as many points for each.
POINTS_PER_QUERY = 12


def search(query: Tensor, points: Tensor, max_distance: float, memory_mb: float) -> Tensor:
    """As `cdist.search`, on the CPU; -1 for queries without a point in reach. It takes as much memory as the points."""
    bound = None if math.isinf(max_distance) else max_distance
    coordinates, number = _distinct(np.ascontiguousarray(points.numpy()))
    leaf = LARGE_LEAF if len(points) >= POINTS_PER_QUERY * len(query) else SMALL_LEAF
    _, index = KDTree(coordinates, leafsize=leaf).query(np.ascontiguousarray(query.numpy()), distance_upper_bound=bound)
    found = torch.from_numpy(index.astype(np.int64))
    # pykdtree answers "none" with the number of points.
    none = found >= len(coordinates)
    if number is not None:
        found = torch.from_numpy(number)[found.clamp(max=len(number) - 1)]
    return found.masked_fill(none, -1)


def _distinct(points: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.int64] | None]:
    """One of each of the points, and their numbers; all of them and None, unless a sample holds equal ones.

    The tree cannot split what is equal: the returns at (0, 0, 0) of a spinning LiDAR would be one leaf of thousands of
    points, which most queries would look through.
    """
    sample = _as_keys(points[:: max(1, len(points) // SAMPLE)])
    if len(np.unique(sample)) == len(sample):
        return points, None
    _, number = np.unique(_as_keys(points), return_index=True)
    return points[number], number


def _as_keys(points: NDArray[Any]) -> NDArray[np.void]:
    """(N,) rows as one value each, equal exactly if their bytes are; -0 is 0."""
    rows = np.ascontiguousarray(points + points.dtype.type(0))
    return rows.view(np.dtype((np.void, rows.dtype.itemsize * rows.shape[1]))).ravel()
