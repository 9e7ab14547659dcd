"""The visibility of a box is the coverage of the reference points in it."""

import math
from functools import partial

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from torchcover.data import SimulatedFrames
from torchcover.detection import Boxes, measure_box_visibility
from torchcover.simulation import PaperReference

TWO = Boxes.from_rows(torch.tensor([[10.0, 0.0, 1.0, 4.0, 2.0, 2.0, 0.0], [30.0, 0.0, 1.0, 4.0, 2.0, 2.0, 0.6]]))


unweighted = partial(measure_box_visibility, reference_weights=None)


def slow_visibility(sensor, reference, boxes, threshold, weights):
    """From the definition in float64 NumPy, box by box."""
    r = cdist(reference.double().numpy(), sensor.double().numpy()).min(axis=1, initial=math.inf)
    results = []
    for x, y, z, length, width, height, yaw in boxes.rows.double().tolist():
        d = reference.double().numpy() - [x, y, z]
        along = np.abs(d[:, 0] * np.cos(yaw) + d[:, 1] * np.sin(yaw)) <= length / 2 + 0.01
        across = np.abs(d[:, 1] * np.cos(yaw) - d[:, 0] * np.sin(yaw)) <= width / 2 + 0.01
        inside = along & across & (d[:, 2] > -height / 2 + 0.01) & (d[:, 2] <= height / 2 + 0.01)
        w = weights[inside]
        known = inside.any()
        share = (w * (r[inside] <= threshold)).sum() / w.sum() if known else math.nan
        mean = (w * r[inside]).sum() / w.sum() if known else math.nan
        results.append((share, mean, inside.sum()))
    return [np.array(column) for column in zip(*results, strict=True)]


@pytest.mark.parametrize("weighted", [False, True])
def test_against_a_slow_twin(weighted):
    generator = torch.Generator().manual_seed(1)
    rows = torch.rand(20, 7, generator=generator) * torch.tensor([20.0, 20, 1, 5, 3, 3, 6]) + 0.1
    boxes = Boxes.from_rows(rows)
    sensor, reference = (torch.rand(n, 3, generator=generator) * torch.tensor([20.0, 20, 3]) for n in (700, 1500))
    weights = torch.rand(1500, generator=generator).double() + 0.1 if weighted else torch.ones(1500).double()
    found = measure_box_visibility(
        sensor, reference, boxes, threshold_m=0.7, reference_weights=weights if weighted else None
    )
    share, mean, count = slow_visibility(sensor, reference, boxes, 0.7, weights.numpy())
    sampled = count > 0
    np.testing.assert_allclose(found.share.numpy()[sampled], share[sampled], atol=1e-12)
    np.testing.assert_allclose(found.mean_radius_m.numpy()[sampled], mean[sampled], rtol=1e-6)
    np.testing.assert_array_equal(found.reference_points.numpy(), count)
    assert 0.0 < np.nanquantile(share, 0.2) < np.nanquantile(share, 0.8) < 1.0
    assert found.threshold_m == 0.7


def test_weights_that_are_all_equal_change_nothing():
    sensor, reference = torch.rand(50, 3) * 4, torch.rand(300, 3) * 4 + torch.tensor([8.0, -2.0, 0.0])
    plain = measure_box_visibility(sensor, reference, TWO, reference_weights=None)
    weighted = measure_box_visibility(sensor, reference, TWO, reference_weights=torch.full((300,), 7.0))
    torch.testing.assert_close(plain.mean_radius_m, weighted.mean_radius_m, equal_nan=True)
    torch.testing.assert_close(plain.share, weighted.share, equal_nan=True)


