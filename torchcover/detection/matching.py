"""Which detection found which object."""

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from torchcover.devices import run_with_float64
from torchcover.neighbors import check_tensor

MatchBy = Literal["distance", "iou"]


@run_with_float64
def compute_bev_iou(first_rows: Tensor, second_rows: Tensor) -> Tensor:
    """Intersection over union of boxes seen from above, exact for any yaw.

    Args:
        first_rows: (N, 7) x, y, z of the centre, length, width, height, yaw.
        second_rows: (M, 7) likewise.

    Returns:
        (N, M) float64; 0 where neither box has an area.

    Example:
        >>> a = torch.tensor([[0.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]])
        >>> b = torch.tensor([[1.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]])
        >>> compute_bev_iou(a, b)
        tensor([[0.6000]], dtype=torch.float64)
    """
    first_rows, second_rows = first_rows.double(), second_rows.double()
    overlap = first_rows.new_zeros(len(first_rows), len(second_rows))
    radius = [torch.linalg.vector_norm(boxes[:, 3:5], dim=1) / 2 for boxes in (first_rows, second_rows)]
    near = (
        torch.linalg.vector_norm(first_rows[:, None, :2] - second_rows[None, :, :2], dim=2)
        < radius[0][:, None] + radius[1]
    )
    i, j = near.nonzero(as_tuple=True)
    overlap[i, j] = _intersection(first_rows[i], second_rows[j])
    union = (first_rows[:, 3] * first_rows[:, 4])[:, None] + (second_rows[:, 3] * second_rows[:, 4])[None] - overlap
    return torch.where(union > 0, overlap / union.where(union > 0, 1.0), 0.0)


@run_with_float64
def match_detections(
    detections: Tensor, scores: Tensor, ground_truth: Tensor, match_by: MatchBy, threshold: float
) -> Tensor:
    """Give each detection at most one object, greedily: the higher score chooses first.

    As in nuScenes (Caesar et al. 2020): in the order of descending score, each detection takes the object that is
    nearest to it among those not yet taken, if their centres are closer than the threshold over ground (0.5, 1, 2 and
    4 m there). With `by="iou"` it takes the one with the largest overlap seen from above, if that is at least the
    threshold (0.7 for cars and 0.5 for others in KITTI). Equal scores choose in the order given.

    Args:
        detections: (N, 7) x, y, z of the centre, length, width, height, yaw.
        scores: (N,) scores.
        ground_truth: (K, 7) objects.
        match_by: "distance" or "iou".
        threshold: Metres, or a share.

    Returns:
        (N,) int64 number of the object of each detection, -1 if none; on the CPU.

    Raises:
        ValueError: Another `match_by`, or not one score for each detection.
        TypeError: What is no tensor.

    Example:
        >>> truth = torch.tensor([[10.0, 0.0, 0.7, 4.5, 1.8, 1.4, 0.0]])
        >>> match(truth.repeat(2, 1), torch.tensor([0.2, 0.9]), truth, by="distance", threshold=2.0)
        tensor([-1,  0])
    """
    if match_by not in ("distance", "iou"):
        raise ValueError(f"by: 'distance' or 'iou' is needed; got {match_by!r}")
    for name, given in (("detections", detections), ("scores", scores), ("truth", ground_truth)):
        check_tensor(given, name)
    if scores.shape != (len(detections),):
        raise ValueError(f"scores: one for each of {len(detections)} detections is needed; got {tuple(scores.shape)}")
    if match_by == "distance":
        # From differences: the matrix product of cdist would lose centimetres at 100 m.
        offset = detections[:, None, :2].double() - ground_truth[None, :, :2].double()
        cost = torch.linalg.vector_norm(offset, dim=2)
        allowed = cost < threshold
    else:
        cost = -compute_bev_iou(detections, ground_truth)
        allowed = cost <= -threshold
    # A choice depends on those before it, so this is a loop; only detections near an object take part.
    costs = cost.where(allowed, torch.inf).cpu().numpy()
    taken_by = np.full(len(detections), -1, dtype=np.int64)
    has_choice = np.isfinite(costs).any(axis=1)
    for number in scores.argsort(descending=True, stable=True).tolist():
        if has_choice[number]:
            chosen = int(costs[number].argmin())
            if np.isfinite(costs[number, chosen]):
                taken_by[number] = chosen
                costs[:, chosen] = np.inf
    return torch.from_numpy(taken_by)


def _intersection(a: Tensor, b: Tensor) -> Tensor:
    """(P,) area that each of (P, 7) boxes shares with its partner of (P, 7), seen from above.

    In the frame of b, the area of a within the rectangle of b is the integral of -clamp(y) d clamp(x) along the outline
    of a, counter-clockwise, where clamp keeps a coordinate within the rectangle (Green's theorem). Between the places
    where an edge crosses the line of a side both are linear, so trapezia are exact. Nothing depends on which corner
    lies in which box, where rounding could decide.
    """
    x, y = (_corners(a) - b[:, None, :2]).unbind(dim=-1)
    cosine, sine = b[:, None, 6].cos(), b[:, None, 6].sin()
    # (P, 4 edges, 2 axes)
    start = torch.stack([x * cosine + y * sine, y * cosine - x * sine], dim=-1)
    way = start.roll(-1, dims=1) - start
    half = b[:, None, 3:5] / 2
    crossings = torch.cat([(-half - start) / way, (half - start) / way], dim=-1)
    # Along an edge parallel to a side nothing changes between any two places.
    crossings = crossings.nan_to_num(nan=0.0, posinf=1.0, neginf=0.0).clamp(0.0, 1.0)
    ends = torch.tensor([0.0, 1.0], dtype=a.dtype, device=a.device).expand(*crossings.shape[:-1], 2)
    place = torch.cat([crossings, ends], dim=-1).sort(dim=-1).values
    knot = start[..., None, :] + place[..., None] * way[..., None, :]
    x, y = knot.maximum(-half[..., None, :]).minimum(half[..., None, :]).unbind(dim=-1)
    area = -((y[..., 1:] + y[..., :-1]) / 2 * x.diff(dim=-1)).sum(dim=(-2, -1))
    return area.where(area > 0, 0.0)


def _corners(boxes: Tensor) -> Tensor:
    """(N, 4, 2) corners seen from above, counter-clockwise."""
    signs = torch.tensor([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]], dtype=boxes.dtype, device=boxes.device)
    along, across = (signs * boxes[:, None, 3:5] / 2).unbind(dim=-1)
    cosine, sine = boxes[:, None, 6].cos(), boxes[:, None, 6].sin()
    turned = torch.stack([along * cosine - across * sine, along * sine + across * cosine], dim=-1)
    return boxes[:, None, :2] + turned
