import math
from collections import defaultdict

import numpy as np
import pytest
from scipy.spatial.distance import cdist


@pytest.fixture(scope="session")
def slow_coverage():
    """Definitions as plain float64 loops, independent of the package: (grid, frames, thresholds) -> maps."""
    return _slow_coverage


def _slow_coverage(grid, steps, thresholds_m=(0.4,), max_radius=math.inf):
    per_cell = defaultdict(list)  # Distances of the points of each frame with points in the cell, by cell.
    for sensor, reference in steps:
        in_step = defaultdict(list)
        distance = cdist(reference, sensor).min(axis=1, initial=math.inf)
        for point, r in zip(reference.tolist(), distance.tolist(), strict=True):
            in_step[_cell_of(grid, point)].append(r)
        for cell, distances in in_step.items():
            per_cell[cell].append(np.array(distances))
    per_cell.pop(None, None)

    shape = grid.shape
    maps = {name: np.full(shape, np.nan) for name in ("radius", "radius_maximum_m", "radius_pooled_m")}
    maps |= {name: np.zeros(shape, dtype=int) for name in ("observed_frames", "point_counts")}
    maps["detection"] = np.full((len(thresholds_m), *shape), np.nan)
    for cell, in_steps in per_cell.items():
        radii = [np.minimum(distances, max_radius) for distances in in_steps]
        maps["radius"][cell] = np.mean([r.mean() for r in radii])
        maps["detection"][(slice(None), *cell)] = [np.mean([(d <= t).mean() for d in in_steps]) for t in thresholds_m]
        maps["radius_maximum_m"][cell] = np.concatenate(radii).max()
        maps["radius_pooled_m"][cell] = np.concatenate(radii).mean()
        maps["observed_frames"][cell], maps["point_counts"][cell] = len(radii), sum(map(len, radii))
    return maps


def _cell_of(grid, point):
    x, y, z = point
    bands = [h for h, (low, high) in enumerate(grid.heights.values()) if low <= z < high]
    inside = grid.x_m[0] <= x < grid.x_m[1] and grid.y_m[0] <= y < grid.y_m[1] and bands
    return (bands[0], int((y - grid.y_m[0]) // grid.cell_m), int((x - grid.x_m[0]) // grid.cell_m)) if inside else None
