"""Assignment of detections to ground-truth objects."""

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from torchcover.devices import run_with_float64
from torchcover.neighbors import check_tensor

MatchBy = Literal["distance", "iou"]


@run_with_float64
def compute_bev_iou(first_rows: Tensor, second_rows: Tensor) -> Tensor:
    """Compute the intersection over union of boxes in bird's-eye view, exact for any yaw.

    Args:
        first_rows: (N, 7) x, y, z of the center, length, width, height, yaw.
        second_rows: (M, 7) rows in the same layout.

    Returns:
        (N, M) float64; 0 if neither box has an area.

    Example:
        >>> a = torch.tensor([[0.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]])
        >>> b = torch.tensor([[1.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]])
        >>> compute_bev_iou(a, b)
        tensor([[0.6000]], dtype=torch.float64)
    """
    first_rows, second_rows = first_rows.double(), second_rows.double()
    overlap = first_rows.new_zeros(len(first_rows), len(second_rows))
    radius = [torch.linalg.vector_norm(boxes[:, 3:5], dim=1) / 2 for boxes in (first_rows, second_rows)]
    is_near = (
        torch.linalg.vector_norm(first_rows[:, None, :2] - second_rows[None, :, :2], dim=2)
        < radius[0][:, None] + radius[1]
    )
    i, j = is_near.nonzero(as_tuple=True)
    overlap[i, j] = _compute_intersection_m2(first_rows[i], second_rows[j])
    union = (first_rows[:, 3] * first_rows[:, 4])[:, None] + (second_rows[:, 3] * second_rows[:, 4])[None] - overlap
    return torch.where(union > 0, overlap / union.where(union > 0, 1.0), 0.0)


@run_with_float64
def match_detections(
    detections: Tensor, scores: Tensor, ground_truth: Tensor, match_by: MatchBy, threshold: float
) -> Tensor:
    """Match detections to objects greedily, in descending order of the score.

    As in nuScenes (Caesar et al. 2020), each detection takes the nearest object that is not yet taken, if the distance
    of the centers over ground is below the threshold (0.5, 1, 2 and 4 m there). With
    `match_by="iou"` it takes the object with the largest overlap in bird's-eye view, if the overlap is at least the
    threshold (0.7 for cars and 0.5 for other categories in KITTI). Detections with equal scores choose in the given
    order.

    Args:
        detections: (N, 7) x, y, z of the center, length, width, height, yaw.
        scores: (N,) scores.
        ground_truth: (K, 7) objects in the same layout.
        match_by: "distance" or "iou".
        threshold: Distance in meters, or overlap as a share.

    Returns:
        (N,) int64 index of the object of each detection, -1 if it has none; on the CPU.

    Raises:
        ValueError: Another `match_by`, or the number of scores differs from that of detections.
        TypeError: An argument is not a tensor.

    Example:
        >>> truth = torch.tensor([[10.0, 0.0, 0.7, 4.5, 1.8, 1.4, 0.0]])
        >>> match_detections(truth.repeat(2, 1), torch.tensor([0.2, 0.9]), truth, match_by="distance", threshold=2.0)
        tensor([-1,  0])
    """
    if match_by not in ("distance", "iou"):
        raise ValueError(f"match_by: 'distance' or 'iou' is needed; got {match_by!r}")
    for name, tensor in (("detections", detections), ("scores", scores), ("ground_truth", ground_truth)):
        check_tensor(tensor, name)
    if scores.shape != (len(detections),):
        raise ValueError(f"scores: one for each of {len(detections)} detections is needed; got {tuple(scores.shape)}")
    if match_by == "distance":
        # From differences: the matrix product of cdist would lose centimeters at 100 m.
        offset = detections[:, None, :2].double() - ground_truth[None, :, :2].double()
        cost = torch.linalg.vector_norm(offset, dim=2)
        allowed = cost < threshold
    else:
        cost = -compute_bev_iou(detections, ground_truth)
        allowed = cost <= -threshold
    # Each choice depends on the previous ones, hence a loop over the detections near an object.
    costs = cost.where(allowed, torch.inf).cpu().numpy()
    object_indices = np.full(len(detections), -1, dtype=np.int64)
    has_choice = np.isfinite(costs).any(axis=1)
    for number in scores.argsort(descending=True, stable=True).tolist():
        if has_choice[number]:
            nearest = int(costs[number].argmin())
            if np.isfinite(costs[number, nearest]):
                object_indices[number] = nearest
                costs[:, nearest] = np.inf
    return torch.from_numpy(object_indices)


def _compute_intersection_m2(a: Tensor, b: Tensor) -> Tensor:
    """Compute the area that each of (P, 7) boxes shares with the box of the same row, in bird's-eye view.

    In the frame of b, the area of a within the rectangle of b is the integral of -clamp(y) d clamp(x) along the outline
    of a, counter-clockwise, where clamp limits a coordinate to the rectangle (Green's theorem). Between the points at
    which an edge crosses the line of a side both are linear, so trapezoids are exact. The result does not depend on a
    test which corner lies in which box, which rounding could decide.
    """
    x, y = (_compute_corners_m(a) - b[:, None, :2]).unbind(dim=-1)
    cosine, sine = b[:, None, 6].cos(), b[:, None, 6].sin()
    # (P, 4 edges, 2 axes)
    start = torch.stack([x * cosine + y * sine, y * cosine - x * sine], dim=-1)
    edge = start.roll(-1, dims=1) - start
    half = b[:, None, 3:5] / 2
    crossings = torch.cat([(-half - start) / edge, (half - start) / edge], dim=-1)
    # The clamped coordinates are linear along an edge that is parallel to a side.
    crossings = crossings.nan_to_num(nan=0.0, posinf=1.0, neginf=0.0).clamp(0.0, 1.0)
    ends = torch.tensor([0.0, 1.0], dtype=a.dtype, device=a.device).expand(*crossings.shape[:-1], 2)
    parameter = torch.cat([crossings, ends], dim=-1).sort(dim=-1).values
    knot = start[..., None, :] + parameter[..., None] * edge[..., None, :]
    x, y = knot.maximum(-half[..., None, :]).minimum(half[..., None, :]).unbind(dim=-1)
    area = -((y[..., 1:] + y[..., :-1]) / 2 * x.diff(dim=-1)).sum(dim=(-2, -1))
    return area.where(area > 0, 0.0)


def _compute_corners_m(boxes: Tensor) -> Tensor:
    """Compute the (N, 4, 2) corners in bird's-eye view, counter-clockwise."""
    signs = torch.tensor([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]], dtype=boxes.dtype, device=boxes.device)
    along, across = (signs * boxes[:, None, 3:5] / 2).unbind(dim=-1)
    cosine, sine = boxes[:, None, 6].cos(), boxes[:, None, 6].sin()
    rotated = torch.stack([along * cosine - across * sine, along * sine + across * cosine], dim=-1)
    return boxes[:, None, :2] + rotated
