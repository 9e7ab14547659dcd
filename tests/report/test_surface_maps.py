"""Maps of the visible surface: ratios of sums over cells, or over squares where points are few, and their opacity."""

import math

import numpy as np
import pytest
import torch

from torchcover.coverage import BevGrid, CoverageMetric, Region
from torchcover.coverage.sparse_sums import BlockSums
from torchcover.report.map_layers import (
    MapParams,
    compute_opacity,
    compute_ratios,
    compute_square_sides,
    downsample_coverage,
    sum_over_squares,
)

CELL_M = 0.25
# Neither a whole number of squares wide nor high.
GRID = BevGrid(x_m=(0.0, 5.75), y_m=(0.0, 3.25), cell_m=CELL_M, heights={"low": (0.0, 1.0), "high": (1.0, 2.0)})
ALL = Region("all", GRID.x_m, GRID.y_m)


def measured(steps: int = 16, points: int = 400):
    """Points that crowd in a corner and leave another empty, and weigh from 0.001 to 1 m2."""
    metric = CoverageMetric(GRID, (0.1, 0.2), num_blocks=16, has_area_weights=True)
    for index in range(steps):
        random = torch.Generator().manual_seed(index)
        size = torch.tensor([5.75, 3.25, 2.0])
        reference = torch.rand(points, 3, generator=random) ** torch.tensor([3.0, 3.0, 1.0]) * size
        reference[:, 0] *= 0.6
        m2 = 10 ** (-3 * torch.rand(points, generator=random))
        metric.update(torch.rand(60, 3, generator=random) * size, reference, weights=m2, block_index=index)
    return metric.compute()


@pytest.fixture(scope="module")
def coverage():
    """Some cells with many points, and some with few or none."""
    return measured()


@pytest.fixture(scope="module")
def sides(coverage):
    """How its maps are cut."""
    return compute_square_sides(coverage.point_counts, CELL_M)


