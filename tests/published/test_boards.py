"""LOB: values that were worked out before, by hand, and what is left out."""

import numpy as np
import pytest

from torchcover.published import Lob
from torchcover.simulation import Lidar, Pose

from .voxel_frames import beam, boxes, frame, place3d


def values(sensors, **options):
    metric = Lob(sensors, **options)
    metric.update(frame(0, boxes()))
    return {number.name: number for number in metric.compute()}


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("center", [0.7962, 0.3981, 0.2389, 0.1392, 0.0637]),
        ("line", [0.9083, 0.3143, 0.1295, 0.0489, 0.0482]),
    ],
)
def test_the_published_rigs_have_the_shares_that_were_worked_out_before(name, expected):
    found = values(place3d(name))
    assert list(found) == ["lob_10m", "lob_20m", "lob_30m", "lob_40m", "lob_50m"]
    assert [round(number.value, 4) for number in found.values()] == expected
    assert found["lob_10m"].count == 314 * 10


def test_the_distance_decides_which_rig_is_better():
    center, line = (values(place3d(name)) for name in ("center", "line"))
    assert center["lob_10m"].value < line["lob_10m"].value
    assert center["lob_30m"].value > line["lob_30m"].value


def test_level_rays_hit_a_cell_each_and_the_same_ray_no_other():
    around = beam(columns=16, z_m=1.1)
    (number,) = values([around], distances_m=(10.0,)).values()
    assert number.value == pytest.approx(16 / 3140)
    again = around.model_copy(update={"name": "again"})
    assert values([around, again], distances_m=(10.0,))["lob_10m"].value == number.value
    assert not values([beam(columns=16, z_m=2.1)], distances_m=(10.0,))["lob_10m"].value
    assert not values([beam(columns=16, z_m=1.1, range_m=9.0)], distances_m=(10.0,))["lob_10m"].value


def test_the_bottom_is_in_the_board_and_the_top_is_not():
    for z_m, hit in ((0.0, 1), (2.0, 0)):
        assert Lob([beam(z_m=z_m)]).cells_hit(10.0).sum() == hit


def test_a_sensor_beside_the_middle_hits_the_cylinder_where_it_is():
    # Ahead from y = 6 m, the cylinder of 10 m is met at x = 8 m.
    hit = Lob([beam(y_m=6.0, z_m=1.1)], distances_m=(10.0,)).cells_hit(10.0)
    ((row, column),) = np.argwhere(hit)
    assert row == 5
    assert column == int((np.arctan2(6.0, 8.0) / (2 * np.pi) + 0.5) * 314)
    assert not Lob([beam(y_m=6.0, z_m=1.1, range_m=7.9)], distances_m=(10.0,)).cells_hit(10.0).any()


def test_a_flat_board_is_hit_ahead_only():
    fan = Lidar(
        name="fan",
        mount=Pose(z_m=1.1),
        elevations_deg=(0.0,),
        horizontal_fov_deg=360.0,
        columns=360,
        max_range_m=100.0,
    )
    found = values([fan], distances_m=(10.0,), width_m=4.0)
    # Cells are 1.15 degrees wide in the middle, the rays a degree: none is missed in the one row.
    assert found["lob_ahead_4m_10m"].value == pytest.approx(1 / 10)
    assert found["lob_ahead_4m_10m"].count == 20 * 10


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sensors": ()}, "sensors: .* got none"),
        ({"distances_m": ()}, "distances_m: one or more positive"),
        ({"distances_m": (-1.0,)}, "distances_m: one or more positive"),
        ({"cell_m": 0.0}, "cell_m: a positive length"),
        ({"cell_m": 0.3}, "height_m: 2 m is not a multiple of the cell of 0.3 m"),
        ({"height_m": (2.0, 0.0)}, "height_m: a lower and a higher bound"),
        ({"width_m": 0.3}, "width_m: 0.3 m is not a multiple"),
        ({"sensors": [beam(x_m=12.0)]}, "sensor 'beam' is 12 m away, behind the board at 10 m"),
        ({"sensors": [beam(x_m=12.0)], "width_m": 4.0}, "sensor 'beam' is 12 m away, behind the board at 10 m"),
    ],
)
def test_boards_that_cannot_be_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Lob(**{"sensors": [beam()], **options})
