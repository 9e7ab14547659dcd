"""Parking lot: the ego vehicle circles through its aisles, among parked cars, low obstacles and pedestrians.

From the center outwards, on both sides: half of a walkway between two rows of stalls that face each other, a row of
stalls with an island at each end, an aisle, another row of stalls, and a walkway along the edge.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
from pydantic import Field

from torchcover.geometry.arrays import Bools, Float64
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.alignment import build_rounded_rectangle
from torchcover.simulation.traffic.assemble import (
    BodyTrajectories,
    build_ego_actor,
    build_nearby_actors,
    compute_body_trajectories,
)
from torchcover.simulation.traffic.fleet import EGO, PEDESTRIAN, Fleet
from torchcover.simulation.traffic.flow import Agent, Lane, LaneSimulation
from torchcover.simulation.traffic.frontage import RoadsideDensity, find_street_sides, place_scenery
from torchcover.simulation.traffic.idm import Driver
from torchcover.simulation.traffic.junctions import TrafficSignals
from torchcover.simulation.traffic.kind import ProceduralTraffic, SceneParts
from torchcover.simulation.traffic.scenery import (
    CURB_HEIGHT_M,
    Scenery,
    build_box,
    build_box_from_bounds,
    build_ground_plane,
    build_post,
    build_tree,
    merge_by_kind,
)
from torchcover.simulation.traffic.walking import Footpath, is_free_for, simulate_walking


@dataclass(frozen=True)
class ParkingLotParams:
    """Layout of a parking lot around the origin, with aisles along x, and behavior of its pedestrians.

    Args:
        num_stalls: Stalls in each row.
        stall_width_m: Width of a stall.
        stall_depth_m: Depth of a stall.
        middle_walkway_m: Width of the walkway between the middle rows.
        aisle_m: Width of an aisle.
        island_length_m: Length of the islands at the ends of the middle rows.
        bollard_x_m: Distance of the rows of bollards along the short sides from the center.
        bollard_spacing_m: Distance between bollards.
        building_y_m: y of the front of the supermarket.
        nose_gap_m: Gap between a parked car and the head of its stall.
        trolley_share: Share of the stalls without a car that hold a shopping trolley.
        trolley_m: Length, width and height of a trolley.
        loop_length_m: Length of the one-way loop through both aisles, along x.
        corner_radius_m: Radius of the corners of the loop.
        warm_up_s: Duration that is simulated before the run.
        wait_offset_m: Distance of waiting pedestrians from the edges of an aisle.
        clear_distance_m: Distance of cars, center to path, at which pedestrians start to cross.
        path_spacing_m: Distance between two footpaths across an aisle.
    """

    num_stalls: int = 24
    stall_width_m: float = 2.6
    stall_depth_m: float = 5.0
    middle_walkway_m: float = 1.9
    aisle_m: float = 6.5
    island_length_m: float = 3.0
    bollard_x_m: float = 48.0
    bollard_spacing_m: float = 1.8
    building_y_m: float = 36.0
    nose_gap_m: float = 0.35
    trolley_share: float = 0.3
    trolley_m: tuple[float, float, float] = (0.9, 0.55, 1.0)
    loop_length_m: float = 84.0
    corner_radius_m: float = 6.0
    warm_up_s: float = 10.0
    wait_offset_m: float = 1.8
    clear_distance_m: float = 6.0
    path_spacing_m: float = 1.2

    @property
    def half_row_m(self) -> float:
        """Half of the length of a row."""
        return self.num_stalls * self.stall_width_m / 2

    @property
    def inner_edge_m(self) -> float:
        """Distance from the center line to the aisle."""
        return self.middle_walkway_m / 2 + self.stall_depth_m

    @property
    def outer_head_m(self) -> float:
        """Distance from the center line to the heads of the outer stalls."""
        return self.inner_edge_m + self.aisle_m + self.stall_depth_m

    @property
    def edge_m(self) -> float:
        """Distance from the center line to the edge of the lot."""
        return self.outer_head_m + 3.2

    def compute_stall_x_m(self, column: int) -> float:
        """Compute the x of the center of a stall."""
        return (column + 0.5 - self.num_stalls / 2) * self.stall_width_m


LOT = ParkingLotParams()


class ParkingLotBuilder:
    """Builder of a parking lot.

    Args:
        settings: Settings of the traffic.
        fleet: Bodies; receives the parked cars.
        generator: Random generator.
    """

    def __init__(self, settings: "ParkingTraffic", fleet: Fleet, generator: np.random.Generator) -> None:
        self._settings, self._fleet, self._generator = settings, fleet, generator
        # On each side, the stalls at which pedestrians cross the aisle stay empty.
        self._crossing_columns: dict[int, list[int]] = {}
        for side in (1, -1):
            columns = generator.choice(LOT.num_stalls, size=settings.crossings_per_aisle, replace=False)
            self._crossing_columns[side] = sorted(columns.tolist())

    def build_footpaths(self) -> list[Footpath]:
        """Build two footpaths across the aisle at each crossing."""
        near_m = LOT.inner_edge_m - LOT.wait_offset_m
        far_m = LOT.inner_edge_m + LOT.aisle_m + LOT.wait_offset_m
        paths = []
        for side, columns in self._crossing_columns.items():
            for column in columns:
                for shift_m in (-LOT.path_spacing_m / 2, LOT.path_spacing_m / 2):
                    x_m = LOT.compute_stall_x_m(column) + shift_m
                    paths.append(Footpath(np.array([x_m, side * near_m]), np.array([x_m, side * far_m])))
        return paths

    def build_static_scenery(self) -> Scenery:
        """Build everything but the cars on 300 m of ground around the center, and park the cars."""
        low_obstacles = self._build_stall_obstacles()
        islands, island_trees = self._build_islands()
        surroundings, market = self._build_surroundings()
        ground, curbs = build_ground_plane((-300.0, -300.0), (300.0, 300.0)), merge_by_kind(islands)
        half_length_m = LOT.bollard_x_m + 14.0
        lot = shapely.box(-half_length_m, -LOT.edge_m - 8.0, half_length_m, LOT.building_y_m)
        roadside_offsets_m = (0.2, 2.5)
        built_share, density = self._settings.built_share, self._settings.roadside_density
        sides = find_street_sides(lot, roadside_offsets_m, _mark_all_visible, built_share, self._generator)
        occupied = [lot, market.buffer(2.0)]  # tree crowns keep off the market
        roadside = place_scenery(sides, occupied, occupied, (), _compute_flat_heights_m, density, self._generator)
        low_meshes = merge_by_kind(low_obstacles, self._build_bollards())
        high_meshes = merge_by_kind(island_trees, surroundings, *roadside)
        return Scenery((ground, *low_meshes, *curbs, *high_meshes), (0, 3))

    def _build_stall_obstacles(self) -> list[Mesh]:
        """Build the wheel stops and trolleys of all stalls, and park the cars."""
        meshes = []
        for side in (1, -1):
            for head_m, inwards in ((LOT.middle_walkway_m / 2, 1), (LOT.outer_head_m, -1)):
                for column in range(LOT.num_stalls):
                    x_m = LOT.compute_stall_x_m(column)
                    meshes.append(build_box((x_m, side * (head_m + inwards * 0.12)), (1.8, 0.15, 0.1)))
                    if column not in self._crossing_columns[side]:
                        meshes += self._fill_stall(x_m, side * head_m, side * inwards)
        return meshes

    def _fill_stall(self, x_m: float, head_y_m: float, inwards: int) -> list[Mesh]:
        """Park a car in a stall, nose or tail first; otherwise return a shopping trolley or nothing."""
        # Cars are a little oblique and off the middle.
        uniform = self._generator.uniform
        if self._generator.random() < self._settings.parked_share:
            kind = self._fleet.sample_kind({"suv": 3.0, "sedan": 3.0, "hatchback": 4.0})
            y_m = head_y_m + inwards * (LOT.nose_gap_m + self._fleet.get_length_m(kind) / 2)
            yaw_deg = self._generator.choice((90.0, -90.0)) + uniform(-1.5, 1.5)
            self._fleet.add_parked_vehicle(kind, (x_m + uniform(-0.1, 0.1), y_m, yaw_deg))
            return []
        if self._generator.random() < LOT.trolley_share:
            center_m = x_m + uniform(-0.6, 0.6), head_y_m + inwards * uniform(1.0, 4.0)
            return [build_box(center_m, LOT.trolley_m, yaw_deg=uniform(0.0, 360.0))]
        return []

    def _build_islands(self) -> tuple[list[Mesh], list[Mesh]]:
        """Build the islands at the ends of the middle rows, and their trees."""
        islands, trees = [], []
        start_m = LOT.half_row_m + 0.3
        for side in (1, -1):
            x0_m, x1_m = sorted((side * start_m, side * (start_m + LOT.island_length_m)))
            for half in (1, -1):
                y0_m, y1_m = sorted((half * LOT.middle_walkway_m / 2, half * (LOT.inner_edge_m - 0.5)))
                island = build_box_from_bounds((x0_m, x1_m), (y0_m, y1_m), (0.0, CURB_HEIGHT_M))
                islands.append(island.assign_material("pavement"))
                trees += build_tree(((x0_m + x1_m) / 2, (y0_m + y1_m) / 2), CURB_HEIGHT_M, 2.3, 5.5, 1.3)
        return islands, trees

    def _build_bollards(self) -> list[Mesh]:
        """Build bollards along both short sides and in front of the market."""
        meshes = []
        for x_m in (-LOT.bollard_x_m, LOT.bollard_x_m):
            for y_m in np.arange(-LOT.edge_m + 1.0, LOT.edge_m, LOT.bollard_spacing_m):
                meshes.append(build_post((x_m, y_m), 0.08, 0.0, 0.9))
        for x_m in np.arange(-LOT.half_row_m, LOT.half_row_m, LOT.bollard_spacing_m):
            meshes.append(build_post((x_m, LOT.building_y_m - 4.0), 0.1, 0.0, 0.9))
        return meshes

    def _build_surroundings(self) -> tuple[list[Mesh], shapely.Geometry]:
        """Build low walls along the edges, planters, lamps and the market; also return the outline of the market."""
        half_m, edge_m, market_y_m = LOT.half_row_m, LOT.edge_m, LOT.building_y_m
        market_x_m, market_end_m = half_m + 5.0, market_y_m + 40.0
        meshes = [
            build_box_from_bounds((-half_m - 12.0, half_m + 12.0), (-edge_m - 0.2, -edge_m), (0.0, 0.6)),
            build_box_from_bounds((-half_m - 12.0, -6.0), (edge_m, edge_m + 0.2), (0.0, 0.6)),
            build_box_from_bounds((6.0, half_m + 12.0), (edge_m, edge_m + 0.2), (0.0, 0.6)),
            build_box_from_bounds((-market_x_m, market_x_m), (market_y_m, market_end_m), (0.0, 7.5)),
        ]
        for x_m in np.linspace(-half_m, half_m, 5):
            meshes.append(build_post((x_m, edge_m + 1.0), 0.1, 0.0, 7.0))
            meshes.append(build_box((x_m + 5.0, market_y_m - 7.0), (1.6, 0.6, 0.5)))
        return meshes, shapely.box(-market_x_m, market_y_m, market_x_m, market_end_m)


def _mark_all_visible(positions_m: Float64) -> Bools:
    """Mark all positions (N, 2) as visible."""
    return np.ones(len(positions_m), dtype=bool)


def _compute_flat_heights_m(positions_m: Float64) -> Float64:
    """Return height 0 at positions (N, 2)."""
    return np.zeros(len(positions_m))


class ParkingTraffic(ProceduralTraffic):
    """Traffic in a parking lot.

    Args:
        speed_mps: Desired speed of the ego vehicle; other cars are slightly slower.
        num_moving_cars: Number of other moving cars.
        parked_share: Share of the stalls that are occupied.
        crossings_per_aisle: Positions along each of the two aisles at which two people cross.
        built_share: Share of the sides of the lot that have houses, except the side of the market.
        roadside_density: Factor on the usual density of objects around the lot; see `UrbanTraffic`.
    """

    type: Literal["parking"] = "parking"
    speed_mps: float = Field(default=3.0, ge=0.5, le=4.0)
    num_moving_cars: int = Field(default=2, ge=0, le=6)
    parked_share: float = Field(default=0.75, ge=0.0, le=1.0)
    crossings_per_aisle: int = Field(default=4, ge=0, le=8)
    built_share: float = Field(default=0.6, ge=0.0, le=1.0)
    roadside_density: RoadsideDensity = 1.0

    def _build(self, fleet: Fleet, times_s: Float64, generator: np.random.Generator) -> SceneParts:
        """Build static scenery, ego vehicle and actors."""
        loop_width_m = 2 * (LOT.inner_edge_m + LOT.aisle_m / 2)
        lanes = [Lane(build_rounded_rectangle(LOT.loop_length_m, loop_width_m, LOT.corner_radius_m))]
        agents = self._create_agents(lanes[0].centerline.length_m, fleet, generator)
        flow = LaneSimulation(lanes, agents, TrafficSignals.create_empty()).run(times_s, LOT.warm_up_s)
        cars = compute_body_trajectories(lanes, agents, flow.lane_positions_m)
        lot = ParkingLotBuilder(self, fleet, generator)
        ego = build_ego_actor(times_s, cars, flow, 0, fleet.meshes[EGO], generator)
        pedestrians = simulate_pedestrians(lot, cars, times_s, fleet, generator)
        actors = build_nearby_actors(times_s, [cars, pedestrians], ego, fleet)
        return lot.build_static_scenery(), ego, actors

    def _create_agents(self, loop_m: float, fleet: Fleet, generator: np.random.Generator) -> list[Agent]:
        """Create the ego vehicle, a car not far ahead of it, and other cars spread over the remaining loop."""
        start_m, leader_gap_m = generator.uniform(0.0, loop_m), generator.uniform(14.0, 24.0)
        agents = [fleet.create_agent(EGO, 0, start_m, Driver(self.speed_mps, 1.5, 2.0, 0.8))]
        for index in range(self.num_moving_cars):
            kind = fleet.sample_kind({"suv": 1.0, "sedan": 2.0, "hatchback": 2.0})
            position_m = start_m + leader_gap_m + index * (loop_m - leader_gap_m) / self.num_moving_cars
            driver = fleet.sample_driver(Driver(0.9 * self.speed_mps, 1.5, 2.0, 0.8), 0.05)
            agents.append(fleet.create_agent(kind, 0, position_m, driver))
        return agents


def simulate_pedestrians(
    lot: ParkingLotBuilder, cars: BodyTrajectories, times_s: Float64, fleet: Fleet, generator: np.random.Generator
) -> BodyTrajectories:
    """Simulate pedestrians that cross the aisles between parked cars, and pedestrians on the walkways.

    Args:
        lot: The parking lot.
        cars: Trajectories of the moving cars, for which pedestrians wait.
        times_s: (T,) evenly spaced times.
        fleet: Bodies.
        generator: Random generator.
    """
    frame_interval_s = float(times_s[1] - times_s[0])
    crossing_paths = lot.build_footpaths()
    paths = list(crossing_paths)
    half_m, outer_m = LOT.half_row_m, LOT.outer_head_m
    # Tracks on the walkways, each for one person.
    for y_m in (-0.45, 0.45, outer_m + 1.2, outer_m + 2.1, -outer_m - 1.2, -outer_m - 2.1):
        paths.append(Footpath(np.array([-half_m, y_m]), np.array([half_m, y_m])))
    pedestrians = []
    for index, path in enumerate(paths):
        kind = fleet.sample_kind({"adult": 4.0, "child": 1.0})
        traversal_s = path.length_m / float(PEDESTRIAN.desired_speed_mps * generator.uniform(0.8, 1.1))
        can_start = np.ones(len(times_s), dtype=bool)
        if index < len(crossing_paths):
            # Pedestrians start when the aisle stays free for the whole way.
            distances_m = np.linalg.norm(cars.positions_m[..., :2] - (path.start_m + path.end_m) / 2, axis=2)
            is_blocked = (distances_m < LOT.clear_distance_m).any(axis=1)
            can_start = is_free_for(is_blocked, traversal_s, frame_interval_s)
        radius_m = fleet.get_length_m(kind) / 2
        pedestrians.append((*simulate_walking(path, can_start, traversal_s, times_s, radius_m, generator), kind))
    return BodyTrajectories.from_bodies(pedestrians)