def test_rig_points_alone_judge_sides_facing_the_vehicle():
    # Ahead, to the left and turned, low enough to be seen from above; and one that nobody saw.
    rows = [
        [10.0, 0, 1, 4, 2, 2, 0],
        [0, 20.0, 1, 2, 4, 2, 0.5 * math.pi],
        [30.0, 0, 0.5, 4, 2, 1, 0],
        [60, 0, 1, 4, 2, 2, 0],
    ]
    boxes = Boxes.from_rows(torch.tensor(rows))
    # In the middle of the side towards the vehicle; in that of the third's top.
    sensor = torch.tensor([[8.0, 0.0, 1.0], [0.0, 19.0, 1.0], [30.0, 0.0, 1.0], [90.0, 0.0, 0.0]])
    seen = unweighted(sensor, torch.tensor([[90.0, 0.0, 1.0]]), boxes, threshold_m=0.5)
    circle = math.pi * 0.5**2
    expected = [circle / (2 * 2), circle / (4 * 2), circle / (4 * 2 + 2 * 1), math.nan]
    np.testing.assert_allclose(seen.share, expected, atol=0.03)
    # From the middle of a square of side 2, the mean distance is 0.7652 times half of it.
    assert seen.mean_radius_m[0] == pytest.approx(0.7652, rel=0.01)
    assert seen.observed.tolist() == [True, True, True, False]
    assert (seen.reference_points.tolist(), seen.sensor_points.tolist()) == ([0] * 4, [1, 1, 1, 0])
    # Where the reference saw anything, that decides; and beside it nothing changes.
    reference = torch.cat([boxes.center_m[1:2], boxes.center_m[1:2] + 0.1])
    both = measure_box_visibility(sensor, reference, boxes, 0.5, reference_weights=torch.ones(2))
    assert both.share[1] == 0.0
    torch.testing.assert_close(both.share[[0, 2]], seen.share[[0, 2]])


@pytest.mark.parametrize("turn_rad", [0.3, 1.2, 2.5, -0.7])
def test_rig_points_alone_give_equal_shares_all_around(turn_rad):
    """In the middles of both of its sides that face the vehicle, and beside it at the same distance elsewhere."""
    row, sides = [12.0, 3.0, 1.0, 4.0, 2.0, 2.0, 0.4], torch.tensor([[-2.0, 0.0, 0.0], [0.0, 1.0, 0.0]]).double()

    def around(points, angle):
        cosine, sine = math.cos(angle), math.sin(angle)
        return points @ torch.tensor([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]).double()

    found = []
    for turn in (0.0, turn_rad):
        centre = around(torch.tensor([row[:3]]).double(), turn)
        boxes = Boxes.from_rows(torch.cat([centre, torch.tensor([[*row[3:6], row[6] + turn]]).double()], dim=1))
        sensor = around(sides, row[6] + turn) + centre
        found.append(unweighted(sensor, torch.tensor([[90.0, 0.0, 1.0]]).double(), boxes, threshold_m=0.5))
    circles, areas = 2 * math.pi * 0.5**2, 2 * 2 + 4 * 2
    assert found[0].share.item() == pytest.approx(circles / areas, abs=0.03)
    assert found[1].share.item() == pytest.approx(found[0].share.item(), abs=0.01)
    assert found[1].mean_radius_m.item() == pytest.approx(found[0].mean_radius_m.item(), rel=1e-6)


def test_nearest_sensor_point_may_lie_outside_the_box():
    """At 0.3 m in front of the box, below the threshold: seen, although no point of the rig is in the box."""
    seen = unweighted(torch.tensor([[7.7, 0.0, 1.0]]), torch.tensor([[8.0, 0.0, 1.0]]), TWO)
    assert seen.share[0] == 1.0
    assert seen.mean_radius_m[0] == pytest.approx(0.3, abs=1e-6)
    assert seen.sensor_points[0] == 0


@pytest.mark.parametrize("threshold", [0.5, 0.0])
def test_radius_equal_to_the_threshold_counts_as_visible(threshold):
    sensor = torch.tensor([[8.0 + threshold, 0.0, 1.0]])
    assert unweighted(sensor, torch.tensor([[8.0, 0.0, 1.0]]), TWO, threshold_m=threshold).share[0] == 1.0


def test_a_rig_that_saw_nothing_is_blind():
    seen = unweighted(torch.empty(0, 3), torch.tensor([[10.0, 0.0, 1.0]]), TWO)
    assert seen.share[0] == 0.0
    assert seen.mean_radius_m[0] == math.inf


def test_no_boxes_give_an_empty_answer():
    seen = unweighted(torch.rand(5, 3), torch.rand(5, 3), Boxes.from_rows(torch.empty(0, 7)))
    assert len(seen) == 0
    assert seen.share.dtype == torch.float64


