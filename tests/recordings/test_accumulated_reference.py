"""Accumulated references: static surfaces, moving objects, and points that are excluded."""

import pickle

import numpy as np
import pytest
import torch

from tests.recordings.drives import Drive
from torchcover.data import AccumulatedReference, BadFrameError, RecordedFrames
from torchcover.detection import Boxes
from torchcover.evaluation import evaluate
from torchcover.geometry import BoundingBox, build_transform, invert, transform_points

FAR_M = (513_248.0, 5_403_655.0, 260.0)


def distances_m(points_m, to_m):
    return torch.cdist(torch.as_tensor(points_m).double(), torch.as_tensor(to_m).double()).min(dim=1).values


def transform_wall(drive, index):
    return transform_points(invert(drive.get_world_T_vehicle(index)), drive.wall_m)


def transform_car(drive, index):
    return transform_points(invert(drive.get_world_T_vehicle(index)) @ drive.world_T_car(index), drive.back_m)


@pytest.mark.parametrize("origin_m", [(0.0, 0.0, 0.0), FAR_M])
@pytest.mark.parametrize("index", [0, 2, 4])
def test_points_lie_on_their_surfaces_at_the_frame(origin_m, index):
    drive = Drive(origin_m=origin_m)
    frames = RecordedFrames(drive, reference=AccumulatedReference(10.0, voxel_m=0.05))
    reference = frames[index].reference
    wall_m, car_m = transform_wall(drive, index), transform_car(drive, index)
    assert len(reference) == len(wall_m) + len(car_m)  # each once, however often it was seen
    assert distances_m(reference, np.concatenate([wall_m, car_m])).max() < 1e-4
    assert distances_m(car_m, reference).max() < 1e-4


class TightlyDrawn(Drive):
    """Drive whose boxes end 8 cm before the surfaces."""

    def read_boxes(self, index):
        rows = super().read_boxes(index).rows
        rows[:, 3:5] -= 0.2
        return Boxes.from_rows(rows, ids=("car",))


def test_points_beside_a_box_move_with_it():
    drive = TightlyDrawn()
    reference = RecordedFrames(drive, reference=AccumulatedReference(10.0, voxel_m=0.05))[2].reference
    assert distances_m(reference, np.concatenate([transform_wall(drive, 2), transform_car(drive, 2)])).max() < 1e-4


class Parked(Drive):
    """Drive in which a part of the wall is labeled too."""

    def read_boxes(self, index):
        moving, size_m = super().read_boxes(index), (6.0, 1.0, 3.2)
        vehicle_T_parked = invert(self.get_world_T_vehicle(index)) @ build_transform(np.eye(3), [10.0, 5.0, 1.5])
        yaw = np.arctan2(vehicle_T_parked[1, 0], vehicle_T_parked[0, 0])
        row = torch.tensor([[*vehicle_T_parked[:3, 3], *size_m, yaw]], dtype=torch.float32)
        return Boxes.from_rows(torch.cat([moving.rows, row]), ids=("car", "parked"))


def test_static_boxes_change_nothing():
    labelled, other = (
        RecordedFrames(drive, reference=AccumulatedReference(10.0, voxel_m=0.05))[6]
        for drive in (Parked(steps=12), Drive(steps=12))
    )
    assert labelled.reference.equal(other.reference)
    assert labelled.reference_weights.equal(other.reference_weights)
    assert labelled.counts == other.counts


class OnARoad(Drive):
    """Drive on a flat road without objects."""

    def __post_init__(self):
        super().__post_init__()
        x, y = np.meshgrid(np.arange(3.0, 110.0, 0.5), np.arange(-6.0, 6.5, 0.5))
        self.wall_m, self.back_m = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1), np.empty((0, 3))


def test_ground_tolerance_grows_with_distance():
    drive = OnARoad(labelled=False)
    points_m = np.array([[10.0, 0.0, 0.34], [10.0, 0.0, 0.36], [100.0, 0.0, -0.78], [100.0, 0.0, 0.82]])
    level_m = AccumulatedReference(10.0)._flatten_ground(drive, 0, points_m)
    assert level_m[:, 2] == pytest.approx([0.0, 0.36, 0.0, 0.82], abs=1e-6)
    assert level_m[:, :2] == pytest.approx(points_m[:, :2])


class Slim(Drive):
    """Drive whose moving object has the size of a pedestrian and three points."""

    def __post_init__(self):
        super().__post_init__()
        self.back_m = np.array([[-0.22, 0.12, 0.22], [-0.22, -0.12, 0.32], [-0.22, 0.02, 0.62]])

    def read_boxes(self, index):
        rows = super().read_boxes(index).rows
        rows[:, 3:6] = torch.tensor([0.5, 0.6, 1.5])
        return Boxes.from_rows(rows, ids=("walker",))


