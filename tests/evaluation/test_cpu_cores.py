"""CPU cores: waiting threads do not keep them busy, and the number of workers is limited."""

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

VARIABLES = (*module.WAIT_VARIABLES, "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")


@pytest.fixture
def clean_environment(monkeypatch):
    for name in VARIABLES:
        monkeypatch.setenv(name, "")  # restored after the test
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


@pytest.mark.parametrize(
    "environment", [{}, {"OMP_NUM_THREADS": "7"}, *({name: "active"} for name in module.WAIT_VARIABLES)]
)
def test_set_threads_keeps_existing_variables(clean_environment, environment):
    for name, value in environment.items():
        clean_environment.setenv(name, value)
    set_threads()
    assert {name: os.environ[name] for name in environment} == environment
    assert ("OMP_WAIT_POLICY" in os.environ) == (
        "GOMP_SPINCOUNT" not in environment and "KMP_BLOCKTIME" not in environment
    )
    assert os.environ["OPENBLAS_NUM_THREADS"] == "1"
    assert os.environ["OMP_NUM_THREADS"] == environment.get("OMP_NUM_THREADS", str(count_cores()))


def test_threads_are_set_before_torch_is_imported():
    code = (
        "import os, sys; from torchcover.cli import app; sys.argv = ['torchcover', '--version']\n"
        "try: app.main()\nexcept SystemExit: pass\n"
        "assert not {'torch', 'numpy'} & sys.modules.keys(); print(os.environ['OMP_WAIT_POLICY'])"
    )
    environment = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "passive"


def test_spinning_threads_warn_once(clean_environment):
    with pytest.warns(UserWarning, match="OMP_WAIT_POLICY") as warned:
        warn_about_spinning(2)
    assert warned[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_about_spinning(2)


def test_warning_points_to_the_line_of_the_user(clean_environment, monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    with pytest.warns(UserWarning, match="OMP_WAIT_POLICY") as warned:
        evaluate("front_roof_128", "courtyard", num_frames=1, num_rays=64)
    assert [warning.filename for warning in warned] == [__file__]


@pytest.mark.parametrize("variable", [None, *module.WAIT_VARIABLES])
def test_passive_threads_do_not_warn(clean_environment, variable):
    if variable:
        clean_environment.setenv(variable, "0")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_about_spinning(2 if variable else 1)


@pytest.mark.parametrize(
    ("num_cores", "num_frames", "num_scenes", "expected"),
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
def test_num_workers_follows_cores_scenes_and_frames(monkeypatch, num_cores, num_frames, num_scenes, expected):
    monkeypatch.setattr(module, "count_cores", lambda: num_cores)
    monkeypatch.setattr(multiprocessing, "get_start_method", lambda allow_none: "fork")
    monkeypatch.setattr(module, "find_memory_limit_bytes", lambda: 1e12)
    assert compute_num_workers(num_frames, num_scenes, sends_frames=False) == expected
    monkeypatch.setattr(multiprocessing, "get_start_method", lambda allow_none: "spawn")
    assert compute_num_workers(num_frames, num_scenes, sends_frames=False) == 0


def test_num_workers_follows_memory_and_shared_memory(monkeypatch, tmp_path):
    monkeypatch.setattr(module, "count_cores", lambda: 16)
    monkeypatch.setattr(module, "SHARED_MEMORY", str(tmp_path))
    monkeypatch.setattr(multiprocessing, "get_start_method", lambda allow_none: "fork")
    for memory_bytes, shared_bytes, sends_frames, expected in (
        (1e12, 64e6, True, 0),
        (1e12, 64e6, False, 8),
        (1e12, 512e6, True, 2),
        (1e12, 1e12, True, 8),
        (2e9, 1e12, True, 3),
        (1e9, 1e12, False, 0),
    ):
        monkeypatch.setattr(module, "find_memory_limit_bytes", lambda memory_bytes=memory_bytes: memory_bytes)
        monkeypatch.setattr(
            os, "statvfs", lambda _, size=shared_bytes: os.statvfs_result([1] * 4 + [int(size)] + [1] * 5)
        )
        assert compute_num_workers(64, 64, sends_frames=sends_frames) == expected


def test_only_simulations_have_default_workers(monkeypatch):
    class ReportedError(Exception):
        """Error with the number of workers of a run."""

    def observe(*_, num_workers, **__):
        raise ReportedError(num_workers)

    def compute(num_frames, num_scenes, *, sends_frames):
        calls.append((num_frames, num_scenes, sends_frames))
        return 2

    calls = []
    monkeypatch.setattr(measurement, "observe", observe)
    monkeypatch.setattr(measurement, "compute_num_workers", compute)
    frames = SimulatedFrames("urban", "front_roof_32", num_frames=64)
    for settings, expected in (
        ({"scenario": "urban", "num_frames": 64}, 2),
        ({"scenario": "urban", "num_frames": 9999, "metrics": "k_cover"}, 2),
        ({"scenario": "urban", "num_frames": 64, "num_workers": 0}, 0),
        ({"frames": frames}, 0),
    ):
        with pytest.raises(ReportedError) as raised:
            evaluate("front_roof_32", **settings)
        assert raised.value.args == (expected,)
    assert calls == [(64, 11, False), (measurement.MeasurementParams().max_inspected_frames, 43, True)]
