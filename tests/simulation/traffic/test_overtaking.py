"""Lane changes: decisions, permitted places and safety."""

import numpy as np
import pytest

from torchcover.simulation.traffic.flow import Agent
from torchcover.simulation.traffic.idm import Driver
from torchcover.simulation.traffic.motorway import MOTORWAY, AuxiliaryLane
from torchcover.simulation.traffic.overtaking import LANES, SIDE_LANE, LaneChange, LaneChangeSimulation

TIMES_S = np.arange(0.0, 60.0, 0.1)
CAR, SLOW = Driver(33.0), Driver(23.0)
FAR_M = np.array([[1e5, 2e5], [1e5, 2e5]])
NEAR_M = np.array([[1500.0, 2000.0], [1500.0, 2000.0]])


LEVEL = np.array([[0.0, 1.0], [0.0, 0.0]])


def simulate(*agents, heavy=(), exits=(), side_m=FAR_M, times_s=TIMES_S, kind="car", slope=0.0):
    """Simulate agents (lane, position, driver); return the simulation, its history and the lanes (T, N)."""
    made = [Agent(kind, 5.0, lane, place, driver) for lane, place, driver in agents]
    marked = [np.isin(np.arange(len(made)), which) for which in (heavy, exits)]
    traffic = LaneChangeSimulation(made, *marked, side_m, np.random.default_rng(0), LEVEL + np.array([[0.0], [slope]]))
    flow = traffic.run(times_s, 0.0)
    lanes = np.tile([agent.lane_index for agent in made], (len(times_s), 1))
    for change in traffic.lane_changes:
        lanes[flow.lane_positions_m[:, change.agent_index] > change.start_m, change.agent_index] = change.new_lane_index
    return traffic, flow, lanes


def test_faster_vehicles_overtake_on_the_left():
    traffic, flow, lanes = simulate((2, 0.0, CAR), (2, 150.0, SLOW))
    assert [(change.agent_index, change.old_lane_index, change.new_lane_index) for change in traffic.lane_changes] == [
        (0, 2, 1),
        (0, 1, 2),
    ]
    assert flow.lane_positions_m[-1, 0] > flow.lane_positions_m[-1, 1] + 50.0
    # It hardly slows down; without a lane change it would have followed.
    assert flow.speeds_mps[100:, 0].min() > 28.0
    passing = np.abs(flow.lane_positions_m[:, 0] - flow.lane_positions_m[:, 1]) < 5.0
    assert (lanes[passing, 0] == 1).all()


def test_overtaking_vehicles_return_with_a_minimum_headway():
    pairs = [(2, 3000.0 * pair + 3.0 * pair * slow + 100.0 * slow, SLOW if slow else CAR)
             for pair in range(16) for slow in (0, 1)]  # fmt: skip
    traffic, flow, _ = simulate(*pairs)
    back = [change for change in traffic.lane_changes if change.new_lane_index == 2 and change.agent_index % 2 == 0]
    assert len(back) > 8
    for change in back:
        at, slow = (
            int(np.argmax(flow.lane_positions_m[:, change.agent_index] >= change.start_m)),
            change.agent_index + 1,
        )
        gap_m = flow.lane_positions_m[at, change.agent_index] - flow.lane_positions_m[at, slow] - 5.0
        assert gap_m > 0.6 * flow.speeds_mps[at, slow] - 0.1


def test_agents_keep_right_without_a_gain():
    traffic, _, _ = simulate((0, 0.0, CAR), (2, 400.0, Driver(34.5)))
    assert [(change.old_lane_index, change.new_lane_index) for change in traffic.lane_changes] == [(0, 1), (1, 2)]


def test_agents_do_not_pass_on_the_right():
    # The second agent decides first, while the one ahead is still in its lane; the right lane is free.
    drives = [
        simulate((1, 60.0, ahead), (1, 0.0, CAR), heavy=[1], times_s=TIMES_S[:15])[0] for ahead in (SLOW, Driver(40.0))
    ]
    assert [[change[:3] for change in traffic.lane_changes] for traffic in drives] == [[], [(1, 1, 2)]]


def test_lane_changes_force_no_hard_braking():
    # The change waits for a fast vehicle from behind.
    traffic, flow, _ = simulate((2, 100.0, CAR), (2, 160.0, SLOW), (1, 40.0, Driver(40.0)))
    (first, *_) = [change for change in traffic.lane_changes if change.agent_index == 0]
    at = int(np.argmax(flow.lane_positions_m[:, 0] > first.start_m))
    assert flow.lane_positions_m[at, 2] > flow.lane_positions_m[at, 0]
    assert np.diff(flow.speeds_mps[:, 2]).min() / 0.1 > -2.1


@pytest.mark.parametrize(("lane", "slope"), [(2, 0.04), (6, -0.04), (2, 0.03)])
def test_engine_power_limits_trucks_on_grades(lane, slope):
    limit = Driver(23.6, 1.6, 3.0, 0.6)
    _, flow, _ = simulate((lane, 0.0, limit), kind="truck", slope=slope, times_s=np.arange(0.0, 400.0, 0.5))
    speed = flow.speeds_mps[-1, 0]
    assert 9.81 * (abs(slope) + 0.006) * speed + 9e-5 * speed**3 == pytest.approx(1000 / 120, rel=0.01)
    assert 15.0 < speed < 22.0
    # Downhill and on the level, it keeps its desired speed.
    for kind, down in (("truck", -slope), ("truck", 0.0), ("car", slope)):
        _, flow, _ = simulate((lane, 0.0, limit), kind=kind, slope=down, times_s=np.arange(0.0, 200.0, 0.5))
        assert flow.speeds_mps[100:, 0].min() > 22.0
        assert flow.speeds_mps.max() < 1.03 * 23.6


