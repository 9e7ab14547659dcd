"""What a study of error against run time is about."""

from dataclasses import dataclass
from pathlib import Path

import torch

from torchcover.coverage import CoverageMetric
from torchcover.data import SimulatedFrames, reference_called
from torchcover.evaluation.settings import DEFAULT_SCENARIO, new_metric, spread_s
from torchcover.simulation import Scenario

# Seeds of the runs are next to each other; the long run's is far away.
LONG_RUN_SEED = 1_000_003


@dataclass(frozen=True)
class StudyPlan:
    """Which reference sensors are tried, for how long, and what they are measured against.

    Args:
        rig: A built-in name or a YAML file.
        scenario: Likewise.
        rays: Rays of the reference sensor at each step; each number is tried with every sensor.
        steps: Most steps of a run.
        runs: Runs with other seeds that errors are averaged over.
        long_run_steps: Steps of the run that the others are measured against.
        long_run_rays: Its rays at each step: no fewer than any other has, for fewer never see some cells of some steps.
        every_s: Time between two steps in seconds; as in `evaluate` if not given.
        seed: Seed of the first run.
        cell_m: Side of a grid cell in metres.
        threshold_m: Detection threshold in metres.
        references: Names of the reference sensors that are tried; the long run is of the first. Those whose points have
            square metres have another measure, and are not possible.

    Raises:
        ValueError: No ray, step, run or reference sensor, a long run with fewer rays than another, or a reference
            sensor that is not possible.
    """

    rig: str | Path
    scenario: str | Path = DEFAULT_SCENARIO
    rays: tuple[int, ...] = (1024, 4096, 16_384, 65_536, 262_144, 1_048_576)
    steps: int = 64
    runs: int = 3
    long_run_steps: int = 256
    long_run_rays: int = 1_048_576
    every_s: float | None = None
    seed: int = 0
    cell_m: float = 0.5
    threshold_m: float = 0.4
    references: tuple[str, ...] = ("even", "paper")

    def __post_init__(self) -> None:
        for name in ("rays", "references"):
            if not getattr(self, name):
                raise ValueError(f"{name}: at least one is needed; got none")
        for name in ("steps", "runs", "long_run_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: at least 1 is needed; got {getattr(self, name)}")
        if self.long_run_rays < max(self.rays):
            raise ValueError(
                f"long_run_rays: no fewer than any run has are needed, {max(self.rays)}; got {self.long_run_rays}"
            )
        for name in self.references:
            if reference_called(name).weight_kind == "m2":
                raise ValueError(f"references: {name} measures by area, which the others do not")

    def frames(self, seed: int, steps: int) -> SimulatedFrames:
        """The frames of a run, whatever the reference sensor."""
        scenario = Scenario.load(self.scenario)
        return SimulatedFrames(scenario, self.rig, steps=steps, seed=seed, every_s=spread_s(scenario, self.every_s))

    def long_frames(self) -> SimulatedFrames:
        """Those of the long run."""
        frames = self.frames(LONG_RUN_SEED + self.seed, self.long_run_steps)
        return frames.with_reference_sensor(reference_called(self.references[0], self.long_run_rays))

    def metric(self, blocks: int) -> CoverageMetric:
        """An empty metric."""
        return new_metric(self.cell_m, (self.threshold_m,), torch.device("cpu"), blocks=blocks)
