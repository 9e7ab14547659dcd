"""No process outlives the one that has started it, though that is killed; one that is stopped is reported."""

import gc
import math
import os
import re
import select
import signal
import subprocess
import sys
import time
from functools import partial
from multiprocessing import active_children

import pytest
import torch
from torch.distributed import HashStore

from tests.files import isolated_readers
from torchcover.data import Frame
from torchcover.evaluation import observe
from torchcover.evaluation.heartbeat import Heartbeat, HeartbeatParams, report_silent_ranks
from torchcover.files import end_with_parent, isolated, processes, report_stopped_processes
from torchcover.simulation.sumo import simulating

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs Linux, which ends processes with their parent")
# Of a child that is left alone.
LIVES_S = 30


class Alive:
    """A pipe with a name that children hold open."""

    def __init__(self, path):
        os.mkfifo(path)
        self.path = path
        self.reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        self.poll = select.poll()
        self.poll.register(self.reader)

    def hold(self):
        """Say that this process is there, and stay."""
        os.write(os.open(self.path, os.O_WRONLY), b".")
        time.sleep(LIVES_S)

    def wait_for(self, count, parent):
        """Until so many children are there."""
        there = b""
        while len(there) < count:
            assert os.waitpid(parent, os.WNOHANG) == (0, 0), "it has ended before its children were there"
            if any(event & select.POLLIN for _, event in self.poll.poll(100)):
                there += os.read(self.reader, count)

    def has_ended(self, within_s):
        """Whether all of them end."""
        end_s = time.monotonic() + within_s
        while time.monotonic() < end_s:
            if any(event == select.POLLHUP for _, event in self.poll.poll(100)):
                return True
        return False


@pytest.fixture
def alive(tmp_path):
    alive = Alive(tmp_path / "alive")
    yield alive
    os.close(alive.reader)


def is_killed(act, alive, children=1):
    """Do something in a fork, and kill it once its children are there."""
    parent = os.fork()
    if not parent:
        try:
            torch.set_num_threads(1)
            act()
        finally:
            os._exit(1)
    alive.wait_for(children, parent)
    os.kill(parent, signal.SIGKILL)
    assert os.waitpid(parent, 0)[1] == signal.SIGKILL


def script(alive, lives_s):
    return f"exec 3> {alive.path}; printf . >&3; exec sleep {lives_s}"


def test_a_program_ends(alive):
    def act():
        subprocess.run(["sh", "-c", script(alive, LIVES_S)], check=True, preexec_fn=end_with_parent())

    is_killed(act, alive)
    assert alive.has_ended(within_s=LIVES_S / 3)


def test_it_would_not_end_by_itself(alive):
    is_killed(lambda: subprocess.run(["sh", "-c", script(alive, 3)], check=True), alive)
    assert not alive.has_ended(within_s=0.3)
    assert alive.has_ended(within_s=LIVES_S)


def test_it_ends_though_its_parent_had_ended_before():
    begin = end_with_parent().func  # without the number of this process
    done = subprocess.run(["sleep", "9"], check=False, preexec_fn=lambda: begin(os.getpid(), math.inf, math.inf, True))
    assert done.returncode == -signal.SIGKILL


def test_workers_end_within_a_frame(alive):
    class Drive:
        get_scene_id = int

        def __len__(self):
            return 4

        def __getitem__(self, index):
            alive.hold()
            return Frame({"a": torch.zeros(1, 3)}, torch.zeros(1, 3), index, "f")

    is_killed(lambda: observe(Drive(), [], num_workers=2), alive, children=2)
    assert alive.has_ended(within_s=LIVES_S / 3)


def test_what_makes_traffic_ends(alive, tmp_path, monkeypatch):
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "sumo").write_text(f"#!/bin/sh\n{script(alive, LIVES_S)}\n")
    (tmp_path / "bin" / "sumo").chmod(0o755)
    monkeypatch.setattr(simulating, "find_sumo_home", lambda: tmp_path)
    is_killed(lambda: simulating.run_program("sumo"), alive)
    assert alive.has_ended(within_s=LIVES_S / 3)


