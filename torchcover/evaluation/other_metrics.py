"""Metrics that others published, in a run: made for its rigs, and held against its own numbers."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from torchcover.coverage import Coverage, Region
from torchcover.evaluation.settings import Settings
from torchcover.evaluation.task import Task
from torchcover.frames import FrameSource
from torchcover.published import PUBLISHED, FrameMetric, Ranking, Setup, Sights
from torchcover.published.comparison import MetricComparison
from torchcover.published.ranks import OWN, rankings
from torchcover.published.registry import Need

WHY: Mapping[Need, str] = {
    "boxes": "it needs boxes of objects, which simulations and labelled recordings have",
    "sensors": "it needs the rig's sensors, with mounts and rays: give the rig's YAML file or a built-in name",
    "sensor_points": "which points are of which sensor is unknown",
}


class OtherMetrics(NamedTuple):
    """The metrics of a run.

    `of_rigs`: name of a metric -> name of a rig -> the metric; `left_out`: name of a metric -> why there is none.
    """

    of_rigs: Mapping[str, Mapping[str, FrameMetric]]
    left_out: Mapping[str, str]

    @property
    def observers(self) -> dict[str, FrameMetric]:
        """All of them, by names that no other observer has."""
        return {f"{name} of {rig}": one for name, metrics in self.of_rigs.items() for rig, one in metrics.items()}

    def after(self, observers: Mapping[str, Any]) -> "OtherMetrics":
        """What they have become in a run, by the same names."""
        of_rigs = {
            name: {rig: observers[f"{name} of {rig}"] for rig in metrics} for name, metrics in self.of_rigs.items()
        }
        return OtherMetrics(of_rigs, self.left_out)


def metrics_of(task: Task[FrameSource], settings: Settings) -> OtherMetrics:
    """Make the metrics that were asked for; what cannot be made for all rigs is left out, if others can.

    ValueError: None of them can be made; the message says why.
    """
    sights, threshold_m = Sights(), settings.thresholds_m[0] if settings.thresholds_m else 0.4
    lacking, ego = _lacking(task), task.frames.ego_mesh()
    left_out = {name: WHY[min(missing)] for name in settings.metrics if (missing := PUBLISHED[name].needs & lacking)}
    if len(left_out) == len(settings.metrics):
        raise ValueError("; ".join(f"metric {name}: {why}" for name, why in left_out.items()))
    observers: dict[str, dict[str, FrameMetric]] = {name: {} for name in settings.metrics if name not in left_out}
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
        for name, metrics in observers.items():
            metrics[rig] = PUBLISHED[name].make(setup).to(settings.device)
    return OtherMetrics(observers, left_out)


def _lacking(task: Task[FrameSource]) -> frozenset[Need]:
    there: dict[Need, bool] = {
        "sensors": all(task.sensors.get(rig) for rig in task.rigs),
        "boxes": task.frames.has_boxes(),
        "sensor_points": all(rig in task.frames.sensor_names for rig in task.rigs),
    }
    return frozenset(need for need, known in there.items() if not known)


def compared(
    metrics: OtherMetrics, coverages: Mapping[str, Coverage], regions: Sequence[Region], seed: int
) -> MetricComparison:
    """What the metrics say after the run, and torchcover's numbers of the regions that they are held against."""
    published = [
        one
        for name, of_rigs in metrics.of_rigs.items()
        for one in rankings(
            name,
            [metric.compute() for metric in of_rigs.values()],
            [metric.estimate() for metric in of_rigs.values()],
            seed,
        )
    ]
    own = [
        one
        for region in regions
        for height in next(iter(coverages.values())).grid.heights
        for one in _own(list(coverages.values()), region, height, seed)
    ]
    return MetricComparison(tuple(coverages), published, own, metrics.left_out)


def _own(coverages: Sequence[Coverage], region: Region, height: str, seed: int) -> list[Ranking]:
    numbers = []
    for coverage in coverages:
        (row,) = (row for row in coverage.summary([region]) if row.height == height)
        given = {"measure": row.measure, "cell_m": coverage.grid.cell}
        numbers.append([number._replace(parameters=given) for number in row.numbers.values()])
    estimates = [coverage.estimate(region, height) for coverage in coverages]
    return [one._replace(name=f"{one.name} {region.name} {height}") for one in rankings(OWN, numbers, estimates, seed)]
