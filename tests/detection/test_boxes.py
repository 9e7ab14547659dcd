"""Boxes, the points in them, and the boxes of simulated frames."""

import dataclasses
import math
import pickle
import warnings

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from torchcover import Scenario
from torchcover.data import Frame, SimulatedFrames, collate_frames
from torchcover.detection import Boxes, BoxVisibility, find_points_in_boxes, match_detections, measure_box_visibility
from torchcover.detection.inside import SKIN_M
from torchcover.simulation import PaperReference, Rig

SMALL = PaperReference(rows=96, columns=128)
NONE = Boxes.from_rows(torch.empty(0, 7))


def random_boxes(count, generator, reach=20.0):
    rows = torch.rand(count, 7, generator=generator) * torch.tensor([2 * reach, 2 * reach, 2, 5, 3, 2, 2 * math.pi])
    return Boxes.from_rows(rows + torch.tensor([-reach, -reach, 0, 0.1, 0.1, 0.1, -math.pi]))


def slow_inside(points, boxes):
    """Pairs from the definition, point by point in float64."""
    pairs = set()
    for k, (x, y, z, length, width, height, yaw) in enumerate(boxes.rows.double().tolist()):
        for p, (px, py, pz) in enumerate(points.double().tolist()):
            along = (px - x) * math.cos(yaw) + (py - y) * math.sin(yaw)
            across = (py - y) * math.cos(yaw) - (px - x) * math.sin(yaw)
            beside = abs(along) <= length / 2 + SKIN_M and abs(across) <= width / 2 + SKIN_M
            if beside and z - height / 2 + SKIN_M < pz <= z + height / 2 + SKIN_M:
                pairs.add((k, p))
    return pairs


@pytest.mark.parametrize("seed", range(4))
def test_points_in_boxes_are_those_of_the_definition(seed):
    generator = torch.Generator().manual_seed(seed)
    boxes = random_boxes(12, generator, reach=6.0)
    points = torch.rand(800, 3, generator=generator) * torch.tensor([16.0, 16.0, 4.0]) - torch.tensor([8.0, 8.0, 0.5])
    inside = find_points_in_boxes(points, boxes)
    assert set(zip(inside.box_indices.tolist(), inside.point_indices.tolist(), strict=True)) == slow_inside(
        points, boxes
    )
    assert (inside.box_indices.diff() >= 0).all()
    assert len(inside.box_indices) > 20


@pytest.mark.parametrize("far_m", [30.0, 3e4, 1e30])
def test_boxes_have_any_distance_and_size(far_m):
    """More cells than there may be, of which some boxes fill many; points beyond all, and none at all."""
    generator = torch.Generator().manual_seed(5)
    rows = random_boxes(12, generator, reach=6.0).rows.double()
    rows[3, 0], rows[5, 1], rows[7, 3:5] = far_m, -far_m, min(far_m, 3e4)
    boxes = Boxes.from_rows(rows)
    points = (torch.rand(300, 3, generator=generator) * 16 - 8).double()
    points[:4, 0] = torch.tensor([torch.inf, -torch.inf, torch.nan, far_m])
    points[4] = rows[3, :3]
    given = points.clone()
    inside = find_points_in_boxes(points, boxes)
    assert set(zip(inside.box_indices.tolist(), inside.point_indices.tolist(), strict=True)) == slow_inside(
        points, boxes
    )
    assert torch.equal(points.nan_to_num(), given.nan_to_num())


def test_sides_and_top_are_closed_bottom_is_open():
    box = Boxes.from_rows(torch.tensor([[10.0, -3.0, 1.0, 4.0, 2.0, 2.0, 0.0]]))
    in_it = [
        [12.0, -3.0, 1.0],
        [8.0, -3.0, 1.0],
        [10.0, -2.0, 1.0],
        [10.0, -4.0, 1.0],
        [10.0, -3.0, 2.0],
        [12.0, -2.0, 2.0],
    ]
    out = [[10.0, -3.0, 0.0], [10.0, -3.0, 0.009], [12.02, -3.0, 1.0], [10.0, -3.0, 2.02], [10.0, -4.02, 1.0]]
    inside = find_points_in_boxes(torch.tensor(in_it + out), box)
    assert inside.point_indices.sort().values.tolist() == list(range(len(in_it)))


