"""Isolated readers: the run continues and the file is named, whatever a library does."""

import json
import os
import sys
import threading
from multiprocessing import get_context
from subprocess import run

import numpy as np
import pytest

from tests.files import isolated_readers
from torchcover.files import BadFileError, guard_reader, isolated
from torchcover.simulation.mesh_files import read_mesh_arrays


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "file.x"
    path.write_text("content")
    return path


def test_what_is_read_comes_as_it_was(path):
    read = isolated_readers.good(path, 2.5)
    assert np.array_equal(read["numbers"], 2.5 * np.arange(6.0).reshape(2, 3))
    assert read["words"].tolist() == ["a", "file.x"]
    assert (read["none"].shape, read["none"].dtype, read["one"].item()) == ((0, 3), np.float32, 7)
    read["numbers"][0] = 1.0  # the variable belongs to the parent


def test_output_of_libraries_does_not_disturb_answers(path):
    (first, torch), (second, _) = (isolated_readers.loud(path)["process"] for _ in range(2))
    assert first == second != os.getpid()
    assert not torch


@pytest.mark.parametrize(("kind", "error", "words"), [
    ("value", ValueError, "^said$"), ("key", ValueError, "^KeyError: 'said'$"), ("import", ImportError, "^said$"),
    ("module", ImportError, r"file\.x: no_such_package is needed to read it: pip install no_such_package"),
])  # fmt: skip
def test_errors_are_raised_here(path, kind, error, words):
    with pytest.raises(error, match=words):
        isolated_readers.wrong(path, kind)


def test_crashes_are_bad_files_and_reading_continues(path):
    door = guard_reader("a thing")(isolated_readers.crashing)
    for _ in range(2):
        with pytest.raises(BadFileError, match=r"file\.x: the library that reads it crashed; the file is damaged"):
            door(path)
    assert isolated_readers.good(path, 1.0)


def test_a_library_that_never_ends_is_ended(path, monkeypatch):
    monkeypatch.setattr(isolated, "BASE_TIMEOUT_S", 0.3)
    with pytest.raises(ValueError, match="it took more than 0 s"):
        isolated_readers.hanging(path)
    monkeypatch.undo()
    assert isolated_readers.good(path, 1.0)


def test_memory_is_what_files_may_take(path, monkeypatch):
    assert isolated_readers.greedy(path, 0.01)["bytes"][0] == 1
    with pytest.raises(MemoryError):
        isolated_readers.greedy(path, 40.0)
    with pytest.raises(ValueError, match="OSError"):
        isolated_readers.writing(path)
    assert path.with_suffix(".new").stat().st_size == 0


def test_memory_kept_by_libraries_does_not_accumulate(path):
    (first, process), (second, other) = (isolated_readers.keeping(path, 1.1)["kept"] for _ in range(2))
    assert (first, second) == (1, 1)
    assert process == other  # a new process
    isolated_readers.keeping(path, 0.0)
    assert isolated_readers.keeping(path, 0.0)["kept"][0] == 2


def test_threads_and_forks_read_too(path):
    result = []
    threads = [
        threading.Thread(target=lambda: result.append(isolated_readers.good(path, 3.0)["one"])) for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(result) == 4
    here = isolated_readers.loud(path)["process"][0]
    queue = get_context("fork").SimpleQueue()
    worker = get_context("fork").Process(
        target=lambda: queue.put(int(isolated_readers.loud(path)["process"][0])), daemon=True
    )
    worker.start()
    assert queue.get() != here
    worker.join()
    assert isolated_readers.loud(path)["process"][0] == here


def test_parts_of_meshes_are_checked_as_meshes(tmp_path):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4")
    (tmp_path / "good.bin").write_bytes(corners.tobytes())
    os.mkfifo(tmp_path / "pipe.bin")
    (tmp_path.parent / "outside.bin").write_bytes(corners.tobytes())
    path = tmp_path / "mesh.gltf"
    for name, words in (
        ("good.bin", None),
        ("pipe.bin", "a pipe, a socket"),
        ("../outside.bin", "outside of its folder"),
    ):
        content = {
            "asset": {"version": "2.0"},
            "buffers": [{"uri": name, "byteLength": 36}],
            "bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": 36}],
            "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "nodes": [{"mesh": 0}],
            "scenes": [{"nodes": [0]}],
            "scene": 0,
        }
        path.write_text(json.dumps(content))
        if words is None:
            assert read_mesh_arrays(path)["vertices"].shape == (3, 3)
        else:
            with pytest.raises(ValueError, match=words):
                read_mesh_arrays(path)


@pytest.mark.parametrize("module", ["cameras.isolated_images", "recordings.isolated_readers", "simulation.mesh_files"])
def test_isolated_readers_do_not_load_torch(module):
    run([sys.executable, "-c", f"import sys, torchcover.{module}; sys.exit('torch' in sys.modules)"], check=True)
