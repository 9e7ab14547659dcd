"""`evaluate` and `compare`: results, their files, comparisons, and invalid settings."""

import csv
import dataclasses
import inspect
import json
import math
import random
import re
import sys
from collections.abc import Iterable
from itertools import product

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

import torchcover
from torchcover import Coverage, RegionsOfInterest, Rig, Scenario
from torchcover.coverage import Maximum, Quantiles
from torchcover.data import DEFAULT_REFERENCE, BadFrameError, Frame, FrameDataset, FrameMetadata
from torchcover.evaluation import Settings, TargetError, task
from torchcover.evaluation.omissions import SLOW_PACKAGES
from torchcover.evaluation.target_error import MIN_FRAMES, StoppingParams

SMALL = {"num_frames": 2, "cell_m": 4.0, "num_rays": 1024, "test_targets": "pole"}


class PointCount:
    """Observer that counts the points of all rigs."""

    def __init__(self):
        self.points = 0

    def update(self, frame):
        self.points += sum(len(cloud) for cloud in frame.clouds.values())

    def compute(self):
        return self.points

    def merge_state(self, other):
        self.points += other.points


class Source(FrameDataset):
    """Source of frames that is neither a simulation nor a recording."""

    metadata = FrameMetadata(("low", "high"), {"scenario": None, "frames": "made up", "seed": None})

    def __len__(self):
        return 3

    def __getitem__(self, index):
        reference = torch.tensor([[2.0, 0.5, 0.0], [6.0, 0.5, 1.0]])
        clouds = {"low": torch.zeros(1, 3), "high": torch.tensor([[2.0, 0.5, 0.0]])}
        return Frame(clouds, reference, index, f"f{index}")


@pytest.mark.parametrize("workers", [0, 2])
def test_random_states_and_default_device_stay_unchanged(workers):
    expected = torchcover.evaluate("front_roof_32", **SMALL)
    before = torch.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002
    with torch.device("meta"):  # tensors on this default device have no values
        result = torchcover.evaluate("front_roof_32", **SMALL, num_workers=workers)
    assert result.summary == expected.summary
    after = torch.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002
    assert torch.equal(before[0], after[0])
    assert np.array_equal(before[1][1], after[1][1])
    assert (before[1][2:], before[2]) == (after[1][2:], after[2])


def test_a_result_has_numbers_maps_and_files(tmp_path):
    result = torchcover.evaluate("front_roof_32", observers={"points": PointCount()}, **SMALL)
    assert result.observer_results["points"] > 1000
    assert result.coverage is result.coverages["front_roof_32"]
    assert result.coverage.counts["num_frames"] == result.run.num_frames == 2
    # Only two sides of the near field contain the center of such a large cell.
    region_bands = [(row["region"], row["band"]) for row in result.summary]
    assert region_bands[:6:2] == [("20m", "ground"), ("80m", "ground"), ("160m", "ground")]
    assert region_bands[6:8] == [("left_3m", "ground"), ("right_3m", "ground")]
    assert region_bands[8:] == [(f"{side}_3m", "pole_100cm") for side in ("front", "rear", "left", "right")]
    assert "front_roof_32: 2 frames" in repr(result)
    assert "mean blind spot" in str(result)
    stem, figure = next(iter(result.plot_maps()))
    assert (stem, isinstance(figure, Figure)) == ("radius_area_m_ground", True)
    files = result.save(tmp_path / "new" / "out")
    assert files[-1].name == "summary.json"
    assert all(path.is_file() for path in files)
    summary = json.loads(files[-1].read_text())
    assert (summary["rig"], summary["scenario"], summary["seed"], summary["frames"]) == (
        "front_roof_32", "courtyard", 0, None
    )  # fmt: skip
    assert summary["rows"] == result.summary
    assert summary["reference"] == {
        "sensor": DEFAULT_REFERENCE,
        "rays_per_frame": result.run.counts["reference_rays"] // 2,
        "frame_interval_s": 0.1,
        "notes": ["Rays that end on the own vehicle: roof 3,380 of 57,600 (5.9%)."],
    }
    assert 0.5 * SMALL["num_rays"] < summary["reference"]["rays_per_frame"] < 1.5 * SMALL["num_rays"]
    loaded = Coverage.load(tmp_path / "new" / "out" / "coverage.npz")
    np.testing.assert_array_equal(loaded.radius, result.coverage.radius)


