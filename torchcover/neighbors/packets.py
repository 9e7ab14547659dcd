"""CPU search in packets: 64 queries that lie close together walk one tree of boxes, compiled by numba.

Points and queries are sorted along a Morton curve, on which neighbors in the order are close in space. Every 16 points
form a leaf; the leaves are the last level of a binary tree of bounding boxes without pointers: node n has the children
2 n and 2 n + 1. Each computation for the queries of a packet is a loop over plain arrays, which the compiler converts
to vector instructions.

The squared distance to a box never exceeds that to a point in it, because rounding is monotonic, so no nearer point is
missed. Among points at the same squared distance in float32 the smallest index wins: the result is the same for any
order, chunk size and number of threads.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.neighbors import kdtree
from torchcover.neighbors.compiled import Array, compile_function, inline_function

# Numba reads constants from the module when it compiles a function.
PACKET_SIZE = 64  # queries per packet
LEAF_SIZE = 16  # points per leaf
CHUNK_SIZE = 64 * PACKET_SIZE  # queries that a thread takes at a time: small enough for all threads to end together
HUGE = np.float32(3e38)  # larger than any squared distance that is compared
ZERO = np.float32(0)
NO_INDEX = np.int32(2**31 - 1)
# A packet array holds x, y and z of its queries, then at these offsets the best squared distances so far, the squared
# distances to the current box, and one more number: the largest of the best squared distances.
BEST = 3 * PACKET_SIZE
BOX = 4 * PACKET_SIZE
WORST = 5 * PACKET_SIZE
AXIS_CELLS = 1 << 11  # a Morton key has 33 bits, 11 for each axis
INDEX_BITS = np.uint64(31)  # the key shares a word with the index of its point
INDEX_MASK = np.uint64((1 << 31) - 1)
DIGIT_BITS = 9  # bits sorted in one pass: the 2^9 positions that a pass writes to stay in the cache
DIGITS = 1 << DIGIT_BITS
PASSES = 4  # for 33 bits
CROWD = 1024  # more points than this in one cell of the curve are sorted again, in finer cells


def search(query: Tensor, points: Tensor, max_distance: float, memory_mb: float) -> Tensor:
    """Find the index of a nearest point for each query on the CPU; types wider than float32 use the KD-tree.

    Args:
        query: (N, 3) finite coordinates.
        points: (M, 3) finite coordinates of the same type, M > 0.
        max_distance: Largest distance in meters that counts.
        memory_mb: Not used; memory grows with the clouds.

    Returns:
        (N,) int64 indices; -1 for queries without a point in reach.
    """
    if query.dtype != torch.float32 or max(len(query), len(points)) > INDEX_MASK:
        return kdtree.search(query, points, max_distance, memory_mb)
    queries, tree_points = (np.require(cloud.numpy(), requirements=["C", "A"]) for cloud in (query, points))
    bound = HUGE if max_distance > 1e19 else np.float32(max_distance**2)
    result = np.empty(len(queries), np.int64)
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        # A pool starts no thread before its first task, so a single thread stays the only one.
        run = pool.map if torch.get_num_threads() > 1 else map
        order, tree_order = run(compute_morton_order, (queries, tree_points))
        leaves, indices, boxes, min_indices = _build_tree(tree_points, tree_order)

        def search_chunk(start: int) -> None:
            chunk = order[start : start + CHUNK_SIZE]
            _search_chunk(queries, chunk, leaves, indices, boxes, min_indices, bound, result)

        list(run(search_chunk, range(0, len(order), CHUNK_SIZE)))
    return torch.from_numpy(result)


def compute_morton_order(points: NDArray[np.float32]) -> NDArray[np.int64]:
    """Sort points by their Morton keys; points with equal keys stay in the order of their indices.

    Args:
        points: (N, 3) finite coordinates.

    Returns:
        (N,) int64 indices of the points in order.
    """
    keys = _sort_keys(_compute_morton_keys(points))
    crowds = _find_crowds(keys)
    order: NDArray[np.int64] = np.bitwise_and(keys, INDEX_MASK, out=keys).view(np.int64)
    # A distant point makes the cells large, and all others may share one. Equal points can never be separated.
    for start, end in crowds:
        if end - start < len(points):
            crowd = order[start:end]
            crowd[:] = crowd[compute_morton_order(points[crowd])]
    return order


@inline_function
def _spread_bits(value: Array, low: Array, scale: Array) -> Array:
    """Compute the cell of a coordinate and spread its bits to every third bit."""
    cell = np.uint64((value - low) * scale)
    cell = (cell | (cell << np.uint64(16))) & np.uint64(0x0000FF0000FF)
    cell = (cell | (cell << np.uint64(8))) & np.uint64(0x00F00F00F00F)
    cell = (cell | (cell << np.uint64(4))) & np.uint64(0x0C30C30C30C3)
    return (cell | (cell << np.uint64(2))) & np.uint64(0x249249249249)


@compile_function("uint64[::1](float32[:, ::1])")
def _compute_morton_keys(cloud: NDArray[np.float32]) -> Array:
    """Compute (N,) keys: the interleaved bits of the three cells, then the index."""
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
            _spread_bits(cloud[i, 0], x0, scale)
            | (_spread_bits(cloud[i, 1], y0, scale) << np.uint64(1))
            | (_spread_bits(cloud[i, 2], z0, scale) << np.uint64(2))
        )
        keys[i] = (key << INDEX_BITS) | np.uint64(i)
    return keys


@compile_function("uint64[::1](uint64[::1])")
def _sort_keys(keys: NDArray[np.uint64]) -> Array:
    """Sort keys by their cells with a stable radix sort, the last digit first."""
    starts = np.zeros((PASSES, DIGITS), np.int64)
    for i in range(len(keys)):
        for k in range(PASSES):
            starts[k, (keys[i] >> np.uint64(INDEX_BITS + k * DIGIT_BITS)) & np.uint64(DIGITS - 1)] += 1
    buffer = np.empty_like(keys)
    for k in range(PASSES):
        start, shift, before = starts[k], np.uint64(INDEX_BITS + k * DIGIT_BITS), 0
        for digit in range(DIGITS):
            count = start[digit]
            start[digit] = before
            before += count
        for i in range(len(keys)):
            digit = (keys[i] >> shift) & np.uint64(DIGITS - 1)
            buffer[start[digit]] = keys[i]
            start[digit] += 1
        keys, buffer = buffer, keys
    return keys


@compile_function("int64[:, ::1](uint64[::1])")
def _find_crowds(keys: NDArray[np.uint64]) -> Array:
    """Return (K, 2) begin and end of the runs of more than `CROWD` equal cells."""
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
def _build_tree(points: NDArray[np.float32], order: NDArray[np.int64]) -> Array:
    """Build leaves (L, 3, LEAF_SIZE), the indices of their points, and box and smallest index of each node."""
    count = (len(points) + LEAF_SIZE - 1) // LEAF_SIZE
    first = 1
    while first < count:
        first *= 2
    leaves = np.empty((count, 3, LEAF_SIZE), np.float32)
    indices = np.empty((count, LEAF_SIZE), np.int32)
    boxes = np.empty((2 * first, 6), np.float32)
    min_indices = np.full(2 * first, NO_INDEX, np.int32)
    boxes[:, :3] = HUGE
    boxes[:, 3:] = -HUGE
    for leaf in range(count):
        for j in range(LEAF_SIZE):
            # The last leaf is padded with copies of the last point.
            index = order[min(leaf * LEAF_SIZE + j, len(points) - 1)]
            indices[leaf, j] = index
            leaves[leaf, 0, j] = points[index, 0]
            leaves[leaf, 1, j] = points[index, 1]
            leaves[leaf, 2, j] = points[index, 2]
        x0 = y0 = z0 = HUGE
        x1 = y1 = z1 = -HUGE
        min_index = NO_INDEX
        for j in range(LEAF_SIZE):
            x, y, z = leaves[leaf, 0, j], leaves[leaf, 1, j], leaves[leaf, 2, j]
            x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
            x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
            min_index = min(min_index, indices[leaf, j])
        box = boxes[first + leaf]
        box[0], box[1], box[2], box[3], box[4], box[5] = x0, y0, z0, x1, y1, z1
        min_indices[first + leaf] = min_index
    for node in range(first - 1, 0, -1):
        left, right = 2 * node, 2 * node + 1
        min_indices[node] = min(min_indices[left], min_indices[right])
        for axis in range(3):
            boxes[node, axis] = min(boxes[left, axis], boxes[right, axis])
            boxes[node, axis + 3] = max(boxes[left, axis + 3], boxes[right, axis + 3])
    return leaves, indices, boxes, min_indices


@inline_function
def _load_packet(
    queries: Array, members: Array, packet: Array, best_indices: Array, bound: Array, bounds: Array
) -> None:
    """Fill the packet with its member queries, padded with the last one, and compute their bounding box `bounds`."""
    bounds[:3] = HUGE
    bounds[3:] = -HUGE
    for i in range(PACKET_SIZE):
        query = members[min(i, len(members) - 1)]
        for axis in range(3):
            value = queries[query, axis]
            packet[axis * PACKET_SIZE + i] = value
            bounds[axis] = min(bounds[axis], value)
            bounds[axis + 3] = max(bounds[axis + 3], value)
        packet[BEST + i] = bound
        best_indices[i] = NO_INDEX


@inline_function
def _compute_gap(boxes: Array, node: int, bounds: Array) -> Array:
    """Compute the squared distance between the box of a node and the box around the packet."""
    x = max(ZERO, boxes[node, 0] - bounds[3], bounds[0] - boxes[node, 3])
    y = max(ZERO, boxes[node, 1] - bounds[4], bounds[1] - boxes[node, 4])
    z = max(ZERO, boxes[node, 2] - bounds[5], bounds[2] - boxes[node, 5])
    return x * x + y * y + z * z


@inline_function
def _compute_center_gap(boxes: Array, node: int, bounds: Array) -> Array:
    """Compute the sum along the axes of the distance between both box centers, which breaks ties between nodes."""
    x = abs(boxes[node, 0] + boxes[node, 3] - bounds[0] - bounds[3])
    y = abs(boxes[node, 1] + boxes[node, 4] - bounds[1] - bounds[4])
    z = abs(boxes[node, 2] + boxes[node, 5] - bounds[2] - bounds[5])
    return x + y + z


@inline_function
def _can_improve(packet: Array, best_indices: Array, boxes: Array, min_indices: Array, node: int) -> bool:
    """Test whether a box may hold, for any query, a nearer point or one at the same distance with a smaller index."""
    x0, y0, z0, x1, y1, z1 = boxes[node]
    for i in range(PACKET_SIZE):
        x = max(ZERO, x0 - packet[i], packet[i] - x1)
        y = max(ZERO, y0 - packet[PACKET_SIZE + i], packet[PACKET_SIZE + i] - y1)
        z = max(ZERO, z0 - packet[2 * PACKET_SIZE + i], packet[2 * PACKET_SIZE + i] - z1)
        packet[BOX + i] = x * x + y * y + z * z
    is_nearer, is_tied = np.int32(0), np.int32(0)
    for i in range(PACKET_SIZE):
        is_nearer |= np.int32(packet[BOX + i] < packet[BEST + i])
        is_tied |= np.int32(packet[BOX + i] == packet[BEST + i])
    if is_nearer or not is_tied:
        return bool(is_nearer)
    for i in range(PACKET_SIZE):  # noqa: SIM110  (numba knows no generators)
        if packet[BOX + i] == packet[BEST + i] and min_indices[node] < best_indices[i]:
            return True
    return False


@inline_function
def _visit_leaf(packet: Array, best_indices: Array, leaves: Array, indices: Array, leaf: int) -> Array:
    """Compare every query with every point of a leaf, and return the largest of the best squared distances."""
    for j in range(LEAF_SIZE):
        px, py, pz, index = leaves[leaf, 0, j], leaves[leaf, 1, j], leaves[leaf, 2, j], indices[leaf, j]
        for i in range(PACKET_SIZE):
            x, y, z = packet[i] - px, packet[PACKET_SIZE + i] - py, packet[2 * PACKET_SIZE + i] - pz
            squared = x * x + y * y + z * z
            best = packet[BEST + i]
            is_better = (squared < best) | ((squared == best) & (index < best_indices[i]))
            packet[BEST + i] = squared if is_better else best
            best_indices[i] = index if is_better else best_indices[i]
    # Non-negative floats sort like their bits, and the maximum of integers becomes vector instructions.
    bits = packet.view(np.int32)
    worst = np.int32(0)
    for i in range(PACKET_SIZE):
        worst = max(worst, bits[BEST + i])
    bits[WORST] = worst
    return packet[WORST]


@compile_function(
    "void(float32[:, ::1], int64[::1], "
    "float32[:, :, ::1], int32[:, ::1], float32[:, ::1], int32[::1], float32, int64[::1])"
)
def _search_chunk(  # noqa: C901
    queries: Array,
    chunk: Array,
    leaves: Array,
    indices: Array,
    boxes: Array,
    min_indices: Array,
    bound: Array,
    result: Array,
) -> None:
    """Write the index of the nearest point of each query in the chunk, or -1, to `result`."""
    first = len(boxes) // 2
    packet, best_indices = np.empty(WORST + 1, np.float32), np.empty(PACKET_SIZE, np.int32)
    bounds = np.empty(6, np.float32)
    stack, gaps = np.empty(64, np.int64), np.empty(64, np.float32)
    last = -1
    for start in range(0, len(chunk), PACKET_SIZE):
        members = chunk[start : start + PACKET_SIZE]
        _load_packet(queries, members, packet, best_indices, bound, bounds)
        # The leaf that the previous packet reached is likely to be near.
        seed, worst = last, bound
        if seed >= 0:
            worst = _visit_leaf(packet, best_indices, leaves, indices, seed)
        stack[0], gaps[0], height = 1, ZERO, 1
        while height > 0:
            height -= 1
            node = stack[height]
            if gaps[height] > worst or not _can_improve(packet, best_indices, boxes, min_indices, node):
                continue
            closer_gap = ZERO
            while node < first and closer_gap <= worst:
                closer, farther = 2 * node, 2 * node + 1
                closer_gap, farther_gap = _compute_gap(boxes, closer, bounds), _compute_gap(boxes, farther, bounds)
                is_tied_but_centered = farther_gap == closer_gap and _compute_center_gap(
                    boxes, farther, bounds
                ) < _compute_center_gap(boxes, closer, bounds)
                if is_tied_but_centered or farther_gap < closer_gap:
                    closer, farther, closer_gap, farther_gap = farther, closer, farther_gap, closer_gap
                if farther_gap <= worst:
                    stack[height], gaps[height] = farther, farther_gap
                    height += 1
                node = closer
            if closer_gap > worst or node - first == seed:
                continue
            if _can_improve(packet, best_indices, boxes, min_indices, node):
                last = node - first
                worst = _visit_leaf(packet, best_indices, leaves, indices, last)
        for i in range(len(members)):
            result[members[i]] = best_indices[i] if best_indices[i] != NO_INDEX else -1
