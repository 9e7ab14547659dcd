import os
import pickle

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from tests.recordings.drives import Drive
from torchcover.data import AccumulatedReference, BadFrameError, RecordedFrames, collate_frames
from torchcover.geometry.rigid import build_transform, convert_euler_to_rotation, transform_points

WHY = ("nonfinite", "no_return", "ego_vehicle")
CLOUD = np.array([[1.0, 2.0, 3.0], [-4.0, 5.0, 0.5]], dtype=np.float32)


def record(folder, frames, **sources):
    """A recording in which both sides of every frame hold `CLOUD`, or what `sources` says."""
    for source in ("sensor", "reference"):
        (folder / source).mkdir(parents=True)
        for name in frames:
            np.save(folder / source / f"{name}.npy", sources.get(source, CLOUD))
    return folder


def record_rigs(folder, **rigs):
    """A recording of two frames of several rigs."""
    record(folder, ["f2", "f10"])
    (folder / "sensor").rename(folder / "aside")
    for rig, cloud in rigs.items():
        (folder / "rigs" / rig).mkdir(parents=True)
        for name in ("f2", "f10"):
            np.save(folder / "rigs" / rig / f"{name}.npy", cloud)
    return folder


def write_poses(folder, **vehicle_T):
    lines = [f"{source}:\n  vehicle_T_sensor: {matrix.tolist()}\n" for source, matrix in vehicle_T.items()]
    (folder / "frames.yaml").write_text("".join(lines))


def test_frames_come_in_natural_order_with_their_names(tmp_path):
    names = ["frame10", "frame2", "frame2b", "1_left10", "1_left9", "frame", "Frame1"]
    frames = RecordedFrames(record(tmp_path, names))
    assert frames.frame_names == ("1_left9", "1_left10", "Frame1", "frame", "frame2", "frame2b", "frame10")
    assert len(frames) == 7
    assert [(frame.index, frame.name) for frame in frames] == list(enumerate(frames.frame_names))


def test_a_frame_is_two_float32_clouds_with_counts(tmp_path):
    reference = np.array([[0.0, 1.0, 2.0]])
    frame = RecordedFrames(record(tmp_path, ["a"], reference=reference))[0]
    torch.testing.assert_close(frame.sensor, torch.from_numpy(CLOUD), rtol=0, atol=0)
    torch.testing.assert_close(frame.reference, torch.tensor([[0.0, 1.0, 2.0]]), rtol=0, atol=0)
    assert frame.sensor.dtype == frame.reference.dtype == torch.float32
    assert set(frame.counts) == {f"{side}_{why}" for side in ("sensor", "reference") for why in WHY}
    assert not any(frame.counts.values())


def test_sides_may_differ_in_format_and_suffix(tmp_path):
    record(tmp_path, [])
    np.full((3, 5), 7.0, dtype="<f4").tofile(tmp_path / "sensor" / "LIDAR_TOP__123.pcd.bin")
    (tmp_path / "reference" / "LIDAR_TOP__123.xyz").write_text("1 2 3\n")
    (tmp_path / "reference" / ".DS_Store").write_bytes(b"\0")
    (frame,) = RecordedFrames(str(tmp_path))
    assert (frame.name, frame.sensor.shape, frame.reference.tolist()) == ("LIDAR_TOP__123", (3, 3), [[1, 2, 3]])


def test_nonfinite_points_are_excluded_and_counted(tmp_path):
    sensor = np.array([[np.nan, 0, 0], [1, 2, 3], [0, np.inf, 0], [0, 0, -np.inf]])
    reference = np.array([[4.0, 5, 6], [np.nan, np.nan, np.nan]])
    record(tmp_path, ["a"], sensor=sensor, reference=reference)
    write_poses(tmp_path, sensor=np.eye(4), reference=np.eye(4))
    frame = RecordedFrames(tmp_path)[0]
    assert frame.sensor.tolist() == [[1, 2, 3]]
    assert frame.reference.tolist() == [[4, 5, 6]]
    counted = {name: count for name, count in frame.counts.items() if count}
    assert counted == {"sensor_nonfinite": 3, "reference_nonfinite": 1}


def test_only_an_empty_reference_is_an_error(tmp_path):
    blind = RecordedFrames(record(tmp_path / "blind", ["a"], sensor=CLOUD[:0]))[0]
    assert blind.sensor.shape == (0, 3)
    assert blind.reference.shape == (2, 3)
    frames = RecordedFrames(record(tmp_path / "nothing", ["a"], reference=CLOUD[:0]))
    with pytest.raises(BadFrameError, match=r"^a \(frame 0\): .*a\.npy: the reference cloud has no points"):
        frames[0]


