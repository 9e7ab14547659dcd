"""Are results safe from kills? Runs into a folder that holds a good result, killed at random and at every file.

Every run is a fork of this process, so that it need not import anything. Of four, three are killed as they write,
rename or delete a file of the folder, at places spread over the whole run; the others at random.

What is there afterwards is *the earlier result*; *the new one*, perhaps without maps or cut short, which it says;
*incomplete*: no `summary.json`; or BROKEN: a `summary.json` that lists files which are missing or of another run, or a
folder that the next run cannot use.
"""

import argparse
import importlib
import itertools
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from unittest import mock

from matplotlib.figure import Figure

from benchmarks.timing import table
from tests.cli.hostile import RIG, YARD
from torchcover import Coverage
from torchcover.cli import app
from torchcover.files import claimed

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
# Of Python's audit events.
TOUCHES = ("open", "os.rename", "os.remove", "os.rmdir")
EARLIER_STEPS, STEPS = 2, 12
COMMAND = ("torchcover", "evaluate", "rig.yaml", "--scenario", "yard.yaml", "--rays", "64", "--cell-m", "8")
# What a run imports late; a fork has it already.
IMPORTED = ("torchcover.evaluation.study", "torchcover.cli.printing", "pykdtree.kdtree")
# Blank ones: drawing takes most of the time.
MAPS = mock.patch(
    "torchcover.evaluation.result.map_figures", return_value=[(name, Figure((1, 1))) for name in ("map1", "map2")]
)


def main():
    """Print what is there after how many kills."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=60)
    options, _ = parser.parse_known_args()
    for name in IMPORTED:
        importlib.import_module(name)
    chance, found, codes = random.Random(0), Counter(), Counter()
    with tempfile.TemporaryDirectory() as place:
        good, whole, log = Path(place, "good"), Path(place, "whole"), Path(place, "log")
        Path(place, "rig.yaml").write_text(RIG)
        Path(place, "yard.yaml").write_text(YARD)
        os.chdir(place)
        assert code_of(started(good, EARLIER_STEPS)) == 0
        shutil.copytree(good, whole)
        start = time.perf_counter()
        assert code_of(started(whole, STEPS, lambda name: log.open("a").write(f"{name}\n"))) == 0
        seconds, touched = time.perf_counter() - start, log.read_text().splitlines()
        at_files = options.kills * 3 // 4
        for kill in range(options.kills):
            out, number = Path(place, f"out{kill}"), SIGNALS[kill % 3]
            shutil.copytree(good, out)
            if kill < at_files:
                at = kill * len(touched) // at_files
                when, code = named(touched[at]), code_of(started(out, STEPS, kills_at(at, number)))
            else:
                when, pid = "at random", started(out, STEPS)
                time.sleep(chance.uniform(0.0, seconds))
                os.kill(pid, number)
                code = code_of(pid)
            found[when, number.name, verdict(out, next_run=number == signal.SIGKILL)] += 1
            codes[number.name, code] += 1
    table(("killed at", "signal", "what is there", "runs"), [(*what, count) for what, count in sorted(found.items())])
    print("\nExit codes (below 0: the signal's): ", end="")
    print("; ".join(f"{name} {code}: {count}" for (name, code), count in sorted(codes.items())))


def started(out, steps, on_touch=None):
    """Run the command line in a fork; its process id.

    Args:
        out: The folder of its result.
        steps: Steps.
        on_touch: Called with the event and the file before a file in the folder is written, renamed or deleted.
    """
    if pid := os.fork():
        return pid
    signal.signal(signal.SIGINT, signal.default_int_handler)  # which is ignored where this runs in the background
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    inside = f"{out}{os.sep}"

    def told(event, arguments):
        # Where a file is opened for reading nothing can break.
        if event in TOUCHES and str(arguments[0]).startswith(inside) and arguments[1] not in ("r", "rb"):
            on_touch(f"{event} {str(arguments[0]).removeprefix(inside)}")

    if on_touch:
        sys.addaudithook(told)
    sys.argv = [*COMMAND, "--steps", str(steps), "--out", str(out)]
    code = 1
    try:
        with MAPS:
            app.main()
    except SystemExit as end:
        code = end.code
    finally:
        os._exit(code)


def kills_at(place, number):
    """Send a signal to this process at a touch of this place in their order."""
    touches = itertools.count()
    return lambda _: os.kill(os.getpid(), number) if next(touches) == place else None


def code_of(pid):
    """The exit code of a process, once it has ended; minus the signal's number, if one has ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def named(touch):
    """Where a touch is, without what changes from run to run: the name of the partial folder."""
    event, name = touch.split(" ", 1)
    first, _, rest = name.partition("/")
    if first.startswith(".partial_"):
        return f"{event} {rest or 'what is left of it'}, aside"
    return f"{event} {name}"


def verdict(out, *, next_run):
    """What a user finds, and the next run."""
    with claimed(out):  # which puts in their places what could not be put there
        found = _found(out)
    if next_run and (code_of(started(out, EARLIER_STEPS)) or _found(out) != "the earlier result"):
        return "BROKEN: not for the next run"
    return found


def _found(out):
    if not (out / "summary.json").exists():
        return "incomplete"
    try:
        summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
        steps = Coverage.load(out / "coverage.npz").counts["steps"]
        missing = [name for name in summary["files"] if not (out / name).is_file()]
    except (OSError, ValueError, KeyError) as error:
        return f"BROKEN: {error!r}"
    maps = {path.relative_to(out).as_posix() for path in out.glob("maps/*")}
    if missing or summary["counts"]["steps"] != steps or (steps == EARLIER_STEPS and not maps):
        return "BROKEN: mixed"
    if steps == EARLIER_STEPS:
        return "the earlier result"
    if steps != STEPS or not summary["complete"]:
        return "BROKEN: claims to be complete" if summary["complete"] else "the new one, cut short"
    return "the new one" if maps.issubset(summary["files"]) and maps else "the new one, without maps"


if __name__ == "__main__":
    main()
