"""Ray tiles have each ray once, within their cone."""

import numpy as np
import pytest

from torchcover.simulation import PaperReference
from torchcover.simulation.rays import compute_unit_directions, split_into_tiles


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (5, 7), (128, 128), (129, 300), (300, 2)])
def test_every_ray_is_in_one_tile(rows, columns):
    directions = compute_unit_directions(np.linspace(-30, 10, rows)[:, None], np.linspace(-60, 60, columns)[None])
    tiled = np.concatenate([tile.directions for tile in split_into_tiles(directions)], axis=1)
    expected = directions.reshape(3, -1).astype(np.float32)
    assert tiled.shape == expected.shape
    np.testing.assert_array_equal(np.sort(tiled.view("i4")), np.sort(expected.view("i4")))


@pytest.mark.parametrize("rows", [2, 64, 300])
def test_rays_lie_in_the_cone_of_their_tile(rows):
    for tile in split_into_tiles(PaperReference(rows=rows, columns=400).compute_directions()):
        assert np.linalg.norm(tile.axis) == pytest.approx(1.0)
        angles = np.arccos(np.clip(tile.axis @ tile.directions.astype(np.float64), -1, 1))
        assert angles.max() <= tile.half_angle_rad + 1e-6


def test_opposite_directions_have_a_spherical_cone():
    both_ways = np.array([[1.0, -1.0], [0.0, 0.0], [0.0, 0.0]]).reshape(3, 1, 2)
    (tile,) = split_into_tiles(both_ways)
    assert tile.half_angle_rad == pytest.approx(np.pi)
