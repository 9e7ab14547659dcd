"""Readers of all formats return the scene that was written."""

import json
import pickle

import numpy as np
import pytest
import torch

from tests.recordings.drives import Drive
from tests.recordings.layouts import LAYOUTS
from tests.recordings.test_accumulated_reference import distances_m, transform_car, transform_wall
from torchcover.data import FORMATS, AccumulatedReference, RecordedFrames, open_recording
from torchcover.files import BadFileError
from torchcover.geometry import invert
from torchcover.recordings.formats.kitti import read_timestamps


@pytest.fixture(params=LAYOUTS)
def layout(request):
    return request.param


@pytest.fixture
def written(layout, tmp_path):
    """A drive, and the recording that its reader opens."""
    drive = Drive(steps=5, labelled=not layout.startswith("ros"))  # bags have no boxes
    return drive, open_recording(LAYOUTS[layout](drive, tmp_path))


def test_formats_are_recognized(layout, written):
    _, recording = written
    assert isinstance(recording, FORMATS[layout.partition(" ")[0]])
    assert len(recording.frame_names) == 5 == len(recording.times_s)
    assert list(recording.key_frames) == ([0, 2, 4] if layout == "nuscenes" else [0, 1, 2, 3, 4])
    assert all(set(of) <= set(recording.sensors) for of in recording.rigs.values())


def test_clouds_and_reference_match_the_scene(layout, written):
    drive, recording = written
    frames = RecordedFrames(recording, reference=AccumulatedReference(10.0, voxel_m=0.05))
    for number, index in enumerate(recording.key_frames):
        frame = frames[number]
        wall_m, car_m = transform_wall(drive, index), transform_car(drive, index)
        assert distances_m(frame.sensor, np.concatenate([wall_m, car_m])).max() < 1e-3
        # Moving points follow boxes, or clusters without labels, which are exact within the diagonal of a cell.
        world_m = np.concatenate([wall_m, car_m])
        assert distances_m(frame.reference, world_m).max() < (2e-3 if drive.labelled else 0.3 * 2**0.5)
        assert distances_m(world_m if drive.labelled else wall_m, frame.reference).max() < 0.05 * 3**0.5
        assert frame.name == recording.frame_names[index]


