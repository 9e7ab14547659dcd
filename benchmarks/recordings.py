"""How far from the truth are numbers against a reference that was accumulated from the recording itself?

A drive is simulated with two LiDARs, 0.1 s apart, with poses and tracked boxes. The forward one is judged; the other
spins. The truth is the measure by area against the surface reference at the same instants, over bands of local ground.

`imperfect`: ranges of the recording have noise, and its poses errors. A second table says of how many that move the
reference has found the velocity.

With `--ground`, ranges have noise, and the question is how far the heights above the ground that these sweeps have seen
are from those of the world, and how far that moves the numbers.
"""

import argparse
import time
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from benchmarks import table
from torchcover import BevGrid, CoverageMetric, forward_regions
from torchcover.data import (
    AccumulatedReference,
    RecordedFrames,
    RegionsOfInterest,
    Scan,
    SimulatedFrames,
    create_reference_sensor,
)
from torchcover.detection import find_points_in_boxes
from torchcover.geometry import build_transform, convert_euler_to_rotation, invert, transform_points
from torchcover.recordings.moving_clusters import MovingClusterParams, find_moving_clusters
from torchcover.recordings.recording import Recording
from torchcover.simulation import Lidar, PaperReference, Rig, Scenario

EVERY_S = 0.1
# Scans before and after the window look at what is in it, too.
MARGIN_S = 1.0
GRID = BevGrid(x_m=(0.0, 160.0), y_m=(-40.0, 40.0), cell_m=0.25, band_frame="ground")
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
# Errors of poses: of places, and of angles in degrees.
POSE_ERROR_M, POSE_ERROR_DEG = 0.05, 0.1
# Vehicles that move so fast and have so many points are to be found with a velocity that is off by no more.
MOVES_MPS, POINTS, WITHIN_MPS, LEAST_LENGTH_M = 0.5, 50, 0.5, 3.0
# With the ground: noise, how near to it points lie on it, and how far up they are lifted, lest noise takes them below.
NOISE_M, ON_GROUND_M, LIFT_M = 0.03, 0.1, 0.3
RANGES_M = (0.0, 40.0, 80.0, 160.0)
MOUNTS = {"judged": JUDGED.mount.to_matrix(), "other": OTHER.mount.to_matrix()}


class Case(NamedTuple):
    """A reference that is looked at: the sensors that take part, its window, and what the recording is like."""

    sensors: tuple[str, ...]
    window_s: float
    labelled: bool
    imperfect: bool = False

    def __str__(self):
        labels = "labels" if self.labelled else "none"
        return f"{', '.join(self.sensors)}, {self.window_s:g} s, {labels}{', imperfect' if self.imperfect else ''}"


class SimulatedDrive(Recording):
    """A `Recording` of sweeps around one instant, which is its only frame; scans are kept."""

    path = Path("simulated")

    def __init__(self, sweeps, instant, window_s, *, labelled=True):
        reach = round((window_s / 2 + MARGIN_S) / EVERY_S)
        self._sweeps = [sweeps[number] for number in range(instant - reach, instant + reach + 1)]
        scenes = [sweeps.simulator.get_scene_geometry(sweep.index) for sweep in self._sweeps]
        self._poses = [scene.scene.ego.trajectory.interpolate(step * scene.scene.time_step_s) for scene, step in scenes]
        self.sensors = tuple(sweeps.rigs)
        self.rigs = {"judged": ("judged",)}
        self.frame_names = [sweep.name for sweep in self._sweeps]
        self.key_frames = [reach]
        self.times_s = EVERY_S * np.arange(len(self.frame_names))
        self.labelled, self.imperfect = labelled, False
        self.ego_box = sweeps.scenario.compute_ego_box()

    def read_scan(self, sensor, index):
        mount = MOUNTS[sensor]
        points_m = transform_points(invert(mount), self._sweeps[index].clouds[sensor].numpy().astype(np.float64))
        if self.imperfect:
            range_m = np.linalg.norm(points_m, axis=1, keepdims=True)
            points_m *= 1 + np.random.default_rng(index).normal(0, NOISE_M, range_m.shape) / range_m
        return Scan(points_m, mount, self.frame_names[index])

    def get_world_T_vehicle(self, index):
        if not self.imperfect:
            return self._poses[index]
        random = np.random.default_rng(index)
        off = build_transform(
            convert_euler_to_rotation(*random.normal(0, POSE_ERROR_DEG, 3)), random.normal(0, POSE_ERROR_M, 3)
        )
        return self._poses[index] @ off

    def read_boxes(self, index):
        return self.true_boxes(index) if self.labelled else None

    def true_boxes(self, index):
        return self._sweeps[index].boxes


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="urban")
    parser.add_argument("--instants", type=int, default=4, help="each in a city of its own")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ground", action="store_true")
    parser.add_argument("--hills-m", type=float, help="of a city")
    parser.add_argument("--windows", type=float, nargs="+", default=[2.0, 5.0])
    options = parser.parse_args()
    torch.set_num_threads(1)
    sweeps = drive(options)
    if options.ground:
        heights(sweeps, options)
        return
    cases = [
        case
        for window_s in options.windows
        for case in (
            Case(("judged",), window_s, True),
            Case(("judged",), window_s, False),
            Case(("judged",), window_s, False, imperfect=True),
            Case(("other",), window_s, False),
            Case(("judged", "other"), window_s, False),
        )
    ]
    tables(cases, *measured(sweeps, cases, options.instants, max(options.windows)))


