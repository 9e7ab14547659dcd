"""Built-in worlds beside recorded streets: what closes the view, visible ground, objects, kerbs, speeds, motion.

`python -m benchmarks.streets --sweeps RIG=PATH ... --logs PATH ...` prints real streets, too: sweeps in files or
recordings, and recorded objects. A sweep is compared with the clouds of the same rig in each world, and both go through
the same estimator: the ground is a field through the cloud's own low surfaces, and heights are above that.
"""

import argparse
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks import table
from torchcover.data import open_recording, read_cloud, read_objects
from torchcover.geometry import BoundingBox, transform_points
from torchcover.geometry.trajectory import Trajectory
from torchcover.recordings.ground_model import GroundModel, extract_low_surfaces
from torchcover.recordings.recording import Scan
from torchcover.recordings.vehicle_cloud import transform_to_vehicle
from torchcover.simulation import PaperReference, Rig, Scenario, Simulator
from torchcover.simulation.returns import get_material_index
from torchcover.simulation.scene import Scene
from torchcover.simulation.scene_geometry import SceneGeometry as Scenery
from torchcover.simulation.traffic.fleet import REAR_OF

WORLDS = ("urban", "sumo_random", "parking", "highway")
TRACKS = ("tracks_argoverse2", "tracks_nuscenes")
RIGS = ("kitti", "nuscenes", "argoverse2")
# So many runs of each world, each a world of its own, looked at at different times.
RUNS, EVERY_S = 8, 67.0
SECTOR_DEG = 1.0
BANDS_M = {"0.2-0.5": (0.2, 0.5), "0.5-2.5": (0.5, 2.5), "2.5-6": (2.5, 6.0)}
THINGS = "0.5-2.5"
WITHIN_M, BEYOND_M = (20.0, 40.0, 60.0), 80.0
RINGS_M = (10.0, 20.0, 30.0, 40.0, 60.0, 80.0)
GROUND_M, GROUND_SECTOR_DEG = 0.2, 2.0
OWN_M = 2.5
# Boxes that people drew are off by centimetres: accelerations within half a second are theirs.
LABELS_TREMBLE_S = 0.5
LOG_S = 15.0
DISTANCES_M = (25.0, 50.0, 75.0)
COUNTED = ("car", "lorry or bus", "two wheels", "person", "other")

# Recorded categories and those of bodies, as kinds that can be compared.
KINDS = {
    "car": "car", "passenger": "car", "delivery": "car", "taxi": "car",
    "truck": "lorry or bus", "trailer": "lorry or bus", "bus": "lorry or bus", "coach": "lorry or bus",
    "tram": "lorry or bus", "pedestrian": "person", "child": "person", "wheelchair": "person",
    "cyclist": "two wheels", "bicycle": "two wheels", "scooter": "two wheels", "moped": "two wheels",
    "motorcycle": "two wheels",
}  # fmt: skip
OTHER = "other"
STANDS_MPS = 0.3
HARD_MPS2 = 6.0
# From there the ground below is looked for, kerbs included.
UP_M = np.array([0.0, 0.0, 1.0])


class Body(NamedTuple):
    """Somebody: a name, one of the kinds above or `other`, length, width and height, and where it is over time."""

    name: str
    kind: str
    size_m: np.ndarray
    trajectory: Trajectory

    def there(self, times_s):
        """(T, 3) places and (T,) yaw in radians; NaN where it is not there."""
        own_s, yaw = self.trajectory.times_s, np.unwrap(np.deg2rad(self.trajectory.angles_deg[:, 0]))
        places_m = self.trajectory.interpolate_positions_m(times_s)
        return places_m, np.where(np.isnan(places_m[:, 0]), np.nan, np.interp(times_s, own_s, yaw))

    @property
    def ever_moves(self):
        """Whether it ever is elsewhere than at first, by more than labels tremble."""
        return bool(np.linalg.norm(np.ptp(self.trajectory.positions_m[:, :2], axis=0)) > 1.0)


