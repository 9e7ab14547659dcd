"""Motorway traffic: vehicles that overtake, enter and exit on a road with gentle curves and grades."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from torchcover.geometry.arrays import Float64
from torchcover.simulation.traffic.alignment import Alignment
from torchcover.simulation.traffic.assemble import (
    HORIZON_M,
    BodyTrajectories,
    build_ego_actor,
    build_nearby_actors,
    get_center_offsets_m,
)
from torchcover.simulation.traffic.fleet import BODY_KINDS, EGO, HEAVY_KINDS, Fleet
from torchcover.simulation.traffic.flow import Agent, TrafficHistory, check_traffic_memory
from torchcover.simulation.traffic.hills import Hills
from torchcover.simulation.traffic.idm import Driver
from torchcover.simulation.traffic.kind import ProceduralTraffic, SceneParts, VehiclesPerKm
from torchcover.simulation.traffic.motorway import MOTORWAY, AuxiliaryLane, build_roadside
from torchcover.simulation.traffic.overtaking import LANES, RAMP_MPS, SIDE_LANE, LaneChangeSimulation


@dataclass(frozen=True)
class MotorwayTrafficParams:
    """Course of a motorway and extent of its traffic.

    Args:
        warm_up_s: Duration before the run, in which platoons form behind slow vehicles.
        behind_m: Extent of the scenery behind the ego vehicle.
        ahead_m: Extent of the scenery and of the traffic ahead of the ego vehicle.
        horizon_margin_m: Addition to the horizon: vehicles on the inside of a curve are nearer than their stations say.
        min_speed_mps: Speed of the slowest vehicles; lanes are filled as far as their vehicles can come near the ego
            vehicle.
        max_ego_speed_mps: Upper bound of the speed of the ego vehicle.
        max_speed_mps: Speed of the fastest vehicles.
        bend_deg: Smallest and largest amplitude of the heading; with the wavelengths, radii are 1.5 to 4 km.
        bend_wavelengths_m: Shortest and longest wavelength of the bends.
        curvature_spacing_m: Distance of the stations at which curvature and slope are given.
        hill_wavelengths_m: Shortest and longest wavelength of the hills.
        max_grade: Largest slope.
        auxiliary_lane_m: Shortest and longest auxiliary lane.
        leader_gap_m: Distance of the vehicle ahead of the ego vehicle, center to center.
        ego_speed_mps: Desired speed of the ego vehicle.
        leader_speed_mps: Desired speed of the vehicle ahead.
        speed_spread: Largest relative deviation of desired speeds.
        heavy_speed_spread: The same for trucks and buses: no two differ by enough to overtake.
        exit_share: Share of the vehicles next to the auxiliary lane that exit.
        ramp_density_share: Density of traffic on ramps, as a share of that on lanes.
    """

    warm_up_s: float = 30.0
    behind_m: float = 150.0
    ahead_m: float = 300.0
    horizon_margin_m: float = 15.0
    min_speed_mps: float = 22.0
    max_ego_speed_mps: float = 36.0
    max_speed_mps: float = 40.0
    bend_deg: tuple[float, float] = (4.0, 8.0)
    bend_wavelengths_m: tuple[float, float] = (1400.0, 2200.0)
    curvature_spacing_m: float = 50.0
    hill_wavelengths_m: tuple[float, float] = (1000.0, 2500.0)
    max_grade: float = 0.04
    auxiliary_lane_m: tuple[float, float] = (450.0, 700.0)
    leader_gap_m: float = 45.0
    ego_speed_mps: float = 34.0
    leader_speed_mps: float = 29.0
    speed_spread: float = 0.09
    heavy_speed_spread: float = 0.02
    exit_share: float = 0.15
    ramp_density_share: float = 0.6


PARAMS = MotorwayTrafficParams()
# Trucks have speed limiters at 90 km/h and are allowed to drive 80 km/h; they drive between both.
TRUCK_DRIVER = Driver(23.6, 1.6, 3.0, 0.6)
# Weight and typical driver of each kind on each lane, from the median to the auxiliary lane.
LANE_USERS = (
    {"sedan": (4.0, Driver(35.0)), "suv": (3.0, Driver(34.5)), "motorcycle": (0.4, Driver(35.0))},
    {"sedan": (4.0, Driver(32.0)), "hatchback": (4.0, Driver(31.0)), "suv": (3.0, Driver(32.0)),
     "pickup": (0.5, Driver(31.0)), "van": (2.0, Driver(29.5)), "bus": (0.4, Driver(27.0, 1.5, 3.0, 0.8))},
    {"truck": (3.0, TRUCK_DRIVER), "lorry": (1.0, TRUCK_DRIVER), "hatchback": (2.0, Driver(30.0)),
     "van": (1.5, Driver(29.0))},
    {"truck": (0.7, TRUCK_DRIVER), "lorry": (0.3, TRUCK_DRIVER), "sedan": (2.0, Driver(31.0)),
     "hatchback": (2.0, Driver(30.0)), "van": (1.0, Driver(29.0))},
)  # fmt: skip


class HighwayTraffic(ProceduralTraffic):
    """Traffic on a motorway.

    Args:
        traffic_per_km: Vehicles per kilometer of lane.
        ego_lane: Lane in which the ego vehicle starts: 1 is next to the shoulder, 3 next to the median.
        hill_height_std_m: Standard deviation of the ground height; 0 is a plane. Grades stay below 4 %.
    """

    type: Literal["highway"] = "highway"
    traffic_per_km: VehiclesPerKm = 12.0
    ego_lane: int = Field(default=2, ge=1, le=3)
    hill_height_std_m: float = Field(default=3.0, ge=0.0, le=10.0)

    def _build(self, fleet: Fleet, times_s: Float64, generator: np.random.Generator) -> SceneParts:
        """Build static scenery, ego vehicle and actors."""
        # The layout has its own generator, so that traffic settings do not change it.
        (layout_generator,) = generator.spawn(1)
        hills = Hills(self.hill_height_std_m, layout_generator, PARAMS.hill_wavelengths_m, PARAMS.max_grade)
        median, auxiliary_lanes = self._sample_median(layout_generator), []
        # The auxiliary lane begins where the vehicle ahead of the ego vehicle is at a random time of the run.
        for _ in range(2):
            ride_s = PARAMS.warm_up_s + layout_generator.uniform(0.0, 0.8) * self.duration_s
            begin_m = PARAMS.leader_speed_mps * ride_s
            length_m = float(layout_generator.uniform(*PARAMS.auxiliary_lane_m))
            auxiliary_lanes.append(AuxiliaryLane(begin_m, begin_m + length_m))
        right, left = auxiliary_lanes
        # Positions along the second direction are stations with the opposite sign.
        auxiliary_spans_m = np.array([right, (-left.end_m, -left.begin_m)])
        agents = self._create_agents(auxiliary_spans_m, fleet)
        is_heavy = np.array([BODY_KINDS.get(agent.kind) in HEAVY_KINDS for agent in agents])
        is_next_to_exit = np.array([agent.lane_index % LANES == SIDE_LANE - 1 for agent in agents])
        is_exiting = (generator.random(len(agents)) < PARAMS.exit_share) & is_next_to_exit
        # The ego vehicle stays on the motorway.
        is_exiting[0] = False
        stations_m = np.arange(median.stations_m[0], median.stations_m[-1], PARAMS.curvature_spacing_m)
        heights_m = hills.compute_heights_m(median.compute_poses(stations_m, 0.0)[:, :2])
        slope_profile = np.stack([stations_m, np.gradient(heights_m, PARAMS.curvature_spacing_m)])
        simulation = LaneChangeSimulation(agents, is_heavy, is_exiting, auxiliary_spans_m, generator, slope_profile)
        flow = simulation.run(times_s, PARAMS.warm_up_s)
        bodies = compute_nearby_trajectories(median, auxiliary_lanes, agents, simulation, flow)
        ego = build_ego_actor(times_s, bodies, flow, 0, fleet.meshes[EGO], generator, hills)
        first_m, last_m = float(flow.lane_positions_m[0, 0]), float(flow.lane_positions_m[-1, 0])
        visible_span_m = (first_m - PARAMS.behind_m, last_m + PARAMS.ahead_m)
        scenery = build_roadside(median, {-1: right, 1: left}, hills, visible_span_m, layout_generator)
        return scenery, ego, build_nearby_actors(times_s, [bodies], ego, fleet, hills)

    @property
    def _simulated_s(self) -> float:
        """Duration of the simulation with the warm-up."""
        return self.duration_s + self.time_step_s + PARAMS.warm_up_s

    def _sample_median(self, generator: np.random.Generator) -> Alignment:
        """Sample the alignment of the median; the ego vehicle starts near station 0."""
        first_m = -PARAMS.max_speed_mps * PARAMS.warm_up_s
        last_m = PARAMS.max_ego_speed_mps * self._simulated_s + 4 * PARAMS.ahead_m
        stations_m = np.arange(first_m, last_m, PARAMS.curvature_spacing_m)
        amplitude_rad = np.deg2rad(generator.uniform(*PARAMS.bend_deg))
        wavelength_m = generator.uniform(*PARAMS.bend_wavelengths_m)
        phases = 2 * np.pi * (stations_m / wavelength_m + generator.random())
        curvatures_per_m = amplitude_rad * 2 * np.pi / wavelength_m * np.cos(phases)
        # An alignment is straight outside of its stations.
        curvatures_per_m[[0, -1]] = 0.0
        return Alignment(stations_m, curvatures_per_m, (first_m, 0.0, float(amplitude_rad * np.sin(phases[0]))))

    def _create_agents(self, auxiliary_spans_m: Float64, fleet: Fleet) -> list[Agent]:
        """Create all agents: the ego vehicle, the vehicle ahead of it in its lane, then all others."""
        ego_lane, simulated_s = 3 - self.ego_lane, self._simulated_s
        leader_body = fleet.sample_kind({kind: weight for kind, (weight, _) in LANE_USERS[ego_lane].items()})
        leader = Driver(PARAMS.leader_speed_mps)
        if BODY_KINDS[leader_body] in HEAVY_KINDS:
            leader = LANE_USERS[ego_lane][BODY_KINDS[leader_body]][1]
        half_gap_m = PARAMS.leader_gap_m / 2
        agents = [
            fleet.create_agent(EGO, ego_lane, -half_gap_m, Driver(PARAMS.ego_speed_mps, headway_s=1.0)),
            fleet.create_agent(leader_body, ego_lane, half_gap_m, leader),
        ]
        # Extent of visible vehicles, and of the oncoming vehicles that meet them.
        same_m = (PARAMS.max_ego_speed_mps - PARAMS.min_speed_mps) * simulated_s + PARAMS.ahead_m
        oncoming_start_m = 2 * PARAMS.min_speed_mps * PARAMS.warm_up_s - PARAMS.ahead_m
        oncoming_end_m = (PARAMS.max_ego_speed_mps + PARAMS.max_speed_mps) * simulated_s + PARAMS.ahead_m
        lane_spans_m = []
        for direction_span_m, (begin_m, _) in zip(
            [(-same_m, same_m), (-oncoming_end_m, -oncoming_start_m)], auxiliary_spans_m.tolist(), strict=True
        ):
            lane_spans_m += [direction_span_m] * SIDE_LANE + [(begin_m - RAMP_MPS * simulated_s, begin_m)]
        density_shares = [1.0, 1.0, 1.0, PARAMS.ramp_density_share] * 2
        weighted_lengths_m = [
            share * np.ptp(span_m) for share, span_m in zip(density_shares, lane_spans_m, strict=True)
        ]
        check_traffic_memory(self.traffic_per_km * sum(weighted_lengths_m) / 1000, self.num_time_steps)
        for lane, (share, span_m) in enumerate(zip(density_shares, lane_spans_m, strict=True)):
            agents += fleet.fill_lane(
                lane,
                span_m,
                share * self.traffic_per_km,
                LANE_USERS[lane % LANES],
                existing_agents=agents[:2],
                speed_spread=PARAMS.speed_spread,
                heavy_speed_spread=PARAMS.heavy_speed_spread,
            )
        return agents


def compute_nearby_trajectories(
    median: Alignment,
    auxiliary_lanes: list[AuxiliaryLane],
    agents: list[Agent],
    simulation: LaneChangeSimulation,
    flow: TrafficHistory,
) -> BodyTrajectories:
    """Compute the poses of all vehicles that come near the ego vehicle, which is the first agent.

    Args:
        median: Alignment of the median.
        auxiliary_lanes: Auxiliary lane of each direction.
        agents: N agents.
        simulation: Simulation with the lane changes.
        flow: Positions along the lanes.
    """
    directions = np.array([1.0 if agent.lane_index < LANES else -1.0 for agent in agents])
    stations_m = flow.lane_positions_m * directions
    is_near = np.abs(stations_m - stations_m[:, :1]) < HORIZON_M + PARAMS.horizon_margin_m
    nearby = np.flatnonzero(is_near.any(axis=0))
    directions, kinds = directions[nearby], tuple(agents[agent].kind for agent in nearby)
    stations_m = stations_m[:, nearby] + directions * get_center_offsets_m(kinds)
    # Distances to the right of the median in the direction of travel, and their derivatives along the lane.
    right_m, slope = np.empty((2, *stations_m.shape))
    for column, agent in enumerate(nearby.tolist()):
        path_m = stations_m[:, column]
        right_m[:, column], slope[:, column] = compute_lane_offsets_m(path_m, agents[agent].lane_index, auxiliary_lanes)
        for change in simulation.lane_changes:
            if change.agent_index == agent:
                progress, progress_per_m = change.compute_progress(flow.lane_positions_m[:, agent])
                old_m, old_slope = compute_lane_offsets_m(path_m, change.old_lane_index, auxiliary_lanes)
                new_m, new_slope = compute_lane_offsets_m(path_m, change.new_lane_index, auxiliary_lanes)
                right_m[:, column] += progress * (new_m - old_m)
                slope[:, column] += progress * (new_slope - old_slope) + progress_per_m * (new_m - old_m)
    poses = interpolate_median_poses(median, stations_m)
    yaw_rad = np.deg2rad(poses[..., 2])
    positions_m = np.zeros(poses.shape)
    positions_m[..., 0] = poses[..., 0] + directions * right_m * np.sin(yaw_rad)
    positions_m[..., 1] = poses[..., 1] - directions * right_m * np.cos(yaw_rad)
    yaw_deg = poses[..., 2] + np.where(directions > 0, 0.0, 180.0) - np.rad2deg(np.arctan(slope))
    return BodyTrajectories(positions_m, yaw_deg, kinds).add_trailers()


def compute_lane_offsets_m(
    stations_m: Float64, lane_index: int, auxiliary_lanes: list[AuxiliaryLane]
) -> tuple[Float64 | float, Float64 | float]:
    """Compute the distance of a lane from the median.

    Args:
        stations_m: (T,) stations.
        lane_index: Index of the lane, see `LaneChangeSimulation`.
        auxiliary_lanes: Auxiliary lane of each direction.

    Returns:
        (T,) distances in meters, and (T,) their derivatives along the direction of travel.
    """
    center_m = MOTORWAY.lane_centers_m[lane_index % LANES]
    if lane_index % LANES != SIDE_LANE:
        return center_m, 0.0
    ramp_offset_m, slope = auxiliary_lanes[lane_index // LANES].compute_offsets_m(stations_m)
    return center_m + ramp_offset_m, slope if lane_index < LANES else -slope


def interpolate_median_poses(median: Alignment, stations_m: Float64, spacing_m: float = 2.0) -> Float64:
    """Interpolate poses (..., 3) of the median at many stations (...), within a third of a millimeter.

    Args:
        median: Alignment of the median.
        stations_m: (...) stations.
        spacing_m: Distance of the stations at which poses are computed.
    """
    first_m, last_m = float(stations_m.min()), float(stations_m.max())
    table = median.compute_poses(np.arange(first_m, last_m + 2 * spacing_m, spacing_m), 0.0)
    index = (stations_m - first_m) / spacing_m
    lower = index.astype(np.int64)
    poses = table.take(lower, axis=0)
    poses += (index - lower)[..., None] * np.diff(table, axis=0, append=0.0).take(lower, axis=0)
    return poses
