"""Compare the sensor models with real sweeps, and the coverage of imperfect sensors with that of ideal ones.

`python -m benchmarks.sensor_models` prints the coverage of imperfect sensors; with `RIG=RECORDING ...`, such as
`argoverse2=LOG`, it compares returns from the road and from vehicles, blind cones and blocked sectors of recordings
with the same sensors simulated.
"""

import argparse
from itertools import pairwise
from pathlib import Path

import matplotlib as mpl
import numpy as np
import torch

from benchmarks import table
from torchcover import BevGrid, CoverageMetric
from torchcover.data import SimulatedFrames, open_recording
from torchcover.geometry import invert, transform_points
from torchcover.recordings.vehicle_cloud import transform_to_vehicle
from torchcover.simulation import Lidar, Material, PaperReference, Rig, Scenario, Simulator
from torchcover.simulation.recorded_returns import fit_returns
from torchcover.simulation.returns import compute_log_excess, compute_return_probability
from torchcover.simulation.road_returns import RoadParams, count_ground_rays, fit_road_profile

BINS_M = (10.0, 20.0, 30.0, 40.0, 50.0, 70.0, 100.0)
VEHICLE_BINS_M = (5.0, 10.0, 20.0, 40.0, 60.0, 100.0)
ENOUGH_RAYS = 200
# About so many rays have a row in one sector, and meet one spot.
RAYS_OF_A_CELL = 2.5
# Every other stripe of azimuths is fitted, the others are judged; then the other way round.
STRIPE_DEG = 2.0
DIRECTIONS = {"ahead": 0.0, "left": 90.0, "behind": 180.0, "right": -90.0}
SECTOR_DEG, OPEN_SHARE = 3.0, 0.6
# Rays that look so far down meet road or what stands on it, and no car hides them.
STEEP_DEG = (-12.0, -4.0)
# Heights of a box, as shares, where paint and where windows are; and how far a return may lie off its side.
PARTS = {"paint": (-0.3, 0.05, "car_paint"), "windows": (0.1, 0.45, "car_windows")}
OFF_BOX_M = 1.5
VEHICLES = ("vehicle", "car", "truck", "bus", "van")
# Points from whose rows is told what a turn was moved by, and less than what is none.
MOVED_M, MOVED_BY_M = (3.0, 30.0), 0.5
LEAST_WAY_M = 0.4
PLAIN = {
    "name": "plain",
    "ego": {"pose": {}},
    "bodies": [{"name": "plain", "ground": True, "shape": {"type": "plane", "size_m": [400.0, 400.0]}}],
}
NUM_FRAMES = 12
EVERY_S = 15.0
GRID = BevGrid(x_m=(0.0, 80.0), y_m=(-20.0, 20.0), band_frame="ground")
LIDAR, CAMERAS = "front_roof_128", "three_cameras"
IMPERFECT = {
    LIDAR: [{}, *({"range_noise_m": sigma_m} for sigma_m in (0.03, 0.1, 0.5, 3.0)), {"dropout": 0.3}],
    CAMERAS: [{}, {"range_noise_share": 0.05}, {"stereo": {"baseline_m": 0.3, "subpixel_px": 0.25}}],
}


def probabilities(rays, material, range_at_10_percent_m, spread):
    excess = compute_log_excess(
        rays.range_m,
        rays.cos_incidence,
        material.numeric_reflectivity,
        material.incidence_exponent,
        range_at_10_percent_m,
    )
    return compute_return_probability(excess, spread, material.log_reflectivity_std)


def predicted(rays, road):
    """(C,) P(return) of each cell, fitted to the other stripes."""
    first = np.floor((rays.azimuth_deg + 180.0) / STRIPE_DEG) % 2 == 0
    probability = np.empty(len(first))
    for half in (first, ~first):
        fit = fit_returns(rays.select(~half), road)
        probability[half] = probabilities(rays.select(half), road, fit.range_at_10_percent_m, fit.log_range_std)
    return probability