class Scene(NamedTuple):
    """A drive: the ego, all others, and the times that are looked at; the world, if it is simulated."""

    ego: Body
    others: list
    times_s: np.ndarray
    world: Scene | None = None

    @classmethod
    def of_world(cls, world, frame_interval_s=1.0):
        """What a scenario builds."""
        ego, *others = (_body(actor) for actor in (world.ego, *world.objects))
        return cls(ego, others, np.arange(0.0, max(world.duration_s, 1e-6), frame_interval_s), world)

    @classmethod
    def of_recording(cls, objects, frame_interval_s=1.0):
        """What was recorded, while its own ego was there."""
        ego = objects.egos[0]
        drive = Trajectory.from_poses(ego.times_s, ego.world_T_ego @ ego.ego_T_vehicle)
        size_m = np.array(ego.size_m or (4.5, 1.9, 1.6))
        others = [
            Body(t.name, KINDS.get(t.vehicle_class or "", OTHER), np.array(t.size_m), t.trajectory)
            for t in objects.tracks
        ]
        return cls(
            Body("ego", "car", size_m, drive), others, np.arange(ego.times_s[0], ego.times_s[-1], frame_interval_s)
        )


def _body(actor):
    size_m = np.array(BoundingBox.from_points(actor.mesh.vertices_m).size_m)
    return Body(actor.name, KINDS.get(actor.category, OTHER), size_m, actor.trajectory)


def outlines(bodies, time_s):
    """(N, 4, 2) outlines seen from above; NaN who is not there."""
    found = np.full((len(bodies), 4, 2), np.nan)
    for number, body in enumerate(bodies):
        places_m, yaw = body.there(np.array([time_s]))
        ahead = np.array([np.cos(yaw[0]), np.sin(yaw[0])]) * body.size_m[0] / 2
        left = np.array([-np.sin(yaw[0]), np.cos(yaw[0])]) * body.size_m[1] / 2
        found[number] = places_m[0, :2] + [ahead + left, left - ahead, -ahead - left, ahead - left]
    return found


def overlaps_m(outline_m):
    """(P, 2) pairs of N rectangles that share space, and (P,) how deep: the least way that parts them."""
    middle_m = outline_m.mean(axis=1)
    radius_m = np.linalg.norm(outline_m - middle_m[:, None], axis=2).max(axis=1, initial=0.0)
    away_m = np.linalg.norm(middle_m[:, None] - middle_m, axis=2)
    first, second = np.nonzero(np.triu(away_m < radius_m[:, None] + radius_m, 1))
    p, q = outline_m[first], outline_m[second]
    edges = np.concatenate([p[:, 1:3] - p[:, :2], q[:, 1:3] - q[:, :2]], axis=1)
    edges /= np.linalg.norm(edges, axis=2, keepdims=True)
    on_p, on_q = edges @ p.swapaxes(1, 2), edges @ q.swapaxes(1, 2)
    depth_m = np.minimum(on_p.max(axis=2), on_q.max(axis=2)) - np.maximum(on_p.min(axis=2), on_q.min(axis=2))
    depth_m = depth_m.min(axis=1)
    return np.stack([first, second], axis=1)[depth_m > 0], depth_m[depth_m > 0]


def met(scene, deeper_m=0.05, within_m=80.0):
    """{(name, name): greatest depth} of pairs that overlap at some time, near the ego; bodies on bridges count too."""
    found = {}
    everybody = [scene.ego, *scene.others]
    height_m = np.stack([body.trajectory.interpolate_positions_m(scene.times_s)[:, 2] for body in everybody])
    for column, time_s in enumerate(scene.times_s):
        outline_m = outlines(everybody, time_s)
        away_m = np.linalg.norm(outline_m.mean(axis=1) - outline_m[0].mean(axis=0), axis=1)
        near = np.flatnonzero(away_m < within_m)
        pairs, depths_m = overlaps_m(outline_m[near])
        for (i, j), depth_m in zip(near[pairs], depths_m, strict=True):
            in_two = everybody[j].name == REAR_OF + everybody[i].name
            if not in_two and depth_m > deeper_m and abs(height_m[i, column] - height_m[j, column]) < 1.5:
                pair = everybody[i].name, everybody[j].name
                found[pair] = max(found.get(pair, 0.0), float(depth_m))
    return found


