"""Signals that end a command: Ctrl-C, SIGTERM of a scheduler, SIGHUP of a lost connection."""

import json
import os
import pty
import signal
import sys
import time

import pytest
import torch

from tests.killing import run_in_fork
from torchcover import Coverage
from torchcover.cli import app
from torchcover.coverage import CoverageSums
from torchcover.evaluation import progress
from torchcover.report.maps import plot_side_by_side

DRAW = "torchcover.report.maps.plot_side_by_side"


def arguments(scenes, *, num_frames=3):
    """Build the arguments of a comparison of two rigs."""
    rigs = [scenes / "low.yaml", scenes / "both.yaml"]
    settings = [
        "--scenario",
        scenes / "yard.yaml",
        "--set",
        "cell_m=4",
        "--thresholds-m",
        2,
        "--num-rays",
        4096,
        "--num-frames",
        num_frames,
    ]
    return ["compare", *rigs, *settings, "--out", scenes / "out"]


@pytest.fixture
def handler():
    """Set the action of a signal and restore it afterwards."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    yield signal.signal
    for number, action in before.items():
        signal.signal(number, action)


@pytest.fixture
def at_update(monkeypatch):
    """Call a function before the nth update of a rig; update 3 is the first rig in the second frame."""

    def call_at(number, act):
        add, calls = CoverageSums.add_sums, []

        def add_sums(self, sums):
            calls.append(self)
            if len(calls) == number:
                act()
            add(self, sums)

        monkeypatch.setattr(CoverageSums, "add_sums", add_sums)

    return call_at


def send(number, times=1):
    for _ in range(times):
        os.kill(os.getpid(), number)


def read_progress(out):
    """Return the frames of each rig, the completeness of the run, and the number of maps."""
    summary = json.loads((out / "summary.json").read_text())
    counts = [Coverage.load(out / "coverage" / f"{name}.npz").counts["num_frames"] for name in ("low", "both")]
    assert counts == [item["num_frames"] for item in summary["counts"].values()]
    return counts, summary["complete"], sum(name.startswith("maps/") for name in summary["files"])


@pytest.mark.parametrize(
    ("number", "action", "expected", "num_frames", "messages"),
    [
        (signal.SIGINT, signal.default_int_handler, 130, 2, ["torchcover: interrupted"]),
        (signal.SIGINT, signal.SIG_IGN, 0, 3, []),
        (signal.SIGTERM, signal.SIG_DFL, 143, 2, ["torchcover: terminated"]),
        (signal.SIGHUP, signal.SIG_DFL, 129, 2, ["torchcover: hung up"]),
        (signal.SIGHUP, signal.SIG_IGN, 0, 3, []),
    ],
)
def test_signal_between_two_rigs_leaves_a_paired_result(
    torchcover, scenes, at_update, handler, number, action, expected, num_frames, messages
):
    handler(number, action)
    at_update(3, lambda: send(number))
    code, _, stderr = torchcover(*arguments(scenes))
    assert code == expected
    assert [line for line in stderr.splitlines() if line.startswith("torchcover:")] == messages
    assert read_progress(scenes / "out")[:2] == ([num_frames, num_frames], expected == 0)
    assert signal.getsignal(number) is action


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_repeated_signal_has_no_effect(torchcover, scenes, at_update, monkeypatch, number):
    """The system and the shell send a signal to the process and to its group."""
    monkeypatch.setattr(progress._TerminationHandler, "repeat_interval_s", 600.0)  # for slow machines
    at_update(3, lambda: send(number, times=2))
    monkeypatch.setattr(DRAW, lambda *args, **kwargs: (send(number), plot_side_by_side(*args, **kwargs))[1])
    code, _, stderr = torchcover(*arguments(scenes))
    assert code == 128 + number
    assert stderr.count("torchcover:") == 1
    counts, complete, maps = read_progress(scenes / "out")
    assert (counts, complete, maps > 0) == ([2, 2], False, True)


def in_a_fork(scenes, log):
    """Run the command in a forked process; returns its exit code and output."""

    def act():
        stream = os.open(log, os.O_WRONLY | os.O_CREAT)
        os.dup2(stream, 1)
        os.dup2(stream, 2)
        run(scenes)

    _, code = run_in_fork(act)
    return code, log.read_text()


def run(scenes):
    torch.set_num_threads(1)  # other threads do not survive a fork
    sys.argv = ["torchcover", *map(str, arguments(scenes))]
    sys.stdout, sys.stderr = (os.fdopen(stream, "w", closefd=False) for stream in (1, 2))
    try:
        app.main()
    except SystemExit as end:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(end.code)


def test_second_ctrl_c_stops_and_lists_kept_files(scenes, at_update, monkeypatch):
    at_update(3, lambda: send(signal.SIGINT))
    monkeypatch.setattr(DRAW, lambda *_, **__: (send(signal.SIGINT), time.sleep(60)))
    code, output = in_a_fork(scenes, scenes / "log")
    out = scenes / "out"
    kept = ", ".join(str(out / name) for name in ("checkpoint.npz", "coverage", "summary.csv", "summary.json"))
    assert code == 130
    assert output.splitlines()[-1] == f"torchcover: stopped immediately: kept {kept}"
    assert read_progress(out) == ([2, 2], False, 0)


def test_second_ctrl_c_stops_within_a_frame(scenes, at_update):
    at_update(1, lambda: (send(signal.SIGINT, times=2), time.sleep(60)))
    code, output = in_a_fork(scenes, scenes / "log")
    assert (code, output.splitlines()[-1]) == (130, "torchcover: stopped immediately: no file of this run is kept")
    assert not (scenes / "out" / "summary.json").exists()


def test_closed_terminal_loses_no_result(scenes, at_update):
    (ready, here), (there, go) = os.pipe(), os.pipe()

    def wait():
        os.write(here, b".")
        os.read(there, 1)  # until the signal arrives

    at_update(3, wait)
    pid, terminal = pty.fork()
    if not pid:
        try:
            run(scenes)
        finally:
            os._exit(1)
    os.close(here)  # otherwise a run that has ended would block the read
    assert os.read(ready, 1) == b"."
    os.close(terminal)
    time.sleep(0.1)
    os.write(go, b".")
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 129
    for end in (ready, there, go):
        os.close(end)
    counts, complete, maps = read_progress(scenes / "out")
    assert (counts, complete, maps > 0) == ([2, 2], False, True)
