"""Each check reports its error, and none reports a valid recording."""

import re
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

import torchcover
from tests.recordings.drives import Drive
from torchcover.data import AccumulatedReference, RecordedFrames, Scan
from torchcover.detection import Boxes
from torchcover.geometry import BoundingBox, build_transform, convert_euler_to_rotation, invert, transform_points
from torchcover.recordings.checks import estimate_ground_height

MOUNT = build_transform(convert_euler_to_rotation(2.0, 1.0, -1.0), [0.5, 0.1, 1.73])
SIZE_M = (4.0, 1.8, 1.5)


@dataclass
class Street:
    """LiDAR above a street: ground with a slope and noise, walls, cars on its right, in the frame of the sensor.

    `reference` samples the same surfaces independently. The fields describe errors.
    """

    mount: np.ndarray = None
    flipped: bool = False
    same: bool = False
    halved: bool = False
    both_sides: bool = False
    turned_deg: float = 0.0
    slope: tuple = (0.03, -0.02)
    step_s: float = 0.1
    steps: int = 6
    ego_box: BoundingBox | None = None
    bumps_m: float = 0.03
    path = Path("street")
    sensors = ("lidar",)
    reference_sensors = ("reference",)
    has_area_weights = False
    block_indices = None

    def __post_init__(self):
        self.frame_names = [f"f{step}" for step in range(self.steps)]
        self.key_frames = range(self.steps)
        self.times_s = self.step_s * np.arange(self.steps)
        self.rigs = {"one": ("lidar",)}

    def read_scan(self, sensor, index):
        seed = index if self.same else [index, sensor == "lidar"]
        generator = np.random.default_rng(seed)
        x, y = generator.uniform(-40, 40, (2, 20_000))
        z = self.slope[0] * x + self.slope[1] * y + generator.normal(0, self.bumps_m, len(x))
        ground_m = np.stack([x, y, z], axis=1)
        wall_m = np.stack([x, np.where(y > 0, 9.0, -12.0), generator.uniform(0, 8, len(x))], axis=1)[:4000]
        beneath_m = generator.uniform([-20, -20, -6], [20, 20, -2], (60, 3))  # what a mirror shows
        sides_m = [
            (generator.uniform(-0.5, 0.5, (40, 3)) * [1, 0, 0.9] + [0, 0.5, 0]) * SIZE_M + row[:3].numpy()
            for row in self.read_boxes(index).rows
        ]
        points_m = np.concatenate([ground_m, wall_m, beneath_m, *sides_m])
        if self.halved and sensor == "lidar":
            points_m = points_m[::2]  # every second laser
        if self.flipped:
            points_m = points_m * [1.0, -1.0, 1.0]
        return Scan(transform_points(invert(MOUNT), points_m), MOUNT if self.mount is None else self.mount, sensor)

    def get_world_T_vehicle(self, index):
        return build_transform(
            convert_euler_to_rotation(30.0 + 4.0 * index + self.turned_deg, 0.0, 0.0), self._place_m(index)
        )

    def _place_m(self, index):
        yaw = np.deg2rad(30.0 + 4.0 * np.arange(index))
        return np.array([513_248.0 + 1.5 * np.cos(yaw).sum(), 5_403_655.0 + 1.5 * np.sin(yaw).sum(), 260.0])

    def read_boxes(self, index):
        x, y = torch.tensor([-15.0, -5.0, 8.0, 16.0]), torch.full((4,), -5.0)
        if self.both_sides:  # cars on both sides
            x, y = x.repeat(2), torch.cat([y, -y])
        z = self.slope[0] * x + self.slope[1] * y + SIZE_M[2] / 2
        size_m = torch.tensor(SIZE_M).expand(len(x), 3)
        return Boxes.from_rows(torch.column_stack([x, y, z, size_m, torch.zeros(len(x))]))


def find_warnings(street, **options):
    return RecordedFrames(street, **options).check(None)


def test_valid_recordings_have_no_warnings():
    assert find_warnings(Street()) == []
    assert find_warnings(Street(), reference=AccumulatedReference(1.0)) == []
    assert find_warnings(Street(slope=(0.12, 0.0))) == []  # a hill
    assert find_warnings(Street(steps=1)) == []
    assert (
        find_warnings(Street(both_sides=True)) == find_warnings(Street(both_sides=True, flipped=True)) == []
    )  # none can tell
    assert find_warnings(Street(same=True, halved=True)) == []  # half of the lasers against all
    assert find_warnings(Street(turned_deg=180.0)) == []  # it reverses
    for drive in (
        Drive(),
        Drive(steps=8),
        Drive(named=False),
        Drive(labelled=False),
        Drive(origin_m=(5e5, 5e6, 100.0)),
    ):
        assert find_warnings(drive, reference=AccumulatedReference(0.8)) == []


@pytest.mark.parametrize(
    ("mistake", "says"),
    [
        (
            {"mount": np.eye(4)},
            r"ground lies at z = -1.[78] m \(lidar\), -1.[78] m \(reference\), not near 0: .*vehicle_T",
        ),
        (
            {"mount": build_transform(np.eye(3), [0.0, 0.0, 3.4])},
            r"ground lies at z = \+1.[67] m \(lidar\), \+1.[67] m \(ref",
        ),
        ({"flipped": True}, r"20 of 20 labeled boxes contain points of (lidar|reference) only if its left and right"),
        ({"same": True}, r"reference points are those of the rig one itself.*--reference accumulated"),
    ],
)
def test_each_error_is_reported(mistake, says):
    found = find_warnings(Street(**mistake))
    assert found
    for message in found:  # and there is no other one
        assert message.startswith("street: ")
        assert re.search(says, message)


