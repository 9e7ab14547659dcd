"""Recall and precision of a detector by visibility and distance, accumulated over frames."""

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

# The center of a box is taken for its bottom if |z| is lower than this share of its height.
LOW_CENTER_SHARE = 0.15
# A warning is issued if more than this share of at least this number of boxes have low centers.
MAX_LOW_SHARE = 0.9
MIN_BOXES = 20


class DetectedFrame:
    """Validated objects and detections of one frame in float64 on the CPU."""

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
                f"the first is {int(bad.nonzero()[0])}; remove them"
            )
        self.ground_truth = boxes.rows.detach().cpu().double()
        self.visibility_share = _get_shares(visibility, len(boxes), "visibility")
        self.is_hidden = _get_hidden(visibility, len(boxes))
        scores_or_zero = torch.zeros(len(bad), device="cpu") if scores is None else scores.detach().cpu()
        if scores_or_zero.shape != (len(bad),) or scores_or_zero.isnan().any():
            raise ValueError(
                f"scores: one number for each of {len(bad)} detections is needed; got shape "
                f"{tuple(scores_or_zero.shape)} with {int(scores_or_zero.isnan().sum())} NaN"
            )
        # Detections without scores count at every threshold.
        self.scores = scores_or_zero.double() if scores is not None else scores_or_zero.double() + math.inf
        unknown = torch.full((len(bad),), math.nan, device="cpu")
        own_visibility = unknown if detection_visibility is None else detection_visibility
        self.detection_visibility_share = _get_shares(own_visibility, len(bad), "detection_visibility")
        self.is_detection_hidden = _get_hidden(own_visibility, len(bad))


def _get_shares(visibility: BoxVisibility | Tensor, count: int, name: str) -> Tensor:
    share = visibility.share if isinstance(visibility, BoxVisibility) else visibility
    check_tensor(share, name)
    share = share.detach().cpu().double()
    if share.shape != (count,) or ((share < 0) | (share > 1)).any():
        raise ValueError(
            f"{name}: {count} shares in [0, 1] are needed, NaN where unknown; got shape {tuple(share.shape)}, "
            f"{int(((share < 0) | (share > 1)).sum())} of them outside"
        )
    return share


def _get_hidden(visibility: BoxVisibility | Tensor, count: int) -> Tensor:
    """(count,) bool: the object was sampled and hidden; False for shares, which do not contain this information."""
    return (
        visibility.hidden.cpu()
        if isinstance(visibility, BoxVisibility)
        else torch.zeros(count, dtype=torch.bool, device="cpu")
    )


