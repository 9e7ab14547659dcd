"""Results after kills: every command, killed at each of its file operations, and real runs, killed at random.

Each run is a fork of this process, which saves the imports, and writes into a folder with an earlier result. A copy of
the folder before each file operation is what a kill at that operation leaves. A reader of the copy finds the earlier
result, the new one, perhaps without its maps, or is told that the folder is incomplete; anything else is mixed. There
is no earlier recording; a recording is mixed if a part of it is read, or if `--resume` does not complete it.
"""

import argparse
import importlib
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from matplotlib.figure import Figure

from benchmarks import table
from tests.cli.hostile import RIG, YARD
from tests.killing import run_in_fork
from tests.placement.surfaces import Surface
from torchcover.cli import app, search_run
from torchcover.data import open_recording
from torchcover.evaluation import result
from torchcover.files import SUMMARY, BadFileError, guard_reader, read_manifest
from torchcover.placement import SearchPlan

SPACE = """name: roof
start: rig.yaml
scenario: urban
free: {top: {x_m: [-0.6, 0.8], z_m: 1.8}}
objectives: {near: {region: 20m}}
"""
SELECTION = """name: corners
scenario: yard.yaml
candidates:
  small:
    sensor: {type: lidar, channels: 8, vertical_fov_deg: [-30, 0], horizontal_fov_deg: 180, columns: 9, max_range_m: 9}
    mounts: {front: {x_m: 2.1, z_m: 1.0}, rear: {x_m: -2.1, z_m: 1.0, yaw_deg: 180}, roof: {z_m: 2.0}}
constraints: {max_sensors: 2}
prices_eur: {small: 1}
objectives: {near: {threshold_m: 1.0, band: ground, region: 20m}}
"""
SCENARIO = ("--scenario", "yard.yaml")
SMALL_RUN = (*SCENARIO, "--num-rays", "64", "--set", "cell_m=8", "--num-frames", "2")
RESULT_COMMANDS = {
    "evaluate": ("evaluate", "rig.yaml", *SMALL_RUN),
    "evaluate --resume": ("evaluate", "rig.yaml", *SMALL_RUN, "--resume"),
    "compare": ("compare", "rig.yaml", "other.yaml", *SMALL_RUN),
    "targets": ("targets", "rig.yaml", "--raster", "3,5,-1,1,1"),
    "search": ("search", "space.yaml", "--num-evaluations", "2"),
    "search, a selection": ("search", "selection.yaml", "--num-rays", "256", "--frames-per-scene", "1"),
    "study": ("study", "rig.yaml", *SCENARIO, "--num-rays", "64", "--num-rays", "32", "--num-frames", "8"),
}
RECORD = ("record", "rig.yaml", *SCENARIO, "--num-rays", "64", "--num-frames", "2")
RECORDING_COMMANDS = {"record": RECORD, "record --format kitti": (*RECORD, "--format", "kitti")}
RANDOM_RUN = ("evaluate", "front_roof_32", "--scenario", "urban", "--num-frames", "4", "--num-workers", "2")
OUTCOMES = ("the earlier", "the new", "incomplete", "mixed")
DOCUMENTS = {
    "rig": RIG,
    "other": RIG.replace("name: r", "name: other").replace("z_m: 2.0", "z_m: 2.4"),
    "yard": YARD,
    "space": SPACE,
    "selection": SELECTION,
}


