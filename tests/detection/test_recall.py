"""Matching, and recall and precision over visibility and distance."""

import math
import re
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from scipy.stats import binomtest

from torchcover.detection import Boxes, BoxVisibility, RecallByVisibility, compute_bev_iou, match_detections, matching
from torchcover.detection.recall_curve import RatioWithInterval

VISIBILITY, DISTANCE = (0.2, 0.4, 0.6, 0.8), (20.0, 40.0, 60.0)


def row(x, y, length=4.0, width=2.0, yaw=0.0):
    return [x, y, 0.75, length, width, 1.5, yaw]


# Overlap seen from above.


def test_axis_aligned_overlap_equals_its_closed_form():
    generator = np.random.default_rng(0)
    a, b = (np.column_stack([generator.uniform(-3, 3, (60, 2)), generator.uniform(0.5, 6, (60, 2))]) for _ in range(2))
    rows = [torch.tensor([row(*box) for box in boxes.tolist()], dtype=torch.float64) for boxes in (a, b)]
    lower = np.maximum(a[:, None, :2] - a[:, None, 2:] / 2, b[None, :, :2] - b[None, :, 2:] / 2)
    upper = np.minimum(a[:, None, :2] + a[:, None, 2:] / 2, b[None, :, :2] + b[None, :, 2:] / 2)
    shared = np.clip(upper - lower, 0, None).prod(axis=2)
    expected = shared / (a[:, None, 2:].prod(axis=2) + b[None, :, 2:].prod(axis=2) - shared)
    np.testing.assert_allclose(compute_bev_iou(*rows).numpy(), expected, atol=1e-12)
    # Turned together by any angle, it is the same; by a quarter, length and width change places.
    for angle in (0.3, math.pi / 4, 2.0):
        c, s = math.cos(angle), math.sin(angle)
        turned = []
        for straight in rows:
            boxes = straight.clone()
            boxes[:, :2] = boxes[:, :2] @ torch.tensor([[c, s], [-s, c]], dtype=torch.float64)
            boxes[:, 6] += angle
            turned.append(boxes)
        np.testing.assert_allclose(compute_bev_iou(*turned).numpy(), expected, atol=1e-12)
    quarter = rows[1][:, [0, 1, 2, 4, 3, 5, 6]].clone()
    quarter[:, 6] += math.pi / 2
    np.testing.assert_allclose(compute_bev_iou(rows[0], quarter).numpy(), expected, atol=1e-12)


def test_boxes_with_separate_circles_are_not_compared(monkeypatch):
    asked = []
    monkeypatch.setattr(
        matching, "_compute_intersection_m2", lambda a, b: asked.append(len(a)) or torch.zeros(len(a)).double()
    )
    diagonal = math.hypot(4.0, 2.0)
    compute_bev_iou(torch.tensor([row(0.0, 0.0)]), torch.tensor([row(1.01 * diagonal, 0.0), row(0.0, 0.99 * diagonal)]))
    assert asked == [1]


def test_overlap_of_turned_boxes_against_a_fine_raster():
    generator = torch.Generator().manual_seed(5)
    boxes = torch.rand(14, 7, generator=generator).double() * torch.tensor([2.0, 2, 1, 4, 3, 1, 7]) + 0.2
    step = 0.01
    ticks = torch.arange(-3.0, 7.0, step, dtype=torch.float64) + step / 2
    x, y = torch.meshgrid(ticks, ticks, indexing="ij")
    masks = []
    for cx, cy, _, length, width, _, yaw in boxes.tolist():
        along = (x - cx) * math.cos(yaw) + (y - cy) * math.sin(yaw)
        across = (y - cy) * math.cos(yaw) - (x - cx) * math.sin(yaw)
        masks.append(((along.abs() <= length / 2) & (across.abs() <= width / 2)).flatten().float())
    stack = torch.stack(masks)
    both = stack @ stack.T
    expected = both / (stack.sum(dim=1)[:, None] + stack.sum(dim=1)[None] - both)
    found = compute_bev_iou(boxes, boxes)
    assert ((found > 0.05) & (found < 0.95)).sum() > 40
    torch.testing.assert_close(found, expected.double(), atol=0.02, rtol=0)


