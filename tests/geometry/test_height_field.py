"""Height fields against slow implementations and closed forms."""

import numpy as np
import pytest

from torchcover.geometry.height_field import VERGE_WEIGHT, HeightField, accumulate_heights, fit_height_field

RANDOM = np.random.default_rng(5)


def height_of(field, place_m):
    """Interpolate at one position: the plane through the corners of its triangle."""
    rows, columns = field.corner_heights_m.shape
    x, y = np.clip((np.asarray(place_m) - field.origin_m) / field.cell_m, 0.0, [columns - 1, rows - 1])
    column, row = min(int(x), columns - 2), min(int(y), rows - 2)
    x, y = x - column, y - row
    first, right, left, across = (
        field.corner_heights_m[row + up, column + on] for up, on in ((0, 0), (0, 1), (1, 0), (1, 1))
    )
    if x >= y:
        return first + x * (right - first) + y * (across - right)
    return first + y * (left - first) + x * (across - left)


def test_heights_are_interpolated_and_clamped_at_the_border():
    field = HeightField(np.array([-3.0, 7.0]), RANDOM.normal(size=(4, 6)), 0.5)
    places_m = RANDOM.uniform([-4.0, 6.0], [0.5, 9.5], (500, 2))
    assert field.compute_heights_m(places_m) == pytest.approx(
        [height_of(field, place_m) for place_m in places_m], abs=1e-12
    )
    assert field.compute_heights_m(field.corner_positions_m) == pytest.approx(field.corner_heights_m.ravel(), abs=1e-12)


def test_above_adds_what_lies_beneath():
    field = HeightField(np.array([1.0, 2.0]), RANDOM.normal(size=(3, 3)), 2.0)
    places_m = RANDOM.uniform([1.0, 2.0], [5.0, 6.0], (50, 2))
    plane = field.add_base(lambda at_m: at_m @ [0.5, -0.25])
    assert plane.compute_heights_m(places_m) - field.compute_heights_m(places_m) == pytest.approx(
        places_m @ [0.5, -0.25], abs=1e-12
    )


def test_positions_contribute_to_surrounding_corners():
    rows, columns = 5, 6
    cells = RANDOM.uniform(-0.5, 5.5, (60, 2))
    heights_m, weights = RANDOM.normal(size=60), RANDOM.uniform(0.1, 2.0, 60)
    expected = np.zeros((2, rows, columns))
    for (x, y), height_m, weight in zip(cells, heights_m, weights, strict=True):
        if not (0 <= np.floor(x) < columns - 1 and 0 <= np.floor(y) < rows - 1):
            continue
        for row, column in np.ndindex(rows, columns):
            share = max(0.0, 1 - abs(x - column)) * max(0.0, 1 - abs(y - row)) * weight
            for at_row, at_column in np.ndindex(rows, columns):
                apart = max(abs(at_row - row), abs(at_column - column))
                part = share * ((apart == 0) + VERGE_WEIGHT * (apart <= 1))
                expected[:, at_row, at_column] += part * height_m, part
    assert np.array(accumulate_heights(cells, heights_m, rows, columns, weights)) == pytest.approx(expected, abs=1e-12)


def test_fit_finds_a_slope_despite_objects():
    places_m = RANDOM.uniform(0.0, 20.0, (4000, 2))
    slope_m = 1.0 + places_m @ [0.03, -0.02]
    heights_m = slope_m + RANDOM.normal(0.0, 0.01, 4000)
    heights_m[::5] += 0.8  # heights of objects
    field = fit_height_field(places_m, heights_m, np.array([20.0, 20.0]), (4.0, 2.0), above_weight=0.3)
    inner = (np.abs(places_m - 10.0) < 9.0).all(axis=1)
    assert np.abs(field.compute_heights_m(places_m[inner]) - slope_m[inner]).max() < 0.05
    finer = fit_height_field(places_m, heights_m, np.array([20.0, 20.0]), (1.0,), above_weight=0.3, base_field=field)
    assert np.abs(finer.compute_heights_m(places_m[inner]) - slope_m[inner]).max() < 0.05
    assert finer.cell_m == 1.0


def test_who_is_trusted_counts_wherever_he_stands():
    places_m = np.stack(np.meshgrid(np.arange(12.0), np.arange(12.0)), axis=-1).reshape(-1, 2)
    bump_m = 0.9 * (np.abs(places_m - 5.5) < 1.0).all(axis=1)
    size_m = np.array([11.0, 11.0])
    trusted = fit_height_field(places_m, bump_m, size_m, (1.0,), trusted_mask=np.ones(len(places_m), dtype=bool))
    doubted = fit_height_field(places_m, bump_m, size_m, (1.0,))
    top = np.array([[5.5, 5.5]])
    assert trusted.compute_heights_m(top)[0] > 0.6
    assert abs(doubted.compute_heights_m(top)[0]) < 0.2