def test_rigs_are_compared_with_the_first_rig(tmp_path):
    rigs = [Rig.load("front_roof_32"), Rig.load("front_roof_32").model_copy(update={"name": "again"})]
    result = torchcover.evaluate(rigs, Scenario.load("courtyard"), **SMALL)
    assert list(result.coverages) == ["front_roof_32", "again"]
    with pytest.raises(ValueError, match=r"2 rigs \(front_roof_32, again\): use coverages"):
        _ = result.coverage
    assert {row["radius_m_difference"] for row in result.summary if row["radius_m"] is not None} == {0.0}
    result.save(tmp_path)
    assert sorted(path.name for path in (tmp_path / "coverage").iterdir()) == ["again.npz", "front_roof_32.npz"]
    with (tmp_path / "summary.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 24
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["rigs"]["again"], summary["scenario"]) == ("again", "courtyard")


def test_plots_do_not_build_the_scene_again(monkeypatch):
    calls, build = [], Scenario.build_scene
    monkeypatch.setattr(Scenario, "build_scene", lambda *args: calls.append(args) or build(*args))
    result = torchcover.evaluate("front_roof_32", **SMALL)
    next(iter(result.plot_maps()))
    assert len(calls) == 1


def test_frames_of_any_source_are_measured():
    both = torchcover.evaluate(frames=Source(), cell_m=4.0)
    assert list(both.coverages) == ["low", "high"]
    assert both.record["frames"] == "made up"
    assert both.record["reference"] is None
    single = torchcover.evaluate("high", frames=Source(), cell_m=4.0, num_frames=2)
    assert single.run.num_frames == 2
    assert torch.equal(single.coverage.radius.nan_to_num(-1.0), both.coverages["high"].radius.nan_to_num(-1.0))
    with pytest.raises(ValueError, match=r"no clouds of the rig middle; the frames have low, high"):
        torchcover.evaluate(["low", "middle"], frames=Source())
    with pytest.raises(ValueError, match="exclude each other"):
        torchcover.evaluate("low", "courtyard", frames=Source())


def test_evaluate_takes_a_target_error_object():
    result = torchcover.evaluate(frames=Single(), cell_m=4.0, target_error=TargetError(radius_m=10.0))
    assert result.run.num_frames == math.ceil(StoppingParams().min_growth * MIN_FRAMES)  # the second check
    assert result.target_error_lines[0] == f"Target error reached after {result.run.num_frames} frames."


class Single(Source):
    """Source of many frames with one rig."""

    metadata = dataclasses.replace(Source.metadata, rigs=("high",))

    def __len__(self):
        return 100

    def __getitem__(self, index):
        frame = super().__getitem__(index)
        return Frame({"high": frame.clouds["high"]}, frame.reference, index, frame.name)


class Ending(PointCount):
    """Observer that raises an error after two frames."""

    def __init__(self, error):
        super().__init__()
        self.error, self.frames = error, 0

    def update(self, frame):
        self.frames += 1
        if self.frames > 2:
            raise self.error


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (BadFrameError("f2 (frame 2): rubbish"), "BadFrameError: f2 (frame 2): rubbish"),
        (RuntimeError("no room.\nand much more"), "RuntimeError: no room"),
        (ZeroDivisionError(), "ZeroDivisionError"),
        (KeyboardInterrupt(), "interrupted"),
    ],
)
def test_an_early_end_is_noted_with_the_error(error, reason):
    with pytest.warns(RuntimeWarning, match=f"The run was cut short after 3 frames: {re.escape(reason)}.") as warned:
        result = torchcover.evaluate(frames=Single(), cell_m=4.0, observers={"ending": Ending(error)})
    assert [warning.filename for warning in warned] == [__file__]
    # The last frame counts, since the coverage observer received it before the observer that failed.
    assert f"The run was cut short after 3 frames: {reason}." in result.table.notes
    assert reason in " ".join(str(result).split())


