"""Point-in-box test for point clouds and bounding boxes."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchcover.detection.boxes import Boxes
from torchcover.devices import ensure_float64, move_tensor
from torchcover.neighbors import check_tensor

# Points of a body lie on its box as often as in it; rounding of coordinates may move them to either side.
SKIN_M = 0.01
# Candidate boxes of a point come from a grid with cells of at least this size and at most this number of cells.
CELL_M = 2.0
MAX_CELLS = 1_000_000


class BoxPointPairs(NamedTuple):
    """Pairs of a box and a point in it, in ascending order of the boxes.

    Args:
        box_indices: (P,) int64 index of the box.
        point_indices: (P,) int64 index of the point.
    """

    box_indices: Tensor
    point_indices: Tensor


def find_points_in_boxes(points: Tensor, boxes: Boxes, *, margin_m: float = SKIN_M) -> BoxPointPairs:
    """Find the points in each box; a point may lie in several boxes.

    A body touches its box: the wall of a box-shaped truck lies on the side of the box. Sides and top are therefore
    closed and expanded by 1 cm. The bottom is raised by 1 cm, since the ground below a body is not part of it.
    Published point counts, for example those of nuScenes and Argoverse 2, have no such margin: `margin_m=0`.

    Args:
        points: (N, 3) points in the vehicle frame in meters.
        boxes: K boxes in the same frame, on the same device.
        margin_m: Expansion of sides and top, and offset of the bottom.

    Returns:
        One entry for each pair of a box and a point in it.

    Raises:
        TypeError: `points` is not a tensor.

    Example:
        >>> boxes = Boxes.from_rows(torch.tensor([[10.0, 0.0, 1.0, 4.0, 2.0, 2.0, 0.0]]))
        >>> find_points_in_boxes(torch.tensor([[11.9, 0.9, 1.9], [12.1, 0.0, 1.0], [10.0, 0.0, 0.0]]), boxes)
        BoxPointPairs(box_indices=tensor([0]), point_indices=tensor([0]))
    """
    check_tensor(points, "points")
    pairs = _BoxGrid(boxes, margin_m).find_pairs(ensure_float64(points))
    return BoxPointPairs(*(move_tensor(indices, points.device) for indices in pairs))


class _BoxGrid:
    """Grid in bird's-eye view with the boxes that intersect each cell."""

    def __init__(self, boxes: Boxes, margin_m: float = SKIN_M) -> None:
        self._margin_m = margin_m
        tensors = (boxes.center_m, boxes.size_m, boxes.yaw_rad)
        center_m, size_m, yaw_rad = (ensure_float64(tensor).double() for tensor in tensors)
        self._boxes = torch.cat([center_m, size_m / 2, yaw_rad.cos()[:, None], yaw_rad.sin()[:, None]], dim=1)
        if not len(boxes):
            return
        reach_m = torch.linalg.vector_norm(size_m[:, :2], dim=1, keepdim=True) / 2 + 2 * margin_m + SKIN_M
        lower_m, upper_m = center_m[:, :2] - reach_m, center_m[:, :2] + reach_m
        self._corner_m = lower_m.amin(dim=0)
        length_m, width_m = (upper_m.amax(dim=0) - self._corner_m).tolist()
        longest_m = max(length_m, width_m)
        self._cell_m = max(CELL_M, math.sqrt(length_m / MAX_CELLS) * math.sqrt(width_m), longest_m / MAX_CELLS)
        first, last = (((bound - self._corner_m) / self._cell_m).floor().long() for bound in (lower_m, upper_m))
        self._shape = (last.amax(dim=0) + 3).tolist()  # the border cells collect points outside the grid
        rows, columns = self._shape
        num_rows, num_columns = (last - first + 1).T
        box = torch.arange(len(boxes), device=center_m.device).repeat_interleave(num_rows * num_columns)
        number = _number_within_groups(num_rows * num_columns)
        row, column = number.div(num_columns[box], rounding_mode="floor"), number % num_columns[box]
        cell, order = ((first[box, 0] + row + 1) * columns + first[box, 1] + column + 1).sort()
        # Boxes sorted by cell; each cell has the start and the number of its boxes.
        self._sorted_boxes = box[order]
        self._count = torch.bincount(cell, minlength=rows * columns)
        self._start = self._count.cumsum(0) - self._count

    def find_pairs(self, points: Tensor) -> BoxPointPairs:
        """Find the pairs of a box and a point in it."""
        if len(self._boxes) == 0 or len(points) == 0:
            empty = torch.empty(0, dtype=torch.int64, device=points.device)
            return BoxPointPairs(empty, empty)
        points = points.detach().to(torch.promote_types(points.dtype, torch.float32))
        box, point = self._find_candidates(points)
        inside = self._is_inside(points.index_select(0, point), box)
        box, order = box[inside].sort(stable=True)
        return BoxPointPairs(box, point[inside][order])

    def _find_candidates(self, points: Tensor) -> BoxPointPairs:
        """Find pairs of a box and a point in a cell that the box intersects, in ascending order of the points."""
        x, y = (
            points[:, axis].double().sub(self._corner_m[axis]).div_(self._cell_m).add_(1.0).clamp_(0, cells - 1)
            for axis, cells in enumerate(self._shape)
        )
        cell = x.nan_to_num_().int().mul_(self._shape[1]).add_(y.nan_to_num_().int())
        count = self._count.index_select(0, cell)
        point = count.nonzero().squeeze(1)
        count, start = count.index_select(0, point), self._start.index_select(0, cell.index_select(0, point))
        position = start.repeat_interleave(count) + _number_within_groups(count)
        return BoxPointPairs(self._sorted_boxes.index_select(0, position), point.repeat_interleave(count))

    def _is_inside(self, points: Tensor, box: Tensor) -> Tensor:
        """(N,) bool: each of (N, 3) points lies in the box of the same row."""
        box_of_point = self._boxes.index_select(0, box)
        x, y, z = (points.double() - box_of_point[:, :3]).T
        half_length, half_width, half_height, cosine, sine = box_of_point[:, 3:].T
        is_within_sides = ((x * cosine + y * sine).abs() <= half_length + self._margin_m) & (
            (y * cosine - x * sine).abs() <= half_width + self._margin_m
        )
        is_inside: Tensor = is_within_sides & (z > self._margin_m - half_height) & (z <= half_height + self._margin_m)
        return is_inside


