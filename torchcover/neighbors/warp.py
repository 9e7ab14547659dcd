"""Search on a GPU, or on the CPU from the same source: each query walks a tree of boxes, compiled by Warp.

The walk keeps no stack. Of two children it takes the nearer one and notes in a bit whether the other may matter; a node
and the bits of its ancestors say where to go on. Nothing nearer is passed over, and of several points at the same
squared distance, here in the type of the clouds, the one with the smallest index is named, as in `packets`.
"""

# The types of Warp's functions are Warp's own.
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# ruff: noqa: ANN202, ANN401

from typing import Any

import torch
from torch import Tensor

from torchcover.neighbors.box_tree import LEAF, NONE, build_box_tree, compute_morton_order

try:
    import warp as wp
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("backend 'warp' needs Warp: pip install 'torchcover[warp]'") from error

# No banner, and no line for each kernel that is loaded.
if hasattr(wp.config, "log_level"):
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
else:
    wp.config.quiet = True
wp.init()
# Nor contraction of sums: a distance is the same on every device.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SCALARS = {torch.float32: wp.float32, torch.float64: wp.float64}


def search(query: Tensor, points: Tensor, max_distance: float, memory_mb: float) -> Tensor:
    """As `cdist.search`, on a CPU or a CUDA device; -1 for queries without a point in reach."""
    scalar = SCALARS[query.dtype]
    bound = max_distance**2 if max_distance < torch.finfo(query.dtype).max ** 0.5 else torch.inf
    tree = build_box_tree(points)
    # Neighbours in the order walk much the same way, which is what makes a GPU fast.
    order = compute_morton_order(query)
    found = torch.full_like(order, NONE)
    wp.launch(
        _walk,
        dim=len(query),
        inputs=[*map(wp.from_torch, (query[order], *tree)), scalar(bound), wp.from_torch(found)],
        device=wp.device_from_torch(query.device),
        stream=wp.stream_from_torch(query.device) if query.is_cuda else None,
    )
    return torch.empty_like(found).scatter_(0, order, found.masked_fill_(found == NONE, -1))


@wp.func
def _gap(boxes: wp.array2d(dtype=Any), node: int, x: Any, y: Any, z: Any):
    """Squared distance of a point to the box of a node."""
    zero = x - x
    dx = wp.max(zero, wp.max(boxes[node, 0] - x, x - boxes[node, 3]))
    dy = wp.max(zero, wp.max(boxes[node, 1] - y, y - boxes[node, 4]))
    dz = wp.max(zero, wp.max(boxes[node, 2] - z, z - boxes[node, 5]))
    return dx * dx + dy * dy + dz * dz


@wp.func
def _better(squared: Any, number: wp.int64, least: Any, best: wp.int64):
    """Whether a point, or a box, is nearer than the best one so far, or as near with a smaller number."""
    return squared < least or (squared == least and number < best)


@wp.kernel
def _walk(  # noqa: C901
    queries: wp.array2d(dtype=Any),
    points: wp.array2d(dtype=Any),
    numbers: wp.array(dtype=wp.int64),
    boxes: wp.array2d(dtype=Any),
    smallest: wp.array(dtype=wp.int64),
    bound: Any,
    found: wp.array(dtype=wp.int64),
):
    """Write the number of the nearest point of each query within the bound to `found`."""
    i = wp.tid()
    x, y, z = queries[i, 0], queries[i, 1], queries[i, 2]
    least = bound + (x - x)
    best = found[i]
    first = boxes.shape[0] // 2
    node = wp.int32(1)
    pending = wp.int32(0)
    while node > 0:
        near = wp.int32(0)
        if node < first:
            left = 2 * node
            to_left, to_right = _gap(boxes, left, x, y, z), _gap(boxes, left + 1, x, y, z)
            see_left = _better(to_left, smallest[left], least, best)
            see_right = _better(to_right, smallest[left + 1], least, best)
            if see_left:
                near = left
            if see_right and (not see_left or to_right < to_left):
                near = left + 1
            if near > 0:
                node = near
                pending = 2 * pending + wp.where(see_left and see_right, 1, 0)
        else:
            start = (node - first) * LEAF
            for j in range(start, start + LEAF):
                dx, dy, dz = x - points[j, 0], y - points[j, 1], z - points[j, 2]
                squared = dx * dx + dy * dy + dz * dz
                number = numbers[j]
                if _better(squared, number, least, best):
                    least = squared
                    best = number
        # Back to the last child that was left for later, unless it has ceased to matter.
        while near == 0 and node > 0:
            if pending == 0:
                node = 0
            elif (pending & 1) == 0:
                node = node >> 1
                pending = pending >> 1
            else:
                node = node ^ 1
                pending = pending ^ 1
                if _better(_gap(boxes, node, x, y, z), smallest[node], least, best):
                    near = node
    found[i] = best


# Both at once, so that the compiler is asked once, and its cache holds one module.
for _scalar in SCALARS.values():
    _floats, _integers = wp.array2d(dtype=_scalar), wp.array(dtype=wp.int64)
    wp.overload(_walk, [_floats, _floats, _integers, _floats, _integers, _scalar, _integers])
