"""Beside what one writes in an afternoon: Open3D for rays and neighbours, or trimesh and SciPy, and NumPy for sums.

Both are given the same cities, rig and grid, and the afternoon's program where all bodies are, and the heights of its
points above the ground. It builds the scene of each step, casts the sensors and the paper's reference, searches, and
sums up by cell and by area: a ray's hit stands for r^2 times its solid angle over the cosine of incidence.
"""

import argparse
import time

import numpy as np
import torch
from scipy.spatial import cKDTree

from benchmarks.timing import table
from torchcover.coverage import CoverageMetric
from torchcover.geometry import invert, transform
from torchcover.simulation import PaperReference, RegionsOfInterest, SimulatedFrames, SurfaceReference

RIG, SCENARIO, EVERY_S, THRESHOLD_M = "front_roof_128", "urban", 15.0, 0.4
STEPS_A_CITY = 4
SIDES = (1024, 256)
FEW_RAYS = 1024
HEIGHTS = (-0.5, 0.5, 2.0)
# Of radii, as in `CoverageMetric.thresholds`.
DETECTION = 1

try:
    import open3d
except ImportError:
    open3d = None


class Open3DScene:
    """Rays at meshes with Open3D."""

    name = "Open3D, NumPy"

    def __init__(self, vertices, faces):
        self.scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        self.scene.add_triangles(vertices.astype(np.float32), faces.astype(np.uint32))

    def cast(self, origin, towards):
        rays = np.hstack([np.broadcast_to(origin, towards.shape), towards]).astype(np.float32)
        found = self.scene.cast_rays(open3d.core.Tensor(rays))
        range_m, face = found["t_hit"].numpy(), found["primitive_ids"].numpy()
        hit = np.flatnonzero(np.isfinite(range_m))
        return hit, range_m[hit], face[hit], found["primitive_normals"].numpy()[hit]

    @staticmethod
    def radii(query, points):
        search = open3d.core.nns.NearestNeighborSearch(open3d.core.Tensor(points.astype(np.float32)))
        search.knn_index()
        return np.sqrt(search.knn_search(open3d.core.Tensor(query.astype(np.float32)), 1)[1].numpy()[:, 0])


class TrimeshScene:
    """Rays at meshes with trimesh and Embree."""

    name = "trimesh, SciPy, NumPy"

    def __init__(self, vertices, faces):
        import trimesh

        self.mesh = trimesh.Trimesh(vertices, faces, process=False)

    def cast(self, origin, towards):
        origins = np.broadcast_to(origin, towards.shape)
        points, hit, face = self.mesh.ray.intersects_location(origins, towards, multiple_hits=False)
        return hit, np.linalg.norm(points - origin, axis=1), face, self.mesh.face_normals[face]

    @staticmethod
    def radii(query, points):
        # As it is built by default it is asked for up to ten times as long, on some clouds.
        return cKDTree(points, balanced_tree=False, compact_nodes=False).query(query)[0]


Scene = Open3DScene if open3d else TrimeshScene


def bodies_at(scene, step):
    """What the afternoon's program is given: all bodies in the vehicle frame, the ego last."""
    world, time_s = scene.world, step * scene.world.time_step_s
    vehicle_T_world = invert(world.ego.trajectory.at(time_s))
    placed = [(mesh, np.eye(4)) for mesh in world.static]
    placed += [(actor.mesh, actor.trajectory.at(time_s)) for actor in (*world.objects, world.ego)]
    return [(transform(vehicle_T_world @ pose, mesh.vertices_m), mesh.faces)
            for mesh, pose in placed if np.isfinite(pose).all()]  # fmt: skip