def test_complete_runs_have_no_note_about_their_end():
    assert "cut short" not in str(torchcover.evaluate(frames=Single(), cell_m=4.0, num_frames=2))


def test_the_only_rig_can_have_another_name():
    result = torchcover.evaluate("kitti", frames=Single(), cell_m=4.0, num_frames=2)
    assert list(result.coverages) == list(result.sensors) == ["kitti"]
    with pytest.raises(FileNotFoundError, match=r"neither a \.yaml file nor one of the built-in rigs"):
        torchcover.evaluate("no_such_rig", frames=Single())


class Rigs:
    """Observer that collects the rigs of frames."""

    def __init__(self):
        self.rigs = set()

    def update(self, frame):
        self.rigs.add(tuple(frame.clouds))

    def compute(self):
        return self.rigs

    def merge_state(self, other):
        self.rigs |= other.rigs


def test_observers_receive_the_measured_rigs_by_name():
    single = torchcover.evaluate("high", frames=Source(), cell_m=4.0, observers={"rigs": Rigs()})
    assert single.observer_results["rigs"] == {("high",)}
    named = torchcover.evaluate("kitti", frames=Single(), cell_m=4.0, num_frames=2, observers={"rigs": Rigs()})
    assert named.observer_results["rigs"] == {("kitti",)}
    both = torchcover.evaluate(["high", "low"], frames=Source(), cell_m=4.0, observers={"rigs": Rigs()})
    assert both.observer_results["rigs"] == {("high", "low")}


def test_rig_names_become_valid_file_names(tmp_path):
    rigs = [Rig.load("front_roof_32").model_copy(update={"name": name}) for name in ("a/b", "a b")]
    result = torchcover.evaluate(rigs, **{**SMALL, "num_frames": 1})
    result.save(tmp_path)
    stems = [path.stem for path in sorted((tmp_path / "coverage").iterdir())]
    assert len(stems) == 2
    assert Coverage.load(tmp_path / "coverage" / f"{stems[0]}.npz").counts["num_frames"] == 1


def test_settings_are_converted_to_one_form():
    result = torchcover.evaluate(
        frames=Single(), cell_m=4.0, num_frames=1, thresholds_m=0.4, device=torch.device("cpu"), target_error="5%"
    )
    assert result.coverage.thresholds_m == (0.4,)
    assert result.record["device"] == "cpu"
    assert result.target_error == TargetError(detection=0.05)
    json.dumps(result.record)


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"num_frames": 0}, ValueError, "num_frames: at least 1 is needed; got 0"),
        ({"num_frames": -1}, ValueError, "num_frames: at least 1 is needed; got -1"),
        ({"thresholds_m": "0.4"}, TypeError, "thresholds_m: meters are needed, as in 0.4"),
        ({"target_error": 0.1}, TypeError, "target error: numbers with their units"),
        ({"aggregations": Maximum()}, TypeError, "aggregations: names such as maximum"),
        ({"aggregations": "minimum"}, ValueError, "aggregation minimum: one of maximum"),
        (
            {"only_detection": True},
            ValueError,
            "only_detection is for simulations; a recording contains all its points",
        ),
        ({"only_detection": True, "redundancy": True}, ValueError, "only_detection: excludes radii"),
        ({"only_detection": True, "target_error": "0.02m"}, ValueError, "only_detection: excludes radii"),
        ({"only_detection": True, "thresholds_m": ()}, ValueError, "needs a threshold"),
        ({"frames": [1, 2]}, TypeError, "FrameDataset is needed; got list; for "),
    ],
)
def test_invalid_settings_are_rejected_before_the_run(settings, error, message):
    with pytest.raises(error, match=message):
        torchcover.evaluate(**{"frames": Single(), "cell_m": 4.0, **settings})