def test_trucks_keep_off_the_median_lane():
    agents = [(1, 0.0, CAR), (1, 150.0, SLOW), (2, 150.0, SLOW)]
    assert any(change[:3] == (0, 1, 0) for change in simulate(*agents)[0].lane_changes)
    assert not any(change[:3] == (0, 1, 0) for change in simulate(*agents, heavy=[0])[0].lane_changes)


@pytest.mark.parametrize("direction", [0, LANES])
def test_agents_enter_and_exit_on_auxiliary_lanes(direction):
    agents = [(SIDE_LANE, 1300.0, CAR), (2, 1000.0, CAR), (2, 900.0, CAR)]
    agents = [(lane + direction, place, driver) for lane, place, driver in agents]
    traffic, flow, lanes = simulate(*agents, exits=[1], side_m=NEAR_M)
    assert (lanes[-1] - direction).tolist() == [2, SIDE_LANE, 2]
    for change in traffic.lane_changes:
        if SIDE_LANE in (change.old_lane_index - direction, change.new_lane_index - direction):
            assert 1500.0 < change.start_m < change.start_m + change.length_m < 2100.0
    # Vehicles are slow on ramps and slow down before.
    assert flow.speeds_mps[flow.lane_positions_m[:, 0] < 1490.0, 0].max() < 22.5
    assert flow.speeds_mps[flow.lane_positions_m[:, 1] > 2100.0, 1].max() < 23.5
    assert np.diff(flow.speeds_mps[:, 1]).min() / 0.1 > -2.5


def test_agents_without_a_gap_stay_on_ramps():
    queue = [(2, 1200.0 + 12.0 * number, Driver(20.0)) for number in range(40)]
    _, _, lanes = simulate((SIDE_LANE, 1400.0, CAR), *queue, side_m=NEAR_M, heavy=range(41), times_s=TIMES_S[:300])
    assert lanes[-1, 0] == SIDE_LANE


def test_agents_never_touch_in_dense_traffic():
    generator = np.random.default_rng(3)
    agents = [
        (lane, 55.0 * number + generator.uniform(0.0, 30.0), Driver(generator.uniform(18.0, 40.0)))
        for lane in range(2 * LANES)
        for number in range(25)
    ]
    exits = np.flatnonzero(np.array([agent[0] for agent in agents]) % LANES == 2)[::2]
    traffic, flow, lanes = simulate(*agents, exits=exits, side_m=NEAR_M - 500.0, times_s=TIMES_S[:400:2])
    assert len(traffic.lane_changes) > 60
    in_lane = lanes[:, :, None] == lanes[:, None]
    for change in traffic.lane_changes:
        # During most of the change, the agent also occupies its old lane.
        place_m = flow.lane_positions_m[:, change.agent_index]
        both = (place_m >= change.start_m) & (place_m < change.start_m + 0.6 * change.length_m)
        there = lanes == change.old_lane_index
        in_lane[:, change.agent_index] |= both[:, None] & there
    apart = np.abs(flow.lane_positions_m[:, :, None] - flow.lane_positions_m[:, None])
    np.einsum("tii->ti", apart)[...] = np.inf
    assert apart[in_lane].min() > 5.0


def test_lane_change_is_smooth_and_its_slope_exact():
    change = LaneChange(0, 2, 1, 100.0, 150.0)
    place_m = np.linspace(50.0, 300.0, 2501)
    done, per_m = change.compute_progress(place_m)
    assert done[0] == 0.0
    assert done[-1] == 1.0
    np.testing.assert_allclose(np.gradient(done, place_m), per_m, atol=1e-5)
    # At 30 m/s over 5 s, the lateral acceleration for a lane width stays below 1 m/s2.
    assert np.abs(np.gradient(per_m, place_m)).max() * 3.6 * 30.0**2 < 1.0


def test_ramps_bend_gently_and_objects_keep_off():
    lane = AuxiliaryLane(1000.0, 1500.0)
    stations = np.arange(0.0, 2500.0, 0.5)
    away_m, slope = lane.compute_offsets_m(stations)
    assert (away_m[(stations >= 1000.0) & (stations <= 1500.0)] == 0.0).all()
    np.testing.assert_allclose(np.gradient(away_m, stations), slope, atol=3e-4)
    assert np.abs(np.gradient(slope, stations)).max() <= 1 / 500.0 + 1e-9
    ramp_m = MOTORWAY.lane_centers_m[SIDE_LANE] + away_m
    for left_m, wide_m in ((16.8, 0.5), (19.5, 0.5), (30.0, 3.5)):
        kept_m = lane.find_clear_offsets_m(stations, left_m, wide_m)
        assert (np.abs(kept_m - ramp_m) > 1.8 + wide_m).all()
        assert (kept_m >= left_m).all()
