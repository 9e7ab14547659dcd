"""Contact time of two outlines in straight motion."""

import numpy as np
import pytest
import shapely

from torchcover.geometry import BoundingBox, compute_contact_time_s, transform_outline
from torchcover.targets.placing import build_poses


def by_differences(a_m, b_m, velocity_mps):
    """Compute the contact slowly: where the path of b enters the hull of all corner differences."""
    hull = shapely.MultiPoint((a_m[:, None] - b_m[None]).reshape(-1, 2)).convex_hull
    way = shapely.LineString([(0.0, 0.0), 1e4 * velocity_mps])
    inside = way.intersection(hull)
    return np.inf if inside.length == 0 else shapely.Point(0, 0).distance(inside) / np.linalg.norm(velocity_mps)


@pytest.fixture(scope="module")
def pairs():
    generator = np.random.default_rng(3)
    count = 300
    a_m, b_m = (
        transform_outline(BoundingBox((-length, -width, 0.0), (length, width, 1.0)).outline_m,
                    build_poses(generator.uniform(-far_m, far_m, (count, 2)), generator.uniform(-4, 4, count)))
        for length, width, far_m in ((2.0, 1.0, 1.0), (0.4, 0.3, 20.0))
    )  # fmt: skip
    towards_m = a_m.mean(axis=1) - b_m.mean(axis=1) + generator.normal(0.0, 2.0, (count, 2))
    return a_m, b_m, towards_m / generator.uniform(0.5, 5.0, (count, 1))


def test_contact_time_equals_the_minkowski_difference(pairs):
    expected_s = np.array([by_differences(*pair) for pair in zip(*pairs, strict=True)])
    found_s = compute_contact_time_s(*pairs)
    assert found_s == pytest.approx(expected_s, abs=1e-9)
    assert 0.2 < np.isfinite(found_s).mean() < 0.95
    a_m, b_m, velocity_mps = pairs
    assert compute_contact_time_s(b_m, a_m, -velocity_mps) == pytest.approx(found_s, abs=1e-9)
    utm_m = np.array([5e5, 4e6])
    assert compute_contact_time_s(a_m + utm_m, b_m + utm_m, velocity_mps) == pytest.approx(found_s, abs=1e-7)


def test_at_contact_they_are_as_near_as_rounding(pairs):
    a_m, b_m, velocity_mps = pairs
    found_s = compute_contact_time_s(a_m, b_m, velocity_mps)
    for k in np.flatnonzero(np.isfinite(found_s)).tolist():
        there = shapely.Polygon(b_m[k] + found_s[k] * velocity_mps[k])
        assert shapely.Polygon(a_m[k]).distance(there) < 1e-9
        before = shapely.Polygon(b_m[k] + max(found_s[k] - 1e-3, 0.0) * velocity_mps[k])
        assert found_s[k] == 0 or shapely.Polygon(a_m[k]).distance(before) > 0


SQUARE_M = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


@pytest.mark.parametrize(
    ("offset_m", "velocity_mps", "expected_s"),
    [
        ([5, 0], [-1e-9, 0], 3e9),
        ([5, 0], [0, 0], np.inf),
        ([0.5, 0.5], [0, 0], 0),
        ([2, 0], [0, 3], np.inf),  # a side slides along a side
        ([2, 0], [-1, 0], 0),
        ([2, 0], [1, 0], np.inf),
        ([2, 5], [0, -1], np.inf),
        ([4, 8], [-1, -1], np.inf),  # a corner passes a corner
        ([2 - 1e-9, 5], [0, -1], 3),
        ([5, 0], [-3e8, 1e-300], 1e-8),
    ],
)  # fmt: skip
def test_squares_that_touch_slide_or_hardly_move(offset_m, velocity_mps, expected_s):
    found_s = compute_contact_time_s(SQUARE_M, SQUARE_M + offset_m, np.array(velocity_mps, dtype=float))
    assert found_s == pytest.approx(expected_s, rel=1e-6)


def test_contact_time_is_exact_at_large_coordinates():
    tilted_m, away_m, velocity_mps = (
        np.array([[5, 1], [-1, 5], [-5, -1], [1, -5]]) / 4,
        [8.0, 4.0],
        np.array([-1, -0.5]),
    )
    far_m = tilted_m + np.array([2.0**50, -(2.0**50)])  # where adjacent numbers differ by 0.25 m
    assert compute_contact_time_s(far_m, far_m + away_m, velocity_mps) == compute_contact_time_s(
        tilted_m, tilted_m + away_m, velocity_mps
    )