def test_a_single_rig_may_be_a_list():
    alone, listed = (torchcover.evaluate(rigs, frames=Source(), cell_m=8.0) for rigs in ("high", ["high"]))
    assert alone.summary == listed.summary
    assert not listed.is_comparison


def test_comparison_of_results_equals_one_common_run():
    low, high = (torchcover.evaluate(rig, frames=Source(), cell_m=4.0) for rig in ("low", "high"))
    together = torchcover.evaluate(["low", "high"], frames=Source(), cell_m=4.0)
    assert torchcover.compare([low, high]).summary == torchcover.compare([together]).summary == together.summary
    assert torchcover.compare(together).summary == together.summary
    assert torchcover.compare([low, high]).run is None
    with pytest.raises(ValueError, match="at least two measured rigs; got low only"):
        torchcover.compare([low])
    with pytest.raises(ValueError, match=r"front_roof_32: not measured; compare takes results and \.npz files"):
        torchcover.compare(["front_roof_32", "front_roof_128"])
    with pytest.raises(TypeError, match="results of `evaluate` or coverage files are needed; got Coverage"):
        torchcover.compare([low.coverage, high.coverage])


def test_a_gpu_casts_rays_without_workers(monkeypatch):
    def find_device(device, **settings):
        return task.find_ray_device(Settings("front_roof_32", device=device, **settings))

    monkeypatch.setattr(task, "get_device", torch.device)
    monkeypatch.setattr(task, "find_spec", lambda name: name == "warp")
    assert (find_device("cuda:1"), find_device("cuda", num_workers=0), find_device("cpu")) == ("cuda:1", "cuda", None)
    assert find_device("cuda", num_workers=2) is None
    monkeypatch.setattr(task, "find_spec", lambda _: None)
    assert find_device("cuda") is None


def test_signature_and_docstring_list_all_settings():
    """Unknown arguments are rejected by name."""
    parameters = inspect.signature(torchcover.evaluate).parameters
    assert [*parameters] == [field.name for field in dataclasses.fields(Settings)]
    positional = inspect.Parameter.POSITIONAL_OR_KEYWORD
    assert [name for name, parameter in parameters.items() if parameter.kind is positional] == ["rigs", "scenario"]
    assert parameters["thresholds_m"].annotation == float | Iterable[float]
    assert parameters["device"].default == "cpu"
    for name in parameters:
        assert f"\n    {name}: " in torchcover.evaluate.__doc__
    with pytest.raises(TypeError, match="evaluate: got an unexpected keyword argument 'stepz'"):
        torchcover.evaluate("front_roof_32", stepz=3)


def test_aggregations_are_measured_plotted_and_saved(tmp_path):
    result = torchcover.evaluate(frames=Single(), cell_m=8.0, num_frames=1, aggregations=["maximum", Quantiles((0.5,))])
    assert all(
        row["radius_q0.5_m"] <= 1.13 * row["radius_maximum_m"] + 0.01 for row in result.summary if row["observed_cells"]
    )
    (quantity,) = [layer.quantity for layer in result.coverage.layers.values() if "maximum" in layer.quantity.key]
    files = result.save(tmp_path)
    assert f"{quantity.key}_ground" in {path.stem for path in files}
    assert quantity.key in Coverage.load(tmp_path / "coverage.npz").layers
    (unused,) = [omission.description for omission in result.omissions if "not computed" in omission.description]
    assert Maximum.description not in unused


