"""`evaluate` and `compare`: what a notebook gets is what the command line writes."""

import csv
import dataclasses
import inspect
import json
import math
import random
import re
import sys
from collections.abc import Iterable

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

import torchcover
from torchcover import Coverage, RegionsOfInterest, Rig, Scenario
from torchcover.coverage import Maximum, Quantiles
from torchcover.data import DEFAULT_REFERENCE, BadFrameError, Frame, FrameDataset
from torchcover.evaluation import Settings, TargetError, task
from torchcover.evaluation.omissions import SLOW_PACKAGES
from torchcover.evaluation.target_error import MIN_FRAMES, StoppingParams

SMALL = {"num_frames": 2, "cell_m": 4.0, "num_rays": 1024, "test_targets": "pole"}


class PointCount:
    def __init__(self):
        self.points = 0

    def update(self, frame):
        self.points += sum(len(cloud) for cloud in frame.clouds.values())

    def compute(self):
        return self.points

    def merge_state(self, other):
        self.points += other.points


class Source(FrameDataset):
    """Frames of a source that is neither a simulation nor a recording."""

    rigs = ("low", "high")
    sensors = {}  # noqa: RUF012
    ego_outline_m = None
    description = {"scenario": None, "frames": "made up", "seed": None}  # noqa: RUF012
    has_area_weights = False
    reference_record = None
    content = {"frames": "made up"}  # noqa: RUF012
    get_scene_id = staticmethod(int)

    def __len__(self):
        return 3

    def __getitem__(self, index):
        reference = torch.tensor([[2.0, 0.5, 0.0], [6.0, 0.5, 1.0]])
        clouds = {"low": torch.zeros(1, 3), "high": torch.tensor([[2.0, 0.5, 0.0]])}
        return Frame(clouds, reference, index, f"f{index}")


@pytest.mark.parametrize("workers", [0, 2])
def test_the_random_states_and_the_default_device_of_the_user_are_neither_used_nor_changed(workers):
    expected = torchcover.evaluate("front_roof_32", **SMALL)
    before = torch.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002
    with torch.device("meta"):  # a tensor that is made on the default device has no numbers
        found = torchcover.evaluate("front_roof_32", **SMALL, num_workers=workers)
    assert found.summary == expected.summary
    after = torch.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002
    assert torch.equal(before[0], after[0])
    assert np.array_equal(before[1][1], after[1][1])
    assert (before[1][2:], before[2]) == (after[1][2:], after[2])


def test_one_rig(tmp_path):
    result = torchcover.evaluate("front_roof_32", observers={"points": PointCount()}, **SMALL)
    assert result.observer_results["points"] > 1000
    assert result.coverage is result.coverages["front_roof_32"]
    assert result.coverage.counts["num_frames"] == result.run.num_frames == 2
    # Of the near field, two sides hold a centre of such large cells, and of that the ground is asked about.
    places = [(row["region"], row["band"]) for row in result.summary]
    assert places[:6:2] == [("20m", "ground"), ("80m", "ground"), ("160m", "ground")]
    assert places[6:8] == [("left_3m", "ground"), ("right_3m", "ground")]
    assert places[8:] == [(f"{side}_3m", "pole_100cm") for side in ("front", "rear", "left", "right")]
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


def test_rigs_and_scenarios_as_objects_and_the_others_against_the_first(tmp_path):
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


def test_no_world_is_built_after_the_run_to_draw_the_ego(monkeypatch):
    built, build = [], Scenario.build_scene
    monkeypatch.setattr(Scenario, "build_scene", lambda *args: built.append(args) or build(*args))
    result = torchcover.evaluate("front_roof_32", **SMALL)
    next(iter(result.plot_maps()))
    assert len(built) == 1


