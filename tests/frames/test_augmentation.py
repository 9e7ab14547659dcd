"""What moves together keeps its relations: radii, points in boxes, coverage."""

import math
from dataclasses import replace

import pytest
import torch

from torchcover import blind_spot_radius
from torchcover.data import Augmentation, Frame, Measurement, flip, rotate, scale
from torchcover.detection import Boxes, find_points_in_boxes


def make_frame(seed=0, index=0):
    generator = torch.Generator().manual_seed(seed)
    rows = torch.rand(9, 7, generator=generator) * torch.tensor([40.0, 40, 1, 4, 2, 2, 6]) + torch.tensor(
        [-20.0, -20, 0, 1, 1, 1, -3]
    )
    boxes = Boxes.from_rows(rows, velocity_mps=torch.randn(9, 2, generator=generator), ids=tuple("abcdefghi"))
    near = rows[torch.arange(900) % 9, :3] + torch.randn(900, 3, generator=generator)
    clouds = {"a": near, "b": torch.randn(500, 3, generator=generator) * 15}
    return Frame(clouds, torch.randn(700, 3, generator=generator) * 10, index, "f", {"rays": 3}, boxes=boxes)


MOVES = {
    "flip": (flip, 1.0),
    "rotate": (lambda frame: rotate(frame, 2.1), 1.0),
    "scale": (lambda frame: scale(frame, 1.3), 1.3),
}


