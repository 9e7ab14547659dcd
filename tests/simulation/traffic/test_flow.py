"""Agents on lanes: queues, lights, junctions."""

from itertools import pairwise

import numpy as np
import pytest

from torchcover.simulation.traffic.alignment import Polyline, loop
from torchcover.simulation.traffic.flow import (
    BRAKING_FOR_A_LIGHT_MPS2,
    CROSS,
    MAIN,
    QUEUE_SPEED,
    STOP_BEFORE_LINE_M,
    Agent,
    Gate,
    Lane,
    Signals,
    Simulation,
)
from torchcover.simulation.traffic.idm import Driver, acceleration_in, advance, tightness

TIMES_S = np.arange(0.0, 60.0, 0.1)
CAR = Driver(14.0)
LONG = Polyline(np.array([[0.0, 0.0], [2000.0, 0.0]]))


def car(lane, place, driver=CAR):
    return Agent("car", 5.0, lane, place, driver)


def run(lanes, agents, offset=0.0, times_s=TIMES_S, **lights):
    return Simulation(lanes, agents, Signals(np.array([offset]), **lights)).run(times_s)


def test_a_queue_keeps_its_order_and_never_touches():
    agents = [car(0, place, Driver(speed)) for place, speed in [(10, 20), (30, 25), (60, 5), (90, 30), (110, 9)]]
    flow = run([Lane(LONG)], agents)
    assert (np.diff(flow.place_m, axis=1) > 5.5).all()
    # All end up at the speed of the slowest ahead of them.
    np.testing.assert_allclose(flow.speed_mps[-1], [5, 5, 5, 9, 9], rtol=0.05)


def test_lanes_do_not_see_each_other():
    alone = run([Lane(LONG)], [car(0, 10.0)])
    beside = run([Lane(LONG), Lane(LONG)], [car(0, 10.0), car(1, 20.0, Driver(2.0))])
    np.testing.assert_array_equal(alone.place_m[:, 0], beside.place_m[:, 0])


def test_stops_at_red_before_the_line_and_goes_at_green():
    lanes = [Lane(LONG, (Gate(200.0, 225.0, 0, MAIN),))]
    # Main green ends after 5 s and comes back after 5 + 6 + 18 + 6 = 35 s.
    flow = run(lanes, [car(0, 20.0)], green_s=(5.0, 18.0))
    front = flow.place_m[:, 0] + 2.5
    waiting = (TIMES_S > 28.0) & (TIMES_S < 35.0)
    assert (front[waiting] <= 200.0).all()
    assert front[waiting].min() > 198.0
    assert front[-1] > 225.0


def test_who_cannot_stop_goes_on_and_is_through_before_the_others_get_green():
    for start in np.linspace(60.0, 200.0, 71):
        lanes = [Lane(LONG, (Gate(200.0, 225.0, 0, MAIN),))]
        flow = run(lanes, [car(0, start)], green_s=(2.0, 18.0), times_s=np.arange(0.0, 12.0, 0.05))
        changes = np.arange(0.0, 12.0, 0.05) > 8.0
        on_junction = (flow.place_m[:, 0] + 2.5 > 200.0) & (flow.place_m[:, 0] - 2.5 < 225.0)
        assert not (on_junction & changes).any()
        assert np.diff(flow.speed_mps[:, 0]).min() / 0.05 > -6.0


def test_waits_for_somebody_left_on_the_junction_in_spite_of_green():
    lanes = [
        Lane(LONG, (Gate(200.0, 225.0, 0, MAIN),)),
        Lane(Polyline(np.array([[0.0, 0.0], [0.0, 2000.0]])), (Gate(200.0, 225.0, 0, CROSS),)),
    ]
    stuck = car(1, 210.0, Driver(0.5))
    flow = run(lanes, [car(0, 100.0), stuck], green_s=(50.0, 10.0))
    inside = flow.place_m[:, 1] - 2.5 < 225.0
    assert inside.sum() > 100
    assert (flow.place_m[inside, 0] + 2.5 <= 200.0).all()
    assert flow.occupied[inside, 0, CROSS].all()
    assert flow.place_m[-1, 0] > 200.0


def test_does_not_enter_a_junction_with_a_queue_behind_it():
    lanes = [Lane(LONG, (Gate(200.0, 225.0, 0, MAIN),))]
    flow = run(lanes, [car(0, 100.0), car(0, 232.0, Driver(1e-3, acceleration_mps2=1e-3))], green_s=(80.0, 10.0))
    assert (flow.place_m[:, 0] + 2.5 <= 200.0).all()


def test_who_is_slow_to_cross_needs_green_to_be_left():
    gate = Gate(20.0, 40.0, 0, MAIN, green_needed_s=15.0)
    walker = Driver(1.4, 0.4, 0.5, 1.0, 1.5)
    flow = run([Lane(LONG, (gate,))], [car(0, 5.0, walker)], green_s=(20.0, 5.0))
    front = flow.place_m[:, 0] + 2.5
    entered = TIMES_S[np.argmax(front > 20.0)]
    assert entered > 37.0
    assert entered < 40.0


def test_on_a_loop_the_first_follows_the_last():
    line = loop(84.0, 18.0, 6.0)
    agents = [car(0, place, Driver(speed)) for place, speed in [(0.0, 2.0), (10.0, 8.0), (60.0, 4.0)]]
    flow = run([Lane(line)], agents, times_s=np.arange(0.0, 200.0, 0.1))
    gaps = np.diff(np.column_stack([flow.place_m, flow.place_m[:, :1] + line.length_m]), axis=1) - 5.0
    assert gaps.min() > 0.5
    np.testing.assert_allclose(flow.speed_mps[-1], 2.0, rtol=0.02)


