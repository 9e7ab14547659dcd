"""Measure rigs in the same frames against two reference sensors: the rays of the paper, and points on the surface."""

import math
from dataclasses import replace

import torch
from rich.progress import track

from torchcover import CoverageMetric
from torchcover.data import SimulatedFrames
from torchcover.simulation import PaperReference, SurfaceReference

# The paper's reference has hundreds of points in cells near the vehicle. With at most 16 per cell, the numbers of 8
# frames change by less than 0.1 percentage points of detection and 0.1 % of the radius.
MAX_POINTS_PER_CELL = 16


class Measurement:
    """Frames of a scenario with both reference sensors.

    Args:
        rigs: Name -> built-in name or path.
        grid: Cells of the paper's averages.
        regions: Regions within the grid.
        options: Options of the command line: scenario, frames, seed, and the range and rays of the reference sensors.
    """

    def __init__(self, rigs, grid, regions, options):
        self.grid = grid
        side = math.isqrt(options.num_rays)
        max_range_m = options.reference_range
        rays = PaperReference(rows=side, columns=side, max_range_m=max_range_m, keep_ego_points=options.ego_points)
        areas = tuple(dict.fromkeys((region.x_m, region.y_m) for region in regions))
        self.frames = SimulatedFrames(
            options.scenario,
            rigs=rigs,
            num_frames=options.num_frames,
            seed=options.seed,
            frame_interval_s=options.frame_interval_s,
            reference_sensor=rays,
        )
        self.surface_frames = self.frames.replace_reference_sensor(SurfaceReference(areas, max_range_m=max_range_m))

    def run(self, frame_indices, *, num_blocks=1, observers=()):
        """Measure all rigs.

        Args:
            frame_indices: Range of indices of frames.
            num_blocks: Number of blocks, as in `CoverageMetric`.
            observers: Objects whose `update` is called with each frame.

        Returns:
            (rig, average) -> `Coverage`, with the average "cells" or "area".
        """
        # Averages over area do not depend on the cell size, so that large cells save memory.
        coarse_grid = replace(self.grid, cell_m=1.0, band_frame="ground")
        settings = {"max_radius_m": self.grid.diagonal_m, "num_blocks": num_blocks}
        by_cells, by_area = {}, {}
        for rig in self.frames.rigs:
            by_cells[rig] = CoverageMetric(self.grid, **settings)
            by_area[rig] = CoverageMetric(coarse_grid, has_area_weights=True, **settings)
        for index in track(frame_indices, f"frames {frame_indices.start} to {frame_indices.stop - 1}"):
            frame, surface = self.frames[index], self.surface_frames[index]
            reference = thin_points(frame.reference, self.grid, MAX_POINTS_PER_CELL, seed=index)
            for rig, cloud in frame.clouds.items():
                by_cells[rig].update(cloud, reference, block_index=index)
                by_area[rig].update(
                    cloud,
                    surface.reference,
                    weights=surface.reference_weights,
                    heights_m=surface.reference_heights_m,
                    block_index=index,
                )
            for observer in observers:
                observer.update(frame)
        metrics = {"cells": by_cells, "area": by_area}
        return {(rig, average): metric.compute() for average in metrics for rig, metric in metrics[average].items()}


def thin_points(points, grid, max_points, seed):
    """Keep a random subset of the points of each cell, so that the mean over a cell keeps its expectation.

    Args:
        points: (M, 3) reference points in meters.
        grid: Grid of the cells; points outside the grid are removed.
        max_points: Maximum number of points per cell; cells with fewer points keep all.
        seed: Seed of the random choice.

    Returns:
        (K, 3) remaining points.
    """
    cells = grid.find_cells(points)
    inside = (cells >= 0).nonzero().squeeze(1)
    shuffled = inside[torch.randperm(len(inside), generator=torch.Generator().manual_seed(seed))]
    sorted_cells, order = cells[shuffled].sort(stable=True)
    rank_in_cell = torch.arange(len(sorted_cells)) - torch.searchsorted(sorted_cells, sorted_cells)
    return points[shuffled[order[rank_in_cell < max_points]]]