class Afternoon:
    """Sums over cells, and over regions in bands by area."""

    def __init__(self, rig, grid, regions, side):
        self.rig, self.grid, self.regions, self.reference = rig, grid, regions, PaperReference(side, side)
        self.sums, self.by_area, self.seconds = np.zeros((3, grid.cells)), [], 0.0
        elevation = np.deg2rad(np.linspace(0.0, -90.0, side))
        # The pole's ring, and the horizon's, reach half as far.
        edges = np.clip(np.concatenate([[0.0], (elevation[1:] + elevation[:-1]) / 2, [-np.pi / 2]]), -np.pi / 2, 0)
        self.steradians = np.repeat(-np.diff(np.sin(edges)) * 2 * np.pi / side, side)

    def step(self, bodies, ego_box, heights_m, generator):
        began = time.process_time()
        first = np.cumsum([0, *(len(vertices) for vertices, _ in bodies)])
        vertices = np.concatenate([vertices for vertices, _ in bodies])
        faces = np.concatenate([of + start for (_, of), start in zip(bodies, first[:-1], strict=True)])
        of_ego = len(faces) - len(bodies[-1][1])
        scene, cloud = Scene(vertices, faces), []
        for sensor in self.rig.sensors:
            pose = sensor.mount.matrix()
            towards = (pose[:3, :3] @ sensor.directions().reshape(3, -1)).T
            hit, range_m, face, _ = scene.cast(pose[:3, 3], towards[~np.isnan(towards[:, 0])])
            kept = (face < of_ego) & (range_m <= sensor.max_range_m)
            cloud.append(pose[:3, 3] + range_m[kept, None] * towards[hit[kept]])
        pose = self.reference.vehicle_T_reference(ego_box, generator)
        towards = (pose[:3, :3] @ self.reference.directions().reshape(3, -1)).T
        hit, range_m, face, normals = scene.cast(pose[:3, 3], towards)
        kept = (face < of_ego) & (range_m <= self.reference.max_range_m)
        hit, range_m, normals = hit[kept], range_m[kept], normals[kept]
        points = pose[:3, 3] + range_m[:, None] * towards[hit]
        m2 = range_m**2 * self.steradians[hit] / np.maximum(np.abs((normals * towards[hit]).sum(axis=1)), 1e-3)
        (x_low, x_high), (y_low, y_high), cell_m = self.grid.x, self.grid.y, self.grid.cell
        self.seconds += time.process_time() - began
        height = heights_m(points)
        began = time.process_time()
        inside = (points[:, 0] >= x_low) & (points[:, 0] < x_high) & (points[:, 1] >= y_low) & (points[:, 1] < y_high)
        inside &= (height >= HEIGHTS[0]) & (height < HEIGHTS[-1])
        points, m2, height = points[inside], m2[inside], height[inside]
        radius = Scene.radii(points, np.concatenate(cloud))
        detected = (radius <= THRESHOLD_M).astype(float)
        _, rows, columns = self.grid.shape
        band = np.digitize(height, HEIGHTS[1:-1])
        column, row = ((points[:, :2] - (x_low, y_low)) / cell_m).astype(int).T
        cell = (band * rows + row) * columns + column
        count = np.bincount(cell, minlength=self.grid.cells)
        some = count > 0
        self.sums[0] += some
        for sums, values in zip(self.sums[1:], (radius, detected), strict=True):
            sums[some] += (np.bincount(cell, values, minlength=self.grid.cells) / np.maximum(count, 1))[some]
        own = []
        for region in self.regions:
            (x, y), (left, right) = points[:, :2].T, region.y
            there = (x >= region.x[0]) & (x < region.x[1]) & (y >= left) & (y < right)
            for number in range(len(HEIGHTS) - 1):
                weight = m2[there & (band == number)]
                own.append((weight.sum(), weight @ detected[there & (band == number)]))
        self.by_area.append(own)
        self.seconds += time.process_time() - began

    def by_city(self):
        return np.reshape(self.by_area, (-1, STEPS_A_CITY, len(self.by_area[0]), 2)).sum(axis=1)


