"""Are results safe from kills? Every command, killed at each of its file operations, and real runs killed at random.

Every run is a fork of this process, so that it need not import anything, into a folder that holds an earlier result.
A copy of that folder just before each operation is what a kill leaves there. A reader then finds *the earlier* result,
*the new* one, perhaps without its maps, or is told that the folder is *incomplete*; anything else is *mixed*. A
recording has no earlier one; it is mixed if a part of it is read, or `--resume` does not complete it.
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
CHOICE = """name: corners
scenario: yard.yaml
candidates:
  small:
    sensor: {type: lidar, channels: 8, vertical_fov_deg: [-30, 0], horizontal_fov_deg: 180, columns: 9, max_range_m: 9}
    mounts: {front: {x_m: 2.1, z_m: 1.0}, rear: {x_m: -2.1, z_m: 1.0, yaw_deg: 180}, roof: {z_m: 2.0}}
constraints: {max_sensors: 2}
prices_eur: {small: 1}
objectives: {near: {threshold_m: 1.0, band: ground, region: 20m}}
"""
WORLD = ("--scenario", "yard.yaml")
SMALL = (*WORLD, "--num-rays", "64", "--set", "cell_m=8", "--num-frames", "2")
RESULTS = {
    "evaluate": ("evaluate", "rig.yaml", *SMALL),
    "evaluate --resume": ("evaluate", "rig.yaml", *SMALL, "--resume"),
    "compare": ("compare", "rig.yaml", "other.yaml", *SMALL),
    "targets": ("targets", "rig.yaml", "--raster", "3,5,-1,1,1"),
    "search": ("search", "space.yaml", "--num-evaluations", "2"),
    "search, a choice": ("search", "choice.yaml", "--num-rays", "256", "--frames-per-scene", "1"),
    "study": ("study", "rig.yaml", *WORLD, "--num-rays", "64", "--num-rays", "32", "--num-frames", "8"),
}
RECORDINGS = {
    "record": ("record", "rig.yaml", *WORLD, "--num-rays", "64", "--num-frames", "2"),
    "record --format kitti": (
        "record",
        "rig.yaml",
        *WORLD,
        "--num-rays",
        "64",
        "--num-frames",
        "2",
        "--format",
        "kitti",
    ),
}
# How an earlier result differs.
EARLIER = {"evaluate --resume": ("--num-frames", "1")}
OTHERWISE = ("--seed", "1")
REAL = ("evaluate", "front_roof_32", "--scenario", "urban", "--num-frames", "4", "--num-workers", "2")
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
VERDICTS = ("the earlier", "the new", "incomplete", "mixed")
DOCUMENTS = {
    "rig": RIG,
    "other": RIG.replace("name: r", "name: other").replace("z_m: 2.0", "z_m: 2.4"),
    "yard": YARD,
    "space": SPACE,
    "choice": CHOICE,
}
# What a run imports late; a fork has it already.
IMPORTED = ("torchcover.evaluation.study", "torchcover.cli.printing", "torchcover.recordings", "pykdtree.kdtree")


def main():
    """Print what is there after each kill, and how much is lost of all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--commands", default=";".join([*RECORDINGS, *RESULTS]), help="separated by semicolons")
    parser.add_argument("--kills", type=int, default=70, help="of real runs, at random")
    options, _ = parser.parse_known_args()
    for name in IMPORTED:
        importlib.import_module(name)
    torch.set_num_threads(1)  # others do not survive a fork
    with tempfile.TemporaryDirectory() as place:
        os.chdir(place)
        for name, text in DOCUMENTS.items():
            Path(f"{name}.yaml").write_text(text)
        at_random = killed_at_random(options.kills) if options.kills else []
        rows = []
        for name in options.commands.split(";"):
            killed = killed_result(name) if name in RESULTS else killed_recording(RECORDINGS[name])
            rows.append((name, *killed))
            print(f"{name}: {killed}", file=sys.stderr, flush=True)
        os.chdir("/")
    table(("command", "file operations", *VERDICTS), rows)
    print()
    table(("real runs, killed at random", "runs", *VERDICTS), at_random)
    print(f"\nMixed: {sum(row[-1] for row in (*rows, *at_random))}")


def make_surface(space, plan, seed, num_scenes):
    """Make frames with known numbers instead of simulated ones."""
    return Surface(seed, num_scenes, plan.frames_per_scene)


@dataclass(frozen=True)
class SurfacePlan(SearchPlan):
    """Plan of a search that scores rigs by a known function."""

    make_frames: Callable = make_surface


