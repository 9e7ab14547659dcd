"""Recall and precision of a detector over what was visible, frame by frame as it finds it."""

import math
import warnings
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import torch
from torch import Tensor

from torchcover.detection.boxes import Boxes, check_boxes
from torchcover.detection.matching import MatchBy, match_detections
from torchcover.detection.recall_curve import DetectionCounts, plot_recall
from torchcover.detection.visibility import BoxVisibility
from torchcover.metrics import MergeableMetric, get_figure
from torchcover.neighbors import check_tensor

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

T = TypeVar("T")

# A box looks as if z were that of its bottom if its center is lower than this share of its height above z = 0.
LOW_CENTER = 0.15
# The share of boxes that look so, and how many there have to be, for a warning.
MOST_LOW = 0.9
MIN_BOXES = 20


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
        self.ground_truth = boxes.rows.detach().cpu().double()
        self.visibility_share = _shares(visibility, len(boxes), "visibility")
        self.is_hidden = _hidden(visibility, len(boxes))
        given = torch.zeros(len(bad), device="cpu") if scores is None else scores.detach().cpu()
        if given.shape != (len(bad),) or given.isnan().any():
            raise ValueError(
                f"scores: one number for each of {len(bad)} detections is needed; got shape {tuple(given.shape)} with "
                f"{int(given.isnan().sum())} NaN"
            )
        # Without scores every detection counts at every threshold.
        self.scores = given.double() if scores is not None else given.double() + math.inf
        unknown = torch.full((len(bad),), math.nan, device="cpu")
        own = unknown if detection_visibility is None else detection_visibility
        self.detection_visibility_share = _shares(own, len(bad), "detection_visibility")
        self.is_detection_hidden = _hidden(own, len(bad))


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
    return (
        visibility.hidden.cpu()
        if isinstance(visibility, BoxVisibility)
        else torch.zeros(count, dtype=torch.bool, device="cpu")
    )