def measured(sweeps, cases, many, longest_s):
    """The true numbers of each rig; of each case those of its rigs, the processor time a frame, and `found_movers`."""
    surface = sweeps.replace_reference_sensor(
        create_reference_sensor(
            num_rays=TRUTH_RAYS, query_plan=RegionsOfInterest().build_query_plan(sweeps.metadata.ego_outline_m)
        )
    )
    truths = {rig: metric() for rig in MOUNTS}
    metrics = {case: {rig: metric() for rig in case.sensors} for case in cases}
    spent_s, movers_of = dict.fromkeys(cases, 0.0), {case: [] for case in cases if not case.labelled}
    for number in range(many):
        instant = round((number + 0.5) * sweeps.scenario.traffic.duration_s / EVERY_S)
        true = surface[instant]
        for rig, of in truths.items():
            added(of, true, rig)
        recording = SimulatedDrive(sweeps, instant, longest_s)
        for case in cases:
            recording.labelled, recording.imperfect = case.labelled, case.imperfect
            recording.rigs = {rig: (rig,) for rig in case.sensors}
            reference = AccumulatedReference(case.window_s, sensors=case.sensors)
            start_s = time.process_time()
            (frame,) = RecordedFrames(recording, reference=reference)
            spent_s[case] += (time.process_time() - start_s) / many
            for rig in case.sensors:
                added(metrics[case][rig], frame, rig)
            if not case.labelled:
                movers_of[case] += found_movers(recording, reference, frame)
    by_area = [{rig: numbers(of.compute(), "area") for rig, of in rigs.items()} for rigs in (truths, *metrics.values())]
    return by_area[0], dict(zip(cases, by_area[1:], strict=True)), spent_s, movers_of


def tables(cases, truths, found, spent_s, movers_of):
    """Print what was measured."""
    rows = [(f"the truth, {rig}", *5 * ("",), *words(of)) for rig, of in truths.items()]
    for case in cases:
        rig, between, from_labels = case.sensors[0], "", ""
        if len(case.sensors) == 2:
            apart = [of["judged"] - of["other"] for of in (found[case], truths)]
            between = f"{100 * np.sqrt(np.nanmean((apart[0] - apart[1])[:, 1] ** 2)):.1f}"
        labelled = case._replace(labelled=True)
        if labelled in found and not case.labelled:
            from_labels, _ = distance(found[case][rig], found[labelled][rig])
        off = distance(found[case][rig], truths[rig])
        rows.append((str(case), *off, from_labels, between, f"{spent_s[case]:.1f}", *words(found[case][rig])))
    strata = (f"{region.name} {height}" for region in REGIONS for height in GRID.heights)
    header = "reference", "rms", "worst", "rms from that with labels", "rms of the difference", "processor s"
    table((*header, *strata), rows)
    print()
    rows = []
    for case, off_mps in movers_of.items():
        right = sum(off <= WITHIN_MPS for off in off_mps)
        rows.append((str(case), len(off_mps), f"{right} ({right / max(len(off_mps), 1):.0%})", off_mps.count(np.inf)))
    moving = f"vehicles that move, with {POINTS} points or more"
    table(("reference", moving, f"found within {WITHIN_MPS:g} m/s", "not found at all"), rows)


def found_movers(recording, reference, frame):
    """How far off in m/s is each vehicle that moves and has enough points; inf for one that is not found."""
    instant = recording.key_frames[0]
    time_s, loose_m, apart_s = recording.times_s[instant], [], []
    vehicle_T_local = invert(reference.sweep_window.compute_local_T_vehicle(recording, instant))
    for (_, index), (points_m, told) in reference.classify_points(recording, instant).items():
        own_m = transform_points(vehicle_T_local, points_m[told > 0])
        since_s = recording.times_s[index] - time_s
        if abs(since_s) <= MovingClusterParams().max_compared_s:
            loose_m.append(own_m[np.linalg.norm(own_m[:, :2], axis=1) < MovingClusterParams().max_range_m])
            apart_s.append(since_s)
    found = find_moving_clusters(loose_m, np.array(apart_s))
    places_m = torch.from_numpy(np.concatenate([np.empty((0, 3)), *(of.points_m for of in found)])).float()
    whose = np.repeat(np.arange(len(found)), [len(of.points_m) for of in found])
    boxes = recording.true_boxes(instant)
    cloud = torch.cat([frame.clouds[sensor] for sensor in reference.sensors])
    count = torch.bincount(find_points_in_boxes(cloud, boxes).box_indices, minlength=len(boxes))
    inside, off_mps = find_points_in_boxes(places_m, boxes), []
    for number in np.flatnonzero(count >= POINTS):
        velocity_mps, far_m = boxes.velocity_mps[number].numpy(), np.linalg.norm(boxes.center_m[number, :2])
        moves = np.linalg.norm(velocity_mps) > MOVES_MPS and boxes.size_m[number, 0] > LEAST_LENGTH_M
        if moves and far_m < MovingClusterParams().max_range_m:
            own = whose[inside.point_indices[inside.box_indices == number].numpy()]
            of = found[np.bincount(own).argmax()].velocity_mps if len(own) else np.inf
            off_mps.append(float(np.linalg.norm(of - velocity_mps)))
    return off_mps