def test_squares_rotated_by_45_degrees_share_an_octagon():
    square = torch.tensor([row(0, 0, 1, 1)])
    octagon = 2 * (math.sqrt(2) - 1)
    turned = torch.tensor([row(0, 0, 1, 1, math.pi / 4)], dtype=torch.float64)
    assert compute_bev_iou(square, turned).item() == pytest.approx(octagon / (2 - octagon), abs=1e-12)


def test_overlap_is_symmetric_and_one_with_itself():
    boxes = torch.rand(50, 7, dtype=torch.float64) * torch.tensor([5.0, 5, 1, 4, 3, 1, 7]) + 0.1
    boxes[:, 0] += 3e4  # far away, nothing is lost
    found = compute_bev_iou(boxes, boxes)
    torch.testing.assert_close(found, found.T, atol=1e-9, rtol=0)
    torch.testing.assert_close(found.diagonal(), torch.ones(50, dtype=torch.float64), atol=1e-9, rtol=0)
    flat = torch.tensor([row(0, 0, 0.0, 2.0), row(0, 0, 0.0, 0.0)])
    assert not compute_bev_iou(flat, flat).any()
    assert not compute_bev_iou(torch.tensor([row(0, 0)]), torch.tensor([row(4.0, 0), row(0, 2.0)])).any()  # they touch
    assert compute_bev_iou(torch.empty(0, 7), boxes).shape == (0, 50)


# Matching.


def slow_match(detections, scores, truth, by, threshold):
    """Step by step, in the order of the rule."""
    taken, answer = set(), [-1] * len(detections)
    for n in sorted(range(len(detections)), key=lambda k: -scores[k]):
        best, best_cost = None, math.inf
        for k in range(len(truth)):
            if by == "distance":
                cost = math.dist(detections[n][:2], truth[k][:2])
                allowed = cost < threshold
            else:
                cost = -compute_bev_iou(torch.tensor([detections[n]]), torch.tensor([truth[k]])).item()
                allowed = cost <= -threshold
            if k not in taken and allowed and cost < best_cost:
                best, best_cost = k, cost
        if best is not None:
            taken.add(best)
            answer[n] = best
    return answer


@pytest.mark.parametrize(("by", "threshold"), [("distance", 2.0), ("iou", 0.2)])
@pytest.mark.parametrize("seed", range(4))
def test_matches_are_those_of_a_slow_twin(by, threshold, seed):
    generator = torch.Generator().manual_seed(seed)
    truth = torch.rand(12, 7, generator=generator).double() * torch.tensor([12.0, 12, 0, 3, 2, 1, 6]) + 0.5
    detections = truth.repeat(2, 1) + torch.randn(24, 7, generator=generator) * torch.tensor(
        [0.7, 0.7, 0, 0, 0, 0, 0.1]
    )
    scores = (torch.rand(24, generator=generator) * 6).round() / 6  # with ties
    found = match_detections(detections, scores, truth, by, threshold)
    assert found.tolist() == slow_match(detections.tolist(), scores.tolist(), truth.tolist(), by, threshold)
    assert (found >= 0).sum() >= 6


def test_higher_scores_match_before_nearer_detections():
    truth = torch.tensor([row(0.0, 0.0), row(3.0, 0.0)])
    detections = torch.tensor([row(0.1, 0.0), row(1.0, 0.0)])
    # The second detection takes object 0; the first, nearer to it, is left with none within 2 m.
    assert match_detections(detections, torch.tensor([0.5, 0.9]), truth, "distance", 2.0).tolist() == [-1, 0]
    assert match_detections(detections, torch.tensor([0.9, 0.5]), truth, "distance", 2.01).tolist() == [0, 1]


def test_only_the_box_itself_has_overlap_one():
    truth = torch.tensor([row(0.0, 0.0), row(20.0, 0.0)])
    metric = RecallByVisibility(match_by="iou", threshold=1.0)
    moved = truth + torch.tensor([0, 0, 0, 0, 0, 0, 0.01]) * torch.tensor([[0.0], [1.0]])
    metric.update(moved, Boxes.from_rows(truth), torch.ones(2))
    assert metric.compute().compute_overall().recall.value.item() == 0.5


