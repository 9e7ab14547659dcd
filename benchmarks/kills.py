"""Are results safe from kills? Runs into a folder that holds a good result, killed at random and at each file.

A folder passes if its `summary.json` is there, lists files that are there, and they are of one run: the earlier one or
the new one, which says whether it is complete.
"""

import argparse
import json
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from benchmarks.timing import table
from torchcover import Coverage

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
FILES = ("coverage.npz", "summary.csv", "summary.json", "maps/*.png")
EARLIER_STEPS, STEPS = 2, 40
COMMAND = ("evaluate", "front_roof_32", "--rays", "256", "--cell", "8")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args([] if __name__ != "__main__" else None)
    chance, found = random.Random(options.seed), Counter()
    with tempfile.TemporaryDirectory() as place:
        good = Path(place) / "good"
        started(good, EARLIER_STEPS).wait()
        for kill in range(options.kills):
            out = Path(place) / f"out{kill}"
            shutil.copytree(good, out)
            number, at = SIGNALS[kill % 3], (None, *FILES)[kill // 3 % 5]
            found[number.name, at or "at random", verdict(out, killed(out, number, at, chance))] += 1
    table(("signal", "when", "what is there", "runs"), [(*what, count) for what, count in sorted(found.items())])


def started(out, steps):
    """A run of the command line."""
    command = [sys.executable, "-m", "torchcover", *COMMAND, "--steps", str(steps), "--out", str(out)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def killed(out, number, at, chance):
    """Run, and send the signal some time, or once a file is being written; the exit code."""
    process, begin, after_s = started(out, STEPS), time.monotonic(), chance.uniform(1.0, 8.0)
    while process.poll() is None:
        if any(out.glob(f".partial_*/{at}")) if at else time.monotonic() - begin > after_s:
            process.send_signal(number)
            break
        time.sleep(0.0005)
    return process.wait()


def verdict(out, code):
    """What a user finds."""
    try:
        summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
        steps = Coverage.load(out / "coverage.npz").counts["steps"]
        missing = [name for name in summary["files"] if not (out / name).is_file()]
    except (OSError, ValueError, KeyError) as error:
        return f"BROKEN: {error!r}"
    if missing or summary["counts"]["steps"] != steps or (summary["complete"] and steps not in (EARLIER_STEPS, STEPS)):
        return "MIXED"
    kept = steps == EARLIER_STEPS
    return f"{'the earlier result' if kept else 'the new one'}, complete: {summary['complete']} (exit code {code})"


if __name__ == "__main__":
    main()