def test_only_detection_changes_no_detection_rate():
    """A noisy and an exact rig, with and without the rays that cannot change a detection."""
    noisy = Rig.load("front_roof_32").sensors[0].model_copy(update={"range_noise_m": 0.2, "dropout": 0.1})
    rigs = [Rig(name="noisy", sensors=(noisy,)), "front_roof_32"]
    settings = {"num_frames": 2, "cell_m": 4.0, "num_rays": 300, "thresholds_m": (0.2, 0.4)}
    full = torchcover.evaluate(rigs, "parking", **settings)
    detection = torchcover.evaluate(rigs, "parking", **settings, only_detection=True)
    for name, coverage in full.coverages.items():
        detection_coverage = detection.coverages[name]
        assert full.target_sums[name]
        assert not detection.target_sums
        np.testing.assert_array_equal(detection_coverage.detection, coverage.detection)
        assert detection_coverage.radius.isnan().all()
        for region, band in product(full.regions, coverage.grid.heights):
            values, detection_values = (item.estimate(region, band).value for item in (coverage, detection_coverage))
            np.testing.assert_array_equal(detection_values[1:], values[1:])
            assert detection_values[0].isnan()
    (omitted,) = [item.count for item in detection.omissions if "near a reference point" in item.description]
    assert omitted == detection.run.counts["sensor_rays_omitted"] > 0.3 * detection.run.counts["sensor_rays"]
    assert full.run.counts["sensor_rays_omitted"] == 0


def test_omissions_are_recorded_at_the_end(monkeypatch):
    result = torchcover.evaluate(frames=Single(), cell_m=8.0, num_frames=1)
    before = result.record["omissions"]
    for package in SLOW_PACKAGES:
        monkeypatch.setitem(sys.modules, package, sys)
    assert result.record["omissions"] == before


def test_a_folder_has_the_files_of_one_run(tmp_path):
    (tmp_path / "maps").mkdir()
    for mine in ("notes.txt", "maps/mine.png"):
        (tmp_path / mine).write_text("mine")
    torchcover.evaluate(frames=Source(), cell_m=8.0, thresholds_m=(0.4, 1.0)).save(tmp_path)
    files = torchcover.evaluate(frames=Single(), cell_m=8.0, num_frames=2).save(tmp_path)
    assert {path for path in tmp_path.rglob("*") if path.is_file()} == {
        *files,
        tmp_path / "notes.txt",
        tmp_path / "maps" / "mine.png",
    }
    listed = json.loads((tmp_path / "summary.json").read_text())["files"]
    assert {tmp_path / name for name in listed} == {*files} - {tmp_path / "summary.json"}
    torchcover.evaluate(frames=Source(), cell_m=8.0).save(tmp_path)
    assert not (tmp_path / "coverage.npz").exists()


@pytest.mark.parametrize("names", [["../mine.txt"], ["/mine.txt"], [3, None], "mine.txt", None])
def test_only_files_within_the_folder_are_deleted(tmp_path, names):
    (tmp_path / "mine.txt").write_text("mine")
    out = tmp_path / "out"
    out.mkdir()
    named = [str(tmp_path / name) if name == "/mine.txt" else name for name in names] if names else names
    (out / "summary.json").write_text(json.dumps({"files": named}))
    torchcover.evaluate(frames=Single(), cell_m=8.0, num_frames=1).save(out)
    assert (tmp_path / "mine.txt").read_text() == "mine"


