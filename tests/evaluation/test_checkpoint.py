"""Checkpoints: an interrupted run continues to a result that is equal to the last bit."""

import errno
import json
import os
import random
import signal
import time
import zipfile
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchcover
from torchcover.coverage import FrameQuantiles, Maximum
from torchcover.data import BadFrameError, FrameDataset, FrameMetadata
from torchcover.evaluation import Checkpoint, checkpoint
from torchcover.evaluation.checkpoint import read_header, read_state, write_checkpoint
from torchcover.evaluation.config import DESCRIPTIONS
from torchcover.evaluation.task import NOT_IN_IDENTITY
from torchcover.files import BadFileError

NUM_FRAMES = 16
SETTINGS = {"cell_m": 8.0, "aggregations": (Maximum(), FrameQuantiles((0.5,)))}


class SyntheticFrames(FrameDataset):
    """Source of frames, some of which may be bad; a delay allows a test to kill it during a frame."""

    metadata = FrameMetadata(("a",), {"scenario": None, "frames": "drive", "seed": None})

    def __init__(self, frame_of, bad=(), content="drive", delay_s=0.0):
        self.frame_of, self.bad, self.content, self.delay_s = frame_of, bad, content, delay_s

    def collect_content(self):
        return {"frames": self.content}

    def __len__(self):
        return NUM_FRAMES

    def __getitem__(self, index):
        time.sleep(self.delay_s)
        if index in self.bad:
            raise BadFrameError(f"f{index} (frame {index}): rubbish")
        return self.frame_of(index)


class RecordingObserver:
    """Observer with the names of its frames; it may call a function at a frame."""

    def __init__(self, call_index=None, call=lambda: None):
        self.names, self.call_index, self.call = [], call_index, call

    def update(self, frame):
        self.names.append(frame.name)
        if frame.index == self.call_index:
            self.call()

    def compute(self):
        return tuple(self.names)

    def merge_state(self, other):
        self.names += other.names

    def state_dict(self):
        return {"names": self.names}

    def load_state_dict(self, state):
        self.names = list(state["names"])


@pytest.fixture
def path(tmp_path):
    return tmp_path / "out" / "checkpoint.npz"


@pytest.fixture
def _write_every_frame(monkeypatch):
    monkeypatch.setattr(checkpoint.CheckpointManager, "params", checkpoint.CheckpointParams(0.0, 1e9))


def evaluate(source, path=None, *, recorder=None, **settings):
    settings = {
        "frames": source,
        "observers": {"recorder": recorder or RecordingObserver()},
        "checkpoint": path,
        **SETTINGS,
        **settings,
    }
    return torchcover.evaluate("a", **settings)


def evaluate_interrupted(*args, **settings):
    """Run an evaluation that an observer interrupts."""
    with pytest.warns(RuntimeWarning, match="The run was cut short after"):
        return evaluate(*args, **settings)


def collect_bits(result):
    """Collect all results, tensors as bytes."""
    results = {
        "observed": result.observer_results,
        "num_frames": result.run.num_frames,
        "counts": dict(result.run.counts),
    }
    for name, coverage in result.coverages.items():
        blocks = {"block sums": coverage.block_sums.sums, "block frames": coverage.block_sums.frame_counts}
        layers = {key: layer.values for key, layer in coverage.layers.items()}
        for key, tensor in {
            **blocks,
            **layers,
            "points": coverage.point_counts,
            "probed": coverage.observed_frames,
        }.items():
            results[f"{name} {key}"] = tensor.numpy().tobytes()
    return {**results, "skipped_frames": tuple(result.run.skipped_frames)}


def identify_file(path):
    """Identify a file by its inode and time, which differ for every replacement."""
    return (path.stat().st_ino, path.stat().st_mtime_ns) if path.exists() else None


def press_ctrl_c():
    os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize("workers", [0, 2])
