"""Build the metrics of others for the rigs of a run, and compare them with torchcover's own numbers."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from torchcover.contrib.comparison import MetricComparison
from torchcover.contrib.frame_metric import FrameMetric
from torchcover.contrib.ranks import OWN, Ranking, rankings
from torchcover.contrib.registry import PUBLISHED, Need, Setup
from torchcover.contrib.sights import Sights
from torchcover.coverage import Coverage, Region
from torchcover.evaluation.settings import Settings
from torchcover.evaluation.task import Task
from torchcover.frames import FrameSource

REASONS: Mapping[Need, str] = {
    "boxes": "it needs boxes of objects, which simulations and labelled recordings have",
    "sensors": "it needs the rig's sensors, with mounts and rays: give the rig's YAML file or a built-in name",
    "sensor_points": "which points are of which sensor is unknown",
}


class RunMetrics(NamedTuple):
    """The metrics of a run.

    Args:
        by_rig: Name of a metric -> name of a rig -> the metric.
        left_out: Name of a metric that cannot be built -> the reason.
    """

    by_rig: Mapping[str, Mapping[str, FrameMetric]]
    left_out: Mapping[str, str]

    @property
    def observers(self) -> dict[str, FrameMetric]:
        """All metrics by unique names, as the observers of a run."""
        return {f"{name} of {rig}": metric for name, metrics in self.by_rig.items() for rig, metric in metrics.items()}

    def update_from(self, observers: Mapping[str, Any]) -> "RunMetrics":
        """Return the metrics as a run left them, by the names of `observers`."""
        by_rig = {name: {rig: observers[f"{name} of {rig}"] for rig in rigs} for name, rigs in self.by_rig.items()}
        return RunMetrics(by_rig, self.left_out)


def build_metrics(task: Task[FrameSource], settings: Settings) -> RunMetrics:
    """Build the requested metrics for all rigs; those whose needs are not met are left out.

    Raises:
        ValueError: No metric can be built; the message says why.
    """
    sights = Sights()
    threshold_m = settings.thresholds_m[0] if settings.thresholds_m else 0.4
    missing, ego = _find_missing_needs(task), task.frames.ego_mesh()
    unmet = {name: PUBLISHED[name].needs & missing for name in settings.metrics}
    left_out = {name: REASONS[min(needs)] for name, needs in unmet.items() if needs}
    if len(left_out) == len(settings.metrics):
        raise ValueError("; ".join(f"metric {name}: {reason}" for name, reason in left_out.items()))
    by_rig: dict[str, dict[str, FrameMetric]] = {name: {} for name in settings.metrics if name not in left_out}
    for rig in task.rigs:
        setup = Setup(
            rig=rig,
            sensors=tuple(task.sensors.get(rig, ())),
            ego=ego,
            grid=task.asked.grid,
            regions=task.asked.regions,
            square_metres=task.frames.square_metres,
            threshold_m=threshold_m,
            sights=sights,
            sync_on_compute=False,
        )
        for name, metrics in by_rig.items():
            metrics[rig] = PUBLISHED[name].make(setup).to(settings.device)
    return RunMetrics(by_rig, left_out)


def _find_missing_needs(task: Task[FrameSource]) -> frozenset[Need]:
    available: dict[Need, bool] = {
        "sensors": all(task.sensors.get(rig) for rig in task.rigs),
        "boxes": task.frames.has_boxes(),
        "sensor_points": all(rig in task.frames.sensor_names for rig in task.rigs),
    }
    return frozenset(need for need, is_available in available.items() if not is_available)


def compare_metrics(
    metrics: RunMetrics, coverages: Mapping[str, Coverage], regions: Sequence[Region], seed: int
) -> MetricComparison:
    """Compare the metrics after a run with torchcover's numbers of the regions."""
    published: list[Ranking] = []
    for name, by_rig in metrics.by_rig.items():
        numbers = [metric.compute() for metric in by_rig.values()]
        estimates = [metric.estimate() for metric in by_rig.values()]
        published += rankings(name, numbers, estimates, seed)
    heights = next(iter(coverages.values())).grid.heights
    own: list[Ranking] = []
    for region in regions:
        for height in heights:
            own += _rank_by_coverage(list(coverages.values()), region, height, seed)
    return MetricComparison(tuple(coverages), published, own, metrics.left_out)


def _rank_by_coverage(coverages: Sequence[Coverage], region: Region, height: str, seed: int) -> list[Ranking]:
    numbers = []
    for coverage in coverages:
        (row,) = (row for row in coverage.summary([region]) if row.height == height)
        parameters = {"measure": row.measure, "cell_m": coverage.grid.cell}
        numbers.append([number._replace(parameters=parameters) for number in row.numbers.values()])
    estimates = [coverage.estimate(region, height) for coverage in coverages]
    ranked = rankings(OWN, numbers, estimates, seed)
    return [ranking._replace(name=f"{ranking.name} {region.name} {height}") for ranking in ranked]
