"""Pedestrians that walk to and fro."""

import numpy as np
import pytest

from torchcover.simulation.traffic.walking import Footpath, compute_step_height_m, is_free_for, simulate_walking

TIMES_S = np.arange(0.0, 120.0, 0.1)
PATH = Footpath(np.array([3.0, -8.0]), np.array([3.0, 8.0]), curb_distance_m=0.5)


@pytest.mark.parametrize("seed", range(10))
def test_pedestrians_start_only_when_allowed_and_finish(seed):
    may_go = (TIMES_S % 40.0 > 20.0) & (TIMES_S % 40.0 < 24.0)
    position, yaw = simulate_walking(PATH, may_go, 12.0, TIMES_S, 0.2, np.random.default_rng(seed))
    y = position[:, 1]
    moving = np.abs(np.diff(y)) > 1e-9
    starts = np.flatnonzero(moving & ~np.concatenate([[False], moving[:-1]]))
    assert may_go[starts].all()
    for start in starts[TIMES_S[starts] < 100.0]:
        np.testing.assert_allclose(np.abs(y[[start, start + 120]]), 8.0)
        assert y[start] * y[start + 120] < 0
    # Pedestrians face the direction in which they walk.
    np.testing.assert_allclose(np.sin(np.deg2rad(yaw[:-1][moving])), np.sign(np.diff(y))[moving], atol=1e-9)
    assert (position[:, 0] == 3.0).all()


def test_pedestrians_cross():
    walks = [
        simulate_walking(PATH, np.ones(1200, bool), 12.0, TIMES_S, 0.2, np.random.default_rng(s))[0] for s in range(10)
    ]
    assert all(np.ptp(position[:, 1]) == pytest.approx(16.0) for position in walks)


def test_feet_stay_up_until_past_the_curb():
    beyond = np.array([-3.0, 0.0, 0.29, 0.3, 0.375, 0.45, 5.0])
    np.testing.assert_allclose(
        compute_step_height_m(beyond, 0.3), [0.15, 0.15, 0.15, 0.15, 0.075, 0.0, 0.0], atol=1e-12
    )


def test_is_free_for_checks_following_frames():
    blocked = np.zeros(20, dtype=bool)
    blocked[10] = True
    expected = np.ones(20, dtype=bool)
    expected[7:11] = False
    np.testing.assert_array_equal(is_free_for(blocked, 0.3, 0.1), expected)
