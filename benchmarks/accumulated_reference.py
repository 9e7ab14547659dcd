"""How far from the truth are numbers against a reference that was accumulated from the recording itself?

A drive is simulated with two LiDARs, 0.1 s apart, with 3 cm of noise, poses and tracked boxes. The forward one is
judged; the other spins. The truth is the measure by area against the surface reference at the same instants. Height
bands of the recording are over the ground that its sweeps have seen; another table says how far that is from the truth.
"""

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from pykdtree.kdtree import KDTree

from benchmarks.recorded_measure import distance
from benchmarks.timing import table
from torchcover import BevGrid, CoverageMetric, forward_regions
from torchcover.data import (
    AccumulatedReference,
    RecordedFrames,
    Scan,
    SimulatedFrames,
    reference_called,
)
from torchcover.geometry import invert, transform
from torchcover.simulation import Lidar, PaperReference, Rig, Scenario

EVERY_S = 0.1
# A ray this near to a point that goes on so far, and by a share of the range, has passed through it.
BESIDE_M, BEYOND_M, BEYOND = 0.1, 0.5, 0.15
GRID = BevGrid(x=(0.0, 160.0), y=(-40.0, 40.0), cell=0.25, band_frame="ground")
REGIONS = forward_regions()
NOISE_M = 0.03
JUDGED = Rig.load("front_roof_128").sensors[0].model_copy(update={"columns": 900, "range_noise_m": NOISE_M})
OTHER = Lidar(
    name="other",
    channels=64,
    vertical_fov_deg=(-25.0, 5.0),
    horizontal_fov_deg=360.0,
    columns=1200,
    max_range_m=200.0,
    range_noise_m=NOISE_M,
    mount={"x_m": -0.8, "z_m": 1.95},
)
# What lies so near to the ground is of it; noise takes points below it, where no true height would be known.
OF_GROUND_M, LIFT_M = 0.1, 0.3
RANGES_M = (0.0, 40.0, 80.0, 160.0)
MOUNTS = {"judged": JUDGED.mount.matrix(), "other": OTHER.mount.matrix()}


class FreeSpace(AccumulatedReference):
    """Without the points that a ray of the instant has passed through."""

    def cloud(self, recording, index, judged):
        found = super().cloud(recording, index, judged)
        points_m, gone = found.points_m.astype(np.float64), np.zeros(len(found.points_m), dtype=bool)
        for sensor in self.sensors:
            scan = recording.scan(sensor, index)
            seen_m = transform(invert(scan.vehicle_T_sensor), points_m)
            range_m, ray_m = np.linalg.norm(seen_m, axis=1), np.linalg.norm(scan.points_m, axis=1)
            tree = KDTree((scan.points_m / ray_m[:, None]).astype(np.float32))
            apart, ray = tree.query((seen_m / range_m[:, None]).astype(np.float32), distance_upper_bound=0.02)
            ray_m = np.append(ray_m, 0.0)[ray]
            gone |= (apart * range_m < BESIDE_M) & (ray_m > range_m * (1 + BEYOND) + BEYOND_M)
        return found._replace(points_m=found.points_m[~gone])


class SimulatedDrive:
    """A `Recording` of sweeps around one instant, which is its only frame; scans are kept."""

    reference_sensors = ()
    square_metres = False
    instants = None
    body = None
    path = Path("simulated")

    def __init__(self, sweeps, instant, window_s, *, labelled=True):
        reach = round(window_s / 2 / EVERY_S)
        self._sweeps = [sweeps[number] for number in range(instant - reach, instant + reach + 1)]
        scenes = [sweeps.simulator.scene_of(sweep.index) for sweep in self._sweeps]
        self._poses = [scene.world.ego.trajectory.at(step * scene.world.time_step_s) for scene, step in scenes]
        self.sensors = tuple(sweeps.rigs)
        self.rigs = {"judged": ("judged",)}
        self.names = [sweep.name for sweep in self._sweeps]
        self.frames = [reach]
        self.times_s = EVERY_S * np.arange(len(self.names))
        self.labelled = labelled

    def scan(self, sensor, index):
        points_m = self._sweeps[index].clouds[sensor].numpy()
        mount = MOUNTS[sensor]
        return Scan(transform(invert(mount), points_m.astype(np.float64)), mount, self.names[index])

    def world_T_vehicle(self, index):
        return self._poses[index]

    def boxes(self, index):
        return self._sweeps[index].boxes if self.labelled else None


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="urban")
    parser.add_argument("--instants", type=int, default=4, help="each in a city of its own")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--hills-m", type=float, help="of a city")
    parser.add_argument("--windows", type=float, nargs="+", default=[1.0, 5.0])
    options = parser.parse_args([] if __name__ != "__main__" else None)
    torch.set_num_threads(1)
    scenario = Scenario.load(options.scenario)
    if options.hills_m is not None:
        hilly = scenario.traffic.model_copy(update={"hills_m": options.hills_m})
        scenario = scenario.model_copy(update={"traffic": hilly})
    sweeps = SimulatedFrames(
        scenario,
        rigs={sensor.name: Rig(name=sensor.name, sensors=[sensor]) for sensor in (named(JUDGED, "judged"), OTHER)},
        steps=1_000_000,
        seed=options.seed,
        every_s=EVERY_S,
        reference_sensor=PaperReference(rows=4, columns=4),
        boxes=True,
    )
    surface = sweeps.with_reference_sensor(reference_called())
    references = {"other, 0 s": AccumulatedReference(0.0, sensors=("other",))}
    for window_s in options.windows:
        for sensors in (("other",), ("judged", "other"), ("judged",)):
            references[f"{', '.join(sensors)}, {window_s:g} s"] = AccumulatedReference(window_s, sensors=sensors)
    longest = max(options.windows)
    for label in ("", ", nothing labelled"):
        if label:
            references[f"judged, other, {longest:g} s{label}"] = AccumulatedReference(longest)
        references[f"judged, other, {longest:g} s{label}, free space"] = FreeSpace(longest, sensors=("judged", "other"))
    truth = metric(square_metres=True)
    metrics, knowing = ({name: metric() for name in references} for _ in range(2))
    grounds = {name: Ground() for name in references}
    run_s = sweeps.scenario.traffic.duration_s
    for number in range(options.instants):
        instant = round((number + 0.5) * run_s / EVERY_S)
        true = surface[instant]
        truth.update(
            true.clouds["judged"],
            true.reference,
            weights=true.reference_weights,
            height=true.reference_heights_m,
        )
        drive = SimulatedDrive(sweeps, instant, longest)
        for name, reference in references.items():
            drive.labelled = "labelled" not in name
            (frame,) = RecordedFrames(drive, reference=reference)
            metrics[name].update(frame.sensor, frame.reference, height=frame.reference_heights_m)
            true_m = true_heights_m(sweeps, instant, frame.reference.numpy())
            knowing[name].update(frame.sensor, frame.reference, height=torch.from_numpy(true_m))
            grounds[name].add(frame.reference.numpy(), frame.reference_heights_m.numpy(), true_m)
    found, known = ({name: each.compute() for name, each in of.items()} for of in (metrics, knowing))
    report(truth.compute(), found)
    print()
    report_ground(grounds, found, known)


