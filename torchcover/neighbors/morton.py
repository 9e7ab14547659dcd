"""The order of points along a Morton curve: what is near in the order is near in space."""

import numpy as np
from numpy.typing import NDArray

from torchcover.neighbors.compiled import Array, compiled, inlined

# A key has 33 bits, 11 of each axis, and shares a word with the index of its point.
AXIS_CELLS = 1 << 11
INDEX_BITS = np.uint64(31)
INDEX_MASK = np.uint64((1 << 31) - 1)
# More points than this in one cell of the curve are sorted again, in finer cells.
CROWD = 1024

HUGE = np.float32(3e38)
ZERO = np.float32(0)


def along_the_curve(cloud: NDArray[np.float32]) -> NDArray[np.int64]:
    """Indices of the points in the order of their Morton keys; equal keys in the order of the indices."""
    keys = _morton_keys(cloud)
    keys.sort()
    order: NDArray[np.int64] = (keys & INDEX_MASK).view(np.int64)
    # A point far away makes the cells large, and all others may lie in one. Equal points stay together for ever.
    for start, end in _crowds(keys):
        if end - start < len(cloud):
            crowd = order[start:end]
            crowd[:] = crowd[along_the_curve(cloud[crowd])]
    return order


@inlined
def _spread(value: Array, least: Array, scale: Array) -> Array:
    """The cell of a coordinate, its bits two places apart."""
    cell = np.uint64((value - least) * scale)
    cell = (cell | (cell << np.uint64(16))) & np.uint64(0x0000FF0000FF)
    cell = (cell | (cell << np.uint64(8))) & np.uint64(0x00F00F00F00F)
    cell = (cell | (cell << np.uint64(4))) & np.uint64(0x0C30C30C30C3)
    return (cell | (cell << np.uint64(2))) & np.uint64(0x249249249249)


@compiled("uint64[::1](float32[:, ::1])")
def _morton_keys(cloud: NDArray[np.float32]) -> Array:
    """(N,) keys: the bits of the three cells in turn, then the index."""
    keys = np.empty(len(cloud), np.uint64)
    x0 = y0 = z0 = HUGE
    x1 = y1 = z1 = -HUGE
    for i in range(len(cloud)):
        x, y, z = cloud[i, 0], cloud[i, 1], cloud[i, 2]
        x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
        x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
    extent = max(x1 - x0, y1 - y0, z1 - z0)
    scale = np.float32(AXIS_CELLS - 1) / extent if extent > ZERO else ZERO
    if scale > HUGE:
        scale = ZERO
    for i in range(len(cloud)):
        key = (
            _spread(cloud[i, 0], x0, scale)
            | (_spread(cloud[i, 1], y0, scale) << np.uint64(1))
            | (_spread(cloud[i, 2], z0, scale) << np.uint64(2))
        )
        keys[i] = (key << INDEX_BITS) | np.uint64(i)
    return keys


@compiled("int64[:, ::1](uint64[::1])")
def _crowds(keys: NDArray[np.uint64]) -> Array:
    """(K, 2) begin and end of the runs of more than `CROWD` equal cells."""
    runs = np.empty((len(keys) // CROWD + 1, 2), np.int64)
    count = start = 0
    for i in range(1, len(keys) + 1):
        if i == len(keys) or (keys[i] >> INDEX_BITS) != (keys[start] >> INDEX_BITS):
            if i - start > CROWD:
                runs[count, 0], runs[count, 1] = start, i
                count += 1
            start = i
    return runs[:count]
