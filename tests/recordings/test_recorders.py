"""Simulated frames that are written as recordings and read again."""

import contextlib
import shutil

import numpy as np
import pytest
import torch

from tests.killing import run_in_fork
from torchcover import Rig
from torchcover.data import RecordedFrames, SimulatedFrames, open_recording, write_recording
from torchcover.detection import measure_box_visibility
from torchcover.files import RECORDING, WRITING, BadFileError, read_manifest
from torchcover.geometry import convert_euler_to_rotation, convert_quaternion_to_rotation
from torchcover.geometry.rigid import convert_rotation_to_quaternion
from torchcover.recordings.formats.kitti import BODY, read_calibration, read_labels
from torchcover.recordings.recorders import NO_OBJECT_LABEL, KittiRecorder
from torchcover.simulation import SurfaceReference, writing

PATTERN = {"channels": 8, "vertical_fov_deg": (-30, 5), "horizontal_fov_deg": 360, "columns": 60, "max_range_m": 60}
# Sensors are not in alphabetical order, and their noise depends on the order.
FRONT = {
    "name": "z front",
    "mount": {"x_m": 2.6, "z_m": 0.8, "pitch_deg": 3, "yaw_deg": 20},
    **PATTERN,
    "range_noise_m": 0.05,
}
REAR = {"name": "a rear", "mount": {"x_m": -2.6, "z_m": 0.9, "yaw_deg": 170}, **PATTERN, "dropout": 0.2}


def simulated(*sensors, scenario="parking", steps=2, **others):
    rig = Rig.model_validate({"name": "both", "sensors": sensors})
    reference_sensor = SurfaceReference((((-20.0, 40.0), (-10.0, 10.0)),), num_rays=512)
    others = {"boxes": True, "frame_interval_s": 45.0, "reference_sensor": reference_sensor, **others}
    return SimulatedFrames(scenario, rig, num_frames=steps, seed=5, **others)


@pytest.fixture(scope="module")
def both():
    return simulated(FRONT, REAR, steps=3)


def in_order(points):
    return points[np.lexsort(points.numpy().T)]


def test_plain_folder_preserves_written_frames(both, tmp_path):
    write_recording(both, tmp_path)
    again = RecordedFrames(tmp_path)
    assert again.recording.sensors == ("a rear", "z front")
    assert again.metadata.has_area_weights
    assert len(again) == 3
    for written, read in zip(both, again, strict=True):
        assert len(read.sensor) == len(written.sensor) > 100
        torch.testing.assert_close(in_order(read.sensor), in_order(written.get_measured_points()), rtol=0, atol=1e-12)
        assert torch.equal(read.reference, written.reference)
        assert torch.equal(read.reference_weights, written.reference_weights)
        assert torch.equal(read.boxes.rows, written.boxes.rows)
        assert written.boxes.velocity_mps.isfinite().all()
        assert torch.equal(read.boxes.velocity_mps, written.boxes.velocity_mps)
        assert torch.equal(read.boxes.sampled_points, written.boxes.sampled_points)
        assert (read.boxes.ids, read.boxes.categories) == (written.boxes.ids, written.boxes.categories)
        # Of what was written it is unknown where it truly is: a point may leave a box that it was on.
        hits = [next(iter(frame.boxes.points_in_box.values())) for frame in (read, written)]
        assert (hits[0] - hits[1]).abs().max() <= 0.2 * max(hits[1].max(), 5)
        assert read.block_index == written.block_index
        assert sum(read.counts.values()) == 0  # nothing was lost on the way


def test_clouds_are_in_the_frame_of_their_sensor(both, tmp_path):
    write_recording(both, tmp_path)
    alone = simulated(FRONT, steps=3)[0].get_measured_points().numpy()
    points = np.load(tmp_path / "sensors" / "z front" / "000000.npy")
    assert len(points) == len(alone)
    range_m = np.linalg.norm(points, axis=1)
    elevation_deg = np.rad2deg(np.arcsin(points[:, 2] / range_m))
    rows_deg = np.linspace(-30, 5, 8)
    assert np.abs(elevation_deg[:, None] - rows_deg).min(axis=1).max() < 1e-3
    np.testing.assert_allclose(range_m, np.linalg.norm(alone - [2.6, 0.0, 0.8], axis=1), rtol=1e-6)


