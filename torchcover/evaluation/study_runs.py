"""The runs of a study: what is tried, the long run that it is measured against, and a stopwatch."""

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from torch import Tensor

from torchcover.coverage import Coverage, CoverageMetric, forward_regions
from torchcover.coverage.measures import area_in_blocks
from torchcover.evaluation.measuring import BLOCKS, metric_of
from torchcover.evaluation.observers import CoverageObserver
from torchcover.evaluation.pipeline import observe
from torchcover.evaluation.progress import progress_of
from torchcover.evaluation.settings import DEFAULT_SCENARIO, OPTIONS, Settings
from torchcover.evaluation.task import Task, simulation
from torchcover.files import end_with_parent
from torchcover.simulation import ReferenceSensor, SimulatedFrames, reference_called

# The long run's seed is far away from any other.
LONG_RUN_SEED = 1_000_003
# What runs have reached is looked at after these steps at the least, then after twice as many, ...
DOUBLINGS = 4
DEFAULT_STEPS = 128


@dataclass(frozen=True)
class StudyPlan:
    """Which numbers of rays of the surface reference are tried, for how many steps, and what they are measured against.

    Args:
        settings: Of `evaluate`: one rig and a scenario, by names or paths, and what else decides about its numbers;
            `steps` are the most of a run (128).
        rays: Numbers of rays of the reference sensor at each step.
        runs: Runs of so many steps that errors are averaged over; shorter ones are their parts, so that there are more.
        long_run: What the runs are measured against: a coverage file of the same rig in the same scenario, with another
            seed. Not given: a run is made for it.
        long_run_steps: Steps of that run.

    Raises:
        ValueError: No number of rays or run, or not one rig by its name.
    """

    settings: Settings
    rays: tuple[int, ...] = (1024, 4096, 16_384)
    runs: int = 2
    long_run: Path | None = None
    long_run_steps: int = 512

    def __post_init__(self) -> None:
        if not self.rays:
            raise ValueError("rays: at least one is needed; got none")
        for name in ("runs", "long_run_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: at least 1 is needed; got {getattr(self, name)}")
        named = (*self.settings.rigs, self.settings.scenario or DEFAULT_SCENARIO)
        if len(named) != 2 or not all(isinstance(one, str | Path) for one in named):
            raise ValueError(
                "study: one rig and a scenario are needed, by names or paths: a command is timed with them"
            )

    @property
    def rig(self) -> str:
        """What the rig was called."""
        return str(self.settings.rigs[0])

    @property
    def scenario(self) -> str:
        """What the scenario was called."""
        return str(self.settings.scenario or DEFAULT_SCENARIO)

    @property
    def lengths(self) -> list[int]:
        """Steps after which runs are looked at: each twice the one before."""
        steps = self.settings.steps or DEFAULT_STEPS
        shortest = max(1, steps >> DOUBLINGS)
        return [shortest << k for k in range(DOUBLINGS + 1) if shortest << k <= steps]

    def frames(self, seed: int, steps: int) -> SimulatedFrames:
        """The frames of a run."""
        return simulation(replace(self.settings, seed=seed, steps=steps)).frames

    def reference_sensor(self, rays: int) -> ReferenceSensor:
        """The reference sensor, aimed as that of `evaluate`."""
        return reference_called(rays=rays, asked=self.task.asked)

    def metric(self, blocks: int) -> CoverageMetric:
        """An empty metric."""
        return metric_of(self.settings, self.task.asked, square_metres=True, blocks=blocks)

    @property
    def command(self) -> list[str]:
        """What `torchcover` is told to do the same: the command, the rig, and the options that are not as usual."""
        usual, words = Settings(), ["evaluate", self.rig]
        for name, option in OPTIONS.items():
            given = getattr(self.settings, name)
            if option.in_study and given != getattr(usual, name):
                each = given if isinstance(given, tuple) else [given]
                words += [f"--{name.replace('_', '-')}={value}" for value in each]
        return words

    @cached_property
    def task(self) -> Task[SimulatedFrames]:
        """What is measured."""
        return simulation(self.settings)


@dataclass(frozen=True)
class Truth:
    """The long run: what it says about the paper's regions and bands.

    Args:
        coverage: Its coverage, by area.

    Raises:
        ValueError: It has no square metres.
    """

    coverage: Coverage

    def __post_init__(self) -> None:
        if self.coverage.measure != "area":
            raise ValueError("long run: its reference points had no square metres; make it with the surface reference")

    @property
    def errors(self) -> dict[str, float]:
        """Its own standard errors by the key of their quantity, root mean squares: no smaller error can be told."""
        places = [(region, height) for region in forward_regions() for height in self.coverage.grid.heights]
        each = torch.stack([self.coverage.estimate(*place).error for place in places])
        return self._by_key(each.square().nanmean(dim=0).sqrt())

    def distances(self, sums: Tensor) -> dict[str, float]:
        """Root mean squares of what runs are off by, over them, the regions and the bands, by the key of the quantity.

        NaN if a run has seen nothing of a region of which the long run has.

        Args:
            sums: (N, R, 1 + Q, H) what `area_sums` says of each of N runs.
        """
        truth = _ratios(area_sums(self.coverage))
        known = truth.isfinite()
        squares = (_ratios(sums) - truth).square().where(known, 0.0)
        return self._by_key((squares.sum(dim=(0, 1, 3)) / (len(sums) * known.sum(dim=(0, 2)))).sqrt())

    def _by_key(self, numbers: Tensor) -> dict[str, float]:
        keys = [quantity.key for quantity in self.coverage.quantities]
        return dict(zip(keys, numbers.tolist(), strict=True))


