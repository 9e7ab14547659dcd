"""Visibility of objects: share of the surface of each bounding box that a rig detects."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchcover.detection.boxes import Boxes, check_boxes
from torchcover.detection.inside import find_points_in_boxes
from torchcover.devices import has_float64, move_tensor
from torchcover.neighbors import blind_spot_radius, check_cloud, check_weights
from torchcover.notebooks import format_short_repr

# Sides of a box that face a point at this height (typical roof of a car) above the vehicle origin count as visible.
VIEWPOINT_HEIGHT_M = 1.7
# Number of sample points along each axis of a side.
POINTS_PER_SIDE_AXIS = 12


@dataclass(frozen=True, eq=False, repr=False)
class BoxVisibility:
    """Visibility of each of K boxes, in float64; NaN for boxes without any reference or sensor point.

    Args:
        share: (K,) detected share of the surface in the box that the reference observed; for boxes in which only the
            rig has points, detected share of the sides that face the vehicle.
        mean_radius_m: (K,) mean blind spot radius of the same points.
        reference_points: (K,) int64 index of reference points in the box.
        sampled_points: (K,) int64 index of points that the reference sampled on the object, from `Boxes`.
        sensor_points: (K,) int64 index of sensor points in the box.
        threshold_m: Detection threshold.
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
        """(K,) bool: the box contains reference points or sensor points."""
        return ~self.share.isnan()

    @property
    def hidden(self) -> Tensor:
        """(K,) bool: the reference sampled points on the object and none is visible from its poses.

        Boxes that are neither observed nor hidden were not sampled, so their visibility is unknown.
        """
        return ~self.observed & (self.sampled_points > 0)

    @property
    def levels(self) -> Tensor:
        """(K,) int64 visibility levels of nuScenes: 1 up to 40 %, 2 up to 60 %, 3 up to 80 %, 4; 0 if unknown.

        nuScenes defines them by the visible pixels of all cameras, here they refer to the surface that the rig detects.
        """
        borders = self.share.new_tensor([0.4, 0.6, 0.8])
        return (torch.bucketize(self.share, borders, right=True) + 1).where(self.observed, 0)

    def __len__(self) -> int:
        return len(self.share)

    def select(self, selection: Tensor) -> "BoxVisibility":
        """Select the results of some of the boxes.

        Args:
            selection: (K,) bool mask, or int64 indices of boxes.

        Returns:
            Results of the selected boxes.
        """
        return self._transform_tensors(lambda tensor: tensor[selection.to(tensor.device)])

    def to(self, device: torch.device | str) -> "BoxVisibility":
        """Copy the result to a device.

        Args:
            device: Target device.

        Returns:
            The copy; its tensors are float32 if the device does not support float64.
        """
        return self._transform_tensors(partial(move_tensor, device=device))

    def _transform_tensors(self, transform: Callable[[Tensor], Tensor]) -> "BoxVisibility":
        names = ("share", "mean_radius_m", "reference_points", "sampled_points", "sensor_points")
        changed: dict[str, Any] = {name: transform(getattr(self, name)) for name in names}
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
    """Compute the share of the surface of each box that the rig detects, and its mean blind spot radius.

        share[k]       = sum over q in box k of w(q) 1(r(q) <= threshold) / sum over q in box k of w(q)
        mean_radius[k] = sum over q in box k of w(q) r(q) / sum over q in box k of w(q)

    with r(q) from `torchcover.blind_spot_radius`. With area weights it is the detected share of the surface that the
    reference observes. The nearest sensor point may lie outside the box: an object next to a detected wall counts as
    detected within the threshold. `sensor_points` counts the points in the box itself, see `find_points_in_boxes`.

    A box may contain sensor points but no reference points. Its sides that face the vehicle (a point 1.7 m above its
    origin) then replace the reference: their detected share is a lower bound of the visibility.

    The reference sensor is close to the ego vehicle and occluded as well: a box without reference and sensor points is
    unknown, and the far side of observed boxes is missing. `SurfaceReference(object_points=...)` samples every object,
    so that such a box is `hidden`; with other references it is not sampled.

    Args:
        sensor: (N, 3) all points of the rig in the vehicle frame in meters. N = 0: the radius is infinite, the share 0.
        reference: (M, 3) points of the reference sensor in the same frame. M = 0: every box is unknown.
        boxes: K objects of the same frame; K = 0 gives an empty result.
        threshold_m: Largest radius that counts as detected.
        reference_weights: (M,) positive weight of each reference point: `frame.reference_weights`. None: equal weights.

    Returns:
        `BoxVisibility` on the device of `reference`.

    Raises:
        ValueError: `reference` is None, a negative threshold, NaN, weights that are not positive, or shapes
            that do not fit.
        TypeError: A cloud is not a floating-point tensor, or `boxes` are not `Boxes`.

    Example:
        >>> boxes = Boxes.from_rows(torch.tensor([[10.0, 0, 1, 4, 2, 2, 0], [30.0, 0, 1, 4, 2, 2, 0]]))
        >>> reference = torch.tensor([[8.0, 0.0, 0.5], [8.0, 0.0, 1.5]])
        >>> sensor = torch.tensor([[8.0, 0.0, 0.6]])
        >>> visibility = measure_box_visibility(sensor, reference, boxes, reference_weights=torch.tensor([1.0, 3.0]))
        >>> visibility.share, visibility.reference_points
        (tensor([0.2500,    nan], dtype=torch.float64), tensor([2, 0]))
    """
    check_boxes(boxes)
    _check_arguments(sensor, reference, threshold_m, reference_weights)
    if not has_float64(reference.device):
        weights = None if reference_weights is None else reference_weights.cpu()
        result = measure_box_visibility(
            sensor.cpu(), reference.cpu(), boxes.to("cpu"), threshold_m, reference_weights=weights
        )
        return result.to(reference.device)
    sensor, boxes = sensor.to(reference.device), boxes.to(reference.device)
    box, point = find_points_in_boxes(reference, boxes)
    queries, weights = reference[point], None if reference_weights is None else reference_weights[point]
    reference_points = torch.bincount(box, minlength=len(boxes))
    sensor_points = torch.bincount(find_points_in_boxes(sensor, boxes).box_indices, minlength=len(boxes))
    if unobserved := ((reference_points == 0) & (sensor_points > 0)).nonzero().squeeze(1).tolist():
        sides, side_box, area_m2 = _sample_facing_sides(boxes, unobserved)
        weights = queries.new_ones(len(queries)) if weights is None else weights
        queries, box = torch.cat([queries, sides.to(queries)]), torch.cat([box, side_box])
        weights = torch.cat([weights.double(), area_m2])
    # The sensor cloud is complete: the nearest point of a query may lie outside the boxes.
    radius = blind_spot_radius(sensor, queries).double()
    return BoxVisibility(
        # The order of sums on a GPU is random, so the share of a fully detected box may exceed 1 by rounding.
        share=compute_box_means((radius <= threshold_m).double(), box, len(boxes), weights).clamp(max=1.0),
        mean_radius_m=compute_box_means(radius, box, len(boxes), weights),
        reference_points=reference_points,
        sampled_points=boxes.sampled_points,
        sensor_points=sensor_points,
        threshold_m=float(threshold_m),
    )


