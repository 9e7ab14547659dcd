"""A parking lot: the ego drives round and round its aisles, among parked cars, low obstacles and people."""

from typing import Literal

import numpy as np
from pydantic import Field

from torchcover.geometry.arrays import Float64
from torchcover.simulation.traffic.assemble import Paths, actors, ego_actor, paths
from torchcover.simulation.traffic.crossing import Footpath, free_for, walk
from torchcover.simulation.traffic.fleet import EGO, WALKING, Fleet
from torchcover.simulation.traffic.flow import Agent, Lane, Simulation
from torchcover.simulation.traffic.frontage import Times
from torchcover.simulation.traffic.idm import Driver
from torchcover.simulation.traffic.lot import AISLE_M, ISLAND_M, STALLS_M, WALKWAYS_M, Lot
from torchcover.simulation.traffic.procedural import Built, Procedural
from torchcover.simulation.traffic.roads import loop
from torchcover.simulation.traffic.signals import Signals

WARM_UP_S = 10.0
ROUND_M, CORNER_RADIUS_M = 84.0, 6.0
# Aisles are one-way, so that the loop runs down their middle.
AISLE_MIDDLE_M = ISLAND_M + AISLE_M / 2
# Where people wait, off the aisle's edges, and how far they keep from a car's middle.
WAITING_OFF_AISLE_M = 1.8
KEEP_AWAY_M = 6.0
PATHS_APART_M = 1.2


class Parking(Procedural):
    """A parking lot.

    Args:
        speed_mps: What the ego wants to drive; the others are a little slower.
        cars: Others that drive around.
        parked_share: Share of the stalls that are taken.
        crossings: Places at each of the two aisles where two people cross.
        built_share: Share of its sides, but that of the market, that have houses.
        roadside: As in `Urban`, of what stands around it.
    """

    type: Literal["parking"] = "parking"
    speed_mps: float = Field(default=3.0, ge=0.5, le=4.0)
    cars: int = Field(default=2, ge=0, le=6)
    parked_share: float = Field(default=0.75, ge=0.0, le=1.0)
    crossings: int = Field(default=4, ge=0, le=8)
    built_share: float = Field(default=0.6, ge=0.0, le=1.0)
    roadside: Times = 1.0

    def _build(self, fleet: Fleet, times_s: Float64, generator: np.random.Generator) -> Built:
        lanes = [Lane(loop(ROUND_M, 2 * AISLE_MIDDLE_M, CORNER_RADIUS_M))]
        agents = self._traffic(lanes[0].line.length_m, fleet, generator)
        flow = Simulation(lanes, agents, Signals.none()).run(times_s, WARM_UP_S)
        driving = paths(lanes, agents, flow.place_m)
        lot = Lot(fleet, self.parked_share, self.crossings, self.built_share, self.roadside, generator)
        driver = ego_actor(times_s, driving, flow, 0, fleet.meshes[EGO], generator)
        walking = _people(lot, driving, times_s, fleet, generator)
        others = actors(times_s, [driving, walking], driver, fleet)
        return lot.static(), driver, others

    def _traffic(self, round_m: float, fleet: Fleet, generator: np.random.Generator) -> list[Agent]:
        """The ego, a car not far ahead of it, and the others spread over the rest of the loop."""
        start, ahead = generator.uniform(0.0, round_m), generator.uniform(14.0, 24.0)
        agents = [fleet.agent(EGO, 0, start, Driver(self.speed_mps, 1.5, 2.0, 0.8))]
        for index in range(self.cars):
            kind = fleet.draw_kind({"suv": 1.0, "sedan": 2.0, "hatchback": 2.0})
            place = start + ahead + index * (round_m - ahead) / self.cars
            driver = fleet.draw_driver(Driver(0.9 * self.speed_mps, 1.5, 2.0, 0.8), 0.05)
            agents.append(fleet.agent(kind, 0, place, driver))
        return agents


def _people(lot: Lot, driving: Paths, times_s: Float64, fleet: Fleet, generator: np.random.Generator) -> Paths:
    """People who cross the aisles between parked cars, and people on the walkways."""
    step_s = float(times_s[1] - times_s[0])
    positions, yaws, kinds = [], [], []
    half = STALLS_M / 2
    along = [Footpath(np.array([-half, y]), np.array([half, y])) for y in WALKWAYS_M]
    for path, crosses in [*((p, True) for p in _across_aisles(lot)), *((p, False) for p in along)]:
        kind = fleet.draw_kind({"adult": 4.0, "child": 1.0})
        takes_s = path.length_m / float(WALKING.desired_speed_mps * generator.uniform(0.8, 1.1))
        may_go = np.ones(len(times_s), dtype=bool)
        if crosses:  # when no car is on the piece of the aisle that is crossed
            distance = np.linalg.norm(driving.positions_m[..., :2] - (path.start_m + path.end_m) / 2, axis=2)
            may_go = free_for((distance < KEEP_AWAY_M).any(axis=1), takes_s, step_s)
        position, yaw = walk(path, may_go, takes_s, times_s, fleet.length_m(kind) / 2, generator)
        positions.append(position)
        yaws.append(yaw)
        kinds.append(kind)
    return Paths(np.stack(positions, axis=1), np.stack(yaws, axis=1), tuple(kinds))


def _across_aisles(lot: Lot) -> list[Footpath]:
    near, far = ISLAND_M - WAITING_OFF_AISLE_M, ISLAND_M + AISLE_M + WAITING_OFF_AISLE_M
    return [
        Footpath(np.array([x + shift, side * near]), np.array([x + shift, side * far]))
        for side, x in lot.crossings
        for shift in (-PATHS_APART_M / 2, PATHS_APART_M / 2)
    ]
