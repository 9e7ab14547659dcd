"""A motorway: lanes with overtaking, ramps, gentle curves and grades, guard rails, bridges and sign gantries.

What stands along it is built as if the road were straight and level, and then bent with it.
"""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from torchcover.geometry.arrays import Bools, Float64
from torchcover.simulation.shapes import Mesh, build_prism_faces
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
from torchcover.simulation.traffic.hills import Hills, bend_along_street
from torchcover.simulation.traffic.idm import Driver
from torchcover.simulation.traffic.kind import ProceduralTraffic, SceneParts, VehiclesPerKm
from torchcover.simulation.traffic.overtaking import LANES, RAMP_MPS, SIDE_LANE, LaneChangeSimulation
from torchcover.simulation.traffic.scenery import (
    Scenery,
    build_box_from_bounds,
    build_ground_plane,
    build_post,
    build_tree,
    merge_by_kind,
)

# Across the road, from the middle of the median; the last is the side lane, on which one enters and exits.
LANE_M = 3.6
LANE_CENTRES_M = np.array([4.6, 8.2, 11.8, 15.4])
LANES_END_M = 13.6
MEDIAN_RAIL_M = 1.3
DELINEATOR_M = 16.2
RAIL_M = 16.8
GANTRY_POST_M = 18.0
SOUND_WALL_M = 19.5
TREES_M = (24.0, 45.0)
# Ramps turn away over such a length to such a curvature, and go straight on; there are rails along them so far.
RAMP_BENDS_M, RAMP_PER_M = 100.0, 1 / 500.0
RAMP_ENDS_M = 60.0

# A W-beam: its upper edge is 0.75 m up, and posts stand at the joints.
RAIL_HEIGHTS_M = (0.44, 0.75)
RAIL_THICKNESS_M = 0.08
RAIL_PIECE_M = 12.0
DELINEATOR_EVERY_M = 50.0
STRUCTURE_EVERY_M = (350.0, 600.0)
CLEARANCE_M = 5.4
NO_TREES_NEAR_BRIDGE_M = 25.0
GROUND_M, SQUARE_M = 320.0, 20.0


class AuxiliaryLane(NamedTuple):
    """The stations between which the side lane of a direction lies beside the others; at both ends ramps lead away."""

    begin_m: float
    end_m: float

    def compute_offsets_m(self, stations_m: ArrayLike) -> tuple[Float64, Float64]:
        """(...) how much farther out than that it is at stations, and how much more after each metre."""
        stations = np.asarray(stations_m, dtype=np.float64)
        beyond = np.maximum(np.maximum(self.begin_m - stations, stations - self.end_m), 0.0)
        bent, straight_on = np.minimum(beyond, RAMP_BENDS_M), np.maximum(beyond - RAMP_BENDS_M, 0.0)
        slope = RAMP_PER_M * bent**2 / (2 * RAMP_BENDS_M)
        away = RAMP_PER_M * bent**3 / (6 * RAMP_BENDS_M) + slope * straight_on
        return away, np.copysign(slope, stations - self.end_m)

    def is_inside(self, stations_m: ArrayLike, left_m: ArrayLike) -> Bools:
        """(...) whether what reaches so far from the middle stays between the other lanes and the ramp."""
        return np.asarray(self.compute_offsets_m(stations_m)[0] > np.asarray(left_m) - LANES_END_M + 1.0)

    def find_clear_offsets_m(self, stations_m: ArrayLike, left_m: ArrayLike, width_m: float = 0.5) -> Float64:
        """(...) how far from the middle things stand: on the outside of the ramp if there is no room before it."""
        outside_m = np.asarray(left_m) + LANE_M + self.compute_offsets_m(stations_m)[0]
        return np.where(self.is_inside(stations_m, np.asarray(left_m) + width_m), left_m, outside_m)