def cut(points: np.ndarray, sides: np.ndarray, y: int, x: int, side: int) -> None:
    """A slow twin: cut one square, then its quarters."""
    quarters = [(y + dy, x + dx, side // 2) for dy in (0, side // 2) for dx in (0, side // 2)]
    inside = [points[qy : qy + half, qx : qx + half].sum() for qy, qx, half in quarters]
    if side > 1 and all(found == 0 or found >= MapParams.min_points for found in inside):
        for quarter in quarters:
            cut(points, sides, *quarter)
    else:
        sides[y : y + side, x : x + side] = side


def test_squares_split_only_with_enough_points(coverage, sides):
    expected = np.zeros(GRID.shape, dtype=int)
    for band in range(2):
        for y in range(0, GRID.shape[1], 8):
            for x in range(0, GRID.shape[2], 8):
                cut(coverage.point_counts[band].numpy(), expected[band], y, x, 8)
    assert set(sides.unique().tolist()) == {1, 2, 4, 8}
    np.testing.assert_array_equal(sides, expected)


@pytest.mark.parametrize(("cell_m", "largest"), [(0.25, 8), (0.3, 4), (1.0, 2), (2.0, 1), (5.0, 1)])
def test_squares_are_at_most_two_meters(cell_m, largest):
    points = torch.zeros(1, 20, 20, dtype=torch.int64)
    points[0, 9, 9] = 1
    square = compute_square_sides(points, cell_m) == largest
    # What is empty is cut to cells.
    assert int(square.sum()) == (400 if largest == 1 else largest**2)
    assert square[0, 9, 9]


def test_dense_cells_keep_their_own_ratio(coverage, sides):
    alone = (sides == 1) & (coverage.point_counts > 0)
    assert int(alone.sum()) > 40
    for found, key in zip(compute_ratios(coverage.area_sums, sides), list(coverage.layers)[3:], strict=True):
        assert torch.equal(found[alone], coverage.layers[key].values[alone])


def test_square_has_the_ratio_of_sums(coverage, sides):
    m2, *sums = coverage.area_sums.sum_blocks().numpy()
    sums = np.stack(sums)
    found = compute_ratios(coverage.area_sums, sides).numpy()
    for band, y, x in zip(*(sides == 4).numpy().nonzero(), strict=True):
        rows, columns = (slice(at // 4 * 4, at // 4 * 4 + 4) for at in (y, x))
        expected = sums[:, band, rows, columns].sum(axis=(1, 2)) / m2[band, rows, columns].sum()
        np.testing.assert_allclose(found[:, band, y, x], expected, rtol=1e-12)


def test_map_weights_equal_the_region(coverage, sides):
    m2 = sum_over_squares(coverage.area_sums.sum_blocks()[0], sides)
    each = m2 / sum_over_squares(torch.ones_like(m2), sides)
    for band, height in enumerate(GRID.heights):
        weighted = (compute_ratios(coverage.area_sums, sides)[:, band] * each[band]).nansum(dim=(1, 2)) / each[
            band
        ].sum()
        torch.testing.assert_close(weighted, coverage.estimate(ALL, height).value, rtol=1e-12, atol=0)


def test_cells_without_area_are_transparent(coverage, sides):
    seen = sum_over_squares(coverage.area_sums.sum_blocks()[0], sides) > 0
    assert 0 < int(seen.sum()) < seen.numel()
    assert torch.equal(compute_ratios(coverage.area_sums, sides).isfinite(), seen.expand(3, -1, -1, -1))
    opacity = compute_opacity(coverage.area_sums, 16, sides, CELL_M)
    assert torch.equal(opacity == 0, ~seen)
    assert opacity[seen].min() > MapParams.min_opacity
    assert opacity.max() <= 1


def listed_of(m2: torch.Tensor, sums: torch.Tensor) -> BlockSums:
    """One block; (Q, cells) sums."""
    at = m2.flatten().nonzero().squeeze(1)
    return BlockSums(torch.tensor([10]), (1, *m2.shape), at, m2.flatten()[at], sums[:, at])


def sums_of(m2: torch.Tensor) -> BlockSums:
    return listed_of(m2, torch.zeros(1, m2.numel()))


def test_opacity_grows_with_visible_area():
    m2 = torch.tensor([0.0, 1e-9, 0.01, 0.1, 10 * CELL_M**2, 50.0]).double()[None, None]
    one = torch.ones(m2.shape, dtype=torch.int64)
    nothing, *rising, full, more = compute_opacity(sums_of(m2), 10, one, CELL_M).flatten().tolist()
    assert nothing == 0 < MapParams.min_opacity < rising[0] < rising[1] < rising[2] < full == more == 1


def test_open_ground_is_opaque_at_grid_edges():
    ground = torch.full((1, 5, 5), 10 * CELL_M**2).double()
    for side in (1, 2, 4, 8):
        opacity = compute_opacity(sums_of(ground), 10, torch.full((1, 5, 5), side), CELL_M)
        torch.testing.assert_close(opacity, torch.ones_like(opacity), rtol=1e-12, atol=0)
        quarter = compute_opacity(sums_of(ground / 4), 10, torch.full((1, 5, 5), side), CELL_M)
        torch.testing.assert_close(
            quarter, torch.full_like(quarter, (1 + MapParams.min_opacity) / 2), rtol=1e-12, atol=0
        )


def test_infinity_stays_in_its_square():
    sums = torch.zeros(1, 1, 4, 4).double()
    sums[..., 0, 0] = math.inf
    area = listed_of(torch.ones(1, 4, 4).double(), sums.flatten(1))
    (found,) = compute_ratios(area, torch.full((1, 4, 4), 2))
    assert torch.equal(found.isinf()[0], torch.tensor([[True, True, False, False]] * 2 + [[False] * 4] * 2))


@pytest.mark.parametrize(("cell", "drawn_m"), [(0.25, 0.25), (0.15, 0.15), (0.125, 0.25), (0.05, 0.2)])
def test_small_cells_are_merged_without_change(cell, drawn_m):
    """Neither side of the grid is a whole number of squares; a region's ratio is that of its squares."""
    grid = BevGrid(
        x_m=(0.0, 46 * cell), y_m=(0.0, 25 * cell), cell_m=cell, heights={"low": (0.0, 1.0), "high": (1.0, 2.0)}
    )
    metric = CoverageMetric(grid, (0.1,), num_blocks=8, has_area_weights=True, regions=[])
    for seed in range(16):
        random = torch.Generator().manual_seed(seed)
        rig, reference = (torch.rand(99, 3, generator=random) * torch.tensor([7.0, 4.0, 2.0]) for _ in range(2))
        metric.update(rig, reference, weights=torch.rand(99, generator=random) + 0.1, block_index=seed)
    whole = metric.compute()
    drawn = downsample_coverage(whole)
    assert (drawn.grid.cell_m, drawn is whole) == (pytest.approx(drawn_m), drawn_m == cell)
    assert drawn.point_counts.sum() == whole.point_counts.sum()
    assert drawn.layers.keys() == whole.layers.keys()
    assert drawn.errors.keys() == whole.errors.keys()
    side = round(drawn_m / cell)
    near = Region("near", (0.0, 4 * side * cell), (0.0, 2 * side * cell))
    for one, other in zip(*(each.estimate(near, "low").jackknife_values for each in (drawn, whole)), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)
    m2, sums, *_ = (
        whole.area_sums.sum_blocks()[:, 1, : 2 * side, : 4 * side].reshape(-1, 2, side, 4, side).sum(dim=(2, 4))
    )
    found = drawn.layers["radius_area_m"].values[1, :2, :4]
    torch.testing.assert_close(found, sums / m2, rtol=1e-12, atol=0, equal_nan=True)
