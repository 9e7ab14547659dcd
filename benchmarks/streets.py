"""Built-in worlds beside recorded streets: what closes the view, visible ground, objects, kerbs, speeds, motion.

`python -m benchmarks.streets --sweeps RIG=PATH ... --logs PATH ...` prints real streets, too: sweeps in files or
recordings, and recorded objects. A sweep is compared with the clouds of the same rig in each world, and both go through
the same estimator: the ground is a field through the cloud's own low surfaces, and heights are above that.
"""

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.motion import STANDS_MPS, Scene, gaps_m, kerbs, motion, near
from benchmarks.timing import table
from torchcover.data import open_recording, read_cloud, read_objects
from torchcover.recordings.ground_model import GroundModel, low_surfaces
from torchcover.recordings.in_vehicle import in_vehicle
from torchcover.recordings.recording import Scan
from torchcover.simulation import PaperReference, Rig, Scenario, Simulator

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
KINDS = ("car", "lorry or bus", "two wheels", "person", "other")


def sight(points_m):
    """Shares (%) of the azimuths that are closed within distances by each band, open beyond, and with ground in rings.

    Args:
        points_m: (N, 3) a cloud in a frame whose z points up and whose origin is on the vehicle or above it.
    """
    points_m = np.asarray(points_m, dtype=np.float64)
    points_m = points_m[np.hypot(*points_m.T[:2]) > OWN_M]
    low_m = points_m[np.hypot(*points_m.T[:2]) < 10.0, 2]
    ground = GroundModel.below([low_surfaces(points_m, np.zeros(3))], np.array([0.0, 0.0, np.quantile(low_m, 0.1)]))
    if ground is None:
        raise ValueError("no ground is seen around the vehicle")
    height_m, range_m = ground.heights_m(points_m), np.hypot(*points_m.T[:2])
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
    every_s = None if scenario.repeats else EVERY_S
    simulator = Simulator(scenario, {"rig": rig}, PaperReference(rows=2, columns=2), seed=seed, every_s=every_s)
    return [
        sight(np.concatenate([scan.points for scan in simulator.scans(index)["rig"]]))
        for index in range(1 if scenario.repeats else runs)
    ]


def recorded(path):
    """`sight` of a sweep in a file, or of all those of a recording."""
    if Path(path).is_file():
        return [sight(in_vehicle(Scan(np.asarray(read_cloud(path))[:, :3], None, str(path))).points_m)]
    recording = open_recording(path)
    return [
        sight(
            np.concatenate([in_vehicle(recording.scan(name, k), recording.body).points_m for name in recording.sensors])
        )
        for k in recording.frames
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
    counts = np.array([[sum(body.kind == kind for body, _, _ in moment) for kind in KINDS] for moment in moments])
    rings = np.array([[sum(away < far for _, away, _ in moment) for far in DISTANCES_M] for moment in moments])
    bodies = {id(body): body for moment in moments for body, _, _ in moment}.values()
    sizes = {kind: np.array([body.size_m for body in bodies if body.kind == kind]) for kind in KINDS}
    driving = [
        speed for time_s, moment in timed for body, _, speed in moment if body.kind == "car" and drives(body, time_s)
    ]
    people = [speed for moment in moments for body, _, speed in moment if body.kind == "person" and body.ever_moves]
    return counts, rings, sizes, np.array(driving), np.array(people)


def drives(body, time_s):
    """Whether it gets anywhere around a time, in as long as a log takes: who waits for longer looks parked there."""
    places_m = body.trajectory.positions_at(time_s + LOG_S * np.linspace(-0.5, 0.5, 16))[:, :2]
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
    parser.add_argument("--worlds", nargs="*", default=[*WORLDS, *TRACKS])
    parser.add_argument("--runs", type=int, default=RUNS)
    options = parser.parse_args([] if __name__ != "__main__" else None)
    pairs = [pair.partition("=")[::2] for pair in options.sweeps]
    rigs = list(dict.fromkeys(rig for rig, _ in pairs)) or list(RIGS[:1])
    views = []
    for rig in rigs:
        views += [(rig, Path(path).stem, recorded(path)) for name, path in pairs if name == rig]
        views += [(rig, f"`{world}`", simulated(world, rig, options.runs)) for world in options.worlds]
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
    for world in options.worlds:
        scenario = Scenario.load(world)
        ego, runs = scenario.ego_mesh(), 1 if scenario.repeats else options.runs
        scenes[f"`{world}`"] = [Scene.of_world(scenario.world(0, run, ego), 5.0) for run in range(runs)]
    found = {name: objects(of_name) for name, of_name in scenes.items()}
    rows = [
        (name, spread(counts.sum(axis=1), 0), *(spread(column, 1) for column in (*counts.T, *ring.T)))
        for name, (counts, ring, *_) in found.items()
    ]
    table(("street", "all", *KINDS, *(f"within {far:.0f}" for far in DISTANCES_M)), rows)
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
