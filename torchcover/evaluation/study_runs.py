"""The short runs of a study: every trial over the same instants, with a stopwatch."""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from statistics import median
from typing import Any, NamedTuple

from torch import Tensor

from torchcover.data import SimulatedFrames, reference_called
from torchcover.evaluation.observers import CoverageObserver
from torchcover.evaluation.progress import progress_of
from torchcover.evaluation.study_plan import StudyPlan
from torchcover.evaluation.study_truth import Truth
from torchcover.neighbors import nearest

# The other backend of the search is tried up to here; beyond, it takes minutes.
MAX_RAYS_BY_BRUTE_FORCE = 4096
# What a run has reached is noted after all its steps, half of them, a quarter, ...
HALVINGS = 6
TIMED_STEPS = 5


class Trial(NamedTuple):
    """A reference sensor, by its name, with a number of rays."""

    reference_sensor: str
    rays: int


class Sample(NamedTuple):
    """What one run of a trial has reached after some steps."""

    trial: Trial
    steps: int
    seconds: float
    squared_errors: Tensor


@dataclass
class _Timed:
    """A trial at work, and what it has cost so far."""

    trial: Trial
    frames: SimulatedFrames
    observer: CoverageObserver
    seconds: float = 0.0

    def add(self, index: int) -> None:
        """Do a step, and note the time."""
        start = time.perf_counter()
        self.observer.update(self.frames[index])
        self.seconds += time.perf_counter() - start


def one_run(plan: StudyPlan, seed: int, truth: Truth, *, progress: bool) -> Iterator[Sample]:
    """Every trial over the same instants; yields what it has reached whenever the steps have doubled."""
    every = _trials(plan, seed)
    stops = {max(1, plan.steps >> halvings) for halvings in range(HALVINGS)}
    with progress_of(plan.steps, f"seed {seed}", shown=progress) as bar:
        for index in range(plan.steps):
            start = time.perf_counter()
            every[0].frames.simulator.scene_of(index)  # each of them would have built it alone
            world_seconds = time.perf_counter() - start
            for timed in every:
                timed.seconds += world_seconds
                timed.add(index)
                if index + 1 in stops:
                    reached = truth.squared_errors(timed.observer.compute())
                    yield Sample(timed.trial, index + 1, timed.seconds, reached)
            bar.advance(plan.steps)


def time_stages(plan: StudyPlan) -> list[dict[str, Any]]:
    """How a step of each trial divides into the rays, the search and the binning, in seconds; medians of five."""
    stages = []
    for timed in _trials(plan, plan.seed):
        times = zip(*(_one_step(timed, index % plan.steps) for index in range(TIMED_STEPS)), strict=True)
        names = ("rays_s", "search_s", "binning_s", "cdist_s")
        medians = {name: median(seconds) for name, seconds in zip(names, times, strict=True)}
        stages.append({"reference": timed.trial.reference_sensor, "rays": timed.trial.rays, **medians})
    return stages


def _trials(plan: StudyPlan, seed: int) -> list[_Timed]:
    base = plan.frames(seed, plan.steps)
    return [
        _Timed(
            Trial(name, rays),
            base.with_reference_sensor(reference_called(name, rays)),
            CoverageObserver(plan.metric(blocks=1)),
        )
        for rays in plan.rays
        for name in plan.references
    ]


def _one_step(timed: _Timed, index: int) -> tuple[float, float, float, float]:
    timed.frames.simulator.scene_of(index)  # not counted: it comes once for many steps
    start, metric = time.perf_counter(), timed.observer.metric
    frame = timed.frames[index]
    cast = time.perf_counter()
    timed.observer.update(frame)
    updated = time.perf_counter()
    inside = frame.reference[metric.grid.cell_of(frame.reference) >= 0]
    searching = time.perf_counter()
    nearest(inside, frame.sensor, max_distance=metric.max_radius)
    searched = time.perf_counter()
    search_s, brute_force_s = searched - searching, math.nan
    if timed.trial.rays <= MAX_RAYS_BY_BRUTE_FORCE:
        nearest(inside, frame.sensor, max_distance=metric.max_radius, backend="cdist")
        brute_force_s = time.perf_counter() - searched
    return cast - start, search_s, max(0.0, updated - cast - search_s), brute_force_s