def build_roadside(
    median_alignment: Alignment,
    auxiliary_lanes: dict[int, AuxiliaryLane],
    hills: Hills,
    span_m: tuple[float, float],
    generator: np.random.Generator,
) -> Scenery:
    """The ground, and what stands along the part of the road from one station to another.

    `median_alignment` is that of the median, `auxiliary_lanes` are the side lanes on the left (1) and on the right (-1).
    """
    way_m = median_alignment.compute_poses(np.arange(span_m[0], span_m[1] + 50.0, 50.0), 0.0)[:, :2]
    plain = (way_m.min(axis=0) - GROUND_M, way_m.max(axis=0) + GROUND_M)
    structures, bridges = _structures(auxiliary_lanes, span_m, generator)
    stands = (
        _rails(auxiliary_lanes, span_m),
        _delineators(auxiliary_lanes, span_m),
        structures,
        _sound_walls(auxiliary_lanes, span_m, generator),
        _trees(auxiliary_lanes, span_m, bridges, generator),
    )
    level = build_ground_plane(*plain) if hills.is_flat else hills.build_mesh(way_m, GROUND_M, SQUARE_M)
    return Scenery(
        (level, *merge_by_kind(*(bend_along_street(median_alignment, hills, pieces) for pieces in stands))), (0,)
    )


def _prisms(outlines_m: Float64, z_m: tuple[float, float]) -> Mesh:
    """Closed bodies over (N, K, 2) convex outlines, counter-clockwise."""
    count, corners, _ = outlines_m.shape
    vertices = np.empty((count, 2, corners, 3))
    vertices[..., :2] = outlines_m[:, None]
    vertices[..., 2] = np.reshape(z_m, (2, 1))
    faces = build_prism_faces(2, corners) + 2 * corners * np.arange(count)[:, None, None]
    return Mesh(vertices.reshape(-1, 3), faces.reshape(-1, 3)).assign_material("metal")


def _wall(x_m: Float64, y_m: Float64, there: Bools, width_m: float, z_m: tuple[float, float]) -> list[Mesh]:
    """A rail or wall through (K,) places: a straight piece between each two that are there."""
    here, ahead = (np.stack([x_m, y_m], axis=1)[ends] for ends in (slice(-1), slice(1, None)))
    aside = np.array([0.0, width_m / 2])
    outlines = np.stack([here - aside, ahead - aside, ahead + aside, here + aside], axis=1)[there[1:] & there[:-1]]
    return [_prisms(outlines, z_m)] if len(outlines) else []


def _rails(sides: dict[int, AuxiliaryLane], span_m: tuple[float, float]) -> list[Mesh]:
    """Along the median, along both edges but where ramps cross them, and along the outsides of the ramps."""
    x_m = np.arange(span_m[0], span_m[1], RAIL_PIECE_M)
    everywhere = np.ones(len(x_m), dtype=bool)
    foot = np.array([[-0.05, -0.03], [0.05, -0.03], [0.05, 0.03], [-0.05, 0.03]])
    pieces = []
    for side, lane in sides.items():
        away_m = lane.compute_offsets_m(x_m)[0]
        for left_m, there, outwards in (
            (np.full(len(x_m), MEDIAN_RAIL_M), everywhere, -0.1),
            (np.full(len(x_m), RAIL_M), lane.is_inside(x_m, RAIL_M), 0.1),
            (RAIL_M + LANE_M + away_m, away_m < RAMP_ENDS_M, 0.1),
        ):
            pieces += _wall(x_m, side * left_m, there, RAIL_THICKNESS_M, RAIL_HEIGHTS_M)
            # Behind the beam, seen from the lanes.
            feet = np.stack([x_m, side * (left_m + outwards)], axis=1)[there]
            pieces.append(_prisms(feet[:, None] + foot, (0.0, 0.7)))
    return pieces


def _delineators(sides: dict[int, AuxiliaryLane], span_m: tuple[float, float]) -> list[Mesh]:
    x_m = np.arange(span_m[0], span_m[1], DELINEATOR_EVERY_M)
    return [
        build_post((x, side * y), 0.06, 0.0, 1.0)
        for side, lane in sides.items()
        for x, y in zip(x_m, lane.find_clear_offsets_m(x_m, DELINEATOR_M), strict=True)
    ]


def _structures(
    sides: dict[int, AuxiliaryLane], span_m: tuple[float, float], generator: np.random.Generator
) -> tuple[list[Mesh], list[float]]:
    """Sign gantries and bridges in turn over the whole road; and the places of the bridges."""
    pieces, bridges = [], []
    place, is_bridge = span_m[0] + generator.uniform(100.0, 300.0), bool(generator.random() < 0.5)
    while place < span_m[1]:
        length, half_width, height = (9.0, 50.0, 1.2) if is_bridge else (0.6, 0.0, 1.6)
        feet = {side: float(lane.find_clear_offsets_m(place, GANTRY_POST_M)) for side, lane in sides.items()}
        pieces += [
            build_post((place, side * y), 0.4 if is_bridge else 0.2, 0.0, CLEARANCE_M) for side, y in feet.items()
        ]
        ends = [side * max(y + 0.3, half_width) for side, y in feet.items()]
        along = (place - length / 2, place + length / 2)
        pieces.append(build_box_from_bounds(along, (min(ends), max(ends)), (CLEARANCE_M, CLEARANCE_M + height)))
        if is_bridge:
            bridges.append(float(place))
        place += generator.uniform(*STRUCTURE_EVERY_M)
        is_bridge = not is_bridge
    return pieces, bridges