def _sample_facing_sides(boxes: Boxes, box_indices: list[int]) -> tuple[Tensor, Tensor, Tensor]:
    """Sample points on the sides of some boxes that face the vehicle.

    Returns:
        (P, 3) points, (P,) index of the box and (P,) area in square meters of each point.
    """
    index = torch.tensor(box_indices, device=boxes.yaw_rad.device)
    center_m, half_m = boxes.center_m.double()[index], (boxes.size_m / 2).double()[index]
    yaw_rad = boxes.yaw_rad.double()[index]
    heading = torch.stack([yaw_rad.cos(), yaw_rad.sin()], dim=1)
    along, across = heading, torch.stack([-heading[:, 1], heading[:, 0]], dim=1)
    viewpoint_m = center_m.new_tensor([0.0, 0.0, VIEWPOINT_HEIGHT_M]) - center_m
    ahead_m, left_m = (viewpoint_m[:, :2] * along).sum(1), (viewpoint_m[:, :2] * across).sum(1)
    local_viewpoint_m = torch.stack([ahead_m, left_m, viewpoint_m[:, 2]], dim=1)
    offsets = (torch.arange(POINTS_PER_SIDE_AXIS, device=index.device).double() + 0.5) * 2 / POINTS_PER_SIDE_AXIS - 1
    first, second = (grid.reshape(-1) for grid in torch.meshgrid(offsets, offsets, indexing="ij"))
    points_m, indices, areas_m2 = [], [], []
    for axis, (axis_u, axis_v) in enumerate(((1, 2), (0, 2), (0, 1))):
        facing = (local_viewpoint_m[:, axis].abs() > half_m[:, axis]).nonzero().squeeze(1)
        if axis == 2:  # the bottom of a box on the ground is not visible
            facing = facing[local_viewpoint_m[facing, 2] > 0]
        local_m = center_m.new_empty(len(facing), len(first), 3)
        local_m[..., axis] = (half_m[facing, axis] * local_viewpoint_m[facing, axis].sign())[:, None]
        local_m[..., axis_u], local_m[..., axis_v] = (
            half_m[facing, axis_u, None] * first,
            half_m[facing, axis_v, None] * second,
        )
        flat_m = local_m[..., :1] * along[facing, None] + local_m[..., 1:2] * across[facing, None]
        points_m.append((torch.cat([flat_m, local_m[..., 2:]], dim=2) + center_m[facing, None]).reshape(-1, 3))
        indices.append(index[facing].repeat_interleave(len(first)))
        side_m2 = 4 * half_m[facing, axis_u] * half_m[facing, axis_v]
        areas_m2.append((side_m2 / len(first)).repeat_interleave(len(first)))
    return torch.cat(points_m), torch.cat(indices), torch.cat(areas_m2)


