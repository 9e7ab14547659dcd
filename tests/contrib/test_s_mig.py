"""S-MIG: closed forms, a slow implementation, its direction, and its limits."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchcover.contrib import SMig
from torchcover.contrib.occupancy import build_occupancy, build_occupancy_rows
from torchcover.contrib.voxels import VoxelGrid
from torchcover.detection import Boxes
from torchcover.geometry import BoundingBox

from .voxel_frames import beam, boxes, frame, place3d

REGION = BoundingBox((-10.0, -10.0, 0.0), (10.0, 10.0, 4.0))
AHEAD = (5.0, 0.0, 1.0, 4.0, 2.0, 2.0, 0.0)  # x from 3 to 7
NONE = boxes()


def s_mig(sensors, frames, **options):
    metric = SMig(sensors, **{"voxel_m": 0.5, "region": REGION, **options})
    metric.update(frames)
    return metric


def value(metric, name=":car"):
    return next(number for number in metric.compute() if number.quantity.key.endswith(name))


def test_entropy_is_one_bit_at_half_occupancy():
    ahead = beam(z_m=1.0)
    always, half = [frame(0, boxes(AHEAD)), frame(1, boxes(AHEAD))], [frame(0, boxes(AHEAD)), frame(1, NONE)]
    assert value(s_mig([ahead], always)).value == 0.0
    number = value(s_mig([ahead], half))
    assert number.value == pytest.approx(-8 * math.log(2), rel=1e-12)  # 4 m in voxels of 0.5 m
    assert (number.count, number.counted_items, number.quantity.unit, number.quantity.lower_is_better) == (
        1,
        "boxes",
        "nats",
        False,
    )
    assert number.parameters["voxels_crossed"] == 20
    assert number.parameters["entropy_captured_nats"] == -number.value
    # Repeated rays, also of four sensors, cross no further voxel.
    again = [ahead.model_copy(update={"name": name}) for name in "abcd"]
    assert value(s_mig(again, half)).value == number.value


def test_rigs_without_rays_have_the_highest_s_mig():
    half = [frame(0, boxes(AHEAD)), frame(1, NONE)]
    above = value(s_mig([beam(z_m=5.0)], half))
    assert above.value == 0.0 > value(s_mig([beam(z_m=1.0)], half)).value
    assert (above.parameters["voxels_crossed"], above.parameters["rays"]) == (0, 1)
    assert "is 0 without rays" in above.warning


def test_rays_end_with_the_range_of_their_sensor():
    half = [frame(0, boxes(AHEAD)), frame(1, NONE)]
    assert value(s_mig([beam(z_m=1.0, range_m=4.0)], half)).value == pytest.approx(-2 * math.log(2))


def test_categories_have_separate_numbers():
    person = (8.0, 0.0, 1.0, 1.0, 1.0, 2.0, 0.0)
    both = Boxes.from_rows(torch.tensor([AHEAD, person]), categories=("car", "pedestrian"))
    every, car, pedestrian, cyclist = s_mig([beam(z_m=1.0)], [frame(0, both), frame(1, NONE)]).compute()
    assert [every.quantity.key, car.quantity.key] == ["s_mig_0.5m", "s_mig_0.5m:car"]
    assert (car.value, pedestrian.value) == pytest.approx((-8 * math.log(2), -2 * math.log(2)))
    assert every.value == pytest.approx(car.value + pedestrian.value)
    assert (every.count, car.count, pedestrian.count) == (2, 1, 1)
    assert math.isnan(cyclist.value)
    assert cyclist.count == 0
    outside = boxes((50.0, 0.0, 1.0, 4.0, 2.0, 2.0, 0.0))
    nowhere = s_mig([beam(z_m=1.0)], [frame(0, outside)]).compute()
    assert all(math.isnan(number.value) and number.count == 0 for number in nowhere)


def random_boxes(generator, count):
    rows = generator.uniform((-12, -12, 0, 0.5, 0.5, 0.5, -3), (12, 12, 2, 6, 3, 3, 3), (count, 7))
    return boxes(*rows.astype(np.float32).tolist())


def slowly(objects, grid):
    """Compute (X, Y, Z) bool: voxels with their center in any box."""
    x, y, z = np.meshgrid(*grid.compute_centers_m(), indexing="ij")
    inside = np.zeros(grid.shape, dtype=bool)
    for row in objects.rows.double().numpy():
        dx, dy, dz = x - row[0], y - row[1], z - row[2]
        ahead, left = dx * np.cos(row[6]) + dy * np.sin(row[6]), dy * np.cos(row[6]) - dx * np.sin(row[6])
        inside |= (abs(ahead) < row[3] / 2) & (abs(left) < row[4] / 2) & (abs(dz) < row[5] / 2)
    return inside


def test_occupancy_equals_a_slow_implementation():
    generator, grid = np.random.default_rng(3), VoxelGrid(REGION, 0.5)
    frames = [frame(index, random_boxes(generator, index % 6), place=index // 2) for index in range(40)]
    frames.append(frames[5])  # a repeated frame
    metric = s_mig([beam()], frames)
    result = build_occupancy(metric.boxes.numpy(), 0, grid, 16)
    counts = np.zeros((16, *grid.shape), dtype=int)
    for one in frames:
        counts[one.block_index // 2] += slowly(one.boxes, grid)  # 20 block indices: two per block
    assert np.array_equal(result.voxels, np.flatnonzero(counts.sum(axis=0)))
    assert np.array_equal(result.counts[result.pattern_indices].T, counts.reshape(16, -1)[:, result.voxels])
    assert result.frame_counts.tolist() == [4, 5, *[4] * 8, *[0] * 6]


def test_overlapping_boxes_count_once():
    grid = VoxelGrid(REGION, 0.5)

    def occupied(*rows):
        table = build_occupancy_rows(boxes(*rows), 0, ("car",), REGION).numpy()
        result = build_occupancy(table, 0, grid, 16)
        assert result.counts.max() == 1
        return len(result.voxels)

    shifted = (6.0, *AHEAD[1:])
    assert occupied(AHEAD) == 8 * 4 * 4
    assert occupied(AHEAD, AHEAD) == 8 * 4 * 4
    assert occupied(AHEAD, shifted) == 10 * 4 * 4
    # Faces on voxel centers: each center belongs to one of two adjacent boxes, despite rounding to float32.
    level = (0.25, 0.25, 0.35, 1.0, 1.0, 1.2, 0.0)
    assert occupied(level) == 2 * 2 * 2
    assert occupied(level, (1.25, *level[1:])) == 4 * 2 * 2
    for tenths in range(6, 30):
        standing = (0.0, 0.0, 0.25 + tenths / 20, 1.0, 1.0, tenths / 10, 0.0)
        assert occupied(standing) == 2 * 2 * math.ceil(tenths / 5)


def test_errors_equal_the_jackknife_over_scenes():
    generator = np.random.default_rng(1)
    sensors = [beam(z_m=1.0, columns=40), beam("low", z_m=0.3, columns=40)]
    frames = [frame(index, random_boxes(generator, 4)) for index in range(16)]
    whole = s_mig(sensors, frames)
    left_out = [value(s_mig(sensors, frames[:drop] + frames[drop + 1 :])).value for drop in range(16)]
    expected = math.sqrt(15 / 16 * sum((one - np.mean(left_out)) ** 2 for one in left_out))
    assert value(whole).error == pytest.approx(expected, rel=1e-9)
    weights = 1.0 - torch.eye(16)
    assert whole.estimate().resample(weights)[:, 1].tolist() == pytest.approx(left_out)
    assert whole.estimate().resample(torch.zeros(1, 16)).isnan().all()
    assert math.isnan(value(s_mig(sensors, frames[:7])).error)
    hits = {"beam": torch.tensor([[9.0, 0.0, 1.0]])}
    occluded = s_mig(sensors, [frame(one.index, one.boxes, clouds=hits) for one in frames], ends_at_hits=True)
    assert value(occluded).value < 0
    assert math.isnan(value(occluded).error)


def test_occluded_rays_end_at_measured_points():
    before = torch.tensor([[5.0, 0.0, 1.25]])
    clouds = {"beam": before}
    frames = [frame(0, boxes(AHEAD), clouds=clouds), frame(1, NONE)]
    number = value(s_mig([beam(z_m=1.25)], frames, ends_at_hits=True))
    # From 3 to 5 m, in one of two frames.
    assert number.quantity.key == "s_mig_occluded_0.5m:car"
    assert number.value == pytest.approx(-4 * math.log(2) / 2)
    assert math.isnan(number.error)
    assert s_mig([beam(z_m=1.25)], frames, ends_at_hits=True).estimate().resample(torch.ones(1, 2)) is None


def test_occluded_s_mig_is_a_mean_over_frames():
    generator = np.random.default_rng(2)
    sensors = [beam("a", z_m=1.0), beam("b", z_m=2.0, x_m=-1.0)]
    frames = [
        frame(
            index,
            random_boxes(generator, 3),
            clouds={
                name: torch.from_numpy(generator.uniform(-9, 9, (50, 3)) * (1, 1, 0.2) + (0, 0, 2)).float()
                for name in "ab"
            },
        )
        for index in range(4)
    ]
    together = value(s_mig(sensors, frames, ends_at_hits=True)).value
    each = [replace(one, clouds={"rig": one.clouds["rig"][:0]}, sensor_point_counts={"rig": {}}) for one in frames]
    alone = [
        value(s_mig(sensors, [*each[:index], frames[index], *each[index + 1 :]], ends_at_hits=True)).value
        for index in range(4)
    ]
    assert together == pytest.approx(sum(alone))


def test_published_rig_crosses_the_known_voxel_count():
    number = value(
        s_mig(place3d("center"), [frame(0, boxes(AHEAD))], voxel_m=1.0, region=SMig(place3d("line")).grid.region)
    )
    assert number.parameters["voxels_crossed"] == 9564
    assert number.parameters["rays"] == 16_000


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sensors": ()}, "sensors: the sensors of the rig, with their mounts and rays, are needed; got none"),
        ({"categories": ()}, "categories: one or more different ones"),
        ({"categories": ("car", "car")}, "categories: one or more different ones"),
        ({"voxel_m": 0.3}, "is not a multiple of the voxel"),
        ({"voxel_m": 30.0}, "is not a multiple of the voxel"),
        ({"voxel_m": 0.0005}, r"voxels of 0.0005 m in 20 x 20 x 4 m: .* GB .*; take larger voxels"),
    ],
)
def test_parameters_that_cannot_be_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        SMig(**{"sensors": [beam()], "voxel_m": 0.5, "region": REGION, **options})


def test_unsuitable_frames_are_refused_without_effect():
    metric = s_mig([beam()], [frame(0, NONE)], ends_at_hits=True)
    without = frame(1, None)
    nobody = replace(frame(1, NONE), sensor_point_counts=None)
    other = frame(1, NONE, clouds={"rear": torch.ones(1, 3)})
    for given, message in ((without, "has no boxes"), (nobody, "set sensor_point_counts"), (other, "sensor 'rear'")):
        with pytest.raises(ValueError, match=message):
            metric.update(given)
    assert (int(metric.num_frames), len(metric.boxes), int(metric.crossings.sum())) == (1, 1, 0)
