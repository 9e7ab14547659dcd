"""CARLA recordings: conversion to right-handed axes, and joining of partial revolutions."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

from tests.recordings.layouts import CARLA_BOX, table
from tests.recordings.test_accumulated_reference import distances_m
from torchcover.data import AccumulatedReference, BadFrameError, RecordedFrames, open_recording
from torchcover.files import BadFileError
from torchcover.geometry import transform_points
from torchcover.recordings.formats.carla import Carla

MOUNT = {"x": 0.7, "y": 0.4, "z": 1.6, "roll": 5.0, "pitch": 10.0, "yaw": 30.0}
POSE = ("x", "y", "z", "roll", "pitch", "yaw")


def carla_matrix(x, y, z, roll, pitch, yaw):
    """`carla.Transform.get_matrix`, as its documentation has it, in left-handed axes."""
    cy, sy, cr, sr, cp, sp = (f(np.deg2rad(angle)) for angle in (yaw, roll, pitch) for f in (np.cos, np.sin))
    return np.array(
        [
            [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr, x],
            [cp * sy, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr, y],
            [sp, -cp * sr, cp * cr, z],
            [0, 0, 0, 1],
        ]
    )


def mirrored(points):
    return points * [1, -1, 1]


WORLD = np.random.default_rng(0).uniform([-20, -20, 0], [20, 20, 4], (50, 3))  # right-handed, in the vehicle frame


def recorded(folder, *, reference=True, ids=("roof",)):
    """Two frames of the same world; the reference has another place in each."""
    sensors = [{"id": "front", "type": "sensor.camera.rgb"}]
    for name in ids:
        sensors.append({"id": name, "type": "sensor.lidar.ray_cast", **MOUNT, "range": "50", "channels": "64"})
        cloud = transform_points(np.linalg.inv(carla_matrix(**MOUNT)), mirrored(WORLD))
        (folder / name).mkdir(parents=True)
        for frame in ("8", "10"):
            np.save(folder / name / f"{frame}.npy", np.c_[cloud, np.ones(50)].astype(np.float32))
    if reference:
        sensors.append({"id": "reference", "type": "sensor.lidar.ray_cast"})
        (folder / "reference").mkdir()
        poses = {"8": (1.0, -0.5, 2.0, 45.0, -40.0, 170.0), "10": (0.0, 1.5, 1.0, -30.0, 20.0, -100.0)}
        for frame, pose in poses.items():
            cloud = transform_points(np.linalg.inv(carla_matrix(*pose)), mirrored(WORLD))
            np.save(folder / "reference" / f"{frame}.npy", cloud)
        table(folder / "reference" / "poses.csv", ("frame", *POSE), [[frame, *pose] for frame, pose in poses.items()])
    (folder / "sensors.json").write_text(json.dumps(sensors))
    return folder


def test_clouds_and_reference_match_the_scene(tmp_path):
    frames = RecordedFrames(recorded(tmp_path))
    assert isinstance(frames.recording, Carla)
    assert (frames.frame_names, frames.metadata.rigs) == (("8", "10"), ("carla",))
    for frame in frames:
        np.testing.assert_allclose(frame.sensor, WORLD, atol=1e-5)
        assert distances_m(frame.reference, WORLD).max() < 1e-5


def test_poses_become_right_handed_like_clouds(tmp_path):
    recorded(tmp_path, reference=False)
    rows = [("10", 0.5, 3.0, 4.0, 0.5, 1.0, -2.0, 120.0), ("8", 0.0, 1.0, 2.0, 0.0, 0.0, 0.0, -90.0)]
    table(tmp_path / "poses.csv", ("frame", "time_s", *POSE), rows)
    recording = open_recording(tmp_path)
    assert recording.times_s.tolist() == [0.0, 0.5]
    for index, row in enumerate(rows[::-1]):
        expected = mirrored(transform_points(carla_matrix(*row[2:]), mirrored(WORLD)))
        np.testing.assert_allclose(transform_points(recording.get_world_T_vehicle(index), WORLD), expected, atol=1e-12)
    assert len(RecordedFrames(recording)[0].reference) > 10  # of the other frame


def turning(folder, rotation_frequency, ticks_s=(0.0, 0.05, 0.1, 0.15, 0.2)):
    """A LiDAR at the vehicle's origin that sees one point of the world and one of the vehicle's own, x = 1, a tick."""
    (folder / "roof").mkdir(parents=True)
    listed = [{"id": "roof", "type": "sensor.lidar.ray_cast", "rotation_frequency": rotation_frequency}]
    (folder / "sensors.json").write_text(json.dumps(listed))
    rows = []
    for tick, time_s in enumerate(ticks_s):
        rows.append((tick, time_s, 2.0 * tick, 0.0, 0.0, 0.0, 0.0, 90.0))  # drives on, its nose to the right
        np.save(folder / "roof" / f"{tick}.npy", np.array([[0.0, 10.0 + tick, 0.5], [1.0, 0.0, 0.5]]))
    table(folder / "poses.csv", ("frame", "time_s", *POSE), rows)
    box = {"location": {"x": 0, "y": 0, "z": 0.75}, "extent": {"x": 2, "y": 1, "z": 0.75}}
    (folder / "vehicle.json").write_text(json.dumps(box))
    return folder


def test_parts_of_a_revolution_are_joined_by_poses(tmp_path):
    recording = open_recording(turning(tmp_path, 10.0))
    assert (recording.frame_names, recording.times_s.tolist()) == (("1", "3"), [0.05, 0.15])  # the fifth makes no turn
    for index, last in enumerate((1, 3)):
        scan = recording.read_scan("roof", index)
        assert scan.vehicle_T_sensor is None
        # Nose to the right: the world's x is the vehicle's left. The earlier part is 2 m further back.
        expected = [[0.0, -10.0 - last, 0.5], [1, 0, 0.5], [0.0, -10.0 - (last - 1) - 2.0, 0.5], [1, 0, 0.5]]
        np.testing.assert_allclose(scan.points_m, expected, atol=1e-12)
        np.testing.assert_allclose(recording.get_world_T_vehicle(index)[:3, 3], [2.0 * last, 0.0, 0.0], atol=1e-12)
    frames = RecordedFrames(recording, reference=AccumulatedReference(1.0))
    assert len(frames[0].sensor) == 2
    assert frames[0].counts["sensor_ego_vehicle"] == 2


@pytest.mark.parametrize(
    ("turns", "names"), [(20.0, "01234"), (19.9, "01234"), (7.0, "2"), (4.0, "4"), (50.0, "01234")]
)
def test_frame_joins_all_files_of_a_revolution(tmp_path, turns, names):
    assert "".join(open_recording(turning(tmp_path, turns)).frame_names) == names


def test_too_few_files_for_a_revolution(tmp_path):
    with pytest.raises(ValueError, match=r"a revolution of its LiDARs takes 20 files; there are 5"):
        open_recording(turning(tmp_path, 1.0))


def test_sectors_without_times_warn(tmp_path):
    turning(tmp_path, 10.0)
    (tmp_path / "poses.csv").unlink()
    with pytest.warns(UserWarning, match=r"0\.npy: roof: no points in 270 degrees; if a file holds a part of a rev"):
        open_recording(tmp_path)
    recorded(tmp_path / "whole")
    listed = json.loads((tmp_path / "whole" / "sensors.json").read_text())
    listed[1]["rotation_frequency"] = 10
    (tmp_path / "whole" / "sensors.json").write_text(json.dumps(listed))
    open_recording(tmp_path / "whole")  # 50 points everywhere around


CAMERA = {"id": "head", "type": "sensor.camera.depth", "image_size_x": "4", "image_size_y": "3", "fov": "80", **MOUNT}


def photographed(folder, codes, **changed):
    """A depth image with these codes in 24 bits, as CARLA's `save_to_disk` writes it."""
    (folder / "head").mkdir(parents=True)
    (folder / "sensors.json").write_text(json.dumps([{**CAMERA, **changed}]))
    bits = np.array(codes)[..., None] >> np.array([0, 8, 16])
    image = np.concatenate([(bits & 255).astype(np.uint8), np.full((*bits.shape[:2], 1), 255, np.uint8)], axis=2)
    Image.fromarray(image).save(folder / "head" / "000.png")
    return folder


