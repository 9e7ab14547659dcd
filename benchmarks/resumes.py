"""Is a run lost? Runs that are killed at random, again and again, and go on: their files beside an unbroken one's.

Each run is killed until it is complete; it passes if every number that it leaves is that of the unbroken run, to the
last bit. A checkpoint is written twenty times a second, so that kills hit it at work.
"""

import argparse
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from benchmarks.timing import table

STEPS = 150
COMMAND = ("evaluate", "front_roof_32", "--rays", "256", "--cell-m", "8", "--resume", "--steps", str(STEPS))
OFTEN = """
import sys
from torchcover.evaluation import checkpoint
checkpoint.EVERY_S, checkpoint.MOST_TIME = 0.05, 1.0
from torchcover.cli.app import main
main()
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args([] if __name__ != "__main__" else None)
    chance, found, kills, runs = random.Random(options.seed), Counter(), 0, 0
    with tempfile.TemporaryDirectory() as place:
        whole = Path(place) / "whole"
        begin_s = time.monotonic()
        started(whole).wait()
        unbroken_s = time.monotonic() - begin_s
        while kills < options.kills:
            out, code, of_run, runs = Path(place) / f"out{runs}", None, 0, runs + 1
            while code != 0:
                process = started(out)
                if kills < options.kills:
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
    print(f"{kills} kills in {runs} runs of {STEPS} steps\n")
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
