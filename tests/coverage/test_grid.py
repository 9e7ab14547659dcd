"""Grid of half-open cells [lo, hi) on every axis."""

import math
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchcover import BevGrid

ONE_BAND = {"all": (-1.0, 1.0)}


def at(x=0.5, y=0.5, z=0.0, dtype=torch.float64):
    return torch.tensor([[x, y, z]], dtype=dtype)


def index_of(grid, point):
    """Return (h, y, x) of the cell of a point, or None."""
    cell = grid.find_cells(point).item()
    return None if cell < 0 else tuple(int(i) for i in np.unravel_index(cell, grid.shape))


# Borders


@pytest.mark.parametrize("bounds", [(0.0, 10.0), (-10.0, 0.0), (-3.0, 2.0), (10.0, 20.0), (-7.5, -2.5), (1e6, 1e6 + 5)])
@pytest.mark.parametrize("axis", ["x", "y"])
def test_cells_are_half_open_wherever_the_range_lies(bounds, axis):
    other = "y" if axis == "x" else "x"
    grid = BevGrid(**{f"{axis}_m": bounds, f"{other}_m": (0.0, 1.0)}, cell_m=0.5, heights=ONE_BAND)
    count = round((bounds[1] - bounds[0]) / 0.5)
    place = {"x": 2, "y": 1}[axis]
    for cell in range(count):
        low, high = bounds[0] + 0.5 * cell, bounds[0] + 0.5 * (cell + 1)
        for inside in (low, low + 0.25, math.nextafter(high, -math.inf)):
            assert index_of(grid, at(**{axis: inside}))[place] == cell
    for outside in (math.nextafter(bounds[0], -math.inf), bounds[1], bounds[1] + 1e9, -1e300):
        assert index_of(grid, at(**{axis: outside})) is None


def test_bands_are_half_open_without_gaps():
    grid = BevGrid(x_m=(0.0, 1.0), y_m=(0.0, 1.0), cell_m=1.0)
    for z, band in [(-0.5, 0), (0.0, 0), (0.4999, 0), (0.5, 1), (1.9999, 1), (2.0, None), (-0.5001, None)]:
        result = index_of(grid, at(z=z))
        assert (result and result[0]) == band if band is not None else result is None


@pytest.mark.parametrize("order", [("low", "middle", "high"), ("high", "low", "middle"), ("middle", "high", "low")])
def test_bands_come_in_any_order_and_with_gaps(order):
    bounds = {"low": (-2.0, -1.0), "middle": (-1.0, 0.5), "high": (3.0, 4.0)}
    grid = BevGrid(x_m=(0.0, 1.0), y_m=(0.0, 1.0), cell_m=1.0, heights={name: bounds[name] for name in order})
    expected = {-2.0: "low", -1.5: "low", -1.0: "middle", 0.0: "middle", 0.5: None, 2.0: None, 3.0: "high", 4.0: None}
    for z, name in {**expected, -2.5: None, 9.0: None}.items():
        result = index_of(grid, at(z=z))
        assert (order[result[0]] if result else None) == name


def test_many_bands_are_those_that_few_would_be():
    heights = {
        f"{k}": (0.1 * k, 0.1 * (k + 1) if k % 3 else 0.1 * k + 0.05) for k in np.random.default_rng(0).permutation(50)
    }
    grid = BevGrid(x_m=(0.0, 1.0), y_m=(0.0, 1.0), cell_m=1.0, heights=heights)
    for z in np.linspace(-0.1, 5.1, 300):
        expected = [band for band, (low, high) in enumerate(heights.values()) if low <= z < high]
        assert grid.find_cells(at(z=z)).item() == (expected[0] if expected else -1)


@pytest.mark.parametrize("shape", [(3,), (5, 2), (5, 4)])
def test_points_of_another_shape_are_refused(shape):
    with pytest.raises(ValueError, match=r"shape \(N, 3\) is needed"):
        BevGrid(x_m=(0.0, 1.0), y_m=(0.0, 1.0), cell_m=1.0).find_cells(torch.zeros(shape))


def test_cell_indices_run_over_bands_then_rows():
    grid = BevGrid(x_m=(0.0, 4.0), y_m=(-1.0, 2.0), cell_m=1.0, heights={"a": (0.0, 1.0), "b": (1.0, 2.0)})
    assert grid.shape == (2, 3, 4)
    assert grid.num_cells == 24
    assert grid.find_cells(at(x=3.5, y=0.5, z=1.5)).item() == (1 * 3 + 1) * 4 + 3