def test_run_resumes_after_ctrl_c_bit_for_bit(frame_of, path, workers):
    whole = collect_bits(evaluate(SyntheticFrames(frame_of, {7}), skip_bad_frames=True))
    for index in (0, 9, NUM_FRAMES - 1):  # the run continues twice
        part = evaluate_interrupted(
            SyntheticFrames(frame_of, {7}),
            path,
            recorder=RecordingObserver(index, press_ctrl_c),
            skip_bad_frames=True,
            num_workers=workers,
        )
        assert isinstance(part.run.failure, KeyboardInterrupt)
        assert len(part.observer_results["recorder"]) == part.run.num_frames == index + 1 - (index > 7)
    assert collect_bits(evaluate(SyntheticFrames(frame_of, {7}), path, skip_bad_frames=True)) == whole


@pytest.mark.usefixtures("_write_every_frame")
def test_run_resumes_after_kills_bit_for_bit(frame_of, path):
    whole, rng, kills = collect_bits(evaluate(SyntheticFrames(frame_of))), random.Random(0), 0
    for _ in range(5):
        before = identify_file(path)
        child = os.fork()
        if not child:
            torch.set_num_threads(1)
            evaluate(SyntheticFrames(frame_of), path)
            os._exit(0)
        deadline_s = time.monotonic() + 60
        while identify_file(path) == before and time.monotonic() < deadline_s:
            time.sleep(0.001)
        time.sleep(rng.uniform(0.0, 0.02))
        os.kill(child, signal.SIGKILL)
        kills += os.waitpid(child, 0)[1] == signal.SIGKILL
        assert 0 < read_header(path)["run"]["num_frames"] <= NUM_FRAMES
    assert kills >= 2
    assert collect_bits(evaluate(SyntheticFrames(frame_of), path)) == whole
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_complete_run_continues_with_more_frames(frame_of, path):
    evaluate(SyntheticFrames(frame_of), path, num_frames=5)
    recorder = RecordingObserver()
    assert collect_bits(evaluate(SyntheticFrames(frame_of), path, num_frames=12, recorder=recorder)) == collect_bits(
        evaluate(SyntheticFrames(frame_of), num_frames=12)
    )
    assert len(recorder.names) == 12
    again = evaluate(SyntheticFrames(frame_of, range(NUM_FRAMES)), path, num_frames=12)  # no frame is read
    assert collect_bits(again) == collect_bits(evaluate(SyntheticFrames(frame_of), num_frames=12))
    with pytest.raises(ValueError, match="num_frames: 12 are done in the checkpoint; got 11, which is less"):
        evaluate(SyntheticFrames(frame_of), path, num_frames=11)


def test_resumed_run_stops_at_the_same_frame(frame_of, path, monkeypatch):
    monkeypatch.setattr("torchcover.evaluation.target_error.MIN_FRAMES", 8)
    target = {"target_error": "0.2m", "thresholds_m": ()}
    whole = evaluate(SyntheticFrames(frame_of), **target)
    assert 8 < whole.run.num_frames < NUM_FRAMES
    for index in range(6, whole.run.num_frames - 1):
        evaluate_interrupted(SyntheticFrames(frame_of), path, recorder=RecordingObserver(index, press_ctrl_c), **target)
    assert collect_bits(evaluate(SyntheticFrames(frame_of), path, **target)) == collect_bits(whole)
    assert collect_bits(evaluate(SyntheticFrames(frame_of, range(NUM_FRAMES)), path, **target)) == collect_bits(whole)


