"""One step of the paper (1024 x 1024 reference rays, 128 x 1800 sensor rays) beside its bare rays and search."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from pykdtree.kdtree import KDTree

from benchmarks.raycasting import THREADS, bare_rays, bare_scene
from benchmarks.timing import compare, table
from torchcover import BevGrid, CoverageMetric, Rig, Scenario
from torchcover.data import SimulatedFrames
from torchcover.simulation import PaperReference


def main():
    """Print the ratio for three steps."""
    frames = SimulatedFrames("courtyard", "front_roof_128", steps=8, seed=0)
    grid = BevGrid(x=(-40.0, 160.0), y=(-40.0, 40.0), cell=0.25)
    metric = CoverageMetric(grid, max_radius=grid.diagonal_m)
    bare = bare_scene(Scenario.load("courtyard").world())
    lidar, sensor = Rig.load("front_roof_128").sensors[0], PaperReference()
    rows = []
    with ThreadPoolExecutor(THREADS) as pool:
        for step in (0, 1, 2):
            frame = frames[step]
            pose = sensor.vehicle_T_reference(frames.scenario.ego_box(), np.random.default_rng([0, step]))
            rays = bare_rays(sensor, pose), bare_rays(lidar, lidar.mount.matrix())

            def whole(step=step):
                made = frames[step]
                metric.update(made.sensor, made.reference)

            def bare_parts(rays=rays, frame=frame):
                for parts in rays:
                    list(pool.map(lambda part: bare.run(*part, output=True), parts))
                KDTree(frame.sensor.numpy()).query(frame.reference.numpy())

            seconds, ratios = compare(bare_parts, whole, rounds=5)
            rows.append((step, len(frame.reference), seconds[0], seconds[1], ratios[1]))
    table(("step", "reference points", "bare rays + bare search (s)", "torchcover (s)", "torchcover / bare"), rows)
    print(f"\n{torch.get_num_threads()} threads.")


if __name__ == "__main__":
    main()