def accelerations(trajectory, frame_interval_s=0.2):
    """Compute speed and acceleration by finite differences over three positions.

    Args:
        trajectory: Trajectory of a body.
        frame_interval_s: Time between the positions, not less than that of the source: its linear pieces have kinks.

    Returns:
        (K,) times, (K,) speeds, (K,) accelerations forward and (K,) to the left, of the middle position.
    """
    times_s = np.arange(trajectory.times_s[0], trajectory.times_s[-1] + 1e-9, frame_interval_s)
    if len(times_s) < 3:
        return np.empty(0), np.empty(0), np.empty(0), np.empty(0)
    places_m = trajectory.interpolate_positions_m(np.minimum(times_s, trajectory.times_s[-1]))[:, :2]
    ways_m = np.diff(places_m, axis=0)
    velocity, change = (
        (ways_m[:-1] + ways_m[1:]) / (2 * frame_interval_s),
        np.diff(ways_m, axis=0) / frame_interval_s**2,
    )
    speed = np.linalg.norm(velocity, axis=1)
    heading = velocity / np.maximum(speed, 1e-9)[:, None]
    ahead = (change * heading).sum(axis=1)
    left = heading[:, 0] * change[:, 1] - heading[:, 1] * change[:, 0]
    return times_s[1:-1], speed, ahead, left


def motion(scene, frame_interval_s=0.2):
    """Figures of a drive: pairs that overlap, who accelerates more than tyres allow, people, and the ego."""
    hard = {"car": 0, "lorry or bus": 0, "two wheels": 0}
    count, fastest_mps, runners, people = dict.fromkeys(hard, 0), 0.0, 0, 0
    for body in scene.others:
        if not body.ever_moves:
            continue
        _, speed, ahead, left = accelerations(body.trajectory, frame_interval_s)
        if not len(speed):
            continue
        if body.kind == "person":
            people += 1
            runners += speed.max() > 4.0
            fastest_mps = max(fastest_mps, float(speed.max()))
        elif body.kind in hard:
            count[body.kind] += 1
            hard[body.kind] += np.hypot(ahead, left).max() > HARD_MPS2
    pairs = met(scene)
    _, _, ahead, left = accelerations(scene.ego.trajectory, frame_interval_s)
    return {
        "pairs that overlap": len(pairs),
        "deepest (m)": max(pairs.values(), default=0.0),
        **{f"{kind}: above {HARD_MPS2:g} m/s2": f"{hard[kind]} of {count[kind]}" for kind in ("car", "lorry or bus")},
        "people above 4 m/s": f"{runners} of {people}",
        "fastest of them (m/s)": fastest_mps,
        "ego to the side (m/s2)": float(np.abs(left).max(initial=0.0)),
        "ego brakes (m/s2)": float(-ahead.min(initial=0.0)),
        "wheels off the ground, or in a kerb (m)": np.nan if scene.world is None else wheels_m(scene.world),
        "left out": 0 if scene.world is None else scene.world.num_omitted_road_users,
    }


def speeds_mps(body, times_s, over_s=0.5):
    """(T,) speeds, NaN where it is not there for so long."""
    before, after = (
        body.trajectory.interpolate_positions_m(times_s + shift)[:, :2] for shift in (-over_s / 2, over_s / 2)
    )
    if not body.trajectory.is_transient and len(body.trajectory.times_s) > 1:
        own_s = body.trajectory.times_s
        over_s = np.minimum(times_s + over_s / 2, own_s[-1]) - np.maximum(times_s - over_s / 2, own_s[0])
    return np.linalg.norm(after - before, axis=1) / over_s