def test_utm_clouds_are_transformed_before_they_become_float32(tmp_path):
    vehicle_T_world = build_transform(convert_euler_to_rotation(33.0, 0.0, 0.0), [0.0, 0.0, 0.0])
    ego_m = np.array([513248.123, 5403655.456, 260.389])
    vehicle_T_world[:3, 3] = -vehicle_T_world[:3, :3] @ ego_m
    near_m = np.array([[10.001, -3.002, 1.003], [0.5, 60.25, -1.5]])
    record(tmp_path, ["a"], sensor=near_m + ego_m, reference=near_m + ego_m)
    write_poses(tmp_path, sensor=vehicle_T_world, reference=vehicle_T_world)
    frame = RecordedFrames(tmp_path)[0]
    expected = transform_points(build_transform(vehicle_T_world[:3, :3], [0, 0, 0]), near_m)
    np.testing.assert_allclose(frame.sensor, expected, atol=1e-5)
    np.testing.assert_allclose(frame.reference, expected, atol=1e-5)


@pytest.mark.parametrize("far_m", [[513248.123, 5403655.456, 260.389], [1e300, 0, 0], [0, 0, -1.1e5]])
def test_coordinates_that_float32_cannot_hold_are_an_error(tmp_path, far_m):
    frames = RecordedFrames(record(tmp_path, ["a"], sensor=np.array([[0.0, 0, 0], far_m])))
    with pytest.raises(BadFrameError, match=r"a coordinate of .* m in the vehicle frame.*give the pose"):
        frames[0]


def test_indices_count_from_both_ends_and_stop_there(tmp_path):
    frames = RecordedFrames(record(tmp_path, ["a", "b", "c"]))
    assert (frames[-1].name, frames[-1].index) == ("c", 2)
    assert frames[np.int64(1)].name == "b"
    for index in (3, -4):
        with pytest.raises(IndexError, match=f"frame {index} of 3"):
            frames[index]


def test_missing_folders_and_empty_ones(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"gone: no such recording"):
        RecordedFrames(tmp_path / "gone")
    with pytest.raises(ValueError, match=r"of no known format; known are .*folder: sensor/FRAME"):
        RecordedFrames(tmp_path)
    (tmp_path / "sensor").mkdir()
    with pytest.raises(ValueError, match=r"no frames; sensor/ are empty"):
        RecordedFrames(tmp_path)
    (tmp_path / "reference").mkdir()
    with pytest.raises(ValueError, match=r"no frames; sensor/ and reference/ are empty"):
        RecordedFrames(tmp_path)
    (tmp_path / "sensor").rename(tmp_path / "rigs")
    with pytest.raises(ValueError, match=r"rigs: no rig; each has a folder rigs/NAME/ of its own"):
        RecordedFrames(tmp_path)


def test_names_of_one_side_are_listed(tmp_path):
    record(tmp_path, ["a"])
    for number in (1, 2, 10, 3, 4, 5, 6):
        np.save(tmp_path / "sensor" / f"s{number}.npy", CLOUD)
    np.save(tmp_path / "reference" / "r.npy", CLOUD)
    message = (
        r"sensor/ and reference/; 1 missing in sensor/ \(r\) and 7 missing in reference/ \(s1, s2, s3, s4, s5, \.+\)$"
    )
    with pytest.raises(ValueError, match=message):
        RecordedFrames(tmp_path)


def test_duplicate_names_and_other_files_are_refused(tmp_path):
    record(tmp_path, ["a"])
    (tmp_path / "sensor" / "a.xyz").write_text("1 2 3")
    with pytest.raises(ValueError, match=r"sensor: two files for the frame a: a\.npy and a\.xyz"):
        RecordedFrames(tmp_path)
    (tmp_path / "sensor" / "a.xyz").unlink()
    (tmp_path / "reference" / "b.e57").write_bytes(b"ASTM-E57")
    with pytest.raises(ValueError, match=r"b\.e57: not a cloud; allowed are files ending in \.npy, "):
        RecordedFrames(tmp_path)
    (tmp_path / "reference" / "b.e57").unlink()
    (tmp_path / "reference" / "b.npy").mkdir()
    with pytest.raises(ValueError, match=r"b\.npy: not a cloud"):
        RecordedFrames(tmp_path)


