"""KD-tree search on the CPU with pykdtree, on as many threads as OpenMP is given (`OMP_NUM_THREADS`)."""

import math

import numpy as np
import torch
from pykdtree.kdtree import KDTree
from torch import Tensor


def search(query: Tensor, points: Tensor, max_distance: float, memory_mb: float) -> Tensor:
    """Index of a nearest point for each query.

    Args:
        query: (N, 3) finite float32 or float64 coordinates on the CPU.
        points: (M, 3) finite coordinates, M > 0, of the same type.
        max_distance: Queries without a point in reach return -1, or any index.
        memory_mb: Not used: the tree takes about as much memory as the points.

    Returns:
        (N,) int64 indices into `points`, or -1.
    """
    # The tree compares squares with `<`, in its own type; the caller decides what is within, from the differences.
    # The square of the bound may not vanish: `max_distance` 0 still finds a point at distance 0.
    least = 2 * math.sqrt(torch.finfo(query.dtype).tiny)
    bound = None if math.isinf(max_distance) else max(max_distance * (1 + 1e-5), least)
    tree = KDTree(np.ascontiguousarray(points.numpy()))
    _, index = tree.query(np.ascontiguousarray(query.numpy()), distance_upper_bound=bound)
    found = torch.from_numpy(index.astype(np.int64))
    # pykdtree answers "none" with the number of points.
    return found.where(found < len(points), -1)
