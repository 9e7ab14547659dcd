"""Tilt of the ego vehicle."""

import numpy as np
import pytest

from torchcover.simulation.traffic.assemble import compute_attitude_deg

TIMES_S = np.arange(0.0, 20.0, 0.1)


def simulate_tilt(speed, yaw_deg=None, seed=0):
    way = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * 0.1)])
    yaw = np.zeros_like(speed) if yaw_deg is None else yaw_deg
    return compute_attitude_deg(TIMES_S, way, speed, yaw, np.random.default_rng(seed))


def compute_mean_change(angles, base, axis, when):
    return (angles - base)[when, axis].mean()


def test_braking_lowers_the_nose():
    speed = np.interp(TIMES_S, [0, 5, 10, 15, 20], [0, 15, 15, 0, 0])
    way = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * 0.1)])
    road = compute_attitude_deg(TIMES_S, way, np.full_like(speed, 1.0), np.zeros_like(speed), np.random.default_rng(0))
    angles = simulate_tilt(speed)
    assert compute_mean_change(angles, road, 1, (TIMES_S > 2) & (TIMES_S < 4.5)) == pytest.approx(-0.9, abs=0.2)
    assert compute_mean_change(angles, road, 1, (TIMES_S > 12) & (TIMES_S < 14.5)) == pytest.approx(0.9, abs=0.2)
    assert abs(compute_mean_change(angles, road, 1, (TIMES_S > 7) & (TIMES_S < 9.5))) < 0.01
    np.testing.assert_array_equal(angles[:, 2], road[:, 2])


def test_right_side_goes_down_in_left_curves():
    speed = np.full_like(TIMES_S, 10.0)
    straight, left = simulate_tilt(speed), simulate_tilt(speed, yaw_deg=np.rad2deg(0.2) * TIMES_S)
    np.testing.assert_array_equal(left[:, 1], straight[:, 1])
    assert compute_mean_change(left, straight, 2, TIMES_S > 3) == pytest.approx(0.4 * 10 * 0.2, rel=0.2)
    right = simulate_tilt(speed, yaw_deg=-np.rad2deg(0.2) * TIMES_S)
    np.testing.assert_allclose(right[:, 2] - straight[:, 2], straight[:, 2] - left[:, 2])


def test_wrapped_headings_cause_no_roll():
    speed, yaw = np.full_like(TIMES_S, 10.0), 5.0 * TIMES_S + 170.0
    wrapped = (yaw + 180.0) % 360.0 - 180.0
    np.testing.assert_allclose(simulate_tilt(speed, yaw)[:, 1:], simulate_tilt(speed, wrapped)[:, 1:], atol=1e-9)


def test_standing_cars_do_not_rock():
    angles = simulate_tilt(np.zeros_like(TIMES_S))
    assert np.ptp(angles, axis=0).max() == 0.0


@pytest.mark.parametrize("seed", range(5))
def test_tilts_are_bounded(seed):
    wild = np.random.default_rng(seed)
    speed = np.abs(np.cumsum(wild.uniform(-2, 2, len(TIMES_S))))
    angles = simulate_tilt(speed, np.cumsum(wild.uniform(-30, 30, len(TIMES_S))), seed)
    assert np.abs(angles[:, 1]).max() < 2.0
    assert np.abs(angles[:, 2]).max() < 1.5
