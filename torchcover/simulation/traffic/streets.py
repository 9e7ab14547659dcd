"""The plan of a city: a main street along x, and streets that cross it at lights."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchcover.simulation.traffic.flow import Lane
from torchcover.simulation.traffic.gates import Gate
from torchcover.simulation.traffic.roads import Line
from torchcover.simulation.traffic.signals import CROSS, MAIN, Signals

Numbers = NDArray[np.float64]

LANE_M = 3.25
BICYCLE_LANE_M = 1.8
PARKING_BAY_M = 2.3
GUTTER_M = 0.5
SIDEWALK_M = 3.2
MIN_BLOCK_M, MAX_BLOCK_M = 80.0, 130.0

# Along the way of whoever drives: stop line, crossing, carriageway of the other street, crossing.
CROSSING_STARTS_M, CROSSING_ENDS_M = 1.0, 4.0
STOP_LINE_M = 5.0
# People walk at these distances from the kerb, each way on its own, between the posts and the facades.
TRACKS_M = (1.35, 2.25)
WAITING_BEHIND_KERB_M = 0.5
# A crossing of the main street holds one person on each of these paths.
FOOTPATHS_M = (1.6, 2.5, 3.4)
WALKED_METRES_PER_GREEN_SECOND = 1.2

# A wave of green that a car with 40 km/h would ride, with a good deal of disorder.
GREEN_WAVE_MPS = 11.0
WAVE_DISORDER_S = 9.0


@dataclass(frozen=True, eq=False)
class Streets:
    """Where the streets are.

    Args:
        lanes_each_way: Of the main street.
        junctions_m: (J,) x of the middle of each cross street.
        cross_lanes_each_way: (J,) 1 or 2.
        signals: Their lights.
        reach_m: How far from the origin lanes begin and end: beyond what is driven in the run.
    """

    lanes_each_way: int
    junctions_m: Numbers
    cross_lanes_each_way: NDArray[np.int64]
    signals: Signals
    reach_m: float

    @property
    def bicycle_lane_m(self) -> float:
        """From the middle of the main street to that of its bicycle lane."""
        return self.lanes_each_way * LANE_M + BICYCLE_LANE_M / 2

    @property
    def bay_m(self) -> float:
        """From the middle of the main street to that of its parking bays."""
        return self.lanes_each_way * LANE_M + BICYCLE_LANE_M + PARKING_BAY_M / 2

    @property
    def kerb_m(self) -> float:
        """From the middle of the main street to its kerb."""
        return self.bay_m + PARKING_BAY_M / 2

    @property
    def cross_kerbs_m(self) -> Numbers:
        """(J,) from the middle of each cross street to its kerb."""
        return np.asarray(self.cross_lanes_each_way * LANE_M + GUTTER_M)

    def traffic_lanes(self) -> list[Lane]:
        """The lanes for motor traffic of the main street: eastbound from the median outwards, then westbound."""
        offsets = [(lane + 0.5) * LANE_M for lane in range(self.lanes_each_way)]
        return [self._main_lane(offset, way, STOP_LINE_M) for way in (1, -1) for offset in offsets]

    def bicycle_lanes(self) -> list[Lane]:
        """One eastbound, one westbound."""
        return [self._main_lane(self.bicycle_lane_m, way, STOP_LINE_M) for way in (1, -1)]

    def sidewalks(self) -> list[Lane]:
        """Tracks of the people who walk along the main street: each way on both sides."""
        tracks = [(self.kerb_m + TRACKS_M[0], 1), (self.kerb_m + TRACKS_M[1], -1)]
        return [self._main_lane(side * offset, way, 0.0) for side in (1, -1) for offset, way in tracks]

    def cross_lanes(self) -> list[Lane]:
        """The lanes of all cross streets: northbound ones on the east side, southbound ones on the west side."""
        lanes = []
        for index, (x, lanes_each_way) in enumerate(zip(self.junctions_m, self.cross_lanes_each_way, strict=True)):
            middle, half = self.reach_m, self.kerb_m
            gate = Gate(middle - half - STOP_LINE_M, middle + half + CROSSING_ENDS_M, index, CROSS)
            for way in (1, -1):
                for lane in range(lanes_each_way):
                    start = (x + way * (lane + 0.5) * LANE_M, -way * self.reach_m)
                    lanes.append(Lane(Line.straight(start, way * 90.0, 2 * self.reach_m), (gate,)))
        return lanes

    def _main_lane(self, right_m: float, way: int, stop_line_m: float) -> Lane:
        """A lane of the main street to the right of its middle, eastbound (1) or westbound (-1).

        Whoever stops right at the kerb of the cross street (`stop_line_m` of 0) walks.
        """
        order = np.argsort(way * self.junctions_m)
        walks = stop_line_m == 0.0
        gates = []
        for index in order:
            middle, half = way * self.junctions_m[index] + self.reach_m, self.cross_kerbs_m[index]
            enter = middle - half - (stop_line_m or WAITING_BEHIND_KERB_M)
            leave = middle + half + (WAITING_BEHIND_KERB_M if walks else CROSSING_ENDS_M)
            needed = (leave - enter) / WALKED_METRES_PER_GREEN_SECOND if walks else 0.0
            gates.append(Gate(float(enter), float(leave), int(index), MAIN, float(needed)))
        yaw_deg = 0.0 if way == 1 else 180.0
        line = Line.straight((-way * self.reach_m, -way * right_m), yaw_deg, 2 * self.reach_m)
        return Lane(line, tuple(gates))


def plan(lanes_each_way: int, span_m: tuple[float, float], reach_m: float, generator: np.random.Generator) -> Streets:
    """Draw the cross streets and their lights. The origin lies halfway between two junctions.

    Args:
        lanes_each_way: Of the main street.
        span_m: x from the first to the last cross street, about; it holds the origin.
        reach_m: How far from the origin lanes begin and end.
        generator: Draws blocks, widths and lights.
    """
    middle = generator.uniform(MIN_BLOCK_M, MAX_BLOCK_M) / 2
    east, west = [middle], [-middle]
    while east[-1] < span_m[1]:
        east.append(east[-1] + generator.uniform(MIN_BLOCK_M, MAX_BLOCK_M))
    while west[-1] > span_m[0]:
        west.append(west[-1] - generator.uniform(MIN_BLOCK_M, MAX_BLOCK_M))
    junctions = np.array(west[::-1] + east)
    # Two-lane and four-lane streets in turn.
    cross_lanes = 1 + (np.arange(len(junctions)) + generator.integers(2)) % 2
    disorder = generator.uniform(-WAVE_DISORDER_S, WAVE_DISORDER_S, size=len(junctions))
    signals = Signals(disorder - junctions / GREEN_WAVE_MPS + generator.uniform(0.0, 60.0))
    return Streets(lanes_each_way, junctions, cross_lanes, signals, reach_m)
