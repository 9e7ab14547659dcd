"""Example that trains a detector on random placements: sampled placements, results after a kill, and a reduced run."""

import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from examples import placement_benchmark as example


def test_placements_depend_on_seed_and_index_only():
    few, many, other = example.sample_placements(4, 0), example.sample_placements(9, 0), example.sample_placements(4, 1)
    assert {name: many[name] for name in few} == few
    assert few != other
    for name, rig in many.items():
        assert sum(sensor.num_rays for sensor in rig.sensors) == example.LIDARS * 16 * 500
        for sensor in rig.sensors:
            place = sensor.mount.x_m, sensor.mount.y_m, sensor.mount.z_m
            within = [
                where
                for where, bounds in example.MOUNTS_M.items()
                if all(low <= value <= high for value, (low, high) in zip(place, bounds, strict=True))
            ]
            assert len(within) == 1
            assert within == ["roof"] or not name.startswith("roof")
            assert max(abs(sensor.mount.pitch_deg), abs(sensor.mount.roll_deg)) <= example.MAX_TILT_DEG


def test_incomplete_lines_are_overwritten(tmp_path):
    path = tmp_path / "trainings.jsonl"
    assert example.read_finished_trainings(path) == {}
    example.append_line(path, {"placement": "a", "seed": 0, "ap": 0.5})
    with path.open("a") as file:
        file.write('{"placement": "b", "se')  # as after a kill
    assert example.read_finished_trainings(path) == {("a", 0): 0.5}
    example.append_line(path, {"placement": "b", "seed": 1, "ap": 0.25})
    assert example.read_finished_trainings(path) == {("a", 0): 0.5, ("b", 1): 0.25}
    assert len([json.loads(line) for line in path.read_text().splitlines()]) == 2


def test_what_is_finished_is_not_trained_again(tmp_path, monkeypatch):
    done = []
    monkeypatch.setattr(example, "simulate", lambda rigs, steps, seed, name: sorted(rigs))
    monkeypatch.setattr(
        example, "train_detector", lambda rig, frames, epochs, seed: done.append((rig, seed)) or (rig, seed)
    )
    monkeypatch.setattr(example, "evaluate_detector", lambda detector, rig, frames: int(rig) + detector[1] / 10)
    options = SimpleNamespace(seeds=2, train=1, validate=1, epochs=1, seed=0)
    path = tmp_path / "trainings.jsonl"
    example.append_line(path, {"placement": "2", "seed": 0, "ap": 7.0})
    values = example.train_all({"1": None, "2": None}, options, path)
    np.testing.assert_allclose(values, [[1.0, 7.0], [1.1, 2.1]])
    assert done == [("1", 0), ("1", 1), ("2", 1)]
    assert example.train_all({"1": None, "2": None}, options, path).tolist() == values.tolist()
    assert len(done) == 3


def test_reduced_benchmark_resumes_and_refuses_other_settings(tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    arguments = ["placement_benchmark.py", "--reduced", "--metrics", "point_density", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", arguments)
    example.main()
    page = capsys.readouterr().out
    assert (out / "placement_benchmark.md").read_text() in page
    for words in (
        "## All placements",
        "Correlation between trainings",
        "mean mounting height",
        "| roof_00 |",
        "seed 1",
    ):
        assert words in page
    assert len(example.read_finished_trainings(out / "trainings.jsonl")) == 6
    monkeypatch.setitem(example.REDUCED, "train", 8)
    with pytest.raises(SystemExit, match=r"train 4 \(now 8\)"):
        example.main()
