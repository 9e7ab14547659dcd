"""Recall and precision with confidence intervals from counts of objects and detections."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from torch import Tensor

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# 97.5 % quantile of the normal distribution, for two-sided 95 % intervals.
NORMAL_QUANTILE = 1.959963984540054


@dataclass(frozen=True, eq=False)
class RatioWithInterval:
    """Success rates with 95 % Wilson intervals (Wilson 1927), in float64; NaN without trials.

    Args:
        value: Success rates.
        low: Lower ends of the intervals.
        high: Upper ends of the intervals.
        trials: int64 numbers of trials.
    """

    value: Tensor
    low: Tensor
    high: Tensor
    trials: Tensor

    @classmethod
    def from_counts(cls, successes: Tensor, trials: Tensor) -> "RatioWithInterval":
        """Compute rates and intervals from counts.

        The interval assumes independent trials; the same object in frames 0.1 s apart is not independent.

        Args:
            successes: int64 numbers of successes.
            trials: int64 numbers of trials, broadcast to the shape of `successes`.

        Returns:
            Rates with intervals.
        """
        trials = trials.expand_as(successes)
        n = trials.double().where(trials > 0, math.nan)
        p = successes / n
        pull = NORMAL_QUANTILE**2 / n
        center = (p + pull / 2) / (1 + pull)
        half_width = (pull * (p * (1 - p) + pull / 4)).sqrt() / (1 + pull)
        return cls(p, (center - half_width).clamp(min=0.0), (center + half_width).clamp(max=1.0), trials)


@dataclass(frozen=True, eq=False)
class RecallCurve:
    """Recall and precision over bins, (S, B) for S score thresholds and B bins.

    Args:
        bins: Names of the bins: "0.2-0.4", "hidden", "not sampled".
        recall: Share of the objects of each bin that a detection matches.
        precision: Share of the detections of each bin that match an object.
    """

    bins: tuple[str, ...]
    recall: RatioWithInterval
    precision: RatioWithInterval


class DetectionCounts:
    """Counts of objects and detections in V bins of visibility (the last two are unknown) and D bins of distance.

    Args:
        objects: (V, D) int64 objects.
        detected_objects: (S, V, D) objects that a detection with at least the score threshold matches.
        detections: (S, V, D) detections with at least the score threshold, by the visibility of their own boxes.
        true_detections: (S, V, D) detections of these that match an object.
        visibility_bins: Names of the V bins.
        distance_bins: Names of the D bins.
        score_thresholds: The S score thresholds.
        num_frames: Number of frames.
    """

    # Not a dataclass: torchmetrics would convert it and squeeze its tensors.
    def __init__(
        self,
        *,
        objects: Tensor,
        detected_objects: Tensor,
        detections: Tensor,
        true_detections: Tensor,
        visibility_bins: tuple[str, ...],
        distance_bins: tuple[str, ...],
        score_thresholds: tuple[float, ...],
        num_frames: int,
    ) -> None:
        self.objects = objects
        self.detected_objects = detected_objects
        self.detections = detections
        self.true_detections = true_detections
        self.visibility_bins = visibility_bins
        self.distance_bins = distance_bins
        self.score_thresholds = score_thresholds
        self.num_frames = num_frames

    def compute_curve(self, axis: Literal["visibility", "distance"]) -> RecallCurve:
        """Compute recall and precision over the bins of one axis.

        Args:
            axis: "visibility" or "distance".

        Returns:
            Curve over the bins of this axis.
        """
        bins, summed_axis = {"visibility": (self.visibility_bins, -1), "distance": (self.distance_bins, -2)}[axis]
        counts = (self.detected_objects, self.objects, self.true_detections, self.detections)
        detected, objects, true_detections, detections = (count.sum(dim=summed_axis) for count in counts)
        return RecallCurve(
            bins,
            RatioWithInterval.from_counts(detected, objects),
            RatioWithInterval.from_counts(true_detections, detections),
        )

    def compute_overall(self) -> RecallCurve:
        """Compute (S, 1) recall and precision over all bins."""
        counts = (self.detected_objects, self.objects, self.true_detections, self.detections)
        detected, objects, true_detections, detections = (count.sum(dim=(-2, -1))[..., None] for count in counts)
        return RecallCurve(
            ("all",),
            RatioWithInterval.from_counts(detected, objects),
            RatioWithInterval.from_counts(true_detections, detections),
        )

    def to_scalars(self) -> dict[str, float]:
        """Flatten recall, precision and counts for a logger.

        Returns:
            `"recall/all"`, `"recall/visibility 0.2-0.4"`, `"objects/visibility 0.2-0.4"`,
            `"precision/distance 0-20 m"`, `"detections/distance 0-20 m"` and so on; several score thresholds give
            `"recall_score_0.5/all"`.
        """
        scalars = {}
        curves = {
            "": self.compute_overall(),
            "visibility ": self.compute_curve("visibility"),
            "distance ": self.compute_curve("distance"),
        }
        for row, score in enumerate(self.score_thresholds):
            suffix = f"_score_{score:g}" if len(self.score_thresholds) > 1 else ""
            for axis, curve in curves.items():
                for column, name in enumerate(curve.bins):
                    scalars[f"recall{suffix}/{axis}{name}"] = float(curve.recall.value[row, column])
                    scalars[f"precision{suffix}/{axis}{name}"] = float(curve.precision.value[row, column])
                    scalars[f"objects/{axis}{name}"] = float(curve.recall.trials[row, column])
                    scalars[f"detections{suffix}/{axis}{name}"] = float(curve.precision.trials[row, column])
        return scalars


def plot_recall(curve: RecallCurve, threshold_index: int, ax: "Axes") -> None:
    """Plot recall at one score threshold, a point with its interval for each bin with objects.

    Args:
        curve: Recall over bins.
        threshold_index: Row of the curve.
        ax: Target axes.
    """
    value, low, high = (
        t[threshold_index].cpu().numpy() for t in (curve.recall.value, curve.recall.low, curve.recall.high)
    )
    bins = np.flatnonzero(curve.recall.trials[threshold_index].cpu().numpy())
    interval = np.stack([value - low, high - value])[:, bins].clip(min=0.0)  # rounding may give negative widths
    ax.errorbar(bins, value[bins], interval, fmt="o", capsize=3)
    labels = [
        f"{name}\n{objects}"
        for name, objects in zip(curve.bins, curve.recall.trials[threshold_index].tolist(), strict=True)
    ]
    ax.set_xticks(range(len(labels)), labels)
    ax.set(xlim=(-0.5, len(labels) - 0.5), ylim=(0.0, 1.03), ylabel="recall")
