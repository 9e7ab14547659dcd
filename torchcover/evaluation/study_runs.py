"""The runs of a study: every number of rays over the same instants, with a stopwatch."""

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from tempfile import TemporaryDirectory

import torch
from torch import Tensor

from torchcover.evaluation.observers import CoverageObserver
from torchcover.evaluation.progress import progress_of
from torchcover.evaluation.study_plan import StudyPlan
from torchcover.evaluation.study_truth import area_sums
from torchcover.simulation import SimulatedFrames


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
    base = plan.frames(plan.seed, steps)
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
    command = [sys.executable, "-m", "torchcover", "evaluate", str(plan.rig), "--scenario", str(plan.scenario)]
    settings: dict[str, object] = {"rays": plan.rays[0], "steps": 1, "seed": plan.seed, "cell": plan.cell_m}
    if plan.vehicle is not None:
        settings["vehicle"] = plan.vehicle
    clock = Clock()
    with TemporaryDirectory() as folder, clock.running():
        options = [f"--{name}={value}" for name, value in settings.items()]
        done = subprocess.run([*command, *options, f"--out={folder}"], check=False, capture_output=True, text=True)
    if done.returncode:
        raise ValueError(f"{' '.join([*command[1:], *options])} ended with {done.returncode}: {done.stderr.strip()}")
    return clock.seconds
