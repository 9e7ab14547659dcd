"""What metrics say of several sensor placements, on the same frames, and what they would have said in other worlds."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchcover.coverage import Coverage, Region
from torchcover.coverage.measures import Measure, area_in_blocks
from torchcover.evaluation.evaluating import evaluate
from torchcover.evaluation.other_metrics import drawn_worlds
from torchcover.evaluation.task import AnyRig, loaded
from torchcover.published import PUBLISHED, Candidate
from torchcover.published.baselines import mean_height_m, rays
from torchcover.published.comparison import Series
from torchcover.published.ranks import LEAST, Array
from torchcover.simulation import RegionsOfInterest, Scenario

THRESHOLD_M = 0.4
CELL_M = 1.0
RADIUS_M = 50.0
MEASURES: Mapping[Measure, str] = {"area": "visible surface", "known": "known cells"}
# Counts what any metric has to beat: how many points there are.
COUNTS_POINTS, POINTS = "point_density", "points"
# Of the parts of a number, those about what detectors are judged on.
CATEGORIES = ("car", "pedestrian", "cyclist")


def circle(radius_m: float = RADIUS_M) -> Region:
    """The region around the vehicle, as a polygon with a corner for each degree."""
    angles = map(math.radians, range(360))
    corners_m = [(radius_m * math.cos(angle), radius_m * math.sin(angle)) for angle in angles]
    return Region.polygon(f"{radius_m:g}m_around", corners_m)


@dataclass(frozen=True, eq=False)
class PlacementScores:
    """What each metric says of each placement.

    Args:
        rigs: Names of the placements.
        candidates: A row for each metric, with values in the order of `rigs`.
        steps: Steps that they were measured in.
    """

    rigs: tuple[str, ...]
    candidates: tuple[Candidate, ...]
    steps: int

    def of(self, rigs: Sequence[str]) -> tuple[Candidate, ...]:
        """The rows of some of the placements, in another order."""
        at = [self.rigs.index(rig) for rig in rigs]
        return tuple(
            Candidate(one.name, one.kind, one.values[at], None if one.draws is None else one.draws[:, at])
            for one in self.candidates
        )


def score_placements(
    rigs: Mapping[str, AnyRig],
    scenario: Scenario | str | Path = "urban",
    *,
    region: Region | None = None,
    metrics: Sequence[str] | None = None,
    steps: int = 64,
    seed: int = 0,
    every_s: float | None = None,
    workers: int = 0,
    progress: bool = False,
) -> PlacementScores:
    """Measure placements in the same frames.

    torchcover's own numbers are detection at 0.4 m on the ground, on obstacles and the mean of the two, over the
    visible surface and over the known cells of 1 m.

    Args:
        rigs: Three or more, by name.
        scenario: The world.
        region: Where; a circle of 50 m around the vehicle if not given.
        metrics: Those of others, of `torchcover.published.PUBLISHED`; all if not given. The number of points is always
            there.
        steps: Steps.
        seed: Seed of the traffic.
        every_s: Time between two steps in seconds; as in `evaluate` if not given.
        workers: Processes that make frames.
        progress: Whether to show a bar.

    Raises:
        ValueError: Fewer rigs, an unknown metric, or as `evaluate`.
        FileNotFoundError: An unknown rig or scenario.

    Example:
        >>> rigs = {name: f"place3d2024_{name}" for name in ("center", "line", "pyramid")}
        >>> scores = score_placements(rigs, "courtyard", metrics=["point_density"], steps=1)
        >>> [one.values.tolist() for one in scores.candidates if one.kind == "baseline"][1:]
        [[2.5, 2.2, 2.35], [16000.0, 16000.0, 16000.0]]
    """
    if len(rigs) < LEAST:
        raise ValueError(f"rigs: three or more are needed to speak of ranks; got {', '.join(rigs) or 'none'}")
    carried = {name: loaded(rig).model_copy(update={"name": name}) for name, rig in rigs.items()}
    region = circle() if region is None else region
    result = evaluate(
        list(carried.values()),
        scenario,
        ask=_around(region),
        thresholds_m=THRESHOLD_M,
        metrics=tuple(dict.fromkeys([*(PUBLISHED if metrics is None else metrics), COUNTS_POINTS])),
        steps=steps,
        seed=seed,
        every_s=every_s,
        workers=workers,
        progress=progress,
    )
    if result.run is not None:
        result.run.raise_failure()  # ranks of a part of what was asked for would look like the whole
    assert result.metrics is not None  # some were asked for
    return PlacementScores(
        rigs=tuple(rigs),
        candidates=(
            *_own([result.coverages[rig] for rig in rigs], region, seed),
            *_of_others(result.metrics.series),
            Candidate("mean mounting height", "baseline", np.array([mean_height_m(rig) for rig in carried.values()])),
            Candidate("rays", "baseline", np.array([float(rays(rig)) for rig in carried.values()])),
        ),
        steps=steps,
    )


def _around(region: Region) -> RegionsOfInterest:
    """What is asked about: one region, and a grid that just holds it."""
    x, y = ((math.floor(low), math.ceil(high)) for low, high in (region.x, region.y))
    where = {"polygon_m": region.corners_m} if region.corners_m else {"x_m": region.x, "y_m": region.y}
    grid = {"x_m": x, "y_m": y, "cell_m": CELL_M}
    return RegionsOfInterest.model_validate({"regions": {region.name: where}, "grid": grid})


def _own(coverages: Sequence[Coverage], region: Region, seed: int) -> Iterator[Candidate]:
    """Our own: detection over the visible surface and over the known cells, for each band and both."""
    weights = drawn_worlds(coverages[0], seed)
    for measure, words in MEASURES.items():
        each = {
            band: np.stack([_detection(one, region, band, measure, weights) for one in coverages])
            for band in coverages[0].grid.heights
        }
        for name, found in {**each, "both bands": np.mean(list(each.values()), axis=0)}.items():
            label = f"detection {THRESHOLD_M:g} m, {name}, {region.name}, {words}"
            yield Candidate(label, "coverage", found[:, 0], None if weights is None else found[:, 1:].T)


def _detection(coverage: Coverage, region: Region, band: str, measure: Measure, weights: Tensor | None) -> Array:
    """(1 + R,) the number itself, then that of each draw of worlds."""
    blocks, area = coverage.blocks, coverage.area
    assert blocks is not None  # `compare` keeps both
    assert area is not None
    once = torch.ones(1, len(blocks.steps), dtype=torch.float64)
    drawn = once if weights is None else torch.cat([once, weights])
    number, cells = list(coverage.grid.heights).index(band), region.mask(coverage.grid)
    if measure == "area":
        m2, _, detected = area_in_blocks(area, number, cells).T
        return np.asarray((drawn @ detected) / (drawn @ m2))
    in_band = torch.zeros(coverage.grid.shape, dtype=torch.bool)
    in_band[number] = cells
    steps, (_, sums) = blocks.spread_over(in_band)
    probed = drawn @ steps.double()
    known = probed > 0
    means = (drawn @ sums.double()) / probed.where(known, 1.0)
    return np.asarray(means.sum(dim=1) / known.sum(dim=1))


def _of_others(series: Sequence[Series]) -> Iterator[Candidate]:
    for one in series:
        number = one.any_number
        if number.is_part and number.name.split(":")[1] not in CATEGORIES:
            continue
        name = number.name if number.higher_is_better else f"{number.name} (less is better)"
        draws = None if one.draws is None else one.sign * one.draws
        yield Candidate(name, "baseline" if number.name == POINTS else "published", one.sign * one.values, draws)
