import numpy as np
import pytest

from torchcover.geometry import BoundingBox


def test_a_box_around_points_touches_them():
    box = BoundingBox.around(np.array([[1.0, -2.0, 0.5], [-1.0, 3.0, 0.0], [0.0, 0.0, 2.0]], dtype=np.float32))
    assert box == BoundingBox((-1.0, -2.0, 0.0), (1.0, 3.0, 2.0))
    assert box.size_m == (2.0, 5.0, 2.0)
    assert all(type(bound) is float for bound in (*box.lower_m, *box.upper_m))


@pytest.mark.parametrize(
    ("lower", "upper"), [((0, 0, 0), (1, 1, 0)), ((0, 2, 0), (1, 1, 1)), ((0, 0, float("nan")), (1, 1, 1))]
)
def test_a_box_without_inside_is_refused(lower, upper):
    with pytest.raises(ValueError, match="lower < upper on every axis; got"):
        BoundingBox(lower, upper)


@pytest.mark.parametrize(("lower", "upper"), [((0, 0), (1, 1)), ((0, 0, 0), (1, 1)), ((0,) * 4, (1,) * 4)])
def test_a_box_in_other_than_three_dimensions_is_refused(lower, upper):
    with pytest.raises(ValueError, match="three numbers for each corner"):
        BoundingBox(lower, upper)
