"""One pass over a scenario: all rigs at the same instants, against the same reference clouds."""

import time
from dataclasses import dataclass

import numpy as np
import torch
from rich.progress import track

from torchcover import BevGrid, Coverage, CoverageMetric
from torchcover.cli.run import outline_m, sensor_views
from torchcover.data import SimulatedFrames
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
    metrics = {(rig, grid): CoverageMetric(grid, max_radius=grid.diagonal_m, blocks=BLOCKS) for rig, grid in measured}
    points = {(rig, grid): torch.zeros(grid.shape[1:], dtype=torch.int64) for rig, grid in counted}
    start = time.perf_counter()
    for index in track(range(len(frames)), description=" ".join(rigs)):
        frame = frames[index]
        for (rig, _), metric in metrics.items():
            metric.update(frame.clouds[rig], frame.reference, weights=frame.reference_weights, index=index)
        for rig, grid in counted:
            points[rig, grid] += points_in_cells(frame.clouds[rig], grid)
    return OnePass(
        coverages={key: metric.compute() for key, metric in metrics.items()},
        points=points,
        ego_outline_m=outline_m(frames.scene.ego_box),
        sensors={name: sensor_views(rig) for name, rig in frames.rigs.items()},
        seconds=time.perf_counter() - start,
    )


def reference_of(regions, options):
    """The paper's reference sensor, or one whose rays are even over each of the regions."""
    if options.reference == "paper":
        side = round(options.rays**0.5)
        return PaperReference(rows=side, columns=side)
    return EvenReference(tuple(dict.fromkeys((region.x, region.y) for region in regions)), rays=options.rays)


def points_in_cells(cloud, grid):
    """(Y, X) how many points of a cloud lie in each cell of a grid, at any height."""
    flat = BevGrid(x=grid.x, y=grid.y, cell=grid.cell, heights=ANY_HEIGHT)
    cells = flat.cell_of(cloud)
    return torch.bincount(cells[cells >= 0], minlength=flat.cells).reshape(grid.shape[1:])
