"""How much of each object the rig could see."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchcover.detection.boxes import Boxes, check_boxes
from torchcover.detection.inside import find_points_in_boxes
from torchcover.devices import has_float64, move_tensor
from torchcover.neighbors import blind_spot_radius, check_cloud, check_weights
from torchcover.notebooks import format_short_repr

# The sides of a box that face this height above the vehicle's origin can be seen; so many points across each.
SEEN_FROM_M, SIDE_POINTS = 1.7, 12


@dataclass(frozen=True, eq=False, repr=False)
class BoxVisibility:
    """What the rig saw of each of K boxes, in float64. A box without a point of reference or rig is unknown: NaN.

    Args:
        share: (K,) share of what the reference saw in the box whose blind spot radius is within the threshold; of the
            sides that face the vehicle where it saw nothing and the rig did.
        mean_radius_m: (K,) mean blind spot radius of the same.
        reference_points: (K,) int64 reference points in the box.
        sampled_points: (K,) int64 points that the reference drew on the object, from `Boxes`.
        sensor_points: (K,) int64 points of the rig in the box.
        threshold_m: The threshold.
    """

    share: Tensor
    mean_radius_m: Tensor
    reference_points: Tensor
    sampled_points: Tensor
    sensor_points: Tensor
    threshold_m: float

    __repr__ = format_short_repr

    @property
    def observed(self) -> Tensor:
        """(K,) bool whether any point of the reference or of the rig fell into the box."""
        return ~self.share.isnan()

    @property
    def hidden(self) -> Tensor:
        """(K,) bool whether points were drawn on the object, and the reference's places saw none: unknown, too.

        What is neither known nor hidden was not sampled: nobody asked whether it can be seen.
        """
        return ~self.observed & (self.sampled_points > 0)

    @property
    def levels(self) -> Tensor:
        """(K,) int64 levels of visibility as nuScenes names them: 1 to 40 %, 2 to 60 %, 3 to 80 %, 4; 0 if unknown.

        There it is the share of an object's pixels in all cameras, here that of its surface with this rig.
        """
        borders = self.share.new_tensor([0.4, 0.6, 0.8])
        return (torch.bucketize(self.share, borders, right=True) + 1).where(self.observed, 0)

    def __len__(self) -> int:
        return len(self.share)

    def select(self, selection: Tensor) -> "BoxVisibility":
        """Some of them, as `Boxes.select` does."""
        return self._each(lambda tensor: tensor[selection.to(tensor.device)])

    def to(self, device: torch.device | str) -> "BoxVisibility":
        """A copy on another device, in float32 where that has no float64."""
        return self._each(lambda tensor: move_tensor(tensor, device))

    def _each(self, change: Callable[[Tensor], Tensor]) -> "BoxVisibility":
        names = ("share", "mean_radius_m", "reference_points", "sampled_points", "sensor_points")
        changed: dict[str, Any] = {name: change(getattr(self, name)) for name in names}
        return replace(self, **changed)


@torch.no_grad()
def measure_box_visibility(
    sensor: Tensor,
    reference: Tensor,
    boxes: Boxes,
    threshold_m: float = 0.4,
    *,
    reference_weights: Tensor | None,
) -> BoxVisibility:
    """Share of what the reference saw of each box that the rig saw too, and its mean blind spot radius.

        share[k]       = sum over q in box k of w(q) 1(r(q) <= threshold) / sum over q in box k of w(q)
        mean_radius[k] = sum over q in box k of w(q) r(q) / sum over q in box k of w(q)

    with r(q) from `torchcover.blind_spot_radius`. With weights in square metres it is the share of the surface that the
    rig covers, of that which the reference's places see. The nearest sensor point may lie outside the box: an object
    right beside a wall that is seen counts as seen as far as the threshold reaches. `sensor_points` are those in the
    box itself; see `find_points_in_boxes`.

    A rig may hit what the reference has no point of. What can be seen of such a box is at most its sides that face the
    vehicle (from 1.7 m above its origin), with their square metres: the share of these is a lower bound.

    The reference sensor is itself occluded: it looks from beside the ego, so a box that nothing can see from there, nor
    the rig, is unknown, and of a box that is known the far side is missing. `SurfaceReference(object_points=...)` asks
    about every object, so that such a box is `hidden`; other references leave it open.

    Args:
        sensor: (N, 3) points of the rig in the vehicle frame in metres, all of them. N = 0: nothing was seen, so the
            radius is infinite and the share 0.
        reference: (M, 3) points of the reference sensor in the same frame. M = 0: every box is unknown.
        boxes: K objects of the same instant; K = 0 gives an empty result.
        threshold_m: Radius in metres up to which a point counts as seen.
        reference_weights: (M,) weight of each reference point, positive: `frame.reference_weights`. None if they weigh
            the same, as those of a frame that has none do.

    Returns:
        `BoxVisibility` on the device of `reference`.

    Raises:
        ValueError: No reference, a negative threshold, NaN, weights that are not positive, or shapes that do not fit.
        TypeError: A cloud is no floating-point tensor, or the boxes are none.

    Example:
        >>> boxes = Boxes.from_rows(torch.tensor([[10.0, 0, 1, 4, 2, 2, 0], [30.0, 0, 1, 4, 2, 2, 0]]))
        >>> reference = torch.tensor([[8.0, 0.0, 0.5], [8.0, 0.0, 1.5]])
        >>> sensor = torch.tensor([[8.0, 0.0, 0.6]])
        >>> seen = measure_box_visibility(sensor, reference, boxes, reference_weights=torch.tensor([1.0, 3.0]))
        >>> seen.share, seen.reference_points
        (tensor([0.2500,    nan], dtype=torch.float64), tensor([2, 0]))
    """
    check_boxes(boxes)
    _check(sensor, reference, threshold_m, reference_weights)
    if not has_float64(reference.device):
        weights = None if reference_weights is None else reference_weights.cpu()
        there = measure_box_visibility(
            sensor.cpu(), reference.cpu(), boxes.to("cpu"), threshold_m, reference_weights=weights
        )
        return there.to(reference.device)
    sensor, boxes = sensor.to(reference.device), boxes.to(reference.device)
    box, point = find_points_in_boxes(reference, boxes)
    asked, weights = reference[point], None if reference_weights is None else reference_weights[point]
    reference_points = torch.bincount(box, minlength=len(boxes))
    sensor_points = torch.bincount(find_points_in_boxes(sensor, boxes).box_indices, minlength=len(boxes))
    if only := ((reference_points == 0) & (sensor_points > 0)).nonzero().squeeze(1).tolist():
        sides, side_of, square_metres = _facing_sides(boxes, only)
        weights = asked.new_ones(len(asked)) if weights is None else weights
        asked, box = torch.cat([asked, sides.to(asked)]), torch.cat([box, side_of])
        weights = torch.cat([weights.double(), square_metres])
    # Only the reference may be cropped to the boxes.
    radius = blind_spot_radius(sensor, asked).double()
    return BoxVisibility(
        # A GPU adds weights up in any order, so that even all of them may come to a trifle over the total.
        share=compute_box_means((radius <= threshold_m).double(), box, len(boxes), weights).clamp(max=1.0),
        mean_radius_m=compute_box_means(radius, box, len(boxes), weights),
        reference_points=reference_points,
        sampled_points=boxes.sampled_points,
        sensor_points=sensor_points,
        threshold_m=float(threshold_m),
    )


def _facing_sides(boxes: Boxes, which: list[int]) -> tuple[Tensor, Tensor, Tensor]:
    """Points on the sides of some boxes that face the vehicle, the number of the box of each, and its square metres."""
    number = torch.tensor(which, device=boxes.yaw_rad.device)
    centre_m, half_m, yaw_rad = (of.double()[number] for of in (boxes.center_m, boxes.size_m / 2, boxes.yaw_rad))
    turn = torch.stack([yaw_rad.cos(), yaw_rad.sin()], dim=1)
    along, across = turn, torch.stack([-turn[:, 1], turn[:, 0]], dim=1)
    from_m = centre_m.new_tensor([0.0, 0.0, SEEN_FROM_M]) - centre_m
    seen_from_m = torch.stack([(from_m[:, :2] * along).sum(1), (from_m[:, :2] * across).sum(1), from_m[:, 2]], dim=1)
    steps = (torch.arange(SIDE_POINTS, device=number.device).double() + 0.5) * 2 / SIDE_POINTS - 1
    first, second = (grid.reshape(-1) for grid in torch.meshgrid(steps, steps, indexing="ij"))
    points, owners, areas = [], [], []
    for axis, (one, other) in enumerate(((1, 2), (0, 2), (0, 1))):
        facing = (seen_from_m[:, axis].abs() > half_m[:, axis]).nonzero().squeeze(1)
        if axis == 2:  # what stands on the ground has no underside
            facing = facing[seen_from_m[facing, 2] > 0]
        local_m = centre_m.new_empty(len(facing), len(first), 3)
        local_m[..., axis] = (half_m[facing, axis] * seen_from_m[facing, axis].sign())[:, None]
        local_m[..., one], local_m[..., other] = half_m[facing, one, None] * first, half_m[facing, other, None] * second
        flat_m = local_m[..., :1] * along[facing, None] + local_m[..., 1:2] * across[facing, None]
        points.append((torch.cat([flat_m, local_m[..., 2:]], dim=2) + centre_m[facing, None]).reshape(-1, 3))
        owners.append(number[facing].repeat_interleave(len(first)))
        side_m2 = 4 * half_m[facing, one] * half_m[facing, other]
        areas.append((side_m2 / len(first)).repeat_interleave(len(first)))
    return torch.cat(points), torch.cat(owners), torch.cat(areas)


def compute_box_means(values: Tensor, box_indices: Tensor, num_boxes: int, weights: Tensor | None) -> Tensor:
    """(K,) weighted mean over the points in each of K boxes, all alike without weights; NaN for a box without any.

    Example:
        >>> compute_box_means(torch.tensor([1.0, 0.0]).double(), torch.tensor([1, 1]), 2, torch.tensor([1.0, 3.0]))
        tensor([   nan, 0.2500], dtype=torch.float64)
    """
    weight = torch.ones_like(values) if weights is None else weights.to(values)
    total, whole = values.new_zeros(2, num_boxes).unbind()
    total.index_add_(0, box_indices, values * weight)
    return total / whole.index_add_(0, box_indices, weight)  # 0 / 0 is NaN


def _check(sensor: Tensor, reference: Tensor, threshold: float, weights: Tensor | None) -> None:
    if reference is None:
        raise ValueError(
            "reference: the frame has none, and visibility is measured against it; use frames of SimulatedFrames, or a "
            "recording with a reference cloud"
        )
    check_cloud(reference, "reference")
    check_cloud(sensor, "sensor")
    if not threshold >= 0:
        raise ValueError(f"threshold: a distance >= 0 in metres is needed; got {threshold}")
    check_weights(weights, len(reference), "reference_weights")


# `torch.load` gives them back with weights_only=True, its default.
torch.serialization.add_safe_globals([BoxVisibility])