def test_surface_points_of_rotated_boxes_are_inside():
    generator = np.random.default_rng(3)
    rows = torch.tensor([[180.0, -140.0, 0.9, 12.0, 2.5, 1.8, 0.7]])
    on_face = generator.uniform(-0.5, 0.5, (500, 3))
    on_face[np.arange(500), generator.integers(0, 2, 500)] = 0.5  # on the front or on the left
    on_face[:, 2] = generator.uniform(-0.45, 0.5, 500)
    local = on_face * rows[0, 3:6].double().numpy()
    c, s = math.cos(0.7), math.sin(0.7)
    points = local @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + rows[0, :3].double().numpy()
    assert len(find_points_in_boxes(torch.from_numpy(points).float(), Boxes.from_rows(rows)).point_indices) == 500


def test_a_point_may_lie_in_two_boxes():
    twice = Boxes.from_rows(torch.tensor([[0.0, 0, 1, 2, 2, 2, 0]] * 2))
    assert find_points_in_boxes(torch.tensor([[0.0, 0.0, 1.0]]), twice).box_indices.tolist() == [0, 1]
    assert len(find_points_in_boxes(torch.rand(9, 3), NONE).box_indices) == 0
    assert len(find_points_in_boxes(torch.empty(0, 3), twice).box_indices) == 0


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_other_types_of_clouds_are_compared_exactly(dtype):
    points = (torch.rand(300, 3) * 100).to(dtype)
    boxes = Boxes.from_rows(torch.tensor([[50.0, 50, 50, 60, 30, 90, 0.4]]))
    assert set(find_points_in_boxes(points, boxes).point_indices.tolist()) == {p for _, p in slow_inside(points, boxes)}


def test_membership_is_invariant_to_rigid_transforms():
    generator = torch.Generator().manual_seed(9)
    boxes, points = random_boxes(8, generator, 5.0), torch.rand(400, 3, generator=generator).double() * 12 - 6
    shift = torch.tensor([31.0, -17.0, 2.0], dtype=torch.float64)
    moved = Boxes(boxes.center_m.double() + shift, boxes.size_m.double(), boxes.yaw_rad.double())
    before, after = find_points_in_boxes(points, boxes), find_points_in_boxes(points + shift, moved)
    pairs = [set(zip(i.box_indices.tolist(), i.point_indices.tolist(), strict=True)) for i in (before, after)]
    assert pairs[0] == pairs[1]


def rows(**changes):
    fields = {"center_m": torch.zeros(2, 3), "size_m": torch.ones(2, 3), "yaw_rad": torch.zeros(2)}
    return Boxes(**{**fields, **changes})


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        (
            {"size_m": torch.tensor([[1.0, 1, 1], [4, 0, 1]])},
            ValueError,
            r"1 of 2 boxes .* box 1 with \[4.0, 0.0, 1.0\]",
        ),
        ({"size_m": -torch.ones(2, 3)}, ValueError, "2 of 2 boxes have a length, width or height that is not positive"),
        ({"center_m": torch.full((2, 3), math.nan)}, ValueError, "center_m: 2 of 2 boxes have NaN or infinite"),
        ({"yaw_rad": torch.tensor([0.0, math.inf])}, ValueError, "yaw_rad: 1 of 2 boxes have NaN or infinite"),
        ({"center_m": torch.zeros(3, 3)}, ValueError, r"center_m: shape \(2, 3\) is needed for 2 boxes; got \(3, 3\)"),
        ({"velocity_mps": torch.zeros(2, 3)}, ValueError, r"velocity_mps: shape \(2, 2\) is needed"),
        ({"ids": ("a",)}, ValueError, "ids: one entry for each of 2 boxes is needed; got 1"),
        ({"sampled_points": torch.zeros(3)}, ValueError, r"sampled_points: shape \(2,\) is needed"),
        (
            {"points_in_box": {"roof": torch.zeros(3)}},
            ValueError,
            r"points_in_box\['roof'\]: one entry for each of 2 boxes",
        ),
        ({"yaw_rad": torch.zeros(2, dtype=torch.int64)}, TypeError, "yaw_rad: a floating-point torch tensor is needed"),
        ({"center_m": [[0.0] * 3] * 2}, TypeError, "center_m: a floating-point torch tensor is needed; got list"),
    ],
)
def test_boxes_that_cannot_be_are_refused(changes, error, message):
    with pytest.raises(error, match=message):
        rows(**changes)