MATRIX = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"an empty file \(0 bytes\); a file of poses is needed"),
        ("{", r"not a YAML file"),
        ("# nothing", r"got NoneType, not a mapping; allowed are sensor, "),
        ("- 1", r"got list, not a mapping"),
        ("sensor: {", r"not a YAML file: .*line 1"),
        ("\x00", r"not a YAML file"),
        (f"lidar: {{vehicle_T_sensor: {MATRIX}}}", r"lidar: unknown key; allowed are sensor"),
        (f"sensor: {{vehicle_T_lidar: {MATRIX}}}", r"sensor\.vehicle_T_lidar: unknown key"),
        ("reference: {vehicle_T_sensor: 5}", r"reference\.vehicle_T_sensor: a list is needed"),
        ("sensor: {vehicle_T_sensor: [[1, a]]}", r"sensor\.vehicle_T_sensor\.0\.1: a number is needed"),
        ("sensor: {vehicle_T_sensor: [[1, 0], [0]]}", r"sensor\.vehicle_T_sensor: a 4x4 matrix of numbers"),
        (f"sensor: {{vehicle_T_sensor: {MATRIX[:3]}}}", r"sensor\.vehicle_T_sensor: a 4x4 matrix is needed"),
        ("sensor: {min_range_m: -1}", r"sensor\.min_range_m: a number of at least 0"),
        ("sensor: {min_range_m: 1}", r"sensor\.min_range_m: it needs vehicle_T_sensor"),
        ("sensor: {flip_y: 1}", r"sensor\.flip_y: true or false is needed"),
        ("sensors: {roof: {}}", r"sensors\.roof: the folder sensors/roof/ does not exist in the recording"),
        ("reference: {area_weights: m2}", r"reference\.area_weights: true or false is needed"),
        (
            "reference: {weight_kind: density}",
            r"reference\.weight_kind: unknown key.* for the reference also area_weights",
        ),
        ("sensor: {area_weights: true}", r"sensor\.area_weights: unknown key"),
        ("vehicle: {lower_m: [0, 0, 0]}", r"vehicle\.upper_m: a value is needed; the key is missing"),
        ("vehicle: {lower_m: [0, 0], upper_m: [1, 1, 1]}", r"vehicle\.lower_m: a list of at least 3 items"),
        ("vehicle: {lower_m: [0, 0, .nan], upper_m: [1, 1, 1]}", r"vehicle\.lower_m\.2: a finite"),
        ("vehicle: {lower_m: [0, 0, 1], upper_m: [1, 1, 1]}", r"vehicle: a box needs lower < upper on every axis"),
        (f"reference: {{vehicle_T_sensor: {[[2, 0, 0, 0], *MATRIX[1:]]}}}", r"reference\.vehicle_T_sensor: not a rig"),
    ],
)
def test_a_bad_frames_yaml_names_file_and_field(tmp_path, text, message):
    (record(tmp_path, ["a"]) / "frames.yaml").write_text(text)
    with pytest.raises(ValueError, match=rf"frames\.yaml: {message}") as caught:
        RecordedFrames(tmp_path)
    assert "\n" not in str(caught.value)


def spoiled(folder):
    """Five frames, of which f2 (truncated) and f4 (no finite point) are bad."""
    record(folder, ["f0", "f1", "f2", "f3", "f4"])
    os.truncate(folder / "sensor" / "f2.npy", 140)
    np.save(folder / "reference" / "f4.npy", np.full((3, 3), np.nan))
    return RecordedFrames(folder)


def test_bad_frames_name_themselves_and_spare_others(tmp_path):
    frames = spoiled(tmp_path)
    with pytest.raises(BadFrameError, match=r"^f2 \(frame 2\): .*sensor.f2\.npy: .* 12 bytes follow it$") as caught:
        frames[2]
    assert (caught.value.name, caught.value.index) == ("f2", 2)
    with pytest.raises(BadFrameError, match=r"^f4 \(frame 4\): .*reference.f4\.npy: none of the 3 points is finite"):
        frames[4]
    assert frames[3].name == "f3"


def test_dataset_and_error_survive_pickle(tmp_path):
    frames = pickle.loads(pickle.dumps(spoiled(tmp_path)))
    assert frames[1].sensor.tolist() == CLOUD.tolist()
    with pytest.raises(BadFrameError) as caught:
        frames[2]
    copy = pickle.loads(pickle.dumps(caught.value))
    assert (str(copy), copy.name, copy.index) == (str(caught.value), "f2", 2)