def test_sides_of_a_box_limit_its_area():
    drive = Slim()
    frame = RecordedFrames(drive, reference=AccumulatedReference(10.0, voxel_m=0.05))[2]
    own = distances_m(frame.reference, transform_car(drive, 2)) < 1e-3
    assert int(own.sum()) == 3
    assert (
        0.5 < float(frame.reference_weights[own].sum()) <= 1.1 * 1.5 + 0.5 * 0.6
    )  # depends on how many viewpoints see it


def test_unnamed_objects_are_excluded_and_counted():
    drive = Drive(named=False)
    frame = RecordedFrames(drive, reference=AccumulatedReference(10.0, voxel_m=0.05))[2]
    assert len(frame.reference) == len(drive.wall_m)
    assert frame.counts["reference_unlabeled"] == 4 * len(drive.back_m)  # not the sensor's own scan of that instant


def test_evaluated_sensors_are_excluded_at_the_frame():
    drive = Drive()
    alone = RecordedFrames(drive, rigs={"left": ("left",)}, reference=AccumulatedReference(0.0, voxel_m=0.05))
    both = len(transform_wall(drive, 1)) + len(transform_car(drive, 1))
    assert len(alone[1].reference) == both  # of the right one
    assert alone.describe_reference()["evaluated_sensors"] == []
    later = RecordedFrames(drive, rigs={"left": ("left",)}, reference=AccumulatedReference(1.0))
    assert later.describe_reference()["evaluated_sensors"] == ["left"]
    assert "also built the reference" in later.describe_reference()["notes"][-1]
    with pytest.raises(ValueError, match=r"window 0 s\) needs a sensor that is not evaluated; all are \(left, right\)"):
        RecordedFrames(drive, reference=AccumulatedReference(0.0))


def test_frames_do_not_depend_on_reading_order():
    drive = Drive(steps=5)

    def frames():
        return RecordedFrames(drive, reference=AccumulatedReference(0.4, voxel_m=0.3))

    one = frames()
    forward = [one[index].reference for index in range(5)]
    again = frames()
    backward = [again[index].reference for index in reversed(range(5))][::-1]
    fresh = [frames()[index].reference for index in range(5)]
    copied = [pickle.loads(pickle.dumps(one))[index].reference for index in range(5)]
    for others in zip(forward, backward, fresh, copied, strict=True):
        assert all(torch.equal(others[0], other) for other in others[1:])
    assert len(one.reference.sweep_window._scans) <= 2 * 5


def test_one_reference_serves_several_recordings():
    reference = AccumulatedReference(10.0, voxel_m=0.05)
    drives = Drive(), Drive(labelled=False), Drive(origin_m=FAR_M)
    shared = [RecordedFrames(drive, reference=reference)[2].reference for drive in drives]
    alone = [RecordedFrames(drive, reference=AccumulatedReference(10.0, voxel_m=0.05))[2].reference for drive in drives]
    assert all(torch.equal(*pair) for pair in zip(shared, alone, strict=True))


def test_reference_has_no_points_in_the_vehicle():
    body = BoundingBox((-30.0, -30.0, 0.0), (30.0, 30.0, 1.0))
    frame = RecordedFrames(Drive(ego_box=body), reference=AccumulatedReference(10.0))[2]
    beside = (frame.reference[:, :2].abs() >= 30.0).any(dim=1)
    assert (frame.reference[~beside, 2] >= 1.0).all()
    assert 0 < beside.sum() < len(beside)
    assert frame.counts["reference_ego_vehicle"] > 0 < frame.counts["sensor_ego_vehicle"]
    nothing = Drive(ego_box=BoundingBox((-90.0, -90.0, -9.0), (90.0, 90.0, 9.0)))
    with pytest.raises(ValueError, match=r"no reference point remains of the scans within 5 s of this frame"):
        RecordedFrames(nothing, reference=AccumulatedReference(10.0))[2]


