"""Ray directions of the LiDAR and of the paper reference."""

import numpy as np
import pytest

from torchcover.geometry import BoundingBox
from torchcover.simulation import Lidar, PaperReference

EGO = BoundingBox((-2.45, -0.97, 0.0), (2.45, 0.97, 1.63))


def lidar(**changes):
    content = {
        "name": "l",
        "channels": 5,
        "vertical_fov_deg": (-20, 10),
        "horizontal_fov_deg": 90,
        "columns": 6,
        "max_range_m": 9,
    }
    return Lidar(**{**content, **changes})


def compute_angles(directions):
    x, y, z = directions.reshape(3, -1)
    return np.rad2deg(np.arcsin(z)), np.rad2deg(np.arctan2(y, x))


def test_rows_span_the_fov_and_columns_equal_sectors():
    elevation, azimuth = compute_angles(lidar().compute_directions())
    np.testing.assert_allclose(elevation.reshape(5, 6)[:, 0], [-20, -12.5, -5, 2.5, 10], atol=1e-12)
    np.testing.assert_allclose(azimuth.reshape(5, 6)[2], [-37.5, -22.5, -7.5, 7.5, 22.5, 37.5], atol=1e-12)


def test_a_full_turn_has_no_ray_twice():
    _, azimuth = compute_angles(
        lidar(horizontal_fov_deg=360, columns=8, channels=1, vertical_fov_deg=(0, 0)).compute_directions()
    )
    np.testing.assert_allclose(np.diff(np.sort(azimuth)), 45.0, atol=1e-12)


def test_row_tables_with_offsets_are_used_unchanged():
    table = lidar(
        channels=None, vertical_fov_deg=None, elevations_deg=(5, -3, 1), azimuth_offsets_deg=(0, 2, -4), columns=1
    )
    elevation, azimuth = compute_angles(table.compute_directions())
    np.testing.assert_allclose(elevation, [5, -3, 1], atol=1e-12)
    np.testing.assert_allclose(azimuth, [0, 2, -4], atol=1e-12)


def test_paper_reference_rays_are_uniform_in_angle():
    elevation, azimuth = compute_angles(PaperReference(rows=91, columns=36).compute_directions())
    np.testing.assert_allclose(elevation.reshape(91, 36)[:, 3], np.arange(0, -91, -1), atol=1e-6)
    np.testing.assert_allclose(np.sort(azimuth.reshape(91, 36)[0] % 360), np.arange(0, 360, 10), atol=1e-12)


def test_default_reference_sensor_matches_the_paper():
    sensor = PaperReference()
    assert (sensor.rows, sensor.columns, sensor.shell_m, sensor.max_tilt_deg) == (1024, 1024, 0.5, 45.0)


def sample_poses(count):
    sensor = PaperReference(rows=1, columns=1)
    generator = np.random.default_rng(7)
    return np.stack([sensor.sample_pose(EGO, generator) for _ in range(count)])


def test_positions_are_uniform_in_the_shell():
    position = sample_poses(4000)[:, :3, 3]
    lower, upper = np.array(EGO.lower_m), np.array(EGO.upper_m)
    assert (position >= lower - [0.5, 0.5, 0]).all()
    assert (position <= upper + 0.5).all()
    inside = ((position > lower) & (position < upper)).all(axis=1)
    assert not inside.any()
    shell = np.prod(upper - lower + [1, 1, 0.5]) - np.prod(upper - lower)
    above = np.prod((upper - lower)[:2] + 1) * 0.5 / shell
    share = (position[:, 2] > upper[2]).mean()
    assert abs(share - above) < 4 * np.sqrt(above * (1 - above) / 4000)
    in_front = (upper - lower + [0, 1, 0.5])[1:].prod() * 0.5 / shell
    share = (position[:, 0] > upper[0]).mean()
    assert abs(share - in_front) < 4 * np.sqrt(in_front * (1 - in_front) / 4000)


def test_orientations_are_uniform_in_their_ranges():
    rotation = sample_poses(4000)[:, :3, :3]
    yaw = np.rad2deg(np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]))
    pitch = np.rad2deg(np.arcsin(-rotation[:, 2, 0]))
    roll = np.rad2deg(np.arctan2(rotation[:, 2, 1], rotation[:, 2, 2]))
    for angle, bound in ((yaw, 180), (pitch, 45), (roll, 45)):
        assert np.abs(angle).max() <= bound + 1e-9
        # Mean 0 and standard deviation bound / sqrt(3), to four standard errors.
        assert abs(angle.mean()) < 4 * bound / np.sqrt(3 * 4000)
        assert angle.std() == pytest.approx(bound / np.sqrt(3), rel=0.04)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rows": 0}, "needs rows and columns; got 0 x 1024"),
        ({"columns": -1}, "got 1024 x -1"),
        ({"shell_m": 0.0}, "shell_m: a positive thickness"),
        ({"shell_m": float("nan")}, "shell_m: a positive thickness"),
        ({"max_tilt_deg": 91.0}, "angle from 0 to 90"),
        ({"max_range_m": 0.0}, "max_range_m: a positive distance"),
    ],
)
def test_an_impossible_reference_sensor_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        PaperReference(**changes)
