"""A parking lot: the ego drives round and round its aisles, among parked cars, low obstacles and people.

From the middle outwards, on both sides alike: a walkway between two rows that face each other, a row of stalls (with it
the island ends), an aisle, another row, a walkway along the edge.
"""

from typing import Literal

import numpy as np
import shapely
from pydantic import Field

from torchcover.geometry.arrays import Float64
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.alignment import build_rounded_rectangle
from torchcover.simulation.traffic.assemble import (
    BodyTrajectories,
    Footpath,
    build_ego_actor,
    build_nearby_actors,
    compute_body_trajectories,
    is_free_for,
    simulate_walking,
)
from torchcover.simulation.traffic.fleet import EGO, PEDESTRIAN, Fleet
from torchcover.simulation.traffic.flow import Agent, Lane, LaneSimulation, TrafficSignals
from torchcover.simulation.traffic.frontage import RoadsideDensity, find_street_sides, place_scenery
from torchcover.simulation.traffic.idm import Driver
from torchcover.simulation.traffic.kind import ProceduralTraffic, SceneParts
from torchcover.simulation.traffic.scenery import (
    PAVEMENT_M,
    Scenery,
    build_box,
    build_box_from_bounds,
    build_ground_plane,
    build_post,
    build_tree,
    merge_by_kind,
)

STALL_WIDTH_M, STALL_DEPTH_M = 2.6, 5.0
STALLS = 24
STALLS_M = STALLS * STALL_WIDTH_M
MIDDLE_WALKWAY_M = 1.9
ISLAND_M = MIDDLE_WALKWAY_M / 2 + STALL_DEPTH_M
AISLE_M = 6.5
OUTER_HEAD_M = ISLAND_M + AISLE_M + STALL_DEPTH_M
# y of the tracks on the walkways, each for one person.
WALKWAYS_M = (-0.45, 0.45, OUTER_HEAD_M + 1.2, OUTER_HEAD_M + 2.1, -OUTER_HEAD_M - 1.2, -OUTER_HEAD_M - 2.1)
EDGE_M = OUTER_HEAD_M + 3.2

ISLAND_END_M = 3.0
BOLLARDS_AT_X_M = 48.0
BOLLARD_EVERY_M = 1.8
BUILDING_AT_Y_M = 36.0
# The lot with its lanes, as far as what stands around it keeps off; and what stands at its edge, and behind that.
LOT_M = shapely.box(-BOLLARDS_AT_X_M - 14.0, -EDGE_M - 8.0, BOLLARDS_AT_X_M + 14.0, BUILDING_AT_Y_M)
AROUND_M = (0.2, 2.5)
# Crowns keep off the market.
CROWN_M = 2.0
NOSE_OFF_HEAD_M = 0.35
PARKED = {"suv": 3.0, "sedan": 3.0, "hatchback": 4.0}
TROLLEY_M = (0.9, 0.55, 1.0)
TROLLEY_SHARE = 0.3


