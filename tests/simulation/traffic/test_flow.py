"""Agents on lanes: polylines, queues, signals, junctions."""

from itertools import pairwise

import numpy as np
import pytest

from torchcover.simulation.traffic.alignment import Polyline, build_rounded_rectangle
from torchcover.simulation.traffic.flow import Agent, JunctionParams, Lane, LaneSimulation
from torchcover.simulation.traffic.idm import Driver, compute_acceleration_mps2, compute_gap_ratio, integrate_motion
from torchcover.simulation.traffic.junctions import CROSS, MAIN, JunctionPassage, TrafficSignals

TIMES_S = np.arange(0.0, 60.0, 0.1)
CAR = Driver(14.0)
PARAMS = JunctionParams()
LONG = Polyline(np.array([[0.0, 0.0], [2000.0, 0.0]]))


def make_car(lane, place, driver=CAR):
    return Agent("car", 5.0, lane, place, driver)


def simulate(lanes, agents, offset=0.0, times_s=TIMES_S, **lights):
    return LaneSimulation(lanes, agents, TrafficSignals(np.array([offset]), **lights)).run(times_s)


def test_queues_keep_order_and_gaps():
    agents = [make_car(0, place, Driver(speed)) for place, speed in [(10, 20), (30, 25), (60, 5), (90, 30), (110, 9)]]
    flow = simulate([Lane(LONG)], agents)
    assert (np.diff(flow.lane_positions_m, axis=1) > 5.5).all()
    # Each agent reaches the speed of the slowest one ahead.
    np.testing.assert_allclose(flow.speeds_mps[-1], [5, 5, 5, 9, 9], rtol=0.05)


def test_committed_vehicles_clear_the_junction_before_cross_green():
    for start in np.linspace(60.0, 200.0, 71):
        lanes = [Lane(LONG, (JunctionPassage(200.0, 225.0, 0, MAIN),))]
        flow = simulate(lanes, [make_car(0, start)], green_s=(2.0, 18.0), times_s=np.arange(0.0, 12.0, 0.05))
        changes = np.arange(0.0, 12.0, 0.05) > 8.0
        on_junction = (flow.lane_positions_m[:, 0] + 2.5 > 200.0) & (flow.lane_positions_m[:, 0] - 2.5 < 225.0)
        assert not (on_junction & changes).any()
        assert np.diff(flow.speeds_mps[:, 0]).min() / 0.05 > -6.0


def test_agents_wait_for_vehicles_left_on_a_junction():
    lanes = [
        Lane(LONG, (JunctionPassage(200.0, 225.0, 0, MAIN),)),
        Lane(Polyline(np.array([[0.0, 0.0], [0.0, 2000.0]])), (JunctionPassage(200.0, 225.0, 0, CROSS),)),
    ]
    stuck = make_car(1, 210.0, Driver(0.5))
    flow = simulate(lanes, [make_car(0, 100.0), stuck], green_s=(50.0, 10.0))
    inside = flow.lane_positions_m[:, 1] - 2.5 < 225.0
    assert inside.sum() > 100
    assert (flow.lane_positions_m[inside, 0] + 2.5 <= 200.0).all()
    assert flow.occupied_phases[inside, 0, CROSS].all()
    assert flow.lane_positions_m[-1, 0] > 200.0


def test_agents_do_not_enter_blocked_junctions():
    lanes = [Lane(LONG, (JunctionPassage(200.0, 225.0, 0, MAIN),))]
    flow = simulate(
        lanes, [make_car(0, 100.0), make_car(0, 232.0, Driver(1e-3, acceleration_mps2=1e-3))], green_s=(80.0, 10.0)
    )
    assert (flow.lane_positions_m[:, 0] + 2.5 <= 200.0).all()


def test_slow_agents_need_enough_remaining_green():
    gate = JunctionPassage(20.0, 40.0, 0, MAIN, min_green_s=15.0)
    walker = Driver(1.4, 0.4, 0.5, 1.0, 1.5)
    flow = simulate([Lane(LONG, (gate,))], [make_car(0, 5.0, walker)], green_s=(20.0, 5.0))
    entered = TIMES_S[np.argmax(flow.lane_positions_m[:, 0] + 2.5 > 20.0)]
    assert 37.0 < entered < 40.0