def distance(value, other):
    """The root mean square over regions and bands, and the worst: points of detection / per cent of the radius."""
    apart = np.stack([100 * (value[:, 1] - other[:, 1]), 100 * (value[:, 0] / other[:, 0] - 1)])
    worst = np.take_along_axis(apart, np.nanargmax(np.abs(apart), axis=1)[:, None], axis=1)[:, 0]
    rms = np.sqrt(np.nanmean(apart**2, axis=1))
    return f"{rms[0]:.1f} / {rms[1]:.0f}", f"{worst[0]:+.1f} / {worst[1]:+.0f}"


def added(to, frame, rig):
    """Add a frame to a metric."""
    heights_m, weights = frame.reference_heights_m, frame.reference_weights
    to.update(frame.clouds[rig], frame.reference, weights=weights, heights_m=heights_m)


def drive(options):
    """The sweeps of both LiDARs."""
    scenario, noise_m = Scenario.load(options.scenario), NOISE_M if options.ground else 0.0
    if options.hills_m is not None:
        hilly = scenario.traffic.model_copy(update={"hill_height_std_m": options.hills_m})
        scenario = scenario.model_copy(update={"traffic": hilly})
    lidars = (named(sensor, name, range_noise_m=noise_m) for sensor, name in ((JUDGED, "judged"), (OTHER, "other")))
    return SimulatedFrames(
        scenario,
        rigs={sensor.name: Rig(name=sensor.name, sensors=[sensor]) for sensor in lidars},
        num_frames=1_000_000,
        seed=options.seed,
        frame_interval_s=EVERY_S,
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
        found, known = (CoverageMetric(grid, max_radius_m=grid.diagonal_m) for _ in range(2))
        seen = []
        for instant in instants:
            recording = SimulatedDrive(sweeps, instant, window_s, labelled=labelled)
            frames = RecordedFrames(recording, reference=AccumulatedReference(window_s, sensors=sensors))
            (frame,) = frames
            true_m = true_heights_m(sweeps, instant, frame.reference.numpy().astype(np.float64))
            for metric_of, heights_m in ((found, frame.reference_heights_m), (known, torch.from_numpy(true_m))):
                metric_of.update(frame.sensor, frame.reference, heights_m=heights_m)
            range_m = torch.linalg.vector_norm(frame.reference[:, :2], dim=1).numpy()
            seen.append(np.stack([range_m, frame.reference_heights_m.numpy(), true_m]))
        rows += [(name, *row) for row in by_range(*np.concatenate(seen, axis=1), grid)]
        one, other = (numbers(of.compute(), "cells") for of in (found, known))
        apart = np.stack([100 * (one[:, 1] - other[:, 1]), 100 * (one[:, 0] / other[:, 0] - 1)], axis=1)
        moves.append((name, *(f"{points:+.2f} / {share:+.1f}" for points, share in apart)))
    on, above = ("known on the ground (%)", "rms (cm)"), ("known above it (%)", "rms (cm)")
    table(("reference", "range", *on, *above, "ground in a wrong band (%)", "obstacles in a wrong band (%)"), rows)
    print()
    table(("reference", *(f"{region.name} {height}" for region in REGIONS for height in GRID.heights)), moves)


def true_heights_m(sweeps, instant, points_m):
    """(N,) of points in the vehicle frame above the ground of the world."""
    scene, step = sweeps.simulator.get_scene_geometry(instant)
    placed_m = transform_points(scene.scene.ego.trajectory.interpolate(step * scene.scene.time_step_s), points_m)
    return scene.ground.compute_heights_m(placed_m + np.array([0.0, 0.0, LIFT_M]), np.eye(4)) - np.float32(LIFT_M)


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
    return CoverageMetric(GRID, max_radius_m=GRID.diagonal_m, has_area_weights=True)


def numbers(coverage, measure):
    """(regions and bands, 2) radius and detection."""
    rows = coverage.summary(REGIONS)
    found = [row.numbers if measure == "area" else row.cell_averages for row in rows]
    return np.array([[one["radius_m"].value, one["detection_0.4m"].value] for one in found])


def words(rows):
    return [f"{100 * detection:.0f} % / {radius_m:.2f} m" for radius_m, detection in rows]


if __name__ == "__main__":
    main()