def near(scene, within_m=75.0):
    """For each time the (body, distance, speed) of all that are within a distance of the ego."""
    ego_m = scene.ego.trajectory.interpolate_positions_m(scene.times_s)[:, :2]
    found = [[] for _ in scene.times_s]
    for body in scene.others:
        away_m = np.linalg.norm(body.trajectory.interpolate_positions_m(scene.times_s)[:, :2] - ego_m, axis=1)
        speed = speeds_mps(body, scene.times_s) if body.ever_moves else np.zeros(len(away_m))
        for column in np.flatnonzero(away_m < within_m):
            found[column].append((body, float(away_m[column]), float(speed[column])))
    return found


def gaps_m(scene, within_m=60.0, lane_m=1.5):
    """Bumper to bumper, from each vehicle that moves to the next on its way, at all times; and the first's speed."""
    movers = [
        body
        for body in (scene.ego, *scene.others)
        if body.ever_moves and body.kind in ("car", "lorry or bus") and not body.name.startswith(REAR_OF)
    ]
    gaps, speeds = [], []
    if not movers:
        return np.empty(0), np.empty(0)
    all_speeds = np.stack([speeds_mps(body, scene.times_s) for body in movers])
    poses = [body.there(scene.times_s) for body in movers]
    for column in range(len(scene.times_s)):
        place_m = np.stack([places[column, :2] for places, _ in poses])
        yaw = np.array([turned[column] for _, turned in poses])
        away = place_m[None] - place_m[:, None]
        ahead = np.cos(yaw)[:, None] * away[..., 0] + np.sin(yaw)[:, None] * away[..., 1]
        left = np.cos(yaw)[:, None] * away[..., 1] - np.sin(yaw)[:, None] * away[..., 0]
        along = np.cos(yaw[None] - yaw[:, None]) > np.cos(np.deg2rad(20.0))
        follows = along & (ahead > 0) & (ahead < within_m) & (np.abs(left) < lane_m)
        for one in np.flatnonzero(follows.any(axis=1)):
            nearest = np.flatnonzero(follows[one])[ahead[one, follows[one]].argmin()]
            gaps.append(ahead[one, nearest] - (movers[one].size_m[0] + movers[nearest].size_m[0]) / 2)
            speeds.append(all_speeds[one, column])
    return np.array(gaps), np.array(speeds)


def kerbs(scene, beside_m=(2.0, 12.0), beyond_m=40.0, shortest_m=30.0):
    """Of the ego's way and some metres straight on: the share of its two sides that vehicles stand along, or NaN.

    They never move and are as the way is, within 15 degrees.
    """
    ego_m, yaw = scene.ego.there(scene.times_s)
    way_m = [ego_m[0, :2]]
    for place_m in ego_m[1:, :2]:
        if np.linalg.norm(place_m - way_m[-1]) > 2.0:
            way_m.append(place_m)
    ends = [np.array([np.cos(angle), np.sin(angle)]) for angle in (yaw[0], yaw[-1])]
    way_m = np.array([way_m[0] - beyond_m * ends[0], *way_m, way_m[-1] + beyond_m * ends[1]])
    arc_m = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(way_m, axis=0), axis=1)))
    if arc_m[-1] < shortest_m:
        return np.nan
    fine_m = np.arange(0.0, arc_m[-1], 0.5)
    line_m = np.stack([np.interp(fine_m, arc_m, axis) for axis in way_m.T], axis=1)
    heading = np.unwrap(np.arctan2(*np.gradient(line_m, axis=0).T[::-1]))
    taken = np.zeros((2, len(fine_m)), dtype=bool)
    for body in scene.others:
        if body.ever_moves or body.kind not in ("car", "lorry or bus"):
            continue
        place_m, turned = body.trajectory.positions_m[0, :2], np.deg2rad(body.trajectory.angles_deg[0, 0])
        nearest = int(np.linalg.norm(line_m - place_m, axis=1).argmin())
        away_m = place_m - line_m[nearest]
        left_m = np.cos(heading[nearest]) * away_m[1] - np.sin(heading[nearest]) * away_m[0]
        if beside_m[0] < abs(left_m) < beside_m[1] and abs(np.sin(turned - heading[nearest])) < np.sin(np.deg2rad(15)):
            taken[int(left_m > 0)] |= np.abs(fine_m - fine_m[nearest]) < body.size_m[0] / 2
    return float(taken.mean())


