"""What a study of error against run time is about."""

from dataclasses import dataclass
from pathlib import Path

import torch

from torchcover.coverage import CoverageMetric
from torchcover.evaluation.settings import DEFAULT_SCENARIO, new_metric, spread_s
from torchcover.simulation import (
    Asked,
    ReferenceSensor,
    RegionsOfInterest,
    Rig,
    Scenario,
    SimulatedFrames,
    reference_called,
    with_ego,
)

# The long run's seed is far away from any other.
LONG_RUN_SEED = 1_000_003
# What runs have reached is looked at after these steps at the least, then after twice as many, ...
DOUBLINGS = 4


@dataclass(frozen=True)
class StudyPlan:
    """Which numbers of rays of the surface reference are tried, for how many steps, and what they are measured against.

    Args:
        rig: A built-in name or a YAML file.
        scenario: Likewise.
        vehicle: What carries the rig, as in `evaluate`.
        rays: Numbers of rays of the reference sensor at each step.
        steps: Most steps of a run.
        runs: Runs of so many steps that errors are averaged over; shorter ones are their parts, so that there are more.
        long_run: What the runs are measured against: a coverage file of the same rig in the same scenario, with another
            seed. Not given: a run is made for it.
        long_run_steps: Steps of that run.
        every_s: Time between two steps in seconds; as in `evaluate` if not given.
        seed: Seed of the runs.
        cell_m: Side of a grid cell in metres.
        threshold_m: Detection threshold in metres.

    Raises:
        ValueError: No number of rays, step or run.
    """

    rig: str | Path
    scenario: str | Path = DEFAULT_SCENARIO
    vehicle: str | None = None
    rays: tuple[int, ...] = (1024, 4096, 16_384)
    steps: int = 128
    runs: int = 2
    long_run: Path | None = None
    long_run_steps: int = 512
    every_s: float | None = None
    seed: int = 0
    cell_m: float = 0.25
    threshold_m: float = 0.4

    def __post_init__(self) -> None:
        if not self.rays:
            raise ValueError("rays: at least one is needed; got none")
        for name in ("steps", "runs", "long_run_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: at least 1 is needed; got {getattr(self, name)}")

    @property
    def lengths(self) -> list[int]:
        """Steps after which runs are looked at: each twice the one before."""
        shortest = max(1, self.steps >> DOUBLINGS)
        return [shortest << k for k in range(DOUBLINGS + 1) if shortest << k <= self.steps]

    def frames(self, seed: int, steps: int) -> SimulatedFrames:
        """The frames of a run."""
        scenario = Scenario.load(self.scenario)
        return SimulatedFrames(
            scenario,
            self.rig,
            steps=steps,
            seed=seed,
            every_s=spread_s(scenario, self.every_s),
            vehicle=self.vehicle,
            reference_sensor=self.reference_sensor(),
        )

    def reference_sensor(self, rays: int | None = None) -> ReferenceSensor:
        """The reference sensor, aimed as that of `evaluate`."""
        return reference_called(rays=rays, asked=self.asked)

    @property
    def asked(self) -> Asked:
        """What `evaluate` is asked about, too."""
        scenario = with_ego(Scenario.load(self.scenario), {str(self.rig): Rig.load(self.rig)}, self.vehicle)
        return RegionsOfInterest().around(scenario.ego_box().outline_m, self.cell_m)

    def metric(self, blocks: int) -> CoverageMetric:
        """An empty metric."""
        return new_metric(self.asked, (self.threshold_m,), torch.device("cpu"), blocks=blocks, square_metres=True)