def test_windows_with_one_frame_are_reported():
    (message,) = find_warnings(Street(step_s=100.0), reference=AccumulatedReference(2.0))
    assert "frames are 100 s apart, and a window of 2 s" in message


@pytest.mark.parametrize(("steps", "lasts"), [(1, "0 s, 1 frames"), (2, "0.1 s, 2 frames")])
def test_drives_shorter_than_the_window_are_reported(steps, lasts):
    (message,) = find_warnings(Drive(steps=steps), reference=AccumulatedReference(2.0))
    assert f"it lasts {lasts}, and its reference is accumulated over 2 s" in message
    assert (
        find_warnings(
            Drive(steps=steps), reference=AccumulatedReference(0.0, sensors=("left",)), rigs={"b": ("right",)}
        )
        == []
    )


def test_empty_clouds_are_reported():
    street = Street()
    scan = street.read_scan
    off = Scan(np.empty((0, 3)), MOUNT, "off")
    street.read_scan = lambda sensor, index: off if sensor == "lidar" and index >= 3 else scan(sensor, index)
    (message,) = find_warnings(street)
    assert "lidar has no point in 2 of 5 frames" in message


def test_ground_is_connected_below_the_vehicle():
    generator = np.random.default_rng(0)
    x, y = generator.uniform(-20, 20, (2, 5000))
    flat_m = np.stack([x, y, np.full(5000, -1.73)], axis=1)
    assert estimate_ground_height(flat_m) == pytest.approx(-1.73)
    assert estimate_ground_height(
        transform_points(build_transform(np.eye(3), [0.0, 0.0, 1.73]), flat_m)
    ) == pytest.approx(0.0, abs=1e-9)
    assert estimate_ground_height(flat_m[:20]) is None  # too few
    assert estimate_ground_height(np.stack([x, y, generator.uniform(2, 12, 5000)], axis=1)) is None  # roofs and trees
    ahead_m = flat_m[(x > 5) & (np.abs(y) < 0.6 * x)]
    ahead_m[:, 2] = 0.15 * np.maximum(ahead_m[:, 0] - 10.0, 0.0)  # where a hill begins
    assert abs(estimate_ground_height(ahead_m)) < 0.5


def test_unreadable_frames_are_skipped():
    street = Street(mount=np.eye(4))
    scan = street.read_scan
    street.read_scan = lambda sensor, index: scan(sensor, index) if index == 5 else Path("gone").read_bytes()
    assert len(find_warnings(street)) == 1
    street.read_scan = lambda sensor, index: Path("gone").read_bytes()
    assert find_warnings(street) == []


def test_evaluation_warns_before_it_begins():
    frames = RecordedFrames(Street(mount=np.eye(4), steps=1))
    with pytest.warns(UserWarning, match=r"^street: the ground lies at z = -1.[78] m \(lidar\)") as caught:
        torchcover.evaluate(frames=frames, cell_m=8.0)
    assert [warning.filename for warning in caught] == [__file__]


class Striped(Drive):
    """Sensor that observes stripes of a wall, 3 m of each 6 m; stationary for `standing` frames, then moving."""

    standing = 0

    def __post_init__(self):
        super().__post_init__()
        self.wall_m[:, 1] = 4.01
        self.back_m, self.rigs, self.labelled = np.empty((0, 3)), {"one": ("right",)}, False

    def get_world_T_vehicle(self, index):
        return build_transform(np.eye(3), [0.5 * max(0, index - self.standing), 0.0, 0.0])

    def read_scan(self, sensor, index):
        scan = super().read_scan(sensor, index)
        points_m = transform_points(scan.vehicle_T_sensor, scan.points_m)
        return replace(scan, points_m=scan.points_m[points_m[:, 0] % 6.0 < 3.0])

    def share_near_stripes(self, index):
        """Compute the share of the wall 0 to 20 m ahead within 0.4 m of a point of the scan."""
        wall_m = transform_points(invert(self.get_world_T_vehicle(index)), self.wall_m)
        wall_m = wall_m[(wall_m[:, 0] >= 0) & (wall_m[:, 0] < 20)]
        seen = self.read_scan("right", index)
        apart_m = np.linalg.norm(wall_m[:, None] - transform_points(seen.vehicle_T_sensor, seen.points_m), axis=2)
        return (apart_m.min(axis=1) < 0.4).mean()


def test_stationary_vehicles_have_no_own_reference():
    def measure(drive, **options):
        frames = RecordedFrames(drive, reference=AccumulatedReference(2.0, **options))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            result = torchcover.evaluate(frames=frames, cell_m=2.0)
        messages = [str(warning.message) for warning in caught if "the vehicle moves less" in str(warning.message)]
        return (
            result.coverage.scalars()["detection_0.4m/20m/obstacle"],
            result.run.counts["reference_stationary"],
            messages,
        )

    drive = Striped(steps=30)
    right = np.mean([drive.share_near_stripes(index) for index in range(30)])
    moving, standing, messages = measure(drive)
    assert abs(moving - right) < 0.03 < 1 - right
    assert (standing, messages) == (0, [])

    drive.standing = 30
    value, standing, messages = measure(drive)
    assert np.isnan(value)
    assert standing == 30
    assert "less than 2 m within 2 s in 30 of 30 frames, so there is no coverage" in messages[0]
    assert measure(drive, sensors=("left",))[1:] == (0, [])  # another sensor is the reference

    drive = Striped(steps=60)
    drive.standing = 30
    value, standing, messages = measure(drive)
    assert abs(value - right) < 0.03
    assert 20 <= standing < 30  # some windows reach into the drive
    assert f"in {standing} of 60 frames, which do not count" in messages[0]
