"""Damaged files through every reader, and malformed documents and options through the command line.

`python -m benchmarks.faults --files N --seeds ...` says how many damaged files of each seed are read.
"""

import argparse
import contextlib
import io
import os
import resource
import signal
import sys
import tempfile
import time
from collections import Counter
from itertools import product
from pathlib import Path
from unittest import mock

from benchmarks import table
from tests.cli.hostile import PLAIN, list_cases
from tests.damaged.good_files import kinds
from tests.damaged.mutated_files import attempt, attempt_pipe, bombs, largest_mb, mutated, silence_libraries
from torchcover.cli import app
from torchcover.files import isolated

# Of the processor's time.
LIMIT_S = 20
# The maps of those that make sense after all are left out: they take most of the time, and tests/report has them.
NO_MAPS = mock.patch("torchcover.evaluation.result.plot_maps", return_value=())
# Rather a MemoryError than a machine that stands still.
MOST_BYTES = 12_000_000_000


MAX_SECONDS, MAX_MB = 5.0, 500


class TooLongError(BaseException):
    """The time of a call is over; no handler of errors is to take it for one."""


def main():
    """Print the tables of damaged files, of bombs and of malformed documents."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", type=int, default=20_000, help="of each seed")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--show", action="store_true", help="print a message of every sort")
    arguments = parser.parse_args()
    show_damaged_files(arguments)
    print()
    show_documents()


def show_damaged_files(arguments):
    """Print a table of readers, and one of bombs."""
    with tempfile.TemporaryDirectory() as folder, silence_libraries():
        every = kinds(folder)
        found = {kind.name: Counter() for kind in every}
        messages = {}
        for number, seed in product(range(arguments.files), arguments.seeds):
            kind = every[number % len(every)]
            data = mutated(every, number, seed)
            outcome = attempt(kind, data, Path(folder), messages)
            _add(found[kind.name], outcome)
        outcomes_of_bombs = [(name, *attempt(kind, kind.data, Path(folder), messages)) for name, kind in bombs(every)]
        pipes = [(f"a FIFO called {kind.name}", *attempt_pipe(kind, Path(folder))) for kind in every]
    columns = ("read", "bad", "foreign", "unnamed", "slow", "large", "seconds", "MB")
    total = Counter()
    for counts in found.values():
        total = Counter(
            {
                key: max(total[key], counts[key]) if key in ("seconds", "MB") else total[key] + counts[key]
                for key in columns
            }
        )
    for reading in isolated._processes.values():
        reading.end()
    children_mb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    print(
        f"{arguments.files:,} files of each seed: {arguments.seeds}. The largest size of this process was "
        f"{largest_mb():.0f} MB, of one that reads for it {children_mb:.0f} MB.\n"
    )
    table(
        ("file", *columns),
        [(name, *(counts[key] for key in columns)) for name, counts in {**found, "all": total}.items()],
    )
    print()
    ended = Counter(outcome for _, outcome, _, _ in pipes)
    table(
        ("bomb", "outcome", "seconds", "MB"),
        [
            *outcomes_of_bombs,
            ("a FIFO, for each", dict(ended), max(row[2] for row in pipes), max(row[3] for row in pipes)),
        ],
    )
    if arguments.show:
        print("\n".join(sorted(messages.values())))


def _add(counts, outcome):
    what, seconds, grown_mb = outcome
    counts[what.partition(":")[0]] += 1
    counts["slow"] += seconds > MAX_SECONDS
    counts["large"] += grown_mb > MAX_MB
    counts["seconds"], counts["MB"] = max(counts["seconds"], seconds), max(counts["MB"], grown_mb)
    if what not in ("read", "bad"):
        print(what[:300])


def show_documents():
    """Print how many calls ended how, the slowest, and each that did not end as it should."""
    resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, resource.RLIM_INFINITY))
    signal.signal(signal.SIGPROF, _stop)
    assert ending_of(PLAIN, limit_s=0)[0] == "ran"  # imports what the others need, be it as slow as it likes
    endings, slowest, before = Counter(), (0.0, ""), _peak_mb()
    for case in list_cases():
        start = time.process_time()
        ending, words = ending_of(case)
        slowest = max(slowest, (time.process_time() - start, case.name))
        endings[ending] += 1
        if ending not in ("refused in one line", "ran"):
            print(f"{case.name}: {ending}: {words[:300]}", flush=True)
    table(("ending", "calls"), [*endings.most_common(), ("all", endings.total())])
    seconds, name = slowest
    print(f"\nThe slowest took {seconds:.1f} s of the processor's time ({name}).")
    print(f"Memory grew by {_peak_mb() - before:,.0f} MB at most.")


def ending_of(case, limit_s=LIMIT_S):
    """How a call ends, and what it says about it."""
    said, here = io.StringIO(), Path.cwd()
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(said),
    ):
        for name, content in case.files.items():
            Path(folder, name).write_text(content)
        case.prepare(Path(folder))
        os.chdir(folder)
        signal.setitimer(signal.ITIMER_PROF, limit_s)
        try:
            with NO_MAPS, mock.patch.object(sys, "argv", ["torchcover", *case.arguments]):
                app.main()
        except SystemExit as stop:
            return judged(stop.code, said.getvalue()), said.getvalue()
        except TooLongError:
            return f"over {LIMIT_S} s", said.getvalue()
        except BaseException as error:  # what a user would see as a traceback
            return "traceback", f"{type(error).__name__}: {error}"
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
            os.chdir(here)
    return "no exit", said.getvalue()


def judged(code, said):
    """What an exit code and the lines on stderr amount to; warnings come before the line that ends it."""
    lines = [line for line in said.splitlines() if line.startswith("torchcover: ") and "warning: " not in line[:24]]
    if code == 0:
        return "ran"
    return "refused in one line" if code == 2 and len(lines) == 1 and said.splitlines()[-1] == lines[0] else "other"


def _stop(*_):
    raise TooLongError


def _peak_mb():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000


if __name__ == "__main__":
    main()
