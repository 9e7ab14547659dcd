"""Alignment of the main street of a city: bends between junctions, and turns at junctions."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from torchcover.geometry.arrays import Float64, Int64
from torchcover.simulation.traffic.alignment import Alignment, compute_squared_distances_m2


@dataclass(frozen=True)
class MainStreetParams:
    """Bends and turns of a main street.

    Args:
        min_radius_m: Smallest radius of the bends between junctions.
        straight_m: Straight length next to a junction, for crossings and stop lines.
        min_bend_m: Shortest section between junctions that bends.
        turn_deg: Smallest and largest angle of a turn.
        turn_transition_m: Length over which the curvature changes at the start and the end of a turn.
        min_turn_spacing: Smallest number of blocks between two turns.
        min_clearance_m: Distance between stretches of the street that are not neighbors.
        neighbor_m: Distance along the street within which stretches are neighbors.
        max_attempts: Number of samples before a straight street is taken.
    """

    min_radius_m: float = 110.0
    straight_m: float = 8.0
    min_bend_m: float = 20.0
    turn_deg: tuple[float, float] = (82.0, 98.0)
    turn_transition_m: float = 8.0
    min_turn_spacing: int = 2
    min_clearance_m: float = 70.0
    neighbor_m: float = 200.0
    max_attempts: int = 30


class MainStreet(NamedTuple):
    """Alignment of a main street with J junctions.

    Args:
        alignment: Alignment with station 0 at the origin, along x.
        turn_directions: (J,) 1 for a turn to the left, -1 to the right, 0 straight on.
        junction_half_lengths_m: (J,) distance from the middle of each junction to its ends.
    """

    alignment: Alignment
    turn_directions: Int64
    junction_half_lengths_m: Float64


def sample_main_street(
    junction_stations_m: Float64,
    junction_half_lengths_m: Float64,
    max_bend_deg: float,
    turn_share: float,
    turn_radius_m: float,
    half_length_m: float,
    generator: np.random.Generator,
    params: MainStreetParams = MainStreetParams(),
) -> MainStreet:
    """Sample a main street that never comes near itself.

    Args:
        junction_stations_m: (J,) stations of the middles of the junctions.
        junction_half_lengths_m: (J,) half lengths of the junctions without a turn.
        max_bend_deg: Largest bend between two junctions, and largest deviation from the first direction without turns.
        turn_share: Share of the junctions with a turn among those that can have one: not the first, not the last.
        turn_radius_m: Radius of turns.
        half_length_m: Distance along the street from the origin to both ends.
        generator: Random generator.
        params: Limits of bends and turns.
    """
    max_bend_rad = np.deg2rad(max_bend_deg)
    for _ in range(params.max_attempts):
        street = _sample_street(
            junction_stations_m, junction_half_lengths_m, max_bend_rad, turn_share, turn_radius_m, generator, params
        )
        if street.alignment.is_straight or _is_clear_of_itself(street.alignment, half_length_m, params):
            return street
    no_turns = np.zeros(len(junction_stations_m), dtype=np.int64)
    return MainStreet(Alignment([0.0], [0.0]), no_turns, junction_half_lengths_m)


def _sample_street(
    junction_stations_m: Float64,
    half_lengths_m: Float64,
    max_bend_rad: float,
    turn_share: float,
    turn_radius_m: float,
    generator: np.random.Generator,
    params: MainStreetParams,
) -> MainStreet:
    """Sample a main street that may come near itself."""
    num_junctions = len(junction_stations_m)
    turns, half_lengths_m = np.zeros(num_junctions, dtype=np.int64), half_lengths_m.copy()
    quarter_turns, last_turn = 0, -params.min_turn_spacing
    for index in range(1, num_junctions - 1):
        if index - last_turn >= params.min_turn_spacing and generator.random() < turn_share:
            # A second turn goes back to the first direction.
            turns[index] = -quarter_turns if quarter_turns else generator.choice([-1, 1])
            quarter_turns, last_turn = quarter_turns + int(turns[index]), index
            angle_rad = np.deg2rad(generator.uniform(*params.turn_deg))
            half_lengths_m[index] = (angle_rad * turn_radius_m + params.turn_transition_m) / 2
    curves: list[tuple[float, float, float, float]] = []  # start, length, length of both transitions, curvature
    deviation_rad = 0.0
    starts_m = junction_stations_m + half_lengths_m + params.straight_m
    ends_m = junction_stations_m[1:] - half_lengths_m[1:] - params.straight_m
    for index, station_m in enumerate(junction_stations_m.tolist()):
        if turns[index]:
            half_m = float(half_lengths_m[index])
            curves.append((station_m - half_m, 2 * half_m, params.turn_transition_m, turns[index] / turn_radius_m))
        angle_rad = generator.uniform(-max_bend_rad, max_bend_rad)
        length_m = float(ends_m[index] - starts_m[index]) if index < len(ends_m) else 0.0
        if length_m > params.min_bend_m and angle_rad:
            # With transitions of a quarter of the length each, a bend turns by curvature times 0.75 lengths.
            max_angle_rad = 0.75 * length_m / params.min_radius_m
            if abs(deviation_rad + angle_rad) > max_bend_rad:
                angle_rad = -angle_rad
            angle_rad = float(np.clip(angle_rad, -max_angle_rad, max_angle_rad))
            curves.append((float(starts_m[index]), length_m, length_m / 4, angle_rad / (0.75 * length_m)))
            deviation_rad += angle_rad
    if not curves:
        return MainStreet(Alignment([0.0], [0.0]), turns, half_lengths_m)
    start_m, length_m, transition_m, curvature_per_m = np.array(curves).T
    end_m, zeros = start_m + length_m, np.zeros(len(curves))
    stations_m = np.stack([start_m, start_m + transition_m, end_m - transition_m, end_m], axis=1).ravel()
    curvatures_per_m = np.stack([zeros, curvature_per_m, curvature_per_m, zeros], axis=1).ravel()
    # The street is moved so that station 0 is at the origin and along x.
    x, y, yaw_deg = Alignment(stations_m, curvatures_per_m).compute_poses(0.0, 0.0)
    yaw = np.deg2rad(yaw_deg)
    start = (-x * np.cos(yaw) - y * np.sin(yaw), x * np.sin(yaw) - y * np.cos(yaw), -yaw)
    return MainStreet(Alignment(stations_m, curvatures_per_m, start), turns, half_lengths_m)


def _is_clear_of_itself(street: Alignment, half_length_m: float, params: MainStreetParams) -> bool:
    """Test whether stretches of a street that are not neighbors keep their distance."""
    stations_m = np.arange(-half_length_m, half_length_m, 20.0)
    positions_m = street.compute_poses(stations_m, 0.0)[:, :2]
    is_no_neighbor = np.abs(stations_m[:, None] - stations_m) > params.neighbor_m
    squared_distances_m2 = compute_squared_distances_m2(positions_m, positions_m)
    return bool((squared_distances_m2[is_no_neighbor] > params.min_clearance_m**2).all())
