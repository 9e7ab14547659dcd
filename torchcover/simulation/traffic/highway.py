"""A motorway: three lanes each way in gentle curves, with guard rails, bridges and sign gantries."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from torchcover.simulation.traffic.assemble import actors, ego_actor, paths
from torchcover.simulation.traffic.fleet import EGO, Fleet
from torchcover.simulation.traffic.flow import Agent, Lane, Simulation, check_crowd
from torchcover.simulation.traffic.idm import Driver
from torchcover.simulation.traffic.procedural import MostVehicles, Procedural
from torchcover.simulation.traffic.roads import Polyline
from torchcover.simulation.traffic.roadside import LANE_CENTRES_M, roadside
from torchcover.simulation.traffic.scenery import Scenery
from torchcover.simulation.traffic.signals import Signals
from torchcover.simulation.world import Actor

Numbers = NDArray[np.float64]

# Platoons form behind the slower ones.
WARM_UP_S = 30.0
BEHIND_M, AHEAD_M = 150.0, 300.0
# Nobody is faster; a lane is filled as far as its vehicles can come near the ego.
FASTEST_MPS = 36.0
CORNER_EVERY_M = 10.0
# Snaking by a few degrees over such a length makes curves of 1.5 to 4 km radius.
CURVE_DEG = (4.0, 8.0)
WAVELENGTH_M = (1400.0, 2200.0)
LEADER_AHEAD_M = 45.0
EGO_MPS, LEADER_MPS = 35.0, 28.5

# Weight and driver by kind, from the lane at the median to the one at the shoulder.
LANE_USERS = (
    {"sedan": (4.0, Driver(34.0)), "suv": (3.0, Driver(34.0)), "motorcycle": (0.4, Driver(34.0))},
    {"sedan": (4.0, Driver(30.0)), "hatchback": (4.0, Driver(29.5)), "suv": (3.0, Driver(30.0)),
     "van": (2.0, Driver(29.0)), "bus": (0.4, Driver(28.5))},
    {"truck": (4.0, Driver(27.5, 1.5, 3.0, 0.7)), "hatchback": (2.0, Driver(29.0)), "van": (1.5, Driver(28.5))},
)  # fmt: skip
SPEED_SPREAD = 0.025


class Highway(Procedural):
    """Traffic on a motorway.

    Args:
        traffic_per_km: Vehicles to a kilometre of lane.
        ego_lane: 1 is the lane at the shoulder, 3 the one at the median.
    """

    type: Literal["highway"] = "highway"
    traffic_per_km: MostVehicles = 12.0
    ego_lane: int = Field(default=2, ge=1, le=3)

    def _build(
        self, fleet: Fleet, times_s: Numbers, generator: np.random.Generator
    ) -> tuple[Scenery, Actor, tuple[Actor, ...]]:
        middle = self._middle_line(generator)
        lanes = _lanes(middle)
        agents = self._traffic(lanes, fleet)
        flow = Simulation(lanes, agents, Signals.none()).run(times_s, WARM_UP_S)
        moving = paths(lanes, agents, flow.place_m)
        driver = ego_actor(times_s, moving, flow, 0, fleet.meshes[EGO], generator)
        first, last = (_nearest(middle, position) for position in driver.trajectory.positions_m[[0, -1], :2])
        static = roadside(middle, (first - BEHIND_M, last + AHEAD_M), moving.positions_m, generator)
        return Scenery(static, (0,)), driver, actors(times_s, [moving], driver, fleet)

    @property
    def _ego_starts_m(self) -> float:
        """Way on the middle line: the faster ones from behind still start on the line."""
        return 0.4 * FASTEST_MPS * (self.duration_s + WARM_UP_S) + 2 * AHEAD_M

    def _middle_line(self, generator: np.random.Generator) -> Polyline:
        length = self._ego_starts_m + 2 * FASTEST_MPS * (self.duration_s + WARM_UP_S) + 2 * AHEAD_M
        along = np.arange(0.0, length, CORNER_EVERY_M)
        amplitude, wavelength = np.deg2rad(generator.uniform(*CURVE_DEG)), generator.uniform(*WAVELENGTH_M)
        heading = amplitude * np.sin(2 * np.pi * (along / wavelength + generator.random()))
        steps = CORNER_EVERY_M * np.stack([np.cos(heading), np.sin(heading)], axis=1)
        points = np.cumsum(steps, axis=0)
        # World coordinates begin where the ego does.
        return Polyline(points - Polyline(points).poses(self._ego_starts_m)[:2])

    def _traffic(self, lanes: list[Lane], fleet: Fleet) -> list[Agent]:
        """Everybody; the ego is the first, behind a leader in its lane."""
        own = 3 - self.ego_lane
        start = self._ego_starts_m
        kind = fleet.draw_kind({kind: weight for kind, (weight, _) in LANE_USERS[own].items()})
        leader = LANE_USERS[own][kind][1] if kind == "truck" else Driver(LEADER_MPS)
        agents = [
            fleet.agent(EGO, own, start - LEADER_AHEAD_M / 2, Driver(EGO_MPS, headway_s=0.9)),
            fleet.agent(kind, own, start + LEADER_AHEAD_M / 2, leader),
        ]
        # Nobody of one's own direction who is that far ahead is ever caught up with.
        ends_m = [2 * start] * 3 + [lane.line.length_m for lane in lanes[3:]]
        check_crowd(self.traffic_per_km * sum(ends_m) / 1000, self.steps)
        for index, end in enumerate(ends_m):
            users = LANE_USERS[index % 3]
            agents += fleet.fill(
                lanes, index, (0.0, end), self.traffic_per_km, users, keep_free=agents[:2], spread=SPEED_SPREAD
            )
        return agents


def _lanes(middle: Polyline) -> list[Lane]:
    """Three lanes of the ego's direction from the median outwards, then three of the other; all keep to the right."""
    own = [Lane(middle.shifted(-offset)) for offset in LANE_CENTRES_M]
    return own + [Lane(middle.shifted(offset).reversed()) for offset in LANE_CENTRES_M]


def _nearest(line: Polyline, position_m: Numbers) -> float:
    """Way of the corner of a line that is nearest to a position."""
    return float(line.arc_m[np.linalg.norm(line.points_m - position_m, axis=1).argmin()])
