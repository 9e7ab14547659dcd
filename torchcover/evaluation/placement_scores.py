"""What metrics say of several sensor placements, on the same frames, and what they would have said in other worlds."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchcover.coverage import Coverage, Region
from torchcover.coverage.blocks import MIN_BLOCKS
from torchcover.coverage.estimate import Measure, area_in_blocks
from torchcover.data import RegionsOfInterest, SimulatedFrames, reference_called
from torchcover.evaluation.evaluating import compare
from torchcover.evaluation.rig_names import AnyRig, loaded
from torchcover.evaluation.settings import BLOCKS, spread_s
from torchcover.evaluation.task import AnyScenario
from torchcover.published import PUBLISHED, Candidate, FrameMetric, Setup, WorldRatios
from torchcover.published.agreement import Kind
from torchcover.published.baselines import Points, mean_height_m, rays
from torchcover.published.ranks import LEAST, Array
from torchcover.simulation import Scenario, with_ego

THRESHOLD_M = 0.4
CELL_M = 1.0
RADIUS_M = 50.0
DRAWS = 1000
MEASURES: Mapping[Measure, str] = {"area": "visible surface", "known": "known cells"}


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
        worlds: How many different worlds, or instants of a given one, these showed.
    """

    rigs: tuple[str, ...]
    candidates: tuple[Candidate, ...]
    steps: int
    worlds: int

    def of(self, rigs: Sequence[str]) -> tuple[Candidate, ...]:
        """The rows of some of the placements, in another order."""
        at = [self.rigs.index(rig) for rig in rigs]
        return tuple(
            Candidate(one.name, one.kind, one.values[at], None if one.draws is None else one.draws[:, at])
            for one in self.candidates
        )