def test_any_source_of_frames_will_do():
    both = torchcover.evaluate(frames=Source(), cell_m=4.0)
    assert list(both.coverages) == ["low", "high"]
    assert both.record["frames"] == "made up"
    assert both.record["reference"] is None
    one = torchcover.evaluate("high", frames=Source(), cell_m=4.0, num_frames=2)
    assert one.run.num_frames == 2
    assert torch.equal(one.coverage.radius.nan_to_num(-1.0), both.coverages["high"].radius.nan_to_num(-1.0))
    with pytest.raises(ValueError, match=r"no clouds of the rig middle; the frames have low, high"):
        torchcover.evaluate(["low", "middle"], frames=Source())
    with pytest.raises(ValueError, match="exclude each other"):
        torchcover.evaluate("low", "courtyard", frames=Source())


def test_a_target_error_is_an_object_here():
    result = torchcover.evaluate(frames=Single(), cell_m=4.0, target_error=TargetError(radius_m=10.0))
    assert result.run.num_frames == math.ceil(StoppingParams().min_growth * MIN_FRAMES)  # the second look
    assert result.target_error_lines[0] == f"Target error reached after {result.run.num_frames} frames."


class Single(Source):
    """One rig, and many frames."""

    rigs = ("high",)

    def __len__(self):
        return 100

    def __getitem__(self, index):
        frame = super().__getitem__(index)
        return Frame({"high": frame.clouds["high"]}, frame.reference, index, frame.name)


class Ending(PointCount):
    """Ends the run after two frames."""

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
def test_a_result_that_was_cut_short_says_so_wherever_its_numbers_stand(error, reason):
    with pytest.warns(RuntimeWarning, match=f"The run was cut short after 3 frames: {re.escape(reason)}.") as told:
        result = torchcover.evaluate(frames=Single(), cell_m=4.0, observers={"ending": Ending(error)})
    assert [warning.filename for warning in told] == [__file__]
    # Of the frame that ended it, coverage has the step: it was fed before the other observer.
    assert f"The run was cut short after 3 frames: {reason}." in result.table.notes
    assert reason in " ".join(str(result).split())


def test_a_run_that_came_to_its_end_says_nothing_of_one():
    assert "cut short" not in str(torchcover.evaluate(frames=Single(), cell_m=4.0, num_frames=2))


def test_the_only_rig_of_a_source_goes_by_the_name_of_the_sensors_it_is():
    result = torchcover.evaluate("kitti", frames=Single(), cell_m=4.0, num_frames=2)
    assert list(result.coverages) == list(result.sensors) == ["kitti"]
    with pytest.raises(FileNotFoundError, match=r"neither a \.yaml file nor one of the built-in rigs"):
        torchcover.evaluate("no_such_rig", frames=Single())


class Rigs:
    """Which rigs an observer was shown."""

    def __init__(self):
        self.seen = set()

    def update(self, frame):
        self.seen.add(tuple(frame.clouds))

    def compute(self):
        return self.seen

    def merge_state(self, other):
        self.seen |= other.seen


def test_observers_see_the_rigs_that_are_measured_under_their_names():
    one = torchcover.evaluate("high", frames=Source(), cell_m=4.0, observers={"rigs": Rigs()})
    assert one.observer_results["rigs"] == {("high",)}
    named = torchcover.evaluate("kitti", frames=Single(), cell_m=4.0, num_frames=2, observers={"rigs": Rigs()})
    assert named.observer_results["rigs"] == {("kitti",)}
    both = torchcover.evaluate(["high", "low"], frames=Source(), cell_m=4.0, observers={"rigs": Rigs()})
    assert both.observer_results["rigs"] == {("high", "low")}


def test_a_rig_may_be_called_what_no_file_can_be(tmp_path):
    rigs = [Rig.load("front_roof_32").model_copy(update={"name": name}) for name in ("a/b", "a b")]
    result = torchcover.evaluate(rigs, **{**SMALL, "num_frames": 1})
    result.save(tmp_path)
    stems = [path.stem for path in sorted((tmp_path / "coverage").iterdir())]
    assert len(stems) == 2
    assert Coverage.load(tmp_path / "coverage" / f"{stems[0]}.npz").counts["num_frames"] == 1


