"""Scans that poses should align: each wrong convention is reported with its remedy."""

import pickle
import re
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch

from torchcover.data import AccumulatedReference, RecordedFrames, RecordingSettings, Scan
from torchcover.detection import Boxes
from torchcover.files import parse_yaml
from torchcover.geometry import (
    build_transform,
    convert_euler_to_rotation,
    convert_quaternion_to_rotation,
    convert_rotation_to_euler,
    convert_rotation_to_quaternion,
    invert,
    transform_points,
)
from torchcover.recordings.corrections import correct_recording
from torchcover.recordings.pose_checks import (
    check_frozen_poses,
    check_pose_conventions,
    check_pose_discontinuities,
    find_time_offset,
    read_pose_segments,
)

MOUNT = build_transform(convert_euler_to_rotation(2.0, 1.0, -1.0), [0.5, 0.1, 1.73])
GROUND, SIDES = 3000, 6000
AWAY_M = np.array([300.0, -40.0, 7.0])


@dataclass
class Yard:
    """LiDAR that drives in an S between crates on flat ground and accelerates; `fault` makes the recording wrong."""

    fault: str = ""
    steps: int = 12
    speed_mps: float = 6.0
    noise_m: float = 0.0
    pose_noise: float = 0.0
    path = Path("yard")
    sensors = ("lidar",)
    reference_sensors = ()
    has_area_weights = False
    block_indices = None
    ego_box = None

    def __post_init__(self):
        self.frame_names = [f"f{step}" for step in range(self.steps)]
        self.key_frames = range(self.steps)
        self.times_s = 0.1 * np.arange(self.steps)
        self.rigs = {"one": self.sensors}
        random = np.random.default_rng(3)
        self.crates_m = random.uniform([-25, -25, 0], [35, 25, 0], (30, 3))
        self.sizes_m = random.uniform(1.0, 3.5, (30, 3))

    def true(self, step):
        time_s = 0.1 * step
        way_m = self.speed_mps * (time_s + 0.4 * time_s**2)
        turn_deg = 25.0 + 4.0 * np.sin(2.5 * time_s) * (self.speed_mps > 0)
        place_m = AWAY_M + np.array([0.9, 0.4, 0.02]) * way_m
        return build_transform(convert_euler_to_rotation(turn_deg, 0.3 * way_m, 0.0), place_m)

    def read_scan(self, sensor, index):
        index = 0 if self.fault == "same" else index
        random = np.random.default_rng(index)
        crate = random.integers(len(self.crates_m), size=SIDES)
        on_side = random.uniform(-0.5, 0.5, (SIDES, 3))
        axis = random.integers(2, size=SIDES)
        on_side[np.arange(SIDES), axis] = np.sign(on_side[np.arange(SIDES), axis]) / 2
        world_m = self.crates_m[crate] + (on_side + np.array([0, 0, 0.5])) * self.sizes_m[crate]
        ground_m = random.uniform([-40, -40, 0], [40, 40, 0.02], (GROUND, 3))
        world_m = AWAY_M + np.concatenate([world_m, ground_m])
        seen_m = transform_points(invert(self.true(index) @ MOUNT), world_m)
        seen_m += random.normal(0, self.noise_m, seen_m.shape) if self.noise_m else 0.0
        if self.fault == "axes":
            seen_m = seen_m[:, [1, 0, 2]]
        return Scan(seen_m * {"mm": 1000.0, "cm": 100.0}.get(self.fault, 1.0), MOUNT, sensor)

    def get_world_T_vehicle(self, index):
        late = {"late": index - 1, "held": index // 2 * 2, "stuck": 0}
        pose = self.true(late.get(self.fault, index))
        if self.pose_noise:
            random = np.random.default_rng(index)
            angles_deg, place_m = random.normal(0, self.pose_noise * 2, 3), random.normal(0, self.pose_noise, 3)
            pose = pose @ build_transform(convert_euler_to_rotation(*angles_deg), place_m)
        if self.fault == "xyzw":
            wxyz = convert_rotation_to_quaternion(pose[:3, :3])
            return build_transform(convert_quaternion_to_rotation(np.roll(wxyz, -1)), pose[:3, 3])
        if self.fault == "yx":
            return build_transform(pose[:3, :3], pose[[1, 0, 2], 3])
        return invert(pose) if self.fault == "inverse" else pose

    def read_boxes(self, index):
        return Boxes.from_rows(torch.zeros((0, 7))) if self.fault == "unlabelled" else None


def find_warnings(yard):
    stretches = list(read_pose_segments(yard, len(yard.key_frames)))
    return check_frozen_poses(stretches) or check_pose_conventions(yard, stretches, "lidar") or ""


def check_jumps(yard):
    return check_pose_discontinuities(yard, list(read_pose_segments(yard, len(yard.key_frames))))


@pytest.mark.parametrize(
    "right",
    [
        Yard(),
        Yard(steps=2),
        Yard(steps=1),
        Yard(speed_mps=0.0),
        Yard(noise_m=0.03),
        Yard(pose_noise=0.05),
    ],
)
def test_right_poses_have_no_warning(right):
    assert not find_warnings(right)


REMEDIES = {
    "xyzw": "--set recording.quaternion_order=xyzw",
    "inverse": "--set recording.pose_convention=vehicle_T_world",
    "yx": "--set recording.pose_convention=swapped_xy",
    "axes": "--set recording.axis_order=yxz",
    "late": "--set recording.time_offset_s=0.10",
    "held": "--set recording.interpolate_poses=true",
}


@pytest.mark.parametrize("fault", REMEDIES)
def test_reported_remedies_correct_the_error(fault):
    message = find_warnings(Yard(fault))
    assert REMEDIES[fault] in message
    name, value = REMEDIES[fault].removeprefix("--set recording.").split("=")
    corrections = RecordingSettings(**{name: parse_yaml(value)})
    corrected = correct_recording(Yard(fault), corrections)
    assert corrections.command_line_options in (REMEDIES[fault], "--set recording.time_offset_s=0.1")
    assert not find_warnings(corrected)
    poses = [pickle.loads(pickle.dumps(corrected)).get_world_T_vehicle(step) for step in range(10)]
    off = [invert(Yard().true(step)) @ pose for step, pose in enumerate(poses)]
    # Interpolated and extrapolated poses are exact only for constant velocity.
    exact = fault not in ("late", "held")
    assert max(np.linalg.norm(each[:3, 3]) for each in off) < (1e-9 if exact else 0.05)
    assert max(np.abs(convert_rotation_to_euler(each[:3, :3])).max() for each in off) < (1e-9 if exact else 0.5)
    points_m = transform_points(MOUNT, corrected.read_scan("lidar", 3).points_m)
    assert np.abs(points_m - transform_points(MOUNT, Yard().read_scan("lidar", 3).points_m)).max() < 1e-9


@pytest.mark.parametrize(
    ("fault", "says"),
    [("same", "repeats the same scan while the vehicle moves")],
)
def test_errors_without_remedy_are_reported(fault, says):
    message = find_warnings(Yard(fault))
    assert re.search(says, message)


@pytest.mark.parametrize("unit", ["mm", "cm"])
def test_wrong_units_are_reported_and_corrected(unit):
    frames = RecordedFrames(Yard(unit), reference=AccumulatedReference(1.0))
    (message,) = frames.check()
    assert f"(--set recording.units={unit})" in message
    corrected = RecordedFrames(correct_recording(frames.recording, RecordingSettings(units=unit)))
    assert corrected.check() == []
    assert f"Corrections of the recording: --set recording.units={unit}." in corrected.describe_reference()["notes"]
    assert corrected.collect_content() != frames.collect_content()


def test_clouds_in_feet_are_converted():
    drive = Yard("unlabelled")
    (sensor, *_), feet = (
        drive.sensors,
        RecordedFrames(correct_recording(drive, RecordingSettings(units="ft"))).recording,
    )
    np.testing.assert_allclose(feet.read_scan(sensor, 0).points_m, 0.3048 * drive.read_scan(sensor, 0).points_m)


def test_missing_labels_are_reported():
    (message,) = RecordedFrames(Yard("unlabelled")).check()
    assert "labels, and none in 12 frames" in message


@pytest.mark.parametrize(("jump_m", "turn_deg"), [((0.8, 0.4, 0.0), 0.0), ((0.0, 0.0, 0.0), 4.0)])
def test_jumps_are_reported_and_separate_scan_pairs(jump_m, turn_deg):
    class Jumping(Yard):
        def get_world_T_vehicle(self, index):
            pose = super().get_world_T_vehicle(index)
            if index < 6:
                return pose
            return (
                build_transform(np.eye(3), jump_m)
                @ pose
                @ build_transform(convert_euler_to_rotation(turn_deg, 0.0, 0.0), np.zeros(3))
            )

    assert "poses jump 1 times in 12 frames that were checked, first at f6" in check_jumps(Jumping())
    assert not find_warnings(Jumping())
    assert check_jumps(Yard(pose_noise=0.05)) is None
    assert check_jumps(Yard(speed_mps=0.0)) is None


def test_invalid_time_offsets_are_refused():
    with pytest.raises(ValueError, match="at most 1 s"):
        RecordingSettings(time_offset_s=3.0)
    untimed = Yard()
    untimed.times_s = None
    with pytest.raises(ValueError, match=r"yard: --set recording.time_offset_s=0\.1 needs the times"):
        correct_recording(untimed, RecordingSettings(time_offset_s=0.1)).get_world_T_vehicle(0)
    assert correct_recording(untimed, RecordingSettings()) is untimed
    assert RecordingSettings(units="mm").command_line_options == "--set recording.units=mm"


def test_noisy_poses_have_no_time_offset():
    """Several time offsets match better, with worse ones in between."""

    class Noisy(NamedTuple):
        better_s: float
        width_s: float

        def match(self, settings):
            return 0.7 + 0.2 * np.exp(-(((settings.time_offset_s - self.better_s) / self.width_s) ** 2))

    assert find_time_offset([Noisy(0.1, 0.2)]) == (pytest.approx(0.1), pytest.approx(0.9))
    assert find_time_offset([Noisy(0.1, 0.2), Noisy(-0.2, 0.03)]) == (0.0, 0.0)