@pytest.mark.parametrize(("write_s", "pause_s"), [(0.0, 60.0), (2.0, 60.0), (9.0, 180.0)])
def test_writing_takes_at_most_5_percent_of_time(tmp_path, monkeypatch, write_s, pause_s):
    now_s, written_s = 0.0, []

    def write(*_):
        nonlocal now_s
        now_s += write_s
        written_s.append(now_s)

    monkeypatch.setattr(checkpoint, "time", SimpleNamespace(monotonic=lambda: now_s))
    monkeypatch.setattr(checkpoint, "write_checkpoint", write)
    journal = checkpoint.CheckpointManager(Checkpoint(tmp_path / "a.npz"), {}, {})
    run = SimpleNamespace(num_frames=1, counts=Counter(), skipped_frames=[], duration_s=0.0)
    while now_s < 1800.0:
        now_s += 1.0
        journal.write_if_due(run)
    assert np.diff(written_s, prepend=0.0).tolist() == [60.0 + write_s, *[pause_s + write_s] * (len(written_s) - 1)]
    assert len(written_s) >= 9


@pytest.mark.usefixtures("_write_every_frame")
def test_frame_missing_in_one_observer_is_not_saved(frame_of, path):
    with pytest.raises(ZeroDivisionError):
        evaluate_interrupted(
            SyntheticFrames(frame_of), path, recorder=RecordingObserver(6, lambda: 1 / 0)
        ).run.raise_failure()
    assert read_header(path)["run"]["num_frames"] == 6
    assert collect_bits(evaluate(SyntheticFrames(frame_of), path)) == collect_bits(evaluate(SyntheticFrames(frame_of)))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"cell_m": 4.0}, r"cell_m \(8.0 there, 4.0 here\)"),
        ({"thresholds_m": (0.4, 1.0)}, r"thresholds_m \(\[0.4\] there, \[0.4, 1.0\] here\)"),
        ({"aggregations": ()}, r"aggregations \(other content\)"),
        ({"band_frame": "ground"}, r"band_frame \(\"vehicle\" there, \"ground\" here\)"),
        ({"average": "cells"}, r"average \(null there, \"cells\" here\)"),
        ({"target_error": "1%"}, r"target_error \(other content\)"),
        ({"observers": {}}, r"observers \(other content\)"),
    ],
)
def test_error_lists_differences_to_another_run(frame_of, path, changes, named):
    evaluate(SyntheticFrames(frame_of), path, num_frames=3)
    with pytest.raises(ValueError, match=rf"checkpoint.npz: a checkpoint of another run: {named}; resume with the"):
        evaluate(SyntheticFrames(frame_of), path, num_frames=3, **changes)
    with pytest.raises(ValueError, match=r"another run: frames \(\"drive\" there, \"other\" here\)"):
        evaluate(SyntheticFrames(frame_of, content="other"), path, num_frames=3)


def test_identity_contains_all_other_settings():
    assert set(DESCRIPTIONS) > NOT_IN_IDENTITY


def test_run_without_resume_starts_again(frame_of, path):
    evaluate(SyntheticFrames(frame_of), path, num_frames=3)
    result = evaluate(SyntheticFrames(frame_of, content="other"), Checkpoint(path, resume=False), num_frames=2)
    assert (result.run.num_frames, read_header(path)["run"]["num_frames"]) == (2, 2)


def test_checkpoint_keeps_skipped_frames(frame_of, path):
    evaluate(SyntheticFrames(frame_of, {1}), path, num_frames=3, skip_bad_frames=True)
    with pytest.raises(ValueError, match=r"1 bad frames were skipped before the checkpoint, such as f1"):
        evaluate(SyntheticFrames(frame_of, {1}), path)


@pytest.mark.usefixtures("_write_every_frame")
def test_full_disk_warns_once_and_run_continues(frame_of, path, monkeypatch):
    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    evaluate(SyntheticFrames(frame_of), path, num_frames=3)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.warns(UserWarning, match="no checkpoint was written .*No space left.*; the run goes on") as warned:
            result = evaluate(SyntheticFrames(frame_of), path, num_frames=9)
    assert len(warned) == 1
    assert (result.run.is_complete, collect_bits(result)) == (
        True,
        collect_bits(evaluate(SyntheticFrames(frame_of), num_frames=9)),
    )
    assert read_header(path)["run"]["num_frames"] == 3
    assert [file.name for file in path.parent.iterdir()] == [path.name]
    assert collect_bits(evaluate(SyntheticFrames(frame_of), path)) == collect_bits(evaluate(SyntheticFrames(frame_of)))


