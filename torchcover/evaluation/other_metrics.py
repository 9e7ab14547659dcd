"""Metrics that others published, in a run: made for its rigs, and held against its own numbers."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchcover.coverage import Coverage, Region
from torchcover.coverage.measures import area_in_blocks
from torchcover.estimation import MIN_BLOCKS, Quantity
from torchcover.evaluation.settings import Settings
from torchcover.evaluation.task import Task
from torchcover.frames import BadFrameError, Frame, FrameSource
from torchcover.published import PUBLISHED, FrameMetric, PublishedNumber, Setup, Sights
from torchcover.published.comparison import OWN, MetricComparison, Series
from torchcover.published.ranks import Array
from torchcover.published.setup import Need
from torchcover.simulation import SimulatedFrames

# Worlds are drawn again so many times for the intervals of tau.
DRAWS = 500

WHY: Mapping[Need, str] = {
    "boxes": "it needs boxes of objects, which simulations and labelled recordings have",
    "sensors": "it needs the rig's sensors, with mounts and rays: give the rig's YAML file or a built-in name",
    "sensor_points": "nobody knows which points are of which sensor",
    "m2": "it needs the square metres of reference points, which the surface reference of a simulation gives",
    "tags": "it needs classes of the reference points, which the frames do not have",
}


class OtherMetrics(NamedTuple):
    """The metrics of a run.

    Args:
        of_rigs: Name of a metric -> name of a rig -> the metric.
        left_out: Name of a metric -> why there is none.
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

    Raises:
        ValueError: None of them can be made; the message says why.
    """
    if not settings.metrics:
        return OtherMetrics({}, {})
    sights, threshold_m = Sights(), settings.thresholds_m[0] if settings.thresholds_m else 0.4
    ego = task.frames.scenario.ego_mesh() if isinstance(task.frames, SimulatedFrames) else None
    lacking = _lacking(task)
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
    """What the frames, or the rigs, do not have."""
    first = None if isinstance(task.frames, SimulatedFrames) else _first_frame(task)
    there: dict[Need, bool] = {
        "sensors": all(task.sensors.get(rig) for rig in task.rigs),
        "m2": task.frames.square_metres,
        "boxes": first is None or first.boxes is not None,
        "sensor_points": first is None or all(rig in (first.sensor_points or {}) for rig in task.rigs),
        "tags": False,
    }
    return frozenset(need for need, known in there.items() if not known)


def _first_frame(task: Task[FrameSource]) -> Frame | None:
    for index in range(len(task.frames)):
        try:
            return task.frames[index]
        except BadFrameError:
            continue  # the run itself skips it, or ends with it
    return None


def compared(
    metrics: OtherMetrics, coverages: Mapping[str, Coverage], regions: Sequence[Region], seed: int
) -> MetricComparison | None:
    """What the metrics say, with the numbers of some regions beside; None if none was asked for.

    Args:
        metrics: After the run.
        coverages: By the name of the rig.
        regions: Those whose numbers they are held against.
        seed: Of the worlds that are drawn again.
    """
    if not metrics.of_rigs:
        return None
    weights = drawn_worlds(next(iter(coverages.values())), seed)
    series = [
        one for name, of_rigs in metrics.of_rigs.items() for one in _series(name, list(of_rigs.values()), weights)
    ]
    own = [
        _own(list(coverages.values()), region, height, quantity, weights)
        for region in regions
        for height in next(iter(coverages.values())).grid.heights
        for quantity in range(len(next(iter(coverages.values())).quantities))
    ]
    return MetricComparison(tuple(coverages), series, own, metrics.left_out)


def drawn_worlds(coverage: Coverage, seed: int) -> Tensor | None:
    """(R, B) how often each block of worlds comes, drawn with replacement; None if there are too few of them."""
    if coverage.blocks is None:
        return None
    used = (coverage.blocks.steps > 0).cpu()
    if int(used.sum()) < MIN_BLOCKS:
        return None
    count = int(used.sum())
    drawn = np.random.default_rng([seed, count]).multinomial(count, np.full(count, 1 / count), size=DRAWS)
    weights = torch.zeros(DRAWS, len(used), dtype=torch.float64)
    weights[:, used] = torch.from_numpy(drawn).double()
    return weights


def _series(name: str, of_rigs: Sequence[FrameMetric], weights: Tensor | None) -> list[Series]:
    """The numbers of a metric, by their names; rigs may have different ones."""
    numbers = [{number.name: number for number in metric.compute()} for metric in of_rigs]
    draws = [_draws(metric, list(own), weights) for metric, own in zip(of_rigs, numbers, strict=True)]
    found = []
    for number in dict.fromkeys(each for own in numbers for each in own):
        together = [drawn[number] for drawn in draws if number in drawn]
        stacked = np.stack(together, axis=1) if len(together) == len(of_rigs) else None
        found.append(Series(name, tuple(own.get(number) for own in numbers), stacked))
    return found


def _draws(metric: FrameMetric, names: Sequence[str], weights: Tensor | None) -> dict[str, Array]:
    drawn = None if weights is None else metric.resampled(weights)
    return {} if drawn is None else dict(zip(names, drawn.cpu().numpy().T, strict=True))


def _own(coverages: Sequence[Coverage], region: Region, height: str, which: int, weights: Tensor | None) -> Series:
    numbers = tuple(_own_number(coverage, region, height, coverage.quantities[which]) for coverage in coverages)
    draws = None
    if weights is not None and all(coverage.area is not None for coverage in coverages):
        draws = np.stack([_own_draws(coverage, region, height, which, weights) for coverage in coverages], axis=1)
    return Series(OWN, numbers, draws)


def _own_number(coverage: Coverage, region: Region, height: str, quantity: Quantity) -> PublishedNumber:
    (summary,) = (row for row in coverage.summary([region]) if row.height == height)
    number = summary.numbers[quantity.key]
    return PublishedNumber(
        f"{quantity.key} {region.name} {height}",
        number.value,
        quantity.unit,
        not quantity.lower_is_better,
        {"measure": summary.measure, "cell_m": coverage.grid.cell},
        0 if math.isnan(number.value) else summary.known_cells,
        "known cells",
        number.error,
    )


def _own_draws(coverage: Coverage, region: Region, height: str, which: int, weights: Tensor) -> Array:
    assert coverage.area is not None
    band, mask = list(coverage.grid.heights).index(height), region.mask(coverage.grid)
    sums = weights @ area_in_blocks(coverage.area, band, mask.to(coverage.radius.device)).cpu()
    drawn: Array = (sums[:, 1 + which] / sums[:, 0]).numpy()
    return drawn