def _number_within_groups(counts: Tensor) -> Tensor:
    """Concatenate the ranges 0 to count - 1 of all counts."""
    total = counts.cumsum(0)
    numbers = torch.arange(int(total[-1]) if len(total) else 0, device=counts.device)
    return numbers - (total - counts).repeat_interleave(counts)


def add_point_counts(
    boxes: Boxes, clouds: Mapping[str, Tensor], point_multiplicities: Mapping[str, Tensor] | None = None
) -> Boxes:
    """Add the number of points of each rig in each box.

    Args:
        boxes: K boxes in the vehicle frame.
        clouds: Name of each rig -> (N, 3) points in the vehicle frame.
        point_multiplicities: Name of a rig -> (N,) number of points for which each of its points counts; default 1.

    Returns:
        Copy of the boxes with `points_in_box`.
    """
    grid, counts = _BoxGrid(boxes), dict[str, Tensor]()
    for rig, cloud in clouds.items():
        pairs = grid.find_pairs(ensure_float64(cloud))
        weights = None
        if point_multiplicities and rig in point_multiplicities:
            weights = ensure_float64(point_multiplicities[rig])[pairs.point_indices]
        count = torch.bincount(pairs.box_indices, weights, minlength=len(boxes)).long()
        counts[rig] = move_tensor(count, cloud.device)
    return replace(boxes, points_in_box=counts)
