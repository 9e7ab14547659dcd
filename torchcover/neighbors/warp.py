"""Search on a GPU, or on the CPU from the same source: each query walks a tree of boxes, compiled by Warp.

The walk needs no stack. It enters the nearer of two children and stores in a bit whether the other one may matter; a
node and the bits of its ancestors determine where the walk continues. No nearer point is missed, and among points at
the same squared distance, in the type of the clouds, the smallest index wins, as in `packets`.
"""

# Warp has types of its own.
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# ruff: noqa: ANN202, ANN401

from typing import Any

import torch
from torch import Tensor

from torchcover.neighbors.box_tree import LEAF_SIZE, NO_INDEX, build_box_tree, compute_morton_order

try:
    import warp as wp
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("backend 'warp' needs Warp: pip install 'torchcover[warp]'") from error

# Warp prints neither a banner nor a line for each loaded kernel.
if hasattr(wp.config, "log_level"):
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
else:
    wp.config.quiet = True
wp.init()
# Sums are not contracted: a distance is the same on every device.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SCALARS = {torch.float32: wp.float32, torch.float64: wp.float64}


def search(query: Tensor, points: Tensor, max_distance: float, memory_mb: float) -> Tensor:
    """Find the index of a nearest point for each query on a CPU or a CUDA device.

    Args:
        query: (N, 3) finite coordinates.
        points: (M, 3) finite coordinates of the same type and device, M > 0.
        max_distance: Largest distance in meters that counts.
        memory_mb: Not used; memory grows with the clouds.

    Returns:
        (N,) int64 indices; -1 for queries without a point in reach.
    """
    scalar = SCALARS[query.dtype]
    bound = max_distance**2 if max_distance < torch.finfo(query.dtype).max ** 0.5 else torch.inf
    tree = build_box_tree(points)
    # Consecutive queries take similar paths through the tree, which makes a GPU fast.
    order = compute_morton_order(query)
    best_indices = torch.full_like(order, NO_INDEX)
    wp.launch(
        _walk_tree,
        dim=len(query),
        inputs=[*map(wp.from_torch, (query[order], *tree)), scalar(bound), wp.from_torch(best_indices)],
        device=wp.device_from_torch(query.device),
        stream=wp.stream_from_torch(query.device) if query.is_cuda else None,
    )
    return torch.empty_like(best_indices).scatter_(0, order, best_indices.masked_fill_(best_indices == NO_INDEX, -1))


@wp.func
def _compute_gap(boxes: wp.array2d(dtype=Any), node: int, x: Any, y: Any, z: Any):
    """Compute the squared distance of a point to the box of a node."""
    zero = x - x
    dx = wp.max(zero, wp.max(boxes[node, 0] - x, x - boxes[node, 3]))
    dy = wp.max(zero, wp.max(boxes[node, 1] - y, y - boxes[node, 4]))
    dz = wp.max(zero, wp.max(boxes[node, 2] - z, z - boxes[node, 5]))
    return dx * dx + dy * dy + dz * dz


@wp.func
def _is_better(squared: Any, index: wp.int64, best_distance: Any, best_index: wp.int64):
    """Test whether a point or box is nearer than the best point so far, or as near with a smaller index."""
    return squared < best_distance or (squared == best_distance and index < best_index)


@wp.kernel
def _walk_tree(  # noqa: C901
    queries: wp.array2d(dtype=Any),
    points: wp.array2d(dtype=Any),
    point_indices: wp.array(dtype=wp.int64),
    boxes: wp.array2d(dtype=Any),
    min_indices: wp.array(dtype=wp.int64),
    bound: Any,
    best_indices: wp.array(dtype=wp.int64),
):
    """Write the index of the nearest point within the bound to `best_indices`, for each query."""
    i = wp.tid()
    x, y, z = queries[i, 0], queries[i, 1], queries[i, 2]
    best_distance = bound + (x - x)
    best_index = best_indices[i]
    first = boxes.shape[0] // 2
    node = wp.int32(1)
    pending = wp.int32(0)
    while node > 0:
        next_child = wp.int32(0)
        if node < first:
            left = 2 * node
            to_left, to_right = (
                _compute_gap(boxes, left, x, y, z),
                _compute_gap(boxes, left + 1, x, y, z),
            )
            can_improve_left = _is_better(to_left, min_indices[left], best_distance, best_index)
            can_improve_right = _is_better(to_right, min_indices[left + 1], best_distance, best_index)
            if can_improve_left:
                next_child = left
            if can_improve_right and (not can_improve_left or to_right < to_left):
                next_child = left + 1
            if next_child > 0:
                node = next_child
                pending = 2 * pending + wp.where(can_improve_left and can_improve_right, 1, 0)
        else:
            start = (node - first) * LEAF_SIZE
            for j in range(start, start + LEAF_SIZE):
                dx, dy, dz = x - points[j, 0], y - points[j, 1], z - points[j, 2]
                squared = dx * dx + dy * dy + dz * dz
                index = point_indices[j]
                if _is_better(squared, index, best_distance, best_index):
                    best_distance = squared
                    best_index = index
        # Return to the last postponed child, unless it can no longer improve the result.
        while next_child == 0 and node > 0:
            if pending == 0:
                node = 0
            elif (pending & 1) == 0:
                node = node >> 1
                pending = pending >> 1
            else:
                node = node ^ 1
                pending = pending ^ 1
                if _is_better(_compute_gap(boxes, node, x, y, z), min_indices[node], best_distance, best_index):
                    next_child = node
    best_indices[i] = best_index


# Both types are declared at once, so that the compiler runs once and caches one module.
for _scalar in SCALARS.values():
    _floats, _integers = wp.array2d(dtype=_scalar), wp.array(dtype=wp.int64)
    wp.overload(_walk_tree, [_floats, _floats, _integers, _floats, _integers, _scalar, _integers])