@pytest.mark.parametrize(("move", "factor"), MOVES.values(), ids=MOVES)
def test_radii_stay_and_scale_with_a_scaling(move, factor):
    frame = make_frame()
    moved = move(frame)
    for rig in ("a", "b"):
        before = blind_spot_radius(frame.clouds[rig], frame.reference)
        after = blind_spot_radius(moved.clouds[rig], moved.reference)
        torch.testing.assert_close(after, factor * before, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(("move", "factor"), MOVES.values(), ids=MOVES)
def test_where_points_landed_moves_with_where_they_are(move, factor):
    frame = make_frame()
    error_m = torch.linspace(-1, 1, 500)
    off = torch.nn.functional.normalize(frame.clouds["b"]) * error_m[:, None]
    frame = replace(frame, measurements={"b": Measurement(frame.clouds["b"] + off, error_m)})
    moved = move(frame)
    torch.testing.assert_close(moved.measurements["b"].error_m, factor * error_m)
    distance = torch.linalg.vector_norm(moved.get_measured_points("b") - moved.clouds["b"], dim=1)
    torch.testing.assert_close(distance, factor * error_m.abs(), atol=1e-5, rtol=1e-4)
    assert moved.get_measured_points("a") is moved.clouds["a"]
    assert len(moved.get_cloud("b", max_error_m=0.5 * factor)) == int((error_m.abs() <= 0.5).sum())
    with pytest.raises(ValueError, match=r"'b' has 9 points, 500 measured points and 500 errors; set `clouds` and"):
        replace(frame, clouds={"b": torch.zeros(9, 3)})


@pytest.mark.parametrize(("move", "factor"), MOVES.values(), ids=MOVES)
def test_points_stay_in_their_boxes(move, factor):
    # Away from the skin, which does not scale.
    frame = make_frame()
    clear = torch.ones(900, dtype=torch.bool)
    for change in (-0.03, 0.03):
        grown = replace(frame.boxes, size_m=frame.boxes.size_m + change)
        clear[find_points_in_boxes(frame.clouds["a"], grown).point_indices] ^= True
    frame = replace(frame, clouds={"a": frame.clouds["a"][clear]})
    moved = move(frame)
    before, after = (find_points_in_boxes(f.clouds["a"], f.boxes) for f in (frame, moved))
    pairs = [sorted(zip(i.box_indices.tolist(), i.point_indices.tolist(), strict=True)) for i in (before, after)]
    assert pairs[0] == pairs[1]
    assert len(pairs[0]) > 100


@pytest.mark.parametrize(("move", "factor"), MOVES.values(), ids=MOVES)
def test_velocity_points_where_the_box_goes(move, factor):
    """A frame a second later: the moved centre less the centre moved is the moved velocity."""
    frame = make_frame()
    later = torch.cat([frame.boxes.velocity_mps, torch.zeros(9, 1)], dim=1)
    then = replace(frame, boxes=replace(frame.boxes, center_m=frame.boxes.center_m + later))
    went = move(then).boxes.center_m - move(frame).boxes.center_m
    torch.testing.assert_close(went[:, :2], move(frame).boxes.velocity_mps, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(("move", "factor"), MOVES.values(), ids=MOVES)
def test_area_weights_scale_and_counts_stay(move, factor):
    frame = make_frame()
    frame = replace(
        frame, boxes=replace(frame.boxes, sampled_points=torch.arange(9)), reference_weights=torch.rand(700)
    )
    moved = move(frame)
    torch.testing.assert_close(moved.reference_weights, factor**2 * frame.reference_weights)
    assert torch.equal(moved.boxes.sampled_points, torch.arange(9))


def test_inverse_augmentations_restore_the_frame():
    frame = make_frame()
    for there_and_back in (flip(flip(frame)), rotate(rotate(frame, 0.7), -0.7), scale(scale(frame, 1.25), 0.8)):
        torch.testing.assert_close(there_and_back.reference, frame.reference, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(there_and_back.boxes.rows, frame.boxes.rows, atol=1e-5, rtol=1e-5)
        assert there_and_back.boxes.ids == frame.boxes.ids
        assert there_and_back.counts == frame.counts


def test_known_cases():
    car = Boxes.from_rows(
        torch.tensor([[10.0, 2.0, 1.0, 4.0, 2.0, 1.5, 0.25]]), velocity_mps=torch.tensor([[3.0, 1.0]])
    )
    frame = Frame({"r": torch.zeros(1, 3)}, torch.zeros(1, 3), 0, "f", boxes=car)
    expected = {
        "flip": ([10.0, -2.0, 1.0, 4.0, 2.0, 1.5, -0.25], [3.0, -1.0]),
        "left": ([-2.0, 10.0, 1.0, 4.0, 2.0, 1.5, 0.25 + math.pi / 2], [-1.0, 3.0]),
        "twice": ([20.0, 4.0, 2.0, 8.0, 4.0, 3.0, 0.25], [6.0, 2.0]),
    }
    moved = {"flip": flip(frame), "left": rotate(frame, math.pi / 2), "twice": scale(frame, 2.0)}
    for name, (row, velocity) in expected.items():
        torch.testing.assert_close(moved[name].boxes.rows, torch.tensor([row]), msg=name)
        torch.testing.assert_close(moved[name].boxes.velocity_mps, torch.tensor([velocity]), msg=name)


def test_augmentations_depend_on_seed_epoch_and_index():
    augment = Augmentation(seed=3)
    first = augment(make_frame(index=5), epoch=1).clouds["a"]
    augment(make_frame(index=6), epoch=2)
    torch.manual_seed(99)
    assert torch.equal(first, Augmentation(seed=3)(make_frame(index=5), epoch=1).clouds["a"])
    others = [
        Augmentation(seed=4)(make_frame(index=5), epoch=1),
        augment(make_frame(index=5), epoch=2),
        augment(make_frame(index=6), epoch=1),
    ]
    assert not any(torch.equal(first, other.clouds["a"]) for other in others)


def test_draws_stay_within_their_bounds_and_reach_them():
    augment = Augmentation(flip_probability=0.25, max_yaw_rad=0.5, scale_range=(0.9, 1.2), seed=0)
    arrow = Boxes.from_rows(torch.tensor([[1.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]]))
    left = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    flips, yaws, factors = [], [], []
    for index in range(600):
        moved = augment(Frame({"r": left}, left, index, "f", boxes=arrow))
        yaws.append(float(moved.boxes.yaw_rad))
        factors.append(float(moved.boxes.size_m[0, 0]) / 4.0)
        (fx, fy, _), (lx, ly, _) = moved.sensor.tolist()
        flips.append(fx * ly - fy * lx < 0)
    assert -0.5 <= min(yaws) < -0.48
    assert 0.48 < max(yaws) <= 0.5
    assert 0.9 <= min(factors) < 0.91
    assert 1.19 < max(factors) <= 1.2 + 1e-6
    assert abs(sum(flips) / 600 - 0.25) < 4 * (0.25 * 0.75 / 600) ** 0.5


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: scale(make_frame(), 0.0), "factor: a finite number > 0 is needed; got 0"),
        (lambda: scale(make_frame(), math.nan), "factor: .* got nan"),
        (lambda: rotate(make_frame(), math.inf), "yaw_rad: a finite angle is needed; got inf"),
        (lambda: Augmentation(flip_probability=1.5), r"flip_probability: a probability in \[0, 1\] is needed; got 1.5"),
        (lambda: Augmentation(max_yaw_rad=-1.0), "max_yaw_rad: an angle >= 0 is needed"),
        (lambda: Augmentation(scale_range=(1.1, 0.9)), "scale_range: two numbers 0 < lowest <= highest"),
        (lambda: Augmentation(seed=-1), "seed: a number >= 0"),
        (lambda: Augmentation()(make_frame(index=-1)), "frame 'f', index -1, epoch 0: numbers >= 0 are needed"),
    ],
)
def test_impossible_augmentations_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
