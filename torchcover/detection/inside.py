"""Which points lie in which boxes."""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchcover.detection.boxes import Boxes
from torchcover.neighbors import check_tensor

# A body's points lie on its box as often as in it; rounding of coordinates may put them on either side.
SKIN_M = 0.01
# Points are first looked for in cells of this size; of more cells nobody makes a map.
CELL_M = 1.0
MAX_CELLS = 1_000_000


class Inside(NamedTuple):
    """Pairs of a box and a point in it: `box` (P,) and `point` (P,) int64, by ascending box."""

    box: Tensor
    point: Tensor


def points_in_boxes(points: Tensor, boxes: Boxes, *, skin_m: float = SKIN_M) -> Inside:
    """Which points lie in which boxes; a point may lie in several.

    A body touches its box: the wall of a box-shaped truck lies on the box's side. Sides and top are therefore closed,
    and 1 cm thicker than given. The bottom is raised by as much: what the body stands on is not the body. Published
    counts of points, as those of nuScenes and Argoverse 2, are without such a skin: `skin_m=0`.

    Args:
        points: (N, 3) points in the vehicle frame in metres.
        boxes: K boxes in the same frame, on the same device.
        skin_m: How much thicker.

    Returns:
        `Inside(box, point)`.

    Raises:
        TypeError: The points are no tensor.

    Example:
        >>> boxes = Boxes.from_rows(torch.tensor([[10.0, 0.0, 1.0, 4.0, 2.0, 2.0, 0.0]]))
        >>> points_in_boxes(torch.tensor([[11.9, 0.9, 1.9], [12.1, 0.0, 1.0], [10.0, 0.0, 0.0]]), boxes)
        Inside(box=tensor([0]), point=tensor([0]))
    """
    check_tensor(points, "points")
    if len(boxes) == 0 or len(points) == 0:
        none = torch.empty(0, dtype=torch.int64, device=points.device)
        return Inside(none, none)
    points = points.detach().to(torch.promote_types(points.dtype, torch.float32))
    reach_m = torch.linalg.vector_norm(boxes.size_m[:, :2].double(), dim=1) / 2 + 2 * skin_m + SKIN_M
    near = _near_any(points, boxes, reach_m)
    # Sorted by x, the points that a box can hold are next to each other.
    x_m, order = points[near, 0].sort()
    first = torch.searchsorted(x_m, (boxes.centre_m[:, 0].double() - reach_m).to(x_m.dtype))
    end = torch.searchsorted(x_m, (boxes.centre_m[:, 0].double() + reach_m).to(x_m.dtype))
    counts = (end - first).clamp(min=0)
    box = torch.arange(len(boxes), device=points.device).repeat_interleave(counts)
    place = torch.arange(len(box), device=points.device) - (counts.cumsum(0) - counts - first)[box]
    point = near[order[place]]
    beside = (points[point, 1] - boxes.centre_m[box, 1]).abs() < reach_m[box]
    box, point = box[beside], point[beside]
    inside = _is_inside(points[point], boxes.rows[box], skin_m)
    return Inside(box[inside], point[inside])


def _near_any(points: Tensor, boxes: Boxes, reach_m: Tensor) -> Tensor:
    """(n,) numbers of the points that share a cell, seen from above, with what any box can reach: most are far away."""
    centre_m = boxes.centre_m[:, :2].double()
    lower_m, upper_m = centre_m - reach_m[:, None], centre_m + reach_m[:, None]
    corner_m = lower_m.amin(dim=0)
    first, last = (((bound - corner_m) / CELL_M).floor().long() for bound in (lower_m, upper_m))
    rows, columns = (last.amax(dim=0) + 3).tolist()  # with a border for all that is beyond
    if rows * columns > MAX_CELLS:
        return torch.arange(len(points), device=points.device)
    offset = torch.arange(int((last - first).amax()) + 1, device=points.device)
    row, column = (first[:, axis, None] + offset for axis in range(2))
    reached = (row <= last[:, 0, None])[:, :, None] & (column <= last[:, 1, None])[:, None]
    marked = torch.zeros(rows * columns, dtype=torch.bool, device=points.device)
    marked[((row + 1)[:, :, None] * columns + (column + 1)[:, None])[reached]] = True
    x, y = (
        ((points[:, axis].double() - corner_m[axis]) / CELL_M + 1).clamp_(0, most - 1).nan_to_num_(0.0).long()
        for axis, most in enumerate((rows, columns))
    )
    return marked.index_select(0, x * columns + y).nonzero().squeeze(1)


def _is_inside(points: Tensor, rows: Tensor, skin_m: float) -> Tensor:
    """(N,) whether each of (N, 3) points lies in the box of its (N, 7) row."""
    x, y, z = (points.double() - rows[:, :3].double()).T
    half_length, half_width, half_height = rows[:, 3:6].double().T / 2
    cosine, sine = rows[:, 6].double().cos(), rows[:, 6].double().sin()
    beside = ((x * cosine + y * sine).abs() <= half_length + skin_m) & (
        (y * cosine - x * sine).abs() <= half_width + skin_m
    )
    inside: Tensor = beside & (z > skin_m - half_height) & (z <= half_height + skin_m)
    return inside


def with_hits(boxes: Boxes, clouds: Mapping[str, Tensor]) -> Boxes:
    """The same boxes with `hits`: how many points of each rig lie in each.

    Args:
        boxes: K boxes.
        clouds: Name of each rig -> (N, 3) its points in the vehicle frame.
    """
    inside = {rig: points_in_boxes(cloud, boxes).box for rig, cloud in clouds.items()}
    return replace(boxes, hits={rig: torch.bincount(box, minlength=len(boxes)) for rig, box in inside.items()})
