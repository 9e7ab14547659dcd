"""Ray casting against bare embreex, and what the simulation leaves out because a scene does not need it.

Bare embreex has its rays ready in memory, torchcover generates them; two threads each. Each thing that is left out is
measured on and off, with the same result.
"""

from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from benchmarks import compare, table
from torchcover.data import SimulatedFrames
from torchcover.evaluation.cpu_cores import set_threads
from torchcover.geometry import invert
from torchcover.simulation import PaperReference, Rig, Scenario, SensorNoise
from torchcover.simulation.mounted_sensor import MountedSensor
from torchcover.simulation.raycaster import cast_from_vehicle
from torchcover.simulation.rays import rotate, split_into_tiles
from torchcover.simulation.scene_geometry import SceneGeometry
from torchcover.simulation.scene_snapshot import SensorScan

RANGE_M = 120.0
STEP = 200
THREADS = 2


def main():
    """Print the table of ray casting, that of run times and one of the counts that frames carry."""
    set_threads()  # as the command line does
    show_ray_casting()
    print()
    urban = SceneGeometry(Scenario.load("urban").build_scene())
    roof, kitti = (Rig.load(rig).apply_sensor_model("ideal").sensors[0] for rig in ("front_roof_128", "kitti"))
    rows = [
        row("bodies that a ray cannot meet", *rays_that_pass_by(urban)),
        row("the ego, seen by `front_roof_128`", *ego_again(urban, roof)),
        row("the ego, seen by the LiDAR of `kitti`", *ego_again(urban, kitti)),
        row(
            "a rig where nothing moves (`courtyard`)",
            *scan_again(SceneGeometry(Scenario.load("courtyard").build_scene()), roof),
        ),
        row("building the static world (`urban`)", *world_again(urban, roof)),
    ]
    table(("left out", "off (ms)", "on (ms)", "off / on", "same result"), rows)
    print()
    totals()


def row(what, off, on):
    """Compare the two, which return a scan."""
    without, left_out = off(), on()
    same = np.array_equal(without.points, left_out.points) and without.self_hits == left_out.self_hits
    seconds, ratios = compare(on, off, rounds=9)
    return what, 1000 * seconds[1], 1000 * seconds[0], ratios[1], "yes" if same else "NO"


def bare_scene(world):
    """The same triangles in embreex, without torchcover."""
    scene = EmbreeScene(robust=True)
    for mesh in (world.ego.mesh, *world.static_meshes):
        TriangleMesh(scene, mesh.vertices_m.astype(np.float32), mesh.faces.astype(np.int32))
    scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))
    return scene


def bare_rays(sensor, pose):
    """Origins and directions in the vehicle frame, row by row, one contiguous part a thread."""
    directions = sensor.compute_directions().reshape(3, -1).T @ pose[:3, :3].T
    origins = np.broadcast_to(pose[:3, 3], directions.shape)
    parts = zip(np.array_split(origins, THREADS), np.array_split(directions, THREADS), strict=True)
    return [(o.astype(np.float32), d.astype(np.float32)) for o, d in parts]


def endless(tile):
    """Where the rays of a tile end: nowhere."""
    return np.full(tile.directions.shape[1], np.finfo(np.float32).max, dtype=np.float32)


def show_ray_casting():
    """Print the ratio for the paper's reference sensor at four poses in the courtyard."""
    world = Scenario.load("courtyard").build_scene()
    scene, bare = SceneGeometry(world), bare_scene(world)
    sensor = PaperReference()
    tiles = split_into_tiles(sensor.compute_directions())
    instant = scene.get_snapshot(0)
    rows = []
    with ThreadPoolExecutor(THREADS) as pool:
        for seed in range(4):
            pose = sensor.sample_pose(scene.ego_box, np.random.default_rng([0, seed]))
            rays = bare_rays(sensor, pose)

            def embreex(rays=rays):
                list(pool.map(lambda part: bare.run(*part, output=True), rays))

            def generate_and_cast(pose=pose):
                bodies = instant.compute_outlines(pose[:3, 3])
                list(pool.map(lambda tile: instant.cast(pose, tile, endless(tile), bodies), tiles))

            def scan(pose=pose):
                instant.scan(pose, tiles, num_threads=THREADS)

            seconds, ratios = compare(embreex, generate_and_cast, scan, rounds=7)
            rows.append((seed, *seconds, 1 / ratios[1], 1 / ratios[2]))
    header = ("pose", "bare embreex (s)", "rays and hits (s)", "and points (s)", "bare / rays and hits", "bare / all")
    table(header, rows)