def wheels_m(world, looks=12):
    """How far the lowest points of the wheels of what moves are from the ground, kerbs included, at the worst."""
    ground, tyre, worst_m = Scenery(world).ground, get_material_index("tyre"), 0.0
    for actor in (world.ego, *world.actors):
        low_m = actor.mesh.vertices_m[np.unique(actor.mesh.faces[actor.mesh.filled_material_indices == tyre])]
        low_m = low_m[low_m[:, 2] < 0.02]
        own_s = actor.trajectory.times_s
        for time_s in np.linspace(own_s[0], own_s[-1], looks) if len(low_m) else ():
            above_m = (
                ground.compute_heights_m(transform_points(actor.trajectory.interpolate(time_s), low_m) + UP_M) - UP_M[2]
            )
            worst_m = max(worst_m, float(np.abs(above_m[np.isfinite(above_m)]).max(initial=0.0)))
    return worst_m


def sight(points_m):
    """Shares (%) of the azimuths that are closed within distances by each band, open beyond, and with ground in rings.

    Args:
        points_m: (N, 3) a cloud in a frame whose z points up and whose origin is on the vehicle or above it.
    """
    points_m = np.asarray(points_m, dtype=np.float64)
    points_m = points_m[np.hypot(*points_m.T[:2]) > OWN_M]
    low_m = points_m[np.hypot(*points_m.T[:2]) < 10.0, 2]
    ground = GroundModel.from_surfaces(
        [extract_low_surfaces(points_m, np.zeros(3))], np.array([0.0, 0.0, np.quantile(low_m, 0.1)])
    )
    if ground is None:
        raise ValueError("no ground is seen around the vehicle")
    height_m, range_m = ground.compute_heights_m(points_m), np.hypot(*points_m.T[:2])
    azimuth_deg = np.rad2deg(np.arctan2(points_m[:, 1], points_m[:, 0])) % 360.0
    found = {}
    for name, (low, high) in BANDS_M.items():
        there = (height_m >= low) & (height_m < high)
        nearest_m = np.full(round(360 / SECTOR_DEG), np.inf)
        sector = np.minimum((azimuth_deg[there] / SECTOR_DEG).astype(int), len(nearest_m) - 1)
        np.minimum.at(nearest_m, sector, range_m[there])
        # A sparse LiDAR has sectors without a ray in a band: where only the front is seen, the rest is not asked about.
        seen = np.zeros(len(nearest_m), dtype=bool)
        seen[np.minimum((azimuth_deg / SECTOR_DEG).astype(int), len(seen) - 1)] = True
        for within_m in WITHIN_M:
            found[f"{name} within {within_m:.0f}"] = 100 * (nearest_m[seen] < within_m).mean()
        found[f"{name} open beyond {BEYOND_M:.0f}"] = 100 * (nearest_m[seen] > BEYOND_M).mean()
    level = np.abs(height_m) < GROUND_M
    for near_m, far_m in pairwise(RINGS_M):
        ring = level & (range_m >= near_m) & (range_m < far_m)
        sectors = np.unique((azimuth_deg[ring] / GROUND_SECTOR_DEG).astype(int))
        found[f"ground {near_m:.0f}-{far_m:.0f}"] = 100 * len(sectors) * GROUND_SECTOR_DEG / 360.0
    return found


