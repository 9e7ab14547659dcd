"""What the simulation leaves out because a scene does not need it: each on and off, with the same result."""

from collections import Counter

import numpy as np

from benchmarks.timing import compare, table
from torchcover.data import SimulatedFrames
from torchcover.simulation import Draws, PaperReference, Rig, Scenario
from torchcover.simulation.instant import SensorScan
from torchcover.simulation.raycaster import cast_from
from torchcover.simulation.rays import into_tiles, rotate
from torchcover.simulation.scene import Scene
from torchcover.simulation.sight import MountedSensor

RANGE_M = 120.0
STEP = 200


def main():
    """Print the table of run times and one of the counts that frames carry."""
    urban = Scene(Scenario.load("urban").world())
    roof, kitti = (Rig.load(rig).sensing("ideal").sensors[0] for rig in ("front_roof_128", "kitti"))
    rows = [
        row("bodies that a ray cannot meet", *rays_that_pass_by(urban)),
        row("the ego, seen by `front_roof_128`", *ego_again(urban, roof)),
        row("the ego, seen by the LiDAR of `kitti`", *ego_again(urban, kitti)),
        row("a rig where nothing moves (`courtyard`)", *scan_again(Scene(Scenario.load("courtyard").world()), roof)),
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


def rays_that_pass_by(scene):
    """65,536 reference rays: without this, each is cast at each body in range."""
    reference, instant = PaperReference(rows=256, columns=256), scene.at(STEP, within_m=RANGE_M)
    generator = np.random.default_rng(0)
    pose = reference.vehicle_T_reference(scene.ego_box, generator)
    tiles = into_tiles(reference.directions())
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
        hits = cast_from(instant.static, instant.static_T_vehicle, pose[:3, 3], directions, limit_m)
        moving = instant.moving
        for caster, part_T_vehicle, body in zip(moving.casters, moving.part_T_vehicle, moving.body, strict=True):
            nearer = cast_from(caster, part_T_vehicle, pose[:3, 3], directions, hits.range_m)
            hits.range_m[:] = nearer.range_m
            hits.body[nearer.body >= 0] = body
        seen = (hits.body >= 0) & (hits.body != instant.ego)
        found.append((directions * hits.range_m + pose[:3, 3].astype(np.float32)[:, None])[:, seen].T)
        self_hits += int((hits.body == instant.ego).sum())
    points = np.concatenate(found)
    return SensorScan(points, np.arange(len(points)), np.empty(0, dtype=np.float32), 0, self_hits)


def ego_again(scene, sensor):
    """A sensor fixed to the ego need not be cast at it at every step."""
    instant, mounted = scene.at(STEP, within_m=RANGE_M), MountedSensor(sensor, scene, sensor.max_range_m)
    return afresh(instant, sensor, mounted.tiles), lambda: mounted.scan(instant, Draws(None))


def scan_again(scene, sensor):
    """Where nothing moves one scan serves for all steps."""
    instant, mounted = scene.at(0), MountedSensor(sensor, scene, sensor.max_range_m)
    return afresh(instant, sensor, mounted.tiles), lambda: mounted.scan(instant, Draws(None))


def afresh(instant, sensor, tiles):
    """A scan that knows nothing of the steps before."""
    return lambda: instant.scan(sensor.mount.matrix(), tiles, max_range_m=sensor.max_range_m)


def world_again(scene, sensor):
    """The meshes are at hand; what is left out is to give them to the ray caster at every step."""
    tiles, world = into_tiles(sensor.directions()), scene.world

    def step(built):
        return afresh(built.at(STEP, within_m=RANGE_M), sensor, tiles)()

    return lambda: step(Scene(world)), lambda: step(scene)


def totals():
    """Print what frames count, summed over a few of them."""
    rows = []
    for scenario, rig in (("urban", "front_roof_128"), ("urban", "kitti"), ("courtyard", "front_roof_128")):
        frames = SimulatedFrames(
            scenario, rig, steps=10, seed=0, every_s=1.0, reference_sensor=PaperReference(rows=256, columns=256)
        )
        counts = Counter()
        for index in range(len(frames)):
            counts.update(frames[index].counts)
        rows.append((f"`{scenario}`, `{rig}`", *(share(counts, *names) for names in COUNTS.values())))
    table(("10 steps of", *COUNTS), rows)


COUNTS = {
    "moving bodies out of range": ("moving_bodies_out_of_range", "moving_bodies"),
    "pairs of ray and body not cast": ("ray_body_pairs_left_out", "ray_body_pairs"),
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
