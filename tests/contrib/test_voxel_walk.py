"""Voxel traversal against exact arithmetic, closed forms and invariances."""

from fractions import Fraction
from itertools import product

import numpy as np
import pytest

from torchcover.contrib.voxels import VoxelGrid, find_crossed_voxels
from torchcover.geometry import BoundingBox

# Side lengths that are exact in binary, with different numbers of voxels.
GRID = VoxelGrid(BoundingBox((-1.0, -0.5, -0.5), (1.0, 1.0, 0.5)), 0.5)
TINY = Fraction(1, 10**6)


def piece(grid, place, origin, direction, end):
    """Compute the exact length of a ray in a voxel, in voxels along its longest axis, as a fraction."""
    side, start, stop = Fraction(grid.voxel_m), Fraction(0), None if end == np.inf else Fraction(end)
    for axis in range(3):
        low = Fraction(grid.region.lower_m[axis]) + place[axis] * side
        o, d = Fraction(origin[axis]), Fraction(direction[axis])
        if d == 0:
            if not low <= o < low + side:
                return Fraction(0)
            continue
        enters, leaves = sorted([(low - o) / d, (low + side - o) / d])
        start, stop = max(start, enters), leaves if stop is None else min(stop, leaves)
    return max(stop - start, Fraction(0)) * max(abs(Fraction(d)) for d in direction) / side


def slowly(grid, origins, directions, ends):
    least, most = np.zeros(grid.shape, dtype=bool), np.zeros(grid.shape, dtype=bool)
    for origin, direction, end in zip(origins.tolist(), directions.tolist(), ends.tolist(), strict=True):
        for place in product(*map(range, grid.shape)):
            length = piece(grid, place, origin, direction, end)
            least[place] |= length > TINY
            most[place] |= length > 0
    return least, most


def nasty_rays():
    """List rays along axes, edges, faces and diagonals, through corners, from faces, from outside, past the region."""
    directions = np.array([way for way in product((-1.0, 0.0, 1.0), repeat=3) if any(way)])
    origins = np.array([[0.0, 0.0, 0.0], [0.25, 0.25, 0.25], [0.5, 0.25, 0.1], [-1.0, -0.5, -0.5], [1.0, 1.0, 0.5]])
    outside = np.array([[-4.0, -3.5, -3.0], [2.0, 0.0, 0.0], [-1.0, 3.0, 0.25], [0.25, 0.3, 2.5]])
    return tuple(np.array(each, dtype=float) for each in zip(*product([*origins, *outside], directions), strict=True))


def test_degenerate_rays_match_exact_arithmetic():
    origins, directions = nasty_rays()
    ends = np.where(np.arange(len(origins)) % 3 == 0, 0.75, np.inf)
    for ray in range(len(origins)):
        one = slice(ray, ray + 1)
        least, most = slowly(GRID, origins[one], directions[one], ends[one])
        assert (least == most).all()
        assert np.array_equal(find_crossed_voxels(GRID, origins[one], directions[one], ends[one]), least), ray


def test_random_rays_match_exact_arithmetic():
    generator = np.random.default_rng(5)
    origins = generator.uniform(-2.5, 2.5, (200, 3))
    directions = generator.normal(size=(200, 3)) * 10 ** generator.uniform(-3, 1, (200, 3))
    ends = np.where(generator.random(200) < 0.5, np.inf, generator.uniform(0, 2, 200))
    for ray in range(200):
        one = slice(ray, ray + 1)
        least, most = slowly(GRID, origins[one], directions[one], ends[one])
        result = find_crossed_voxels(GRID, origins[one], directions[one], ends[one])
        assert (least <= result).all(), ray
        assert (result <= most).all(), ray


MIDDLE = VoxelGrid(BoundingBox((-5.0, -5.0, -2.0), (5.0, 5.0, 2.0)), 0.5)


def test_nearly_parallel_rays_stay_in_the_upper_voxel():
    for tiny in (0.0, 1e-17, -1e-17, 1e-13, -1e-13):
        result = np.argwhere(find_crossed_voxels(MIDDLE, [0.0, 0.0, 0.25], [[1.0, tiny, tiny]]))
        assert result[:, 1:].tolist() == [[10, 4]] * 10
    # From far away it would leave the region on that side.
    assert find_crossed_voxels(MIDDLE, [-1e6, 0.25, 0.25], [[1.0, 1e-5, 0.0]]).sum() == 0


