"""What an evaluation is done with, unless the user says otherwise."""

from dataclasses import dataclass

import torch

from torchcover.coverage import BevGrid, CoverageMetric, Region, forward_regions
from torchcover.evaluation.target_error import TargetError
from torchcover.simulation import REFERENCE_SENSORS, ReferenceSensor, Scenario

DEFAULT_SCENARIO = "courtyard"
DEFAULT_REFERENCE = "even"
DEFAULT_STEPS = 64
# With a target error; as many as the paper averages.
MAX_STEPS = 4096
# A world is built once a minute of traffic, for about the price of eight steps: docs/accuracy.md has the trade.
EVERY_S_IN_TRAFFIC = 10.0
# For standard errors: at least half as many are in use at the end of a long run.
BLOCKS = 16
# Holds the paper's regions, and the space beside and behind the vehicle.
GRID_X_M = (-40.0, 160.0)
GRID_Y_M = (-40.0, 40.0)


@dataclass(frozen=True)
class Settings:
    """What `evaluate` and `compare` let the user set, see there; None where the user gave nothing."""

    steps: int | None = None
    seed: int = 0
    cell_m: float = 0.25
    thresholds: tuple[float, ...] = (0.4,)
    reference: str | None = None
    rays: int | None = None
    every_s: float | None = None
    target_error: TargetError | None = None
    device: str = "cpu"
    workers: int = 0
    skip_bad_frames: bool = False

    @property
    def simulated_steps(self) -> int:
        """Steps of a simulation, at most."""
        return self.steps or (DEFAULT_STEPS if self.target_error is None else MAX_STEPS)

    @property
    def regions(self) -> tuple[Region, ...]:
        """Those that numbers are given for."""
        return forward_regions()

    def check_recording(self) -> None:
        """Find out whether anything was set that a recording decides itself.

        Raises:
            ValueError: The reference sensor, its rays or the time between steps was set.
        """
        if any(setting is not None for setting in (self.reference, self.rays, self.every_s)):
            raise ValueError("reference, rays and every are for simulations; a recording has its reference points")

    def metric(self) -> CoverageMetric:
        """An empty metric."""
        return new_metric(self.cell_m, self.thresholds, usable_device(self.device))


def usable_device(name: str) -> torch.device:
    """The device of this name.

    Raises:
        ValueError: It cannot be used here.
    """
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"device {name}: cannot be used here ({str(error).splitlines()[0]}); try cpu") from error
    return device


def new_metric(
    cell_m: float, thresholds: tuple[float, ...], device: torch.device, *, blocks: int = BLOCKS
) -> CoverageMetric:
    """An empty metric over the grid of every evaluation, with standard errors unless there is one block only.

    Raises:
        ValueError: A cell or a threshold that makes no sense, or more cells than the memory has room for.
    """
    grid = BevGrid(x=GRID_X_M, y=GRID_Y_M, cell=cell_m)
    try:
        return CoverageMetric(grid, thresholds, max_radius=grid.diagonal_m, blocks=blocks).to(device)
    except RuntimeError as error:  # what torch raises when there is no memory left
        raise ValueError(
            f"a cell of {cell_m:g} m: there is not enough memory for the sums of {grid.cells:,} cells in {blocks} "
            "blocks; use larger cells"
        ) from error


def spread_s(scenario: Scenario, given_s: float | None) -> float | None:
    """Time between two steps: what was given, else 10 s in traffic; None for the scenario's own time step."""
    return EVERY_S_IN_TRAFFIC if given_s is None and scenario.traffic is not None else given_s


def reference_called(name: str | None, rays: int | None) -> ReferenceSensor:
    """A reference sensor by its name.

    Args:
        name: One of `REFERENCE_SENSORS`; None for the default. Asked about the paper's regions and the grid.
        rays: About how many rays at each step; None for the sensor's own number.

    Raises:
        ValueError: Another name, or too few rays.
    """
    kind = REFERENCE_SENSORS.get(name or DEFAULT_REFERENCE)
    if kind is None:
        raise ValueError(f"reference {name}: {' or '.join(f'`{known}`' for known in REFERENCE_SENSORS)} is needed")
    areas = (*((region.x, region.y) for region in forward_regions()), (GRID_X_M, GRID_Y_M))
    return kind.from_rays(areas, rays)