def test_poses_are_of_the_ego_and_cities_separate(both, tmp_path):
    write_recording(both, tmp_path)
    recording = open_recording(tmp_path)
    for index in range(3):
        geometry, step = both.simulator.get_scene_geometry(index)
        expected = geometry.scene.ego.trajectory.interpolate(step * geometry.scene.time_step_s)
        np.testing.assert_allclose(recording.get_world_T_vehicle(index), expected, atol=1e-12)
    apart_s, cities = np.diff(recording.times_s), np.diff(recording.block_indices)
    assert set(cities) == {0, 1}
    np.testing.assert_allclose(apart_s, 45.0 + 1000.0 * cities)
    body, ego = recording.ego_box, both.scenario.compute_ego_box()
    assert (body.upper_m, body.lower_m[:2]) == (ego.upper_m, ego.lower_m[:2])


@pytest.mark.parametrize("angles", [(0, 0, 0), (180, 0, 0), (33, -20, 170), (0, 90, 0), (-90, 0, 180), (1e-5, 0, 0)])
def test_quaternions_match_their_rotation(angles):
    rotation = convert_euler_to_rotation(*map(float, angles))
    wxyz = convert_rotation_to_quaternion(rotation)
    assert wxyz[0] >= 0
    np.testing.assert_allclose(convert_quaternion_to_rotation(wxyz), rotation, atol=1e-14)


def test_kitti_layout_is_read_as_kitti(tmp_path):
    frames = simulated(FRONT, steps=1)
    write_recording(frames, tmp_path / "training", "kitti")
    again = RecordedFrames(tmp_path)
    assert (again.metadata.rigs, again.frame_names) == (("kitti",), ("000000",))
    written, read = frames[0], again[0]
    # The reader excludes points inside KITTI's vehicle.
    points = written.get_measured_points().numpy().astype(np.float64)
    own = ((points > BODY.lower_m) & (points < BODY.upper_m)).all(axis=1)
    assert read.counts["sensor_ego_vehicle"] == own.sum()
    np.testing.assert_allclose(read.sensor, points[~own], atol=1e-5)
    np.testing.assert_allclose(read.reference, written.reference, atol=1e-5)
    torch.testing.assert_close(read.boxes.rows[:, :6], written.boxes.rows[:, :6], rtol=0, atol=1e-4)
    turned = read.boxes.yaw_rad - written.boxes.yaw_rad
    assert torch.sin(turned / 2).abs().max() < 1e-5
    assert read.boxes.categories == written.boxes.categories
    weights = written.reference_weights
    shares = measure_box_visibility(
        written.sensor, written.reference, written.boxes, reference_weights=weights
    ).share.numpy()
    said = read.boxes.visibility.numpy()
    assert (np.isnan(said) == np.isnan(shares)).all()
    known = np.flatnonzero(~np.isnan(shares))
    assert len(known) > 3
    assert said[known] == pytest.approx(np.array([0.2, 0.6, 0.9])[np.digitize(shares[known], [0.4, 0.8])])
    calibration = read_calibration(tmp_path / "training" / "calib" / "000000.txt")
    assert {"P2", "R0_rect", "Tr_velo_to_cam", "Tr_imu_to_velo"} <= calibration.keys()


def test_kitti_labels_are_in_the_camera_frame(tmp_path):
    frames = simulated(FRONT, steps=1)
    write_recording(frames, tmp_path, "kitti")
    labels = read_labels(tmp_path / "label_2" / "000000.txt")
    assert len(labels) == len(frames[0].boxes) > 5
    for (category, numbers), row in zip(labels, frames[0].boxes.rows.double().numpy(), strict=True):
        _, _, alpha, *_, height, width, length, x, y, z, turn = numbers
        assert category
        np.testing.assert_allclose([length, width, height], row[3:6], atol=1e-5)
        # The camera is 0.307 m behind the middle of the vehicle and 1.65 m high; its x points to the right, y down.
        np.testing.assert_allclose([x, y, z], [-row[1], 1.65 - (row[2] - row[5] / 2), row[0] + 0.307], atol=1e-5)
        np.testing.assert_allclose(np.exp(1j * alpha), np.exp(1j * (turn - np.arctan2(x, z))), atol=1e-5)
        assert abs(alpha) <= np.pi