def test_grazing_rays_stay_within_the_region():
    grid = VoxelGrid(BoundingBox((0.0, 0.0, 0.0), (4.0, 4.0, 1.0)), 1.0)
    # Within 1e-9 of the border at the last plane, and beyond it afterwards.
    result = np.argwhere(find_crossed_voxels(grid, [0.0, 4.0 - 3.5e-9, 0.5], [[1.0, 1e-9, 0.0]]))
    assert result.tolist() == [[0, 3, 0], [1, 3, 0], [2, 3, 0], [3, 3, 0]]


def some_rays(count=300):
    generator = np.random.default_rng(8)
    return generator.uniform(-4, 4, (count, 3)), generator.normal(size=(count, 3)), generator.uniform(0, 9, count)


def test_order_and_length_of_rays_do_not_matter(monkeypatch):
    origins, directions, ends = some_rays()
    whole = find_crossed_voxels(MIDDLE, origins, directions, ends)
    order = np.random.default_rng(1).permutation(len(origins))
    assert np.array_equal(whole, find_crossed_voxels(MIDDLE, origins[order], directions[order], ends[order]))
    assert np.array_equal(whole, find_crossed_voxels(MIDDLE, origins, directions * 4, ends / 4))
    parts = find_crossed_voxels(MIDDLE, origins[:100], directions[:100], ends[:100])
    assert parts is find_crossed_voxels(MIDDLE, origins[100:], directions[100:], ends[100:], output=parts)
    assert np.array_equal(whole, parts)
    monkeypatch.setattr("torchcover.contrib.voxels.RAYS_PER_CHUNK", 7)
    assert np.array_equal(whole, find_crossed_voxels(MIDDLE, origins, directions, ends))


def test_directions_of_nan_are_no_rays():
    some = np.array([[1.0, 0.0, 0.0], [np.nan, np.nan, np.nan], [0.0, 1.0, 0.0]])
    expected = find_crossed_voxels(MIDDLE, np.zeros(3), some[[0, 2]], [3.0, 2.0])
    assert np.array_equal(find_crossed_voxels(MIDDLE, np.zeros(3), some, [3.0, 1.0, 2.0]), expected)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (([0, 0], [[1, 0, 0]], 1), r"origins_m: shape \(3,\) or \(1, 3\) is needed; got \(2,\)"),
        (([0, 0, np.nan], [[1, 0, 0]], 1), "origins_m: finite"),
        (([0, 0, 0], [1, 0, 0], 1), r"directions: shape \(N, 3\) is needed; got \(3,\)"),
        (([0, 0, 0], [[0, 0, 0]], 1), "directions: finite vectors that are not 0"),
        (([0, 0, 0], [[np.inf, 0, 0]], 1), "directions: finite vectors that are not 0"),
        (([0, 0, 0], [[1, 0, 0]], [1, 2]), r"ends: one number or shape \(1,\)"),
        (([0, 0, 0], [[1, 0, 0]], -1), "ends: lengths >= 0"),
        (([0, 0, 0], [[1, 0, 0]], np.nan), "ends: lengths >= 0"),
    ],
)
def test_rays_that_are_none_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        find_crossed_voxels(MIDDLE, *given)


def test_output_arrays_of_other_grids_are_refused():
    with pytest.raises(ValueError, match=r"crossed: a contiguous bool array of shape \(20, 20, 8\)"):
        find_crossed_voxels(MIDDLE, [0, 0, 0], [[1, 0, 0]], output=np.zeros((20, 20, 9), dtype=bool))


@pytest.mark.parametrize(
    ("voxel_m", "message"),
    [
        (0.3, r"extent along x of 10 m is not a multiple of the voxel of 0.3 m \(33.33333333 voxels\); one of 0.30"),
        (21.0, r"extent along x of 10 m is not a multiple of the voxel of 21 m"),
        (0.0, "voxel_m: a positive length"),
        (np.nan, "voxel_m: a positive length"),
    ],
)
def test_voxels_that_do_not_divide_are_refused(voxel_m, message):
    with pytest.raises(ValueError, match=message):
        VoxelGrid(MIDDLE.region, voxel_m)


def test_centers_lie_in_half_open_voxels():
    x, y, z = GRID.compute_centers_m()
    centres = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    assert GRID.find_voxels(centres).tolist() == list(range(GRID.num_voxels))
    assert GRID.find_voxels([GRID.region.lower_m, GRID.region.upper_m]).tolist() == [0, -1]
    assert GRID.find_voxels(np.full((1, 3), np.nan)).tolist() == [-1]
