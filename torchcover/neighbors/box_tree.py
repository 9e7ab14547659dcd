"""A binary tree of bounding boxes without pointers, made by torch on the device of the points.

Node n has the children 2 n and 2 n + 1, the root is node 1, and the last level are the leaves: points that follow each
other along a Morton curve, on which what is near in the order is near in space.
"""

from typing import NamedTuple

import torch
from torch import Tensor

LEAF = 8  # points
AXIS_CELLS = 1 << 21  # so that the three cells of a point fit a number of 63 bits
SPREAD = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
SAMPLE = 4096  # points, at least, by which the cells are sized
# More than the number of any point.
NONE = 2**63 - 1


class BoxTree(NamedTuple):
    """Points in leaves of `LEAF`, and the boxes above them. L leaves under F >= L places, a power of two.

    Args:
        points: (L LEAF, 3) in order; the last leaf is filled up with copies of the last point.
        point_indices: (L LEAF,) int64 which point each is.
        boxes: (2 F, 6) least and largest coordinates in each node; in a node without points inf and -inf.
        min_point_indices: (2 F,) int64 smallest number of a point in each node; `NONE` where there is none.
    """

    points: Tensor
    point_indices: Tensor
    boxes: Tensor
    min_point_indices: Tensor


def build_box_tree(points: Tensor) -> BoxTree:
    """The tree over (M, 3) points of finite coordinates, M > 0."""
    order = compute_morton_order(points)
    numbers = torch.cat([order, order[-1:].expand(-len(order) % LEAF)])
    points = points[numbers]
    leaves = points.view(-1, LEAF, 3)
    # The largest of negated coordinates are the least: one reduction for all six.
    level, smallest = torch.cat([-leaves, leaves], dim=2).amax(dim=1), numbers.view(-1, LEAF).amin(dim=1)
    empty = (1 << (len(level) - 1).bit_length()) - len(level)
    level = torch.cat([level, level.new_full((empty, 6), -torch.inf)])
    smallest = torch.cat([smallest, smallest.new_full((empty,), NONE)])
    levels, all_smallest = [level], [smallest]
    while len(level) > 1:
        level, smallest = level.view(-1, 2, 6).amax(dim=1), smallest.view(-1, 2).amin(dim=1)
        levels.append(level)
        all_smallest.append(smallest)
    # Nothing is node 0.
    boxes = torch.cat([level, *reversed(levels)])
    boxes[:, :3] *= -1
    return BoxTree(points, numbers, boxes, torch.cat([smallest, *reversed(all_smallest)]))


def compute_morton_order(points: Tensor) -> Tensor:
    """(N,) int64 numbers of the points in the order of their Morton keys; equal keys in the order of the numbers.

    The cells are sized by where most points are, so that a point far away does not put all others into one; what lies
    beyond the last cell counts to it.
    """
    sample = points[:: max(1, len(points) // SAMPLE)].sort(dim=0).values.double()
    tail = len(sample) // 64
    low, middle = sample[tail], (sample[-1 - tail] - sample[tail]).amax()
    least, most = points.amin(dim=0).double(), points.amax(dim=0).double()
    # Most points may be one and the same.
    low = torch.where(middle > 0, low - middle, least)
    extent = torch.where(middle > 0, 3 * middle, (most - least).amax())
    scale = (AXIS_CELLS / extent).nan_to_num(0.0, posinf=0.0)
    key = torch.zeros(len(points), dtype=torch.int64, device=points.device)
    for axis in range(3):
        cell = ((points[:, axis].double() - low[axis]) * scale).clamp_(0, AXIS_CELLS - 1).long()
        for bits, mask in SPREAD:
            cell = (cell | (cell << bits)) & mask
        key |= cell << axis
    return key.argsort(stable=True)
