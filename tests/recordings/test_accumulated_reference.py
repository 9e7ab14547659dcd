"""A reference made of the recording itself: what moves, what stands, and whose points they are."""

import pickle

import numpy as np
import pytest
import torch

from tests.recordings.drives import Drive
from torchcover.data import AccumulatedReference, RecordedFrames
from torchcover.detection import Boxes
from torchcover.geometry import BoundingBox, invert, transform

FAR_M = (513_248.0, 5_403_655.0, 260.0)


def distances_m(points_m, to_m):
    return torch.cdist(torch.as_tensor(points_m).double(), torch.as_tensor(to_m).double()).min(dim=1).values


def standing(drive, index):
    return transform(invert(drive.world_T_vehicle(index)), drive.wall_m)


def moving(drive, index):
    return transform(invert(drive.world_T_vehicle(index)) @ drive.world_T_car(index), drive.back_m)


@pytest.mark.parametrize("origin_m", [(0.0, 0.0, 0.0), FAR_M])
@pytest.mark.parametrize("index", [0, 2, 4])
def test_every_point_is_where_its_surface_is_at_the_instant(origin_m, index):
    drive = Drive(origin_m=origin_m)
    frames = RecordedFrames(drive, reference=AccumulatedReference(10.0, voxel_m=0.05))
    reference = frames[index].reference
    wall_m, car_m = standing(drive, index), moving(drive, index)
    assert len(reference) == len(wall_m) + len(car_m)  # each once, however often it was seen
    assert distances_m(reference, np.concatenate([wall_m, car_m])).max() < 1e-4
    assert distances_m(car_m, reference).max() < 1e-4


class TightlyDrawn(Drive):
    """The boxes end 8 cm before the surfaces."""

    def boxes(self, index):
        rows = super().boxes(index).rows
        rows[:, 3:5] -= 0.2
        return Boxes.from_rows(rows, ids=("car",))


def test_what_sticks_out_of_its_box_moves_with_it():
    drive = TightlyDrawn()
    reference = RecordedFrames(drive, reference=AccumulatedReference(10.0, voxel_m=0.05))[2].reference
    assert distances_m(reference, np.concatenate([standing(drive, 2), moving(drive, 2)])).max() < 1e-4


def test_objects_without_a_name_are_left_out_and_counted():
    drive = Drive(named=False)
    frame = RecordedFrames(drive, reference=AccumulatedReference(10.0, voxel_m=0.05))[2]
    assert len(frame.reference) == len(drive.wall_m)
    assert frame.counts["reference_gone"] == 4 * len(drive.back_m)  # not the sensor's own scan of that instant


def test_a_judged_sensor_takes_no_part_at_the_instant_itself():
    drive = Drive()
    alone = RecordedFrames(drive, rigs={"left": ("left",)}, reference=AccumulatedReference(0.0, voxel_m=0.05))
    both = len(standing(drive, 1)) + len(moving(drive, 1))
    assert len(alone[1].reference) == both  # of the right one
    assert alone.reference_record["judged_among_them"] == []
    later = RecordedFrames(drive, rigs={"left": ("left",)}, reference=AccumulatedReference(1.0))
    assert later.reference_record["judged_among_them"] == ["left"]
    assert "took part" in later.reference_record["notes"][-1]
    with pytest.raises(ValueError, match=r"window 0 s\) needs a sensor that is not judged; all are \(left, right\)"):
        RecordedFrames(drive, reference=AccumulatedReference(0.0))


def test_a_frame_does_not_depend_on_those_read_before():
    drive = Drive(steps=8)

    def frames():
        return RecordedFrames(drive, reference=AccumulatedReference(0.4, voxel_m=0.3))

    one = frames()
    forward = [one[index].reference for index in range(8)]
    again = frames()
    backward = [again[index].reference for index in reversed(range(8))][::-1]
    fresh = [frames()[index].reference for index in range(8)]
    copied = [pickle.loads(pickle.dumps(one))[index].reference for index in range(8)]
    for others in zip(forward, backward, fresh, copied, strict=True):
        assert all(torch.equal(others[0], other) for other in others[1:])
    assert len(one.reference.sweeps._kept) <= 2 * 8


def test_one_reference_serves_several_recordings():
    reference = AccumulatedReference(10.0, voxel_m=0.05)
    drives = Drive(), Drive(labelled=False), Drive(origin_m=FAR_M)
    shared = [RecordedFrames(drive, reference=reference)[2].reference for drive in drives]
    alone = [RecordedFrames(drive, reference=AccumulatedReference(10.0, voxel_m=0.05))[2].reference for drive in drives]
    assert all(torch.equal(*pair) for pair in zip(shared, alone, strict=True))


def test_where_the_vehicle_stands_is_no_reference():
    body = BoundingBox((-30.0, -30.0, 0.0), (30.0, 30.0, 1.0))
    frame = RecordedFrames(Drive(body=body), reference=AccumulatedReference(10.0))[2]
    beside = (frame.reference[:, :2].abs() >= 30.0).any(dim=1)
    assert (frame.reference[~beside, 2] >= 1.0).all()
    assert 0 < beside.sum() < len(beside)
    assert frame.counts["reference_own_vehicle"] > 0 < frame.counts["sensor_own_vehicle"]
    nothing = Drive(body=BoundingBox((-90.0, -90.0, -9.0), (90.0, 90.0, 9.0)))
    with pytest.raises(ValueError, match=r"no reference point is left of the scans within 5 s of this instant"):
        RecordedFrames(nothing, reference=AccumulatedReference(10.0))[2]


def test_what_a_recording_does_not_say_is_named():
    drive = Drive()
    drive.times_s = None
    with pytest.raises(ValueError, match=r"cannot be accumulated, .* does not say when its scans were made"):
        RecordedFrames(drive)
    drive = Drive()
    drive.world_T_vehicle = lambda index: None
    with pytest.raises(ValueError, match="does not say where the vehicle was"):
        RecordedFrames(drive)
    with pytest.raises(ValueError, match=r"no sensor roof; it has left, right"):
        RecordedFrames(Drive(), reference=AccumulatedReference(sensors=("roof",)))
    for bad in ({"window_s": -1.0}, {"window_s": np.nan}, {"voxel_m": 0.0}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            AccumulatedReference(**bad)
