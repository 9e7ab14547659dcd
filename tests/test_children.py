"""No process outlives the one that has started it, though that is killed."""

import math
import os
import select
import signal
import subprocess
import sys
import time

import pytest
import torch

from torchcover.data import Frame
from torchcover.evaluation import observe
from torchcover.files import end_with_parent
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
    done = subprocess.run(["sleep", "9"], check=False, preexec_fn=lambda: begin(os.getpid(), math.inf, math.inf))
    assert done.returncode == -signal.SIGKILL


def test_what_makes_frames_ends_though_it_is_in_the_middle_of_one(alive):
    class Drive:
        world_of = int

        def __len__(self):
            return 4

        def __getitem__(self, index):
            alive.hold()
            return Frame({"a": torch.zeros(1, 3)}, torch.zeros(1, 3), index, "f")

    is_killed(lambda: observe(Drive(), [], workers=2), alive, children=2)
    assert alive.has_ended(within_s=LIVES_S / 3)


def test_what_makes_traffic_ends(alive, tmp_path, monkeypatch):
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "sumo").write_text(f"#!/bin/sh\n{script(alive, LIVES_S)}\n")
    (tmp_path / "bin" / "sumo").chmod(0o755)
    monkeypatch.setattr(simulating, "home", lambda: tmp_path)
    is_killed(lambda: simulating.run("sumo"), alive)
    assert alive.has_ended(within_s=LIVES_S / 3)