def compute_box_means(values: Tensor, box_indices: Tensor, num_boxes: int, weights: Tensor | None) -> Tensor:
    """Compute the weighted mean of values over the points in each box.

    Args:
        values: (P,) values of the points.
        box_indices: (P,) int64 box of each point.
        num_boxes: Number of boxes K.
        weights: (P,) weights; None: equal weights.

    Returns:
        (K,) means; NaN for boxes without points.

    Example:
        >>> compute_box_means(torch.tensor([1.0, 0.0]).double(), torch.tensor([1, 1]), 2, torch.tensor([1.0, 3.0]))
        tensor([   nan, 0.2500], dtype=torch.float64)
    """
    weight = torch.ones_like(values) if weights is None else weights.to(values)
    weighted_sum, weight_sum = values.new_zeros(2, num_boxes).unbind()
    weighted_sum.index_add_(0, box_indices, values * weight)
    return weighted_sum / weight_sum.index_add_(0, box_indices, weight)  # 0 / 0 is NaN


def _check_arguments(sensor: Tensor, reference: Tensor, threshold: float, weights: Tensor | None) -> None:
    if reference is None:
        raise ValueError(
            "reference: the frame has none, and visibility is measured against it; use frames of SimulatedFrames, or a "
            "recording with a reference cloud"
        )
    check_cloud(reference, "reference")
    check_cloud(sensor, "sensor")
    if not threshold >= 0:
        raise ValueError(f"threshold: a distance >= 0 in meters is needed; got {threshold}")
    check_weights(weights, len(reference), "reference_weights")


# Classes on this list load with `torch.load(weights_only=True)`, the default.
torch.serialization.add_safe_globals([BoxVisibility])