def test_alone_on_a_loop_one_has_a_free_road():
    flow = run([Lane(loop(84.0, 18.0, 6.0))], [car(0, 0.0, Driver(3.0))])
    assert flow.speed_mps[-1, 0] == pytest.approx(3.0, rel=0.02)


def test_a_coarse_time_step_gives_the_same_run():
    lanes = [Lane(LONG, (Gate(200.0, 225.0, 0, MAIN),))]
    agents = [car(0, 20.0), car(0, 60.0)]
    # Green ends between two of the coarse times, and would still let the first one pass.
    fine = run(lanes, agents, times_s=np.arange(0.0, 40.5, 0.1), green_s=(9.05, 18.0))
    coarse = run(lanes, agents, times_s=np.arange(0.0, 40.5, 2.0), green_s=(9.05, 18.0))
    np.testing.assert_allclose(fine.place_m[::20][: len(coarse.place_m)], coarse.place_m, atol=1e-6)


def twin(lanes, agents, lights, times_s):
    """(T, N) places, worked out for one agent after the other in the words of the rules."""
    place, speed = [agent.place_m for agent in agents], Simulation(lanes, agents, lights).speed_mps.tolist()
    found = [list(place)]
    for time, after in pairwise(times_s):
        left, gates, ahead = lights.green_left_s(time), [], []
        for n, agent in enumerate(agents):
            rear = place[n] - agent.length_m / 2
            gates.append(next((gate for gate in lanes[agent.lane].gates if gate.exit_m >= rear), None))
            lap = lanes[agent.lane].line.length_m if lanes[agent.lane].line.closed else np.inf
            others = [(m, place[m] + (lap if place[m] < place[n] else 0.0)) for m in range(len(agents)) if m != n]
            others = [(m, at) for m, at in others if agents[m].lane == agent.lane]
            ahead.append(min(others, key=lambda other: other[1], default=(n, np.inf)))

        to_line = [
            np.inf if gate is None else gate.enter_m - at - agent.length_m / 2
            for gate, at, agent in zip(gates, place, agents, strict=True)
        ]
        committed = [v**2 > 2 * BRAKING_FOR_A_LIGHT_MPS2 * way for v, way in zip(speed, to_line, strict=True)]
        inside = {(gates[n].junction, gates[n].phase) for n in range(len(agents)) if committed[n]}
        moved = []
        for n, agent in enumerate(agents):
            (m, at), gate, driver = ahead[n], gates[n], agent.driver
            gap, line = at - place[n] - (agent.length_m + agents[m].length_m) / 2, np.inf
            if gate is not None and not committed[n]:
                back = at - agents[m].length_m / 2
                jam = gate.enter_m < back < gate.exit_m + agent.length_m + driver.standstill_gap_m
                jam = jam and speed[m] < QUEUE_SPEED * driver.desired_speed_mps
                free = left[gate.junction, gate.phase] > gate.green_needed_s
                if jam or not free or (gate.junction, 1 - gate.phase) in inside:
                    line = to_line[n]
            stop = line + driver.standstill_gap_m - STOP_BEFORE_LINE_M
            closing = speed[n] - speed[m] if np.isfinite(at) else 0.0
            behind, before = (
                acceleration_in(
                    driver,
                    np.array([speed[n]]),
                    tightness(driver, np.array([speed[n]]), np.array([room]), np.array([approach])),
                    driver.desired_speed_mps,
                )
                for room, approach in ((gap, closing), (stop, speed[n]))
            )
            wanted, room = np.minimum(behind, before), np.array([min(gap, line)])
            way, end = advance(np.array([speed[n]]), wanted, room, after - time)
            moved.append((place[n] + float(way[0]), float(end[0])))
        place, speed = map(list, zip(*moved, strict=True))
        found.append(place)
    return np.array(found)


def test_all_together_are_that_many_single_ones():
    generator = np.random.default_rng(0)
    gates = [Gate(200.0, 225.0, 0, MAIN), Gate(260.0, 285.0, 1, MAIN, green_needed_s=4.0)]
    crossing = Polyline(np.array([[0.0, 0.0], [0.0, 2000.0]]))
    lanes = [
        Lane(LONG, tuple(gates)),
        Lane(crossing, (Gate(200.0, 225.0, 0, CROSS),)),
        Lane(crossing, (Gate(120.0, 145.0, 1, CROSS),)),
        Lane(loop(84.0, 18.0, 6.0)),
    ]
    agents = [
        Agent("car", 5.0, lane, start + 16.0 * number, Driver(generator.uniform(3.0, 16.0)))
        for lane, start, count in ((0, 100.0, 5), (1, 110.0, 4), (2, 70.0, 3), (3, 0.0, 3))
        for number in range(count)
    ]
    lights, times_s = Signals(np.array([3.0, 11.0]), green_s=(7.0, 5.0), amber_s=2.0, clear_s=1.0), TIMES_S[:250]
    together = Simulation(lanes, agents, lights).run(times_s)
    np.testing.assert_allclose(together.place_m, twin(lanes, agents, lights, times_s), atol=1e-6)
    held_up = (together.speed_mps == 0.0).any(axis=0)
    assert 2 < held_up.sum() < len(agents)