def simulated(world, rig, runs=RUNS, seed=0):
    """`sight` of what a rig sees in several runs of a world."""
    rig, scenario = Rig.load(rig), Scenario.load(world)
    frame_interval_s = None if scenario.is_repeating else EVERY_S
    simulator = Simulator(
        scenario, {"rig": rig}, PaperReference(rows=2, columns=2), seed=seed, frame_interval_s=frame_interval_s
    )
    return [
        sight(np.concatenate([scan.points for scan in simulator.simulate_scans(index)["rig"]]))
        for index in range(1 if scenario.is_repeating else runs)
    ]


def recorded(path):
    """`sight` of a sweep in a file, or of all those of a recording."""
    if Path(path).is_file():
        return [sight(transform_to_vehicle(Scan(np.asarray(read_cloud(path))[:, :3], None, str(path))).points_m)]
    recording = open_recording(path)
    return [
        sight(
            np.concatenate(
                [
                    transform_to_vehicle(recording.read_scan(name, k), recording.ego_box).points_m
                    for name in recording.sensors
                ]
            )
        )
        for k in recording.key_frames
    ]


def mean_row(found, keys):
    """Mean, and the spread where there are several."""
    values = np.array([[one[key] for key in keys] for one in found])
    spread = values.std(axis=0, ddof=1) if len(values) > 1 else np.full(len(keys), np.nan)
    return [
        f"{m:.0f}" + ("" if np.isnan(s) else f" ± {s:.0f}") for m, s in zip(values.mean(axis=0), spread, strict=True)
    ]


def objects(scenes):
    """A row of counts by kind, by distance and of all, and rows of sizes by kind."""
    timed = [pair for scene in scenes for pair in zip(scene.times_s, near(scene), strict=True)]
    moments = [moment for _, moment in timed]
    counts = np.array([[sum(body.kind == kind for body, _, _ in moment) for kind in COUNTED] for moment in moments])
    rings = np.array([[sum(away < far for _, away, _ in moment) for far in DISTANCES_M] for moment in moments])
    bodies = {id(body): body for moment in moments for body, _, _ in moment}.values()
    sizes = {kind: np.array([body.size_m for body in bodies if body.kind == kind]) for kind in COUNTED}
    driving = [
        speed for time_s, moment in timed for body, _, speed in moment if body.kind == "car" and drives(body, time_s)
    ]
    people = [speed for moment in moments for body, _, speed in moment if body.kind == "person" and body.ever_moves]
    return counts, rings, sizes, np.array(driving), np.array(people)


def drives(body, time_s):
    """Whether it gets anywhere around a time, in as long as a log takes: who waits for longer looks parked there."""
    places_m = body.trajectory.interpolate_positions_m(time_s + LOG_S * np.linspace(-0.5, 0.5, 16))[:, :2]
    places_m = places_m[~np.isnan(places_m[:, 0])]
    return bool(len(places_m) and np.linalg.norm(np.ptp(places_m, axis=0)) > 1.0)