def test_poses_and_boxes_match_the_scene(layout, written):
    drive, recording = written
    for index in range(5):
        moved = invert(recording.get_world_T_vehicle(0)) @ recording.get_world_T_vehicle(index)
        np.testing.assert_allclose(
            moved, invert(drive.get_world_T_vehicle(0)) @ drive.get_world_T_vehicle(index), atol=1e-6
        )
        if not drive.labelled:
            assert recording.read_boxes(index) is None
            continue
        (row,) = recording.read_boxes(index).rows
        between = layout == "nuscenes" and index % 2  # half-way between two headings
        torch.testing.assert_close(row, drive.read_boxes(index).rows[0], atol=1e-2 if between else 1e-4, rtol=0)
        assert recording.read_boxes(index).ids == recording.read_boxes(0).ids != ("",)
        shares = {0: 0.2, 2: 0.7, 4: 0.2} if layout == "nuscenes" else {}  # between two, that of the first
        share = shares.get(index // 2 * 2, np.nan)
        assert recording.read_boxes(index).visibility.tolist() == pytest.approx([share], nan_ok=True)
        assert (
            "car" in recording.read_boxes(index).categories[0] or "vehicle" in recording.read_boxes(index).categories[0]
        )


def test_a_recording_survives_pickle(written):
    _, recording = written
    copy = RecordedFrames(pickle.loads(pickle.dumps(recording)), reference=AccumulatedReference(0.5))
    assert torch.equal(copy[1].reference, RecordedFrames(recording, reference=AccumulatedReference(0.5))[1].reference)


def test_readers_read_scans_only_on_request(written, monkeypatch):
    _, recording = written
    monkeypatch.setattr("torchcover.recordings.clouds.read_cloud", lambda path: pytest.fail("a scan was read"))
    assert recording.get_world_T_vehicle(1).shape == (4, 4)


@pytest.mark.parametrize(
    ("table", "change", "named"),
    [
        ("sample_data", lambda row: row.pop("timestamp"), "KeyError: 'timestamp'"),
        ("sample_data", lambda row: row.update(ego_pose_token="gone"), "no row has the token 'gone'"),
        ("sample_data", lambda row: row.update(filename="x/LIDAR_TOP/../../a.bin"), "which is not within it"),
        ("ego_pose", lambda row: row.update(rotation=[0, 0, 0, 0]), "norm 0"),
        ("sample_annotation", lambda row: row.pop("size"), "KeyError: 'size'"),
        ("sample_annotation", lambda row: row.update(size=[{}, 4.0, 1.5]), "'dict'"),
        ("sample_annotation", lambda row: row.update(size=[10**400, 4.0, 1.5]), "too large"),
        ("sample_annotation", lambda row: row.update(size=[float("nan"), 4.0, 1.5]), "three finite numbers"),
    ],
)
def test_inconsistent_tables_are_bad_files(tmp_path, table, change, named):
    root = LAYOUTS["nuscenes"](Drive(steps=3), tmp_path)
    path = root / "v1.0-mini" / f"{table}.json"
    rows = json.loads(path.read_text())
    change(rows[0])
    path.write_text(json.dumps(rows))
    with pytest.raises(BadFileError, match=named) as told:
        open_recording(root).read_boxes(0)
    assert str(root) in str(told.value)


def test_kitti_times_have_no_time_zone(tmp_path):
    (tmp_path / "timestamps.txt").write_text("2011-09-26 13:02:25+02\n")
    with pytest.raises(
        BadFileError, match=r"lines of date and time are needed|parsing timezone aware"
    ):  # as NumPy says
        read_timestamps(tmp_path / "timestamps.txt", [0])


@pytest.mark.parametrize("stamps", ["a line for each frame", "blank lines", "a line for each scan"])
@pytest.mark.parametrize("gone", [(1, 2), (0, 3)])
def test_frame_numbers_of_kitti_identify_tracklets_and_times(tmp_path, stamps, gone):
    path = LAYOUTS["kitti_raw"](Drive(steps=6), tmp_path)
    whole = open_recording(path)
    times = path / "velodyne_points" / "timestamps.txt"
    lines = times.read_text().splitlines(keepends=True)
    for number in gone:
        for folder, suffix in (("velodyne_points", "bin"), ("oxts", "txt")):
            (path / folder / "data" / f"{number:010d}.{suffix}").unlink()
    if stamps != "a line for each frame":
        blank = "\n" if stamps == "blank lines" else ""
        times.write_text("".join(blank if number in gone else line for number, line in enumerate(lines)))
    left = [number for number in range(6) if number not in gone]
    partial = open_recording(path)
    np.testing.assert_allclose(partial.times_s, whole.times_s[left] - whole.times_s[left[0]], atol=1e-6)
    for index, number in enumerate(left):
        torch.testing.assert_close(partial.read_boxes(index).rows, whole.read_boxes(number).rows)


def remove_second_pose(layout, path):
    if layout == "kitti_raw":
        (path / "oxts" / "data" / "0000000001.txt").unlink()
        return
    from pyarrow import feather

    table = feather.read_table(path / "city_SE3_egovehicle.feather")
    kept = np.arange(len(table)) != np.argsort(table["timestamp_ns"].to_numpy())[1]
    feather.write_feather(table.filter(kept), str(path / "city_SE3_egovehicle.feather"))


@pytest.mark.parametrize("layout", ["kitti_raw", "argoverse2"])
def test_missing_pose_excludes_only_its_sweep(layout, tmp_path):
    drive = Drive(steps=4)
    path = LAYOUTS[layout](drive, tmp_path)
    whole = open_recording(path)
    remove_second_pose(layout, path)
    with pytest.warns(UserWarning, match=r"1 of 4 sweeps are excluded, since there is no pose .* first is "):
        partial = open_recording(path)
    assert list(partial.frame_names) == [whole.frame_names[index] for index in (0, 2, 3)]
    np.testing.assert_allclose(partial.times_s, whole.times_s[[0, 2, 3]], atol=1e-6)
    for index, number in enumerate((0, 2, 3)):
        np.testing.assert_allclose(partial.get_world_T_vehicle(index), whole.get_world_T_vehicle(number))
        np.testing.assert_array_equal(
            partial.read_scan(whole.sensors[0], index).points_m, whole.read_scan(whole.sensors[0], number).points_m
        )
        torch.testing.assert_close(partial.read_boxes(index).rows, whole.read_boxes(number).rows)


def test_kitti_scans_need_poses_of_their_time(tmp_path):
    path = LAYOUTS["kitti_raw"](Drive(steps=3), tmp_path)
    stamps = (path / "velodyne_points" / "timestamps.txt").read_text()
    (path / "oxts" / "timestamps.txt").write_text(stamps)
    open_recording(path)
    (path / "oxts" / "timestamps.txt").write_text(stamps.replace("2018", "2017"))
    with pytest.raises(ValueError, match=r"apart; take the drive's synced\+rectified"):
        open_recording(path)