def test_frame_without_objects_has_an_empty_list(tmp_path):
    frames = simulated(FRONT, steps=1)
    frames.simulator.compute_labels = lambda index: []
    for layout in ("folder", "kitti"):
        write_recording(frames, tmp_path / layout, layout)
        assert len(RecordedFrames(tmp_path / layout)[0].boxes) == 0
    assert (tmp_path / "kitti" / "label_2" / "000000.txt").read_text() == NO_OBJECT_LABEL + "\n"


def test_without_boxes_none_are_written(tmp_path):
    frames = simulated(FRONT, steps=1, boxes=False)
    for layout in ("folder", "kitti"):
        write_recording(frames, tmp_path / layout, layout)
        assert RecordedFrames(tmp_path / layout)[0].boxes is None


def test_unsupported_recordings_are_refused_before_the_first_frame(both, tmp_path, monkeypatch):
    monkeypatch.setattr(both.simulator, "simulate_frame", lambda index: pytest.fail("a step was simulated"))
    with pytest.raises(ValueError, match=r"format 'bag': recordings are written as folder or kitti"):
        write_recording(both, tmp_path, "bag")
    with pytest.raises(ValueError, match=r"format kitti: a rig of one LiDAR is needed; both has z front, a rear"):
        write_recording(both, tmp_path, "kitti")
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=r"not empty; a new or empty folder is needed"):
        write_recording(both, tmp_path)
    with pytest.raises(ValueError, match=r"file: a file; a new or empty folder is needed"):
        write_recording(both, tmp_path / "file")
    for name in ("a/b", "..", "", "reference"):
        with pytest.raises(ValueError, match=rf"sensor '{name}': a recording has a folder of this name"):
            write_recording(simulated({**FRONT, "name": name}), tmp_path / "new")
    several = SimulatedFrames("courtyard", rigs={"a": "front_roof_32", "b": "front_roof_32"}, num_frames=1)
    with pytest.raises(ValueError, match=r"a recording is of one rig; got a, b"):
        write_recording(several, tmp_path / "new")
    assert not (tmp_path / "new").exists()


@pytest.fixture
def simulated_once(both, monkeypatch):
    """The steps of `both`, which are not simulated again; which of them were asked for."""
    made, asked = [writing.build_frame_record(both, index) for index in range(len(both))], []
    monkeypatch.setattr(writing, "build_frame_record", lambda _, index: (asked.append(index), made[index])[1])
    return asked


def until(step, stop):
    """Passes on the numbers of steps, and does something before one of them."""

    def progress(steps):
        for index in steps:
            if index == step:
                stop()
            yield index

    return progress


def texts(folder):
    """Its files by name; what is in those that say no time."""
    files = [path for path in folder.rglob("[!.]*") if path.is_file() and path.name != RECORDING]
    return {path.relative_to(folder): path.suffix == ".npz" or path.read_bytes() for path in files}


@pytest.mark.parametrize("layout", ["folder", "kitti"])
def test_incomplete_recording_is_refused_and_can_be_resumed(both, simulated_once, tmp_path, monkeypatch, layout):
    if layout == "kitti":
        monkeypatch.setattr(KittiRecorder, "__init__", anything)
    write_recording(both, tmp_path / "whole", layout)
    simulated_once.clear()
    with pytest.raises(ZeroDivisionError):
        write_recording(both, tmp_path / "part", layout, progress=until(2, lambda: 1 / 0))
    with pytest.raises(
        ValueError, match=r"part: an incomplete recording with 2 frames; .* `torchcover record --resume`"
    ):
        open_recording(tmp_path / "part")
    with pytest.raises(ValueError, match=r"holds a part of a recording, 2 frames; continue it \(--resume\), or"):
        write_recording(both, tmp_path / "part", layout)
    write_recording(both, tmp_path / "part", layout, resume=True)
    write_recording(both, tmp_path / "part", layout, resume=True)  # there is nothing left to do
    assert simulated_once == [0, 1, 2]
    assert texts(tmp_path / "part") == texts(tmp_path / "whole")
    assert len(open_recording(tmp_path / "part").frame_names) == 3


