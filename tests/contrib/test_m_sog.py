"""M-SOG: closed forms, a slow implementation, and its limits."""

import math

import numpy as np
import pytest
import torch

from torchcover.contrib import MSog
from torchcover.contrib.voxels import VoxelGrid, find_crossed_voxels
from torchcover.detection import find_points_in_boxes
from torchcover.geometry import BoundingBox

from .voxel_frames import beam, boxes, frame

REGION = BoundingBox((-4.0, -4.0, 0.0), (4.0, 4.0, 2.0))
CAR = (2.0, 0.0, 1.0, 1.0, 1.0, 2.0, 0.0)
ON_CAR, ON_WALL = [1.75, 0.25, 0.75], [3.25, 0.25, 0.75]


def m_sog(sensors, frames, **options):
    metric = MSog(sensors, **{"voxel_m": 0.5, "region": REGION, **options})
    metric.update(frames)
    (number,) = metric.compute()
    return number


def seen(*points):
    return torch.tensor(points).reshape(-1, 3)


AHEAD = beam(y_m=0.25, z_m=0.75)  # 8 voxels, including those of both points


def test_three_labels_of_one_voxel_by_hand():
    # In one voxel: a car in two of four frames, other content in one, empty in one.
    beside = boxes((2.0, 3.0, 1.0, 1.0, 1.0, 2.0, 0.0))
    frames = [
        frame(0, boxes(CAR), reference=seen(ON_CAR)),
        frame(1, boxes(CAR), reference=seen(ON_CAR, ON_CAR)),
        frame(2, beside, reference=seen(ON_CAR)),
        frame(3, boxes(), reference=seen()),
    ]
    number = m_sog([AHEAD], frames)
    assert number.value == pytest.approx(-1.039721 / 8, abs=1e-7)  # H(.5, .25, .25)
    assert (number.quantity.key, number.count, number.counted_items) == ("m_sog_car_0.5m", 8, "voxels")
    assert "only for ranks" in number.warning
    always = [frame(index, boxes(CAR), reference=seen(ON_CAR, ON_WALL)) for index in range(4)]
    assert m_sog([AHEAD], always).value == 0.0


def test_points_vote_and_a_draw_is_the_category():
    # The voxel from 1.5 to 2 m contains the front of the box only from 1.6 m.
    short = boxes((2.1, 0.0, 1.0, 1.0, 1.0, 2.0, 0.0))
    in_it, beside_it = [1.9, 0.25, 0.75], [1.51, 0.25, 0.75]
    metric = MSog([AHEAD], voxel_m=0.5, region=REGION)
    for index, points in enumerate(([in_it, beside_it], [in_it, beside_it, beside_it], [beside_it])):
        metric.update(frame(index, short, reference=seen(*points)))
    assert metric.label_counts.sum(dim=(0, 2)).tolist() == [1, 2]


def test_m_sog_equals_a_slow_implementation():
    generator = np.random.default_rng(7)
    sensors, frames = [beam(z_m=1.0, columns=24), beam("low", z_m=0.3, x_m=1.0, columns=9)], []
    for index in range(16):
        objects = boxes(*generator.uniform((-4, -4, 0, 1, 1, 1, -3), (4, 4, 1, 3, 2, 2, 3), (3, 7)).tolist())
        points = torch.from_numpy(generator.uniform((-5, -5, -1), (5, 5, 3), (200, 3))).float()
        frames.append(frame(index, objects, reference=points))
    grid = VoxelGrid(REGION, 0.5)
    crossed = np.zeros(grid.shape, dtype=bool)
    for sensor in sensors:
        origin = np.array([sensor.mount.x_m, 0.0, sensor.mount.z_m])
        find_crossed_voxels(grid, origin, sensor.compute_directions().reshape(3, -1).T, output=crossed)
    labels = np.zeros((16, 3, *grid.shape))
    for index, one in enumerate(frames):
        votes = np.zeros((2, *grid.shape))
        inside = set(find_points_in_boxes(one.reference, one.boxes).point_indices.tolist())
        for number, point in enumerate(one.reference.double().numpy()):
            if (point >= REGION.lower_m).all() and (point < REGION.upper_m).all():
                votes[(int(number not in inside), *((point - REGION.lower_m) // 0.5).astype(int))] += 1
        labels[index] = [
            (votes[0] >= votes[1]) & (votes[0] > 0),
            votes[1] > votes[0],
            votes.sum(axis=0) == 0,
        ]

    def twin(chosen):
        share = np.mean(chosen, axis=0)[:, crossed]
        return float(np.mean(np.sum(share * np.log(np.where(share > 0, share, 1.0)), axis=0)))

    number = m_sog(sensors, frames)
    assert number.value == pytest.approx(twin(labels))
    assert number.parameters["crossed_share"] == crossed.mean()
    left_out = [twin(np.delete(labels, drop, axis=0)) for drop in range(16)]
    expected = math.sqrt(15 / 16 * sum((one - np.mean(left_out)) ** 2 for one in left_out))
    assert number.error == pytest.approx(expected)
    metric = MSog(sensors, voxel_m=0.5, region=REGION)
    metric.update(frames)
    assert metric.estimate().resample(1.0 - torch.eye(16))[:, 0].tolist() == pytest.approx(left_out)
    assert math.isnan(m_sog(sensors, frames[:7]).error)


def test_what_was_never_seen_is_unknown():
    without = [frame(0, boxes(), reference=seen(ON_WALL))]
    of_others = [frame(0, boxes(CAR, category="bus"), reference=seen(ON_CAR))]
    with_car = [frame(0, boxes(CAR), reference=seen(ON_CAR))]
    for sensors, frames in (([AHEAD], without), ([AHEAD], of_others), ([beam(z_m=9.0)], with_car)):
        number = m_sog(sensors, frames)
        assert math.isnan(number.value)
        assert number.count == 0
    assert m_sog([AHEAD], with_car).value == 0.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sensors": ()}, "sensors: .* got none"),
        ({"voxel_m": 0.3}, "is not a multiple of the voxel"),
        ({"voxel_m": 0.001}, r"voxels of 0.001 m in 8 x 8 x 2 m: .* GB of memory are needed"),
    ],
)
def test_parameters_that_cannot_be_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        MSog(**{"sensors": [beam()], "region": REGION, **options})


def test_frames_without_boxes_are_refused_without_effect():
    metric = MSog([AHEAD], region=REGION)
    with pytest.raises(ValueError, match="has no boxes"):
        metric.update(frame(0, None, reference=seen(ON_CAR)))
    assert (int(metric.num_frames), int(metric.block_frame_counts.sum())) == (0, 0)