def test_depth_pixels_have_the_positions_of_carla(tmp_path):
    codes = np.random.default_rng(1).integers(10_000, 2_000_000, (3, 4))
    codes[0, 1], codes[2, 2] = 2**24 - 1, 0  # sky, and nothing at all
    recording = open_recording(photographed(tmp_path, codes))
    (seen,) = [transform_points(scan.vehicle_T_sensor, scan.points_m) for scan in [recording.read_scan("head", 0)]]
    focal = 4 / (2 * np.tan(np.deg2rad(80) / 2))
    expected = []
    for (row, column), code in np.ndenumerate(codes):
        if 0 < code < 2**24 - 1:
            depth_m = 1000 * code / (2**24 - 1)
            right, down = (column + 0.5 - 2) / focal, (row + 0.5 - 1.5) / focal
            expected.append([depth_m, depth_m * right, -depth_m * down])
    np.testing.assert_allclose(seen, mirrored(transform_points(carla_matrix(**MOUNT), np.array(expected))), atol=1e-4)


def test_camera_and_image_sizes_have_to_agree(tmp_path):
    photographed(tmp_path, np.ones((5, 4), int))
    with pytest.raises(BadFileError, match=r"head.000\.png: .*depth must be \(3, 4\)"):
        open_recording(tmp_path).read_scan("head", 0)
    photographed(tmp_path / "other", np.ones((3, 4), int), fov=None)
    with pytest.raises(ValueError, match=r"sensors\.json: .*a camera needs width .* and fov, in degrees"):
        open_recording(tmp_path / "other")
    photographed(tmp_path / "bent", np.ones((3, 4), int), lens_kcube="0.2", lens_k="-1.0")
    with pytest.raises(ValueError, match=r"sensors\.json: .*lens_kcube: distorted depth images are not read"):
        open_recording(tmp_path / "bent")
    photographed(tmp_path / "cloud", np.ones((3, 4), int))
    np.save(tmp_path / "cloud" / "head" / "001.npy", np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"001\.npy: not a depth image; allowed are files ending in \.png"):
        open_recording(tmp_path / "cloud")