def test_distance_excludes_and_overlap_includes_the_threshold():
    truth = torch.tensor([row(0.0, 0.0)])
    assert match_detections(torch.tensor([row(2.0, 0.0)]), torch.ones(1), truth, "distance", 2.0).tolist() == [-1]
    # 2 of 6 square metres, as exact in binary as 1/3 can be.
    third = compute_bev_iou(torch.tensor([row(2.0, 0.0)]), truth).item()
    assert match_detections(torch.tensor([row(2.0, 0.0)]), torch.ones(1), truth, "iou", third).tolist() == [0]


def test_invalid_criteria_and_missing_scores_are_rejected():
    boxes = torch.tensor([row(0, 0), row(9, 0)])
    with pytest.raises(ValueError, match="match_by: 'distance' or 'iou' is needed; got 'centre'"):
        match_detections(boxes, torch.ones(2), boxes, "centre", 2.0)
    with pytest.raises(ValueError, match=r"scores: one for each of 2 detections is needed; got \(1,\)"):
        match_detections(boxes, torch.ones(1), boxes, "distance", 2.0)


def test_nothing_matches_nothing():
    none = torch.empty(0, 7)
    assert match_detections(none, torch.empty(0), torch.tensor([row(0, 0)]), "iou", 0.5).tolist() == []
    assert match_detections(torch.tensor([row(0, 0)]), torch.ones(1), none, "distance", 2.0).tolist() == [-1]


# The metric.


def random_frame(seed):
    generator = torch.Generator().manual_seed(seed)
    count = int(torch.randint(0, 9, (1,), generator=generator))
    truth = torch.rand(count, 7, generator=generator) * torch.tensor([120.0, 60, 1, 4, 2, 1, 6]) + 0.3
    jitter = torch.randn(count, 7, generator=generator) * torch.tensor([1.2, 1.2, 0, 0, 0, 0, 0])
    false = torch.rand(4, 7, generator=generator) * torch.tensor([120.0, 60, 1, 4, 2, 1, 6]) + 0.3
    detections = torch.cat([truth + jitter, false])
    share = torch.rand(count, generator=generator).double()
    share[torch.rand(count, generator=generator) < 0.3] = math.nan
    drawn = torch.randint(0, 3, (count,), generator=generator)
    seen = BoxVisibility(share, share, (~share.isnan()).long(), drawn, drawn, 0.4)
    own = torch.rand(count + 4, generator=generator).double()
    return detections, Boxes.from_rows(truth), seen, torch.rand(count + 4, generator=generator), own


def slow_counts(frames, scores_at):
    """Counts in nested loops."""

    def cell(x, y, share, drawn=0):
        line = (5 if drawn else 6) if math.isnan(share) else sum(share >= border for border in VISIBILITY)
        return line, sum(math.hypot(x, y) >= border for border in DISTANCE)

    objects = np.zeros((7, 4), dtype=int)
    found, detected, true = (np.zeros((len(scores_at), 7, 4), dtype=int) for _ in range(3))
    for detections, boxes, seen, scores, own in frames:
        objects_seen = list(zip(seen.share.tolist(), seen.sampled_points.tolist(), strict=True))
        truth = boxes.rows.double().tolist()
        chosen = slow_match(detections.double().tolist(), scores.tolist(), truth, "distance", 2.0)
        for k, box in enumerate(truth):
            objects[cell(*box[:2], *objects_seen[k])] += 1
        for n, box in enumerate(detections.double().tolist()):
            for s, least in enumerate(scores_at):
                if float(scores[n]) >= least:
                    detected[s][cell(*box[:2], float(own[n]))] += 1
                    if chosen[n] >= 0:
                        true[s][cell(*box[:2], float(own[n]))] += 1
                        found[s][cell(*truth[chosen[n]][:2], *objects_seen[chosen[n]])] += 1
    return objects, found, detected, true


FRAMES = [random_frame(seed) for seed in range(40)]
NAMES = ("objects", "detected_objects", "detections", "true_detections")


def filled(frames, **options):
    metric = RecallByVisibility(score_thresholds=(0.0, 0.5), **options)
    for detections, boxes, share, scores, own in frames:
        metric.update(detections, boxes, share, scores, own)
    return metric


def counts_of(metric):
    result = metric.compute()
    return [getattr(result, name).tolist() for name in NAMES]


