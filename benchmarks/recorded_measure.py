"""How far is what a recording says from the measure by area of what its reference sensor saw?

Recordings are simulated: scans of a LiDAR on the roof, with 2 cm of noise, are the reference of a rig. The truth is
the measure by area over the surface that this LiDAR sees from its own places, within its field of view, at the same
instants.
"""

import argparse

import numpy as np
import torch
from pykdtree.kdtree import KDTree

from benchmarks.recorded_references import (
    ACCUMULATED,
    BOXES,
    GRID,
    REGIONS,
    SOLID_STATE,
    SPINNING,
    STRATA,
    recorded_and_true,
)
from benchmarks.timing import table
from torchcover import nearest
from torchcover.data import SimulatedFrames
from torchcover.simulation import PaperReference, Rig

THRESHOLD_M = 0.4


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rig", default="front_roof_128")
    parser.add_argument("--scenario", default="urban")
    parser.add_argument("--steps", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--every", type=float, default=20.0, help="seconds between steps")
    options = parser.parse_args([] if __name__ != "__main__" else None)
    torch.set_num_threads(1)
    frames = SimulatedFrames(
        options.scenario,
        options.rig,
        steps=options.steps,
        seed=options.seed,
        every_s=options.every,
        reference_sensor=PaperReference(rows=4, columns=4),
    )
    sums = {}
    for index in range(options.steps):
        sensor = frames[index].clouds[options.rig]
        for lidar in (SPINNING, SOLID_STATE, ACCUMULATED):
            generator = np.random.default_rng([options.seed, index, lidar.columns])
            add_step(sums, lidar, *recorded_and_true(frames, index, lidar, generator), sensor)
    rows, true = [], []
    for reference in dict.fromkeys(reference for reference, _, _ in sums):
        truth = sums[reference, "truth", 1].ratio()
        for name in dict.fromkeys(name for of, name, _ in sums if of == reference and name != "truth"):
            full, quarter = (sums[reference, name, every].ratio() for every in (1, 2))
            rows.append((reference, name, *distance(full, truth), distance(quarter, full)[0]))
        true.append((reference, *(f"{100 * detection:.0f} % / {radius_m:.2f} m" for radius_m, detection in truth)))
    table(("reference", "estimator", "rms", "worst", "rms move at a quarter of the points"), rows)
    print()
    table(("the truth", *(f"{region.name} {height}" for region in REGIONS for height in GRID.heights)), true)
    print()
    flat_ground(options.rig)


def flat_ground(rig, cuts=20_000):
    """Straight ahead on flat ground: the rings of a reference, each with the exact ground that it stands for."""
    met_m, rows = np.concatenate([rings_m(lidar) for lidar in Rig.load(rig).sensors]), []
    for lidar in (SPINNING, SOLID_STATE):
        probed_m = np.sort(rings_m(lidar))
        for region in REGIONS:
            inside_m = probed_m[probed_m < region.x[1]]
            # Up to the middle of two neighbours.
            edges_m = np.concatenate([inside_m[:1], (inside_m[1:] + inside_m[:-1]) / 2, inside_m[-1:]])
            everywhere_m = np.linspace(inside_m[0], inside_m[-1], cuts)
            answers = []
            for places_m, weights in ((everywhere_m, np.ones(cuts)), (inside_m, np.diff(edges_m))):
                radius_m = np.abs(places_m[:, None] - met_m).min(axis=1)
                answers.append(np.average([radius_m, radius_m <= THRESHOLD_M], axis=1, weights=weights))
            words = (f"{100 * detection:.1f} % / {radius_m:.2f} m" for radius_m, detection in answers)
            rows.append((lidar.name, region.name, len(inside_m), *words))
    table(("flat ground, reference", "region", "rings", "everywhere", "rings with their exact share"), rows)


def rings_m(lidar):
    """How far ahead on flat ground each row of a LiDAR ends."""
    mount, rows_deg = lidar.mount.matrix(), np.array(lidar.rows_deg())
    return mount[0, 3] + mount[2, 3] / np.tan(np.deg2rad(-rows_deg[rows_deg < 0]))


def add_step(sums, lidar, recorded, truth, sensor):
    """Add the sums of a step to each estimator's."""
    for cloud in (recorded, truth):
        found = nearest(torch.from_numpy(cloud.points_m.astype(np.float32)), sensor, max_distance=GRID.diagonal_m)
        cloud.radius_m = found.distance.clamp(max=GRID.diagonal_m).numpy()
    if lidar is not ACCUMULATED:
        kinds = {lidar.name: (recorded, truth)}
    else:
        at_rest = recorded.where(~recorded.on_moving), truth.where(~truth.on_moving)
        kinds = {"accumulated": (recorded, truth), "accumulated, nothing that moves": at_rest}
    for reference, (points, true) in kinds.items():
        sums.setdefault((reference, "truth", 1), Sums()).add(true, true.weights)
        for every in (1, 2):
            thinned = points.where((points.row % every == 0) & (points.column % every == 0))
            for name, weights in estimators(lidar).items():
                known = name.startswith("known")
                sums.setdefault((reference, name, every), Cells() if known else Sums()).add(
                    thinned, None if known else weights(thinned.points_m)
                )


def estimators(lidar):
    """What an estimator is called, and the weights that it gives to (N, 3) points."""
    origin_m = lidar.mount.matrix()[:3, 3]
    found = {"known cells of 0.25 m": None, "all points alike": lambda points_m: np.ones(len(points_m))}
    for side_m in (0.1, 0.2, 0.4, 0.8, 1.6):
        found[f"one point a voxel of {side_m} m"] = lambda points_m, side_m=side_m: one_a_voxel(points_m, side_m)
    found["distance to the 8th neighbour, squared"] = neighbours_squared
    if lidar is not ACCUMULATED:
        found["range squared"] = lambda points_m: ((points_m - origin_m) ** 2).sum(axis=1)
        found["area between neighbouring rays"] = lambda points_m: between_rays(points_m - origin_m)
    return found


def one_a_voxel(points_m, side_m):
    """1 / points in the voxel."""
    key = np.floor(points_m / side_m).astype(np.int64)
    key -= key.min(axis=0, initial=0)
    size = key.max(axis=0, initial=0) + 1
    _, voxel, points = np.unique(np.ravel_multi_index(key.T, size), return_inverse=True, return_counts=True)
    return 1 / points[voxel]


def neighbours_squared(points_m, neighbours=8):
    """What the circle grows with that holds so many."""
    distance_m, _ = KDTree(points_m).query(points_m, k=neighbours + 1)
    return distance_m[:, -1] ** 2


def between_rays(points_m, neighbours=12, within=0.3):
    """The ellipse that the points of the nearest rays fill, for each of them.

    Seen from the origin neighbours stay so, however flat the angle is at which a surface is looked at. Those whose
    ranges differ by more than a share lie on something else.
    """
    range_m = np.linalg.norm(points_m, axis=1)
    directions = points_m / range_m[:, None]
    _, others = KDTree(directions).query(directions, k=neighbours + 1)
    same = np.abs(range_m[others] / range_m[:, None] - 1) < within
    count = same.sum(axis=1)
    about_m = points_m[others] - (points_m[others] * same[..., None]).sum(axis=1, keepdims=True) / count[:, None, None]
    about_m *= same[..., None]
    spread = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", about_m, about_m) / count[:, None, None])
    return np.sqrt(np.maximum(spread[:, 1] * spread[:, 2], 1e-16)) / count


class Sums:
    """Sums of the weights, and of the weights times radius and detection, for each region and band."""

    def __init__(self):
        self.sums = np.zeros((len(STRATA), 3))

    def add(self, cloud, weights):
        for number, inside in enumerate(within(cloud.points_m)):
            radius_m, weight = cloud.radius_m[inside], weights[inside]
            self.sums[number] += weight.sum(), weight @ radius_m, weight @ (radius_m <= THRESHOLD_M)

    def ratio(self):
        with np.errstate(invalid="ignore"):
            return self.sums[:, 1:] / self.sums[:, :1]


class Cells:
    """Sums over steps of the means in cells: what a recording is measured by without weights."""

    def __init__(self):
        self.sums = np.zeros((3, GRID.cells))

    def add(self, cloud, _):
        cell = GRID.cell_of(torch.from_numpy(cloud.points_m)).numpy()
        cell, radius_m = cell[cell >= 0], cloud.radius_m[cell >= 0]
        values = np.ones(len(cell)), radius_m, radius_m <= THRESHOLD_M
        points, *sums = (np.bincount(cell, value, minlength=GRID.cells) for value in values)
        self.sums += np.stack([points, *sums]) / np.maximum(points, 1)

    def ratio(self):
        steps, *sums = (each.reshape(GRID.shape) for each in self.sums)
        found = []
        for region in REGIONS:
            for band in range(len(GRID.heights)):
                known = region.mask(GRID).numpy() & (steps[band] > 0)
                found.append(
                    [(each[band][known] / steps[band][known]).mean() if known.any() else np.nan for each in sums]
                )
        return np.array(found)


def distance(value, other):
    """The root mean square over regions and bands, and the worst: points of detection / per cent of the radius."""
    apart = np.stack([100 * (value[:, 1] - other[:, 1]), 100 * (value[:, 0] / other[:, 0] - 1)])
    worst = np.take_along_axis(apart, np.nanargmax(np.abs(apart), axis=1)[:, None], axis=1)[:, 0]
    rms = np.sqrt(np.nanmean(apart**2, axis=1))
    return f"{rms[0]:.1f} / {rms[1]:.0f}", f"{worst[0]:+.1f} / {worst[1]:+.0f}"


def within(points_m):
    for low, high in zip(*BOXES, strict=True):
        yield ((points_m >= low) & (points_m < high)).all(axis=1)


if __name__ == "__main__":
    main()