def spread(values, digits=2):
    values = np.asarray(values)[~np.isnan(values)] if len(values) else np.empty(0)
    return f"{values.mean():.{digits}f} ± {values.std():.{digits}f}" if len(values) else "-"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--sweeps", nargs="*", default=[], metavar="RIG=PATH", help="real sweeps of the LiDARs of a rig"
    )
    parser.add_argument("--logs", nargs="*", default=[], metavar="PATH", help="recorded objects with an ego")
    parser.add_argument("--scenarios", nargs="*", default=[*WORLDS, *TRACKS])
    parser.add_argument("--runs", type=int, default=RUNS)
    options = parser.parse_args()
    pairs = [pair.partition("=")[::2] for pair in options.sweeps]
    rigs = list(dict.fromkeys(rig for rig, _ in pairs)) or list(RIGS[:1])
    views = []
    for rig in rigs:
        views += [(rig, Path(path).stem, recorded(path)) for name, path in pairs if name == rig]
        views += [(rig, f"`{world}`", simulated(world, rig, options.runs)) for world in options.scenarios]
    print("Azimuths (%) closed by something of a height (m) above the ground within a distance (m), and open beyond.\n")
    closed = [f"{name} within {far:.0f}" for name in BANDS_M for far in WITHIN_M]
    closed = [key for key in closed if key.startswith(THINGS) or key.endswith("within 40")]
    closed += [f"{THINGS} open beyond {BEYOND_M:.0f}"]
    table(("rig", "street", *closed), [(rig, name, *mean_row(found, closed)) for rig, name, found in views])
    print("\nDirections (%) in which ground is seen in a ring (m).\n")
    rings = [key for key in views[0][2][0] if key.startswith("ground")]
    table(
        ("rig", "street", *(key.removeprefix("ground ") for key in rings)),
        [(rig, name, *mean_row(found, rings)) for rig, name, found in views],
    )
    print("\nObjects within 75 m of the ego at a time, by kind, and within distances (m).\n", flush=True)
    scenes = {Path(path).stem: [Scene.of_recording(read_objects(path))] for path in options.logs}
    for world in options.scenarios:
        scenario = Scenario.load(world)
        ego, runs = scenario.build_ego_mesh(), 1 if scenario.is_repeating else options.runs
        scenes[f"`{world}`"] = [Scene.of_world(scenario.build_scene(0, run, ego), 5.0) for run in range(runs)]
    found = {name: objects(of_name) for name, of_name in scenes.items()}
    rows = [
        (name, spread(counts.sum(axis=1), 0), *(spread(column, 1) for column in (*counts.T, *ring.T)))
        for name, (counts, ring, *_) in found.items()
    ]
    table(("street", "all", *COUNTED, *(f"within {far:.0f}" for far in DISTANCES_M)), rows)
    print("\nBodies (m): mean and spread.\n")
    sized = [
        (name, kind, size) for name, (_, _, sizes, *_) in found.items() for kind, size in sizes.items() if len(size) > 1
    ]
    table(
        ("street", "kind", "bodies", "length", "width", "height"),
        [(name, kind, len(size), *(spread(column) for column in size.T)) for name, kind, size in sized],
    )
    print("\nTraffic: cars that drive within 15 s (m/s, share that stands), people who walk, gaps ahead, and kerbs.\n")
    rows = []
    for name, (_, _, _, driving, walking) in found.items():
        both = [gaps_m(scene) for scene in scenes[name]]
        gaps, speed = (np.concatenate([one[k] for one in both]) for k in (0, 1))
        moves = speed > 2.0
        stands = f"{100 * np.mean(driving < STANDS_MPS):.0f} %" if len(driving) else "-"
        beside = [100 * kerbs(scene) for scene in scenes[name]]
        headway_s = gaps[moves] / speed[moves]
        walk = spread(walking)
        rows.append((name, spread(driving, 1), stands, walk, spread(gaps, 1), spread(headway_s, 1), spread(beside, 0)))
    table(("street", "speed", "standing", "people", "gap (m)", "gap (s)", "kerbs with vehicles (%)"), rows)
    print("\nMotion, in all drives.\n")
    moved = {
        name: [motion(scene, 0.2 if name.startswith("`") else LABELS_TREMBLE_S) for scene in of_name]
        for name, of_name in scenes.items()
    }
    table(("street", *next(iter(moved.values()))[0]), [(name, *together(each)) for name, each in moved.items()])


def together(figures):
    """Sums of counts, and the largest of what is measured."""
    for key in figures[0]:
        values = [one[key] for one in figures]
        if isinstance(values[0], str):
            parts = np.array([value.split(" of ") for value in values], dtype=int).sum(axis=0)
            yield f"{parts[0]} of {parts[1]}"
        else:
            yield sum(values) if isinstance(values[0], int) else f"{max(values):.2f}"


if __name__ == "__main__":
    main()