class ParkingLotBuilder:
    """Draws a parking lot about the origin, with its aisles along x."""

    def __init__(self, settings: "ParkingTraffic", fleet: Fleet, generator: np.random.Generator) -> None:
        self._options, self._fleet, self._generator = settings, fleet, generator
        count = settings.crossings_per_aisle
        self._empty = {side: set(generator.choice(STALLS, size=count, replace=False).tolist()) for side in (1, -1)}

    @property
    def crossing_positions(self) -> list[tuple[int, float]]:
        """Side (1 is the aisle at positive y) and x of each place where people cross."""
        return [(side, _stall_x(column)) for side in (1, -1) for column in sorted(self._empty[side])]

    def build_static_scenery(self) -> Scenery:
        """Everything but the cars, with ground for 300 m around; the cars are parked."""
        low = []
        for side in (1, -1):
            for head, inwards in ((MIDDLE_WALKWAY_M / 2, 1), (OUTER_HEAD_M, -1)):
                for column in range(STALLS):
                    wheel_stop = build_box((_stall_x(column), side * (head + inwards * 0.12)), (1.8, 0.15, 0.1))
                    low.append(wheel_stop)
                    if column not in self._empty[side]:
                        place = (_stall_x(column), side * head, side * inwards)
                        low += self._occupant(*place)
        islands, trees = self._islands()
        around, market = self._surroundings()
        level, kerbs = build_ground_plane((-300.0, -300.0), (300.0, 300.0)), merge_by_kind(islands)

        sides = find_street_sides(LOT_M, AROUND_M, lambda _: np.array(True), self._options.built_share, self._generator)
        taken = [LOT_M, market.buffer(CROWN_M)]
        stood = place_scenery(
            sides,
            taken,
            taken,
            (),
            lambda places_m: np.zeros(len(places_m)),
            self._options.roadside_density,
            self._generator,
        )
        return Scenery(
            (level, *merge_by_kind(low, self._bollards()), *kerbs, *merge_by_kind(trees, around, *stood)), (0, 3)
        )

    def _occupant(self, x: float, head_y: float, inwards: int) -> list[Mesh]:
        """Park a car in a stall, nose or tail first; or return a trolley that somebody left there; or nothing."""
        if self._generator.random() < self._options.parked_share:
            kind = self._fleet.sample_kind(PARKED)
            y = head_y + inwards * (NOSE_OFF_HEAD_M + self._fleet.get_length_m(kind) / 2)
            yaw = self._generator.choice((90.0, -90.0)) + self._generator.uniform(-1.5, 1.5)
            x += self._generator.uniform(-0.1, 0.1)
            self._fleet.add_parked_vehicle(kind, (x, y, yaw))
            return []
        if self._generator.random() < TROLLEY_SHARE:
            x, y = x + self._generator.uniform(-0.6, 0.6), head_y + inwards * self._generator.uniform(1.0, 4.0)
            return [build_box((x, y), TROLLEY_M, yaw_deg=self._generator.uniform(0.0, 360.0))]
        return []

    def _islands(self) -> tuple[list[Mesh], list[Mesh]]:
        """Kerbed ends of the double row, each with trees."""
        kerbs, trees = [], []
        for side in (1, -1):
            ends = sorted((side * (STALLS_M / 2 + 0.3), side * (STALLS_M / 2 + 0.3 + ISLAND_END_M)))
            for half in (1, -1):
                across = sorted((half * MIDDLE_WALKWAY_M / 2, half * (ISLAND_M - 0.5)))
                kerbs.append(
                    build_box_from_bounds(
                        (ends[0], ends[1]), (across[0], across[1]), (0.0, PAVEMENT_M)
                    ).assign_material("pavement")
                )
                trees += build_tree((sum(ends) / 2, sum(across) / 2), PAVEMENT_M, 2.3, 5.5, 1.3)
        return kerbs, trees

    def _bollards(self) -> list[Mesh]:
        """Along both short sides, and in front of the building."""
        ends = [
            build_post((x, y), 0.08, 0.0, 0.9)
            for x in (-BOLLARDS_AT_X_M, BOLLARDS_AT_X_M)
            for y in np.arange(-EDGE_M + 1.0, EDGE_M, BOLLARD_EVERY_M)
        ]
        front = [
            build_post((x, BUILDING_AT_Y_M - 4.0), 0.1, 0.0, 0.9)
            for x in np.arange(-STALLS_M / 2, STALLS_M / 2, BOLLARD_EVERY_M)
        ]
        return ends + front

    def _surroundings(self) -> tuple[list[Mesh], shapely.Geometry]:
        """Low walls along the edges, planters, and the market; and the market in plan."""
        half = STALLS_M / 2
        market = (-half - 5.0, half + 5.0), (BUILDING_AT_Y_M, BUILDING_AT_Y_M + 40.0)
        pieces = [
            build_box_from_bounds((-half - 12.0, half + 12.0), (-EDGE_M - 0.2, -EDGE_M), (0.0, 0.6)),
            build_box_from_bounds((-half - 12.0, -6.0), (EDGE_M, EDGE_M + 0.2), (0.0, 0.6)),
            build_box_from_bounds((6.0, half + 12.0), (EDGE_M, EDGE_M + 0.2), (0.0, 0.6)),
            build_box_from_bounds(*market, (0.0, 7.5)),
        ]
        for x in np.linspace(-half, half, 5):
            pieces.append(build_post((x, EDGE_M + 1.0), 0.1, 0.0, 7.0))
            pieces.append(build_box((x + 5.0, BUILDING_AT_Y_M - 7.0), (1.6, 0.6, 0.5)))
        return pieces, shapely.box(market[0][0], market[1][0], market[0][1], market[1][1])


