"""The course of a main street: where it bends between junctions, and at which of them it turns."""

from typing import NamedTuple

import numpy as np

from torchcover.geometry.arrays import Float64, Int64
from torchcover.simulation.traffic.alignment import Alignment, squared_distances

# Between junctions no curve is tighter; crossings and stop lines lie on straights.
SMALLEST_RADIUS_M = 110.0
STRAIGHT_BESIDE_M = 8.0
SHORTEST_BEND_M = 20.0
TURN_DEG = (82.0, 98.0)
# At the beginning and the end of a turn, over which the steering wheel is turned.
RAMP_M = 8.0
# At least so many blocks between two turns.
TURNS_APART = 2
# Stretches that are not neighbours keep apart; what is nearer along the street is one.
APART_M, NEIGHBOURS_M = 70.0, 200.0
DRAWS = 30


class Course(NamedTuple):
    """`street` has station 0 at the origin, along x; `turns` (J,) 1 to the left, -1 to the right, 0: straight on.

    `halves_m` (J,) is how far from its middle each junction ends.
    """

    street: Alignment
    turns: Int64
    halves_m: Float64


def course(
    junctions_m: Float64,
    halves_m: Float64,
    bend_deg: float,
    turn_share: float,
    radius_m: float,
    reach_m: float,
    generator: np.random.Generator,
) -> Course:
    """Draw one that never comes near itself, and that begins and ends `reach_m` from the origin.

    Each of the junctions, at (J,) stations, ends `halves_m` from its middle where the street goes straight on. It bends
    by `bend_deg` at most between two of them, and from its first direction. Of those that may have a turn, which is
    neither the first nor the last, `turn_share` have one.
    """
    for _ in range(DRAWS):
        found = _draw(junctions_m, halves_m, np.deg2rad(bend_deg), turn_share, radius_m, generator)
        if found.street.is_straight or _keeps_apart(found.street, reach_m):
            return found
    return Course(Alignment([0.0], [0.0]), np.zeros(len(junctions_m), dtype=np.int64), halves_m)


def _draw(
    junctions_m: Float64,
    halves_m: Float64,
    bend: float,
    turn_share: float,
    radius_m: float,
    generator: np.random.Generator,
) -> Course:
    turns, halves_m = np.zeros(len(junctions_m), dtype=np.int64), halves_m.copy()
    angles, quarter, last = np.zeros(len(junctions_m)), 0, -TURNS_APART
    for index in range(1, len(junctions_m) - 1):
        if index - last >= TURNS_APART and generator.random() < turn_share:
            turns[index] = -quarter if quarter else generator.choice([-1, 1])
            quarter, last = quarter + int(turns[index]), index
            angles[index] = np.deg2rad(generator.uniform(*TURN_DEG))
            halves_m[index] = (angles[index] * radius_m + RAMP_M) / 2
    stations, curvatures = [0.0], [0.0]
    aside = 0.0
    ends_m = junctions_m + halves_m + STRAIGHT_BESIDE_M
    following_m = junctions_m[1:] - halves_m[1:] - STRAIGHT_BESIDE_M
    for index, middle_m in enumerate(junctions_m.tolist()):
        if turns[index]:
            half_m = float(halves_m[index])
            _append(stations, curvatures, middle_m - half_m, 2 * half_m, RAMP_M, turns[index] / radius_m)
        angle = generator.uniform(-bend, bend)
        length_m = float(following_m[index] - ends_m[index]) if index < len(following_m) else 0.0
        if length_m > SHORTEST_BEND_M and angle:
            # A curve turns by its curvature times three quarters of its length.
            most = 0.75 * length_m / SMALLEST_RADIUS_M
            angle = float(np.clip(-angle if abs(aside + angle) > bend else angle, -most, most))
            _append(stations, curvatures, float(ends_m[index]), length_m, length_m / 4, angle / (0.75 * length_m))
            aside += angle
    if len(stations) == 1:
        return Course(Alignment([0.0], [0.0]), turns, halves_m)
    stations, curvatures = stations[1:], curvatures[1:]
    # Begun anywhere, and then moved: the origin is where station 0 is.
    x, y, yaw_deg = Alignment(stations, curvatures).poses(0.0, 0.0)
    yaw = np.deg2rad(yaw_deg)
    start = (-x * np.cos(yaw) - y * np.sin(yaw), x * np.sin(yaw) - y * np.cos(yaw), -yaw)
    return Course(Alignment(stations, curvatures, start), turns, halves_m)


def _append(
    stations: list[float], curvatures: list[float], start: float, length: float, ramp: float, curvature: float
) -> None:
    """A curve: in, round, out."""
    stations += [start, start + ramp, start + length - ramp, start + length]
    curvatures += [0.0, curvature, curvature, 0.0]


def _keeps_apart(street: Alignment, reach_m: float) -> bool:
    stations = np.arange(-reach_m, reach_m, 20.0)
    places_m = street.poses(stations, 0.0)[:, :2]
    far = np.abs(stations[:, None] - stations) > NEIGHBOURS_M
    return bool((squared_distances(places_m, places_m)[far] > APART_M**2).all())