class ObserverWithoutState:
    update = compute = merge_state = None


class ObserverWithSet(RecordingObserver):
    def state_dict(self):
        return {"names": {1, 2}}


@pytest.mark.parametrize(
    ("observer", "message"),
    [
        (
            ObserverWithoutState,
            "observer recorder: a ObserverWithoutState without state_dict and load_state_dict",
        ),
        (ObserverWithSet, "observer recorder: its state_dict cannot be saved in a checkpoint: .* got set in it"),
    ],
)
def test_observer_without_state_is_rejected_before_the_run(frame_of, path, observer, message):
    with pytest.raises(TypeError, match=message):
        evaluate(SyntheticFrames(frame_of, range(NUM_FRAMES)), path, recorder=observer())
    assert not path.parent.exists()


def test_states_are_restored_bit_for_bit(tmp_path):
    path = tmp_path / "a.npz"
    nan = torch.tensor([0x7FF8_0000_0000_1234], dtype=torch.int64).view(torch.float64)
    sparse = torch.zeros(50, 40, dtype=torch.float64)
    sparse[7, 3], sparse[49, 39] = -0.0, 5e-324
    state = {
        "dense": torch.cat([torch.rand(9, dtype=torch.float64), nan, torch.tensor([-0.0, torch.inf, -torch.inf])]),
        "sparse": sparse,
        "transposed": torch.arange(6).view(2, 3).T,
        "scalar": torch.tensor(7),
        "empty": torch.zeros(0, 3),
        "truth": torch.tensor([True, False]),
        "tree": {"list": [1, 0.1, None, "text", True, [torch.tensor([1.5])]], "": {}},
    }
    header = {"identity": {}, "run": {"num_frames": 1, "counts": {}, "skipped_frames": [], "duration_s": 0.0}}
    write_checkpoint(path, header, {"observer": state})
    back = read_state(path, read_header(path), "observer")
    tree, tree_back = state.pop("tree"), back.pop("tree")
    assert tree_back.pop("list")[5][0].equal(tree.pop("list")[5][0])
    assert tree_back == tree
    assert back.keys() == state.keys()
    for name, tensor in state.items():
        assert (back[name].shape, back[name].dtype) == (tensor.shape, tensor.dtype)
        assert back[name].numpy().tobytes() == tensor.numpy().tobytes()


def test_state_may_exceed_the_zip_limit(tmp_path, monkeypatch):
    """The limit of 2 GiB is 1 kB here."""
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", 1000)
    path, state = tmp_path / "a.npz", {"large": torch.arange(1000)}
    header = {"identity": {}, "run": {"num_frames": 1, "counts": {}, "skipped_frames": [], "duration_s": 0.0}}
    write_checkpoint(path, header, {"observer": state})
    assert torch.equal(read_state(path, read_header(path), "observer")["large"], state["large"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shape": [-1, 3]}, r"an array of int64 and the shape \(-1, 3\)"),
        ({"shape": [-2, -3]}, r"an array of int64 and the shape \(-2, -3\)"),
        ({"shape": [2, 4]}, "cannot reshape"),
        ({"dtype": "<U2"}, r"an array of <U2 and the shape \(2, 3\)"),
        ({"shape": [10**9, 10**9]}, "reading it takes"),
    ],
)
def test_wrong_header_of_an_array_is_rejected(tmp_path, change, message):
    path = tmp_path / "a.npz"
    header = {"identity": {}, "run": {"num_frames": 1, "counts": {}, "skipped_frames": [], "duration_s": 0.0}}
    write_checkpoint(path, header, {"observer": {"tensor": torch.arange(6).view(2, 3)}})
    header = read_header(path)
    header["states"]["observer"]["dict"]["tensor"]["tensor"] |= change
    with pytest.raises(BadFileError, match=rf"a\.npz: .*{message}"):
        read_state(path, header, "observer")


