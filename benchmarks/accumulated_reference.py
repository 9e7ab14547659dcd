"""How far from the truth are numbers against a reference that was accumulated from the recording itself?

A drive is simulated with two LiDARs, 0.1 s apart, with poses and tracked boxes. The forward one is judged; the other
spins. The truth is the measure by area against the surface reference at the same instants, over bands of local ground.

With `--ground`, ranges have noise, and the question is how far the heights above the ground that these sweeps have seen
are from those of the world, and how far that moves the numbers.
"""

import argparse
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from benchmarks.recorded_measure import distance
from benchmarks.timing import table
from torchcover import BevGrid, CoverageMetric, forward_regions
from torchcover.data import (
    AccumulatedReference,
    RecordedFrames,
    RegionsOfInterest,
    Scan,
    SimulatedFrames,
    reference_called,
)
from torchcover.geometry import invert, transform
from torchcover.simulation import Lidar, PaperReference, Rig, Scenario

EVERY_S = 0.1
# Scans before and after the window look at what is in it, too.
MARGIN_S = 1.0
GRID = BevGrid(x=(0.0, 160.0), y=(-40.0, 40.0), cell=0.25, band_frame="ground")
TRUTH_RAYS = 65_536
REGIONS = forward_regions()
JUDGED = Rig.load("front_roof_128").sensors[0].model_copy(update={"columns": 900})
OTHER = Lidar(
    name="other",
    channels=64,
    vertical_fov_deg=(-25.0, 5.0),
    horizontal_fov_deg=360.0,
    columns=1200,
    max_range_m=200.0,
    mount={"x_m": -0.8, "z_m": 1.95},
)
# With the ground: noise, how near to it points lie on it, and how far up they are lifted, lest noise takes them below.
NOISE_M, ON_GROUND_M, LIFT_M = 0.03, 0.1, 0.3
RANGES_M = (0.0, 40.0, 80.0, 160.0)
MOUNTS = {"judged": JUDGED.mount.matrix(), "other": OTHER.mount.matrix()}


class SimulatedDrive:
    """A `Recording` of sweeps around one instant, which is its only frame; scans are kept."""

    reference_sensors = ()
    square_metres = False
    instants = None
    path = Path("simulated")

    def __init__(self, sweeps, instant, window_s, *, labelled=True):
        reach = round((window_s / 2 + MARGIN_S) / EVERY_S)
        self._sweeps = [sweeps[number] for number in range(instant - reach, instant + reach + 1)]
        scenes = [sweeps.simulator.scene_of(sweep.index) for sweep in self._sweeps]
        self._poses = [scene.world.ego.trajectory.at(step * scene.world.time_step_s) for scene, step in scenes]
        self.sensors = tuple(sweeps.rigs)
        self.rigs = {"judged": ("judged",)}
        self.names = [sweep.name for sweep in self._sweeps]
        self.frames = [reach]
        self.times_s = EVERY_S * np.arange(len(self.names))
        self.labelled = labelled
        self.body = sweeps.scenario.ego_box()

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
    parser.add_argument("--ground", action="store_true")
    parser.add_argument("--hills-m", type=float, help="of a city")
    parser.add_argument("--windows", type=float, nargs="+", default=[2.0, 5.0])
    options = parser.parse_args([] if __name__ != "__main__" else None)
    torch.set_num_threads(1)
    sweeps = drive(options)
    if options.ground:
        heights(sweeps, options)
        return
    surface = sweeps.with_reference_sensor(
        reference_called(rays=TRUTH_RAYS, asked=RegionsOfInterest().around(sweeps.ego_outline_m))
    )
    cases = [
        (f"{', '.join(sensors)}, {window_s:g} s, {'labels' if labelled else 'none'}", sensors, window_s, labelled)
        for window_s in options.windows
        for sensors in (("judged",), ("judged", "other"))
        for labelled in (True, False)
    ]
    truths = {rig: metric() for rig in MOUNTS}
    metrics = {(name, rig): metric() for name, *_ in cases for rig in MOUNTS}
    spent_s = dict.fromkeys((name for name, *_ in cases), 0.0)
    for number in range(options.instants):
        instant = round((number + 0.5) * sweeps.scenario.traffic.duration_s / EVERY_S)
        true = surface[instant]
        for rig, of in truths.items():
            added(of, true, rig)
        for name, sensors, window_s, labelled in cases:
            recording = SimulatedDrive(sweeps, instant, window_s, labelled=labelled)
            recording.rigs = {rig: (rig,) for rig in sensors}
            start_s = time.process_time()
            (frame,) = RecordedFrames(recording, reference=AccumulatedReference(window_s, sensors=sensors))
            spent_s[name] += (time.process_time() - start_s) / options.instants
            for rig in sensors:
                added(metrics[name, rig], frame, rig)
    by_area = {rig: numbers(of.compute(), "area") for rig, of in truths.items()}
    rows = [("the truth", "", "", "", *words(by_area["judged"]))]
    for name, sensors, *_ in cases:
        found = {rig: numbers(metrics[name, rig].compute(), "area") for rig in sensors}
        between = ""
        if len(sensors) == 2:
            apart = [of["judged"] - of["other"] for of in (found, by_area)]
            between = f"{100 * np.sqrt(np.nanmean((apart[0] - apart[1])[:, 1] ** 2)):.1f}"
        off = distance(found["judged"], by_area["judged"])
        rows.append((name, *off, between, f"{spent_s[name]:.1f}", *words(found["judged"])))
    rows[0] = (*rows[0][:4], "", *rows[0][4:])
    strata = (f"{region.name} {height}" for region in REGIONS for height in GRID.heights)
    table(("reference", "rms", "worst", "rms of the difference", "processor s", *strata), rows)