def test_rows_of_another_width_are_refused():
    with pytest.raises(ValueError, match=r"rows: shape \(K, 7\) is needed.*got \(2, 9\)"):
        Boxes.from_rows(torch.zeros(2, 9))


def test_yaw_in_degrees_warns_once_per_line():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        for _ in range(3):
            rows(yaw_rad=torch.tensor([0.0, 90.0]))
    assert len(caught) == 1
    assert "radians are needed" in str(caught[0].message)
    rows(yaw_rad=torch.tensor([-2 * math.pi, 2 * math.pi]))  # a full turn is none


def test_unknown_velocities_are_nan_and_names_empty():
    made = rows()
    assert made.velocity_mps.isnan().all()
    assert made.ids == made.categories == ("", "")
    assert made.sampled_points.tolist() == [0, 0]


def test_selecting_keeps_everything_together():
    made = rows(
        center_m=torch.arange(6.0).view(2, 3),
        ids=("a", "b"),
        categories=("car", "bus"),
        points_in_box={"r": torch.tensor([3, 4])},
        sampled_points=torch.tensor([5, 6]),
    )
    for chosen in (
        made.select(torch.tensor([False, True])),
        made.select(torch.tensor([1])),
        made.select_categories("bus"),
    ):
        assert (chosen.ids, chosen.categories, chosen.points_in_box["r"].tolist()) == (("b",), ("bus",), [4])
        assert chosen.center_m.tolist() == [[3.0, 4.0, 5.0]]
        assert chosen.sampled_points.tolist() == [6]
    assert len(made.select_categories("tram")) == 0
    assert len(NONE.select_categories("car")) == 0


TRAFFIC = {"name": "t", "traffic": {"type": "parking", "duration_s": 2.0, "time_step_s": 0.5}}
LIDAR = {
    "type": "lidar", "name": "top", "mount": {"z_m": 1.9}, "channels": 48, "vertical_fov_deg": (-30, 5),
    "horizontal_fov_deg": 360, "columns": 720, "max_range_m": 120,
}  # fmt: skip


@pytest.fixture(scope="module")
def frames():
    rig = Rig.model_validate({"name": "r", "sensors": [LIDAR]})
    return SimulatedFrames(
        Scenario.model_validate(TRAFFIC), rig, num_frames=8, seed=2, reference_sensor=SMALL, boxes=True
    )


def same(a, b):
    tensors = ("center_m", "size_m", "yaw_rad", "velocity_mps", "sampled_points")
    alike = all(torch.equal(getattr(a, name), getattr(b, name)) for name in tensors)
    return (
        alike
        and a.ids == b.ids
        and a.categories == b.categories
        and torch.equal(a.points_in_box["r"], b.points_in_box["r"])
    )