def test_frame_interval_does_not_change_the_simulation():
    lanes = [Lane(LONG, (JunctionPassage(200.0, 225.0, 0, MAIN),))]
    agents = [make_car(0, 20.0), make_car(0, 60.0)]
    # Green ends between two of the coarse frames.
    fine = simulate(lanes, agents, times_s=np.arange(0.0, 40.5, 0.1), green_s=(9.05, 18.0))
    coarse = simulate(lanes, agents, times_s=np.arange(0.0, 40.5, 2.0), green_s=(9.05, 18.0))
    np.testing.assert_allclose(
        fine.lane_positions_m[::20][: len(coarse.lane_positions_m)], coarse.lane_positions_m, atol=1e-6
    )


def simulate_agent_by_agent(lanes, agents, lights, times_s):
    """Compute positions (T, N) agent by agent, directly from the rules."""
    place, speed = (
        [agent.lane_position_m for agent in agents],
        LaneSimulation(lanes, agents, lights).speeds_mps.tolist(),
    )
    found = [list(place)]
    for time, after in pairwise(times_s):
        left, gates, ahead = lights.compute_remaining_green_s(time), [], []
        for n, agent in enumerate(agents):
            rear = place[n] - agent.length_m / 2
            gates.append(next((gate for gate in lanes[agent.lane_index].passages if gate.exit_m >= rear), None))
            lap = (
                lanes[agent.lane_index].centerline.length_m if lanes[agent.lane_index].centerline.is_closed else np.inf
            )
            others = [(m, place[m] + (lap if place[m] < place[n] else 0.0)) for m in range(len(agents)) if m != n]
            others = [(m, at) for m, at in others if agents[m].lane_index == agent.lane_index]
            ahead.append(min(others, key=lambda other: other[1], default=(n, np.inf)))

        to_line = [
            np.inf if gate is None else gate.stop_line_m - at - agent.length_m / 2
            for gate, at, agent in zip(gates, place, agents, strict=True)
        ]
        committed = [v**2 > 2 * PARAMS.max_braking_mps2 * way for v, way in zip(speed, to_line, strict=True)]
        inside = {(gates[n].junction_index, gates[n].phase) for n in range(len(agents)) if committed[n]}
        moved = []
        for n, agent in enumerate(agents):
            (m, at), gate, driver = ahead[n], gates[n], agent.driver
            gap, line = at - place[n] - (agent.length_m + agents[m].length_m) / 2, np.inf
            if gate is not None and not committed[n]:
                back = at - agents[m].length_m / 2
                jam = gate.stop_line_m < back < gate.exit_m + agent.length_m + driver.standstill_gap_m
                jam = jam and speed[m] < PARAMS.queue_speed_share * driver.desired_speed_mps
                free = left[gate.junction_index, gate.phase] > gate.min_green_s
                if jam or not free or (gate.junction_index, 1 - gate.phase) in inside:
                    line = to_line[n]
            stop = line + driver.standstill_gap_m - PARAMS.stop_distance_m
            closing = speed[n] - speed[m] if np.isfinite(at) else 0.0
            behind, before = (
                compute_acceleration_mps2(
                    driver,
                    np.array([speed[n]]),
                    compute_gap_ratio(driver, np.array([speed[n]]), np.array([room]), np.array([approach])),
                    driver.desired_speed_mps,
                )
                for room, approach in ((gap, closing), (stop, speed[n]))
            )
            wanted, room = np.minimum(behind, before), np.array([min(gap, line)])
            way, end = integrate_motion(np.array([speed[n]]), wanted, room, after - time)
            moved.append((place[n] + float(way[0]), float(end[0])))
        place, speed = map(list, zip(*moved, strict=True))
        found.append(place)
    return np.array(found)


def test_vectorized_simulation_matches_single_agents():
    generator = np.random.default_rng(0)
    gates = [JunctionPassage(200.0, 225.0, 0, MAIN), JunctionPassage(260.0, 285.0, 1, MAIN, min_green_s=4.0)]
    crossing = Polyline(np.array([[0.0, 0.0], [0.0, 2000.0]]))
    lanes = [
        Lane(LONG, tuple(gates)),
        Lane(crossing, (JunctionPassage(200.0, 225.0, 0, CROSS),)),
        Lane(crossing, (JunctionPassage(120.0, 145.0, 1, CROSS),)),
        Lane(build_rounded_rectangle(84.0, 18.0, 6.0)),
    ]
    agents = [
        Agent("car", 5.0, lane, start + 16.0 * number, Driver(generator.uniform(3.0, 16.0)))
        for lane, start, count in ((0, 100.0, 5), (1, 110.0, 4), (2, 70.0, 3), (3, 0.0, 3))
        for number in range(count)
    ]
    lights, times_s = (
        TrafficSignals(np.array([3.0, 11.0]), green_s=(7.0, 5.0), yellow_s=2.0, all_red_s=1.0),
        TIMES_S[:250],
    )
    together = LaneSimulation(lanes, agents, lights).run(times_s)
    np.testing.assert_allclose(
        together.lane_positions_m, simulate_agent_by_agent(lanes, agents, lights, times_s), atol=1e-6
    )
    held_up = (together.speeds_mps == 0.0).any(axis=0)
    assert 2 < held_up.sum() < len(agents)


