"""KD-tree search on the CPU with pykdtree, on the threads that OpenMP has (`OMP_NUM_THREADS`)."""

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pykdtree.kdtree import KDTree
from torch import Tensor


def search(query: Tensor, points: Tensor, max_distance: float, memory_mb: float) -> Tensor:
    """Find the index of a nearest point for each query on the CPU.

    Args:
        query: (N, 3) finite coordinates.
        points: (M, 3) finite coordinates of the same type, M > 0.
        max_distance: Largest distance in meters that counts.
        memory_mb: Not used; the tree takes as much memory as the points.

    Returns:
        (N,) int64 indices; -1 for queries without a point in reach.
    """
    bound = None if math.isinf(max_distance) else max_distance
    coordinates, original_indices = _drop_duplicates(np.ascontiguousarray(points.numpy()))
    # Trees with large leaves are built in less than half the time, those with small leaves are faster to query.
    leaf_size = 64 if len(points) >= 12 * len(query) else 16
    tree = KDTree(coordinates, leafsize=leaf_size)
    _, found = tree.query(np.ascontiguousarray(query.numpy()), distance_upper_bound=bound)
    index = torch.from_numpy(found.astype(np.int64))
    is_missing = index >= len(coordinates)  # pykdtree returns the number of points if none is in reach
    if original_indices is not None:
        index = torch.from_numpy(original_indices)[index.clamp(max=len(original_indices) - 1)]
    return index.masked_fill(is_missing, -1)


def _drop_duplicates(points: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.int64] | None]:
    """Return distinct points and their indices; all points and None unless a sample of 1024 contains equal ones.

    The tree cannot split equal points: the missing returns of a spinning LiDAR, all at (0, 0, 0), would form one leaf
    of thousands of points that most queries search.
    """
    sample = _convert_rows_to_keys(points[:: max(1, len(points) // 1024)])
    if len(np.unique(sample)) == len(sample):
        return points, None
    _, indices = np.unique(_convert_rows_to_keys(points), return_index=True)
    return points[indices], indices


def _convert_rows_to_keys(points: NDArray[Any]) -> NDArray[np.void]:
    """Convert rows to (N,) single values that are equal exactly if the bytes of the rows are; -0 becomes 0."""
    rows = np.ascontiguousarray(points + points.dtype.type(0))
    return rows.view(np.dtype((np.void, rows.dtype.itemsize * rows.shape[1]))).ravel()