def by_range(rays, lidar, road):
    """A row for each bin: rays, and P(return) real, fitted to the other half, and of the rig's own numbers."""
    fitted = predicted(rays, road)
    own = probabilities(rays, road, lidar.range_at_10_percent_m or np.inf, lidar.log_range_std)
    rows = []
    for low_m, high_m in pairwise(BINS_M):
        there = (rays.range_m >= low_m) & (rays.range_m < high_m)
        count = rays.ray_counts[there].sum()
        if count >= 10:
            shares = (rays.return_counts, fitted * rays.ray_counts, own * rays.ray_counts)
            rows.append((low_m, high_m, count, *(one[there].sum() / count for one in shares)))
    return np.array(rows)


def misfit(rows, column):
    """Largest difference of P(return), and rms ln(real / modelled) of the density, in bins with enough rays."""
    enough = rows[rows[:, 2] >= ENOUGH_RAYS]
    real, modelled = enough[:, 3], enough[:, column]
    return np.abs(real - modelled).max(), np.sqrt(np.mean(np.log(real / modelled) ** 2))


def as_cast(points_m, lidar):
    """The points where they were when they were hit: data sets move those of a turn to one time.

    Moved along x by what the vehicle drove, in proportion to the azimuth and with a jump where the turn begins, rows
    are no more cones about the axis: that tells how far.
    """
    in_sensor_m, rows_deg = (
        transform_points(invert(lidar.mount.to_matrix()), points_m),
        np.sort(lidar.compute_elevations_deg()),
    )
    x, y, z = in_sensor_m.T
    flat_m, azimuth_deg = np.hypot(x, y), np.rad2deg(np.arctan2(y, x))
    gap_rad = np.deg2rad(np.interp(np.rad2deg(np.arctan2(z, flat_m)), rows_deg, np.gradient(rows_deg)))
    # Of points that are moved by metres only those are told apart that stay in their row, by more than they err.
    used = (np.abs(z) > 0.04 * flat_m) & (flat_m > MOVED_M[0]) & (flat_m < MOVED_M[1])
    used &= MOVED_BY_M * np.abs(z) < flat_m**2 * gap_rad / 2
    weight = np.abs(z / flat_m)[used]
    along, shift_m = np.cos(np.deg2rad(azimuth_deg[used])), np.zeros(len(z))
    for _ in range(4):  # with every pass fewer points are in a row that is not theirs
        elevation_deg = np.rad2deg(np.arctan2(z, np.hypot(x + shift_m, y)))[used]
        row_deg = rows_deg[np.searchsorted((rows_deg[1:] + rows_deg[:-1]) / 2, elevation_deg)]
        off_m = z[used] / np.tan(np.deg2rad(row_deg)) - flat_m[used]
        best = np.inf, np.zeros(2), shift_m
        for begin_deg in np.arange(-180.0, 180.0, 5.0):
            turn = (np.rad2deg(np.arctan2(y, x + shift_m)) - begin_deg) % 360.0 / 360.0
            terms, misfit_m = np.column_stack([along, along * turn[used]]), np.abs(off_m - along * shift_m[used])
            for within_m in (0.5, 0.3, 0.1):
                kept = misfit_m < within_m
                moved_m = np.linalg.lstsq(terms[kept] * weight[kept, None], (off_m * weight)[kept], rcond=None)[0]
                misfit_m = np.abs(off_m - terms @ moved_m)
            best = min(best, ((np.minimum(misfit_m, 0.1) * weight).mean(), moved_m, turn), key=lambda one: one[0])
        _, moved_m, turn = best
        shift_m = moved_m[0] + moved_m[1] * turn
    if abs(moved_m[1]) < LEAST_WAY_M:
        return points_m
    return transform_points(lidar.mount.to_matrix(), in_sensor_m + np.outer(shift_m, [1.0, 0.0, 0.0]))


def nearest_road(points_m, place_m):
    """From which range on the road is seen in each direction: the fourth nearest point within 2.5 degrees."""
    azimuth_deg = np.rad2deg(np.arctan2(*(points_m[:, :2] - place_m[:2]).T[::-1]))
    range_m = np.hypot(*(points_m[:, :2] - place_m[:2]).T)
    found = {}
    for name, at_deg in DIRECTIONS.items():
        near = np.sort(range_m[np.abs((azimuth_deg - at_deg + 180.0) % 360.0 - 180.0) < 2.5])
        found[name] = near[3] if len(near) > 3 else np.nan
    return found


