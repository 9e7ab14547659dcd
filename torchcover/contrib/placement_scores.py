"""What metrics say of several sensor placements, on the same frames, and what they would have said in other worlds."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from torchcover.contrib.comparison import MetricComparison
from torchcover.contrib.ranks import BASELINE, LEAST, OWN, Ranking, build_rankings
from torchcover.contrib.registry import PUBLISHED
from torchcover.coverage import Coverage, Region
from torchcover.coverage.averages import Average
from torchcover.estimation import Quantity
from torchcover.evaluation.evaluating import evaluate
from torchcover.evaluation.task import AnyRig, load_rig
from torchcover.simulation import RegionsOfInterest, Scenario

THRESHOLD_M = 0.4
CELL_M = 1.0
RADIUS_M = 50.0
MEASURES: Mapping[Average, str] = {"area": "visible surface", "cells": "observed cells"}
# Counts what any metric has to beat: how many points there are.
COUNTS_POINTS, POINTS = "point_density", "points"
# Of the parts of a number, those about what detectors are judged on.
CATEGORIES = ("car", "pedestrian", "cyclist")


def build_circle_region(radius_m: float = RADIUS_M) -> Region:
    """The region around the vehicle, as a polygon with a corner for each degree."""
    angles = map(math.radians, range(360))
    corners_m = [(radius_m * math.cos(angle), radius_m * math.sin(angle)) for angle in angles]
    return Region.from_corners(f"{radius_m:g}m_around", corners_m)


@dataclass(frozen=True, eq=False)
class PlacementScores:
    """What each metric says of each placement.

    Args:
        rigs: Names of the placements.
        rankings: A row for each metric, with numbers in the order of `rigs`.
        num_frames: Steps that they were measured in.
        sensor_models: Name of each placement -> what its sensors made of their hits, `ideal` or `real`.
    """

    rigs: tuple[str, ...]
    rankings: tuple[Ranking, ...]
    num_frames: int
    sensor_models: Mapping[str, str]

    def select(self, rigs: Sequence[str]) -> tuple[Ranking, ...]:
        """The rows of some of the placements, in another order."""
        places = [self.rigs.index(rig) for rig in rigs]
        return tuple(one.select(places) for one in self.rankings)


def score_placements(
    rigs: Mapping[str, AnyRig],
    scenario: Scenario | str | Path = "urban",
    *,
    region: Region | None = None,
    metrics: Sequence[str] | None = None,
    num_frames: int = 64,
    seed: int = 0,
    sensor_model: Literal["ideal", "real"] | None = None,
    **settings: Any,  # noqa: ANN401  (those of `evaluate`)
) -> PlacementScores:
    """Measure placements in the same frames.

    torchcover's own numbers are detection at 0.4 m on the ground, on obstacles and the mean of the two, over the
    visible surface and over the known cells of 1 m.

    Args:
        rigs: Three or more, by name.
        scenario: The world.
        region: Where; a circle of 50 m around the vehicle if not given.
        metrics: Those of others, of `torchcover.contrib.PUBLISHED`; all if not given. The number of points is always
            there.
        num_frames: Steps.
        seed: Seed of the traffic.
        sensor_model: What sensors make of their hits; as for `evaluate`.
        settings: Others of `evaluate`: `frame_interval_s`, `workers`, `progress`.

    Raises:
        ValueError: Fewer rigs, an unknown metric, or as `evaluate`.
        FileNotFoundError: An unknown rig or scenario.

    Example:
        >>> rigs = {name: f"place3d2024_{name}" for name in ("center", "line", "pyramid")}
        >>> scores = score_placements(rigs, "courtyard", metrics=["point_density"], num_frames=1)
        >>> [ranking.scores.tolist() for ranking in scores.rankings if ranking.metric == "baseline"][1:]
        [[2.5, 2.2, 2.35], [16000.0, 16000.0, 16000.0]]
    """
    if len(rigs) < LEAST:
        raise ValueError(f"rigs: three or more are needed to speak of ranks; got {', '.join(rigs) or 'none'}")
    carried = {
        name: load_rig(rig).apply_sensor_model(sensor_model).model_copy(update={"name": name})
        for name, rig in rigs.items()
    }
    region = build_circle_region() if region is None else region
    result = evaluate(
        list(carried.values()),
        scenario,
        regions=_around(region),
        thresholds_m=THRESHOLD_M,
        metrics=tuple(dict.fromkeys([*(PUBLISHED if metrics is None else metrics), COUNTS_POINTS])),
        num_frames=num_frames,
        seed=seed,
        **settings,
    )
    if result.run is not None:
        result.run.raise_failure()  # ranks of a part of what was asked for would look like the whole
    assert isinstance(result.metrics, MetricComparison)  # some were requested
    heights_m = [sum(sensor.mount.z_m for sensor in rig.sensors) / len(rig.sensors) for rig in carried.values()]
    return PlacementScores(
        rigs=tuple(rigs),
        rankings=(
            *_own([result.coverages[rig] for rig in rigs], region, seed),
            *_of_others(result.metrics.rankings),
            _of_rigs("mean mounting height", "m", [round(height_m, 6) for height_m in heights_m]),
            _of_rigs(
                "rays", "rays", [float(sum(sensor.num_rays for sensor in rig.sensors)) for rig in carried.values()]
            ),
        ),
        num_frames=num_frames,
        sensor_models={name: rig.sensor_model for name, rig in carried.items()},
    )


def _around(region: Region) -> RegionsOfInterest:
    """What is asked about: one region, and a grid that just holds it."""
    x, y = ((math.floor(low), math.ceil(high)) for low, high in (region.x_m, region.y_m))
    where = {"polygon_m": region.corners_m} if region.corners_m else {"x_m": region.x_m, "y_m": region.y_m}
    grid = {"x_m": x, "y_m": y, "cell_m": CELL_M}
    return RegionsOfInterest.model_validate({"regions": {region.name: where}, "grid": grid})


def _own(coverages: Sequence[Coverage], region: Region, seed: int) -> Iterator[Ranking]:
    """Our own: detection over the visible surface and over the known cells, for each band and both."""
    for measure, words in MEASURES.items():
        name, bands = f"detection {THRESHOLD_M:g} m, {{}}, {region.name}, {words}", []
        for band in coverages[0].grid.heights:
            estimates = [coverage.estimate(region, band, measure)[1:] for coverage in coverages]
            numbers = [list(estimate.to_numbers().values()) for estimate in estimates]
            (one,) = build_rankings(OWN, numbers, estimates, seed)
            bands.append(one._replace(name=name.format(band)))
        yield from bands
        both = np.mean([one.scores for one in bands], axis=0)
        draws = [one.samples for one in bands if one.samples is not None]
        again = np.asarray(np.mean(draws, axis=0)) if len(draws) == len(bands) else None
        yield Ranking.from_values(bands[0].quantity, both, OWN, again)._replace(name=name.format("both bands"))


def _of_others(published: Sequence[Ranking]) -> Iterator[Ranking]:
    for one in published:
        if one.is_part and one.name.split(":")[1] not in CATEGORIES:
            continue
        name = f"{one.name} (less is better)" if one.quantity.lower_is_better else one.name
        yield one._replace(name=name, metric=BASELINE if one.name == POINTS else one.metric)


def _of_rigs(words: str, unit: str, values: Iterable[float]) -> Ranking:
    return Ranking.from_values(Quantity(words, words, unit, lower_is_better=False), list(values))