def test_repeated_array_counts_repeatedly_for_memory(tmp_path, monkeypatch):
    path = tmp_path / "a.npz"
    header = {"identity": {}, "run": {"num_frames": 1, "counts": {}, "skipped_frames": [], "duration_s": 0.0}}
    write_checkpoint(path, header, {"observer": {"tensor": torch.zeros(100_000)}})
    header = read_header(path)
    states = header["states"]["observer"]["dict"]
    states["copies"] = {"list": 30 * [states["tensor"]]}
    monkeypatch.setenv("TORCHCOVER_MAX_FILE_GB", "0.01")
    with pytest.raises(BadFileError, match=r"reading it takes 0\.0124 GB of memory, more than the 0\.01 GB"):
        read_state(path, header, "observer")


def test_damaged_checkpoint_is_named(frame_of, path):
    evaluate(SyntheticFrames(frame_of), path, num_frames=3)
    data = bytearray(path.read_bytes())
    third = len(data) // 3
    for damage in (data[:-100], data[:third] + bytes(third) + data[2 * third :], b"PK", b""):
        path.write_bytes(damage)
        with pytest.raises(BadFileError, match=r"checkpoint\.npz: "):
            evaluate(SyntheticFrames(frame_of), path, num_frames=3)
    np.savez(path, header=np.array("{}"))
    with pytest.raises(BadFileError, match="checkpoint format None; this torchcover reads format 3"):
        evaluate(SyntheticFrames(frame_of), path, num_frames=3)


def test_edited_checkpoint_is_rejected(frame_of, path):
    evaluate(SyntheticFrames(frame_of), path, num_frames=3)
    with np.load(path) as file:
        arrays = dict(file)
    header = json.loads(str(arrays["header"]))
    header["run"]["num_frames"] = 9
    with zipfile.ZipFile(path) as archive:
        checksum = archive.comment
    for edited in (arrays | {"header": np.array(json.dumps(header))}, dict(list(arrays.items())[1:])):
        np.savez(path, **edited)
        for comment in (b"", checksum):
            with zipfile.ZipFile(path, "a") as archive:
                archive.comment = comment
            with pytest.raises(BadFileError, match="the file was edited or is damaged; start again"):
                evaluate(SyntheticFrames(frame_of), path, num_frames=3)


@pytest.mark.parametrize(
    ("part", "change"),
    [
        ("identity", {"seed": 5}),
        ("run", {"num_frames": "3"}),
        ("run", {"num_frames": 10**30}),
        ("run", {"counts": "abc"}),
        ("run", {"counts": {"a": "b"}}),
        ("run", {"skipped_frames": 5}),
        ("run", {"duration_s": None}),
        ("run", {"duration_s": float("nan")}),
    ],
)
def test_checkpoint_with_values_of_other_types_is_rejected(frame_of, path, part, change):
    evaluate(SyntheticFrames(frame_of), path, num_frames=3)
    header = read_header(path)
    states = {name: read_state(path, header, name) for name in header["states"]}
    parts = {name: header[name] for name in ("identity", "run")}
    parts[part] = {**parts[part], **change}
    write_checkpoint(path, parts, states)
    with pytest.raises(BadFileError, match="values of other types than written"):
        evaluate(SyntheticFrames(frame_of), path, num_frames=4)


def test_checkpoint_with_other_states_is_named(frame_of, path):
    evaluate(SyntheticFrames(frame_of), path, num_frames=3)
    header = read_header(path)
    write_checkpoint(path, {name: header[name] for name in ("identity", "run")}, dict.fromkeys(header["states"], 5))
    with pytest.raises(BadFileError, match=r"checkpoint\.npz: "):
        evaluate(SyntheticFrames(frame_of), path, num_frames=4)