def test_counts_are_those_of_a_slow_twin():
    expected = slow_counts(FRAMES, (0.0, 0.5))
    assert counts_of(filled(FRAMES)) == [count.tolist() for count in expected]
    assert all(count.sum() > 20 for count in expected)


def test_lower_thresholds_only_add_matches():
    """Matches of the detections above a score are those of the full list, since the higher score chooses first."""
    only_high = [(d[s >= 0.5], boxes, share, s[s >= 0.5], own[s >= 0.5]) for d, boxes, share, s, own in FRAMES]
    both, high = filled(FRAMES).compute(), filled(only_high).compute()
    for name in NAMES[1:]:
        assert torch.equal(getattr(both, name)[1], getattr(high, name)[0])


def test_reset_works_under_inference_mode():
    metric = filled(FRAMES[:3])
    with torch.inference_mode():
        metric.reset()
        metric.update(*FRAMES[4])
    metric.update(*FRAMES[5])
    assert counts_of(metric) == counts_of(filled(FRAMES[4:6]))


def test_recall_and_precision_are_quotients_of_counts():
    objects, found, detected, true = slow_counts(FRAMES, (0.0, 0.5))
    result = filled(FRAMES).compute()
    for axis, summed in {"visibility": 2, "distance": 1}.items():
        curve = result.compute_curve(axis)
        with np.errstate(invalid="ignore"):
            np.testing.assert_allclose(
                curve.recall.value.numpy(), found.sum(axis=summed) / objects.sum(axis=summed - 1), err_msg=axis
            )
            np.testing.assert_allclose(
                curve.precision.value.numpy(), true.sum(axis=summed) / detected.sum(axis=summed), err_msg=axis
            )
        assert len(curve.bins) == curve.recall.value.shape[1]
        assert (curve.recall.trials[0].numpy() == objects.sum(axis=summed - 1)).all()
    assert result.compute_overall().recall.value[0, 0] == found[0].sum() / objects.sum()


def test_bins_are_half_open_except_the_last():
    metric = RecallByVisibility(visibility_borders=(0.5,), distance_borders=(10.0,))
    boxes = Boxes.from_rows(torch.tensor([row(10.0, 0.0), row(0.0, -9.99), row(6.0, 8.0), row(500.0, 0.0)]))
    metric.update(torch.empty(0, 7), boxes, torch.tensor([0.5, 0.499999, 1.0, math.nan]))
    result = metric.compute()
    assert result.objects.tolist() == [[1, 0], [0, 2], [0, 0], [0, 1]]
    assert result.visibility_bins == ("0-0.5", "0.5-1", "hidden", "not sampled")
    assert result.distance_bins == ("0-10 m", "over 10 m")


def test_precision_over_visibility_needs_visibility_of_detections():
    metric = RecallByVisibility()
    detections, boxes, share, scores, _ = FRAMES[1]
    metric.update(detections, boxes, share, scores)
    result = metric.compute()
    assert result.compute_curve("visibility").precision.trials[0].tolist() == [0] * 6 + [len(detections)]
    assert result.compute_curve("visibility").precision.value[0, :-1].isnan().all()
    assert result.compute_curve("distance").precision.trials.sum() == len(detections)


def test_without_scores_the_first_detection_matches_first():
    metric = RecallByVisibility(score_thresholds=(0.9,))
    truth = Boxes.from_rows(torch.tensor([row(5.0, 0.0)]))
    metric.update(torch.tensor([row(6.0, 0.0), row(5.0, 0.0)]), truth, torch.tensor([0.9]))
    assert metric.compute().compute_overall().recall.value.item() == 1.0
    assert metric.compute().compute_overall().precision.value.item() == 0.5


def test_a_score_of_exactly_the_threshold_counts():
    metric = RecallByVisibility(score_thresholds=(0.5, 0.51))
    truth = Boxes.from_rows(torch.tensor([row(5.0, 0.0)]))
    metric.update(truth.rows, truth, torch.tensor([0.9]), torch.tensor([0.5]))
    result = metric.compute().compute_overall()
    assert result.recall.value.flatten().tolist() == [1.0, 0.0]
    assert result.precision.trials.flatten().tolist() == [1, 0]


