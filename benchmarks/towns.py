"""What towns of SUMO cost beside cities of our own: a world, a step, and a run of many towns."""

import os
import time
from pathlib import Path

import numpy as np

from benchmarks.timing import compare, table
from torchcover import Scenario
from torchcover.data import SimulatedFrames
from torchcover.simulation import PaperReference
from torchcover.simulation.sumo import Sumo

RIG = "front_roof_128"
KINDS = "urban", "sumo_random"
WORLDS, STEPS, ROUNDS = 8, 8, 3
RUNS, EVERY_RUNS = 30, 10


def main():
    """Print a table for each."""
    worlds()
    print()
    steps()
    print()
    runs()


def worlds():
    """Processor time of ours; SUMO's programs are processes of their own."""
    rows = []
    for name in KINDS:
        scenario = Scenario.load(name)
        ego, found = scenario.ego_mesh(), []
        scenario.world(WORLDS, 0, ego)  # what is loaded once is not counted
        for seed in range(WORLDS):
            start = time.process_time()
            world = scenario.world(seed, 0, ego)
            taken_s = time.process_time() - start
            faces = sum(len(mesh.faces) for mesh in world.static)
            found.append((taken_s, faces, len(world.actors), len(world.parked)))
        seconds, *counts = np.median(found, axis=0).tolist()
        rows.append((name, round(seconds, 2), *(f"{count:,.0f}" for count in counts)))
    table(("scenario", "a world of 60 s (s)", "triangles", "road users near", "parked"), rows)


def steps():
    """A step of both, in turns, and how much there is to be hit."""
    sources = {name: SimulatedFrames(name, RIG, steps=STEPS, seed=1, every_s=1.0) for name in KINDS}
    seconds, ratios = compare(
        *(lambda frames=frames: [frames[index] for index in range(STEPS)] for frames in sources.values()),
        rounds=ROUNDS,
        clock=time.process_time,
    )
    rows = []
    for (name, frames), taken_s, ratio in zip(sources.items(), seconds, ratios, strict=True):
        counts = [frames[index].counts for index in range(STEPS)]
        near = np.mean([count["moving_bodies"] - count["moving_bodies_out_of_range"] for count in counts])
        world = frames.simulator.scene_of(0)[0].world
        rows.append((name, 1000 * taken_s / STEPS, ratio, f"{sum(len(m.faces) for m in world.static):,}", float(near)))
    table(("scenario", "a step (ms)", "ratio", "triangles at rest", "moving bodies in range"), rows)


def runs():
    """Memory of this process while one run after the other is built."""
    traffic = Sumo(random={"network": "grid"}, duration_s=2.0, time_step_s=0.5)
    scenario = Scenario(name="town", traffic=traffic)
    frames = SimulatedFrames(scenario, RIG, steps=5 * RUNS + 1, reference_sensor=PaperReference(rows=8, columns=16))
    rows = []
    for number in range(RUNS + 1):
        frames[5 * number]
        if number % EVERY_RUNS == 0:
            rows.append((number, _resident_mb()))
    table(("runs built before", "memory of the process (MB)"), rows)


def _resident_mb():
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6)
