"""How much of each object a rig sees, and how many objects it hits."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchcover.contrib.frame_metric import WorldRatios, said
from torchcover.contrib.object_strata import CATEGORIES, RANGE_BORDERS_M, ObjectStrata
from torchcover.contrib.sights import rig_of
from torchcover.detection.visibility import mean_by_box
from torchcover.frames import Frame

HITS = (1, 5, 10)


class ObjectCoverage(WorldRatios):
    """Mean over objects of the share that the rig sees, and share of objects with n points of the rig or more.

    The share of one object is that of `torchcover.detection.box_visibility`: of what the reference's places see of it,
    in square metres where the weights are; an object of which they see nothing is unknown and not in the mean. Hits are
    counted over all objects, those that are hidden from everywhere among them.

    Args:
        threshold_m: Distance within which a point counts as seen.
        hits: Numbers of points, n.
        categories: Those that have numbers of their own.
        range_borders_m: Borders between bins of range; farther objects do not count.
        kwargs: `rig` and `sights` of `FrameMetric`, and those of `torchmetrics.Metric`.

    Raises:
        ValueError: A threshold that is negative, n below 1, categories or borders that make no sense. From `update`:
            a frame without boxes.

    Example:
        >>> from torchcover.detection import Boxes
        >>> boxes = Boxes.from_rows(torch.tensor([[10.0, 0, 1, 4, 2, 2, 0]]), categories=("car",))
        >>> reference = torch.tensor([[8.0, 0.0, 0.5], [8.0, 0.0, 1.5]])
        >>> metric = ObjectCoverage()
        >>> metric.update(Frame({"rig": torch.tensor([[8.0, 0.0, 0.6]])}, reference, 0, "a", boxes=boxes))
        >>> [(one.quantity.key, one.value) for one in metric.compute() if one.known and ":" not in one.quantity.key]
        [('object_coverage_0.4m', 0.5), ('objects_hit_1', 1.0), ('objects_hit_5', 0.0), ('objects_hit_10', 0.0)]
    """

    def __init__(
        self,
        threshold_m: float = 0.4,
        hits: Sequence[int] = HITS,
        categories: Sequence[str] = CATEGORIES,
        range_borders_m: Sequence[float] = RANGE_BORDERS_M,
        **kwargs: Any,  # noqa: ANN401  (whatever torchmetrics takes)
    ) -> None:
        if not 0 <= threshold_m < float("inf"):
            raise ValueError(f"threshold_m: a finite distance >= 0 in metres is needed; got {threshold_m}")
        if not hits or any(least < 1 for least in hits) or len(set(hits)) < len(hits):
            raise ValueError(f"hits: different numbers of points from 1 on are needed; got {tuple(hits)}")
        strata = ObjectStrata(categories, range_borders_m)
        names = [f"object_coverage_{threshold_m:g}m", *(f"objects_hit_{least}" for least in hits)]
        given: list[dict[str, Any]] = [{"threshold_m": threshold_m}, *({"hits": least} for least in hits)]
        within: dict[str, Any] = {"range_m": strata.range_borders_m[-1]}
        ratios = [
            said(name + stratum, "share", "objects", **parameters, **within)
            for name, parameters in zip(names, given, strict=True)
            for stratum in strata.names
        ]
        super().__init__(ratios, {"threshold_m": float(threshold_m), "hits": tuple(hits), **strata.meaning}, **kwargs)
        self.strata = strata
        self.threshold_m = float(threshold_m)
        self.hits = tuple(hits)

    def _of_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        rig, boxes = rig_of(frame, self.rig), self.sights.boxes(frame)
        seen = self.sights.distance(frame, rig, self.threshold_m) <= self.threshold_m
        box, point = self.sights.reference_in_boxes(frame)
        weights = None if frame.reference_weights is None else frame.reference_weights[point]
        share = mean_by_box(seen[point].double(), box, len(boxes), weights)
        known = ~share.isnan()
        hits = self.sights.hits(frame, rig).to(share.device)
        # (1 + hits, K) of each object, whether it counts, and with what.
        counts = torch.stack([known.double(), *[torch.ones_like(share)] * len(self.hits)])
        values = torch.stack([share.where(known, 0.0), *((hits >= least).double() for least in self.hits)])
        members = self.sights.members(frame, self.strata).to(share.device)
        base = (counts @ members.T).flatten()
        return base, (values @ members.T).flatten(), base.long()