@pytest.fixture
def stopped(monkeypatch):
    """Look often for stopped processes; returns a list of the warnings, each of which lets its process go on."""
    reported = []

    def warn(message, *_, **__):
        reported.append(message)
        os.kill(int(re.search(r"kill -CONT (\d+)", message)[1]), signal.SIGCONT)

    monkeypatch.setattr("torchcover.files.processes.warnings.warn", warn)
    for place in ("evaluation.frame_workers", "files.isolated", "simulation.sumo.simulating"):
        monkeypatch.setattr(
            f"torchcover.{place}.report_stopped_processes", partial(report_stopped_processes, poll_interval_s=0.1)
        )
    return reported


class StoppingDrive:
    """Four frames, the second of which stops the worker that makes it."""

    get_scene_id = int

    def __len__(self):
        return 4

    def __getitem__(self, index):
        if index == 1:
            os.kill(os.getpid(), signal.SIGSTOP)
        return Frame({"a": torch.zeros(1, 3)}, torch.zeros(1, 3), index, "f")


def test_stopped_worker_is_reported_and_resumed(stopped):
    assert observe(StoppingDrive(), [], num_workers=2).num_frames == 4
    assert [message.split(" (process ")[0] for message in stopped] == ["a worker"]


def test_run_with_stopped_worker_can_be_interrupted(stopped, monkeypatch):
    end = lambda message, *_, **__: (stopped.append(message), os.kill(os.getpid(), signal.SIGINT))  # noqa: E731
    monkeypatch.setattr("torchcover.files.processes.warnings.warn", end)
    with pytest.raises(KeyboardInterrupt):
        observe(StoppingDrive(), [], num_workers=2)
    gc.collect()
    assert len(stopped) == 1
    assert active_children() == []


def test_a_stopped_sumo_is_reported(stopped, tmp_path, monkeypatch):
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "sumo").write_text("#!/bin/sh\nkill -STOP $$\necho more\n")
    (tmp_path / "bin" / "sumo").chmod(0o755)
    monkeypatch.setattr(simulating, "find_sumo_home", lambda: tmp_path)
    assert list(simulating.stream_output("sumo")) == [b"more\n"]
    assert [message.split(" (process ")[0] for message in stopped] == ["SUMO's sumo"]


def test_program_stopped_before_it_runs_is_reported(stopped, tmp_path, monkeypatch):
    monkeypatch.setattr(processes, "report_stopped_processes", partial(report_stopped_processes, poll_interval_s=0.1))
    stop = lambda *_: os.kill(os.getpid(), signal.SIGSTOP)  # noqa: E731
    monkeypatch.setattr(isolated, "end_with_parent", lambda: stop)
    isolated._ReaderProcess().kill()
    assert [message.split(" (process ")[0] for message in stopped] == ["the process that reads files"]


def test_stopped_reader_is_reported_and_times_out(stopped, tmp_path, monkeypatch):
    (tmp_path / "file.x").write_text("content")
    assert isolated_readers.stopping(tmp_path / "file.x")["one"] == 1
    assert [message.split(" (process ")[0] for message in stopped] == ["the process that reads files"]
    monkeypatch.setattr("torchcover.files.processes.warnings.warn", lambda *_, **__: None)
    monkeypatch.setattr(isolated, "BASE_TIMEOUT_S", 0.5)
    with pytest.raises(ValueError, match="the process that reads it was stopped"):
        isolated_readers.stopping(tmp_path / "file.x")


@pytest.mark.parametrize("pause_s", [0.0, 1.0])
def test_silent_rank_is_reported_once(monkeypatch, pause_s):
    reported, params, store = [], HeartbeatParams(interval_s=0.05, timeout_s=0.5), HashStore()
    monkeypatch.setattr("torchcover.evaluation.heartbeat.warnings.warn", lambda words, *_, **__: reported.append(words))
    silent = Heartbeat(store, 1, 3, params)  # sends nothing
    with report_silent_ranks(store, 0, 3, params), report_silent_ranks(store, 2, 3, params):
        time.sleep(0.2 + pause_s)
    assert sorted(words[:6] for words in reported) == ["rank 1"] * (2 if pause_s else 0)
    assert silent.find_silent(time.monotonic() + 9.0) == [0]  # the store, which rank 0 keeps, has not answered
    assert store.get("alive 0") == b"left"