def _sound_walls(
    sides: dict[int, AuxiliaryLane], span_m: tuple[float, float], generator: np.random.Generator
) -> list[Mesh]:
    """Walls along parts of the road, on either side."""
    pieces = []
    for side, lane in sides.items():
        place = span_m[0] + generator.uniform(0.0, 300.0)
        while place < span_m[1]:
            length, height = generator.uniform(80.0, 300.0), generator.uniform(2.5, 4.5)
            x_m = np.arange(place, min(place + length, span_m[1]), RAIL_PIECE_M)
            inside, y_m = lane.is_inside(x_m, SOUND_WALL_M + 0.5), side * lane.find_clear_offsets_m(x_m, SOUND_WALL_M)
            for there in (inside, ~inside):
                pieces += _wall(x_m, y_m, there, 0.2, (0.0, float(height)))
            place += length + generator.uniform(100.0, 400.0)
    return pieces


def _trees(
    sides: dict[int, AuxiliaryLane], span_m: tuple[float, float], bridges: list[float], generator: np.random.Generator
) -> list[Mesh]:
    pieces = []
    for side, lane in sides.items():
        x_m = span_m[0] + np.cumsum(generator.uniform(7.0, 25.0, int((span_m[1] - span_m[0]) / 16.0)))
        y_m = lane.find_clear_offsets_m(x_m, generator.uniform(*TREES_M, len(x_m)), 3.5)
        for x, y in zip(x_m.tolist(), y_m.tolist(), strict=True):
            shape = generator.uniform(0.8, 2.2), generator.uniform(4.0, 11.0), generator.uniform(1.2, 2.8)
            if all(abs(x - bridge) > NO_TREES_NEAR_BRIDGE_M for bridge in bridges):
                pieces += build_tree((x, side * y), 0.0, *shape)
    return pieces


# Platoons form behind the slower ones.
WARM_UP_S = 30.0
BEHIND_M, AHEAD_M = 150.0, 300.0
# On the level; those on the inside of a curve are a little nearer than the stations say.
SLACK_M = 15.0
# About: a lane is filled as far as its vehicles can come near the ego.
SLOWEST_MPS, EGO_AT_MOST_MPS, FASTEST_MPS = 22.0, 36.0, 40.0
# Snaking by a few degrees over such a length makes curves of 1.5 to 4 km radius.
CURVE_DEG = (4.0, 8.0)
WAVELENGTH_M = (1400.0, 2200.0)
CURVATURE_EVERY_M, POSE_EVERY_M = 50.0, 2.0
# Hills are long, and no road goes up or down them by more than this.
HILLS_M, STEEPEST = (1000.0, 2500.0), 0.04
SIDE_LANE_M = (450.0, 700.0)
LEADER_AHEAD_M = 45.0
EGO_MPS, LEADER_MPS = 34.0, 29.0