@pytest.mark.parametrize("count", [0, 3])
def test_frames_without_objects_or_detections_are_counted(count):
    metric = RecallByVisibility()
    none = Boxes.from_rows(torch.empty(0, 7))
    metric.update(torch.rand(count, 7), none, torch.empty(0), torch.rand(count))
    result = metric.compute()
    assert result.num_frames == 1
    assert result.compute_overall().recall.value.isnan().all()
    assert result.compute_overall().precision.trials.item() == count


def test_scalars_are_floats_with_their_counts():
    scalars = RecallByVisibility(visibility_borders=(0.5,), distance_borders=())
    scalars.update(torch.tensor([row(5.0, 0.0)]), Boxes.from_rows(torch.tensor([row(5.0, 0.0)])), torch.tensor([0.7]))
    flat = scalars.compute().to_scalars()
    assert flat["recall/all"] == 1.0
    assert flat["recall/visibility 0.5-1"] == 1.0
    assert math.isnan(flat["recall/visibility 0-0.5"])
    assert flat["objects/visibility 0-0.5"] == 0.0
    assert flat["precision/distance over 0 m"] == 1.0
    assert all(isinstance(value, float) for value in flat.values())
    several = filled(FRAMES).compute().to_scalars()
    assert several["recall_score_0.5/all"] <= several["recall_score_0/all"]


def test_intervals_are_wilson_s_and_unknown_without_trials():
    successes, trials = torch.tensor([8, 0, 10, 1, 57, 0]), torch.tensor([10, 10, 10, 400, 60, 0])
    ratio = RatioWithInterval.from_counts(successes, trials)
    for k in range(5):
        exact = binomtest(int(successes[k]), int(trials[k])).proportion_ci(0.95, method="wilson")
        assert ratio.low[k].item() == pytest.approx(exact.low, abs=1e-12)
        assert ratio.high[k].item() == pytest.approx(exact.high, abs=1e-12)
    assert torch.stack([ratio.value[5], ratio.low[5], ratio.high[5]]).isnan().all()
    # Tensors cannot say whether they are equal: each is what it is.
    assert len({ratio, replace(ratio)}) == 2
    assert ratio != replace(ratio)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"match_by": "height"}, "match_by: 'distance' or 'iou' is needed; got 'height'"),
        ({"threshold": 0.0}, "threshold: meters > 0"),
        ({"match_by": "iou", "threshold": 2.0}, r"threshold: .* a share in \(0, 1\] for 'iou', is needed; got 2.0"),
        ({"visibility_borders": (0.4, 0.4)}, r"visibility_borders: ascending numbers within \(0, 1\)"),
        ({"visibility_borders": (0.5, 1.0)}, "visibility_borders: ascending"),
        ({"distance_borders": (-5.0, 20.0)}, r"distance_borders: ascending numbers within \(0, inf\)"),
        ({"distance_borders": (math.nan,)}, "distance_borders: ascending"),
        ({"score_thresholds": ()}, "score_thresholds: at least one number"),
        ({"score_thresholds": (math.nan,)}, "score_thresholds: at least one number"),
    ],
)
def test_impossible_parameters_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        RecallByVisibility(**options)


@pytest.mark.parametrize("column", range(7))
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, -1e-9])
def test_one_bad_number_of_a_detection_is_enough(column, bad):
    detections = torch.tensor([row(0, 0)] * 3).double()
    detections[1, column] = bad
    boxes, share = Boxes.from_rows(torch.tensor([row(0, 0)])), torch.tensor([0.5])
    if bad == -1e-9 and column not in (3, 4, 5):
        RecallByVisibility().update(detections, boxes, share)
        return
    with pytest.raises(ValueError, match=r"1 of 3 have NaN .*the first is 1; remove them"):
        RecallByVisibility().update(detections, boxes, share)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"detections": torch.zeros(2, 6)}, r"detections: shape \(N, 7\) is needed.*got \(2, 6\)"),
        ({"detections": torch.full((2, 7), math.nan)}, "detections: 2 of 2 have NaN or infinite numbers"),
        ({"detections": torch.tensor([row(0, 0), row(0, 0, -1.0)])}, "1 of 2 have NaN .*negative size, the first is 1"),
        ({"scores": torch.tensor([0.5])}, r"scores: one number for each of 2 detections is needed; got shape \(1,\)"),
        ({"scores": torch.tensor([0.5, math.nan])}, "scores: .* with 1 NaN"),
        ({"visibility": torch.tensor([0.5, 0.5])}, r"visibility: 1 shares in \[0, 1\] are needed"),
        ({"visibility": torch.tensor([40.0])}, r"visibility: 1 shares .* 1 of them outside"),
        ({"detection_visibility": torch.tensor([0.5])}, "detection_visibility: 2 shares"),
        ({"boxes": []}, "one entry for each frame is needed in every list; got 1, 0, 1, 1, 1 entries"),
    ],
)
def test_invalid_frames_do_not_change_the_state(changes, message):
    metric = RecallByVisibility()
    good = {
        "detections": torch.tensor([row(0, 0)] * 2),
        "boxes": Boxes.from_rows(torch.tensor([row(0, 0)])),
        "visibility": torch.tensor([0.5]),
    }
    with pytest.raises(ValueError, match=message):
        metric.update(**{**good, **changes})
    assert int(metric.num_frames) == 0