@pytest.mark.parametrize(
    ("cell", "bounds"), [(0.1, (0, 20)), (0.1, (-7, 3)), (0.3, (-3, 6)), (0.7, (0, 7)), (0.01, (0, 1))]
)
def test_a_border_is_the_decimal_that_one_writes(cell, bounds):
    """Multiples of 0.1 are not representable: 3 * 0.1 > 0.3, yet a point at x = 0.3 belongs to the cell [0.3, 0.4)."""
    grid = BevGrid(x_m=bounds, y_m=(0.0, cell), cell_m=cell, heights=ONE_BAND)
    decimal = Fraction(str(cell))
    borders = [float(bounds[0] + decimal * k) for k in range(grid.shape[2] + 1)]
    assert grid.x_edges_m.tolist() == borders
    points = torch.tensor([[border, 0.0, 0.0] for border in borders], dtype=torch.float64)
    assert grid.find_cells(points).tolist() == [*range(grid.shape[2]), -1]


@settings(max_examples=100, deadline=None)
@given(
    low=st.integers(-1000, 1000),
    count=st.integers(1, 300),
    cell=st.sampled_from([0.1, 0.25, 0.3, 0.05, 1.0, 2.5]),
    share=st.floats(-0.5, 1.5),
)
def test_points_lie_between_the_edges_of_their_cell(low, count, cell, share):
    bounds = (low * cell, (low + count) * cell)
    grid = BevGrid(x_m=(0.0, cell), y_m=bounds, cell_m=cell, heights=ONE_BAND)
    edges = grid.y_edges_m
    assert grid.shape == (1, count, 1)
    assert (edges[0], edges[-1]) == bounds
    assert (edges.diff() > 0).all()
    y = bounds[0] + share * (bounds[1] - bounds[0])
    result = grid.find_cells(at(x=0.0, y=y)).item()
    if bounds[0] <= y < bounds[1]:
        assert edges[result] <= y < edges[result + 1]
    else:
        assert result == -1


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_points_of_any_dtype_are_compared_exactly(dtype):
    grid = BevGrid(x_m=(0, 1), y_m=(0, 1), cell_m=0.1, heights=ONE_BAND)
    x = torch.arange(10).to(dtype) / 10
    points = torch.stack([x, torch.zeros_like(x), torch.zeros_like(x)], dim=1)
    # Rounded to a short dtype, 0.7 lies on one side of 0.7.
    expected = [max(k for k in range(10) if value >= k / 10) for value in x.double().tolist()]
    assert grid.find_cells(points).tolist() == expected
    assert grid.find_cells(points.T.contiguous().T.requires_grad_()).tolist() == expected


@pytest.mark.parametrize(
    ("x", "cell"),
    [
        ((-40.0, 160.0), 0.25),
        ((0.0, 0.7), 0.1),
        ((1e6, 1e6 + 3.0), 1e-3),
        ((-1e-9, 1e-9), 1e-11),
        ((1e8, 1e8 + 2**-16), 2**-24),
        ((1e8, 1e8 + 2**-20), 2**-28),
        ((-1e300, 1e300), 1e298),
        ((0.0, 1e-310), 1e-313),
    ],
)
def test_cells_equal_a_search_among_the_edges(x, cell, monkeypatch):
    """Test values on edges, next to them, between them, far outside and NaN, in one chunk and in several."""
    grid = BevGrid(x_m=x, y_m=(0.0, cell), cell_m=cell, heights=ONE_BAND)
    edges = grid.x_edges_m.numpy()
    between = np.random.default_rng(0).uniform(*x, 5000)
    far = [-np.inf, np.inf, np.nan, -1.7e308, 1.7e308, 0.0]
    values = np.concatenate([edges, np.nextafter(edges, -np.inf), np.nextafter(edges, np.inf), between, far])
    expected = np.searchsorted(edges, values, side="right") - 1
    expected[~((values >= edges[0]) & (values < edges[-1]))] = -1
    points = torch.zeros(len(values), 3, dtype=torch.float64)
    points[:, 0] = torch.from_numpy(values)
    for part in (65_536, 1000):
        monkeypatch.setattr("torchcover.coverage.grid.CHUNK_POINTS", part)
        np.testing.assert_array_equal(grid.find_cells(points), expected)


def test_no_points_have_no_cells():
    cells = BevGrid(x_m=(0, 1), y_m=(0, 1), cell_m=0.1).find_cells(torch.zeros(0, 3))
    assert (cells.shape, cells.dtype) == ((0,), torch.int64)


# Properties of grids


def test_centres_lie_in_the_middle():
    grid = BevGrid(x_m=(-1.0, 1.0), y_m=(2.0, 3.0), cell_m=0.5)
    assert grid.x_centers_m.tolist() == [-0.75, -0.25, 0.25, 0.75]
    assert grid.y_centers_m.tolist() == [2.25, 2.75]


