"""Example that trains on a recording, with a drive in the raw layout of KITTI."""

import importlib
import math
import sys
from pathlib import Path

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from tests.recordings.drives import Drive
from tests.recordings.layouts import kitti_raw
from torchcover.data import AccumulatedReference, RecordedFrames
from torchcover.geometry import build_transform

EXAMPLES = Path(__file__).parents[2] / "examples"


class Straight(Drive):
    """Write a drive along a wall behind a car at constant distance, with one visible row of points per scan."""

    def get_world_T_vehicle(self, index):
        return build_transform(torch.eye(3).numpy(), [1.5 * index, 0.0, 0.0])

    def world_T_car(self, index):
        return build_transform(torch.eye(3).numpy(), [12.0 + 1.5 * index, 0.0, 0.75])

    def read_scan(self, sensor, index):
        whole, row = self.back_m, index % 7
        self.back_m = whole[row * 10 : row * 10 + 10]
        seen = super().read_scan(sensor, index)
        self.back_m = whole
        return seen


@pytest.fixture
def example(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    yield importlib.import_module("train_on_recording")
    for name in ("train_on_recording", "train_detector"):
        sys.modules.pop(name)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return kitti_raw(Straight(steps=10), tmp_path_factory.mktemp("kitti"))


def test_last_fifth_of_a_recording_is_the_validation(example, drive):
    frames = RecordedFrames(drive, reference=AccumulatedReference(0.6))
    rig, trained, validated = example.prepare_frames(frames)
    assert (rig, len(trained), len(validated)) == ("kitti", 8, 2)
    assert [frame.index for frame in (*trained, *validated)] == list(range(10))
    assert all(len(frame.boxes) == 1 for frame in (*trained, *validated))
    assert all(len(frame.reference) == 0 for frame in trained)
    for frame in validated:
        assert torch.equal(frame.reference, frames[frame.index].reference)
        assert torch.equal(frame.get_cloud(rig), frames[frame.index].get_cloud(rig))


def test_small_kitti_run_ends_with_table_and_figure(example, drive, tmp_path, monkeypatch, capsys, blank_maps):
    options = ("--window", "0.6", "--epochs", "2", "--out", str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["train_on_recording.py", str(drive), *options])
    monkeypatch.setenv("COLUMNS", "200")
    example.main()
    said = capsys.readouterr().out
    assert "Reference: points of velodyne, accumulated over 0.6 s" in said
    assert "also built the reference: surfaces that they never observe are missing" in said
    (line,) = (line for line in said.splitlines() if "not sampled" in line)
    assert "│ 0 " in line  # the reference contains the car, since its scans show other rows of it
    assert (tmp_path / "recall.png").stat().st_size > 10_000
    events = EventAccumulator(str(tmp_path / "kitti"))
    events.Reload()
    tag = "coverage/kitti/val/detection_0.4m/0-51m/body"
    first, second = events.Scalars(tag)
    assert first.value == second.value  # fixed frames do not depend on the detector
    assert 0.0 < first.value <= 1.0
    assert math.isnan(events.Scalars("val/recall/visibility not sampled")[1].value)


def test_a_recording_without_boxes_is_refused(example, drive, tmp_path):
    frames = RecordedFrames(kitti_raw(Straight(steps=3), tmp_path), reference=AccumulatedReference(0.6))
    (frames.recording.path / "tracklet_labels.xml").unlink()
    with pytest.raises(SystemExit, match="labeled boxes are needed for recall, and there are none"):
        example.prepare_frames(frames)
