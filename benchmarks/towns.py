"""What towns of SUMO cost: a world, a step beside `urban`, a hundred runs, a crowd far away, 100,000 streets."""

import os
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.timing import compare, table
from torchcover import Scenario
from torchcover.data import SimulatedFrames
from torchcover.simulation import PaperReference
from torchcover.simulation.sumo import Sumo
from torchcover.simulation.sumo.network import read_network
from torchcover.simulation.sumo.simulating import run

RIG = "front_roof_128"
WORLDS, STEPS = 8, 12
RUNS, EVERY_RUNS = 100, 25
# A grid of so many junctions each way has 101,760 streets; of the few, one is as good as another.
JUNCTIONS, STREET_M, CROWD = 160, 120.0, 10_000


def main():
    """Print a table for each."""
    worlds()
    print()
    steps()
    print()
    runs()
    print()
    far_away()


def worlds():
    """Processor time of ours; SUMO's programs are processes of their own."""
    rows = []
    scenario = Scenario.load("sumo_random")
    ego = scenario.ego_mesh()
    for seed in range(WORLDS):
        start = time.process_time()
        world = scenario.world(seed, 0, ego)
        taken_s = time.process_time() - start
        faces = sum(len(mesh.faces) for mesh in world.static)
        rows.append((seed, taken_s, f"{faces:,}", len(world.actors), len(world.parked)))
    table(("seed", "a world of 60 s (s)", "triangles", "road users near", "parked"), rows)


def steps():
    """A step of both, in turns, and how much there is to be hit."""
    sources = {name: SimulatedFrames(name, RIG, steps=STEPS, seed=1, every_s=1.0) for name in ("urban", "sumo_random")}
    seconds, ratios = compare(
        *(lambda frames=frames: [frames[index] for index in range(STEPS)] for frames in sources.values()),
        rounds=5,
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


def far_away():
    """A network of 100,000 streets, and a crowd all over it."""
    with TemporaryDirectory() as name:
        net, rows = Path(name) / "large.net.xml", []
        run(
            "netgenerate", "--grid", "--grid.number", str(JUNCTIONS), "--grid.length", str(STREET_M),
            "--no-turnarounds", "true", "--output-file", net,
        )  # fmt: skip
        start = time.process_time()
        network = read_network(net)
        read_s = time.process_time() - start
        streets = len({lane.edge for lane in network.lanes if lane.use == "road"})
        crowd_m = np.random.default_rng(0).uniform(0.0, JUNCTIONS * STREET_M, (CROWD, 2))
        from_m, to_m = next(lane for lane in network.lanes if lane.use == "road").line_m[[0, -1], :2]
        for kept in (np.linalg.norm(crowd_m - from_m, axis=1) < 2 * STREET_M, np.ones(CROWD, dtype=bool)):
            fcd = Path(name) / "fcd.xml"
            fcd.write_text(_driving(from_m, to_m, crowd_m[kept]), encoding="utf-8")
            scenario = Scenario(name="large", traffic=Sumo(net=net, fcd=fcd, ego_id="ego", duration_s=4.0))
            start = time.process_time()
            world = scenario.world(0)
            built_s = time.process_time() - start
            frames = SimulatedFrames(scenario, RIG, steps=STEPS)
            seconds, _ = compare(
                lambda frames=frames: [frames[index] for index in range(STEPS)], rounds=5, clock=time.process_time
            )
            faces = sum(len(mesh.faces) for mesh in world.static)
            rows.append((f"{int(kept.sum()):,}", built_s, f"{faces:,}", len(world.actors), 1000 * seconds[0] / STEPS))
        print(f"{streets:,} streets ({net.stat().st_size / 1e6:.0f} MB) are read once, in {read_s:.0f} s.\n")
        table(("vehicles", "a world, FCD included (s)", "triangles", "vehicles near", "a step (ms)"), rows)


def _driving(from_m, to_m, crowd_m):
    """Floating car data: everybody drives at 10 m/s, the ego along its street."""
    way = (to_m - from_m) / np.linalg.norm(to_m - from_m)
    angle_deg = 90.0 - np.rad2deg(np.arctan2(way[1], way[0]))
    row = '<vehicle id="{}" x="{:.2f}" y="{:.2f}" angle="{:.2f}" type="car"/>'
    rows = ["<fcd-export>"]
    for step in range(41):
        ego_m = from_m + (20.0 + step) * way
        rows.append(f'<timestep time="{step / 10:.1f}">{row.format("ego", *ego_m, angle_deg)}')
        rows += [row.format(k, x + step, y, 90.0) for k, (x, y) in enumerate(crowd_m.tolist())]
        rows.append("</timestep>")
    return "".join([*rows, "</fcd-export>"])


def _resident_mb():
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6)