def test_settings_have_one_form_whatever_they_are_given_as():
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
        ({"only_detection": True}, ValueError, "only_detection is for simulations; a recording contains all its points"),
        ({"only_detection": True, "redundancy": True}, ValueError, "only_detection: excludes radii"),
        ({"only_detection": True, "target_error": "0.02m"}, ValueError, "only_detection: excludes radii"),
        ({"only_detection": True, "thresholds_m": ()}, ValueError, "needs a threshold"),
        ({"frames": [1, 2]}, TypeError, "FrameSource is needed; got list, which has no rigs, "),
    ],
)
def test_what_a_setting_cannot_be_is_said_before_the_run(settings, error, message):
    with pytest.raises(error, match=message):
        torchcover.evaluate(**{"frames": Single(), "cell_m": 4.0, **settings})


def test_a_rig_alone_and_a_list_of_it_are_one_thing():
    alone, listed = (torchcover.evaluate(rigs, frames=Source(), cell_m=8.0) for rigs in ("high", ["high"]))
    assert alone.summary == listed.summary
    assert not listed.is_comparison


def test_results_are_compared_as_if_they_had_been_measured_together():
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


def test_a_gpu_casts_rays_if_warp_is_there_and_no_workers_are_asked_for(monkeypatch):
    def device(given, **settings):
        return task.find_ray_device(Settings("front_roof_32", device=given, **settings))

    monkeypatch.setattr(task, "get_device", torch.device)
    monkeypatch.setattr(task, "find_spec", lambda name: name == "warp")
    assert (device("cuda:1"), device("cuda", num_workers=0), device("cpu")) == ("cuda:1", "cuda", None)
    assert device("cuda", num_workers=2) is None
    monkeypatch.setattr(task, "find_spec", lambda _: None)
    assert device("cuda") is None


def test_every_argument_is_declared_once_and_stands_in_the_signature_and_in_the_docstring():
    """And an argument that is none is refused by its name."""
    parameters = inspect.signature(torchcover.evaluate).parameters
    assert [*parameters] == [one.name for one in dataclasses.fields(Settings)]
    assert [name for name, one in parameters.items() if one.kind is one.POSITIONAL_OR_KEYWORD] == ["rigs", "scenario"]
    assert parameters["thresholds_m"].annotation == float | Iterable[float]
    assert parameters["device"].default == "cpu"
    for name in parameters:
        assert f"\n    {name}: " in torchcover.evaluate.__doc__
    with pytest.raises(TypeError, match="evaluate: got an unexpected keyword argument 'stepz'"):
        torchcover.evaluate("front_roof_32", stepz=3)


def test_aggregations_are_measured_drawn_and_saved(tmp_path):
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


def test_of_detections_alone_the_same_is_known_and_of_radii_nothing():
    """Of a rig that errs, beside one that does not: with and without the rays that change no detection."""
    errs = Rig.load("front_roof_32").sensors[0].model_copy(update={"range_noise_m": 0.2, "dropout": 0.1})
    rigs = [Rig(name="errs", sensors=(errs,)), "front_roof_32"]
    given = {"num_frames": 2, "cell_m": 4.0, "num_rays": 300, "thresholds_m": (0.2, 0.4)}
    every, some = (torchcover.evaluate(rigs, "parking", **given, only_detection=only) for only in (False, True))
    for name, coverage in every.coverages.items():
        other = some.coverages[name]
        assert coverage.target_sums
        assert not other.target_sums  # nobody has asked for them
        np.testing.assert_array_equal(other.detection, coverage.detection)
        assert other.radius.isnan().all()
        for region, height in ((region, height) for region in every.regions for height in coverage.grid.heights):
            one, less = (each.estimate(region, height).value for each in (coverage, other))
            np.testing.assert_array_equal(less[1:], one[1:])
            assert less[0].isnan()
    spared = {one.description: one.count for one in some.omissions if "near a reference point" in one.description}
    assert list(spared.values()) == [some.run.counts["sensor_rays_omitted"]]
    assert some.run.counts["sensor_rays_omitted"] > 0.3 * some.run.counts["sensor_rays"]
    assert every.run.counts["sensor_rays_omitted"] == 0