def test_sampled_boxes_without_visible_points_are_hidden():
    boxes = Boxes.from_rows(TWO.rows.repeat(2, 1), sampled_points=torch.tensor([0, 7, 9, 0]))
    seen = unweighted(torch.rand(5, 3), torch.tensor([[10.0, 0.0, 1.0]]), boxes)
    assert seen.observed.tolist() == [True, False, True, False]
    assert seen.hidden.tolist() == [False, True, False, False]
    assert seen.select(torch.tensor([3, 1])).hidden.tolist() == [False, True]
    # Where nobody says anything about drawing, as in a recording, nothing is known to be hidden.
    assert not unweighted(torch.rand(5, 3), torch.empty(0, 3), TWO).hidden.any()


def test_weights_cannot_be_forgotten():
    with pytest.raises(TypeError, match="reference_weights"):
        measure_box_visibility(torch.rand(5, 3), torch.rand(5, 3), TWO)


def test_selecting_keeps_the_columns_together():
    seen = unweighted(torch.rand(5, 3), torch.tensor([[10.0, 0.0, 1.0]]), TWO)
    one = seen.select(seen.observed)
    assert len(one) == 1
    assert one.reference_points.tolist() == [1]


def test_frames_without_boxes_raise_with_a_remedy():
    with pytest.raises(TypeError, match=r"boxes: Boxes are needed, .* got NoneType; SimulatedFrames\(.*boxes=True"):
        unweighted(torch.rand(5, 3), torch.rand(5, 3), None)


def test_frames_without_reference_raise_with_a_remedy():
    with pytest.raises(ValueError, match="reference: the frame has none, and visibility is measured against it; use"):
        unweighted(torch.rand(5, 3), None, TWO)


def test_boxes_without_points_or_around_vehicles_are_unknown():
    around = Boxes.from_rows(torch.cat([TWO.rows, torch.tensor([[0.0, 0.0, 1.0, 4.0, 4.0, 4.0, 0.0]])]))
    seen = unweighted(torch.tensor([[0.5, 0.5, 1.0]]), torch.empty(0, 3), around)
    assert seen.share.isnan().all()
    assert seen.mean_radius_m.isnan().all()
    assert seen.sensor_points.tolist() == [0, 0, 1]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sensor": torch.full((5, 3), math.nan)}, "sensor: 5 of 5 points have NaN"),
        ({"reference": torch.zeros(5, 4)}, r"reference: shape \(N, 3\) is needed; got \(5, 4\)"),
        ({"threshold_m": -0.1}, "threshold: a distance >= 0 in meters is needed; got -0.1"),
        ({"threshold_m": math.nan}, "threshold: .* got nan"),
        ({"reference_weights": torch.ones(4)}, r"reference_weights: shape \(5,\), one for each .*got \(4,\)"),
        ({"reference_weights": torch.zeros(5)}, "reference_weights: finite weights > 0"),
        ({"reference_weights": torch.full((5,), math.nan)}, "reference_weights: finite weights > 0"),
    ],
)
def test_bad_input_is_refused(changes, message):
    good = {"sensor": torch.rand(5, 3), "reference": torch.rand(5, 3), "boxes": TWO, "reference_weights": None}
    with pytest.raises(ValueError, match=message):
        measure_box_visibility(**{**good, **changes})


def test_simulated_boxes_behind_the_rig_are_hidden():
    # Level, it sees all around.
    reference = PaperReference(rows=512, columns=512, max_tilt_deg=0.0)
    frame = SimulatedFrames("highway", "front_roof_128", num_frames=1, seed=1, reference_sensor=reference, boxes=True)[
        0
    ]
    seen = unweighted(frame.sensor, frame.reference, frame.boxes)
    known = seen.observed
    assert known.sum() >= 5
    assert torch.equal(seen.sensor_points, frame.boxes.points_in_box["front_roof_128"])
    # The rig looks 120 degrees forward: what is behind is blind, and what it sees, it has points on.
    behind = known & (frame.boxes.center_m[:, 0] < -10.0)
    assert (seen.share[behind] == 0).all()
    assert (seen.sensor_points[known & (seen.share > 0.5)] > 0).all()
    assert (seen.share[known] > 0.5).any()