def _stall_x(column: int) -> float:
    return (column + 0.5 - STALLS / 2) * STALL_WIDTH_M


WARM_UP_S = 10.0
ROUND_M, CORNER_RADIUS_M = 84.0, 6.0
# Aisles are one-way, so that the loop runs down their middle.
AISLE_MIDDLE_M = ISLAND_M + AISLE_M / 2
# Where people wait, off the aisle's edges, and how far they keep from a car's middle.
WAITING_OFF_AISLE_M = 1.8
KEEP_AWAY_M = 6.0
PATHS_APART_M = 1.2


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
        lanes = [Lane(build_rounded_rectangle(ROUND_M, 2 * AISLE_MIDDLE_M, CORNER_RADIUS_M))]
        agents = self._traffic(lanes[0].centerline.length_m, fleet, generator)
        flow = LaneSimulation(lanes, agents, TrafficSignals.create_empty()).run(times_s, WARM_UP_S)
        driving = compute_body_trajectories(lanes, agents, flow.lane_positions_m)
        lot = ParkingLotBuilder(self, fleet, generator)
        driver = build_ego_actor(times_s, driving, flow, 0, fleet.meshes[EGO], generator)
        walking = _people(lot, driving, times_s, fleet, generator)
        others = build_nearby_actors(times_s, [driving, walking], driver, fleet)
        return lot.build_static_scenery(), driver, others

    def _traffic(self, round_m: float, fleet: Fleet, generator: np.random.Generator) -> list[Agent]:
        """The ego, a car not far ahead of it, and the others spread over the rest of the loop."""
        start, ahead = generator.uniform(0.0, round_m), generator.uniform(14.0, 24.0)
        agents = [fleet.create_agent(EGO, 0, start, Driver(self.speed_mps, 1.5, 2.0, 0.8))]
        for index in range(self.num_moving_cars):
            kind = fleet.sample_kind({"suv": 1.0, "sedan": 2.0, "hatchback": 2.0})
            place = start + ahead + index * (round_m - ahead) / self.num_moving_cars
            driver = fleet.sample_driver(Driver(0.9 * self.speed_mps, 1.5, 2.0, 0.8), 0.05)
            agents.append(fleet.create_agent(kind, 0, place, driver))
        return agents


def _people(
    lot: ParkingLotBuilder, driving: BodyTrajectories, times_s: Float64, fleet: Fleet, generator: np.random.Generator
) -> BodyTrajectories:
    """People who cross the aisles between parked cars, and people on the walkways."""
    step_s = float(times_s[1] - times_s[0])
    found, half = [], STALLS_M / 2
    along = [Footpath(np.array([-half, y]), np.array([half, y])) for y in WALKWAYS_M]
    for path, crosses in [*((p, True) for p in _across_aisles(lot)), *((p, False) for p in along)]:
        kind = fleet.sample_kind({"adult": 4.0, "child": 1.0})
        takes_s = path.length_m / float(PEDESTRIAN.desired_speed_mps * generator.uniform(0.8, 1.1))
        may_go = np.ones(len(times_s), dtype=bool)
        if crosses:  # when no car is on the piece of the aisle that is crossed
            distance = np.linalg.norm(driving.positions_m[..., :2] - (path.start_m + path.end_m) / 2, axis=2)
            may_go = is_free_for((distance < KEEP_AWAY_M).any(axis=1), takes_s, step_s)
        found.append((*simulate_walking(path, may_go, takes_s, times_s, fleet.get_length_m(kind) / 2, generator), kind))
    return BodyTrajectories.from_bodies(found)


def _across_aisles(lot: ParkingLotBuilder) -> list[Footpath]:
    near, far = ISLAND_M - WAITING_OFF_AISLE_M, ISLAND_M + AISLE_M + WAITING_OFF_AISLE_M
    return [
        Footpath(np.array([x + shift, side * near]), np.array([x + shift, side * far]))
        for side, x in lot.crossing_positions
        for shift in (-PATHS_APART_M / 2, PATHS_APART_M / 2)
    ]