def blocked(points_m, lidar, turns):
    """Azimuths in the frame of the LiDAR in which less than 60 % of the rays that look down return, in words."""
    in_sensor_m = transform_points(invert(lidar.mount.to_matrix()), points_m)
    down = np.sign(lidar.mount.to_matrix()[2, 2])
    elevation_deg = down * np.rad2deg(np.arcsin(in_sensor_m[:, 2] / np.linalg.norm(in_sensor_m, axis=1)))
    rows_deg = down * lidar.compute_elevations_deg()
    azimuth_deg = np.rad2deg(np.arctan2(in_sensor_m[:, 1], in_sensor_m[:, 0])) % 360.0
    looks = (elevation_deg > STEEP_DEG[0]) & (elevation_deg < STEEP_DEG[1])
    rows = np.count_nonzero((rows_deg > STEEP_DEG[0]) & (rows_deg < STEEP_DEG[1]))
    counts = np.bincount((azimuth_deg[looks] / SECTOR_DEG).astype(int), minlength=round(360 / SECTOR_DEG))
    share = counts / (turns * rows * lidar.columns * SECTOR_DEG / lidar.horizontal_fov_deg)
    closed = np.append(share < OPEN_SHARE, False).astype(int)
    starts, ends = (np.flatnonzero(np.diff(closed, prepend=0) == sign) for sign in (1, -1))
    return ", ".join(f"{SECTOR_DEG * a:.0f}-{SECTOR_DEG * b:.0f}" for a, b in zip(starts, ends, strict=True)) or "none"


def on_vehicles(sweeps, recording, lidar):
    """A row for each bin and part of a vehicle: rays at the side of a box with nothing before it, P(return)."""
    met = [
        at_sides(points_m, recording.read_boxes(index), lidar)
        for index, points_m in zip(recording.key_frames, sweeps, strict=True)
    ]
    rows = []
    for part, (_, _, name) in PARTS.items():
        of_part = np.concatenate([np.empty((0, 3)), *(one[part] for one in met)])
        material = Material.load(name)
        excess = compute_log_excess(
            of_part[:, 0],
            of_part[:, 1],
            material.numeric_reflectivity,
            material.incidence_exponent,
            lidar.range_at_10_percent_m or np.inf,
        )
        modelled = compute_return_probability(excess, lidar.log_range_std, material.log_reflectivity_std)
        for low_m, high_m in pairwise(VEHICLE_BINS_M):
            there = (of_part[:, 0] >= low_m) & (of_part[:, 0] < high_m)
            if there.sum() >= 50:
                real, model = of_part[there, 2].mean(), modelled[there].mean()
                rows.append((lidar.name, part, f"{low_m:g}-{high_m:g}", there.sum(), f"{real:.2f}", f"{model:.2f}"))
    return rows