def true_heights_m(sweeps, instant, points_m):
    """(N,) above the ground of the world."""
    scene, step = sweeps.simulator.scene_of(instant)
    placed_m = transform(scene.world.ego.trajectory.at(step * scene.world.time_step_s), points_m.astype(np.float64))
    return scene.ground.heights_m(placed_m + np.array([0.0, 0.0, LIFT_M]), np.eye(4)) - np.float32(LIFT_M)


class Ground:
    """How far modelled heights are from the truth, by range."""

    def __init__(self):
        self.seen = []

    def add(self, points_m, found_m, true_m):
        self.seen.append(np.stack([np.hypot(*points_m[:, :2].T), found_m, true_m]))

    def rows(self):
        """Range, and of what lies on the ground the share with a height and the rms; shares in a wrong band."""
        range_m, found_m, true_m = np.concatenate(self.seen, axis=1)
        edges_m = [edge for _, edge in GRID.heights.values()]
        band, true_band = (np.digitize(of, [-0.5, *edges_m]) for of in (found_m, true_m))
        for near_m, far_m in pairwise(RANGES_M):
            here = (range_m >= near_m) & (range_m < far_m)
            known, ground = here & np.isfinite(found_m), here & (np.abs(true_m) < OF_GROUND_M)
            off_m, above = (found_m - true_m), here & (true_m >= OF_GROUND_M)
            shares = [f"{100 * np.isfinite(found_m[of]).mean():.1f}" for of in (ground, above)]
            rms = [f"{100 * np.sqrt((off_m[known & of] ** 2).mean()):.1f}" for of in (ground, above)]
            wrong = [f"{100 * (band != true_band)[known & (true_band == number)].mean():.2f}" for number in (1, 2)]
            yield f"{near_m:g} to {far_m:g} m", shares[0], rms[0], shares[1], rms[1], *wrong


def report_ground(grounds, found, known):
    heading = ("on the ground: known (%)", "rms (cm)", "above it: known (%)", "rms (cm)")
    own = {name: ground for name, ground in grounds.items() if "free space" not in name}
    rows = [(name, *row) for name, ground in own.items() for row in ground.rows()]
    table(("reference", "range", *heading, "ground in a wrong band (%)", "obstacles in a wrong band (%)"), rows)
    print()
    rows = []
    for name in own:
        one, other = numbers(found[name], "known"), numbers(known[name], "known")
        moves = np.stack([100 * (one[:, 1] - other[:, 1]), 100 * (one[:, 0] / other[:, 0] - 1)], axis=1)
        rows.append((name, *(f"{points:+.2f} / {share:+.1f}" for points, share in moves)))
    strata = (f"{region.name} {height}" for region in REGIONS for height in GRID.heights)
    table(("reference, modelled less true heights", *strata), rows)


def named(sensor, name):
    return sensor.model_copy(update={"name": name})


def metric(**options):
    return CoverageMetric(GRID, max_radius=GRID.diagonal_m, **options)


def report(truth, coverages):
    by_area = numbers(truth, "area")
    rows = [("the surface, by area: the truth", "", "", *words(truth, "area"))]
    for name, coverage in {"the surface, known cells": truth, **coverages}.items():
        rows.append((name, *distance(numbers(coverage, "known"), by_area), *words(coverage, "known")))
    strata = (f"{region.name} {height}" for region in REGIONS for height in GRID.heights)
    table(("reference", "rms", "worst", *strata), rows)


def numbers(coverage, measure):
    """(regions and bands, 2) radius and detection."""
    rows = coverage.summary(REGIONS)
    found = [row.numbers if measure == "area" else row.known for row in rows]
    return np.array([[one["radius_m"].value, one["detection_0.4m"].value] for one in found])


def words(coverage, measure):
    return [f"{100 * detection:.0f} % / {radius_m:.2f} m" for radius_m, detection in numbers(coverage, measure)]


if __name__ == "__main__":
    main()