def test_green_phases_are_exclusive_with_clearance():
    signals, times_s = TrafficSignals(np.array([0.0, 17.3, -211.0])), np.arange(0.0, 400.0, 0.05)
    left = signals.compute_remaining_green_s(times_s)
    green = left > 0
    assert not (green[..., MAIN] & green[..., CROSS]).any()
    assert green[..., MAIN].any()
    for junction in range(3):
        for phase in (MAIN, CROSS):
            ends = times_s[1:][green[:-1, junction, phase] & ~green[1:, junction, phase]]
            starts = times_s[1:][~green[:-1, junction, 1 - phase] & green[1:, junction, 1 - phase]]
            waits = [(starts[starts > end] - end).min() for end in ends if (starts > end).any()]
            assert len(waits) > 3
            np.testing.assert_allclose(waits, signals.yellow_s + signals.all_red_s, atol=0.11)


def test_remaining_green_counts_down():
    signals = TrafficSignals(np.zeros(1), green_s=(20.0, 10.0), yellow_s=3.0, all_red_s=2.0)
    assert signals.cycle_s == 40.0
    np.testing.assert_allclose(signals.compute_remaining_green_s(0.0)[0], [20.0, -np.inf])
    np.testing.assert_allclose(signals.compute_remaining_green_s(19.0)[0, MAIN], 1.0)
    assert (signals.compute_remaining_green_s(24.9)[0] < 0).all()
    np.testing.assert_allclose(signals.compute_remaining_green_s(25.0)[0, CROSS], 10.0)
    np.testing.assert_allclose(signals.compute_remaining_green_s(34.0 + 5 * 40.0)[0, CROSS], 1.0)


def build_circle(radius, corners=720):
    angle = np.linspace(0, 2 * np.pi, corners + 1)
    return Polyline(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))


@pytest.mark.parametrize("place", [-30.0, 0.0, 12.5, 100.0, 130.0])
def test_straight_polylines_continue_beyond_their_ends(place):
    yaw = np.deg2rad(30.0)
    ends_m = np.array([1.0, 2.0]) + np.array([[0.0], [100.0]]) * [np.cos(yaw), np.sin(yaw)]
    x, y, yaw_deg = Polyline(ends_m).compute_poses(place)
    np.testing.assert_allclose([x, y], [1 + place * np.cos(yaw), 2 + place * np.sin(yaw)])
    assert yaw_deg == pytest.approx(30.0)


def test_poses_on_a_circle():
    place = np.linspace(1.0, 300.0, 57)
    poses = build_circle(50.0).compute_poses(place)
    angle = place / 50.0
    np.testing.assert_allclose(poses[:, :2], 50 * np.stack([np.cos(angle), np.sin(angle)], axis=1), atol=0.01)
    np.testing.assert_allclose(poses[:, 2], np.rad2deg(angle) + 90, atol=0.05)


def test_loops_close_smoothly_and_repeat():
    line = build_rounded_rectangle(80.0, 20.0, 6.0)
    assert line.length_m == pytest.approx(2 * (80 + 20) - 8 * 6 + 2 * np.pi * 6, rel=1e-3)
    place = np.arange(-30.0, line.length_m + 30.0, 0.1)
    poses = line.compute_poses(place)
    assert np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1).max() < 0.1001
    turn = (np.diff(poses[:, 2]) + 180) % 360 - 180
    assert turn.min() >= -1e-9
    assert turn.max() < 2.0
    np.testing.assert_allclose(line.compute_poses(place + line.length_m)[:, :2], poses[:, :2], atol=1e-9)
    assert np.abs(poses[:, 0]).max() == pytest.approx(40.0)
    assert np.abs(poses[:, 1]).max() == pytest.approx(10.0)
