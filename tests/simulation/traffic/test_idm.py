"""The Intelligent Driver Model against its closed forms."""

import numpy as np
import pytest

from torchcover.simulation.traffic.idm import (
    AccelerationLimits,
    Driver,
    compute_acceleration_mps2,
    compute_gap_ratio,
    integrate_motion,
)

DRIVER = Driver(desired_speed_mps=30.0, headway_s=1.5, standstill_gap_m=2.0, acceleration_mps2=1.4)
STEP_S = 0.05


def compute_acceleration(driver, speed, gap, closing):
    return compute_acceleration_mps2(
        driver, speed, compute_gap_ratio(driver, speed, gap, closing), driver.desired_speed_mps
    )


def compute_equilibrium_gap_m(speed):
    """Compute the gap at which a driver keeps its speed behind a leader of constant speed."""
    return (2.0 + 1.5 * speed) / np.sqrt(1 - (speed / 30.0) ** 4)


def simulate_following(driver, speed, leader_place, leader_speed, duration, step=STEP_S):
    """Simulate following a leader of constant speed; return gaps (T,) and speeds (T,)."""
    place, speed, gaps, speeds = np.zeros(1), np.array([float(speed)]), [], []
    for index in range(round(duration / step)):
        gap = leader_place + leader_speed * index * step - place
        way, speed = integrate_motion(speed, compute_acceleration(driver, speed, gap, speed - leader_speed), gap, step)
        place = place + way
        gaps.append(float(leader_place + leader_speed * (index + 1) * step - place[0]))
        speeds.append(float(speed[0]))
    return np.array(gaps), np.array(speeds)


@pytest.mark.parametrize("speed", [0.0, 5.0, 15.0, 29.0])
def test_acceleration_is_zero_at_equilibrium_gap(speed):
    gap = compute_equilibrium_gap_m(speed)
    assert compute_acceleration(DRIVER, np.array([speed]), np.array([gap]), np.zeros(1)) == pytest.approx(
        0.0, abs=1e-12
    )


def test_free_acceleration_matches_the_integral():
    # dv/dt = a (1 - (v/v0)^4) integrates to t = v0/(2a) (artanh(v/v0) + arctan(v/v0)).
    _, speeds = simulate_following(DRIVER, 0.0, leader_place=np.inf, leader_speed=0.0, duration=40.0)
    share = speeds / 30.0
    expected_time = 30.0 / 1.4 / 2 * (np.arctanh(share) + np.arctan(share))
    np.testing.assert_allclose(expected_time[:-1], STEP_S * np.arange(1, len(speeds)), rtol=0.01)
    assert (np.diff(speeds) > 0).all()


@pytest.mark.parametrize("step", [0.01, 0.1, 0.5])
def test_driver_stops_at_the_standstill_gap(step):
    gaps, speeds = simulate_following(DRIVER, 25.0, leader_place=300.0, leader_speed=0.0, duration=120.0, step=step)
    assert speeds[-1] < 0.05
    assert 1.5 < gaps[-1] < 2.3
    assert gaps.min() > 1.5
    assert (np.diff(gaps) <= 0).all()


def test_braking_is_about_the_comfortable_deceleration():
    _, speeds = simulate_following(DRIVER, 25.0, leader_place=300.0, leader_speed=0.0, duration=120.0)
    assert np.diff(speeds).min() / STEP_S == pytest.approx(-2.0, abs=0.35)


def test_braking_is_bounded_and_finite_at_contact():
    wanted = compute_acceleration(DRIVER, np.array([20.0, 20.0]), np.array([0.0, -1.0]), np.array([20.0, 20.0]))
    np.testing.assert_array_equal(wanted, -AccelerationLimits().max_braking_mps2)


def test_steps_never_go_backwards_or_through_leaders():
    generator = np.random.default_rng(0)
    speed, room = generator.uniform(0, 40, 10_000), generator.uniform(-1, 60, 10_000)
    room[::7] = 0.0
    for step in (0.01, 0.1, 1.0, 10.0):
        way, after = integrate_motion(speed, generator.uniform(-9, 3, 10_000), room, step)
        assert (way >= 0).all()
        assert (way <= np.maximum(room, 0)).all()
        assert (after >= 0).all()


def test_steps_are_uniform_acceleration_until_standstill():
    infinite = np.full(3, np.inf)
    way, after = integrate_motion(np.array([10.0, 10.0, 1.0]), np.array([2.0, -2.0, -4.0]), infinite, 0.5)
    np.testing.assert_allclose(way, [10 * 0.5 + 0.25, 10 * 0.5 - 0.25, 1.0 / 8.0])
    np.testing.assert_allclose(after, [11.0, 9.0, 0.0])


@pytest.mark.parametrize("speed", [0.0, -1.0, np.nan, np.array([3.0, 0.0])])
def test_drivers_need_a_positive_desired_speed(speed):
    with pytest.raises(ValueError, match="desired speed above 0"):
        Driver(speed)
