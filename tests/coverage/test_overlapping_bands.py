"""Overlapping bands do not affect each other."""

import pytest
import torch

from torchcover import BevGrid, CoverageMetric
from torchcover.coverage import Maximum

BANDS = {"child": (0.1, 1.1), "dog": (0.05, 0.5), "all": (-1.0, 2.0), "above": (1.1, 2.0)}


def grid_of(heights):
    return BevGrid(x_m=(-2.0, 2.0), y_m=(-1.0, 1.0), cell_m=0.5, heights=heights)


def measured(heights, **options):
    metric = CoverageMetric(grid_of(heights), max_radius_m=3.0, num_blocks=8, aggregations=[Maximum()], **options)
    for index in range(12):
        generator = torch.Generator().manual_seed(index)
        sensor, reference = (torch.randn(count, 3, generator=generator) for count in (20, 200))
        metric.update(sensor, reference, weights=torch.rand(200, generator=generator) + 0.1)
    return metric.compute()


@pytest.mark.filterwarnings("ignore:reference. .* points lie outside the grid or in no height band:UserWarning")
@pytest.mark.parametrize("has_area_weights", [False, True])
def test_overlapping_bands_do_not_affect_each_other(has_area_weights):
    together = measured(BANDS, has_area_weights=has_area_weights)
    for number, (name, band) in enumerate(BANDS.items()):
        alone = measured({name: band}, has_area_weights=has_area_weights)
        assert torch.equal(together.point_counts[number], alone.point_counts[0])
        for key, layer in alone.layers.items():
            torch.testing.assert_close(
                together.layers[key].values[number], layer.values[0], equal_nan=True, rtol=0, atol=0
            )
        for key, error in alone.errors.items():
            torch.testing.assert_close(together.errors[key][number], error[0], equal_nan=True, rtol=0, atol=0)


def test_a_point_in_several_bands_is_counted_once():
    together, widest = measured(BANDS), measured({"all": BANDS["all"]})
    assert together.counts == widest.counts
    assert together.point_counts.sum() > together.counts["inside_points"] == widest.point_counts.sum()


def test_assigned_cells_are_the_cells_of_each_band():
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(1))
    bins = grid_of(BANDS).assign_cells(points)
    result = set(zip(bins.point_indices[bins.point_positions].tolist(), bins.cell_indices.tolist(), strict=True))
    expected = set()
    for number, (name, band) in enumerate(BANDS.items()):
        cells = grid_of({name: band}).find_cells(points)
        expected |= {(at, cell + number * 32) for at, cell in enumerate(cells.tolist()) if cell >= 0}
    assert result == expected
    assert len(bins.cell_indices) == len(expected)
    assert bins.point_indices.tolist() == sorted({at for at, _ in expected})


@pytest.mark.parametrize("heights", [BANDS, {"ground": (-0.5, 0.5), "obstacle": (0.5, 2.0)}], ids=["over", "above"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_points_by_column_are_those_of_the_bins(heights, dtype, monkeypatch):
    monkeypatch.setattr("torchcover.coverage.grid.CHUNK_POINTS", 300)
    points = torch.randn(1000, 3, generator=torch.Generator().manual_seed(1), dtype=dtype)
    points[:9] = torch.tensor([-2.0, -1.0, 0.05, 0.5, 1.0, 1.1, 2.0, torch.inf, torch.nan])[:, None]
    points[9:18, :2], points[9:18, 2] = 0.25, points[:9, 0]  # on the borders of the bands
    points[18:27, 0] = points[:9, 0]
    grid = grid_of(heights)
    expected = torch.bincount(grid.assign_cells(points).cell_indices % 32, minlength=32).view(4, 8)
    assert torch.equal(grid.count_points_by_column(points), expected.double())
    assert expected.sum() > 300
    assert torch.equal(grid.count_points_by_column(points[:0]), torch.zeros(4, 8, dtype=torch.float64))


def test_find_cells_refuses_overlapping_bands():
    with pytest.raises(ValueError, match="the height bands overlap, so that a point may be in several cells: use"):
        grid_of(BANDS).find_cells(torch.zeros(1, 3))