def test_missing_times_poses_and_sensors_are_named():
    drive = Drive()
    drive.times_s = None
    with pytest.raises(ValueError, match=r"no reference can be accumulated because .* has no times of its scans"):
        RecordedFrames(drive)
    drive = Drive()
    drive.get_world_T_vehicle = lambda index: None
    with pytest.raises(ValueError, match="has no poses of the vehicle"):
        RecordedFrames(drive)
    with pytest.raises(ValueError, match=r"no sensor roof; it has left, right"):
        RecordedFrames(Drive(), reference=AccumulatedReference(sensors=("roof",)))
    for bad in ({"window_s": -1.0}, {"window_s": np.nan}, {"voxel_m": 0.0}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            AccumulatedReference(**bad)


def test_excluded_points_are_counted_and_areas_positive():
    frame = RecordedFrames(Drive(steps=12, labelled=False), reference=AccumulatedReference(10.0, voxel_m=0.05))[5]
    counts = {name.removeprefix("reference_"): count for name, count in frame.counts.items()}
    assert counts["sweeps"] == 2 * 11  # all but the two of the instant
    assert counts["rays"] > counts["free_space"] + counts["transient"] > 0
    assert frame.reference_weights.shape == frame.reference.shape[:1]
    assert frame.reference_weights.min() > 0


def test_a_pose_that_jumps_ends_the_window():
    drive = Drive(steps=20)
    places = Drive(steps=20).get_world_T_vehicle
    drive.get_world_T_vehicle = lambda index: build_transform(np.eye(3), [5.0 * (index >= 8), 0.0, 0.0]) @ places(index)
    frames = RecordedFrames(drive, reference=AccumulatedReference(10.0))
    assert frames[9].counts["reference_sweeps"] == 2 * 11
    assert frames[9].counts["reference_sweeps_skipped"] == 2 * 8
    assert frames[3].counts["reference_sweeps"] == 2 * 7


@pytest.mark.parametrize("steps", [1, 2])
def test_a_drive_of_one_or_two_sweeps(steps):
    drive = Drive(steps=steps, labelled=False)
    frames = RecordedFrames(drive, rigs={"left": ("left",)}, reference=AccumulatedReference(2.0, min_motion_m=1.0))
    wall_m = np.concatenate([transform_wall(drive, 0), transform_car(drive, 0)])
    assert distances_m(frames[0].reference, wall_m).max() < 0.3  # one sweep alone tells no velocity
    assert distances_m(transform_wall(drive, 0), frames[0].reference).max() < 0.1


class Standing(Drive):
    """Drive with a stationary vehicle."""

    def get_world_T_vehicle(self, index):
        return super().get_world_T_vehicle(0)


def test_moving_objects_are_found_by_stationary_vehicles():
    drive = Standing(steps=12, labelled=False)
    frame = RecordedFrames(drive, reference=AccumulatedReference(10.0, voxel_m=0.05, min_motion_m=0.0))[6]
    here_m = np.concatenate([transform_wall(drive, 6), transform_car(drive, 6)])
    assert distances_m(frame.reference, here_m).max() < 0.5
    assert distances_m(transform_wall(drive, 6), frame.reference).max() < 1e-3


def test_memory_does_not_grow_with_the_drive():
    drive = Drive(steps=60, labelled=False)
    frames = RecordedFrames(drive, reference=AccumulatedReference(0.4))
    for index in range(0, 60, 20):
        _ = frames[index]
    sweeps = frames.reference.sweep_window
    kept = 2 * (2 * 12 + 1)
    assert len(sweeps._scans) <= kept
    assert len(sweeps._counter._counted) <= kept
    assert len(sweeps._counter._images) <= kept


def test_one_bad_sweep_fails_only_its_frame():
    def gone(sensor, index):
        if index == 2:
            raise ValueError("f2.bin: truncated")
        return scan(sensor, index)

    drive = Drive(steps=6)
    scan, drive.read_scan = drive.read_scan, gone
    frames = RecordedFrames(drive, reference=AccumulatedReference(1.0))
    with pytest.raises(BadFrameError, match=r"^f2: f2.bin: truncated; it is in the window of f0 .*skip_bad_frames"):
        frames[0]
    with pytest.raises(BadFrameError, match=r"^f2 \(frame 2\): f2.bin: truncated$"):
        frames[2]
    result = evaluate(frames=frames, skip_bad_frames=True, cell_m=8.0)
    assert (result.run.num_frames, result.run.skipped_frames) == (5, ["f2 (frame 2): f2.bin: truncated"])
    assert pickle.loads(pickle.dumps(frames.reference)).sweep_window.skip_unreadable
    assert all(len(frames[each].reference) for each in (0, 1, 3, 5))
    assert frames[0].counts["reference_sweeps_skipped"] == 2  # both sensors
    whole = RecordedFrames(Drive(steps=6), reference=AccumulatedReference(1.0))[0]
    assert frames[0].counts["reference_sweeps"] == whole.counts["reference_sweeps"] - 2


def test_unreadable_labels_fail_only_their_sweep():
    def gone(index):
        if index == 6:
            raise ValueError("f6.csv: truncated")
        return boxes(index)

    drive = Drive(steps=12)
    boxes, drive.read_boxes = drive.read_boxes, gone
    frames = RecordedFrames(drive, reference=AccumulatedReference(0.2))
    frames.skip_unreadable_sweeps()
    for index in (0, 1, 11):  # whose boxes half a second before or after are not to be had
        assert frames[index].counts.get("reference_sweeps_skipped", 0) == 0
    assert frames[5].counts["reference_sweeps_skipped"] == 2


@pytest.mark.parametrize("position_m", [1e11, -1e12])
def test_positions_far_from_the_first_are_bad_frames(position_m):
    drive = Drive()
    drive.read_scan = Drive().read_scan
    drive.get_world_T_vehicle = lambda index: build_transform(np.eye(3), [position_m * (index > 0), -position_m, 0.0])
    frames = RecordedFrames(drive, reference=AccumulatedReference())
    with pytest.raises(BadFrameError, match="m from its position in"):
        frames[1]
