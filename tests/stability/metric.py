"""Binning and sums at the extremes, through `CoverageMetric`, for every backend of the search."""

from collections import Counter
from fractions import Fraction
from functools import lru_cache, partial
from math import fsum

import numpy as np
import torch

from torchcover import BevGrid, Region
from torchcover.coverage.quantities import RADIUS
from torchcover.estimation import Estimate

from .case import Case, most, relative

STEPS, TIMES = 1000, 100
HALF_ULP = 2.0**-24
CELLS = 40
ANY_HEIGHT = {"all": (-1.0, 1.0)}
LAST_EDGE_M = CELLS / 10


def row_of_cells(count, cell=1.0, x=0.0):
    return BevGrid(x_m=(x, x + count * cell), y_m=(0.0, cell), cell_m=cell, heights=ANY_HEIGHT)


def merged(metric, times):
    """Create the sums of `times` metrics with equal frames."""
    total = metric.clone()
    total.reset()
    for _ in range(times):
        total.merge_state(metric)
    return total.compute()


# Sums over many steps


@lru_cache
def drawn_radii():
    """Create one float32 radius per frame, as exact distances along z."""
    return np.random.default_rng(0).uniform(0.0, 1.0, STEPS).astype(np.float32)


def many_steps(search):
    metric = search.metric(row_of_cells(1))
    sensor = search.cloud([0.5, 0.5, 0.0])
    for radius_m in drawn_radii().tolist():
        metric.update(sensor, search.cloud([0.5, 0.5, radius_m]))
    return relative(merged(metric, TIMES).radius.item(), fsum(drawn_radii().tolist()) / STEPS)


def many_steps_in_float32():
    total = np.cumsum(np.tile(drawn_radii(), TIMES), dtype=np.float32)[-1]
    return relative(float(total) / (STEPS * TIMES), fsum(drawn_radii().tolist()) / STEPS)


def seen_once(search):
    """One of 4096 = 1 + 45 * 91 frames has a point in the second cell at 0.75 m; all have one in the first."""
    metric, once = search.metric(row_of_cells(2)), search.metric(row_of_cells(2))
    sensor = search.cloud([[0.5, 0.5, 0.0], [1.5, 0.5, 0.0]])
    for _ in range(91):
        metric.update(sensor, search.cloud([0.5, 0.5, 0.25]))
    once.update(sensor, search.cloud([[0.5, 0.5, 0.25], [1.5, 0.5, 0.75]]))
    for _ in range(45):
        once.merge_state(metric)
    result = once.compute()
    right = result.observed_frames.flatten().tolist() == [4096, 1]
    return most(result.radius.flatten().cpu().numpy() - [0.25, 0.75]) if right else np.inf


@lru_cache
def crowd(count):
    heights = np.random.default_rng(1).uniform(0.0, 1.0, count).astype(np.float32)
    return np.stack([np.full_like(heights, 0.5), np.full_like(heights, 0.5), heights], axis=1)


def one_crowded_cell(count, search):
    metric = search.metric(row_of_cells(1))
    metric.update(search.cloud([0.5, 0.5, 0.0]), search.cloud(crowd(count)))
    return relative(metric.compute().radius.item(), fsum(crowd(count)[:, 2].tolist()) / count)


def one_crowded_cell_in_float32(count):
    total = np.cumsum(crowd(count)[:, 2], dtype=np.float32)[-1]
    return relative(float(total) / count, fsum(crowd(count)[:, 2].tolist()) / count)


# Borders


@lru_cache
def tenths(dtype):
    """Points on the borders of cells of 0.1 m and one rounding to either side: x, and the cell each belongs to."""
    x, cells = [], []
    for border in range(CELLS + 1):
        on = torch.tensor(border / 10, dtype=dtype)
        for point in (on, *(torch.nextafter(on, torch.tensor(far, dtype=dtype)) for far in (-9.0, 9.0))):
            # A border is the float64 number nearest to the decimal.
            borders_passed = sum(Fraction(float(point)) >= Fraction(k / 10) for k in range(CELLS + 1))
            x.append(point)
            cells.append(borders_passed - 1 if borders_passed <= CELLS else -1)
    return torch.stack(x), cells


def on_borders(dtype, search):
    x, cells = tenths(dtype)
    metric = search.metric(row_of_cells(CELLS, cell=0.1))
    reference = torch.stack([x, torch.full_like(x, 0.05), torch.zeros_like(x)], dim=1)
    metric.update(search.cloud([0.0, 0.0, 0.0]), reference.to(search.device))
    result = metric.compute()
    return wrong(result.point_counts.flatten().tolist(), cells) + abs(result.counts["outside_points"] - cells.count(-1))


def wrong(points, cells):
    """Count points in wrong cells, at least."""
    expected = Counter(cells)
    return sum(abs(count - expected[cell]) for cell, count in enumerate(points))