def test_the_diagonal_spans_all_bands():
    grid = BevGrid(x_m=(-1.0, 2.0), y_m=(0.0, 4.0), cell_m=0.5, heights={"b": (5.0, 12.0), "a": (0.0, 1.0)})
    assert grid.diagonal_m == 13.0


def test_the_defaults_are_the_papers():
    grid = BevGrid(x_m=(0, 20), y_m=(-5, 5))
    assert grid.cell_m == 0.25
    assert grid.heights == {"ground": (-0.5, 0.5), "obstacle": (0.5, 2.0)}
    assert list(grid.heights) == ["ground", "obstacle"]


def test_grids_with_equal_cells_are_equal():
    heights = {"a": (0.0, 1.0), "b": (1.0, 2.0)}
    grid = BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0), cell_m=1.0, heights=heights)
    same = BevGrid(x_m=[0, 2], y_m=(0, 1), cell_m=1, heights={"a": [0, 1], "b": [1, 2]})
    assert grid == same
    assert hash(grid) == hash(same)
    assert repr(grid) == repr(same)
    assert grid != BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0), cell_m=1.0, heights={"b": (1.0, 2.0), "a": (0.0, 1.0)})
    assert grid != BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0), cell_m=0.5, heights=heights)
    assert grid != "a grid"


def test_a_grid_does_not_change_with_its_arguments():
    heights = {"a": (0.0, 1.0)}
    grid = BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0), cell_m=1.0, heights=heights)
    heights["b"] = (1.0, 2.0)
    assert grid.shape == (1, 1, 2)


# Refused inputs


@pytest.mark.parametrize("cell", [0.0, -0.5, math.nan, math.inf])
def test_a_cell_without_a_length_is_refused(cell):
    with pytest.raises(ValueError, match=f"cell_m: a positive length in meters is needed; got {cell}"):
        BevGrid(x_m=(0, 1), y_m=(0, 1), cell_m=cell)


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        ((1.0, 1.0), "the lower bound must be below the upper one; got .1.0, 1.0"),
        ((2.0, -2.0), "the lower bound must be below the upper one"),
        ((0.0, math.inf), "two finite bounds in meters are needed; got .0.0, inf"),
        ((math.nan, 1.0), "two finite bounds in meters are needed"),
        ((0.0, 1.0, 2.0), "two finite bounds in meters are needed"),
        ((0.0, 1.2), "its extent of 1.2 m is not a multiple of the cell of 0.5 m .2.4 cells.; a cell of 0.6 m would"),
        ((0.0, 0.2), "its extent of 0.2 m is not a multiple of the cell of 0.5 m .0.4 cells.; a cell of 0.2 m would"),
        ((0.0, 1e-7), "its extent of 1e-07 m is not a multiple of the cell of 0.5 m .2e-07 cells."),
        ((0.0, 0.5 + 0.8e-6), "its extent of 0.5000008 m is not a multiple of the cell of 0.5 m"),
        ((0.0, 500_000.25), "its extent of 500000.25 m is not a multiple of the cell of 0.5 m"),
    ],
)
def test_bounds_that_do_not_make_cells_are_refused(axis, bounds, message):
    other = "y" if axis == "x" else "x"
    with pytest.raises(ValueError, match=f"^{axis}_m: {message}"):
        BevGrid(**{f"{axis}_m": bounds, f"{other}_m": (0.0, 1.0)}, cell_m=0.5)


@pytest.mark.parametrize(
    ("heights", "message"),
    [
        ({}, "heights: at least one height band is needed"),
        ({"a": (1.0, 0.0)}, r"heights\['a'\]: the lower bound must be below"),
        ({"a": (0.0, math.nan)}, r"heights\['a'\]: two finite bounds"),
        ({"a": (0.5, 0.5)}, r"heights\['a'\]: the lower bound must be below"),
    ],
)
def test_bands_that_make_no_sense_are_refused(heights, message):
    with pytest.raises(ValueError, match=message):
        BevGrid(x_m=(0, 1), y_m=(0, 1), cell_m=0.5, heights=heights)


def test_too_large_grids_are_refused_before_allocation():
    with pytest.raises(ValueError, match=r"x_m: inf cells of 1e-310 m, over 100,000,000: use larger cells"):
        BevGrid(x_m=(0.0, 1.0), y_m=(0.0, 1.0), cell_m=1e-310)
    with pytest.raises(ValueError, match="the grid has 200,000,000 cells, over 100,000,000: use larger cells"):
        BevGrid(x_m=(0, 10_000), y_m=(0, 10_000), cell_m=1.0)