# Weight, driver and spread of the speeds by kind, from the lane at the median to the one at the shoulder. Lorries have
# limiters at 90 km/h, and drive between that and the 80 km/h that they are allowed: no two of them differ by enough to
# overtake.
LORRY = Driver(23.6, 1.6, 3.0, 0.6)
LANE_USERS = (
    {"sedan": (4.0, Driver(35.0)), "suv": (3.0, Driver(34.5)), "motorcycle": (0.4, Driver(35.0))},
    {"sedan": (4.0, Driver(32.0)), "hatchback": (4.0, Driver(31.0)), "suv": (3.0, Driver(32.0)),
     "pickup": (0.5, Driver(31.0)), "van": (2.0, Driver(29.5)), "bus": (0.4, Driver(27.0, 1.5, 3.0, 0.8))},
    {"truck": (3.0, LORRY), "lorry": (1.0, LORRY), "hatchback": (2.0, Driver(30.0)), "van": (1.5, Driver(29.0))},
    {"truck": (0.7, LORRY), "lorry": (0.3, LORRY), "sedan": (2.0, Driver(31.0)), "hatchback": (2.0, Driver(30.0)),
     "van": (1.0, Driver(29.0))},
)  # fmt: skip
SPEED_SPREAD, HEAVY_SPREAD = 0.09, 0.02
# Of those who drive beside the side lane, who leave; and on ramps there are fewer.
EXIT_SHARE, RAMP_SHARE = 0.15, 0.6


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
        (shapes,) = generator.spawn(1)
        hills = Hills(self.hill_height_std_m, shapes, HILLS_M, STEEPEST)
        middle, sides = self._middle_line(shapes), []
        for _ in range(2):
            begin_m = LEADER_MPS * (WARM_UP_S + shapes.uniform(0.0, 0.8) * self.duration_s)
            sides.append(AuxiliaryLane(begin_m, begin_m + float(shapes.uniform(*SIDE_LANE_M))))
        # Places of the other direction are stations with the sign turned.
        side_m = np.array([sides[0], (-sides[1].end_m, -sides[1].begin_m)])
        agents = self._traffic(side_m, fleet)
        heavy = np.array([BODY_KINDS.get(agent.kind) in HEAVY_KINDS for agent in agents])
        exits = (generator.random(len(agents)) < EXIT_SHARE) & np.array(
            [a.lane_index % LANES == SIDE_LANE - 1 for a in agents]
        )
        exits[0] = False
        stations = np.arange(middle.stations_m[0], middle.stations_m[-1], CURVATURE_EVERY_M)
        heights_m = hills.compute_heights_m(middle.compute_poses(stations, 0.0)[:, :2])
        climb = np.stack([stations, np.gradient(heights_m, CURVATURE_EVERY_M)])
        driving = LaneChangeSimulation(agents, heavy, exits, side_m, generator, climb)
        flow = driving.run(times_s, WARM_UP_S)
        moving = _near(middle, sides, agents, driving, flow)
        driver = build_ego_actor(times_s, moving, flow, 0, fleet.meshes[EGO], generator, hills)
        seen_m = (float(flow.lane_positions_m[0, 0]) - BEHIND_M, float(flow.lane_positions_m[-1, 0]) + AHEAD_M)
        scenery = build_roadside(middle, {-1: sides[0], 1: sides[1]}, hills, seen_m, shapes)
        return scenery, driver, build_nearby_actors(times_s, [moving], driver, fleet, hills)

    @property
    def _lasts_s(self) -> float:
        return self.duration_s + self.time_step_s + WARM_UP_S

    def _middle_line(self, generator: np.random.Generator) -> Alignment:
        """The ego begins near station 0."""
        first, last = -FASTEST_MPS * WARM_UP_S, EGO_AT_MOST_MPS * self._lasts_s + 4 * AHEAD_M
        stations = np.arange(first, last, CURVATURE_EVERY_M)
        amplitude, wavelength = np.deg2rad(generator.uniform(*CURVE_DEG)), generator.uniform(*WAVELENGTH_M)
        waves = 2 * np.pi * (stations / wavelength + generator.random())
        curvatures = amplitude * 2 * np.pi / wavelength * np.cos(waves)
        curvatures[[0, -1]] = 0.0
        return Alignment(stations, curvatures, (first, 0.0, float(amplitude * np.sin(waves[0]))))

    def _traffic(self, side_m: Float64, fleet: Fleet) -> list[Agent]:
        """Everybody; the ego is the first, behind a leader in its lane."""
        own, lasts_s = 3 - self.ego_lane, self._lasts_s
        kind = fleet.sample_kind({kind: weight for kind, (weight, _) in LANE_USERS[own].items()})
        leader = LANE_USERS[own][BODY_KINDS[kind]][1] if BODY_KINDS[kind] in HEAVY_KINDS else Driver(LEADER_MPS)
        agents = [
            fleet.create_agent(EGO, own, -LEADER_AHEAD_M / 2, Driver(EGO_MPS, headway_s=1.0)),
            fleet.create_agent(kind, own, LEADER_AHEAD_M / 2, leader),
        ]
        # Who may be seen, and who those may meet.
        within_m = (EGO_AT_MOST_MPS - SLOWEST_MPS) * lasts_s + AHEAD_M
        meets_m = (2 * SLOWEST_MPS * WARM_UP_S - AHEAD_M, (EGO_AT_MOST_MPS + FASTEST_MPS) * lasts_s + AHEAD_M)
        spans_m = [(-within_m, within_m)] * SIDE_LANE + [(0.0, 0.0)]
        spans_m += [(-meets_m[1], -meets_m[0])] * SIDE_LANE + [(0.0, 0.0)]
        for direction, (begin_m, _) in enumerate(side_m.tolist()):
            spans_m[direction * LANES + SIDE_LANE] = (begin_m - RAMP_MPS * lasts_s, begin_m)
        shares = [1.0, 1.0, 1.0, RAMP_SHARE] * 2
        check_traffic_memory(
            self.traffic_per_km * sum(share * np.ptp(span) for share, span in zip(shares, spans_m, strict=True)) / 1000,
            self.num_time_steps,
        )
        for lane, (share, span) in enumerate(zip(shares, spans_m, strict=True)):
            users = LANE_USERS[lane % LANES]
            agents += fleet.fill_lane(
                lane,
                span,
                share * self.traffic_per_km,
                users,
                existing_agents=agents[:2],
                speed_spread=SPEED_SPREAD,
                heavy_speed_spread=HEAVY_SPREAD,
            )
        return agents


