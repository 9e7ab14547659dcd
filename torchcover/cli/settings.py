"""What `evaluate` and `compare` let the user set in the same way, and what they make of it."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch.utils.data import Dataset

from torchcover import __version__
from torchcover.cli.run import GRID_X_M, GRID_Y_M, Progression
from torchcover.cli.stopping import TargetError
from torchcover.coverage import forward_regions
from torchcover.data import Frame, SimulatedFrames
from torchcover.simulation import REFERENCE_SENSORS, ReferenceSensor, Rig, Scenario

DEFAULT_REFERENCE = "even"
DEFAULT_STEPS = 64
# A world is built once a minute of traffic, for about the price of eight steps: docs/accuracy.md has the trade.
EVERY_S_IN_TRAFFIC = 10.0
# As many as the paper averages.
MAX_STEPS = 4096


@dataclass(frozen=True)
class Settings:
    """Options that `torchcover evaluate` and `torchcover compare` share; None where the user gave none."""

    steps: int | None
    seed: int
    out: Path
    cell: float
    thresholds: tuple[float, ...]
    reference: str | None
    rays: int | None
    every_s: float | None
    target: TargetError | None
    error_maps: bool
    explain: bool
    device: str
    workers: int

    @property
    def simulated_steps(self) -> int:
        """Steps of a simulation, at most."""
        return self.steps or (DEFAULT_STEPS if self.target is None else MAX_STEPS)


def simulated_frames(
    settings: Settings, scenario: str, *, rig: str | None = None, rigs: Mapping[str, Rig] | None = None
) -> SimulatedFrames:
    """The frames that were asked for. In traffic they are spread over many cities, unless `--every` says otherwise."""
    world = Scenario.load(scenario)
    return SimulatedFrames(
        world,
        rig,
        rigs=rigs,
        steps=settings.simulated_steps,
        seed=settings.seed,
        every_s=every_s_of(world, settings.every_s),
        reference_sensor=reference_called(settings.reference, settings.rays),
    )


def every_s_of(scenario: Scenario, given_s: float | None) -> float | None:
    """Time between two steps: what was given, else 10 s in traffic; None for the scenario's own time step."""
    return EVERY_S_IN_TRAFFIC if given_s is None and scenario.traffic is not None else given_s


def reference_called(name: str | None, rays: int | None) -> ReferenceSensor:
    """The reference sensor of `--reference` and `--rays`.

    Args:
        name: One of `REFERENCE_SENSORS`, which is asked about the paper's regions and the grid; None for the default.
        rays: About how many rays at each step; None for the sensor's own number.

    Raises:
        ValueError: Another name, or too few rays.
    """
    kind = REFERENCE_SENSORS.get(name or DEFAULT_REFERENCE)
    if kind is None:
        known = " or ".join(f"`{name}`" for name in REFERENCE_SENSORS)
        raise ValueError(f"--reference {name}: {known} is needed")
    areas = (*((region.x, region.y) for region in forward_regions()), (GRID_X_M, GRID_Y_M))
    return kind.from_rays(areas, rays)


def reference_record(
    settings: Settings, progression: Progression, frames: Dataset[Frame], steps: int
) -> dict[str, object]:
    """Which reference sensor a simulation used, how many rays it cast, and how often, for `summary.json`."""
    assert isinstance(frames, SimulatedFrames)
    rays = progression.counts["reference_rays"] // steps
    return {"sensor": settings.reference or DEFAULT_REFERENCE, "rays_per_step": rays, "every_s": frames.every_s}


def reference_note(record: dict[str, object]) -> str:
    """The same in words."""
    return (
        f"Reference sensor: {record['sensor']}, {record['rays_per_step']:,} rays a step; a step every "
        f"{record['every_s']:g} s."
    )


def run_record(settings: Settings, progression: Progression) -> dict[str, Any]:
    """How the run went, for `summary.json`."""
    return {
        "torchcover": __version__,
        "device": settings.device,
        "seconds": round(progression.seconds, 3),
        "complete": progression.complete,
        "frame_counts": dict(progression.counts),
    }