def score_placements(
    rigs: Mapping[str, AnyRig],
    scenario: AnyScenario = "urban",
    *,
    region: Region | None = None,
    metrics: Sequence[str] | None = None,
    steps: int = 64,
    seed: int = 0,
    every_s: float | None = None,
    rays_of_reference: int | None = None,
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
        metrics: Those of others, of `torchcover.published.PUBLISHED`; all if not given.
        steps: Steps.
        seed: Seed of the traffic.
        every_s: Time between two steps in seconds; as in `evaluate` if not given.
        rays_of_reference: Rays of the reference sensor at each step.
        workers: Processes that make frames.
        progress: Whether to show a bar.

    Raises:
        ValueError: Fewer rigs, an unknown metric, or as `evaluate`.
        FileNotFoundError: An unknown rig or scenario.
    """
    if len(rigs) < LEAST:
        raise ValueError(f"rigs: three or more are needed to speak of ranks; got {', '.join(rigs) or 'none'}")
    names = tuple(PUBLISHED) if metrics is None else tuple(metrics)
    if unknown := [name for name in names if name not in PUBLISHED]:
        raise ValueError(f"metrics: {', '.join(PUBLISHED)} are there; got {', '.join(unknown)}")
    carried = {name: loaded(rig) for name, rig in rigs.items()}
    world = with_ego(scenario if isinstance(scenario, Scenario) else Scenario.load(scenario), carried)
    region = circle() if region is None else region
    ask = _around(region)
    asked = ask.around()
    frames = SimulatedFrames(
        world,
        rigs=carried,
        steps=steps,
        seed=seed,
        every_s=spread_s(world, every_s),
        reference_sensor=reference_called(rays=rays_of_reference, asked=asked),
        boxes=True,
    )
    setup = Setup(
        ego=world.ego_mesh(), grid=asked.grid, regions=(region,), threshold_m=THRESHOLD_M, sync_on_compute=False
    )
    observers = {
        name: [make(replace(setup, rig=rig, sensors=content.sensors)) for rig, content in carried.items()]
        for name, make in {**{name: PUBLISHED[name].make for name in names}, "points": _points}.items()
    }
    fed = {f"{name} of {rig}": one for name, of in observers.items() for rig, one in zip(rigs, of, strict=True)}
    result = compare(
        frames=frames, ask=ask, thresholds=(THRESHOLD_M,), observers=fed, workers=workers, progress=progress
    )
    weights = _weights(result.coverages[next(iter(rigs))], seed)
    return PlacementScores(
        rigs=tuple(rigs),
        candidates=(
            *_own([result.coverages[rig] for rig in rigs], region, weights),
            *(one for name in names for one in _rows("published", observers[name], weights)),
            *_rows("baseline", observers["points"], weights),
            Candidate("mean mounting height", "baseline", np.array([mean_height_m(rig) for rig in carried.values()])),
            Candidate("rays", "baseline", np.array([float(rays(rig)) for rig in carried.values()])),
        ),
        steps=result.run.steps if result.run else steps,
        worlds=len({frames.simulator.place_in_time(index) for index in range(steps)}),
    )


def _points(setup: Setup) -> FrameMetric:
    return Points(setup.rig)


def _around(region: Region) -> RegionsOfInterest:
    """What is asked about: one region, and a grid that just holds it."""
    x, y = ((math.floor(low), math.ceil(high)) for low, high in (region.x, region.y))
    where = {"polygon_m": region.corners_m} if region.corners_m else {"x_m": region.x, "y_m": region.y}
    return RegionsOfInterest.model_validate(
        {"regions": {region.name: where}, "grid": {"x_m": x, "y_m": y, "cell_m": CELL_M}}
    )


def _weights(coverage: Coverage, seed: int) -> Tensor | None:
    """(R, B) how often each block of worlds comes in each draw; None where there are too few for a draw to say much."""
    assert coverage.blocks is not None  # `compare` keeps them
    used = (coverage.blocks.steps > 0).numpy()
    if used.sum() < MIN_BLOCKS:
        return None
    weights = np.zeros((DRAWS, len(used)))
    weights[:, used] = np.random.default_rng(seed).multinomial(used.sum(), np.full(used.sum(), 1 / used.sum()), DRAWS)
    return torch.from_numpy(weights)


def _own(coverages: Sequence[Coverage], region: Region, weights: Tensor | None) -> Iterator[Candidate]:
    """Our own: detection over the visible surface and over the known cells, for each band and both."""
    once = torch.ones(1, BLOCKS, dtype=torch.float64)
    for measure, words in MEASURES.items():
        each = {
            band: np.stack([_detection(one, region, band, measure, once, weights) for one in coverages])
            for band in coverages[0].grid.heights
        }
        for name, found in {**each, "both bands": np.mean(list(each.values()), axis=0)}.items():
            label = f"detection {THRESHOLD_M:g} m, {name}, {region.name}, {words}"
            yield Candidate(label, "coverage", found[:, 0], None if weights is None else found[:, 1:].T)


def _detection(
    coverage: Coverage, region: Region, band: str, measure: str, once: Tensor, weights: Tensor | None
) -> Array:
    """(1 + R,) the number itself, then that of each draw."""
    drawn = once if weights is None else torch.cat([once, weights])
    number, cells = list(coverage.grid.heights).index(band), region.mask(coverage.grid)
    if measure == "area":
        assert coverage.area is not None  # a surface reference
        m2, _, detected = area_in_blocks(coverage.area, number, cells).T
        return np.asarray((drawn @ detected) / (drawn @ m2))
    assert coverage.blocks is not None
    in_band = torch.zeros(coverage.grid.shape, dtype=torch.bool)
    in_band[number] = cells
    steps, (_, detected) = coverage.blocks.spread_over(in_band)
    probed = drawn @ steps.double()
    known = probed > 0
    means = (drawn @ detected.double()) / probed.where(known, 1.0)
    return np.asarray(means.sum(dim=1) / known.sum(dim=1))


def _rows(kind: Kind, metrics: Sequence[FrameMetric], weights: Tensor | None) -> Iterator[Candidate]:
    """A row for each number of a metric of one rig after the other."""
    numbers = [metric.compute() for metric in metrics]
    drawn = None
    if weights is not None and isinstance(metrics[0], WorldRatios):
        drawn = np.stack([metric.resampled(weights).numpy() for metric in metrics if isinstance(metric, WorldRatios)])
    for place, first in enumerate(numbers[0]):
        sign = 1.0 if first.higher_is_better else -1.0
        values = np.array([of_rig[place].value for of_rig in numbers])
        draws = None if drawn is None else sign * drawn[:, :, place].T
        name = first.name if first.higher_is_better else f"{first.name} (less is better)"
        yield Candidate(name, kind, sign * values, draws)
