"""`evaluate` and `compare`: what a notebook gets is what the command line writes."""

import csv
import json

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

import torchcover
from torchcover import Coverage, Rig, Scenario
from torchcover.data import Frame
from torchcover.evaluation import TargetError

SMALL = {"steps": 2, "cell_m": 4.0, "rays": 1024}


class PointCount:
    def __init__(self):
        self.points = 0

    def update(self, frame):
        self.points += sum(len(cloud) for cloud in frame.clouds.values())

    def compute(self):
        return self.points

    def merge_state(self, other):
        self.points += other.points


class Source:
    """Frames of a source that is neither a simulation nor a recording."""

    rigs = ("low", "high")
    sensors = {}  # noqa: RUF012
    ego_outline_m = None
    description = {"scenario": None, "frames": "made up", "seed": None}  # noqa: RUF012
    reference = None

    def __len__(self):
        return 3

    def __getitem__(self, index):
        reference = torch.tensor([[2.0, 0.5, 0.0], [6.0, 0.5, 1.0]])
        clouds = {"low": torch.zeros(1, 3), "high": torch.tensor([[2.0, 0.5, 0.0]])}
        return Frame(clouds, reference, index, f"f{index}")


def test_one_rig(tmp_path):
    result = torchcover.evaluate("front_roof_32", observers={"points": PointCount()}, **SMALL)
    assert result.observed["points"] > 1000
    assert result.coverage is result.coverages["front_roof_32"]
    assert result.coverage.counts["steps"] == result.run.steps == 2
    assert [row["region"] for row in result.summary] == ["20m", "20m", "80m", "80m", "160m", "160m"]
    assert "front_roof_32: 2 steps" in repr(result)
    assert "mean blind spot" in repr(result)
    stem, figure = next(iter(result.maps()))
    assert (stem, isinstance(figure, Figure)) == ("radius_m_ground", True)
    files = result.save(tmp_path / "new" / "out")
    assert files[-1].name == "summary.json"
    assert all(path.is_file() for path in files)
    summary = json.loads(files[-1].read_text())
    assert (summary["rig"], summary["scenario"], summary["seed"], summary["frames"]) == (
        "front_roof_32", "courtyard", 0, None
    )  # fmt: skip
    assert summary["rows"] == result.summary
    assert summary["reference"] == {"sensor": "even", "rays_per_step": 1020, "every_s": 0.1}
    loaded = Coverage.load(tmp_path / "new" / "out" / "coverage.npz")
    np.testing.assert_array_equal(loaded.radius, result.coverage.radius)


def test_rigs_and_scenarios_as_objects_and_the_others_against_the_first(tmp_path):
    rigs = [Rig.load("front_roof_32"), Rig.load("front_roof_32").model_copy(update={"name": "again"})]
    result = torchcover.compare(rigs, Scenario.load("courtyard"), **SMALL)
    assert list(result.coverages) == ["front_roof_32", "again"]
    with pytest.raises(ValueError, match=r"2 rigs \(front_roof_32, again\): use coverages"):
        _ = result.coverage
    assert {row["radius_m_difference"] for row in result.summary if row["radius_m"] is not None} == {0.0}
    result.save(tmp_path)
    assert sorted(path.name for path in (tmp_path / "coverage").iterdir()) == ["again.npz", "front_roof_32.npz"]
    with (tmp_path / "summary.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 12
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["rigs"]["again"], summary["scenario"]) == ("again", "courtyard")


def test_no_world_is_built_after_the_run_to_draw_the_ego(monkeypatch):
    built, build = [], Scenario.world
    monkeypatch.setattr(Scenario, "world", lambda *args: built.append(args) or build(*args))
    result = torchcover.evaluate("front_roof_32", **SMALL)
    next(iter(result.maps()))
    assert len(built) == 1


def test_any_source_of_frames_will_do():
    both = torchcover.compare(frames=Source(), cell_m=4.0)
    assert list(both.coverages) == ["low", "high"]
    assert both.record["frames"] == "made up"
    assert both.record["reference"] is None
    one = torchcover.evaluate("high", frames=Source(), cell_m=4.0, steps=2)
    assert one.run.steps == 2
    assert torch.equal(one.coverage.radius.nan_to_num(-1.0), both.coverages["high"].radius.nan_to_num(-1.0))
    with pytest.raises(ValueError, match="rigs low, high: say which, or compare them"):
        torchcover.evaluate(frames=Source())
    with pytest.raises(ValueError, match=r"no clouds of the rig middle; the frames have low, high"):
        torchcover.compare(["low", "middle"], frames=Source())
    with pytest.raises(ValueError, match="at least two rigs; got 'low' only"):
        torchcover.compare(["low"], frames=Source())
    with pytest.raises(ValueError, match="exclude each other"):
        torchcover.evaluate("low", "courtyard", frames=Source())


def test_a_target_error_is_an_object_here():
    result = torchcover.evaluate(frames=Single(), cell_m=4.0, target_error=TargetError(radius_m=10.0))
    assert result.run.steps == 32
    assert result.target_lines[0] == "Target error reached after 32 steps."


class Single(Source):
    """One rig, and many frames."""

    rigs = ("high",)

    def __len__(self):
        return 100

    def __getitem__(self, index):
        frame = super().__getitem__(index)
        return Frame({"high": frame.clouds["high"]}, frame.reference, index, frame.name)


def test_the_only_rig_of_a_source_goes_by_the_name_of_the_sensors_it_is():
    result = torchcover.evaluate("kitti", frames=Single(), cell_m=4.0, steps=2)
    assert list(result.coverages) == list(result.sensors) == ["kitti"]
    with pytest.raises(FileNotFoundError, match=r"neither a \.yaml file nor one of the built-in rigs"):
        torchcover.evaluate("no_such_rig", frames=Single())
