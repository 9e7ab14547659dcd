"""City traffic: the ego vehicle follows a main street with bends, turns, parked cars and pedestrians."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from torchcover.geometry.arrays import Float64
from torchcover.simulation.traffic.alignment import OffsetPath, StreetCorridor
from torchcover.simulation.traffic.assemble import (
    HORIZON_M,
    BodyTrajectories,
    build_ego_actor,
    build_nearby_actors,
    compute_body_trajectories,
    find_nearby_agents,
)
from torchcover.simulation.traffic.city import CityBuilder
from torchcover.simulation.traffic.fleet import CATEGORIES, CYCLIST, EGO, PEDESTRIAN, Fleet
from torchcover.simulation.traffic.flow import Agent, Lane, LaneSimulation, TrafficHistory, check_traffic_memory
from torchcover.simulation.traffic.frontage import RoadsideDensity
from torchcover.simulation.traffic.hills import Bounds, Hills
from torchcover.simulation.traffic.idm import Driver
from torchcover.simulation.traffic.junctions import CROSS, MAIN
from torchcover.simulation.traffic.kind import PeoplePerKm, ProceduralTraffic, SceneParts, VehiclesPerKm
from torchcover.simulation.traffic.streets import STREETS, CrossSection, StreetPlan, sample_street_plan
from torchcover.simulation.traffic.walking import Footpath, compute_step_height_m, simulate_walking


@dataclass(frozen=True)
class UrbanParams:
    """Extent of a city and behavior of the vehicles around the ego vehicle.

    Args:
        warm_up_s: Duration that is simulated before the run.
        behind_m: Extent of buildings and traffic behind the first position of the ego vehicle.
        ahead_m: Extent of buildings and traffic ahead of its last position.
        corridor_margin_m: Further extent along the street of the stretches that keep their corridor free; stretches
            beyond are not built, even if they come near again.
        lane_m: Smallest and largest width of lanes.
        bay_m: Width of parking bays.
        bay_share: Share of the cities with parking bays.
        sidewalk_m: Smallest and largest width of sidewalks.
        leader_gap_m: Distance of the vehicle ahead of the ego vehicle at the start, center to center.
        leader_speed_share: Desired speed of the vehicle ahead, as a share of the speed of the ego vehicle.
        following_distance_m: Distance within which the ego vehicle follows another vehicle.
        min_following_share: Smallest share of the frames in which the ego vehicle follows another vehicle; a signal may
            separate it from the vehicle ahead, and such a run is sampled again.
        max_attempts: Number of samples before a run is accepted.
    """

    warm_up_s: float = 20.0
    behind_m: float = 120.0
    ahead_m: float = 260.0
    corridor_margin_m: float = 320.0
    lane_m: tuple[float, float] = (3.25, 3.75)
    bay_m: float = 2.3
    bay_share: float = 0.8
    sidewalk_m: tuple[float, float] = (3.2, 5.0)
    leader_gap_m: float = 20.0
    leader_speed_share: float = 0.82
    following_distance_m: float = 40.0
    min_following_share: float = 0.6
    max_attempts: int = 5


PARAMS = UrbanParams()
# Weight, desired speed as a share of the usual one, headway, and acceleration from standstill of each kind.
DRIVER_PARAMS = {
    "sedan": (4.0, 1.0, 1.2, 1.6),
    "hatchback": (4.0, 1.0, 1.2, 1.6),
    "suv": (3.0, 1.0, 1.2, 1.6),
    "pickup": (1.0, 1.0, 1.2, 1.6),
    "van": (1.5, 0.95, 1.3, 1.4),
    "lorry": (0.5, 0.85, 1.5, 1.0),
    "truck": (0.3, 0.85, 1.6, 0.9),
    "bus": (0.6, 0.85, 1.5, 1.0),
    "motorcycle": (0.6, 1.05, 1.2, 2.2),
}


class UrbanTraffic(ProceduralTraffic):
    """Traffic in a city.

    Args:
        num_lanes: Lanes of the main street in both directions together; sampled for each run (2 or 4) if None. Cross
            streets have 2 or 4 lanes.
        speed_mps: Usual desired speed of drivers.
        traffic_per_km: Vehicles per kilometer of lane.
        cross_traffic_share: Traffic density of cross streets as a share of `traffic_per_km`.
        cyclists_per_km: Cyclists per kilometer of bicycle lane.
        people_per_km: Pedestrians per kilometer of sidewalk in each direction.
        parked_share: Share of the parking bays that are occupied.
        built_share: Share of the block sides that have houses; 0 is open country.
        roadside_density: Factor on the usual density of roadside objects other than houses, or factors for some kinds,
            such as `{hedge: 2, lamp: 0}`.
        max_bend_deg: Largest bend of the main street between two junctions; 0 is straight.
        turn_share: Share of the junctions at which the main street turns.
        hill_height_std_m: Standard deviation of the ground height; 0 is a plane.
    """

    type: Literal["urban"] = "urban"
    num_lanes: Literal[2, 4] | None = None
    speed_mps: float = Field(default=13.9, ge=5.0, le=20.0)
    traffic_per_km: VehiclesPerKm = 20.0
    cross_traffic_share: float = Field(default=0.75, ge=0.0, le=1.0)
    cyclists_per_km: PeoplePerKm = 6.0
    people_per_km: PeoplePerKm = 25.0
    parked_share: float = Field(default=0.45, ge=0.0, le=1.0)
    built_share: float = Field(default=0.8, ge=0.0, le=1.0)
    roadside_density: RoadsideDensity = 1.0
    max_bend_deg: float = Field(default=25.0, ge=0.0, le=35.0)
    turn_share: float = Field(default=0.25, ge=0.0, le=1.0)
    hill_height_std_m: float = Field(default=1.0, ge=0.0, le=2.0)

    def _build(self, fleet: Fleet, times_s: Float64, generator: np.random.Generator) -> SceneParts:
        """Build static scenery, ego vehicle and actors."""
        # The layout has its own generator, so that traffic settings do not change it.
        (layout_generator,) = generator.spawn(1)
        hills = Hills(self.hill_height_std_m, layout_generator)
        num_lanes = self.num_lanes or int(layout_generator.choice([2, 4]))
        bay_m = PARAMS.bay_m if layout_generator.random() < PARAMS.bay_share else 0.0
        lane_m = float(layout_generator.uniform(*PARAMS.lane_m))
        section = CrossSection(num_lanes // 2, lane_m, bay_m, float(layout_generator.uniform(*PARAMS.sidewalk_m)))
        max_ride_m = 1.25 * self.speed_mps * (self.duration_s + PARAMS.warm_up_s)
        span_m, half_length_m = (-PARAMS.behind_m, max_ride_m + PARAMS.ahead_m), max_ride_m + 2 * PARAMS.ahead_m
        for _ in range(PARAMS.max_attempts):
            streets = sample_street_plan(
                section, self.max_bend_deg, self.turn_share, span_m, half_length_m, generator, layout_generator
            )
            lanes, agents = self._create_agents(streets, fleet, generator)
            flow = LaneSimulation(lanes, agents, streets.signals).run(times_s, PARAMS.warm_up_s)
            if is_usually_following(agents, flow):
                break
        # Only agents that come near the ego vehicle become actors.
        nearby = find_nearby_agents(lanes, agents, flow.lane_positions_m)
        lane_positions_m, agents = flow.lane_positions_m[:, nearby], [agents[index] for index in nearby]
        ego_path = lanes[agents[0].lane_index].centerline
        assert isinstance(ego_path, OffsetPath)  # like all lanes of a city
        first_m, last_m = ego_path.convert_distances_to_stations_m(lane_positions_m[[0, -1], 0])
        visible_span_m = (float(first_m) - PARAMS.behind_m, float(last_m) + PARAMS.ahead_m)
        margin_m = PARAMS.corridor_margin_m
        built_span_m = (visible_span_m[0] - margin_m, visible_span_m[1] + margin_m)
        bodies = compute_body_trajectories(lanes, agents, lane_positions_m)
        lift_pedestrians(bodies, lanes, agents, lane_positions_m, streets, fleet)
        remove_bodies_off_streets(bodies, lanes, agents, lane_positions_m, streets, built_span_m)
        ego = build_ego_actor(times_s, bodies, flow, 0, fleet.meshes[EGO], generator, hills)
        pedestrians = simulate_crossing_pedestrians(streets, flow, times_s, visible_span_m, fleet, generator)
        corridor = StreetCorridor(streets.main_alignment, built_span_m)
        densities = self.built_share, self.parked_share, self.roadside_density
        city = CityBuilder(streets, corridor, hills, fleet, *densities, generator, layout_generator)
        scenery = city.build_static_scenery(visible_span_m)
        return scenery, ego, build_nearby_actors(times_s, [bodies, pedestrians], ego, fleet, hills)

    def _create_agents(
        self, streets: StreetPlan, fleet: Fleet, generator: np.random.Generator
    ) -> tuple[list[Lane], list[Agent]]:
        """Create all lanes and all agents on them; the ego vehicle is the first agent."""
        drivers = {}
        for kind, (weight, speed_share, headway_s, acceleration_mps2) in DRIVER_PARAMS.items():
            driver = Driver(self.speed_mps * speed_share, headway_s=headway_s, acceleration_mps2=acceleration_mps2)
            drivers[kind] = (weight, driver)
        main_drivers = dict(drivers)
        if streets.main_street.turn_directions.any():
            del main_drivers["truck"]  # 16.5 m long: it does not stay in one lane in a turn
        pedestrians = {"adult": (5.0, PEDESTRIAN), "child": (1.0, PEDESTRIAN)}
        cross_per_km = self.cross_traffic_share * self.traffic_per_km
        end_m = 2 * streets.half_length_m
        # Agents that have left the junction of a cross street far behind do not come back.
        cross_end_m = streets.half_length_m + PARAMS.ahead_m
        lanes: list[Lane] = []
        lane_traffic: list[tuple[float, float, Mapping[str, tuple[float, Driver]]]] = []
        for group, lane_end_m, density_per_km, group_drivers in (
            (streets.build_traffic_lanes(), end_m, self.traffic_per_km, main_drivers),
            (streets.build_bicycle_lanes(), end_m, self.cyclists_per_km, {"cyclist": (1.0, CYCLIST)}),
            (streets.build_sidewalk_lanes(), end_m, self.people_per_km, pedestrians),
            (streets.build_cross_lanes(), cross_end_m, cross_per_km, drivers),
        ):
            lanes += group
            lane_traffic += [(lane_end_m, density_per_km, group_drivers)] * len(group)
        num_agents = sum(density_per_km * lane_end_m / 1000 for lane_end_m, density_per_km, _ in lane_traffic)
        check_traffic_memory(num_agents, self.num_time_steps)
        agents = self._create_ego_and_leader(streets, fleet, generator)
        for index, (lane_end_m, density_per_km, lane_drivers) in enumerate(lane_traffic):
            span_m, passages = (0.0, lane_end_m), lanes[index].passages
            agents += fleet.fill_lane(
                index, span_m, density_per_km, lane_drivers, passages=passages, existing_agents=agents[:2]
            )
        simulated_s = self.duration_s + self.time_step_s + PARAMS.warm_up_s
        return lanes, select_relevant_agents(lanes, agents, simulated_s)

    def _create_ego_and_leader(self, streets: StreetPlan, fleet: Fleet, generator: np.random.Generator) -> list[Agent]:
        """Create the ego vehicle in the middle of a lane of the main street, and a slower vehicle ahead of it."""
        lane, middle_m = int(generator.integers(streets.cross_section.lanes_per_direction)), streets.half_length_m
        kind = fleet.sample_kind({"suv": 1.0, "sedan": 2.0, "hatchback": 2.0, "van": 1.0})
        half_gap_m = PARAMS.leader_gap_m / 2
        leader = Driver(PARAMS.leader_speed_share * self.speed_mps)
        return [
            fleet.create_agent(EGO, lane, middle_m - half_gap_m, Driver(self.speed_mps, headway_s=1.1)),
            fleet.create_agent(kind, lane, middle_m + half_gap_m, leader),
        ]


def select_relevant_agents(lanes: Sequence[Lane], agents: Sequence[Agent], duration_s: float) -> list[Agent]:
    """Select the agents that can be visible or influence others.

    Agents depend on those ahead and on junctions, and none exceeds its desired speed. Agents that stay far before the
    first junction of their lane therefore change nothing.

    Args:
        lanes: Lanes.
        agents: Agents.
        duration_s: Duration of the simulation.

    Returns:
        The selected agents in the same order.
    """
    max_positions_m = [np.inf] * len(lanes)
    irrelevant = set()
    order = np.argsort([-agent.lane_position_m for agent in agents], kind="stable")
    for index in order.tolist():
        agent, lane = agents[index], agents[index].lane_index
        end_m = agent.lane_position_m + float(agent.driver.desired_speed_mps) * duration_s
        max_positions_m[lane] = min(max_positions_m[lane], end_m)
        if max_positions_m[lane] < lanes[lane].passages[0].stop_line_m - HORIZON_M:
            irrelevant.add(index)
    return [agent for index, agent in enumerate(agents) if index not in irrelevant]


def is_usually_following(agents: Sequence[Agent], flow: TrafficHistory) -> bool:
    """Test whether the first agent usually follows another vehicle on its lane.

    Args:
        agents: N agents.
        flow: Simulation.
    """
    lane_indices = np.array([agent.lane_index for agent in agents])
    neighbors = 1 + np.flatnonzero(lane_indices[1:] == lane_indices[0])
    distances_m = flow.lane_positions_m[:, neighbors] - flow.lane_positions_m[:, :1]
    is_following = ((distances_m > 0) & (distances_m < PARAMS.following_distance_m)).any(axis=1)
    return bool(is_following.mean() >= PARAMS.min_following_share)


def lift_pedestrians(
    bodies: BodyTrajectories,
    lanes: Sequence[Lane],
    agents: Sequence[Agent],
    lane_positions_m: Float64,
    streets: StreetPlan,
    fleet: Fleet,
) -> None:
    """Lift pedestrians along the main street onto the sidewalk in place, except where they cross other streets.

    Args:
        bodies: Trajectories of the N agents and their trailers; heights are changed.
        lanes: Lanes.
        agents: N agents.
        lane_positions_m: (T, N) positions along the lanes.
        streets: Streets.
        fleet: Sizes of the bodies.
    """
    radii_m = np.array([fleet.get_length_m(agent.kind) / 2 for agent in agents])
    lane_indices = np.array([agent.lane_index for agent in agents])
    # The sidewalk continues around turns.
    middles_m = streets.junction_stations_m[streets.has_lights]
    half_lengths_m = streets.main_street.junction_half_lengths_m[streets.has_lights]
    for lane in np.unique(lane_indices):
        path, on_lane = lanes[lane].centerline, np.flatnonzero(lane_indices == lane)
        assert isinstance(path, OffsetPath)
        is_walking = CATEGORIES.get(agents[on_lane[0]].kind) == "pedestrian"
        if path.street is not streets.main_alignment or not is_walking:
            continue
        edges_m = middles_m[:: path.direction] + np.array([[-1.0], [1.0]]) * half_lengths_m[:: path.direction]
        first_m, last_m = np.sort(path.convert_stations_to_distances_m(edges_m), axis=0)
        positions_m = lane_positions_m[:, on_lane]
        next_crossing = np.searchsorted(last_m, np.ascontiguousarray(positions_m.T)).T
        next_crossing = np.minimum(next_crossing, len(last_m) - 1)
        beyond_curb_m = np.minimum(positions_m - first_m[next_crossing], last_m[next_crossing] - positions_m)
        bodies.positions_m[:, on_lane, 2] = compute_step_height_m(beyond_curb_m, radii_m[on_lane])


def remove_bodies_off_streets(
    bodies: BodyTrajectories,
    lanes: Sequence[Lane],
    agents: Sequence[Agent],
    lane_positions_m: Float64,
    streets: StreetPlan,
    built_span_m: Bounds,
) -> None:
    """Set positions beyond the ends of cross streets and of the built main street to NaN, in place.

    Args:
        bodies: Trajectories of the N agents and their trailers.
        lanes: Lanes.
        agents: N agents.
        lane_positions_m: (T, N) positions along the lanes.
        streets: Streets.
        built_span_m: Stations of the main street that are built.
    """
    if streets.main_alignment.is_straight:
        # A straight street never comes near again and is built as far as its lanes go.
        built_span_m = (-2 * streets.half_length_m, 2 * streets.half_length_m)
    spans_by_street = {id(streets.main_alignment): np.array(built_span_m)}
    for street, span_m in zip(streets.cross_streets, streets.cross_street_spans_m, strict=True):
        spans_by_street[id(street)] = span_m
    min_m, max_m = np.empty((2, len(agents)))
    for index, agent in enumerate(agents):
        path = lanes[agent.lane_index].centerline
        assert isinstance(path, OffsetPath)
        min_m[index], max_m[index] = np.sort(path.convert_stations_to_distances_m(spans_by_street[id(path.street)]))
    is_outside = (lane_positions_m < min_m) | (lane_positions_m > max_m)
    bodies.positions_m[:, : len(agents)][is_outside] = np.nan
    # Trailers disappear with their towing vehicles.
    towing_x_m = bodies.positions_m[:, list(bodies.towing_indices), 0]
    bodies.positions_m[:, len(agents) :][np.isnan(towing_x_m)] = np.nan


def simulate_crossing_pedestrians(
    streets: StreetPlan,
    flow: TrafficHistory,
    times_s: Float64,
    visible_span_m: Bounds,
    fleet: Fleet,
    generator: np.random.Generator,
) -> BodyTrajectories:
    """Simulate pedestrians on both crossings of the main street at each visible junction with signals.

    Args:
        streets: Streets.
        flow: Simulation with the occupied phases of the junctions.
        times_s: (T,) evenly spaced times.
        visible_span_m: First and last visible station of the main street.
        fleet: Bodies.
        generator: Random generator.
    """
    wait_m = streets.cross_section.curb_offset_m + STREETS.wait_offset_m
    traversal_s = 2 * wait_m / float(PEDESTRIAN.desired_speed_mps)
    remaining_s = streets.signals.compute_remaining_green_s(times_s)[..., CROSS] + streets.signals.yellow_s
    can_start = (remaining_s > traversal_s) & ~flow.occupied_phases[:, :, MAIN]
    stations_m = streets.junction_stations_m
    is_visible = (stations_m > visible_span_m[0]) & (stations_m < visible_span_m[1])
    pedestrians = []
    for index in np.flatnonzero(is_visible & streets.has_lights):
        for side in (1, -1):
            for footpath_m in STREETS.footpaths_m:
                offset_m = streets.main_street.junction_half_lengths_m[index] + footpath_m
                kind = fleet.sample_kind({"adult": 5.0, "child": 1.0})
                ends = streets.main_alignment.compute_poses(
                    stations_m[index] + side * offset_m, np.array([-wait_m, wait_m])
                )
                path = Footpath(ends[0, :2], ends[1, :2], STREETS.wait_offset_m)
                radius_m = fleet.get_length_m(kind) / 2
                poses = simulate_walking(path, can_start[:, index], traversal_s, times_s, radius_m, generator)
                pedestrians.append((*poses, kind))
    return BodyTrajectories.from_bodies(pedestrians)
