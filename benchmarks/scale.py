"""How the cost of a run grows with rays, traffic, cells, steps, rigs and ranks, and what a thousand rigs would take.

Processor seconds of one thread. A run takes

    start + worlds * world + steps * (base + rays * ray + rigs * rig) + rigs * files

each of which is measured, and the whole beside a run that none of them was measured in.
"""

import argparse
import json
import os
import pickle
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks import table
from torchcover.data import RegionsOfInterest, SimulatedFrames, create_reference_sensor
from torchcover.evaluation import CoverageObserver, Settings
from torchcover.evaluation.checkpoint import write_checkpoint
from torchcover.evaluation.measurement import build_metric
from torchcover.evaluation.ranks import serialize
from torchcover.simulation import Scenario

RIG, SCENARIO, EVERY_S, STEPS_A_WORLD = "front_roof_128", "urban", 10.0, 6
RAYS = (4096, 16_384, 65_536, 262_144)
CELLS_M = (1.0, 0.25, 0.1, 0.05)
TRAFFIC = (5.0, 20.0, 80.0)  # vehicles to a kilometre of lane
RIGS = (1, 2, 4, 8)
RANKS = (4, 16, 64)
# The run that is extrapolated to: as in the documentation.
MANY_RIGS, MANY_SCENARIOS, STEPS = 1000, 100, 64
RIGS_TOGETHER = 8
RESUMED_STEPS = 150
COMMAND = (
    "evaluate",
    "front_roof_32",
    "--num-rays",
    "256",
    "--set",
    "cell_m=8",
    "--resume",
    "--num-frames",
    str(RESUMED_STEPS),
)
OFTEN = """
import sys
from torchcover.evaluation import checkpoint
checkpoint.CheckpointManager.params = checkpoint.CheckpointParams(interval_s=0.05, max_time_share=1.0)
from torchcover.cli.app import main
main()
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num-scenes", type=int, default=2, help="worlds of six steps each, for every row")
    parser.add_argument("--ranks", action="store_true", help="wall times of ranks and workers too: on a quiet machine")
    parser.add_argument("--kills", type=int, help="kill and resume runs this often instead")
    parser.add_argument("--seed", type=int, default=0, help="of the times of the kills")
    options = parser.parse_args()
    if options.kills:
        show_resumes(options.kills, options.seed)
        return
    torch.set_num_threads(1)
    times(1)  # what is imported and compiled at the first step is a part of the start
    steps = STEPS_A_WORLD * options.num_scenes
    table(("traffic", "bodies that move", "triangles", "a world (s)", "a step (s)"), list(by_traffic(steps)))
    of_rays = {rays: step_s(steps, rays=rays) for rays in RAYS}
    print()
    table(("rays of the reference", "a step (s)"), list(of_rays.items()))
    of_rigs = {rigs: step_s(steps, rigs=rigs) for rigs in RIGS}
    print()
    table(("rigs in the same frames", "a step (s)", "a step and rig (s)"), [(n, s, s / n) for n, s in of_rigs.items()])
    print()
    table(("cell (m)", "cells", "a step (s)", "sums (MB)", "checkpoint (s)", "checkpoint (MB)", "to another rank (MB)"),
          list(by_cells(steps)))  # fmt: skip
    print()
    table(("ranks", "from one to another (MB)", "until all are merged (s)"), list(by_ranks(steps)))
    print()
    table(("steps", "a step (s)"), [(n, step_s(n, rays=4096)) for n in (steps, 2 * steps, 4 * steps)])
    cost = fitted(steps, of_rays, of_rigs)
    print()
    table(("part", "processor seconds"), list(cost.items()))
    print()
    table(("run", "steps", "formula (s)", "measured (s)"), [checked(cost, 24)])
    print()
    table(("run", "core hours"), extrapolated(cost))
    if options.ranks:
        print()
        table(("processes", "wall (s)", "processor (s)"), list(by_processes()))


def frames_of(steps, *, rays=16_384, rigs=1, scenario=SCENARIO):
    rigs = {f"rig {number}": RIG for number in range(rigs)}
    reference = create_reference_sensor(num_rays=rays)
    return SimulatedFrames(scenario, rigs=rigs, num_frames=steps, frame_interval_s=EVERY_S, reference_sensor=reference)


def observers_of(frames, cell_m=0.25):
    asked = RegionsOfInterest().build_query_plan(cell_m=cell_m)
    return [CoverageObserver(build_metric(Settings(), asked, has_area_weights=True), name) for name in frames.rigs]


def times(steps, *, cell_m=0.25, **settings):
    """Processor seconds of all worlds and of all steps."""
    frames = frames_of(steps, **settings)
    observers = observers_of(frames, cell_m)
    worlds_s = steps_s = 0.0
    for index in range(steps):
        begin_s = time.process_time()
        frames.simulator.get_scene_geometry(index)
        built_s = time.process_time()
        frame = frames[index]
        for observer in observers:
            observer.update(frame)
        worlds_s, steps_s = worlds_s + built_s - begin_s, steps_s + time.process_time() - built_s
    return worlds_s, steps_s, frames, observers


def step_s(steps, **settings):
    return times(steps, **settings)[1] / steps


def by_traffic(steps):
    scenario = Scenario.load(SCENARIO)
    for vehicles in TRAFFIC:
        traffic = scenario.traffic.model_copy(update={"traffic_per_km": vehicles})
        worlds_s, steps_s, frames, _ = times(steps, scenario=scenario.model_copy(update={"traffic": traffic}))
        world = frames.simulator.get_scene_geometry(0)[0].scene
        meshes = [*world.static_meshes, world.ego.mesh, *(actor.mesh for actor in world.actors)]
        triangles = sum(len(mesh.faces) for mesh in meshes)
        worlds = steps / STEPS_A_WORLD
        yield f"{vehicles:g} vehicles/km", len(world.actors), triangles, worlds_s / worlds, steps_s / steps


def by_cells(steps):
    for cell_m in CELLS_M:
        _, steps_s, _, (observer,) = times(steps, cell_m=cell_m)
        state = observer.state_dict()
        sums_mb = sum(tensor.nbytes for tensor in state.values() if isinstance(tensor, torch.Tensor)) / 1e6
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "checkpoint.npz"
            begin_s = time.process_time()
            write_checkpoint(path, {}, {"coverage": state})
            taken_s = time.process_time() - begin_s
            size_mb = path.stat().st_size / 1e6
        grid = observer.metric.grid
        yield cell_m, grid.num_cells, steps_s / steps, sums_mb, taken_s, size_mb, len(serialize(observer)) / 1e6


def by_ranks(steps):
    """What merging in pairs takes the slowest pair of each round, of ranks that have seen a city each."""
    frames = frames_of(steps)
    seen = [frames[index] for index in range(steps)]
    for size in RANKS:
        ranks, took_s, apart = [], 0.0, 1
        for city in range(size):
            (observer,) = observers_of(frames)
            for number in range(STEPS_A_WORLD):
                observer.update(replace(seen[(city + number) % steps], block_index=city))
            ranks.append(observer)
        sent_mb = len(serialize(ranks[-1])) / 1e6
        while apart < size:
            pairs_s = []
            for rank in range(0, size, 2 * apart):
                begin_s = time.process_time()
                ranks[rank].merge_state(pickle.loads(serialize(ranks[rank + apart])))
                pairs_s.append(time.process_time() - begin_s)
            took_s, apart = took_s + max(pairs_s), 2 * apart
        yield size, sent_mb, took_s


def fitted(steps, of_rays, of_rigs):
    """The parts of the formula; slopes are least squares."""
    worlds_s, *_ = times(steps)
    ray_s, _ = np.polyfit(list(of_rays), list(of_rays.values()), 1)
    rig_s, _ = np.polyfit(list(of_rigs), list(of_rigs.values()), 1)
    base_s = of_rigs[1] - rig_s - 16_384 * ray_s
    start_s, files_s = command_s(1), command_s(4)
    one_s = worlds_s * STEPS_A_WORLD / steps + of_rigs[1]
    files_each_s = max(0.0, (files_s - start_s) / 3 - rig_s)
    return {
        "start": start_s - one_s - files_each_s,
        "world": worlds_s * STEPS_A_WORLD / steps,
        "base": base_s,
        "ray": ray_s,
        "rig": rig_s,
        "files": files_each_s,
    }


def command_s(rigs, steps=1):
    """Processor seconds of a command from its start to its end."""
    verb = ("evaluate", RIG) if rigs == 1 else ("compare", *([RIG] * rigs))
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-m", "torchcover", *verb, "--scenario", SCENARIO, "--num-frames", str(steps)]
        return ended([*command, "--out", out])[1]


def ended(command):
    """Wall and processor seconds of a command and its children, one thread each."""
    before, begin_s = os.times(), time.perf_counter()
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment)
    after = os.times()
    used_s = after.children_user + after.children_system - before.children_user - before.children_system
    return time.perf_counter() - begin_s, used_s


def run_s(cost, rigs, steps, rays=16_384):
    """The formula."""
    worlds = -(-steps // STEPS_A_WORLD)
    of_steps = steps * (cost["base"] + rays * cost["ray"] + rigs * cost["rig"])
    return cost["start"] + worlds * cost["world"] + of_steps + rigs * cost["files"]


def checked(cost, steps):
    return f"evaluate {RIG} in {SCENARIO}", steps, run_s(cost, 1, steps), command_s(1, steps)


def extrapolated(cost):
    """Core hours of many rigs in many scenarios of this kind."""
    alone = MANY_RIGS * MANY_SCENARIOS * run_s(cost, 1, STEPS)
    together = MANY_RIGS / RIGS_TOGETHER * MANY_SCENARIOS * run_s(cost, RIGS_TOGETHER, STEPS)
    what = f"{MANY_RIGS:,} rigs x {MANY_SCENARIOS} scenarios x {STEPS} steps"
    return [
        (f"{what}, `evaluate` of each", alone / 3600),
        (f"{what}, `compare` of {RIGS_TOGETHER} at a time", together / 3600),
    ]


def by_processes(steps=48):
    """Wall and processor time by the number of workers and of ranks."""
    arguments = ["torchcover", "evaluate", RIG, "--scenario", SCENARIO, "--num-frames", str(steps)]
    launch = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node"]
    runs = {
        "one": [sys.executable, "-m", *arguments],
        "2 workers": [sys.executable, "-m", *arguments, "--num-workers", "2"],
        "2 ranks": [*launch, "2", "-m", *arguments],
    }
    for name, command in runs.items():
        with tempfile.TemporaryDirectory() as out:
            yield name, *ended([*command, "--out", out])


def show_resumes(kills_wanted, seed):
    """Kill runs at random and resume them until complete; print whether their numbers are those of an unbroken run."""
    chance, found, kills, runs = random.Random(seed), Counter(), 0, 0
    with tempfile.TemporaryDirectory() as place:
        whole = Path(place) / "whole"
        begin_s = time.monotonic()
        started(whole).wait()
        unbroken_s = time.monotonic() - begin_s
        while kills < kills_wanted:
            out, code, of_run, runs = Path(place) / f"out{runs}", None, 0, runs + 1
            while code != 0:
                process = started(out)
                if kills < kills_wanted:
                    kill_after(process, chance.uniform(0.5, 1.0) * unbroken_s)
                code = process.wait()
                if code == -signal.SIGKILL:
                    kills, of_run = kills + 1, of_run + 1
                    found[
                        "killed", "with a checkpoint" if (out / "checkpoint.npz").exists() else "before its first"
                    ] += 1
                elif code:
                    found["ended with an error", f"exit code {code}"] += 1
                    break
            same = code == 0 and numbers(out) == numbers(whole)
            found["complete", "the same bits" if same else "OTHER BITS"] += 1
    print(f"{kills} kills in {runs} runs of {RESUMED_STEPS} steps\n")
    table(("runs", "what is there", "how often"), [(*what, count) for what, count in sorted(found.items())])


def started(out):
    """A run of the command line."""
    command = [sys.executable, "-c", OFTEN, *COMMAND, "--out", str(out)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def kill_after(process, seconds):
    """Kill it then, unless it has ended before."""
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        process.kill()


def numbers(out):
    """All that was measured; the time that it took is another one each time."""
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    summary.pop("seconds")
    return summary, (out / "coverage.npz").read_bytes(), (out / "summary.csv").read_bytes()


if __name__ == "__main__":
    main()
