"""Counts of objects and detections as recall and precision, with their uncertainty."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from torch import Tensor

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Two-sided 95 %.
NORMAL_QUANTILE = 1.959963984540054


@dataclass(frozen=True, eq=False)
class RatioWithInterval:
    """A share of successes for each entry, in float64; NaN where nothing was counted.

    `low` and `high` are the ends of the 95 % Wilson interval (Wilson 1927), `trials` int64.
    """

    value: Tensor
    low: Tensor
    high: Tensor
    trials: Tensor

    @classmethod
    def from_counts(cls, successes: Tensor, trials: Tensor) -> "RatioWithInterval":
        """From counts. The interval takes trials as independent; the same object in frames 0.1 s apart is not."""
        trials = trials.expand_as(successes)
        n = trials.double().where(trials > 0, math.nan)
        p = successes / n
        pull = NORMAL_QUANTILE**2 / n
        middle = (p + pull / 2) / (1 + pull)
        half = (pull * (p * (1 - p) + pull / 4)).sqrt() / (1 + pull)
        return cls(p, (middle - half).clamp(min=0.0), (middle + half).clamp(max=1.0), trials)


@dataclass(frozen=True, eq=False)
class RecallCurve:
    """Recall and precision over bins, (S, B) for S score thresholds and B bins.

    `bins`: what each bin holds, in words: "0.2-0.4", "hidden", "not sampled"; `recall`: objects found, of the objects
    of the bin; `precision`: detections that found an object, of the detections of the bin.
    """

    bins: tuple[str, ...]
    recall: RatioWithInterval
    precision: RatioWithInterval


class DetectionCounts:
    """What was there and what was found, by visibility and distance: V bins, the last two unknown, and D bins.

    Args:
        objects: (V, D) int64 objects.
        detected_objects: (S, V, D) those that a detection of at least the score threshold found.
        detections: (S, V, D) detections of at least the score threshold, by the visibility of their own boxes.
        true_detections: (S, V, D) those of them that found an object.
        visibility_bins: Names of the V bins.
        distance_bins: Names of the D bins.
        score_thresholds: The S score thresholds.
        num_frames: Number of frames that were counted.
    """

    # No dataclass: torchmetrics would take it apart and squeeze its tensors.
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
        """Recall and precision over bins of visibility or of distance."""
        bins, other = {"visibility": (self.visibility_bins, -1), "distance": (self.distance_bins, -2)}[axis]
        counts = (self.detected_objects, self.objects, self.true_detections, self.detections)
        found, objects, true_detections, detections = (count.sum(dim=other) for count in counts)
        return RecallCurve(
            bins,
            RatioWithInterval.from_counts(found, objects),
            RatioWithInterval.from_counts(true_detections, detections),
        )

    def compute_overall(self) -> RecallCurve:
        """(S, 1) recall and precision of everything."""
        counts = (self.detected_objects, self.objects, self.true_detections, self.detections)
        found, objects, true_detections, detections = (count.sum(dim=(-2, -1))[..., None] for count in counts)
        return RecallCurve(
            ("all",),
            RatioWithInterval.from_counts(found, objects),
            RatioWithInterval.from_counts(true_detections, detections),
        )

    def to_scalars(self) -> dict[str, float]:
        """A flat dict for a logger.

        Returns:
            `"recall/all"`, `"recall/visibility 0.2-0.4"`, `"objects/visibility 0.2-0.4"`,
            `"precision/distance 0-20 m"`, `"detections/distance 0-20 m"` and so on; with several score thresholds
            `"recall_score_0.5/all"`.
        """
        flat = {}
        curves = {
            "": self.compute_overall(),
            "visibility ": self.compute_curve("visibility"),
            "distance ": self.compute_curve("distance"),
        }
        for row, score in enumerate(self.score_thresholds):
            at = f"_score_{score:g}" if len(self.score_thresholds) > 1 else ""
            for axis, curve in curves.items():
                for column, name in enumerate(curve.bins):
                    flat[f"recall{at}/{axis}{name}"] = float(curve.recall.value[row, column])
                    flat[f"precision{at}/{axis}{name}"] = float(curve.precision.value[row, column])
                    flat[f"objects/{axis}{name}"] = float(curve.recall.trials[row, column])
                    flat[f"detections{at}/{axis}{name}"] = float(curve.precision.trials[row, column])
        return flat


def plot_recall(curve: RecallCurve, threshold_index: int, ax: "Axes") -> None:
    """Draw recall at one score threshold: a point and its interval for each bin that has objects."""
    value, low, high = (
        t[threshold_index].cpu().numpy() for t in (curve.recall.value, curve.recall.low, curve.recall.high)
    )
    there = np.flatnonzero(curve.recall.trials[threshold_index].cpu().numpy())
    interval = np.stack([value - low, high - value])[:, there].clip(min=0.0)  # of rounding
    ax.errorbar(there, value[there], interval, fmt="o", capsize=3)
    labels = [
        f"{name}\n{objects}"
        for name, objects in zip(curve.bins, curve.recall.trials[threshold_index].tolist(), strict=True)
    ]
    ax.set_xticks(range(len(labels)), labels)
    ax.set(xlim=(-0.5, len(labels) - 0.5), ylim=(0.0, 1.03), ylabel="recall")
