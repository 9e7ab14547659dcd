"""A folder of CARLA's LiDARs: its left-handed axes are turned, in clouds, mounts and poses alike."""

import json

import numpy as np
import pytest

from tests.data.layouts import table
from tests.data.test_accumulated_reference import distances_m
from torchcover.data import BadFrameError, RecordedFrames, open_recording
from torchcover.data.recordings.carla import Carla
from torchcover.geometry import transform

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
        cloud = transform(np.linalg.inv(carla_matrix(**MOUNT)), mirrored(WORLD))
        (folder / name).mkdir(parents=True)
        for frame in ("8", "10"):
            np.save(folder / name / f"{frame}.npy", np.c_[cloud, np.ones(50)].astype(np.float32))
    if reference:
        sensors.append({"id": "reference", "type": "sensor.lidar.ray_cast"})
        (folder / "reference").mkdir()
        poses = {"8": (1.0, -0.5, 2.0, 45.0, -40.0, 170.0), "10": (0.0, 1.5, 1.0, -30.0, 20.0, -100.0)}
        for frame, pose in poses.items():
            cloud = transform(np.linalg.inv(carla_matrix(*pose)), mirrored(WORLD))
            np.save(folder / "reference" / f"{frame}.npy", cloud)
        table(folder / "reference" / "poses.csv", ("frame", *POSE), [[frame, *pose] for frame, pose in poses.items()])
    (folder / "sensors.json").write_text(json.dumps(sensors))
    return folder


def test_clouds_are_where_the_world_is(tmp_path):
    frames = RecordedFrames(recorded(tmp_path))
    assert isinstance(frames.recording, Carla)
    assert (frames.names, frames.rigs) == (("8", "10"), ("carla",))
    for frame in frames:
        np.testing.assert_allclose(frame.sensor, WORLD, atol=1e-5)
        assert distances_m(frame.reference, WORLD).max() < 1e-5


def test_poses_are_turned_as_the_clouds_are(tmp_path):
    recorded(tmp_path, reference=False)
    rows = [("10", 0.5, 3.0, 4.0, 0.5, 1.0, -2.0, 120.0), ("8", 0.0, 1.0, 2.0, 0.0, 0.0, 0.0, -90.0)]
    table(tmp_path / "poses.csv", ("frame", "time_s", *POSE), rows)
    recording = open_recording(tmp_path)
    assert recording.times_s.tolist() == [0.0, 0.5]
    for index, row in enumerate(rows[::-1]):
        expected = mirrored(transform(carla_matrix(*row[2:]), mirrored(WORLD)))
        np.testing.assert_allclose(transform(recording.world_T_vehicle(index), WORLD), expected, atol=1e-12)
    assert len(RecordedFrames(recording)[0].reference) > 10  # of the other frame


def test_frames_that_come_faster_than_turns_are_told(tmp_path):
    recorded(tmp_path)
    listed = json.loads((tmp_path / "sensors.json").read_text())
    table(tmp_path / "poses.csv", ("frame", "time_s", *POSE), [("8", 0.0, *[0.0] * 6), ("10", 0.05, *[0.0] * 6)])
    listed[1]["rotation_frequency"] = "20"
    (tmp_path / "sensors.json").write_text(json.dumps(listed))
    open_recording(tmp_path)
    listed[1]["rotation_frequency"] = 10.0
    (tmp_path / "sensors.json").write_text(json.dumps(listed))
    with pytest.warns(UserWarning, match=r"roof: a file holds 50% of a turn at most \(10 turns a second, "):
        open_recording(tmp_path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[]", r"LiDARs \(.*\) of different id are needed; got none"),
        ("{}", r"a list of sensors with id and type is needed; : Input should be a valid list"),
        ('[{"id": "../a", "type": "sensor.lidar.ray_cast"}]', r"0\.id: String should match pattern"),
        ('[{"type": "sensor.lidar.ray_cast"}]', r"0\.id: Field required"),
        ('[{"id": "roof", "type": "sensor.lidar.ray_cast", "yaw": .nan}]', r"0\.yaw: Input should be a finite number"),
        ('[{"id": "reference", "type": "sensor.lidar.ray_cast"}]', r"of different id are needed; got reference"),
    ],
)
def test_a_bad_list_of_sensors_names_file_and_field(tmp_path, content, message):
    (recorded(tmp_path) / "sensors.json").write_text(content)
    with pytest.raises(ValueError, match=rf"sensors\.json: .*{message}"):
        RecordedFrames(tmp_path)


def test_what_is_missing_is_named(tmp_path):
    recorded(tmp_path, ids=("roof", "left"))
    (tmp_path / "reference" / "poses.csv").write_text("frame,x,y,z,roll,pitch,yaw\n8,0,0,0,0,0,0\n")
    with pytest.raises(ValueError, match=r"reference.poses\.csv: one row for every frame is needed; 1 missing \(10\)"):
        RecordedFrames(tmp_path)
    (tmp_path / "reference" / "poses.csv").unlink()
    (tmp_path / "roof" / "8.npy").write_bytes(b"rubbish")
    with pytest.raises(BadFrameError, match=r"^8 \(frame 0\): .*8\.npy"):
        RecordedFrames(tmp_path)[0]
    (tmp_path / "roof" / "8.npy").unlink()
    with pytest.raises(ValueError, match=r"1 missing in roof/ \(8\)"):
        RecordedFrames(tmp_path)
