"""Search on the CPU in packets: 64 queries that lie together go through one tree of boxes, compiled by numba.

Points and queries are sorted along a Morton curve: what is near in the order is near in space. Every 16 points are a
leaf; the leaves are the last level of a binary tree of bounding boxes without pointers: node n has the children 2 n and
2 n + 1. What is computed for each query of a packet is a loop over plain arrays, which the compiler turns into vector
instructions.

The squared distance to a box is never above that to a point in it, because rounding keeps order, so nothing nearer is
passed over. Of several points at the same squared distance in float32 the one with the smallest index is named: the
result is the same for any order, division and number of threads.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.neighbors import kdtree
from torchcover.neighbors.compiled import Array, compile_function, inline_function

PACKET = 64  # queries
LEAF = 16  # points
SHARE = 64 * PACKET  # queries that a thread takes at a time: few enough for threads to end together
HUGE = np.float32(3e38)
NONE = np.int32(2**31 - 1)
ZERO = np.float32(0)
# Where the numbers of a packet begin: coordinates, least squared distances so far and those to a box; then one more.
X, Y, Z, LEAST, TO_BOX, MOST = range(0, 6 * PACKET, PACKET)
# A Morton key has 33 bits, 11 of each axis, and shares a word with the index of its point.
AXIS_CELLS = 1 << 11
INDEX_BITS = np.uint64(31)
INDEX_MASK = np.uint64((1 << 31) - 1)
# A pass of the sort takes so many bits: few enough for the places that it writes to to stay in the cache.
DIGIT_BITS = 9
DIGITS = 1 << DIGIT_BITS
PASSES = 4  # for 33 bits
# More points than this in one cell of the curve are sorted again, in finer cells.
CROWD = 1024


def search(query: Tensor, points: Tensor, max_distance: float, memory_mb: float) -> Tensor:
    """As `cdist.search`, on the CPU; -1 for queries without a point in reach. Types wider than float32: the KD-tree."""
    if query.dtype != torch.float32 or max(len(query), len(points)) > INDEX_MASK:
        return kdtree.search(query, points, max_distance, memory_mb)
    queries, tree_points = (np.require(cloud.numpy(), requirements=["C", "A"]) for cloud in (query, points))
    bound = HUGE if max_distance > 1e19 else np.float32(max_distance**2)
    found = np.empty(len(queries), np.int64)
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        # With a single thread the pool is never asked, and starts none.
        run = pool.map if torch.get_num_threads() > 1 else map
        order, tree_order = run(compute_morton_order, (queries, tree_points))
        leaves, indices, boxes, smallest = _build(tree_points, tree_order)
        parts = [order[start : start + SHARE] for start in range(0, len(order), SHARE)]
        list(run(lambda part: _search_part(queries, part, leaves, indices, boxes, smallest, bound, found), parts))
    return torch.from_numpy(found)


def compute_morton_order(points: NDArray[np.float32]) -> NDArray[np.int64]:
    """Indices of the points in the order of their Morton keys; equal keys in the order of the indices."""
    keys = _sorted(_morton_keys(points))
    crowds = _crowds(keys)
    order: NDArray[np.int64] = np.bitwise_and(keys, INDEX_MASK, out=keys).view(np.int64)
    # A point far away makes the cells large, and all others may lie in one. Equal points stay together for ever.
    for start, end in crowds:
        if end - start < len(points):
            crowd = order[start:end]
            crowd[:] = crowd[compute_morton_order(points[crowd])]
    return order


@inline_function
def _spread(value: Array, least: Array, scale: Array) -> Array:
    """The cell of a coordinate, its bits two places apart."""
    cell = np.uint64((value - least) * scale)
    cell = (cell | (cell << np.uint64(16))) & np.uint64(0x0000FF0000FF)
    cell = (cell | (cell << np.uint64(8))) & np.uint64(0x00F00F00F00F)
    cell = (cell | (cell << np.uint64(4))) & np.uint64(0x0C30C30C30C3)
    return (cell | (cell << np.uint64(2))) & np.uint64(0x249249249249)


@compile_function("uint64[::1](float32[:, ::1])")
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


@compile_function("uint64[::1](uint64[::1])")
def _sorted(keys: NDArray[np.uint64]) -> Array:
    """The keys in the order of their cells, equal cells in the order they came in: by digits, the last one first."""
    starts = np.zeros((PASSES, DIGITS), np.int64)
    for i in range(len(keys)):
        for k in range(PASSES):
            starts[k, (keys[i] >> np.uint64(INDEX_BITS + k * DIGIT_BITS)) & np.uint64(DIGITS - 1)] += 1
    other = np.empty_like(keys)
    for k in range(PASSES):
        start, shift, before = starts[k], np.uint64(INDEX_BITS + k * DIGIT_BITS), 0
        for digit in range(DIGITS):
            count = start[digit]
            start[digit] = before
            before += count
        for i in range(len(keys)):
            digit = (keys[i] >> shift) & np.uint64(DIGITS - 1)
            other[start[digit]] = keys[i]
            start[digit] += 1
        keys, other = other, keys
    return keys


@compile_function("int64[:, ::1](uint64[::1])")
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


@compile_function(
    "Tuple((float32[:, :, ::1], int32[:, ::1], float32[:, ::1], int32[::1]))(float32[:, ::1], int64[::1])"
)
def _build(points: NDArray[np.float32], order: NDArray[np.int64]) -> Array:
    """Leaves (L, 3, LEAF) and the indices of their points, boxes of all nodes, and the smallest index beneath each."""
    count = (len(points) + LEAF - 1) // LEAF
    first = 1
    while first < count:
        first *= 2
    leaves = np.empty((count, 3, LEAF), np.float32)
    indices = np.empty((count, LEAF), np.int32)
    boxes = np.empty((2 * first, 6), np.float32)
    smallest = np.full(2 * first, NONE, np.int32)
    boxes[:, :3] = HUGE
    boxes[:, 3:] = -HUGE
    for leaf in range(count):
        for j in range(LEAF):
            # The last leaf is filled up with copies of the last point.
            index = order[min(leaf * LEAF + j, len(points) - 1)]
            indices[leaf, j] = index
            leaves[leaf, 0, j] = points[index, 0]
            leaves[leaf, 1, j] = points[index, 1]
            leaves[leaf, 2, j] = points[index, 2]
        x0 = y0 = z0 = HUGE
        x1 = y1 = z1 = -HUGE
        least = NONE
        for j in range(LEAF):
            x, y, z = leaves[leaf, 0, j], leaves[leaf, 1, j], leaves[leaf, 2, j]
            x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
            x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
            least = min(least, indices[leaf, j])
        box = boxes[first + leaf]
        box[0], box[1], box[2], box[3], box[4], box[5] = x0, y0, z0, x1, y1, z1
        smallest[first + leaf] = least
    for node in range(first - 1, 0, -1):
        left, right = 2 * node, 2 * node + 1
        smallest[node] = min(smallest[left], smallest[right])
        for axis in range(3):
            boxes[node, axis] = min(boxes[left, axis], boxes[right, axis])
            boxes[node, axis + 3] = max(boxes[left, axis + 3], boxes[right, axis + 3])
    return leaves, indices, boxes, smallest


@inline_function
def _load(queries: Array, part: Array, packet: Array, found: Array, bound: Array, around: Array) -> None:
    """Fill the packet with the queries `part`, the last one again where they are too few; `around` is their box."""
    around[:3] = HUGE
    around[3:] = -HUGE
    for i in range(PACKET):
        query = part[min(i, len(part) - 1)]
        for axis in range(3):
            value = queries[query, axis]
            packet[axis * PACKET + i] = value
            around[axis] = min(around[axis], value)
            around[axis + 3] = max(around[axis + 3], value)
        packet[LEAST + i] = bound
        found[i] = NONE


@inline_function
def _gap(boxes: Array, node: int, around: Array) -> Array:
    """Squared distance between the box of a node and the box around the packet."""
    x = max(ZERO, boxes[node, 0] - around[3], around[0] - boxes[node, 3])
    y = max(ZERO, boxes[node, 1] - around[4], around[1] - boxes[node, 4])
    z = max(ZERO, boxes[node, 2] - around[5], around[2] - boxes[node, 5])
    return x * x + y * y + z * z


@inline_function
def _centre_gap(boxes: Array, node: int, around: Array) -> Array:
    """How far apart the centres of the two boxes are, by sums along the axes: the order of nodes that are as near."""
    x = abs(boxes[node, 0] + boxes[node, 3] - around[0] - around[3])
    y = abs(boxes[node, 1] + boxes[node, 4] - around[1] - around[4])
    z = abs(boxes[node, 2] + boxes[node, 5] - around[2] - around[5])
    return x + y + z


@inline_function
def _may_improve(packet: Array, found: Array, boxes: Array, smallest: Array, node: int) -> bool:
    """Whether the box may hold a nearer point for any query, or one as near with a smaller index."""
    x0, y0, z0, x1, y1, z1 = boxes[node]
    for i in range(PACKET):
        x = max(ZERO, x0 - packet[X + i], packet[X + i] - x1)
        y = max(ZERO, y0 - packet[Y + i], packet[Y + i] - y1)
        z = max(ZERO, z0 - packet[Z + i], packet[Z + i] - z1)
        packet[TO_BOX + i] = x * x + y * y + z * z
    nearer, as_near = np.int32(0), np.int32(0)
    for i in range(PACKET):
        nearer |= np.int32(packet[TO_BOX + i] < packet[LEAST + i])
        as_near |= np.int32(packet[TO_BOX + i] == packet[LEAST + i])
    if nearer or not as_near:
        return bool(nearer)
    for i in range(PACKET):  # noqa: SIM110  (numba knows no generators)
        if packet[TO_BOX + i] == packet[LEAST + i] and smallest[node] < found[i]:
            return True
    return False


@inline_function
def _visit(packet: Array, found: Array, leaves: Array, indices: Array, leaf: int) -> Array:
    """Compare every query with every point of a leaf; the largest of the least squared distances."""
    for j in range(LEAF):
        px, py, pz, index = leaves[leaf, 0, j], leaves[leaf, 1, j], leaves[leaf, 2, j], indices[leaf, j]
        for i in range(PACKET):
            x, y, z = packet[X + i] - px, packet[Y + i] - py, packet[Z + i] - pz
            squared = x * x + y * y + z * z
            least = packet[LEAST + i]
            better = (squared < least) | ((squared == least) & (index < found[i]))
            packet[LEAST + i] = squared if better else least
            found[i] = index if better else found[i]
    # Numbers that are not negative sort as their bits do, and the maximum of integers becomes vector instructions.
    bits = packet.view(np.int32)
    most = np.int32(0)
    for i in range(PACKET):
        most = max(most, bits[LEAST + i])
    bits[MOST] = most
    return packet[MOST]


@compile_function(
    "void(float32[:, ::1], int64[::1], "
    "float32[:, :, ::1], int32[:, ::1], float32[:, ::1], int32[::1], float32, int64[::1])"
)
def _search_part(  # noqa: C901
    queries: Array,
    part: Array,
    leaves: Array,
    indices: Array,
    boxes: Array,
    smallest: Array,
    bound: Array,
    result: Array,
) -> None:
    """Write the index of the nearest point of each query in `part`, or -1, to `result`."""
    first = len(boxes) // 2
    packet, found = np.empty(MOST + 1, np.float32), np.empty(PACKET, np.int32)
    around = np.empty(6, np.float32)
    stack, gaps = np.empty(64, np.int64), np.empty(64, np.float32)
    last = -1
    for start in range(0, len(part), PACKET):
        members = part[start : start + PACKET]
        _load(queries, members, packet, found, bound, around)
        # The leaf that the packet before came to is likely to be near.
        seed, most = last, bound
        if seed >= 0:
            most = _visit(packet, found, leaves, indices, seed)
        stack[0], gaps[0], height = 1, ZERO, 1
        while height > 0:
            height -= 1
            node = stack[height]
            if gaps[height] > most or not _may_improve(packet, found, boxes, smallest, node):
                continue
            near_gap = ZERO
            while node < first and near_gap <= most:
                near, far = 2 * node, 2 * node + 1
                near_gap, far_gap = _gap(boxes, near, around), _gap(boxes, far, around)
                as_near = far_gap == near_gap and _centre_gap(boxes, far, around) < _centre_gap(boxes, near, around)
                if as_near or far_gap < near_gap:
                    near, far, near_gap, far_gap = far, near, far_gap, near_gap
                if far_gap <= most:
                    stack[height], gaps[height] = far, far_gap
                    height += 1
                node = near
            if near_gap > most or node - first == seed:
                continue
            if _may_improve(packet, found, boxes, smallest, node):
                last = node - first
                most = _visit(packet, found, leaves, indices, last)
        for i in range(len(members)):
            result[members[i]] = found[i] if found[i] != NONE else -1
