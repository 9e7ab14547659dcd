"""Cars that are parked in bays: lanes that nobody may use."""

import numpy as np

from torchcover.simulation.height_field import Ground
from torchcover.simulation.sumo.ground import tilts_deg
from torchcover.simulation.sumo.vicinity import Vicinity
from torchcover.simulation.traffic.city import FREE_AT_CORNERS_M, PARKED, PARKED_GAP_M
from torchcover.simulation.traffic.fleet import Fleet
from torchcover.simulation.traffic.roads import Line


def park(vicinity: Vicinity, ground: Ground, fleet: Fleet, share: float, generator: np.random.Generator) -> None:
    """Put cars into the bays of the streets that are near.

    Args:
        vicinity: The streets.
        ground: What the cars stand on.
        fleet: Their bodies; it notes them down.
        share: How much of the bays' room is taken.
        generator: Draws kinds and places.
    """
    poses: dict[str, list[np.ndarray]] = {kind: [] for kind in PARKED}
    for lane in vicinity.lanes:
        if lane.use != "bay":
            continue
        line = Line(lane.line_m[:, :2])
        way_m, end_m = FREE_AT_CORNERS_M, line.length_m - FREE_AT_CORNERS_M
        while way_m < end_m:
            kind = fleet.draw_kind(PARKED)
            length_m = fleet.length_m(kind) + PARKED_GAP_M + float(generator.uniform(0.0, 0.5))
            taken = generator.random() < share and way_m + length_m < end_m
            if taken and fleet.width_m(kind) < lane.width_m:
                poses[kind].append(line.poses(way_m + length_m / 2))
            way_m += length_m
    for kind, drawn in poses.items():
        places = np.array(drawn).reshape(-1, 3)
        heights_m = ground.heights_m(places[:, :2])
        tilts = tilts_deg(ground, places[:, :2], places[:, 2], (fleet.length_m(kind), fleet.width_m(kind)))
        for (x_m, y_m, yaw_deg), height_m, (pitch, roll) in zip(
            places.tolist(), heights_m.tolist(), tilts.tolist(), strict=True
        ):
            fleet.park(kind, (x_m, y_m, yaw_deg), height_m, (pitch, roll))