def test_frames_without_boxes_are_rejected():
    with pytest.raises(TypeError, match=r"boxes: Boxes are needed, .* got NoneType"):
        RecallByVisibility().update(torch.empty(0, 7), None, torch.empty(0))


def test_intervals_end_at_zero_and_one():
    trials = torch.arange(1, 20_000)
    every, none = (RatioWithInterval.from_counts(successes, trials) for successes in (trials, torch.zeros_like(trials)))
    assert every.high.max() == 1.0
    assert none.low.min() == 0.0


def test_recall_plot_shows_wilson_intervals_of_occupied_bins():
    metric = RecallByVisibility(visibility_borders=(0.5,), score_thresholds=(0.0, 0.5))
    rows = torch.tensor([row(10 * k, 0) for k in range(1, 4)])
    metric.update(rows[:2], Boxes.from_rows(rows), torch.tensor([0.9, 0.1, math.nan]), torch.tensor([0.9, 0.3]))
    curve = metric.compute().compute_curve("visibility")
    for at, score in enumerate((None, 0.5)):
        figure, axes = metric.plot(score_threshold=score)
        points, (bars,) = axes.lines[0].get_xydata(), axes.collections
        assert points[:, 0].tolist() == [0, 1, 3]
        assert points[:, 1].tolist() == curve.recall.value[at, [0, 1, 3]].tolist() == [[1, 1, 0], [0, 1, 0]][at]
        ends = np.array([segment[:, 1] for segment in bars.get_segments()])
        expected = torch.stack([curve.recall.low[at], curve.recall.high[at]], dim=1)[[0, 1, 3]]
        np.testing.assert_allclose(ends, expected, atol=1e-12)
        assert [len(caps.get_xdata()) for caps in axes.lines[1:]] == [3, 3]  # both ends of each interval are marked
        assert [label.get_text().split("\n")[1] for label in axes.get_xticklabels()] == ["1", "1", "0", "1"]
        assert axes.get_xlabel() == "visibility of the object; second line: number of objects"
        plt.close(figure)
    with pytest.raises(ValueError, match=r"score_threshold: one of \(0.0, 0.5\) is needed; got 0.4"):
        metric.plot(score_threshold=0.4)


def test_bottom_centers_instead_of_centers_warn_once():
    """As MMDetection3D has them; 24 objects in 3 frames."""
    rows = torch.rand(8, 7) * 30 + torch.tensor([0.0, 0, 0, 4, 2, 1.5, 0])
    rows[:, 5], rows[:, 6] = 1.5, 0.0
    rows[:, 2] = 0.75  # the center of what stands on the ground

    def run(rows):
        metric = RecallByVisibility()
        for _ in range(4):
            metric.update(rows, Boxes.from_rows(rows), torch.ones(len(rows)))

    run(rows)
    rows[:, 2] = 0.1
    with pytest.warns(UserWarning, match="boxes: 24 of 24 have their center on the ground") as warned:
        run(rows)
    assert len(warned) == 1


def test_keys_are_those_that_every_logger_takes():
    metric = RecallByVisibility(score_thresholds=(0.0, 0.5))
    metric.update([], [], [])
    legal = re.compile(r"[\w\-. /]+")  # of MLflow
    assert all(legal.fullmatch(key) for key in metric.compute().to_scalars())