def test_objects_are_in_the_vehicle_frame(tmp_path):
    turning(tmp_path, 20.0)
    row = ["17", "walker", 4.0, 10.0, 1.0, 0.0, 0.0, 90.0, 0.3, 0.2, 0.9]
    for tick in range(5):
        table(tmp_path / "boxes" / f"{tick}.csv", (*CARLA_BOX, "velocity_x", "velocity_y"), [[*row, 3.0, 0.5]])
    boxes = open_recording(tmp_path).read_boxes(1)  # the vehicle is at x = 2, its nose to the right
    torch.testing.assert_close(boxes.rows, torch.tensor([[10.0, 2.0, 1.0, 0.6, 0.4, 1.8, 0.0]]), atol=1e-6, rtol=0)
    torch.testing.assert_close(boxes.velocity_mps, torch.tensor([[0.5, 3.0]]), atol=1e-6, rtol=0)
    assert (boxes.ids, boxes.categories) == (("17",), ("walker",))
    (tmp_path / "poses.csv").unlink()
    with pytest.raises(ValueError, match=r"boxes/ are in the world; poses\.csv is needed"):
        open_recording(tmp_path)


def test_objects_without_size_are_excluded_alone(tmp_path):
    turning(tmp_path, 20.0)
    rows = [
        [name, "bike", 4.0, 10.0, 1.0, 0.0, 0.0, 90.0, 0.3, width, 0.9] for name, width in (("17", 0.0), ("18", 0.2))
    ]
    for tick in range(5):
        table(tmp_path / "boxes" / f"{tick}.csv", CARLA_BOX, rows)
    with pytest.warns(UserWarning, match=r"without a size are excluded: 1 of 2 .* 17 \(bike\): .* extent_y 0"):
        assert open_recording(tmp_path).read_boxes(1).ids == ("18",)


@pytest.mark.parametrize(
    ("box", "message"),
    [
        (
            "{location: {x: 0, y: 0, z: 1}, extent: {x: 2, y: 1, z: 1}, rotation: {pitch: 0, yaw: 90, roll: 0}}",
            "rotation: a box aligned with the vehicle's axes is needed",
        ),
        ("{extent: {x: 1, y: 1, z: 1}}", "location: a value is needed; the key is missing"),
        ("[]", "location and extent, each with x, y, z"),
        ("{location: {x: 0, y: 0, z: 0}, extent: {x: 0, y: 1, z: 1}}", "lower < upper on every axis"),
    ],
)
def test_bad_vehicle_boxes_are_refused(tmp_path, box, message):
    (recorded(tmp_path) / "vehicle.json").write_text(box)
    with pytest.raises(BadFileError, match=rf"vehicle\.json: .*{message}"):
        open_recording(tmp_path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[]", r"LiDARs \(.*\) or depth cameras \(.*\) of different id are needed; got none"),
        ("{}", r"a list of sensors with id and type is needed; a list is needed"),
        ('[{"id": "../a", "type": "sensor.lidar.ray_cast"}]', r"0\.id: a text of the pattern"),
        ('[{"type": "sensor.lidar.ray_cast"}]', r"0\.id: a value is needed; the key is missing"),
        ('[{"id": "roof", "type": "sensor.lidar.ray_cast", "yaw": .nan}]', r"0\.yaw: a finite number"),
        ('[{"id": "reference", "type": "sensor.lidar.ray_cast"}]', r"of different id are needed; got reference"),
    ],
)
def test_bad_sensor_list_names_file_and_field(tmp_path, content, message):
    (recorded(tmp_path) / "sensors.json").write_text(content)
    with pytest.raises(ValueError, match=rf"sensors\.json: .*{message}"):
        RecordedFrames(tmp_path)


def test_missing_files_are_named(tmp_path):
    recorded(tmp_path, ids=("roof", "left"))
    (tmp_path / "reference" / "poses.csv").write_text("frame,x,y,z,roll,pitch,yaw\n8,0,0,0,0,0,0\n")
    with pytest.raises(ValueError, match=r"reference.poses\.csv: each frame needs one row; 1 are missing \(10\)"):
        RecordedFrames(tmp_path)
    (tmp_path / "reference" / "poses.csv").unlink()
    (tmp_path / "roof" / "8.npy").write_bytes(b"rubbish")
    with pytest.raises(BadFrameError, match=r"^8 \(frame 0\): .*8\.npy"):
        RecordedFrames(tmp_path)[0]
    (tmp_path / "roof" / "8.npy").unlink()
    with pytest.raises(ValueError, match=r"1 missing in roof/ \(8\)"):
        RecordedFrames(tmp_path)