def _near(
    middle: Alignment,
    sides: list[AuxiliaryLane],
    agents: list[Agent],
    driving: LaneChangeSimulation,
    flow: TrafficHistory,
) -> BodyTrajectories:
    """Where those are at all times who come near the ego, which is the first of them."""
    way = np.array([1.0 if agent.lane_index < LANES else -1.0 for agent in agents])
    stations = flow.lane_positions_m * way
    near = np.flatnonzero((np.abs(stations - stations[:, :1]) < HORIZON_M + SLACK_M).any(axis=0))
    way, kinds = way[near], tuple(agents[agent].kind for agent in near)
    stations = stations[:, near] + way * get_center_offsets_m(kinds)
    # How far to the right of the middle they are in their own direction, and how much more after each metre.
    right_m, slope = np.empty((2, *stations.shape))
    for column, agent in enumerate(near.tolist()):
        own, lane = stations[:, column], agents[agent].lane_index
        right_m[:, column], slope[:, column] = _lane_at(own, lane, sides)
        for change in driving.lane_changes:
            if change.agent_index == agent:
                done, per_m = change.compute_progress(flow.lane_positions_m[:, agent])
                (old_m, old_slope), (new_m, new_slope) = (
                    _lane_at(own, lane, sides) for lane in (change.old_lane_index, change.new_lane_index)
                )
                right_m[:, column] += done * (new_m - old_m)
                slope[:, column] += done * (new_slope - old_slope) + per_m * (new_m - old_m)
    poses = _poses(middle, stations)
    yaw = np.deg2rad(poses[..., 2])
    positions_m = np.zeros(poses.shape)
    positions_m[..., 0] = poses[..., 0] + way * right_m * np.sin(yaw)
    positions_m[..., 1] = poses[..., 1] - way * right_m * np.cos(yaw)
    yaw_deg = poses[..., 2] + np.where(way > 0, 0.0, 180.0) - np.rad2deg(np.arctan(slope))
    return BodyTrajectories(positions_m, yaw_deg, kinds).add_trailers()


def _lane_at(stations: Float64, lane: int, sides: list[AuxiliaryLane]) -> tuple[Float64 | float, Float64 | float]:
    """(T,) how far from the middle of the road a lane is at stations, and how much more after each metre driven."""
    centre_m = float(LANE_CENTRES_M[lane % LANES])
    if lane % LANES != SIDE_LANE:
        return centre_m, 0.0
    away_m, slope = sides[lane // LANES].compute_offsets_m(stations)
    return centre_m + away_m, slope if lane < LANES else -slope


def _poses(middle: Alignment, stations: Float64) -> Float64:
    """(..., 3) poses of the middle at stations, of which there are very many, to a third of a millimetre."""
    first = float(stations.min())
    table = middle.compute_poses(np.arange(first, float(stations.max()) + 2 * POSE_EVERY_M, POSE_EVERY_M), 0.0)
    place = (stations - first) / POSE_EVERY_M
    entry = place.astype(np.int64)
    poses = table.take(entry, axis=0)
    poses += (place - entry)[..., None] * np.diff(table, axis=0, append=0.0).take(entry, axis=0)
    return poses