def test_boxes_do_not_depend_on_order_or_workers(frames):
    late_first = frames[6]
    there = [f for b in DataLoader(frames, batch_size=3, num_workers=2, collate_fn=collate_frames) for f in b.frames]
    assert all(same(frames[index].boxes, there[index].boxes) for index in range(8))
    assert same(late_first.boxes, frames[6].boxes)
    without = SimulatedFrames(frames.scenario, frames.rigs["r"], num_frames=8, seed=2, reference_sensor=SMALL)[6]
    assert without.boxes is None
    assert torch.equal(without.sensor, late_first.sensor)
    assert torch.equal(without.reference, late_first.reference)
    assert same(pickle.loads(pickle.dumps(frames))[6].boxes, late_first.boxes)


def test_objects_keep_names_and_move_with_their_velocity(frames):
    first, second = frames[2].boxes, frames[3].boxes
    world = frames.simulator.get_scene_geometry(0)[0].scene
    poses = [world.ego.trajectory.interpolate(0.5 * step) for step in (2, 3)]
    moved = 0
    for k, name in enumerate(first.ids):
        if first.categories[k] == "pedestrian" or name not in second.ids:
            continue  # people turn on the spot
        places = [
            pose[:3, :3] @ boxes.center_m[boxes.ids.index(name)].double().numpy() + pose[:3, 3]
            for pose, boxes in zip(poses, (first, second), strict=True)
        ]
        velocity = [
            pose[:2, :2] @ boxes.velocity_mps[boxes.ids.index(name)].double().numpy()
            for pose, boxes in zip(poses, (first, second), strict=True)
        ]
        np.testing.assert_allclose((places[1] - places[0])[:2], 0.5 * np.mean(velocity, axis=0), atol=0.12)
        moved += np.linalg.norm(velocity[0]) > 1.0
    assert moved >= 1
    assert any(name.startswith("parked") for name in first.ids)


def test_hits_on_a_body_lie_in_its_box(frames):
    frame = frames[1]
    inside = find_points_in_boxes(frame.sensor, frame.boxes)
    assert torch.equal(torch.bincount(inside.box_indices, minlength=len(frame.boxes)), frame.boxes.points_in_box["r"])
    assert frame.boxes.points_in_box["r"].sum() > 500
    grown = Boxes(frame.boxes.center_m, frame.boxes.size_m + torch.tensor([0.3, 0.3, 0.0]), frame.boxes.yaw_rad)
    around = find_points_in_boxes(frame.sensor, grown).point_indices
    just_outside = around[~torch.isin(around, inside.point_indices)]
    # Within 15 cm of a box but not in it: a few points of the ground, the ego is tilted, or of a wheel stop.
    assert (frame.sensor[just_outside, 2] < 0.3).all()
    assert len(just_outside) < 0.02 * len(inside.point_indices)


def test_batches_give_lists_padded_boxes_and_frame_numbers(frames):
    batch = collate_frames([frames[0], frames[5]])
    assert [len(boxes) for boxes in batch.boxes] == [len(frames[0].boxes), len(frames[5].boxes)]
    padded = batch.pad_boxes(["pedestrian", "car"])
    assert padded.shape[0] == 2
    assert padded.shape[2] == 8
    for row, boxes in zip(padded, batch.boxes, strict=True):
        wanted = boxes.select_categories("car", "pedestrian")
        assert torch.equal(row[: len(wanted), :7], wanted.rows)
        assert [["pedestrian", "car"][int(number) - 1] for number in row[: len(wanted), 7]] == list(wanted.categories)
        assert not row[len(wanted) :].any()
    stacked = batch.stack_points()
    for number, cloud in enumerate(batch.sensor):
        assert torch.equal(stacked[stacked[:, 0] == number, 1:], cloud)
    assert torch.equal(stacked, batch.stack_points("r"))