def run(command, out, *options):
    """Run the command line in this process, which is to be a fork."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # which is ignored where this runs in the background
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    sys.argv = ["torchcover", *command, *options, "--out", str(out)]
    if "space.yaml" in command:  # frames are made up
        search_run.SearchPlan = SurfacePlan
    if command is not REAL:  # drawing takes most of the time
        result.plot_maps = lambda *_, **__: [("map1", Figure((1, 1)))]
    try:
        app.main()
    except SystemExit as end:
        os._exit(end.code or 0)


def killed_result(name):
    """How many operations a command has, and how often what is there after a kill at each is what."""
    command = RESULTS[name]
    place = Path(tempfile.mkdtemp(dir="."))
    earlier, whole = place / "earlier", place / "whole"
    assert run_in_fork(lambda: run(command, earlier, *EARLIER.get(name, OTHERWISE)))[1] == 0
    shutil.copytree(earlier, whole)
    count, code = run_in_fork(lambda: run(command, whole), copied=(whole, place / "killed"))
    assert code == 0
    contents = files_of(earlier), files_of(whole)
    assert contents[0] != contents[1]
    found = Counter(verdict(place / "killed" / str(at), *contents) for at in range(count))
    return count, *(found[name] for name in VERDICTS)


def killed_recording(command):
    """The same of a recording: the earlier is none, or a part that is not read and gone on with."""
    place = Path(tempfile.mkdtemp(dir="."))
    whole = place / "whole"
    count, code = run_in_fork(lambda: run(command, whole), copied=(whole, place / "killed"))
    assert code == 0
    frames, found = frames_of(whole), Counter()
    for out in (place / "killed" / str(at) for at in range(count)):
        name = {None: "the earlier", frames: "the new"}.get(frames_of(out), "mixed")
        went_on = run_in_fork(lambda out=out: run(command, out, "--resume"))[1] == 0
        found[name if went_on and frames_of(out) == frames else "mixed"] += 1
    return count, *(found[name] for name in VERDICTS)


def frames_of(recording):
    """How many frames are read; None where a reader finds no recording, or is told that it is a part."""
    try:
        return len(open_recording(recording).frame_names)
    except (ValueError, OSError):
        return None


def killed_at_random(kills):
    """Runs in a city, with workers, ended by each signal in turn."""
    place, chance = Path(tempfile.mkdtemp(dir=".")), random.Random(0)
    earlier, whole = place / "earlier", place / "whole"
    assert run_in_fork(lambda: run(REAL, earlier, *OTHERWISE))[1] == 0
    shutil.copytree(earlier, whole)
    start = time.perf_counter()
    assert run_in_fork(lambda: run(REAL, whole))[1] == 0
    seconds, found = time.perf_counter() - start, {number: Counter() for number in SIGNALS}
    for kill in range(kills):
        out, number = place / str(kill), SIGNALS[kill % len(SIGNALS)]
        shutil.copytree(earlier, out)
        if not (pid := os.fork()):
            run(REAL, out)
            os._exit(1)
        time.sleep(chance.uniform(0.0, seconds))
        os.kill(pid, number)
        os.waitpid(pid, 0)
        found[number][verdict(out, files_of(earlier), files_of(whole))] += 1
        print(f"{number.name}: {dict(found[number])}", file=sys.stderr, flush=True)
        shutil.rmtree(out)
    return [(one.name, each.total(), *(each[name] for name in VERDICTS)) for one, each in found.items()]


@guard_reader("a file of a result")
def content(path):
    """What a reader finds."""
    return path.read_bytes()


def files_of(out):
    """The files of a result, as a reader finds them, by name."""
    names = json.loads(content(out / SUMMARY))["files"]
    return {name: content(out / name) for name in (*names, SUMMARY)}


def verdict(out, earlier, whole):
    """What a reader finds of all files that the results list."""
    found, incomplete = {}, False
    for name in {**earlier, **whole}:
        try:
            found[name] = content(out / name)
        except FileNotFoundError:
            continue
        except BadFileError as error:
            if "an incomplete result" not in str(error):
                return "mixed"
            incomplete = True
    if incomplete:
        return "incomplete"
    manifest = read_manifest(out / SUMMARY) or {"files": {}}
    found = {name: found.get(name) for name in (*manifest["files"], SUMMARY)}
    if found == earlier:
        return "the earlier"
    is_mixed = any(text is None or text == earlier.get(name) != whole.get(name) for name, text in found.items())
    return "mixed" if is_mixed else "the new"


if __name__ == "__main__":
    main()