def read_files(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def fail_halfway(path):
    """Write half of a file to a full disk."""
    path.write_bytes(b"half")
    raise OSError("no space left on device")


def test_earlier_files_stay_until_new_numbers_are_complete(tmp_path, monkeypatch):
    result = torchcover.evaluate(frames=Single(), cell_m=8.0, num_frames=2)
    result.save(tmp_path)
    before = read_files(tmp_path)
    monkeypatch.setattr(Coverage, "save", lambda self, path, *_, **__: fail_halfway(path))
    with pytest.raises(OSError, match="no space left"):
        result.save(tmp_path)
    assert read_files(tmp_path) == before


def test_numbers_survive_an_error_while_plotting(tmp_path, monkeypatch):
    torchcover.evaluate(frames=Source(), cell_m=8.0).save(tmp_path)
    monkeypatch.setattr(Figure, "savefig", lambda self, path, **_: fail_halfway(path))
    with pytest.raises(OSError, match="no space left"):
        torchcover.evaluate(frames=Single(), cell_m=8.0, num_frames=2).save(tmp_path)
    after = read_files(tmp_path)
    assert set(after) == {"coverage.npz", "summary.csv", "summary.json"}
    assert list(json.loads(after["summary.json"])["files"]) == ["coverage.npz", "summary.csv"]


def test_temporary_files_of_killed_processes_are_deleted(tmp_path):
    (tmp_path / ".torchcover_left").mkdir()
    (tmp_path / ".torchcover_left" / "coverage.npz").write_bytes(b"half")
    torchcover.evaluate(frames=Single(), cell_m=8.0, num_frames=1).save(tmp_path)
    assert not [name for name in read_files(tmp_path) if name.startswith(".")]


def test_checkpoints_need_the_content_of_a_source(tmp_path):
    with pytest.raises(NotImplementedError, match=r"^frames: Single does not define collect_content\(\), by which"):
        torchcover.evaluate(frames=Single(), cell_m=8.0, checkpoint=tmp_path / "checkpoint.npz")


def test_hills_do_not_change_detection_of_far_obstacles():
    """Above a hilly ground, bands of the vehicle frame would contain the road."""
    urban = Scenario.load("urban")
    flat = urban.model_copy(update={"traffic": urban.traffic.model_copy(update={"hill_height_std_m": 0.0})})
    settings = {"num_frames": 8, "cell_m": 1.0, "num_rays": 2048, "seed": 1}
    hilly, level = (torchcover.evaluate("front_roof_128", scenario, **settings) for scenario in (urban, flat))
    assert (hilly.record["band_frame"], hilly.coverage.band_frame) == ("ground", "ground")
    far = [
        {row["region"]: row["detection_0.4m"] for row in result.summary if row["band"] == "obstacle"}
        for result in (hilly, level)
    ]
    for region in ("80m", "160m"):
        assert abs(far[0][region] - far[1][region]) < 0.07  # in eight frames


def test_pitch_and_roll_do_not_change_numbers():
    """In the vehicle frame, half of the surface in the obstacle band would be ground."""
    poses = [{"x_m": x, "y_m": y, "z_m": -1.0} for x, y in ((12, 3), (30, -6), (50, 9), (70, -12))]
    bodies = [
        {"name": "floor", "ground": True, "shape": {"type": "plane", "size_m": [400, 400]}},
        {"name": "wall", "shape": {"type": "box", "size_m": [0.4, 4, 3]}, "poses": poses},
    ]
    lidar = {"channels": 128, "vertical_fov_deg": [-30, 10], "horizontal_fov_deg": 360, "columns": 720}
    lidar |= {"name": "top", "type": "lidar", "mount": {"z_m": 2.0}, "max_range_m": 150}
    rig = Rig.model_validate({"name": "rig", "sensors": [lidar]})
    regions = RegionsOfInterest(regions={"80m": {"x_m": (0, 80), "y_m": (-20, 20)}})

    def measure_obstacles(band_frame=None, **pose):
        ego = {"shape": {"type": "box", "size_m": [4, 2, 1.5]}, "pose": pose}
        scenario = Scenario.model_validate({"name": "walls", "ego": ego, "bodies": bodies})
        result = torchcover.evaluate(
            rig, scenario, num_frames=4, cell_m=4, num_rays=1024, regions=regions, band_frame=band_frame
        )
        (row,) = (row for row in result.summary if row["band"] == "obstacle")
        return np.array([row["detection_0.4m"], row["visible_m2"] / 10])

    level = measure_obstacles()
    for pose in ({"pitch_deg": 2.0}, {"pitch_deg": -2.0}, {"roll_deg": 2.0}, {"roll_deg": -2.0}):
        np.testing.assert_allclose(measure_obstacles(**pose), level, atol=0.06)
    assert measure_obstacles("vehicle", pitch_deg=2.0)[0] < level[0] - 0.4


def test_unavailable_band_frames_are_rejected():
    assert torchcover.evaluate("low", frames=Source(), cell_m=4.0).coverage.band_frame == "vehicle"
    with pytest.raises(ValueError, match=r"f0.* are unknown; use the band frame vehicle$"):
        torchcover.evaluate("low", frames=Source(), cell_m=4.0, band_frame="ground")
    with pytest.raises(ValueError, match="band_frame sea: `ground` or `vehicle` is needed"):
        torchcover.evaluate("front_roof_32", band_frame="sea")
