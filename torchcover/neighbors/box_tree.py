"""Binary tree of bounding boxes without pointers, built by torch on the device of the points.

Node n has the children 2 n and 2 n + 1, the root is node 1, and the last level contains the leaves: consecutive points
along a Morton curve, on which neighbors in the order are close in space.
"""

from typing import NamedTuple

import torch
from torch import Tensor

LEAF_SIZE = 8  # points per leaf
AXIS_CELLS = 1 << 21  # three cell indices fit a key of 63 bits
# Shifts and masks that spread the 21 bits of a cell index to every third bit.
SPREAD_STEPS = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
NO_INDEX = 2**63 - 1  # larger than the index of any point


class BoxTree(NamedTuple):
    """Points in L leaves and the boxes above them; the last level has F >= L nodes, F a power of two.

    Args:
        points: (L LEAF_SIZE, 3) points in Morton order; the last leaf is padded with copies of the last point.
        point_indices: (L LEAF_SIZE,) int64 index of each point in the input.
        boxes: (2 F, 6) smallest and largest coordinates in each node; inf and -inf in nodes without points.
        min_point_indices: (2 F,) int64 smallest index of a point in each node; `NO_INDEX` in nodes without points.
    """

    points: Tensor
    point_indices: Tensor
    boxes: Tensor
    min_point_indices: Tensor


def build_box_tree(points: Tensor) -> BoxTree:
    """Build the tree.

    Args:
        points: (M, 3) finite coordinates, M > 0.
    """
    order = compute_morton_order(points)
    indices = torch.cat([order, order[-1:].expand(-len(order) % LEAF_SIZE)])
    points = points[indices]
    leaves = points.view(-1, LEAF_SIZE, 3)
    # The largest negated coordinates are the smallest coordinates: one reduction yields all six bounds.
    level = torch.cat([-leaves, leaves], dim=2).amax(dim=1)
    min_indices = indices.view(-1, LEAF_SIZE).amin(dim=1)
    num_empty = (1 << (len(level) - 1).bit_length()) - len(level)
    level = torch.cat([level, level.new_full((num_empty, 6), -torch.inf)])
    min_indices = torch.cat([min_indices, min_indices.new_full((num_empty,), NO_INDEX)])
    levels, index_levels = [level], [min_indices]
    while len(level) > 1:
        level, min_indices = level.view(-1, 2, 6).amax(dim=1), min_indices.view(-1, 2).amin(dim=1)
        levels.append(level)
        index_levels.append(min_indices)
    # Row 0 is unused, so that the root is node 1.
    boxes = torch.cat([level, *reversed(levels)])
    boxes[:, :3] *= -1
    return BoxTree(points, indices, boxes, torch.cat([min_indices, *reversed(index_levels)]))


def compute_morton_order(points: Tensor, sample_size: int = 4096) -> Tensor:
    """Sort points by their Morton keys; points with equal keys stay in the order of their indices.

    The size of the cells follows from where most points are, so that a distant point does not put all others into one
    cell; points beyond the last cell belong to it.

    Args:
        points: (N, 3) finite coordinates.
        sample_size: Smallest number of points from which the cell size is estimated.

    Returns:
        (N,) int64 indices of the points in order.
    """
    sample = points[:: max(1, len(points) // sample_size)].sort(dim=0).values.double()
    tail = len(sample) // 64
    low, central_extent = sample[tail], (sample[-1 - tail] - sample[tail]).amax()
    smallest, largest = points.amin(dim=0).double(), points.amax(dim=0).double()
    # The central extent is 0 if most points are equal.
    low = torch.where(central_extent > 0, low - central_extent, smallest)
    extent = torch.where(central_extent > 0, 3 * central_extent, (largest - smallest).amax())
    scale = (AXIS_CELLS / extent).nan_to_num(0.0, posinf=0.0)
    key = torch.zeros(len(points), dtype=torch.int64, device=points.device)
    for axis in range(3):
        cell = ((points[:, axis].double() - low[axis]) * scale).clamp_(0, AXIS_CELLS - 1).long()
        for bits, mask in SPREAD_STEPS:
            cell = (cell | (cell << bits)) & mask
        key |= cell << axis
    return key.argsort(stable=True)
