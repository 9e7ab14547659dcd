"""City traffic: the ego vehicle follows a main street with bends, turns, parked cars and pedestrians."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from pydantic import Field

from torchcover.geometry.arrays import Float64
from torchcover.simulation.traffic.alignment import OffsetPath, StreetCorridor
from torchcover.simulation.traffic.assemble import (
    HORIZON_M,
    BodyTrajectories,
    Footpath,
    build_ego_actor,
    build_nearby_actors,
    compute_body_trajectories,
    compute_step_height_m,
    find_nearby_agents,
    simulate_walking,
)
from torchcover.simulation.traffic.city import CityBuilder
from torchcover.simulation.traffic.fleet import CATEGORIES, CYCLIST, EGO, PEDESTRIAN, Fleet
from torchcover.simulation.traffic.flow import (
    CROSS,
    MAIN,
    Agent,
    Lane,
    LaneSimulation,
    TrafficHistory,
    check_traffic_memory,
)
from torchcover.simulation.traffic.frontage import RoadsideDensity
from torchcover.simulation.traffic.hills import Hills
from torchcover.simulation.traffic.idm import Driver
from torchcover.simulation.traffic.kind import PeoplePerKm, ProceduralTraffic, SceneParts, VehiclesPerKm
from torchcover.simulation.traffic.streets import (
    FOOTPATHS_M,
    WAITING_BEHIND_KERB_M,
    CrossSection,
    StreetPlan,
    sample_street_plan,
)

WARM_UP_S = 20.0
# What is built up or has traffic, behind and ahead of all places the ego gets to.
BEHIND_M, AHEAD_M = 120.0, 260.0
# Stretches of the street that lie farther along it than this are not built, even where they come near again.
ASIDE_M = 320.0
# Widths of the main street, and the share of cities with parking bays along it.
LANE_M, BAY_M, SIDEWALK_M, WITH_BAYS = (3.25, 3.75), 2.3, (3.2, 5.0), 0.8
# The ego starts this far behind the vehicle it follows, which is a little slower.
LEADER_AHEAD_M = 20.0
LEADER_SPEED = 0.82
# A light may part the two for good; a run in which the ego is alone for most of the time is drawn again, some times.
FOLLOWS_WITHIN_M = 40.0
FOLLOWS_SHARE = 0.6
DRAWS = 5
# Weight, desired speed as a share of the usual one, headway, acceleration when starting.
DRIVING = {
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
        # What the streets are like is drawn apart from what happens in them.
        (shapes,) = generator.spawn(1)
        hills, lanes_of_both = Hills(self.hill_height_std_m, shapes), self.num_lanes or int(shapes.choice([2, 4]))
        bay_m = BAY_M if shapes.random() < WITH_BAYS else 0.0
        widths_m = float(shapes.uniform(*LANE_M)), bay_m, float(shapes.uniform(*SIDEWALK_M))
        section = CrossSection(lanes_of_both // 2, *widths_m)
        longest_way = 1.25 * self.speed_mps * (self.duration_s + WARM_UP_S)
        span_m, reach_m = (-BEHIND_M, longest_way + AHEAD_M), longest_way + 2 * AHEAD_M
        for _ in range(DRAWS):
            streets = sample_street_plan(
                section, self.max_bend_deg, self.turn_share, span_m, reach_m, generator, shapes
            )
            lanes, agents = self._traffic(streets, fleet, generator)
            flow = LaneSimulation(lanes, agents, streets.signals).run(times_s, WARM_UP_S)
            if _usually_follows(agents, flow):
                break
        near = find_nearby_agents(lanes, agents, flow.lane_positions_m)
        place_m, agents = flow.lane_positions_m[:, near], [agents[number] for number in near]
        own_lane = lanes[agents[0].lane_index].centerline
        assert isinstance(own_lane, OffsetPath)  # as all lanes of a city are
        first_m, last_m = own_lane.convert_distances_to_stations_m(place_m[[0, -1], 0])
        seen = (float(first_m) - BEHIND_M, float(last_m) + AHEAD_M)
        built = (seen[0] - ASIDE_M, seen[1] + ASIDE_M)
        territory = StreetCorridor(streets.main_alignment, built)
        moving = _in_place(
            compute_body_trajectories(lanes, agents, place_m), lanes, agents, place_m, streets, built, fleet
        )
        driver = build_ego_actor(times_s, moving, flow, 0, fleet.meshes[EGO], generator, hills)
        crossing = _crossers(streets, flow, times_s, seen, fleet, generator)
        city = CityBuilder(
            streets,
            territory,
            hills,
            fleet,
            self.parked_share,
            self.built_share,
            self.roadside_density,
            generator,
            shapes,
        )
        static = city.build_static_scenery(seen)
        return static, driver, build_nearby_actors(times_s, [moving, crossing], driver, fleet, hills)

    def _traffic(
        self, streets: StreetPlan, fleet: Fleet, generator: np.random.Generator
    ) -> tuple[list[Lane], list[Agent]]:
        """Everybody who follows a lane; the ego is the first."""
        main, bicycles, cross = (
            streets.build_traffic_lanes(),
            streets.build_bicycle_lanes(),
            streets.build_cross_lanes(),
        )
        sidewalks = streets.build_sidewalk_lanes()
        lanes = [*main, *bicycles, *sidewalks, *cross]
        driving = {
            kind: (weight, Driver(self.speed_mps * pace, headway_s=headway, acceleration_mps2=starting))
            for kind, (weight, pace, headway, starting) in DRIVING.items()
        }
        # Trucks of 16.5 m do not get round a corner in one lane.
        turning = (
            driving
            if not streets.main_street.turn_directions.any()
            else {k: v for k, v in driving.items() if k != "truck"}
        )
        per_lane = [
            *[(self.traffic_per_km, turning)] * len(main),
            *[(self.cyclists_per_km, {"cyclist": (1.0, CYCLIST)})] * len(bicycles),
            *[(self.people_per_km, {"adult": (5.0, PEDESTRIAN), "child": (1.0, PEDESTRIAN)})] * len(sidewalks),
            *[(self.cross_traffic_share * self.traffic_per_km, driving)] * len(cross),
        ]
        # Who has left a cross street's junction far behind does not come back.
        ends_m = [2 * streets.half_length_m] * (len(lanes) - len(cross)) + [streets.half_length_m + AHEAD_M] * len(
            cross
        )
        check_traffic_memory(
            sum(per_km * end / 1000 for (per_km, _), end in zip(per_lane, ends_m, strict=True)), self.num_time_steps
        )
        agents = self._ego_and_leader(streets, fleet, generator)
        for index, ((per_km, drivers), end) in enumerate(zip(per_lane, ends_m, strict=True)):
            agents += fleet.fill_lane(
                index, (0.0, end), per_km, drivers, passages=lanes[index].passages, existing_agents=agents[:2]
            )
        return lanes, _who_matter(lanes, agents, self.duration_s + self.time_step_s + WARM_UP_S)

    def _ego_and_leader(self, streets: StreetPlan, fleet: Fleet, generator: np.random.Generator) -> list[Agent]:
        lane, middle = int(generator.integers(streets.cross_section.lanes_per_direction)), streets.half_length_m
        kind = fleet.sample_kind({"suv": 1.0, "sedan": 2.0, "hatchback": 2.0, "van": 1.0})
        return [
            fleet.create_agent(EGO, lane, middle - LEADER_AHEAD_M / 2, Driver(self.speed_mps, headway_s=1.1)),
            fleet.create_agent(kind, lane, middle + LEADER_AHEAD_M / 2, Driver(LEADER_SPEED * self.speed_mps)),
        ]


def _who_matter(lanes: list[Lane], agents: list[Agent], duration_s: float) -> list[Agent]:
    """Leave out those who stay so far before the first junction of their lane that nobody sees them or waits for them.

    What somebody does depends on those ahead and on junctions; nobody overtakes, nor is faster than they want to be.
    """
    last_m, left_out = [np.inf] * len(lanes), set()
    for agent in sorted(agents, key=lambda agent: agent.lane_position_m, reverse=True):
        gets_to_m = agent.lane_position_m + float(agent.driver.desired_speed_mps) * duration_s
        last_m[agent.lane_index] = min(last_m[agent.lane_index], gets_to_m)
        if last_m[agent.lane_index] < lanes[agent.lane_index].passages[0].stop_line_m - HORIZON_M:
            left_out.add(agent)
    return [agent for agent in agents if agent not in left_out]


def _usually_follows(agents: list[Agent], flow: TrafficHistory) -> bool:
    """Whether in most frames somebody is close ahead of the first agent on its lane."""
    same_lane = [index for index, agent in enumerate(agents) if agent.lane_index == agents[0].lane_index and index > 0]
    ahead = flow.lane_positions_m[:, same_lane] - flow.lane_positions_m[:, :1]
    close = ((ahead > 0) & (ahead < FOLLOWS_WITHIN_M)).any(axis=1)
    return bool(close.mean() >= FOLLOWS_SHARE)


def _in_place(
    found: BodyTrajectories,
    lanes: Sequence[Lane],
    agents: Sequence[Agent],
    place_m: Float64,
    streets: StreetPlan,
    built_m: tuple[float, float],
    fleet: Fleet,
) -> BodyTrajectories:
    """Lift those who walk along the main street onto the pavement, and let them step down at the cross streets.

    And let nobody be where their cross street ends, nor where the main street is not built.
    """
    junction = {id(street): index for index, street in enumerate(streets.cross_streets)}
    ends_m = streets.cross_street_spans_m
    if streets.main_alignment.is_straight:  # it never comes back
        built_m = (-2 * streets.half_length_m, 2 * streets.half_length_m)
    radius_m = np.array([fleet.get_length_m(agent.kind) / 2 for agent in agents])
    lane_of = np.array([agent.lane_index for agent in agents])
    within_m = np.empty((2, len(agents)))
    for lane in np.unique(lane_of):
        line, on_lane = lanes[lane].centerline, np.flatnonzero(lane_of == lane)
        assert isinstance(line, OffsetPath)
        of_main = line.street is streets.main_alignment
        within_m[:, on_lane] = np.sort(
            line.convert_stations_to_distances_m(built_m if of_main else ends_m[junction[id(line.street)]])
        )[:, None]
        if of_main and CATEGORIES.get(agents[on_lane[0]].kind) == "pedestrian":
            # In a turn the pavement goes on.
            stop = streets.has_lights
            middles_m, halves_m = (
                streets.junction_stations_m[stop][:: line.direction],
                streets.main_street.junction_half_lengths_m[stop][:: line.direction],
            )
            places_m = place_m[:, on_lane]
            first_m, last_m = np.sort(
                line.convert_stations_to_distances_m(middles_m + np.array([[-1.0], [1.0]]) * halves_m), axis=0
            )
            next_one = np.minimum(np.searchsorted(last_m, np.ascontiguousarray(places_m.T)).T, len(last_m) - 1)
            beyond_kerb_m = np.minimum(places_m - first_m[next_one], last_m[next_one] - places_m)
            found.positions_m[:, on_lane, 2] = compute_step_height_m(beyond_kerb_m, radius_m[on_lane])
    found.positions_m[:, : len(agents)][(place_m < within_m[0]) | (place_m > within_m[1])] = np.nan
    rears = found.positions_m[:, len(agents) :]
    rears[np.isnan(found.positions_m[:, list(found.towing_indices), 0])] = np.nan
    return found


def _crossers(
    streets: StreetPlan,
    flow: TrafficHistory,
    times_s: Float64,
    seen_m: tuple[float, float],
    fleet: Fleet,
    generator: np.random.Generator,
) -> BodyTrajectories:
    """People who go to and fro across the main street, on both crossings of each junction with lights in sight."""
    found = []
    wait_m = streets.cross_section.curb_offset_m + WAITING_BEHIND_KERB_M
    walks = 2 * wait_m / float(PEDESTRIAN.desired_speed_mps)
    green = streets.signals.compute_remaining_green_s(times_s)[..., CROSS]
    may_go = (green + streets.signals.yellow_s > walks) & ~flow.occupied_phases[:, :, MAIN]
    seen = (streets.junction_stations_m > seen_m[0]) & (streets.junction_stations_m < seen_m[1])
    for index in np.flatnonzero(seen & streets.has_lights):
        for side in (1, -1):
            for offset in FOOTPATHS_M:
                x = streets.junction_stations_m[index] + side * (
                    streets.main_street.junction_half_lengths_m[index] + offset
                )
                kind = fleet.sample_kind({"adult": 5.0, "child": 1.0})
                ends = streets.main_alignment.compute_poses(x, np.array([-wait_m, wait_m]))[:, :2]
                path = Footpath(ends[0], ends[1], WAITING_BEHIND_KERB_M)
                walked = simulate_walking(
                    path, may_go[:, index], walks, times_s, fleet.get_length_m(kind) / 2, generator
                )
                found.append((*walked, kind))
    return BodyTrajectories.from_bodies(found)