@pytest.mark.parametrize("workers", [0, 1])
def test_callers_skip_bad_frames_with_workers(tmp_path, workers):
    loader = DataLoader(spoiled(tmp_path), batch_size=1, collate_fn=collate_frames, num_workers=workers)
    batches, seen, skipped = iter(loader), [], []
    while True:
        try:
            seen += [frame.name for frame in next(batches).frames]
        except BadFrameError as error:
            skipped.append(error)
        except StopIteration:
            break
    assert seen == ["f0", "f1", "f3"]
    assert [(error.name, error.index) for error in skipped] == [("f2", 2), ("f4", 4)]
    assert [str(error).splitlines()[0].split(":")[0] for error in skipped] == ["f2 (frame 2)", "f4 (frame 4)"]
    assert str(skipped[0]).endswith("12 bytes follow it")


def test_rigs_share_a_reference_with_own_poses(tmp_path):
    nowhere = np.array([[np.nan, 0, 0], [1.0, 2.0, 3.0]])
    frames = RecordedFrames(record_rigs(tmp_path, rig10=CLOUD, rig2=nowhere))
    assert frames.metadata.rigs == ("rig2", "rig10")
    assert frames.frame_names == ("f2", "f10")
    assert frames[0].clouds["rig10"].tolist() == CLOUD.tolist()
    assert {name: count for name, count in frames[1].counts.items() if count} == {"sensor_nonfinite": 1}
    turned = build_transform(convert_euler_to_rotation(90.0, 0.0, 0.0), [1.0, 0.0, 0.0])
    (tmp_path / "frames.yaml").write_text(f"rigs: {{rig2: {{vehicle_T_sensor: {turned.tolist()}}}}}")
    frame = RecordedFrames(tmp_path)[0]
    np.testing.assert_allclose(frame.clouds["rig2"], [[-1.0, 1.0, 3.0]], atol=1e-6)
    assert frame.clouds["rig10"].tolist() == frame.reference.tolist() == CLOUD.tolist()


def test_errors_of_several_rigs_are_named(tmp_path):
    folder = record_rigs(tmp_path, a=CLOUD, b=CLOUD)
    (folder / "frames.yaml").write_text(f"rigs: {{c: {{vehicle_T_sensor: {MATRIX}}}}}")
    with pytest.raises(ValueError, match=r"frames\.yaml: rigs\.c: the folder rigs/c/ does not exist in the recording"):
        RecordedFrames(folder)
    (folder / "frames.yaml").write_text(f"rigs: {{b: {{vehicle_T_sensor: {MATRIX[:3]}}}}}")
    with pytest.raises(ValueError, match=r"frames\.yaml: rigs\.b\.vehicle_T_sensor: a 4x4 matrix is needed"):
        RecordedFrames(folder)
    (folder / "frames.yaml").unlink()
    (folder / "rigs" / "b" / "f2.npy").write_bytes(b"rubbish")
    with pytest.raises(BadFrameError, match=r"^f2 \(frame 0\): .*f2\.npy"):
        RecordedFrames(folder)[0]
    (folder / "rigs" / "b" / "f2.npy").unlink()
    with pytest.raises(ValueError, match=r"file in rigs/a/ and rigs/b/ and reference/; 1 missing in rigs/b/ \(f2\)$"):
        RecordedFrames(folder)
    (folder / "sensor").mkdir()
    with pytest.raises(ValueError, match=r"both sensor/ and rigs/; sensor/ is for one sensor, sensors/NAME/ for"):
        RecordedFrames(folder)


def test_frames_of_one_window_share_a_block():
    drive = Drive(steps=30)  # 0.1 s apart

    def places(window_s, **changed):
        for name, value in changed.items():
            setattr(drive, name, value)
        frames = RecordedFrames(drive, reference=AccumulatedReference(window_s))
        return [frames[index].block_index for index in range(len(frames))]

    assert places(0.5) == [index // 5 for index in range(30)]
    assert places(5.0) == [0] * 30  # too short for an error
    # A pause is no room for more blocks; an instant that is seen again is at its first place.
    later_s = drive.times_s + np.where(np.arange(30) < 15, 0.0, 1e6)
    assert places(0.5, times_s=later_s) == [index // 5 for index in range(30)]
    assert places(0.5, block_indices=[*range(15), *range(15)]) == 2 * [index // 5 for index in range(15)]
