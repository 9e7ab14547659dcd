"""Threads that wait leave their cores to others, and a run has as many processes as help."""

import multiprocessing
import os
import subprocess
import sys
import warnings

import pytest
import torch

from torchcover.data import SimulatedFrames
from torchcover.evaluation import cpu_cores as module
from torchcover.evaluation import evaluate, measurement
from torchcover.evaluation.cpu_cores import compute_num_workers, count_cores, set_threads, warn_about_spinning

SAID = (*module.WAIT_VARIABLES, "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")


@pytest.fixture
def nothing_said(monkeypatch):
    for name in SAID:
        monkeypatch.setenv(name, "")  # what was there comes back
        monkeypatch.delenv(name)
    module._warn_about_spinning_once.cache_clear()
    yield monkeypatch
    module._warn_about_spinning_once.cache_clear()


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({}, 8),
        ({"max": "max 100000"}, 8),
        ({"max": "250000 100000"}, 2),
        ({"max": "50000 100000"}, 1),
        ({"max": "9900000 100000"}, 8),
        ({"quota": "-1", "period": "100000"}, 8),
        ({"quota": "300000\n", "period": "100000\n"}, 3),
        ({"quota": "300000"}, 8),
        ({"max": "nonsense"}, 8),
        ({"max": ""}, 8),
    ],
)
def test_container_limit_reduces_the_cores(tmp_path, monkeypatch, files, expected):
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(module, "CPU_QUOTAS", ((tmp_path / "max",), (tmp_path / "quota", tmp_path / "period")))
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    assert count_cores() == expected


@pytest.mark.parametrize("said", [{}, {"OMP_NUM_THREADS": "7"}, *({name: "active"} for name in module.WAIT_VARIABLES)])
def test_set_threads_keeps_existing_variables(nothing_said, said):
    for name, value in said.items():
        nothing_said.setenv(name, value)
    set_threads()
    assert {name: os.environ[name] for name in said} == said
    assert ("OMP_WAIT_POLICY" in os.environ) == ("GOMP_SPINCOUNT" not in said and "KMP_BLOCKTIME" not in said)
    assert os.environ["OPENBLAS_NUM_THREADS"] == "1"
    assert os.environ["OMP_NUM_THREADS"] == said.get("OMP_NUM_THREADS", str(count_cores()))


def test_threads_are_set_before_torch_is_imported():
    code = (
        "import os, sys; from torchcover.cli import app; sys.argv = ['torchcover', '--version']\n"
        "try: app.main()\nexcept SystemExit: pass\n"
        "assert not {'torch', 'numpy'} & sys.modules.keys(); print(os.environ['OMP_WAIT_POLICY'])"
    )
    environment = {name: value for name, value in os.environ.items() if name not in SAID}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "passive"


def test_spinning_threads_warn_once(nothing_said):
    with pytest.warns(UserWarning, match="OMP_WAIT_POLICY") as said:
        warn_about_spinning(2)
    assert said[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_about_spinning(2)


def test_warning_points_to_the_line_of_the_user(nothing_said, monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    with pytest.warns(UserWarning, match="OMP_WAIT_POLICY") as said:
        evaluate("front_roof_128", "courtyard", num_frames=1, num_rays=64)
    assert [one.filename for one in said] == [__file__]


@pytest.mark.parametrize("said", [None, *module.WAIT_VARIABLES])
def test_passive_threads_do_not_warn(nothing_said, said):
    if said:
        nothing_said.setenv(said, "0")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_about_spinning(2 if said else 1)


@pytest.mark.parametrize(
    ("count", "frames", "worlds", "expected"),
    [
        (1, 64, 11, 0),
        (2, 64, 11, 2),
        (16, 64, 11, 8),
        (16, 24, 4, 3),
        (16, 64, 2, 2),
        (16, 64, 1, 0),
        (16, 8, 8, 0),
    ],
)
def test_num_workers_follows_cores_scenes_and_frames(monkeypatch, count, frames, worlds, expected):
    monkeypatch.setattr(module, "count_cores", lambda: count)
    monkeypatch.setattr(multiprocessing, "get_start_method", lambda allow_none: "fork")
    monkeypatch.setattr(module, "find_memory_limit_bytes", lambda: 1e12)
    assert compute_num_workers(frames, worlds, sends_frames=False) == expected
    monkeypatch.setattr(multiprocessing, "get_start_method", lambda allow_none: "spawn")
    assert compute_num_workers(frames, worlds, sends_frames=False) == 0


def test_num_workers_follows_memory_and_shared_memory(monkeypatch, tmp_path):
    monkeypatch.setattr(module, "count_cores", lambda: 16)
    monkeypatch.setattr(module, "SHARED_MEMORY", str(tmp_path))
    monkeypatch.setattr(multiprocessing, "get_start_method", lambda allow_none: "fork")
    for memory, room, whole, expected in (
        (1e12, 64e6, True, 0),
        (1e12, 64e6, False, 8),
        (1e12, 512e6, True, 2),
        (1e12, 1e12, True, 8),
        (2e9, 1e12, True, 3),
        (1e9, 1e12, False, 0),
    ):
        monkeypatch.setattr(module, "find_memory_limit_bytes", lambda memory=memory: memory)
        monkeypatch.setattr(os, "statvfs", lambda _, room=room: os.statvfs_result([1] * 4 + [int(room)] + [1] * 5))
        assert compute_num_workers(64, 64, sends_frames=whole) == expected


def test_only_simulations_have_default_workers(monkeypatch):
    class KnownError(Exception):
        """The number of workers."""

    def observe(*_, num_workers, **__):
        raise KnownError(num_workers)

    def usual(frames, worlds, *, sends_frames):
        asked.append((frames, worlds, sends_frames))
        return 2

    asked = []
    monkeypatch.setattr(measurement, "observe", observe)
    monkeypatch.setattr(measurement, "compute_num_workers", usual)
    frames = SimulatedFrames("urban", "front_roof_32", num_frames=64)
    for given, expected in (
        ({"scenario": "urban", "num_frames": 64}, 2),
        ({"scenario": "urban", "num_frames": 9999, "metrics": "k_cover"}, 2),
        ({"scenario": "urban", "num_frames": 64, "num_workers": 0}, 0),
        ({"frames": frames}, 0),
    ):
        with pytest.raises(KnownError) as found:
            evaluate("front_roof_32", **given)
        assert found.value.args == (expected,)
    assert asked == [(64, 11, False), (measurement.MeasurementParams().max_inspected_frames, 43, True)]