def anything(recorder, add, setup, init=KittiRecorder.__init__):
    """Write two sensors in a layout for one, with the cloud of the first."""
    name = setup.lidar_names[0]
    init(recorder, add, setup._replace(mounts={name: setup.mounts[name]}, lidar_names=[name]))
    write = recorder.write
    recorder.write = lambda step: write(step._replace(clouds={name: step.clouds[name]}))


def test_different_recordings_cannot_be_resumed(both, simulated_once, tmp_path):
    with pytest.raises(ZeroDivisionError):
        write_recording(both, tmp_path / "part", progress=until(2, lambda: 1 / 0))
    write_recording(both, tmp_path / "whole")
    for folder in (tmp_path / "part", tmp_path / "whole"):
        with pytest.raises(ValueError, match=rf"{folder.name}: of another recording, with another rig both, boxes; ch"):
            write_recording(simulated(REAR, steps=3, boxes=False), folder, resume=True)
        with pytest.raises(ValueError, match=rf"{folder.name}: . frames are there; got 1; choose another folder"):
            write_recording(simulated(FRONT, REAR, steps=1), folder, resume=True)


def test_recordings_are_checked_against_their_manifest(tmp_path):
    frames = simulated(FRONT, steps=2)
    write_recording(frames, tmp_path / "training", "kitti")
    label = tmp_path / "training" / "label_2" / "000000.txt"
    label.write_text(label.read_text() + "\n")
    with pytest.warns(UserWarning, match=r"edited since it was recorded: label_2/000000.txt \(missing, or of another"):
        RecordedFrames(tmp_path)
    label.write_text(label.read_text()[:-1])
    for path in list(tmp_path.glob("training/*/000001.*")):
        shutil.copy(path, path.with_stem("000009"))
    with pytest.raises(ValueError, match=r"of 2 frames \(recording.json\), and 1 more are there, such as 000009; copy"):
        RecordedFrames(tmp_path)
    for path in tmp_path.glob("training/*/000001.*"):
        path.unlink()
    with pytest.raises(ValueError, match=r"of 2 frames \(recording.json\), and 1 are missing, such as 000001; copy or"):
        RecordedFrames(tmp_path)
    (tmp_path / "training" / "recording.json").write_text("[]")
    with pytest.raises(BadFileError, match=r"recording.json: a list of files with their sizes, and the names"):
        RecordedFrames(tmp_path)
    (tmp_path / "training" / "recording.json").unlink()  # as if another tool had written it
    assert len(open_recording(tmp_path).frame_names) == 2


def test_kill_at_any_file_operation_costs_one_frame(tmp_path, monkeypatch):
    frames = simulated(FRONT, scenario="courtyard", steps=2, frame_interval_s=0.1, boxes=False)
    made, content = [writing.build_frame_record(frames, index) for index in range(2)], frames.collect_content()
    monkeypatch.setattr(writing, "build_frame_record", lambda _, index: made[index])
    monkeypatch.setattr(SimulatedFrames, "collect_content", lambda _: content)
    whole, copies = tmp_path / "whole", tmp_path / "copies"
    count, code = run_in_fork(lambda: write_recording(frames, whole), copied=(whole, copies))
    assert (count > 40, code) == (True, 0)
    kept = set()
    for folder in (copies / str(at) for at in range(count)):
        manifest = read_manifest(folder / RECORDING) or {}
        if manifest.get(WRITING):
            with pytest.raises(ValueError, match="an incomplete recording"):
                open_recording(folder)
            kept.add(len(manifest.get("steps", ())))
        with contextlib.suppress(ValueError, FileNotFoundError):  # of nothing that is known: it had not begun
            assert len(open_recording(folder).frame_names) == 2
        write_recording(frames, folder, resume=True)
        assert texts(folder) == texts(whole)
    assert kept == {0, 1, 2}
