"""Which points lie in which boxes."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchcover.detection.boxes import Boxes
from torchcover.devices import ensure_float64, move_tensor
from torchcover.neighbors import check_tensor

# A body's points lie on its box as often as in it; rounding of coordinates may put them on either side.
SKIN_M = 0.01
# Points are first looked for in cells of this size, or in larger ones, so that there are about so many at most.
CELL_M = 2.0
MAX_CELLS = 1_000_000


class BoxPointPairs(NamedTuple):
    """Pairs of a box and a point in it: `box_indices` (P,) and `point_indices` (P,) int64, by ascending box."""

    box_indices: Tensor
    point_indices: Tensor


def find_points_in_boxes(points: Tensor, boxes: Boxes, *, margin_m: float = SKIN_M) -> BoxPointPairs:
    """Which points lie in which boxes; a point may lie in several.

    A body touches its box: the wall of a box-shaped truck lies on the box's side. Sides and top are therefore closed,
    and 1 cm thicker than given. The bottom is raised by as much: what the body stands on is not the body. Published
    counts of points, as those of nuScenes and Argoverse 2, are without such a skin: `skin_m=0`.

    Args:
        points: (N, 3) points in the vehicle frame in metres.
        boxes: K boxes in the same frame, on the same device.
        margin_m: How much thicker.

    Returns:
        `Inside(box, point)`: (P,) int64 each, one entry for each pair.

    Raises:
        TypeError: The points are no tensor.

    Example:
        >>> boxes = Boxes.from_rows(torch.tensor([[10.0, 0.0, 1.0, 4.0, 2.0, 2.0, 0.0]]))
        >>> find_points_in_boxes(torch.tensor([[11.9, 0.9, 1.9], [12.1, 0.0, 1.0], [10.0, 0.0, 0.0]]), boxes)
        Inside(box=tensor([0]), point=tensor([0]))
    """
    check_tensor(points, "points")
    inside = _BoxMap(boxes, margin_m).holding(ensure_float64(points))
    return BoxPointPairs(*(move_tensor(numbers, points.device) for numbers in inside))


class _BoxMap:
    """The boxes as seen from above: which of them reach into which cell."""

    def __init__(self, boxes: Boxes, skin_m: float = SKIN_M) -> None:
        self._skin_m = skin_m
        boxes_m = (boxes.center_m, boxes.size_m, boxes.yaw_rad)
        centre_m, size_m, yaw_rad = (ensure_float64(tensor).double() for tensor in boxes_m)
        self._boxes = torch.cat([centre_m, size_m / 2, yaw_rad.cos()[:, None], yaw_rad.sin()[:, None]], dim=1)
        if not len(boxes):
            return
        reach_m = torch.linalg.vector_norm(size_m[:, :2], dim=1, keepdim=True) / 2 + 2 * skin_m + SKIN_M
        lower_m, upper_m = centre_m[:, :2] - reach_m, centre_m[:, :2] + reach_m
        self._corner_m = lower_m.amin(dim=0)
        length_m, width_m = (upper_m.amax(dim=0) - self._corner_m).tolist()
        most_m = max(length_m, width_m)
        self._cell_m = max(CELL_M, math.sqrt(length_m / MAX_CELLS) * math.sqrt(width_m), most_m / MAX_CELLS)
        first, last = (((bound - self._corner_m) / self._cell_m).floor().long() for bound in (lower_m, upper_m))
        self._shape = (last.amax(dim=0) + 3).tolist()  # with a border for all that is beyond
        rows, columns = self._shape
        wide, deep = (last - first + 1).T
        box = torch.arange(len(boxes), device=centre_m.device).repeat_interleave(wide * deep)
        row, column = (_numbered(wide * deep).div(deep[box], rounding_mode="floor"), _numbered(wide * deep) % deep[box])
        cell, order = ((first[box, 0] + row + 1) * columns + first[box, 1] + column + 1).sort()
        # Cell by cell, the boxes that reach into it; where those of a cell start, and how many they are.
        self._listed = box[order]
        self._count = torch.bincount(cell, minlength=rows * columns)
        self._start = self._count.cumsum(0) - self._count

    def holding(self, points: Tensor) -> BoxPointPairs:
        """Which of the points lie in which boxes."""
        if len(self._boxes) == 0 or len(points) == 0:
            none = torch.empty(0, dtype=torch.int64, device=points.device)
            return BoxPointPairs(none, none)
        points = points.detach().to(torch.promote_types(points.dtype, torch.float32))
        box, point = self._near(points)
        inside = self._is_inside(points.index_select(0, point), box)
        box, order = box[inside].sort(stable=True)
        return BoxPointPairs(box, point[inside][order])

    def _near(self, points: Tensor) -> BoxPointPairs:
        """Pairs of a box and a point in a cell that it reaches into, by ascending point."""
        x, y = (
            points[:, axis].double().sub(self._corner_m[axis]).div_(self._cell_m).add_(1.0).clamp_(0, cells - 1)
            for axis, cells in enumerate(self._shape)
        )
        cell = x.nan_to_num_().int().mul_(self._shape[1]).add_(y.nan_to_num_().int())
        count = self._count.index_select(0, cell)
        point = count.nonzero().squeeze(1)
        count, start = count.index_select(0, point), self._start.index_select(0, cell.index_select(0, point))
        listed = start.repeat_interleave(count) + _numbered(count)
        return BoxPointPairs(self._listed.index_select(0, listed), point.repeat_interleave(count))

    def _is_inside(self, points: Tensor, box: Tensor) -> Tensor:
        """(N,) whether each of (N, 3) points lies in its own of the boxes."""
        of_box = self._boxes.index_select(0, box)
        x, y, z = (points.double() - of_box[:, :3]).T
        half_length, half_width, half_height, cosine, sine = of_box[:, 3:].T
        beside = ((x * cosine + y * sine).abs() <= half_length + self._skin_m) & (
            (y * cosine - x * sine).abs() <= half_width + self._skin_m
        )
        inside: Tensor = beside & (z > self._skin_m - half_height) & (z <= half_height + self._skin_m)
        return inside


def _numbered(counts: Tensor) -> Tensor:
    """0, 1, ... up to each count, one after the other."""
    total = counts.cumsum(0)
    every = torch.arange(int(total[-1]) if len(total) else 0, device=counts.device)
    return every - (total - counts).repeat_interleave(counts)


def add_point_counts(
    boxes: Boxes, clouds: Mapping[str, Tensor], point_multiplicities: Mapping[str, Tensor] | None = None
) -> Boxes:
    """The same boxes with `hits`: how many points of each rig, (N, 3) in the vehicle frame, lie in each.

    `point_multiplicities` says how many points each point of a rig, (N,), is counted as; one if not given.
    """
    of_all, hits = _BoxMap(boxes), dict[str, Tensor]()
    for rig, cloud in clouds.items():
        inside = of_all.holding(ensure_float64(cloud))
        weights = (
            ensure_float64(point_multiplicities[rig])[inside.point_indices]
            if point_multiplicities and rig in point_multiplicities
            else None
        )
        hits[rig] = move_tensor(torch.bincount(inside.box_indices, weights, minlength=len(boxes)).long(), cloud.device)
    return replace(boxes, points_in_box=hits)