class Ours:
    """A `CoverageMetric` fed with simulated frames."""

    def __init__(self, frames, grid, regions, reference, *, radii=True):
        self.frames, self.seconds = frames.with_reference_sensor(reference), 0.0
        self.frames.simulator.within_m = None if radii else THRESHOLD_M
        settings = {"blocks": 16, "regions": regions, "square_metres": reference.square_metres, "radii": radii}
        self.metric = CoverageMetric(grid, (THRESHOLD_M,), max_radius=grid.diagonal_m, **settings)

    def step(self, index, city):
        began = time.process_time()
        frame = self.frames[index]
        height = frame.heights_in(self.metric.grid.band_frame)
        given = {"weights": frame.reference_weights, "height": height, "place_in_time": city}
        self.metric.update(frame.sensor, frame.reference, **given)
        self.seconds += time.process_time() - began

    def by_area(self, cities):
        places = self.metric.compute().places
        return torch.stack([places.m2[:cities], places.sums[:cities, DETECTION]], dim=2).numpy()


def errors(by_area):
    """Values and standard errors of the ratios of (cities, places, 2) sums."""
    base, sums = np.moveaxis(np.asarray(by_area), 2, 0)
    value = sums.sum(axis=0) / base.sum(axis=0)
    off = sums - value * base
    return value, np.sqrt(len(off) / (len(off) - 1) * (off**2).sum(axis=0)) / base.sum(axis=0)


def main(arguments=()):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cities", type=int, default=10, help=f"of {STEPS_A_CITY} steps; the first step is not timed")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    steps = STEPS_A_CITY * options.cities
    frames = SimulatedFrames(SCENARIO, RIG, steps=steps, every_s=EVERY_S)
    (rig,), asked = frames.rigs.values(), RegionsOfInterest().around()
    of_z = RegionsOfInterest().around(band_frame="vehicle").grid
    regions = asked.regions
    usual, few = (SurfaceReference(asked.areas, bands_m=asked.bands_m, **rays) for rays in ({}, {"rays": FEW_RAYS}))
    ours = {
        "as usual": Ours(frames, asked.grid, regions, usual),
        f"`--only-detection --rays {FEW_RAYS}`": Ours(frames, asked.grid, regions, few, radii=False),
    }
    same = {side: Ours(frames, of_z, regions, PaperReference(side, side)) for side in SIDES}
    theirs = {side: Afternoon(rig, asked.grid, regions, side) for side in SIDES}
    for index in range(steps):
        scene, step = frames.simulator.scene_of(index)  # a city, for all of them
        instant, bodies = scene.at(step), bodies_at(scene, step)
        for side, program in theirs.items():
            program.step(bodies, scene.ego_box, instant.heights_m, np.random.default_rng([side, index]))
        for each in (*ours.values(), *same.values()):
            each.step(index, frames.world_of(index))
        if index == 0:  # in which libraries are loaded and compiled
            for each in (*ours.values(), *same.values(), *theirs.values()):
                each.seconds = 0.0
    timed = steps - 1
    print(f"{Scene.name}; {steps} steps in {options.cities} cities; processor time.\n")
    table(("rays of the paper's reference", "theirs (s a step)", "ours, the same settings (s a step)", "theirs / ours"),
          [(f"{side} x {side}", theirs[side].seconds / timed, same[side].seconds / timed,
            theirs[side].seconds / same[side].seconds) for side in SIDES])  # fmt: skip
    found = {f"ours, {name}": (errors(each.by_area(options.cities)), each.seconds) for name, each in ours.items()}
    found |= {f"theirs, {side} x {side}": (errors(theirs[side].by_city()), theirs[side].seconds) for side in SIDES}
    _, usual_s = found["ours, as usual"]
    usual_error = found["ours, as usual"][0][1]
    print("\nDetections by area. For the same error as ours as usual, in the median of six:\n")
    rows = []
    for name, ((_, error), seconds) in found.items():
        cities = float(np.median((error / usual_error) ** 2))
        rows.append((name, seconds / timed, cities, cities * seconds / usual_s))
    table(("", "s a step", "times the cities", "times the processor time"), rows)
    print("\nIn points, with standard errors:\n")
    places = [f"{region.name} {band}" for region in regions for band in asked.grid.heights]
    cells = {
        name: [f"{100 * v:.1f} ± {100 * e:.1f}" for v, e in zip(*of, strict=True)] for name, (of, _) in found.items()
    }
    table(("region", *cells), list(zip(places, *cells.values(), strict=True)))


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