def test_frames_without_objects_pad_without_boxes_raise():
    empty = Frame({"r": torch.zeros(2, 3)}, torch.zeros(2, 3), 0, "night 7", boxes=NONE)
    assert collate_frames([empty, empty]).pad_boxes(["car"]).shape == (2, 0, 8)
    nobody_looked = Frame({"r": torch.zeros(2, 3)}, torch.zeros(2, 3), 0, "night 8")
    with pytest.raises(
        ValueError, match=r"1 of 2 frames have no boxes, for example 'night 8': use SimulatedFrames\(.*boxes=True"
    ):
        _ = collate_frames([empty, nobody_looked]).boxes


def test_scenes_without_objects_have_empty_boxes():
    frame = SimulatedFrames("courtyard", "front_roof_32", num_frames=1, reference_sensor=SMALL, boxes=True)[0]
    assert len(frame.boxes) == 0
    assert frame.boxes.points_in_box["front_roof_32"].shape == (0,)


MOVING = rows(
    velocity_mps=torch.ones(2, 2),
    ids=("a", "b"),
    points_in_box={"r": torch.tensor([1, 2])},
    sampled_points=torch.tensor([3, 4]),
)


def test_boxes_move_with_their_frame():
    frame = Frame({"r": torch.zeros(2, 3)}, torch.zeros(2, 3), 0, "a", boxes=MOVING)
    there = collate_frames([frame]).to("cpu").boxes[0]
    assert there is not frame.boxes
    assert same(there, frame.boxes)


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda a, t, boxes: Boxes.from_rows(a), "rows"),
        (lambda a, t, boxes: find_points_in_boxes(a, boxes), "points"),
        (lambda a, t, boxes: match_detections(a, t[:, 0], t, "distance", 2.0), "detections"),
        (lambda a, t, boxes: match_detections(t, a[:, 0], t, "distance", 2.0), "scores"),
        (lambda a, t, boxes: match_detections(t, t[:, 0], a, "distance", 2.0), "ground_truth"),
        (lambda a, t, boxes: measure_box_visibility(a[:, :3], t[:, :3], boxes, reference_weights=None), "sensor"),
        (
            lambda a, t, boxes: measure_box_visibility(t[:, :3], t[:, :3], boxes, reference_weights=a[:, 0]),
            "reference_weights",
        ),
    ],
)
def test_numpy_arrays_are_rejected_by_name(call, name):
    rows = torch.ones(2, 7)
    with pytest.raises(TypeError, match=rf"^{name}: .* got a NumPy array of float32; torch.from_numpy\(array\) makes"):
        call(rows.numpy(), rows, Boxes.from_rows(rows))


def test_warning_of_degrees_names_the_callers_line():
    numbers = torch.tensor([[4.0, 2.0, 1.5]])
    with pytest.warns(UserWarning, match="beyond a full turn, so it may be in degrees") as told:
        Boxes(numbers, numbers, torch.tensor([90.0]))
    assert [one.filename for one in told] == [__file__]
    Boxes(numbers, numbers, torch.tensor([-2 * math.pi]))


def test_boxes_and_visibility_survive_a_round_trip():
    boxes = Boxes.from_rows(torch.tensor([[5.0, 0.0, 0.75, 4.0, 2.0, 1.5, 0.0]]))
    one = torch.ones(1)
    for made, name in ((boxes, "center_m"), (BoxVisibility(one, one, one, one, one, 0.4), "share")):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(made, name, one)


def test_margin_extends_the_top_not_the_bottom():
    boxes = Boxes.from_rows(torch.tensor([[0.0, 0.0, 0.0, 8.0, 4.0, 2.0, 0.0]]).double())
    heights_m = [1.0 + SKIN_M, 1.0 + SKIN_M + 1e-9, SKIN_M - 1.0, SKIN_M - 1.0 + 1e-9]
    points = torch.tensor([[0.5, -0.5, height_m] for height_m in heights_m]).double()
    points[:, 2] = torch.tensor(heights_m, dtype=torch.float64)
    assert find_points_in_boxes(points, boxes).point_indices.tolist() == [0, 3]
