"""One pass over a scenario: all rigs at the same instants, against the same reference clouds."""

from dataclasses import dataclass

import numpy as np
import torch

from torchcover import BevGrid, Coverage, CoverageMetric
from torchcover.data import SimulatedFrames
from torchcover.evaluation import CoverageObserver, observe, sensor_views
from torchcover.report import SensorView
from torchcover.simulation import EvenReference, PaperReference

BLOCKS = 16  # for standard errors
# One band that holds every point of a rig.
ANY_HEIGHT = {"any": (-100.0, 100.0)}


@dataclass
class OnePass:
    """What it gave: coverage by rig and grid, and on request how many points of a rig fell into each cell."""

    coverages: dict[tuple[str, BevGrid], Coverage]
    points: dict[tuple[str, BevGrid], torch.Tensor]
    ego_outline_m: np.ndarray
    sensors: dict[str, list[SensorView]]
    seconds: float


def one_pass(measured, counted, regions, options):
    """Run it.

    Args:
        measured: Names of rigs and grids whose coverage is wanted.
        counted: Those whose points shall be counted cell by cell.
        regions: Those that numbers are wanted for.
        options: Scenario, steps, time between them, seed, and the reference sensor with its rays.
    """
    measured = list(dict.fromkeys(measured))
    rigs = list(dict.fromkeys(rig for rig, _ in measured))
    frames = SimulatedFrames(
        options.scenario,
        rigs={name: name for name in rigs},
        steps=options.steps,
        seed=options.seed,
        every_s=options.every,
        reference_sensor=reference_of(regions, options),
    )
    coverages = {
        (rig, grid): CoverageObserver(CoverageMetric(grid, max_radius=grid.diagonal_m, blocks=BLOCKS), rig)
        for rig, grid in measured
    }
    points = {(rig, grid): PointCount(grid, rig) for rig, grid in counted}
    run = observe(frames, [*coverages.values(), *points.values()], progress=True, title=" ".join(rigs))
    return OnePass(
        coverages={key: observer.compute() for key, observer in coverages.items()},
        points={key: observer.compute() for key, observer in points.items()},
        ego_outline_m=frames.ego_outline_m,
        sensors={name: sensor_views(sensors) for name, sensors in frames.sensors.items()},
        seconds=run.seconds,
    )


def reference_of(regions, options):
    """The paper's reference sensor, or one whose rays are even over each of the regions."""
    if options.reference == "paper":
        side = round(options.rays**0.5)
        return PaperReference(rows=side, columns=side)
    return EvenReference(tuple(dict.fromkeys((region.x, region.y) for region in regions)), rays=options.rays)


class PointCount:
    """(Y, X) how many points of a rig lie in each cell of a grid, at any height; an observer of frames."""

    def __init__(self, grid, rig):
        self.grid = BevGrid(x=grid.x, y=grid.y, cell=grid.cell, heights=ANY_HEIGHT)
        self.rig = rig
        self.points = torch.zeros(self.grid.cells, dtype=torch.int64)

    def update(self, frame):
        cells = self.grid.cell_of(frame.cloud_of(self.rig))
        self.points += torch.bincount(cells[cells >= 0], minlength=self.grid.cells)

    def compute(self):
        return self.points.reshape(self.grid.shape[1:])

    def merge_state(self, other):
        self.points += other.points