def on_borders_by_quotients(dtype):
    x, cells = tenths(dtype)
    result = [int(cell) if cell < CELLS else -1 for cell in torch.floor(x / 0.1).clamp(min=-1).tolist()]
    return sum(a != b for a, b in zip(result, cells, strict=True))


def coarse(dtype):
    """Every cell of 0.1 m met by numbers of a short type: x, and its cell by fractions."""
    x = torch.linspace(0.0, LAST_EDGE_M, 997).to(dtype)
    borders = [Fraction(k / 10) for k in range(CELLS + 1)]
    passed = [sum(Fraction(value) >= border for border in borders) for value in x.double().tolist()]
    return x, [count - 1 if count <= CELLS else -1 for count in passed]


def coarse_points(dtype, search):
    x, cells = coarse(dtype)
    metric = search.metric(row_of_cells(CELLS, cell=0.1))
    reference = torch.stack([x, torch.full_like(x, 0.05), torch.zeros_like(x)], dim=1)
    metric.update(search.cloud([0.0, 0.0, 0.0], dtype=dtype), reference.to(search.device))
    return wrong(metric.compute().point_counts.flatten().tolist(), cells)


def coarse_points_by_quotients(dtype):
    x, cells = coarse(dtype)
    result = torch.floor(x / torch.tensor(0.1, dtype=dtype)).long().tolist()
    return sum((a if a < CELLS else -1) != b for a, b in zip(result, cells, strict=True))


HEIGHTS = {"ground": (-0.3, 0.1), "middle": (0.1, 0.7), "top": (0.9, 1.1)}


@lru_cache
def heights_at_borders():
    """Points on the borders of height bands and just below them, and the band of each."""
    borders = {-0.3: (None, 0), 0.1: (0, 1), 0.7: (1, None), 0.9: (None, 2), 1.1: (2, None)}
    z = [height for border in borders for height in (np.nextafter(border, -9.0), border)]
    return np.array(z), [band for pair in borders.values() for band in pair]


def bands(search):
    z, expected = heights_at_borders()
    metric = search.metric(BevGrid(x_m=(0.0, 10.0), y_m=(0.0, 1.0), cell_m=1.0, heights=HEIGHTS))
    reference = np.stack([np.arange(10) + 0.5, np.full(10, 0.5), z], axis=1)
    metric.update(search.cloud([0.0, 0.0, 0.0]), search.cloud(reference, torch.float64))
    points = metric.compute().point_counts[:, 0].T.tolist()
    return sum(counts != [int(band == k) for k in range(3)] for counts, band in zip(points, expected, strict=True))


def bands_in_float32():
    """Comparisons in float32, where a border and the number just below it are one."""
    z, expected = heights_at_borders()
    z, lows, highs = (np.array(values, dtype=np.float32) for values in (z, *zip(*HEIGHTS.values(), strict=True)))
    inside = (z[:, None] >= lows) & (z[:, None] < highs)
    return sum(row.tolist() != [band == k for k in range(3)] for row, band in zip(inside, expected, strict=True))


def region_cells(search):
    """Regions whose borders are cell centres, written as decimals: the lower one belongs to it, the upper one not."""
    grid, wrong_cells = row_of_cells(CELLS, cell=0.1), 0
    metric = search.metric(grid)
    metric.update(search.cloud([0.0, 0.0, 0.0]), search.cloud([0.05, 0.05, 0.0]))
    result = metric.compute()
    for first in range(CELLS - 2):
        low, high = (2 * first + 1) / 20, (2 * first + 5) / 20
        rows = result.summary([Region("part", x_m=(low, high), y_m=(0.0, 0.1))])
        wrong_cells += abs(rows[0].num_cells - 2)
    return wrong_cells


def region_cells_by_steps():
    """Compute centers as running sums."""
    centres, wrong_cells = np.cumsum([0.05] + [0.1] * (CELLS - 1)), 0
    for first in range(CELLS - 2):
        low, high = (2 * first + 1) / 20, (2 * first + 5) / 20
        wrong_cells += abs(int(((centres >= low) & (centres < high)).sum()) - 2)
    return wrong_cells


JUST_INSIDE_M = np.arange(CELLS) * 0.25 + 0.24


def far_grid(origin_m, search):
    """Count wrong cells of a grid in world coordinates."""
    metric = search.metric(row_of_cells(CELLS, cell=0.25, x=origin_m))
    reference = np.stack([origin_m + JUST_INSIDE_M, np.full(CELLS, 0.1), np.zeros(CELLS)], axis=1)
    metric.update(
        search.cloud(reference + np.array([0.0, 0.0, 0.5]), torch.float64), search.cloud(reference, torch.float64)
    )
    result = metric.compute()
    return wrong(result.point_counts.flatten().tolist(), range(CELLS)) + int((result.radius != 0.5).sum())


def far_grid_in_float32(origin_m):
    x = (origin_m + JUST_INSIDE_M).astype(np.float32)
    result = np.floor((x - np.float32(origin_m)) / np.float32(0.25)).astype(int)
    return wrong([int((result == cell).sum()) for cell in range(CELLS)], range(CELLS))


