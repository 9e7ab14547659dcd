"""Bodies on the ground: heights and tilts along their tracks, and cars in bays, lanes that nobody may use."""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from torchcover.geometry.arrays import Float64
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation.height_field import Ground, Plain
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.sumo.ground import Pavement, tilts_deg
from torchcover.simulation.sumo.motion import Motion, corners_m, rounded
from torchcover.simulation.sumo.vicinity import Vicinity
from torchcover.simulation.traffic.assemble import attitude
from torchcover.simulation.traffic.city import FREE_AT_CORNERS_M, PARKED, PARKED_GAP_M
from torchcover.simulation.traffic.fleet import CATEGORIES, EGO, REAR_OF, Fleet, parts_of
from torchcover.simulation.traffic.roads import Polyline
from torchcover.simulation.traffic.scenery import PAVEMENT_M
from torchcover.simulation.world import Actor

# Who is so far above the ground is on a bridge.
BRIDGE_M = 0.4
# So long, in poses, before and after it does it take to step onto a kerb.
STEP_POSES = 2


class Placing:
    """Puts bodies onto the ground, the pavement, or the deck of a bridge."""

    def __init__(self, ground: Ground, pavement: Pavement) -> None:
        self._ground = ground
        self._pavement = pavement

    def actors(self, others: Sequence[Motion], fleet: Fleet, duration_s: float) -> tuple[Actor, ...]:
        """The others as actors, there for as long as they were in the simulation."""
        found = []
        for number, motion in enumerate(others):
            name = f"{motion.user.kind} {motion.user.track.name} {number}"
            for kind, part in zip(parts_of(motion.user.kind), motion.parts, strict=True):
                poses = self._poses(motion, *part)
                trajectory = Trajectory(motion.times_s, *poses, not motion.user.track.covers(duration_s))
                found.append(Actor(name, CATEGORIES[kind], fleet.meshes[kind], trajectory))
                name = REAR_OF + name
        return tuple(found)

    def ego(self, ego: Motion, times_s: Float64, mesh: Mesh, generator: np.random.Generator) -> Actor:
        """The ego, with a body that tilts with braking and curves, too, at evenly spaced times."""
        columns = np.concatenate(self._poses(ego, *ego.parts[0]), axis=1).T
        x_m, y_m, z_m, yaw, pitch, roll = (np.interp(times_s, ego.times_s, column) for column in columns)
        way_m = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x_m), np.diff(y_m)))])
        angles = attitude(times_s, way_m, np.gradient(way_m, times_s), yaw, generator)
        angles[:, 1:] += np.stack([pitch, roll], axis=1)
        return Actor(EGO, "car", mesh, Trajectory(times_s, np.stack([x_m, y_m, z_m], axis=1), angles))

    def _poses(self, motion: Motion, poses: Float64, size_m: tuple[float, float]) -> tuple[Float64, Float64]:
        """(K, 3) places and (K, 3) angles of a part of a body."""
        middle_m, yaw_deg, track = poses[:, :2], np.rad2deg(poses[:, 2]), motion.user.track
        back_m = 0.0 if track.on_foot else motion.user.sizes_m[0][0] / 2
        # What is drawn along is behind.
        back_m = back_m + np.linalg.norm(middle_m - motion.poses[:, :2], axis=1)
        heights_m = self._ground.heights_m(middle_m)
        told_m, slope_deg = (
            np.interp(motion.times_s, track.times_s, told) for told in (track.places_m[:, 2], track.slope_deg)
        )
        on_deck_m = told_m - back_m * np.sin(np.deg2rad(slope_deg))
        up = on_deck_m > heights_m + BRIDGE_M
        angles_deg = np.column_stack([yaw_deg, np.zeros((len(yaw_deg), 2))])
        if track.on_foot:
            raised_m = np.where(self._pavement.holds(middle_m) & ~up, PAVEMENT_M, 0.0)
            heights_m = heights_m + rounded(raised_m[:, None], STEP_POSES)[:, 0]
        elif not isinstance(self._ground, Plain):
            angles_deg[:, 1:] = tilts_deg(self._ground, middle_m, yaw_deg, size_m)
            angles_deg[up, 1], angles_deg[up, 2] = -slope_deg[up], 0.0
        return np.column_stack([middle_m, np.where(up, on_deck_m, heights_m)]), angles_deg


def park(
    vicinity: Vicinity, ground: Ground, fleet: Fleet, share: float, generator: np.random.Generator
) -> NDArray[np.object_]:
    """Put cars into the bays of the streets that are near; their outlines in plan."""
    outlines_m = [np.empty((0, 4, 2))]
    poses: dict[str, list[np.ndarray]] = defaultdict(list)
    for lane in vicinity.lanes:
        if lane.use != "bay":
            continue
        line = Polyline(lane.line_m[:, :2])
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
        size_m = fleet.length_m(kind), fleet.width_m(kind)
        tilts = tilts_deg(ground, places[:, :2], places[:, 2], size_m)
        turned = np.column_stack([places[:, :2], np.deg2rad(places[:, 2])])
        outlines_m.append(corners_m(turned, np.tile(size_m, (len(places), 1))))
        for (x_m, y_m, yaw_deg), height_m, (pitch, roll) in zip(
            places.tolist(), heights_m.tolist(), tilts.tolist(), strict=True
        ):
            fleet.park(kind, (x_m, y_m, yaw_deg), height_m, (pitch, roll))
    return np.asarray(shapely.polygons(np.concatenate(outlines_m)))
