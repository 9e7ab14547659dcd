import numpy as np
import pytest

from torchcover.geometry import BoundingBox, find_overlaps
from torchcover.targets.placing import build_poses


def test_a_box_around_points_touches_them():
    box = BoundingBox.from_points(np.array([[1.0, -2.0, 0.5], [-1.0, 3.0, 0.0], [0.0, 0.0, 2.0]], dtype=np.float32))
    assert box == BoundingBox((-1.0, -2.0, 0.0), (1.0, 3.0, 2.0))
    assert box.size_m == (2.0, 5.0, 2.0)
    assert all(type(bound) is float for bound in (*box.lower_m, *box.upper_m))


def test_outlines_are_counterclockwise_in_bird_eye_view():
    outline_m = BoundingBox((-1.0, -2.0, 0.5), (3.0, 4.0, 9.0)).outline_m
    np.testing.assert_array_equal(outline_m, [[-1, -2], [3, -2], [3, 4], [-1, 4]])
    x, y = outline_m.T
    assert (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2 == 4 * 6  # the signed area is positive


@pytest.mark.parametrize(
    ("lower", "upper"), [((0, 0, 0), (1, 1, 0)), ((0, 2, 0), (1, 1, 1)), ((0, 0, float("nan")), (1, 1, 1))]
)
def test_a_box_without_inside_is_refused(lower, upper):
    with pytest.raises(ValueError, match="lower < upper on every axis; got"):
        BoundingBox(lower, upper)


@pytest.mark.parametrize(("lower", "upper"), [((0, 0), (1, 1)), ((0, 0, 0), (1, 1)), ((0,) * 4, (1,) * 4)])
def test_boxes_need_three_dimensions(lower, upper):
    with pytest.raises(ValueError, match="three numbers for each corner"):
        BoundingBox(lower, upper)


def test_touching_boxes_do_not_overlap():
    car = BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5))
    there = build_poses(
        np.array([[4.0, 0.0], [3.99, 0.0], [0.0, -2.0], [2.9, 1.9], [2.9, 1.9]]), np.deg2rad([0, 0, 0, 0, 45])
    )
    assert find_overlaps(car, there, car.corners_m).tolist() == [False, True, False, True, True]
    above = np.eye(4)[None].copy()
    above[:, 2, 3] = 1.5
    assert not find_overlaps(car, above, car.corners_m).any()
    away = build_poses(np.array([[3.6, 2.4]]), np.deg2rad([135]))  # their projections onto x and y overlap
    assert not find_overlaps(car, away, car.corners_m).any()
