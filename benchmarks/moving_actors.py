"""One step with 60 bodies that move, and one with 1,000 far away, over the same rays in the static world alone."""

from dataclasses import replace

import numpy as np

from benchmarks.timing import compare, table
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation import Draws, PaperReference, Rig, Scenario
from torchcover.simulation.rays import into_tiles
from torchcover.simulation.scene import Scene
from torchcover.simulation.sight import MountedSensor
from torchcover.simulation.world import Actor

RANGE_M = 250.0
STEPS = (100, 110, 120, 130)
NEAR, FAR = 60, 1000
FAR_M = 10_000.0
REFERENCE = PaperReference(rows=256, columns=256, max_range_m=RANGE_M)
REFERENCE_TILES = into_tiles(REFERENCE.directions())


def main():
    """Print the ratios for `front_roof_128` and 65,536 reference rays in `urban`, one thread."""
    world = Scenario.load("urban").world()
    around = nearest(world, NEAR)
    static, busy = replace(world, actors=()), replace(world, actors=around)
    parked = replace(world, actors=far_away(around, moving=False))
    driving = replace(world, actors=far_away(around, moving=True))
    runs = [steps_of(Scene(each)) for each in (static, busy, parked, driving)]
    for run in runs:
        run()
    seconds, ratios = compare(*runs, rounds=11)
    what = (
        "static world and ego",
        f"and {NEAR} moving bodies in range",
        f"and {FAR:,} parked bodies {FAR_M / 1000:.0f} km away",
        f"and {FAR:,} moving bodies {FAR_M / 1000:.0f} km away",
    )
    rows = zip(what, [1000 * each / len(STEPS) for each in seconds], ratios, strict=True)
    table(("world", "a step (ms)", "ratio"), list(rows))


def steps_of(scene):
    """A function that makes the scans of some steps."""
    (lidar,) = Rig.load("front_roof_128").sensors
    mounted = MountedSensor(lidar, scene, lidar.max_range_m)

    def run():
        for step in STEPS:
            instant = scene.at(step, within_m=RANGE_M)
            mounted.scan(instant, Draws(None))
            generator = np.random.default_rng(step)
            pose = REFERENCE.vehicle_T_reference(scene.ego_box, generator)
            instant.buried(pose[:3, 3])
            instant.scan(pose, REFERENCE_TILES, max_range_m=RANGE_M)

    return run


def nearest(world, count):
    """The actors that stay nearest to the ego."""
    times_s = world.time_step_s * np.array(STEPS)
    ego_m = world.ego.trajectory.positions_at(times_s)
    moving = [actor for actor in world.actors if actor.trajectory.moves]
    farthest_m = [np.linalg.norm(actor.trajectory.positions_at(times_s) - ego_m, axis=1).max() for actor in moving]
    chosen = np.argsort(farthest_m)[:count]
    print(f"{count} of {len(moving)} moving bodies; the farthest is {farthest_m[chosen[-1]]:.0f} m away.\n")
    return tuple(moving[k] for k in chosen)


def far_away(kinds, moving):
    """Bodies 20 m apart, in a square far from where the ego drives."""
    side = int(np.ceil(np.sqrt(FAR)))
    actors = []
    for number in range(FAR):
        start = np.array([FAR_M + 20.0 * (number // side), FAR_M + 20.0 * (number % side), 0.0])
        kind = kinds[number % len(kinds)]
        ends = start + np.array([[0.0, 0.0, 0.0], [300.0 * moving, 0.0, 0.0]])
        drive = Trajectory.from_arrays([0.0, 60.0], ends, np.zeros((2, 3)))
        actors.append(Actor(f"far {number}", kind.category, kind.mesh, drive))
    return tuple(actors)


if __name__ == "__main__":
    main()