def test_what_a_run_left_out_is_told_as_it_was_at_its_end(monkeypatch):
    result = torchcover.evaluate(frames=Single(), cell_m=8.0, num_frames=1)
    before = result.record["omissions"]
    for package in SLOW_PACKAGES:
        monkeypatch.setitem(sys.modules, package, sys)
    assert result.record["omissions"] == before


def test_a_folder_of_results_is_of_one_run(tmp_path):
    (tmp_path / "maps").mkdir()
    for mine in ("notes.txt", "maps/mine.png"):
        (tmp_path / mine).write_text("mine")
    torchcover.evaluate(frames=Source(), cell_m=8.0, thresholds_m=(0.4, 1.0)).save(tmp_path)
    files = torchcover.evaluate(frames=Single(), cell_m=8.0, num_frames=2).save(tmp_path)
    found = {path for path in tmp_path.rglob("*") if path.is_file()}
    assert found == {*files, tmp_path / "notes.txt", tmp_path / "maps" / "mine.png"}
    listed = json.loads((tmp_path / "summary.json").read_text())["files"]
    assert {tmp_path / name for name in listed} == {*files} - {tmp_path / "summary.json"}
    torchcover.evaluate(frames=Source(), cell_m=8.0).save(tmp_path)
    assert not (tmp_path / "coverage.npz").exists()


@pytest.mark.parametrize("names", [["../mine.txt"], ["/mine.txt"], [3, None], "mine.txt", None])
def test_a_summary_that_lists_others_deletes_nothing(tmp_path, names):
    (tmp_path / "mine.txt").write_text("mine")
    out = tmp_path / "out"
    out.mkdir()
    named = [str(tmp_path / name) if name == "/mine.txt" else name for name in names] if names else names
    (out / "summary.json").write_text(json.dumps({"files": named}))
    torchcover.evaluate(frames=Single(), cell_m=8.0, num_frames=1).save(out)
    assert (tmp_path / "mine.txt").read_text() == "mine"