class RecallByVisibility(MergeableMetric):
    """Recall and precision in bins of visibility and of distance, so that a miss and a blind spot can be told apart.

    Detections are matched to objects by `torchcover.detection.match_detections`. An object's visibility is its share from
    `measure_box_visibility`, and its distance that of its centre from the vehicle's origin, over ground. Bins are half-open
    [lo, hi), the last ones closed by 1 and open to infinity. Objects of unknown visibility have two bins of their own:
    those "hidden" from the reference's places too, and those "not sampled"; see `BoxVisibility.hidden`.

    A false detection has no object, so precision goes by the visibility and distance of the detection's own box; see
    `update`. All objects and detections count, whatever their category: give one category at a time for figures by
    category.

    The state is a few counts, whatever the number of frames, which is `steps`; as every `MergeableMetric`, metrics with
    the same parameters merge, and ranks are added up when `compute` is called.

    Args:
        match_by: "distance" of the centres over ground, or "iou", the overlap seen from above.
        threshold: Of the match, in metres or as a share; 2 m, the third of nuScenes' four thresholds, or 0.5 if None.
        visibility_borders: Borders between bins of visibility, ascending, within (0, 1).
        distance_borders: Borders between bins of distance in metres, ascending, positive.
        score_thresholds: Detections with lower scores do not count; recall and precision have a row for each.
        kwargs: For `torchmetrics.Metric` (`sync_on_compute`, `dist_sync_fn`, ...).

    Raises:
        ValueError: An unknown way to match, a threshold or borders out of range or order, no score threshold.

    Example:
        >>> truth = Boxes.from_rows(torch.tensor([[9.0, 0, 1, 4, 2, 2, 0], [30.0, 0, 1, 4, 2, 2, 0]]))
        >>> metric = RecallByVisibility(visibility_borders=(0.5,), distance_borders=(20.0,))
        >>> metric.update(truth.rows[:1], truth, torch.tensor([0.9, 0.1]))
        >>> curve = metric.compute().over("visibility")
        >>> curve.bins, curve.recall.trials
        (('0-0.5', '0.5-1', 'hidden', 'not sampled'), tensor([[1, 1, 0, 0]]))
        >>> curve.recall.value
        tensor([[0., 1., nan, nan]], dtype=torch.float64)
    """

    objects: Tensor
    detected_objects: Tensor
    detections: Tensor
    true_detections: Tensor

    def __init__(
        self,
        *,
        match_by: MatchBy = "distance",
        threshold: float | None = None,
        visibility_borders: Sequence[float] = (0.2, 0.4, 0.6, 0.8),
        distance_borders: Sequence[float] = (20.0, 40.0, 60.0),
        score_thresholds: Sequence[float] = (-math.inf,),
        **kwargs: Any,  # noqa: ANN401  (whatever torchmetrics takes)
    ) -> None:
        threshold = float({"distance": 2.0, "iou": 0.5}.get(match_by, 0.0) if threshold is None else threshold)
        borders = {
            "visibility_borders": tuple(float(border) for border in visibility_borders),
            "distance_borders": tuple(float(border) for border in distance_borders),
        }
        scores = tuple(float(score) for score in score_thresholds)
        _check_parameters(match_by, threshold, borders, scores)
        super().__init__(
            {"match_by": match_by, "threshold": threshold, **borders, "score_thresholds": scores}, **kwargs
        )
        self._box_counts: tuple[int, int] | None = (0, 0)  # low and all; None once it has been warned of
        self.match_by = match_by
        self.threshold = threshold
        self.visibility_borders = borders["visibility_borders"]
        self.distance_borders = borders["distance_borders"]
        self.score_thresholds = scores
        bins = (len(self.visibility_borders) + 3, len(self.distance_borders) + 1)
        self.define_sum("objects", bins, torch.int64)
        for name in ("detected_objects", "detections", "true_detections"):
            self.define_sum(name, (len(self.score_thresholds), *bins), torch.int64)

    def update(
        self,
        detections: Tensor | Sequence[Tensor],
        boxes: Boxes | Sequence[Boxes],
        visibility: BoxVisibility | Tensor | Sequence[BoxVisibility | Tensor],
        scores: Tensor | Sequence[Tensor] | None = None,
        detection_visibility: BoxVisibility | Tensor | Sequence[BoxVisibility | Tensor] | None = None,
    ) -> None:
        """Add a frame, or lists with one entry for each frame.

        Args:
            detections: (N, 7) x, y, z of the centre, length, width, height, yaw; further columns are ignored.
            boxes: The K objects.
            visibility: What `measure_box_visibility` said of them, or (K,) shares, NaN where they were not sampled.
            scores: (N,) scores; without them, detections choose their objects in the order given and all count.
            detection_visibility: What `measure_box_visibility` says of the detections' boxes, or (N,) shares. Without it,
                precision is known over distance only: detections are in the bin of what was not sampled.

        Raises:
            ValueError: Lists of different lengths, shapes that do not fit, NaN in detections or scores, a negative
                size, shares outside [0, 1].
            TypeError: Boxes that are none, as those of a frame in which nobody looked for objects.
        """
        frames = [_as_list(given) for given in (detections, boxes, visibility)]
        count = len(frames[0])
        frames += [[None] * count if given is None else _as_list(given) for given in (scores, detection_visibility)]
        if len({len(column) for column in frames}) > 1:
            lengths = ", ".join(str(len(column)) for column in frames)
            raise ValueError(
                f"one entry for each frame is needed in every list; got {lengths} entries (detections, boxes, "
                "visibility, scores, detection_visibility)"
            )
        checked = [DetectedFrame(*frame) for frame in zip(*frames, strict=True)]
        for frame in checked:
            self._add_frame(frame)
        self._warn_of_low_boxes(torch.cat([frame.ground_truth for frame in checked]) if checked else None)

    def _warn_of_low_boxes(self, truth: Tensor | None) -> None:
        """Warn once if the centers of most objects so far are on the ground, as if z were that of the bottom."""
        if truth is None or self._box_counts is None:
            return
        low = (truth[:, 2].abs() < LOW_CENTER * truth[:, 5]).sum()
        self._box_counts = (self._box_counts[0] + int(low), self._box_counts[1] + len(truth))
        if self._box_counts[1] >= MIN_BOXES and self._box_counts[0] > MOST_LOW * self._box_counts[1]:
            warnings.warn(
                f"boxes: {self._box_counts[0]} of {self._box_counts[1]} have their center on the ground; z has to be "
                "that of the center, not of the bottom: add half of the height",
                stacklevel=3,
            )
            self._box_counts = None

    @torch.no_grad()
    def _add_frame(self, frame: DetectedFrame) -> None:
        chosen = match_detections(frame.detections, frame.scores, frame.ground_truth, self.match_by, self.threshold)
        hit = chosen >= 0
        # The score at which an object is found; NaN, at no threshold, if it is not.
        found_at = torch.full((len(frame.ground_truth),), math.nan, dtype=torch.float64, device="cpu")
        found_at[chosen[hit]] = frame.scores[hit]
        object_bin = self._bin(frame.ground_truth, frame.visibility_share, frame.is_hidden)
        detection_bin = self._bin(frame.detections, frame.detection_visibility_share, frame.is_detection_hidden)
        counts = [frame.scores >= score for score in self.score_thresholds]
        self.objects += self._counted([object_bin])[0]
        self.detected_objects += self._counted([object_bin[found_at >= score] for score in self.score_thresholds])
        self.detections += self._counted([detection_bin[some] for some in counts])
        self.true_detections += self._counted([detection_bin[some & hit] for some in counts])
        self.num_frames += 1

    def _bin(self, rows: Tensor, share: Tensor, hidden: Tensor) -> Tensor:
        distance = torch.linalg.vector_norm(rows[:, :2].double(), dim=1)
        column = torch.bucketize(
            distance, torch.tensor(self.distance_borders, dtype=torch.float64, device="cpu"), right=True
        )
        line = torch.bucketize(
            share, torch.tensor(self.visibility_borders, dtype=torch.float64, device="cpu"), right=True
        )
        line[share.isnan()] = len(self.visibility_borders) + 2
        line[hidden] = len(self.visibility_borders) + 1
        return line * (len(self.distance_borders) + 1) + column

    def _counted(self, lists: list[Tensor]) -> Tensor:
        """(lists, V, D) how many entries of each list fall into each bin."""
        rows = [torch.bincount(bins, minlength=self.objects.numel()) for bins in lists]
        return torch.stack(rows).view(len(lists), *self.objects.shape).to(self.objects.device)

    def compute(self) -> DetectionCounts:
        """The counts so far, which give recall and precision: `over("visibility")`, `over("distance")`, `overall()`."""
        visibility, distance = (0.0, *self.visibility_borders, 1.0), (0.0, *self.distance_borders)
        return DetectionCounts(
            objects=self.objects.clone(),
            detected_objects=self.detected_objects.clone(),
            detections=self.detections.clone(),
            true_detections=self.true_detections.clone(),
            visibility_bins=(*(f"{a:g}-{b:g}" for a, b in pairwise(visibility)), "hidden", "not sampled"),
            distance_bins=(
                *(f"{a:g}-{b:g} m" for a, b in pairwise(distance)),
                f"over {distance[-1]:g} m",
            ),
            score_thresholds=self.score_thresholds,
            num_frames=int(self.num_frames),
        )

    def plot(
        self,
        val: DetectionCounts | None = None,
        ax: "Axes | None" = None,
        *,
        axis: Literal["visibility", "distance"] = "visibility",
        score_threshold: float | None = None,
    ) -> "tuple[Figure, Axes]":
        """Draw recall over visibility or distance, with its 95 % Wilson intervals and the number of objects.

        Args:
            val: What `compute` or `forward` returned; the counts so far if not given.
            ax: Where to; a new figure of pyplot's if not given.
            axis: What the bins are of.
            score_threshold: One of `score_thresholds`; the first if not given.

        Raises:
            TypeError: `val` is no `DetectionCounts`.
            ValueError: No such score threshold.
        """
        counts = self.compute() if val is None else val
        if not isinstance(counts, DetectionCounts):
            raise TypeError(f"val: DetectionCounts, as of compute(), are needed; got {type(counts).__name__}")
        score = counts.score_thresholds[0] if score_threshold is None else score_threshold
        if score not in counts.score_thresholds:
            raise ValueError(f"score_threshold: one of {counts.score_thresholds} is needed; got {score}")
        fig, ax = get_figure(ax)
        plot_recall(counts.compute_curve(axis), counts.score_thresholds.index(score), ax)
        ax.set_xlabel(f"{axis} of the object; below, objects")
        return fig, ax


def _check_parameters(
    by: str, threshold: float, borders: dict[str, tuple[float, ...]], scores: tuple[float, ...]
) -> None:
    if by not in ("distance", "iou"):
        raise ValueError(f"by: 'distance' or 'iou' is needed; got {by!r}")
    if not 0 < threshold < math.inf or (by == "iou" and threshold > 1):
        raise ValueError(f"threshold: metres > 0, or a share in (0, 1] for 'iou', is needed; got {threshold}")
    for (name, given), highest in zip(borders.items(), (1.0, math.inf), strict=True):
        if not all(low < high for low, high in pairwise((0.0, *given, highest))):
            raise ValueError(f"{name}: ascending numbers within (0, {highest:g}) are needed; got {given}")
    if not scores or any(math.isnan(score) for score in scores):
        raise ValueError(f"score_thresholds: at least one number is needed; got {scores}")


def _as_list(given: T | Sequence[T]) -> list[Any]:
    return list(given) if isinstance(given, (list, tuple)) else [given]