def rays_that_pass_by(scene):
    """65,536 reference rays: without this, each is cast at each body in range."""
    reference, instant = PaperReference(rows=256, columns=256), scene.get_snapshot(STEP, RANGE_M)
    generator = np.random.default_rng(0)
    pose = reference.sample_pose(scene.ego_box, generator)
    tiles = split_into_tiles(reference.compute_directions())
    return (
        lambda: at_every_body(instant, pose, tiles),
        lambda: instant.scan(pose, tiles, max_range_m=RANGE_M),
    )


def at_every_body(instant, pose, tiles):
    """The slow way: a scan in which nothing is left out."""
    found, self_hits = [], 0
    for tile in tiles:
        directions = rotate(pose[:3, :3], tile.directions)
        limit_m = np.full(directions.shape[1], RANGE_M, dtype=np.float32)
        hits = cast_from_vehicle(instant.static_caster, instant.static_T_vehicle, pose[:3, 3], directions, limit_m)
        moving = instant.moving_bodies
        for caster, vehicle_T_part, body in zip(
            moving.casters, moving.vehicle_T_part, moving.body_indices, strict=True
        ):
            nearer = cast_from_vehicle(caster, invert(vehicle_T_part), pose[:3, 3], directions, hits.range_m)
            hits.range_m[:] = nearer.range_m
            hits.body_indices[nearer.body_indices >= 0] = body
        seen = (hits.body_indices >= 0) & (hits.body_indices != instant.ego_index)
        found.append((directions * hits.range_m + pose[:3, 3].astype(np.float32)[:, None])[:, seen].T)
        self_hits += int((hits.body_indices == instant.ego_index).sum())
    points = np.concatenate(found)
    return SensorScan(points, np.arange(len(points)), np.empty(0, dtype=np.float32), 0, self_hits)


def ego_again(scene, sensor):
    """A sensor fixed to the ego need not be cast at it at every step."""
    instant, mounted = scene.get_snapshot(STEP, RANGE_M), MountedSensor(sensor, scene, sensor.max_range_m)
    return afresh(instant, sensor, mounted.tiles), lambda: mounted.scan(instant, SensorNoise(None))


def scan_again(scene, sensor):
    """Where nothing moves one scan serves for all steps."""
    instant, mounted = scene.get_snapshot(0), MountedSensor(sensor, scene, sensor.max_range_m)
    return afresh(instant, sensor, mounted.tiles), lambda: mounted.scan(instant, SensorNoise(None))


def afresh(instant, sensor, tiles):
    """A scan that knows nothing of the steps before."""
    return lambda: instant.scan(sensor.mount.to_matrix(), tiles, max_range_m=sensor.max_range_m)


def world_again(scene, sensor):
    """The meshes are at hand; what is left out is to give them to the ray caster at every step."""
    tiles, world = split_into_tiles(sensor.compute_directions()), scene.scene

    def step(built):
        return afresh(built.get_snapshot(STEP, RANGE_M), sensor, tiles)()

    return lambda: step(SceneGeometry(world)), lambda: step(scene)


def totals():
    """Print what frames count, summed over a few of them."""
    rows = []
    for scenario, rig in (("urban", "front_roof_128"), ("urban", "kitti"), ("courtyard", "front_roof_128")):
        frames = SimulatedFrames(
            scenario,
            rig,
            num_frames=10,
            seed=0,
            frame_interval_s=1.0,
            reference_sensor=PaperReference(rows=256, columns=256),
        )
        counts = Counter()
        for index in range(len(frames)):
            counts.update(frames[index].counts)
        rows.append((f"`{scenario}`, `{rig}`", *(share(counts, *names) for names in COUNTS.values())))
    table(("10 steps of", *COUNTS), rows)


COUNTS = {
    "moving bodies out of range": ("moving_bodies_out_of_range", "moving_bodies"),
    "pairs of ray and body not cast": ("ray_body_pairs_omitted", "ray_body_pairs"),
    "rig's rays reused": ("sensor_rays_reused", "sensor_rays"),
    "self hits reused": ("sensor_self_hits_reused", "sensor_self_hits"),
}


def share(counts, left_out, of_all):
    """A part of a whole, in words."""
    if not counts[of_all]:
        return "none there"
    return f"{counts[left_out]:,} of {counts[of_all]:,} ({counts[left_out] / counts[of_all]:.1%})"


if __name__ == "__main__":
    main()