# Thresholds


THRESHOLDS_M = tuple(step / 20 for step in range(1, CELLS + 1))


@lru_cache
def at_thresholds():
    """Create in each cell a point at the threshold and one just beyond it, each above a sensor point."""
    at = np.array(THRESHOLDS_M, dtype=np.float32)
    x = np.arange(CELLS, dtype=np.float32) * 16 + 4
    points = [np.stack([x + side, np.full_like(x, 8), distance], axis=1)
              for side, distance in ((0, at), (8, np.nextafter(at, np.float32(9))))]  # fmt: skip
    reference = np.concatenate(points)
    return reference, reference * np.array([1, 1, 0], dtype=np.float32)


def detections(search):
    reference, sensor = at_thresholds()
    grid = BevGrid(x_m=(0.0, 16.0 * CELLS), y_m=(0.0, 16.0), cell_m=16.0, heights={"all": (-1.0, 9.0)})
    metric = search.metric(grid, thresholds_m=THRESHOLDS_M)
    metric.update(search.cloud(sensor), search.cloud(reference))
    result = metric.compute().detection[:, 0, 0].diagonal()
    return int((result != 0.5).sum())


def detections_in_float64():
    reference, sensor = (cloud.astype(np.float64) for cloud in at_thresholds())
    result = (np.linalg.norm(reference - sensor, axis=1).reshape(2, CELLS) <= np.array(THRESHOLDS_M)).mean(axis=0)
    return int((result != 0.5).sum())


def crowded(count, **options):
    return Case(f"{count:,} points in one cell and step", "math.fsum", "relative", 1e-12,
                partial(one_crowded_cell, count),
                "float32 running sum", partial(one_crowded_cell_in_float32, count), **options)  # fmt: skip


# Numbers without a block


def lopsided_blocks():
    """Square metres, and radii times them, of 256 blocks; one has seen 1e12 times what the others have."""
    m2 = np.random.default_rng(1).uniform(1.0, 2.0, 256)
    m2[100] *= 1e12
    return m2, m2 * np.random.default_rng(2).uniform(0.1, 0.2, 256)


def without_the_largest():
    m2, sums = (np.delete(each, 100) for each in lopsided_blocks())
    return fsum(sums) / fsum(m2)


def left_out(_):
    m2, sums = map(torch.from_numpy, lopsided_blocks())
    estimate = Estimate.from_ratios((RADIUS,), m2, sums[:, None], torch.ones(256, dtype=torch.int64))
    return relative(estimate.jackknife_values[100].item(), without_the_largest())


def left_out_by_differences():
    m2, sums = lopsided_blocks()
    return relative((sums.sum() - sums[100]) / (m2.sum() - m2[100]), without_the_largest())


CASES = [
    Case("100,000 steps (1,000, merged 100 times)", "math.fsum", "relative", 1e-12, many_steps,
         "float32 running sum", many_steps_in_float32),
    crowded(5_000_000, benchmark_only=True),
    crowded(200_000),
    Case("a cell seen once in 4096 steps", "closed form", "m", 0.0, seen_once,
         "divided by all steps", lambda: 0.75 - 0.75 / 4096),
    Case("points on borders of 0.1 m cells, float64", "fractions", "of 123 wrong", 0,
         partial(on_borders, torch.float64),
         "floor(x / 0.1)", partial(on_borders_by_quotients, torch.float64)),
    Case("points on borders of 0.1 m cells, float32", "fractions", "of 123 wrong", 0,
         partial(on_borders, torch.float32),
         "floor(x / 0.1)", partial(on_borders_by_quotients, torch.float32)),
    Case("float16 points in 0.1 m cells", "fractions", "of 997 wrong", 0, partial(coarse_points, torch.float16),
         "floor(x / 0.1) in float16", partial(coarse_points_by_quotients, torch.float16)),
    Case("points on borders of height bands", "by hand", "of 10 wrong", 0, bands,
         "float32 comparisons", bands_in_float32),
    Case("region borders on cell centres", "by hand", "of 76 wrong", 0, region_cells,
         "centres as running sums", region_cells_by_steps),
    Case("grid 1e6 m from the origin, float64", "by hand", "of 40 wrong", 0, partial(far_grid, 1e6),
         "float32 coordinates", partial(far_grid_in_float32, 1e6)),
    Case("grid 1e7 m from the origin, float64", "by hand", "of 40 wrong", 0, partial(far_grid, 1e7),
         "float32 coordinates", partial(far_grid_in_float32, 1e7)),
    Case("thresholds equal to a distance, and just below", "by hand", "of 40 wrong", 0, detections,
         "float64 distances", detections_in_float64),
    Case("without one of 256 blocks, which has 1e12 times the others", "math.fsum", "relative", 1e-14, left_out,
         "all less the block, float64", left_out_by_differences),
]  # fmt: skip