def main():
    """Print the outcomes after each kill, and the number of mixed results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = ";".join([*RECORDING_COMMANDS, *RESULT_COMMANDS])
    parser.add_argument("--commands", default=commands, help="separated by semicolons")
    parser.add_argument("--kills", type=int, default=70, help="number of real runs that are killed at random")
    options, _ = parser.parse_known_args()
    # Forks share modules that a run would import late.
    for name in ("evaluation.study", "cli.printing", "recordings"):
        importlib.import_module(f"torchcover.{name}")
    importlib.import_module("pykdtree.kdtree")
    torch.set_num_threads(1)  # other threads do not survive a fork
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for name, text in DOCUMENTS.items():
            Path(f"{name}.yaml").write_text(text)
        random_rows = kill_at_random(options.kills) if options.kills else []
        rows = []
        for name in options.commands.split(";"):
            kill = kill_result if name in RESULT_COMMANDS else kill_recording
            rows.append((name, *kill(name)))
            print(rows[-1], file=sys.stderr, flush=True)
        os.chdir("/")
    table(("command", "file operations", *OUTCOMES), rows)
    print()
    table(("real runs, killed at random", "runs", *OUTCOMES), random_rows)
    print(f"\nMixed: {sum(row[-1] for row in (*rows, *random_rows))}")


def make_surface(space, plan, seed, num_scenes):
    """Make frames that score rigs by a known function instead of a simulation."""
    return Surface(seed, num_scenes, plan.frames_per_scene)


@dataclass(frozen=True)
class SurfacePlan(SearchPlan):
    """Plan of a search that scores rigs by a known function."""

    make_frames: Callable = make_surface


def make_blank_maps(*_, **__):
    return [("map1", Figure((1, 1)))]


def run(command, out, *options):
    """Run the command line in this process, which must be a fork."""
    # A shell ignores Ctrl-C in background processes.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    devnull = os.open(os.devnull, os.O_WRONLY)
    os.dup2(devnull, 1)
    os.dup2(devnull, 2)
    sys.argv = ["torchcover", *command, *options, "--out", str(out)]
    if "space.yaml" in command:
        search_run.SearchPlan = SurfacePlan
    if command is not RANDOM_RUN:  # maps take most of the time
        result.plot_maps = make_blank_maps
    try:
        app.main()
    except SystemExit as end:
        os._exit(end.code or 0)


def kill_result(name):
    """Count the file operations of a command, and the outcomes of kills at each of them."""
    command, folder = RESULT_COMMANDS[name], Path(tempfile.mkdtemp(dir="."))
    earlier, complete = folder / "earlier", folder / "complete"
    changes = ("--num-frames", "1") if "--resume" in command else ("--seed", "1")
    assert run_in_fork(lambda: run(command, earlier, *changes))[1] == 0
    shutil.copytree(earlier, complete)
    count, code = run_in_fork(lambda: run(command, complete), copied=(complete, folder / "killed"))
    assert code == 0
    earlier_files, new_files = read_files(earlier), read_files(complete)
    assert earlier_files != new_files
    outcomes = Counter()
    for index in range(count):
        outcomes[classify_outcome(folder / "killed" / str(index), earlier_files, new_files)] += 1
    return count, *(outcomes[outcome] for outcome in OUTCOMES)


def kill_recording(name):
    """Count the same for a recording, which `--resume` must complete."""
    command, folder = RECORDING_COMMANDS[name], Path(tempfile.mkdtemp(dir="."))
    complete = folder / "complete"
    count, code = run_in_fork(lambda: run(command, complete), copied=(complete, folder / "killed"))
    assert code == 0
    num_frames, outcomes = count_frames(complete), Counter()
    for index in range(count):
        out = folder / "killed" / str(index)
        outcome = {None: "the earlier", num_frames: "the new"}.get(count_frames(out), "mixed")
        _, code = run_in_fork(lambda out=out: run(command, out, "--resume"))
        is_completed = code == 0 and count_frames(out) == num_frames
        outcomes[outcome if is_completed else "mixed"] += 1
    return count, *(outcomes[outcome] for outcome in OUTCOMES)


def count_frames(recording):
    """Count the frames of a recording; None if there is none or it is incomplete."""
    try:
        return len(open_recording(recording).frame_names)
    except (ValueError, OSError):
        return None


def kill_at_random(num_kills):
    """Kill runs in a city with workers by each signal in turn, and count the outcomes by signal."""
    folder, rng = Path(tempfile.mkdtemp(dir=".")), random.Random(0)
    earlier, complete = folder / "earlier", folder / "complete"
    assert run_in_fork(lambda: run(RANDOM_RUN, earlier, "--seed", "1"))[1] == 0
    shutil.copytree(earlier, complete)
    start_s = time.perf_counter()
    assert run_in_fork(lambda: run(RANDOM_RUN, complete))[1] == 0
    duration_s = time.perf_counter() - start_s
    signals = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    outcomes = {number: Counter() for number in signals}
    for kill in range(num_kills):
        out, number = folder / str(kill), signals[kill % len(signals)]
        shutil.copytree(earlier, out)
        pid = os.fork()
        if not pid:
            run(RANDOM_RUN, out)
            os._exit(1)
        time.sleep(rng.uniform(0.0, duration_s))
        os.kill(pid, number)
        os.waitpid(pid, 0)
        outcomes[number][classify_outcome(out, read_files(earlier), read_files(complete))] += 1
        print(f"{number.name}: {dict(outcomes[number])}", file=sys.stderr, flush=True)
        shutil.rmtree(out)
    rows = []
    for number, counts in outcomes.items():
        rows.append((number.name, counts.total(), *(counts[outcome] for outcome in OUTCOMES)))
    return rows


@guard_reader("a file of a result")
def read_file(path):
    """Read a file as a reader of results does."""
    return path.read_bytes()


def read_files(out):
    """Read all files of a result by name."""
    names = json.loads(read_file(out / SUMMARY))["files"]
    return {name: read_file(out / name) for name in (*names, SUMMARY)}


def classify_outcome(out, earlier, new):
    """Classify what a reader finds in a folder as one of `OUTCOMES`."""
    content, is_incomplete = {}, False
    for name in {**earlier, **new}:
        try:
            content[name] = read_file(out / name)
        except FileNotFoundError:
            continue
        except BadFileError as error:
            if "an incomplete result" not in str(error):
                return "mixed"
            is_incomplete = True
    if is_incomplete:
        return "incomplete"
    manifest = read_manifest(out / SUMMARY) or {"files": {}}
    content = {name: content.get(name) for name in (*manifest["files"], SUMMARY)}
    if content == earlier:
        return "the earlier"
    for name, data in content.items():
        if data is None or data == earlier.get(name) != new.get(name):
            return "mixed"
    return "the new"


if __name__ == "__main__":
    main()
