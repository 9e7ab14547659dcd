"""What ends a command from outside: Ctrl-C, a scheduler, a connection that is lost."""

import json
import os
import pty
import signal
import sys
import time

import pytest
import torch

from tests.killing import operations_of
from torchcover import Coverage
from torchcover.cli import app
from torchcover.coverage import CoverageSums
from torchcover.evaluation import progress
from torchcover.report.maps import plot_side_by_side

DRAW = "torchcover.report.maps.plot_side_by_side"


def arguments(worlds, *, num_frames=3):
    """Two rigs in the tiny yard."""
    rigs = [worlds / "low.yaml", worlds / "both.yaml"]
    settings = [
        "--scenario",
        worlds / "yard.yaml",
        "--set",
        "cell_m=4",
        "--thresholds-m",
        2,
        "--num-rays",
        4096,
        "--num-frames",
        num_frames,
    ]
    return ["compare", *rigs, *settings, "--out", worlds / "out"]


@pytest.fixture
def handler():
    """Set what a signal does."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    yield signal.signal
    for number, action in before.items():
        signal.signal(number, action)


@pytest.fixture
def at_update(monkeypatch):
    """Have something done before a rig sees a frame: number 3 is the first rig in the second step."""

    def have(number, act):
        add, calls = CoverageSums.add_sums, []

        def acting(self, sums):
            calls.append(self)
            if len(calls) == number:
                act()
            add(self, sums)

        monkeypatch.setattr(CoverageSums, "add_sums", acting)

    return have


def send(number, times=1):
    for _ in range(times):
        os.kill(os.getpid(), number)


def steps_of(out):
    """The steps of each rig, whether the run is complete, and how many maps there are."""
    summary = json.loads((out / "summary.json").read_text())
    counts = [Coverage.load(out / "coverage" / f"{name}.npz").counts["num_frames"] for name in ("low", "both")]
    assert counts == [of_rig["num_frames"] for of_rig in summary["counts"].values()]
    return counts, summary["complete"], sum(name.startswith("maps/") for name in summary["files"])


@pytest.mark.parametrize(
    ("number", "action", "expected", "steps", "said"),
    [
        (signal.SIGINT, signal.default_int_handler, 130, 2, ["torchcover: interrupted"]),
        (signal.SIGINT, signal.SIG_IGN, 0, 3, []),
        (signal.SIGTERM, signal.SIG_DFL, 143, 2, ["torchcover: terminated"]),
        (signal.SIGHUP, signal.SIG_DFL, 129, 2, ["torchcover: hung up"]),
        (signal.SIGHUP, signal.SIG_IGN, 0, 3, []),
    ],
)
def test_signal_between_two_rigs_leaves_a_paired_result(
    torchcover, worlds, at_update, handler, number, action, expected, steps, said
):
    handler(number, action)
    at_update(3, lambda: send(number))
    code, _, complaints = torchcover(*arguments(worlds))
    assert code == expected
    assert [line for line in complaints.splitlines() if line.startswith("torchcover:")] == said
    assert steps_of(worlds / "out")[:2] == ([steps, steps], expected == 0)
    assert signal.getsignal(number) is action


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_repeated_signal_has_no_effect(torchcover, worlds, at_update, monkeypatch, number):
    """To the process and to its group, by the system and by the shell."""
    monkeypatch.setattr(progress._TerminationHandler, "repeat_interval_s", 600.0)  # on a machine that is as slow as it likes
    at_update(3, lambda: send(number, times=2))
    monkeypatch.setattr(DRAW, lambda *given, **more: (send(number), plot_side_by_side(*given, **more))[1])
    code, _, complaints = torchcover(*arguments(worlds))
    assert code == 128 + number
    assert complaints.count("torchcover:") == 1
    counts, complete, maps = steps_of(worlds / "out")
    assert (counts, complete, maps > 0) == ([2, 2], False, True)


def in_a_fork(worlds, log):
    """Run the command in another process, which writes to a file; returns its exit code and what it said."""

    def act():
        stream = os.open(log, os.O_WRONLY | os.O_CREAT)
        os.dup2(stream, 1)
        os.dup2(stream, 2)
        run(worlds)

    _, code = operations_of(act)
    return code, log.read_text()


def run(worlds):
    torch.set_num_threads(1)  # the others do not survive a fork
    sys.argv = ["torchcover", *map(str, arguments(worlds))]
    sys.stdout, sys.stderr = (os.fdopen(stream, "w", closefd=False) for stream in (1, 2))
    try:
        app.main()
    except SystemExit as end:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(end.code)


def test_second_ctrl_c_stops_and_lists_kept_files(worlds, at_update, monkeypatch):
    at_update(3, lambda: send(signal.SIGINT))
    monkeypatch.setattr(DRAW, lambda *_, **__: (send(signal.SIGINT), time.sleep(60)))
    code, said = in_a_fork(worlds, worlds / "log")
    out = worlds / "out"
    kept = ", ".join(str(out / name) for name in ("checkpoint.npz", "coverage", "summary.csv", "summary.json"))
    assert code == 130
    assert said.splitlines()[-1] == f"torchcover: stopped immediately: kept {kept}"
    assert steps_of(out) == ([2, 2], False, 0)


def test_second_ctrl_c_stops_within_a_frame(worlds, at_update):
    at_update(1, lambda: (send(signal.SIGINT, times=2), time.sleep(60)))
    code, said = in_a_fork(worlds, worlds / "log")
    assert (code, said.splitlines()[-1]) == (130, "torchcover: stopped immediately: no file of this run is kept")
    assert not (worlds / "out" / "summary.json").exists()


def test_closed_terminal_loses_no_result(worlds, at_update):
    (ready, here), (there, go) = os.pipe(), os.pipe()

    def wait():
        os.write(here, b".")
        os.read(there, 1)  # until the signal comes

    at_update(3, wait)
    pid, terminal = pty.fork()
    if not pid:
        try:
            run(worlds)
        finally:
            os._exit(1)
    os.close(here)  # so that nobody waits for a run that has ended
    assert os.read(ready, 1) == b"."
    os.close(terminal)
    time.sleep(0.1)
    os.write(go, b".")
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 129
    for end in (ready, there, go):
        os.close(end)
    counts, complete, maps = steps_of(worlds / "out")
    assert (counts, complete, maps > 0) == ([2, 2], False, True)