def added(to, frame, rig):
    """Add a frame to a metric."""
    heights_m, weights = frame.reference_heights_m, frame.reference_weights
    to.update(frame.clouds[rig], frame.reference, weights=weights, height=heights_m)


def drive(options):
    """The sweeps of both LiDARs."""
    scenario, noise_m = Scenario.load(options.scenario), NOISE_M if options.ground else 0.0
    if options.hills_m is not None:
        hilly = scenario.traffic.model_copy(update={"hills_m": options.hills_m})
        scenario = scenario.model_copy(update={"traffic": hilly})
    lidars = (named(sensor, name, range_noise_m=noise_m) for sensor, name in ((JUDGED, "judged"), (OTHER, "other")))
    return SimulatedFrames(
        scenario,
        rigs={sensor.name: Rig(name=sensor.name, sensors=[sensor]) for sensor in lidars},
        steps=1_000_000,
        seed=options.seed,
        every_s=EVERY_S,
        reference_sensor=PaperReference(rows=4, columns=4),
        boxes=True,
    )


def heights(sweeps, options):
    """Print how far heights are from the truth by range, and numbers with them from those with the true ones."""
    grid, rows, moves = GRID, [], []
    references = {"the instant": (0.0, ("other",), True)}
    for window_s in options.windows:
        references[f"{window_s:g} s"] = window_s, ("judged", "other"), True
    references[f"{options.windows[-1]:g} s, nothing labelled"] = options.windows[-1], ("judged", "other"), False
    instants = [
        round((number + 0.5) * sweeps.scenario.traffic.duration_s / EVERY_S) for number in range(options.instants)
    ]
    for name, (window_s, sensors, labelled) in references.items():
        found, known = (CoverageMetric(grid, max_radius=grid.diagonal_m) for _ in range(2))
        seen = []
        for instant in instants:
            recording = SimulatedDrive(sweeps, instant, window_s, labelled=labelled)
            frames = RecordedFrames(recording, reference=AccumulatedReference(window_s, sensors=sensors))
            (frame,) = frames
            true_m = true_heights_m(sweeps, instant, frame.reference.numpy().astype(np.float64))
            for metric_of, heights_m in ((found, frame.reference_heights_m), (known, torch.from_numpy(true_m))):
                metric_of.update(frame.sensor, frame.reference, height=heights_m)
            range_m = torch.linalg.vector_norm(frame.reference[:, :2], dim=1).numpy()
            seen.append(np.stack([range_m, frame.reference_heights_m.numpy(), true_m]))
        rows += [(name, *row) for row in by_range(*np.concatenate(seen, axis=1), grid)]
        one, other = (numbers(of.compute(), "known") for of in (found, known))
        apart = np.stack([100 * (one[:, 1] - other[:, 1]), 100 * (one[:, 0] / other[:, 0] - 1)], axis=1)
        moves.append((name, *(f"{points:+.2f} / {share:+.1f}" for points, share in apart)))
    on, above = ("known on the ground (%)", "rms (cm)"), ("known above it (%)", "rms (cm)")
    table(("reference", "range", *on, *above, "ground in a wrong band (%)", "obstacles in a wrong band (%)"), rows)
    print()
    table(("reference", *(f"{region.name} {height}" for region in REGIONS for height in GRID.heights)), moves)


def true_heights_m(sweeps, instant, points_m):
    """(N,) of points in the vehicle frame above the ground of the world."""
    scene, step = sweeps.simulator.scene_of(instant)
    placed_m = transform(scene.world.ego.trajectory.at(step * scene.world.time_step_s), points_m)
    return scene.ground.heights_m(placed_m + np.array([0.0, 0.0, LIFT_M]), np.eye(4)) - np.float32(LIFT_M)


def by_range(range_m, found_m, true_m, grid):
    """Range; of what lies on the ground, and above it, the share with a height and the rms; shares in a wrong band."""
    edges_m = [-0.5, *(edge for _, edge in grid.heights.values())]
    band, true_band = (np.digitize(of, edges_m) for of in (found_m, true_m))
    for near_m, far_m in pairwise(RANGES_M):
        here = (range_m >= near_m) & (range_m < far_m)
        row = [f"{near_m:g} to {far_m:g} m"]
        for of in (here & (np.abs(true_m) < ON_GROUND_M), here & (true_m >= ON_GROUND_M)):
            rms_m = np.sqrt(np.nanmean((found_m[of] - true_m[of]) ** 2))
            row += [f"{100 * np.isfinite(found_m[of]).mean():.1f}", f"{100 * rms_m:.1f}"]
        for number in (1, 2):
            of = here & np.isfinite(found_m) & (true_band == number)
            row.append(f"{100 * (band != true_band)[of].mean():.2f}")
        yield row


def named(sensor, name, **more):
    return sensor.model_copy(update={"name": name, **more})


def metric():
    return CoverageMetric(GRID, max_radius=GRID.diagonal_m, square_metres=True)


def numbers(coverage, measure):
    """(regions and bands, 2) radius and detection."""
    rows = coverage.summary(REGIONS)
    found = [row.numbers if measure == "area" else row.known for row in rows]
    return np.array([[one["radius_m"].value, one["detection_0.4m"].value] for one in found])


def words(rows):
    return [f"{100 * detection:.0f} % / {radius_m:.2f} m" for radius_m, detection in rows]


if __name__ == "__main__":
    main()