class RecallByVisibility(MergeableMetric):
    """Recall and precision in bins of visibility and distance, which separate misses from blind spots.

    Detections are matched to objects by `torchcover.detection.match_detections`. The visibility of an object is its
    share from `measure_box_visibility`, its distance that of its center from the vehicle origin, over ground. Bins are
    half-open [lo, hi); the last ones are closed by 1 and unbounded. Objects of unknown visibility have two more bins:
    "hidden" from the poses of the reference sensor, and "not sampled"; see `BoxVisibility.hidden`.

    A false detection has no object, so the bin of a detection follows from the visibility and distance of its own box;
    see `update`. All categories count together: update one metric for each category for separate figures.

    The state consists of a few counts of constant size; metrics with equal parameters merge, and ranks are added when
    `compute` is called, see `MergeableMetric`.

    Args:
        match_by: "distance" of the centers over ground, or "iou", the overlap in bird's-eye view.
        threshold: Threshold of the match, in meters or as a share; None: 2 m (third of the four
            thresholds of nuScenes) or 0.5.
        visibility_borders: Borders between bins of visibility, ascending, within (0, 1).
        distance_borders: Borders between bins of distance in meters, ascending, positive.
        score_thresholds: Detections with lower scores do not count; recall and precision have a row for each.
        kwargs: Arguments of `torchmetrics.Metric` (`sync_on_compute`, `dist_sync_fn`, ...).

    Raises:
        ValueError: An unknown `match_by`, a threshold or borders out of range or order, no score threshold.

    Example:
        >>> truth = Boxes.from_rows(torch.tensor([[9.0, 0, 1, 4, 2, 2, 0], [30.0, 0, 1, 4, 2, 2, 0]]))
        >>> metric = RecallByVisibility(visibility_borders=(0.5,), distance_borders=(20.0,))
        >>> metric.update(truth.rows[:1], truth, torch.tensor([0.9, 0.1]))
        >>> curve = metric.compute().compute_curve("visibility")
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
        **kwargs: Any,  # noqa: ANN401  (arguments of torchmetrics)
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
        self._box_counts: tuple[int, int] | None = (0, 0)  # low boxes, all boxes; None after the warning
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
            detections: (N, 7) x, y, z of the center, length, width, height, yaw; further columns are ignored.
            boxes: The K objects.
            visibility: Result of `measure_box_visibility`, or (K,) shares, NaN where not sampled.
            scores: (N,) scores; without them, detections choose objects in the given order and all count.
            detection_visibility: Result of `measure_box_visibility` for the boxes of the detections, or (N,) shares.
                Without it, precision is known over distance only: all detections are in the bin "not sampled".

        Raises:
            ValueError: Lists of different lengths, shapes that do not fit, NaN in detections or scores, a negative
                size, shares outside [0, 1].
            TypeError: `boxes` are not `Boxes`, for example None.
        """
        columns = [_to_list(detections), _to_list(boxes), _to_list(visibility)]
        for optional in (scores, detection_visibility):
            columns.append([None] * len(columns[0]) if optional is None else _to_list(optional))
        lengths = [len(column) for column in columns]
        if len(set(lengths)) > 1:
            raise ValueError(
                f"one entry for each frame is needed in every list; got {', '.join(map(str, lengths))} entries "
                "(detections, boxes, visibility, scores, detection_visibility)"
            )
        frames = [DetectedFrame(*frame) for frame in zip(*columns, strict=True)]
        for frame in frames:
            self._add_frame(frame)
        self._warn_of_low_boxes(torch.cat([frame.ground_truth for frame in frames]) if frames else None)

    def _warn_of_low_boxes(self, ground_truth: Tensor | None) -> None:
        """Warn once if the centers of most objects are on the ground, probably because z is that of the bottom."""
        if ground_truth is None or self._box_counts is None:
            return
        low = (ground_truth[:, 2].abs() < LOW_CENTER_SHARE * ground_truth[:, 5]).sum()
        self._box_counts = (self._box_counts[0] + int(low), self._box_counts[1] + len(ground_truth))
        if self._box_counts[1] >= MIN_BOXES and self._box_counts[0] > MAX_LOW_SHARE * self._box_counts[1]:
            warnings.warn(
                f"boxes: {self._box_counts[0]} of {self._box_counts[1]} have their center on the ground; z must be "
                "the center, not the bottom: add half of the height",
                stacklevel=3,
            )
            self._box_counts = None

    @torch.no_grad()
    def _add_frame(self, frame: DetectedFrame) -> None:
        object_index = match_detections(
            frame.detections, frame.scores, frame.ground_truth, self.match_by, self.threshold
        )
        is_match = object_index >= 0
        # Score of the detection that matches an object; NaN, which reaches no threshold, without a match.
        detected_score = torch.full((len(frame.ground_truth),), math.nan, dtype=torch.float64, device="cpu")
        detected_score[object_index[is_match]] = frame.scores[is_match]
        object_bin = self._find_bins(frame.ground_truth, frame.visibility_share, frame.is_hidden)
        detection_bin = self._find_bins(frame.detections, frame.detection_visibility_share, frame.is_detection_hidden)
        masks = [frame.scores >= score for score in self.score_thresholds]
        self.objects += self._count_bins([object_bin])[0]
        self.detected_objects += self._count_bins(
            [object_bin[detected_score >= score] for score in self.score_thresholds]
        )
        self.detections += self._count_bins([detection_bin[mask] for mask in masks])
        self.true_detections += self._count_bins([detection_bin[mask & is_match] for mask in masks])
        self.num_frames += 1

    def _find_bins(self, rows: Tensor, share: Tensor, hidden: Tensor) -> Tensor:
        distance = torch.linalg.vector_norm(rows[:, :2].double(), dim=1)
        column = torch.bucketize(
            distance, torch.tensor(self.distance_borders, dtype=torch.float64, device="cpu"), right=True
        )
        row = torch.bucketize(
            share, torch.tensor(self.visibility_borders, dtype=torch.float64, device="cpu"), right=True
        )
        row[share.isnan()] = len(self.visibility_borders) + 2
        row[hidden] = len(self.visibility_borders) + 1
        return row * (len(self.distance_borders) + 1) + column

    def _count_bins(self, lists: list[Tensor]) -> Tensor:
        """Count the entries of each list of bins: (lists, V, D)."""
        rows = [torch.bincount(bins, minlength=self.objects.numel()) for bins in lists]
        return torch.stack(rows).view(len(lists), *self.objects.shape).to(self.objects.device)

    def compute(self) -> DetectionCounts:
        """Return the counts of all frames; their methods give recall and precision."""
        visibility, distance = (0.0, *self.visibility_borders, 1.0), (0.0, *self.distance_borders)
        return DetectionCounts(
            objects=self.objects.clone(),
            detected_objects=self.detected_objects.clone(),
            detections=self.detections.clone(),
            true_detections=self.true_detections.clone(),
            visibility_bins=(*(f"{low:g}-{high:g}" for low, high in pairwise(visibility)), "hidden", "not sampled"),
            distance_bins=(
                *(f"{low:g}-{high:g} m" for low, high in pairwise(distance)),
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
        """Plot recall over visibility or distance, with its 95 % Wilson intervals and the number of objects.

        Args:
            val: Result of `compute` or `forward`; default: the current counts.
            ax: Target axes; default: a new pyplot figure.
            axis: Axis of the bins.
            score_threshold: Element of `score_thresholds`; default: the first.

        Raises:
            TypeError: `val` is not a `DetectionCounts`.
            ValueError: The score threshold was not counted.
        """
        counts = self.compute() if val is None else val
        if not isinstance(counts, DetectionCounts):
            raise TypeError(f"val: the DetectionCounts of compute() are needed; got {type(counts).__name__}")
        score = counts.score_thresholds[0] if score_threshold is None else score_threshold
        if score not in counts.score_thresholds:
            raise ValueError(f"score_threshold: one of {counts.score_thresholds} is needed; got {score}")
        fig, ax = get_figure(ax)
        plot_recall(counts.compute_curve(axis), counts.score_thresholds.index(score), ax)
        ax.set_xlabel(f"{axis} of the object; second line: number of objects")
        return fig, ax


def _check_parameters(
    match_by: str, threshold: float, borders: dict[str, tuple[float, ...]], scores: tuple[float, ...]
) -> None:
    if match_by not in ("distance", "iou"):
        raise ValueError(f"match_by: 'distance' or 'iou' is needed; got {match_by!r}")
    if not 0 < threshold < math.inf or (match_by == "iou" and threshold > 1):
        raise ValueError(f"threshold: meters > 0, or a share in (0, 1] for 'iou', is needed; got {threshold}")
    for (name, values), highest in zip(borders.items(), (1.0, math.inf), strict=True):
        if not all(low < high for low, high in pairwise((0.0, *values, highest))):
            raise ValueError(f"{name}: ascending numbers within (0, {highest:g}) are needed; got {values}")
    if not scores or any(math.isnan(score) for score in scores):
        raise ValueError(f"score_thresholds: at least one number is needed; got {scores}")


def _to_list(values: T | Sequence[T]) -> list[Any]:
    return list(values) if isinstance(values, (list, tuple)) else [values]
