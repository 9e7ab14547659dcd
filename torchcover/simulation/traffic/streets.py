"""Street plan of a city: a main street with bends and turns, and streets that cross it at traffic signals."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation.traffic.alignment import Alignment, OffsetPath, StreetCorridor
from torchcover.simulation.traffic.flow import SPEED_LIMIT_SPACING_M, Lane
from torchcover.simulation.traffic.junctions import CROSS, MAIN, JunctionPassage, TrafficSignals
from torchcover.simulation.traffic.main_street import MainStreet, sample_main_street


@dataclass(frozen=True)
class CityStreetParams:
    """Dimensions of streets, junctions and sidewalks of a city.

    Args:
        bicycle_lane_m: Width of bicycle lanes.
        gutter_m: Width between the lanes of a cross street and its curbs.
        block_m: Smallest and largest distance between junctions.
        stop_line_m: Distance of stop lines before the curb of the cross street.
        crossing_end_m: Distance behind the curb of the cross street at which a rear end has left the crossing.
        sidewalk_tracks_m: Distances from the curb at which pedestrians walk along the street, in each direction,
            between posts and facades.
        wait_offset_m: Distance from the curb at which pedestrians wait.
        footpaths_m: Distances of the footpaths of a crossing from the end of the junction; each holds one person.
        walking_mps: Speed of pedestrians, for the green that they need.
        green_wave_mps: Speed of a green wave, about 40 km/h.
        green_wave_error_s: Largest deviation of a signal from the green wave.
        sight_m: Distance along a cross street that is visible from the main street.
        half_vehicle_m: Half of the length of the longest vehicle, with a margin.
        lateral_mps2: Comfortable lateral acceleration in curves.
        braking_mps2: Comfortable braking before curves.
        bus_half_length_m: Half of the length of a bus of 12 m.
        bus_width_m: Width of a bus of 2.55 m, with a margin to pass another one in a turn.
    """

    bicycle_lane_m: float = 1.8
    gutter_m: float = 0.5
    block_m: tuple[float, float] = (80.0, 130.0)
    stop_line_m: float = 5.0
    crossing_end_m: float = 4.0
    sidewalk_tracks_m: tuple[float, float] = (1.35, 2.25)
    wait_offset_m: float = 0.5
    footpaths_m: tuple[float, ...] = (1.6, 2.5, 3.4)
    walking_mps: float = 1.2
    green_wave_mps: float = 11.0
    green_wave_error_s: float = 9.0
    sight_m: float = 270.0
    half_vehicle_m: float = 9.0
    lateral_mps2: float = 2.0
    braking_mps2: float = 1.2
    bus_half_length_m: float = 6.0
    bus_width_m: float = 2.65


STREETS = CityStreetParams()


@dataclass(frozen=True)
class CrossSection:
    """Cross section of the main street from its middle to the houses.

    Args:
        lanes_per_direction: Lanes in each direction.
        lane_width_m: Width of the lanes of all streets.
        bay_width_m: Width of the parking bays; 0 without bays.
        sidewalk_width_m: Width of the sidewalks.
    """

    lanes_per_direction: int
    lane_width_m: float = 3.25
    bay_width_m: float = 2.3
    sidewalk_width_m: float = 3.2

    @property
    def bay_center_offset_m(self) -> float:
        """Distance from the middle of the street to the middle of its parking bays."""
        return self.lanes_per_direction * self.lane_width_m + STREETS.bicycle_lane_m + self.bay_width_m / 2

    @property
    def curb_offset_m(self) -> float:
        """Distance from the middle of the street to its curb."""
        return self.bay_center_offset_m + self.bay_width_m / 2

    @property
    def min_turn_radius_m(self) -> float:
        """Smallest radius of the middle of a turn in which two buses on neighboring lanes do not touch."""
        inner_m, outer_m = STREETS.bus_width_m / 2, self.lane_width_m - STREETS.bus_width_m / 2
        half_m = STREETS.bus_half_length_m
        innermost_m = (half_m**2 + inner_m**2 - outer_m**2) / (2 * (outer_m - inner_m))
        return innermost_m + (self.lanes_per_direction - 0.5) * self.lane_width_m


@dataclass(frozen=True, eq=False)
class StreetPlan:
    """Main street and the J streets that cross it.

    Args:
        cross_section: Cross section of the main street.
        junction_stations_m: (J,) stations of the main street at which other streets cross it.
        cross_lanes_per_direction: (J,) 1 or 2 lanes of each cross street.
        signals: Traffic signals of the junctions.
        half_length_m: Distance from the origin to the ends of the lanes, which no agent reaches during a run.
        main_street: Alignment and turns of the main street.
    """

    cross_section: CrossSection
    junction_stations_m: Float64
    cross_lanes_per_direction: Int64
    signals: TrafficSignals
    half_length_m: float
    main_street: MainStreet

    @property
    def main_alignment(self) -> Alignment:
        """Alignment of the main street."""
        return self.main_street.alignment

    @property
    def has_lights(self) -> Bools:
        """(J,) junctions with signals; where the main street turns, it has priority."""
        return np.asarray(self.main_street.turn_directions == 0)

    @cached_property
    def cross_streets(self) -> list[Alignment]:
        """J cross streets with station 0 on the junction.

        A straight one crosses the main street at right angles from its right side to its left side. Where the main
        street turns, the other street is the same turn on the opposite side of the junction.
        """
        streets, middle_poses = [], self.main_alignment.compute_poses(self.junction_stations_m, 0.0)
        half_lengths_m = self.main_street.junction_half_lengths_m
        for index, (station_m, half_m) in enumerate(zip(self.junction_stations_m, half_lengths_m, strict=True)):
            if self.main_street.turn_directions[index] == 0:
                x, y, yaw_deg = middle_poses[index]
                streets.append(Alignment([0.0], [0.0], (x, y, np.deg2rad(yaw_deg + 90.0))))
                continue
            start_pose, end_pose = self.main_alignment.compute_poses([station_m - half_m, station_m + half_m], 0.0)
            (x, y, yaw_deg), (end_x, end_y, end_yaw_deg) = start_pose, end_pose
            yaw, angle = np.deg2rad([yaw_deg, end_yaw_deg - yaw_deg])
            # The tangents of the turn meet in a corner; the other turn starts on the first one, equally far beyond it.
            corner_distance_m = np.hypot(end_x - x, end_y - y) / 2 / np.cos(angle / 2)
            start = x + 2 * corner_distance_m * np.cos(yaw), y + 2 * corner_distance_m * np.sin(yaw), yaw + np.pi
            knots_m = self.main_alignment.stations_m
            is_in_turn = (knots_m >= station_m - half_m - 1e-6) & (knots_m <= station_m + half_m + 1e-6)
            curvatures_per_m = self.main_alignment.curvatures_per_m[is_in_turn]
            streets.append(Alignment(knots_m[is_in_turn] - station_m, curvatures_per_m, start))
        return streets

    @property
    def cross_curb_offsets_m(self) -> Float64:
        """(J,) distances from the middle of each cross street to its curb, also where the main street turns."""
        return np.asarray(self.cross_lanes_per_direction * self.cross_section.lane_width_m + STREETS.gutter_m)

    @cached_property
    def cross_street_spans_m(self) -> Float64:
        """(J, 2) stations between which a cross street with all its width keeps off all other stretches."""
        corridor = StreetCorridor(self.main_alignment, (-self.half_length_m, self.half_length_m))
        half_lengths_m = self.main_street.junction_half_lengths_m + 1.0
        edges_m = self.junction_stations_m + np.array([[-1.0], [1.0]]) * half_lengths_m
        spans_m = np.empty((len(self.junction_stations_m), 2))
        for column, side in enumerate((-1, 1)):
            if self.main_alignment.is_straight:
                spans_m[:, column] = side * 2 * self.half_length_m
                continue
            widths_m = corridor.find_half_widths_m(
                edges_m.ravel(), side, self.cross_section.curb_offset_m, STREETS.sight_m
            )
            spans_m[:, column] = side * (widths_m.reshape(2, -1).min(axis=0) - STREETS.half_vehicle_m)
        return spans_m

    def build_traffic_lanes(self) -> list[Lane]:
        """Build the lanes of the main street: eastbound from the median outwards, then westbound."""
        indices = np.arange(self.cross_section.lanes_per_direction)
        offsets_m = ((indices + 0.5) * self.cross_section.lane_width_m).tolist()
        return [self._build_main_lane(offset_m, direction) for direction in (1, -1) for offset_m in offsets_m]

    def build_bicycle_lanes(self) -> list[Lane]:
        """Build the bicycle lanes of the main street: eastbound, westbound."""
        lanes_m = self.cross_section.lanes_per_direction * self.cross_section.lane_width_m
        offset_m = lanes_m + STREETS.bicycle_lane_m / 2
        return [self._build_main_lane(offset_m, direction) for direction in (1, -1)]

    def build_sidewalk_lanes(self) -> list[Lane]:
        """Build the tracks of pedestrians along the main street: both directions on each side."""
        lanes = []
        for side in (1, -1):
            for track_m, direction in zip(STREETS.sidewalk_tracks_m, (1, -1), strict=True):
                offset_m = side * (self.cross_section.curb_offset_m + track_m)
                lanes.append(self._build_main_lane(offset_m, direction, is_sidewalk=True))
        return lanes

    def build_cross_lanes(self) -> list[Lane]:
        """Build the lanes of all cross streets with signals: northbound ones on the east side, then southbound ones."""
        lanes = []
        middle_m, half_m = self.half_length_m, self.cross_section.curb_offset_m
        stop_line_m = middle_m - half_m - STREETS.stop_line_m
        exit_m = middle_m + half_m + STREETS.crossing_end_m
        for index in np.flatnonzero(self.has_lights).tolist():
            passage = JunctionPassage(stop_line_m, exit_m, index, CROSS)
            for direction in (1, -1):
                for lane in range(self.cross_lanes_per_direction[index]):
                    left_m = -direction * (lane + 0.5) * self.cross_section.lane_width_m
                    path = OffsetPath(self.cross_streets[index], left_m, direction, self.half_length_m)
                    lanes.append(Lane(path, (passage,)))
        return lanes

    def _build_main_lane(self, right_m: float, direction: int, is_sidewalk: bool = False) -> Lane:
        """Build a lane or a track at an offset to the right of the main street, eastbound (1) or westbound (-1)."""
        path = OffsetPath(self.main_alignment, -direction * right_m, direction, self.half_length_m)
        before_m = STREETS.wait_offset_m if is_sidewalk else STREETS.stop_line_m
        behind_m = STREETS.wait_offset_m if is_sidewalk else STREETS.crossing_end_m
        passages = []
        for index in np.argsort(direction * self.junction_stations_m):
            if self.has_lights[index]:
                middle_m = float(path.convert_stations_to_distances_m(self.junction_stations_m[index]))
                half_m = self.main_street.junction_half_lengths_m[index]
                enter_m, exit_m = middle_m - half_m - before_m, middle_m + half_m + behind_m
                min_green_s = (exit_m - enter_m) / STREETS.walking_mps if is_sidewalk else 0.0
                passages.append(JunctionPassage(float(enter_m), float(exit_m), int(index), MAIN, float(min_green_s)))
        has_limits = not (is_sidewalk or self.main_alignment.is_straight)
        return Lane(path, tuple(passages), compute_speed_limits_mps(path) if has_limits else None)


def compute_speed_limits_mps(path: OffsetPath) -> Float64:
    """Compute the speeds at which a lane can be driven, in curves and before them.

    Args:
        path: Centerline of the lane.

    Returns:
        (K,) speeds in m/s, every `SPEED_LIMIT_SPACING_M`.
    """
    distances_m = np.arange(0.0, path.length_m, SPEED_LIMIT_SPACING_M)
    curvature_per_m = path.street.compute_curvatures_per_m(path.convert_distances_to_stations_m(distances_m))
    curvature_per_m = np.abs(curvature_per_m / (1.0 - curvature_per_m * path.left_m))
    squared_speed = STREETS.lateral_mps2 / np.maximum(curvature_per_m, 1e-6)
    # Gentle braking from here must suffice for every curve ahead.
    braked = 2 * STREETS.braking_mps2 * distances_m
    return np.asarray(np.sqrt(np.minimum.accumulate((squared_speed + braked)[::-1])[::-1] - braked))


def sample_street_plan(
    cross_section: CrossSection,
    max_bend_deg: float,
    turn_share: float,
    span_m: tuple[float, float],
    half_length_m: float,
    generator: np.random.Generator,
    layout_generator: np.random.Generator,
) -> StreetPlan:
    """Sample the streets of a city. The origin is halfway between two junctions.

    Args:
        cross_section: Cross section of the main street.
        max_bend_deg: Largest bend between two junctions.
        turn_share: Share of the junctions at which the main street turns.
        span_m: Stations between which there are junctions.
        half_length_m: Distance from the origin to the ends of the lanes.
        generator: Random generator of the junctions and their signals.
        layout_generator: Random generator of bends and turns.
    """
    middle_m = generator.uniform(*STREETS.block_m) / 2
    east_m, west_m = [middle_m], [-middle_m]
    while east_m[-1] < span_m[1]:
        east_m.append(east_m[-1] + generator.uniform(*STREETS.block_m))
    while west_m[-1] > span_m[0]:
        west_m.append(west_m[-1] - generator.uniform(*STREETS.block_m))
    stations_m = np.array(west_m[::-1] + east_m)
    # Two-lane and four-lane streets alternate.
    cross_lanes = 1 + (np.arange(len(stations_m)) + generator.integers(2)) % 2
    max_error_s = STREETS.green_wave_error_s
    errors_s = generator.uniform(-max_error_s, max_error_s, size=len(stations_m))
    signals = TrafficSignals(errors_s - stations_m / STREETS.green_wave_mps + generator.uniform(0.0, 60.0))
    half_lengths_m = np.asarray(cross_lanes * cross_section.lane_width_m + STREETS.gutter_m)
    radius_m = cross_section.min_turn_radius_m
    main_street = sample_main_street(
        stations_m, half_lengths_m, max_bend_deg, turn_share, radius_m, half_length_m, layout_generator
    )
    return StreetPlan(cross_section, stations_m, cross_lanes, signals, half_length_m, main_street)
