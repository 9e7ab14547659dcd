"""Rigs at the same instants against two references: the paper's rays for its mean over known cells, and points drawn on
the surface for the mean over the visible square metres."""

import math
from dataclasses import replace

from rich.progress import track

from examples.paper.thinning import thinned
from torchcover import CoverageMetric
from torchcover.data import SimulatedFrames
from torchcover.simulation import PaperReference, SurfaceReference

# Of the paper's points in a cell so many are kept: numbers of 8 steps move by less than 0.1 points and 0.1 %.
POINTS_PER_CELL = 16
# Sums over the surface do not depend on the cell.
CELL_OF_AREAS_M = 1.0


class Measurement:
    """Instants of a scenario, and where numbers of them are wanted.

    Args:
        rigs: Name -> built-in name or path.
        grid: Cells of the paper's mean.
        regions: Within the grid.
        options: Of the command line: scenario, steps, seconds between them, seed, and of the references.
    """

    def __init__(self, rigs, grid, regions, options):
        self.grid = grid
        side = math.isqrt(options.rays)
        reach_m = options.reference_range
        rays = PaperReference(rows=side, columns=side, max_range_m=reach_m, keep_ego_points=options.ego_points)
        areas = tuple(dict.fromkeys((region.x, region.y) for region in regions))
        self.frames = SimulatedFrames(
            options.scenario,
            rigs=rigs,
            num_frames=options.steps,
            seed=options.seed,
            frame_interval_s=options.every,
            reference_sensor=rays,
        )
        self.surface_frames = self.frames.replace_reference_sensor(SurfaceReference(areas, max_range_m=reach_m))

    def run(self, steps, *, blocks=1, also=()):
        """Measure.

        Args:
            steps: Their numbers.
            blocks: As of `CoverageMetric`.
            also: What else is to be updated with each frame.

        Returns:
            Rig and measure, "known" or "area" -> `Coverage`.
        """
        reach_m, coarse = self.grid.diagonal_m, replace(self.grid, cell=CELL_OF_AREAS_M, band_frame="ground")
        known = {rig: CoverageMetric(self.grid, max_radius=reach_m, blocks=blocks) for rig in self.frames.rigs}
        area = {
            rig: CoverageMetric(coarse, max_radius=reach_m, blocks=blocks, square_metres=True)
            for rig in self.frames.rigs
        }
        for index in track(steps, f"steps {steps.start} to {steps.stop - 1}"):
            frame, surface = self.frames[index], self.surface_frames[index]
            reference = thinned(frame.reference, self.grid, POINTS_PER_CELL, seed=index)
            for rig, cloud in frame.clouds.items():
                known[rig].update(cloud, reference, block_index=index)
                area[rig].update(
                    cloud,
                    surface.reference,
                    weights=surface.reference_weights,
                    heights_m=surface.reference_heights_m,
                    block_index=index,
                )
            for observer in also:
                observer.update(frame)
        metrics = {"known": known, "area": area}
        return {(rig, measure): metric.compute() for measure in metrics for rig, metric in metrics[measure].items()}
