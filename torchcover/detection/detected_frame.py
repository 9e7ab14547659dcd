"""One frame of what a detector found, as it comes in."""

import math

import torch
from torch import Tensor

from torchcover.detection.boxes import Boxes, check_boxes
from torchcover.detection.visibility import BoxVisibility
from torchcover.neighbors import check_tensor


class DetectedFrame:
    """The objects and the detections of one frame in float64 on the CPU, checked."""

    def __init__(
        self,
        detections: Tensor,
        boxes: Boxes,
        visibility: BoxVisibility | Tensor,
        scores: Tensor | None,
        detection_visibility: BoxVisibility | Tensor | None,
    ) -> None:
        check_boxes(boxes)
        check_tensor(detections, "detections")
        if scores is not None:
            check_tensor(scores, "scores")
        if detections.ndim != 2 or detections.shape[1] < 7:
            raise ValueError(
                f"detections: shape (N, 7) is needed, x y z length width height yaw; got {tuple(detections.shape)}"
            )
        self.detections = detections[:, :7].detach().cpu().double()
        bad = ~self.detections.isfinite().all(dim=1) | (self.detections[:, 3:6] < 0).any(dim=1)
        if bad.any():
            raise ValueError(
                f"detections: {int(bad.sum())} of {len(bad)} have NaN or infinite numbers or a negative size, "
                f"the first is {int(bad.nonzero()[0])}; drop them"
            )
        self.truth = boxes.rows.detach().cpu().double()
        self.share = _shares(visibility, len(boxes), "visibility")
        self.hidden = _hidden(visibility, len(boxes))
        given = torch.zeros(len(bad)) if scores is None else scores.detach().cpu()
        if given.shape != (len(bad),) or given.isnan().any():
            raise ValueError(
                f"scores: one number for each of {len(bad)} detections is needed; got shape {tuple(given.shape)} with "
                f"{int(given.isnan().sum())} NaN"
            )
        # Without scores every detection counts at every threshold.
        self.scores = given.double() if scores is not None else given.double() + math.inf
        unknown = torch.full((len(bad),), math.nan)
        own = unknown if detection_visibility is None else detection_visibility
        self.detection_share = _shares(own, len(bad), "detection_visibility")
        self.detection_hidden = _hidden(own, len(bad))


def _shares(visibility: BoxVisibility | Tensor, count: int, name: str) -> Tensor:
    share = visibility.share if isinstance(visibility, BoxVisibility) else visibility
    check_tensor(share, name)
    share = share.detach().cpu().double()
    if share.shape != (count,) or ((share < 0) | (share > 1)).any():
        raise ValueError(
            f"{name}: {count} shares in [0, 1] are needed, NaN where unknown; got shape {tuple(share.shape)}, "
            f"{int(((share < 0) | (share > 1)).sum())} of them outside"
        )
    return share


def _hidden(visibility: BoxVisibility | Tensor, count: int) -> Tensor:
    """(count,) whether the reference's places were asked, and saw nothing; which mere shares do not say."""
    return visibility.hidden.cpu() if isinstance(visibility, BoxVisibility) else torch.zeros(count, dtype=torch.bool)