def contents(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def full(path):
    path.write_bytes(b"half")
    raise OSError("no space left on device")


def test_a_result_stays_whole_until_the_numbers_of_the_next_are_there(tmp_path, monkeypatch):
    result = torchcover.evaluate(frames=Single(), cell_m=8.0, num_frames=2)
    result.save(tmp_path)
    before = contents(tmp_path)
    monkeypatch.setattr(Coverage, "save", lambda self, path: full(path))
    with pytest.raises(OSError, match="no space left"):
        result.save(tmp_path)
    assert contents(tmp_path) == before


def test_numbers_are_safe_and_listed_although_a_map_could_not_be_written(tmp_path, monkeypatch):
    torchcover.evaluate(frames=Source(), cell_m=8.0).save(tmp_path)
    monkeypatch.setattr(Figure, "savefig", lambda self, path, **_: full(path))
    with pytest.raises(OSError, match="no space left"):
        torchcover.evaluate(frames=Single(), cell_m=8.0, num_frames=2).save(tmp_path)
    after = contents(tmp_path)
    assert set(after) == {"coverage.npz", "summary.csv", "summary.json"}
    assert list(json.loads(after["summary.json"])["files"]) == ["coverage.npz", "summary.csv"]


def test_what_a_killed_process_left_aside_is_cleared(tmp_path):
    (tmp_path / ".torchcover_left").mkdir()
    (tmp_path / ".torchcover_left" / "coverage.npz").write_bytes(b"half")
    torchcover.evaluate(frames=Single(), cell_m=8.0, num_frames=1).save(tmp_path)
    assert not [name for name in contents(tmp_path) if name.startswith(".")]


def test_a_source_that_lacks_something_is_told_what():
    class Unfinished(Single):
        has_area_weights = property()  # raises AttributeError, as what is not there does

    with pytest.raises(TypeError, match="got Unfinished, which has no has_area_weights; for a list"):
        torchcover.evaluate(frames=Unfinished(), cell_m=8.0)


def test_hills_do_not_change_what_is_seen_of_far_obstacles():
    """The same cities with and without hills; by z of a vehicle that pitches the road is an obstacle there."""
    urban = Scenario.load("urban")
    flat = urban.model_copy(update={"traffic": urban.traffic.model_copy(update={"hill_height_std_m": 0.0})})
    settings = {"num_frames": 8, "cell_m": 1.0, "num_rays": 2048, "seed": 1}
    hilly, level = (torchcover.evaluate("front_roof_128", each, **settings) for each in (urban, flat))
    assert (hilly.record["band_frame"], hilly.coverage.band_frame) == ("ground", "ground")
    far = [
        {row["region"]: row["detection_0.4m"] for row in result.summary if row["band"] == "obstacle"}
        for result in (hilly, level)
    ]
    for region in ("80m", "160m"):
        assert abs(far[0][region] - far[1][region]) < 0.07  # of eight instants


def test_an_ego_that_leans_finds_the_same_numbers():
    """Walls up to 70 m away, level ground; by z of the vehicle half of what is called an obstacle is the ground."""
    places = [{"x_m": x, "y_m": y, "z_m": -1.0} for x, y in ((12, 3), (30, -6), (50, 9), (70, -12))]
    bodies = [
        {"name": "floor", "ground": True, "shape": {"type": "plane", "size_m": [400, 400]}},
        {"name": "wall", "shape": {"type": "box", "size_m": [0.4, 4, 3]}, "poses": places},
    ]
    turning = {"channels": 128, "vertical_fov_deg": [-30, 10], "horizontal_fov_deg": 360, "columns": 720}
    lidar = {"name": "top", "type": "lidar", "mount": {"z_m": 2.0}, "max_range_m": 150, **turning}
    rig = Rig.model_validate({"name": "rig", "sensors": [lidar]})
    ask = RegionsOfInterest(regions={"80m": {"x_m": (0, 80), "y_m": (-20, 20)}})

    def obstacle(band_frame=None, **pose):
        ego = {"shape": {"type": "box", "size_m": [4, 2, 1.5]}, "pose": pose}
        scenario = Scenario.model_validate({"name": "walls", "ego": ego, "bodies": bodies})
        result = torchcover.evaluate(
            rig, scenario, num_frames=4, cell_m=4, num_rays=1024, regions=ask, band_frame=band_frame
        )
        (row,) = (row for row in result.summary if row["band"] == "obstacle")
        return np.array([row["detection_0.4m"], row["visible_m2"] / 10])

    level = obstacle()
    for pose in ({"pitch_deg": 2.0}, {"pitch_deg": -2.0}, {"roll_deg": 2.0}, {"roll_deg": -2.0}):
        np.testing.assert_allclose(obstacle(**pose), level, atol=0.06)
    assert obstacle("vehicle", pitch_deg=2.0)[0] < level[0] - 0.4


def test_a_band_frame_that_frames_do_not_have_is_refused():
    assert torchcover.evaluate("low", frames=Source(), cell_m=4.0).coverage.band_frame == "vehicle"
    with pytest.raises(ValueError, match=r"f0.* are unknown; use the band frame vehicle$"):
        torchcover.evaluate("low", frames=Source(), cell_m=4.0, band_frame="ground")
    with pytest.raises(ValueError, match="band_frame sea: `ground` or `vehicle` is needed"):
        torchcover.evaluate("front_roof_32", band_frame="sea")
