"""Documents and options that nobody should write: how each call of the command line ends, in this process."""

import contextlib
import io
import os
import resource
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from unittest import mock

from benchmarks.timing import table
from tests.cli.hostile import PLAIN, cases
from torchcover.cli import app

# Of the processor's time.
LIMIT_S = 20
# The maps of those that make sense after all are left out: they take most of the time, and tests/report has them.
NO_MAPS = mock.patch("torchcover.evaluation.result.map_figures", return_value=())
# Rather a MemoryError than a machine that stands still.
MOST_BYTES = 12_000_000_000


class TooLongError(BaseException):
    """The time of a call is over; no handler of errors is to take it for one."""


def main():
    """Print how many calls ended how, the slowest, and each that did not end as it should."""
    resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, resource.RLIM_INFINITY))
    signal.signal(signal.SIGPROF, _stop)
    assert ending_of(PLAIN, limit_s=0)[0] == "ran"  # imports what the others need, be it as slow as it likes
    endings, slowest, before = Counter(), (0.0, ""), _peak_mb()
    for case in cases():
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