def at_sides(points_m, boxes, lidar):
    """For each part (K, 3) of its rays: range and cosine at the side of a box, and whether that returned."""
    found = {part: [np.empty((0, 3))] for part in PARTS}
    mount = lidar.mount.to_matrix()
    cloud_m = transform_points(invert(mount), points_m)
    rows_deg, columns = np.sort(lidar.compute_elevations_deg()), lidar.columns
    range_m = np.linalg.norm(cloud_m, axis=1)
    elevation_deg = np.rad2deg(np.arctan2(cloud_m[:, 2], np.hypot(cloud_m[:, 0], cloud_m[:, 1])))
    row = np.searchsorted((rows_deg[1:] + rows_deg[:-1]) / 2, elevation_deg)
    column = (
        np.floor((np.rad2deg(np.arctan2(cloud_m[:, 1], cloud_m[:, 0])) + 180.0) / 360.0 * columns).astype(int) % columns
    )
    image_m = np.full((len(rows_deg), columns), np.inf)
    np.minimum.at(image_m, (row, column), range_m)
    beside_m = np.minimum(image_m, np.minimum(np.roll(image_m, 1, 1), np.roll(image_m, -1, 1)))
    elevation, azimuth = np.deg2rad(rows_deg)[:, None], np.deg2rad((np.arange(columns) + 0.5) / columns * 360.0 - 180.0)
    flat = np.cos(elevation)
    towards = np.stack(np.broadcast_arrays(flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)), axis=-1)
    for centre_m, size_m, yaw, category in zip(
        boxes.center_m.numpy(), boxes.size_m.numpy(), boxes.yaw_rad.numpy(), boxes.categories, strict=True
    ):
        if not any(word in category for word in VEHICLES):
            continue
        box_T_vehicle = np.eye(4)
        box_T_vehicle[:2, :2] = [[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]
        box_T_sensor = box_T_vehicle @ mount
        origin_m = box_T_sensor[:3, 3] - box_T_vehicle[:3, :3] @ centre_m
        rays = towards @ box_T_sensor[:3, :3].T
        for part, (low, high, _) in PARTS.items():
            half = size_m / 2 * [0.95, 0.9, 1.0]
            lower, upper = (
                np.array([-half[0], -half[1], low * size_m[2]]),
                np.array([half[0], half[1], high * size_m[2]]),
            )
            with np.errstate(divide="ignore", invalid="ignore"):
                ends_m = np.stack([(lower - origin_m) / rays, (upper - origin_m) / rays])
            into_m, out_m = ends_m.min(axis=0), ends_m.max(axis=0).min(axis=-1)
            enter_m, side = into_m.max(axis=-1), into_m.argmax(axis=-1)
            hits = (out_m > enter_m) & (enter_m > 2.0) & (side < 2) & (beside_m > enter_m - 1.0)
            cosine = np.abs(np.take_along_axis(rays, side[..., None], -1)[..., 0])
            returned = (image_m > enter_m - OFF_BOX_M) & (image_m < np.maximum(enter_m + OFF_BOX_M, out_m + 0.5))
            found[part].append(np.stack([enter_m[hits], cosine[hits], returned[hits]], axis=1))
    return {part: np.concatenate(each) for part, each in found.items()}


def main():
    """Print the tables of each recording, and draw P(return)."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="*", help="RIG=RECORDING")
    parser.add_argument("--picture", type=Path, help="where to draw P(return) by range")
    given, road = parser.parse_args(), Material.load("road")
    if not given.recordings:
        show_imperfections()
        return
    returns, misfits, cones, vehicles, curves = [], [], [], [], {}
    for pair in given.recordings:
        name, _, folder = pair.partition("=")
        rig, recording = Rig.load(name), open_recording(folder)
        scans = Simulator(
            Scenario.model_validate(PLAIN), {"rig": rig.apply_sensor_model("ideal")}, PaperReference(rows=2, columns=2)
        )
        simulated = dict(zip([one.name for one in rig.sensors], scans.simulate_scans(0)["rig"], strict=True))
        for lidar in rig.sensors:
            if not isinstance(lidar, Lidar):
                continue
            recorded = lidar.name if lidar.name in recording.sensors else recording.sensors[0]
            scans = (recording.read_scan(recorded, index) for index in recording.key_frames)
            sweeps = [
                as_cast(transform_to_vehicle(one, recording.ego_box).points_m.astype(float), lidar) for one in scans
            ]
            label = f"{Path(folder).name} {lidar.name}"
            rows = curves[label] = by_range(count_ground_rays(sweeps, lidar), lidar, road)
            returns += [
                (label, f"{low_m:.0f}-{high_m:.0f}", f"{n:.0f}", *(f"{p:.2f}" for p in rest))
                for low_m, high_m, n, *rest in rows
            ]
            misfits.append((label, *(f"{value:.3f}" for column in (4, 5) for value in misfit(rows, column))))
            place_m, on_road = lidar.mount.to_matrix()[:3, 3], []
            for points_m in sweeps:
                above_m = points_m[:, 2] - fit_road_profile(points_m).compute_heights_m(points_m)
                is_close = np.abs(points_m[:, 1]) < 3 * RoadParams().half_lanes_m
                on_road.append(points_m[(np.abs(above_m) < 0.15) & is_close])
            real = [nearest_road(one, place_m) for one in on_road]
            model = nearest_road(simulated[lidar.name].points, place_m)
            cones += [(label, f"{np.median([one[at] for one in real]):.1f} / {model[at]:.1f}", at) for at in DIRECTIONS]
            closed = blocked(np.concatenate(sweeps), lidar, len(sweeps))
            cones.append((label, f"{closed} / {blocked(simulated[lidar.name].points, lidar, 1)}", "blocked (degrees)"))
            if any(recording.read_boxes(index) is not None for index in recording.key_frames):
                vehicles += on_vehicles(sweeps, recording, lidar)
    print(
        "P(return) from road: real, modelled from the other half of the azimuths, modelled as built in; ideal is 1.\n"
    )
    table(("sweeps", "range (m)", "rays", "real", "modelled", "built in"), returns)
    print(f"\nMisfit in bins with {ENOUGH_RAYS} rays: largest difference of P, rms ln(density), modelled; built in.\n")
    table(("sweeps", "P", "density", "P, built in", "density, built in"), misfits)
    print(
        "\nFrom where on the road is seen (m), and azimuths in which under 60 % of the rays return: real / simulated.\n"
    )
    table(("sweeps", "real / simulated", "where"), cones)
    print("\nP(return) from the sides of vehicles.\n")
    table(("LiDAR", "part", "range (m)", "rays", "real", "built in"), vehicles)
    if given.picture:
        draw(curves, given.picture)


def draw(curves, path):
    """P(return) by range of every LiDAR: real, fitted on the other half, as built in, ideal."""
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(curves), figsize=(3.2 * len(curves), 2.8), sharey=True, layout="constrained")
    for axis, (label, rows) in zip(np.atleast_1d(axes), curves.items(), strict=True):
        middle_m = rows[:, :2].mean(axis=1)
        share = rows[:, 3].clip(0.02, 0.98)
        error = np.sqrt(share * (1 - share) / (rows[:, 2] / RAYS_OF_A_CELL))
        axis.errorbar(middle_m, rows[:, 3], error, fmt="ko", markersize=4, label="real")
        axis.plot(middle_m, rows[:, 4], "C0-", label="modelled, from the other half")
        axis.plot(middle_m, rows[:, 5], "C1--", label="modelled, as built in")
        axis.axhline(1.0, color="0.6", linestyle=":", label="ideal")
        axis.set(title=label.split()[-1] if len(label) > 20 else label, xlabel="range (m)", ylim=(0, 1.08))
    np.atleast_1d(axes)[0].set_ylabel("P(return) from road")
    np.atleast_1d(axes)[0].legend(fontsize=7, loc="lower left")
    figure.savefig(path, dpi=130)


def show_imperfections():
    """Print detection within 80 m, by area, of sensors with noise and drop-out."""
    torch.set_num_threads(1)
    rigs = {f"{name}: {words(keys)}": imperfect(name, keys) for name, each in IMPERFECT.items() for keys in each}
    frames = SimulatedFrames("urban", rigs=rigs, num_frames=NUM_FRAMES, frame_interval_s=EVERY_S, seed=0)
    metrics = {(rig, landed): CoverageMetric(GRID, has_area_weights=True) for rig in rigs for landed in (False, True)}
    for frame in frames:
        for (rig, landed), metric in metrics.items():
            points, error = (
                (frame.get_measured_points(rig), None) if landed else (frame.get_cloud(rig), frame.get_errors_m(rig))
            )
            surface = {"weights": frame.reference_weights, "heights_m": frame.reference_heights_m}
            metric.update(points, frame.reference, errors_m=error, **surface)
    percent = {key: [f"{100 * value:.1f}" for value in detection(metric)] for key, metric in metrics.items()}
    rows = [(*rig.split(": ", 1), *percent[rig, False], *percent[rig, True]) for rig in rigs]
    table(
        ("rig", "what is imperfect", "ground (%)", "obstacle (%)", "ground, landed (%)", "obstacle, landed (%)"), rows
    )


def words(keys):
    return ", ".join(f"{key} {value}" for key, value in keys.items()).replace("'", "") or "nothing"


def imperfect(name, keys):
    """A built-in rig whose sensors all have some more keys."""
    document = Rig.load(name).model_dump(exclude_unset=True)
    return Rig.model_validate({**document, "sensors": [{**sensor, **keys} for sensor in document["sensors"]]})


def detection(metric):
    """Of the ground, and of obstacles."""
    rows = {(row.region, row.band): row for row in metric.compute().summary()}
    return [rows["80m", height].numbers["detection_0.4m"].value for height in ("ground", "obstacle")]


if __name__ == "__main__":
    main()
