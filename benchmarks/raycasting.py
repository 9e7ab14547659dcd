"""Ray casting, rays generated, beside bare embreex with its rays ready in memory; two threads each."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from benchmarks.timing import compare, table
from torchcover import Scenario
from torchcover.simulation import PaperReference
from torchcover.simulation.rays import into_tiles
from torchcover.simulation.scene import Scene

THREADS = 2


def bare_scene(world):
    """The same triangles in embreex, without torchcover."""
    scene = EmbreeScene(robust=True)
    for mesh in (world.ego.mesh, *world.static):
        TriangleMesh(scene, mesh.vertices_m.astype(np.float32), mesh.faces.astype(np.int32))
    scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))
    return scene


def bare_rays(sensor, pose):
    """Origins and directions in the vehicle frame, row by row, one contiguous part a thread."""
    directions = sensor.directions().reshape(3, -1).T @ pose[:3, :3].T
    origins = np.broadcast_to(pose[:3, 3], directions.shape)
    parts = zip(np.array_split(origins, THREADS), np.array_split(directions, THREADS), strict=True)
    return [(o.astype(np.float32), d.astype(np.float32)) for o, d in parts]


def endless(tile):
    """Where the rays of a tile end: nowhere."""
    return np.full(tile.directions.shape[1], np.finfo(np.float32).max, dtype=np.float32)


def main():
    """Print the ratio for the paper's reference sensor at four poses in the courtyard."""
    world = Scenario.load("courtyard").world()
    scene, bare = Scene(world), bare_scene(world)
    sensor = PaperReference()
    tiles = into_tiles(sensor.directions())
    instant = scene.at(0)
    rows = []
    with ThreadPoolExecutor(THREADS) as pool:
        for seed in range(4):
            pose = sensor.vehicle_T_reference(scene.ego_box, np.random.default_rng([0, seed]))
            rays = bare_rays(sensor, pose)

            def embreex(rays=rays):
                list(pool.map(lambda part: bare.run(*part, output=True), rays))

            def generate_and_cast(pose=pose):
                bodies = instant.outlines(pose[:3, 3])
                list(pool.map(lambda tile: instant.cast(pose, tile, endless(tile), bodies), tiles))

            def scan(pose=pose):
                instant.scan(pose, tiles, threads=THREADS)

            seconds, ratios = compare(embreex, generate_and_cast, scan, rounds=7)
            rows.append((seed, *seconds, 1 / ratios[1], 1 / ratios[2]))
    header = ("pose", "bare embreex (s)", "rays and hits (s)", "and points (s)", "bare / rays and hits", "bare / all")
    table(header, rows)


if __name__ == "__main__":
    main()