def area_sums(coverage: Coverage) -> Tensor:
    """(R, 1 + Q, H) sums over the visible surface of the paper's R regions in H bands; those of other steps add up.

    The square metres, then those times each of Q quantities.
    """
    places = [[(region, height) for height in coverage.grid.heights] for region in forward_regions()]
    return torch.stack(
        [torch.stack([area_in_blocks(coverage, *place)[1].sum(dim=0) for place in row], 1) for row in places]
    )


def long_run(plan: StudyPlan, *, progress: bool) -> Truth:
    """Do it, or read it.

    Raises:
        FileNotFoundError: No such file.
        ValueError: It is no coverage by area, or one with other settings.
    """
    if plan.long_run is None:
        observer = CoverageObserver(plan.metric(BLOCKS))
        frames = plan.frames(LONG_RUN_SEED + plan.settings.seed, plan.long_run_steps)
        observe(frames, [observer], progress=progress, title="long run")
        return Truth(observer.compute())
    coverage = Coverage.load(plan.long_run)
    for name, wanted in _settings_of(plan.metric(blocks=1)).items():
        if (there := _settings_of(coverage)[name]) != wanted:
            raise ValueError(f"{plan.long_run}: {name} is {there} there; {wanted} is needed")
    return Truth(coverage)


def _settings_of(measured: Coverage | CoverageMetric) -> dict[str, object]:
    """Those of a study that a coverage file knows."""
    return {"cell_m": measured.grid.cell, "thresholds_m": measured.thresholds, "max_radius": measured.max_radius}


def _ratios(sums: Tensor) -> Tensor:
    return sums[..., 1:, :] / sums[..., :1, :]


@dataclass
class Clock:
    """Seconds that went into something."""

    seconds: float = 0.0

    @contextmanager
    def running(self) -> Iterator[None]:
        """Add what is done within."""
        start = time.perf_counter()
        yield
        self.seconds += time.perf_counter() - start


@dataclass
class Trial:
    """A number of rays at work.

    Args:
        rays: How many.
        frames: What they see.
        observer: Fed with it; empty after every `lengths[0]` steps.
        casting: The rays of the rig and of the reference.
        measuring: The search and the sums.
        parts: What `area_sums` said each time.
    """

    rays: int
    frames: SimulatedFrames
    observer: CoverageObserver
    casting: Clock = field(default_factory=Clock)
    measuring: Clock = field(default_factory=Clock)
    parts: list[Tensor] = field(default_factory=list)

    def add(self, index: int) -> None:
        """Do a step."""
        with self.casting.running():
            frame = self.frames[index]
        with self.measuring.running():
            self.observer.update(frame)

    def end_part(self) -> None:
        """Note what the last steps said."""
        self.parts.append(area_sums(self.observer.compute()))
        self.observer.metric.reset()

    def sums(self, parts: int) -> Tensor:
        """(N, ...) those of N runs, each of so many parts."""
        each = torch.stack(self.parts)
        return each.view(-1, parts, *each.shape[1:]).sum(dim=1)


@dataclass(frozen=True)
class Tried:
    """All trials, and what time they share.

    Args:
        trials: One for each number of rays.
        steps: Steps of each.
        start_s: What a command of any number of steps takes beside them: Python, imports, maps and files.
        worlds_s: What building the worlds took.
    """

    trials: list[Trial]
    steps: int
    start_s: float
    worlds_s: float

    def seconds(self, trial: Trial, steps: int) -> float:
        """What a command of so many steps takes."""
        whole = self.worlds_s + trial.casting.seconds + trial.measuring.seconds
        return self.start_s + whole * steps / self.steps


def tried(plan: StudyPlan, one_step_s: float, *, progress: bool) -> Tried:
    """Do all steps of all runs, one after the other.

    Args:
        plan: What to try.
        one_step_s: What `command_s` said.
        progress: Whether to show a bar.
    """
    steps, part = plan.runs * plan.lengths[-1], plan.lengths[0]
    base = plan.frames(plan.settings.seed, steps)
    trials = [
        Trial(rays, base.with_reference_sensor(plan.reference_sensor(rays)), CoverageObserver(plan.metric(blocks=1)))
        for rays in plan.rays
    ]
    worlds, first, scene, first_step_s = Clock(), trials[0], None, 0.0
    with progress_of(steps, "runs", shown=progress) as bar:
        for index in range(steps):
            cast_s = first.casting.seconds
            with worlds.running():  # each trial would have built it alone
                before, (scene, _) = scene, base.simulator.scene_of(index)
                if scene is not before:
                    first.frames[index]  # what the first frame of a world prepares for the others
            for trial in trials:
                trial.add(index)
                if (index + 1) % part == 0:
                    trial.end_part()
            if scene is not before:  # that frame was cast twice
                worlds.seconds -= first.casting.seconds - cast_s
            if index == 0:
                first_step_s = worlds.seconds + first.casting.seconds + first.measuring.seconds
            bar.advance(steps)
    return Tried(trials, steps, one_step_s - first_step_s, worlds.seconds)


def command_s(plan: StudyPlan) -> float:
    """How long `torchcover evaluate` takes for one step, from its start to its end.

    Raises:
        ValueError: It fails.
    """
    words = [*plan.command, f"--rays={plan.rays[0]}", "--steps=1"]
    clock = Clock()
    with TemporaryDirectory() as folder, clock.running():
        command = [sys.executable, "-m", "torchcover", *words, f"--out={folder}"]
        done = subprocess.run(command, check=False, capture_output=True, text=True, preexec_fn=end_with_parent())
    if done.returncode:
        raise ValueError(f"torchcover {' '.join(words)} ended with {done.returncode}: {done.stderr.strip()}")
    return clock.seconds
