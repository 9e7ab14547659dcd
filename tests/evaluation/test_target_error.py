"""Target errors: valid values, the end of a run, and the lines about errors that were not reached."""

import itertools
import json
import math
import re

import numpy as np
import pytest
import torch

from torchcover import BevGrid, CoverageMetric, Region
from torchcover.evaluation import (
    ConvergenceStatus,
    CoverageObserver,
    TargetError,
    TargetErrorRule,
    compute_convergence,
    summarize_target_error,
)

GRID = BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0), cell_m=1.0, heights={"all": (-0.5, 0.5), "above": (0.5, 1.0)})
REGIONS = (Region("near", (0.0, 1.0), (0.0, 1.0)), Region("far", (1.0, 2.0), (0.0, 1.0)))


def create_metric() -> CoverageMetric:
    return CoverageMetric(GRID, (0.4, 0.8), num_blocks=16)


def add_frame(metric: CoverageMetric, index: int, scale: float = 0.3) -> None:
    """Add a point with a random radius between 0 and 1, and one with `scale` times this radius."""
    radius = np.random.default_rng(index).random()
    reference = torch.tensor([[0.5, 0.5, 0.0], [1.5, 0.5, 0.0]])
    metric.update(
        reference - torch.tensor([[0.0, 0.0, radius], [0.0, 0.0, scale * radius]]), reference, block_index=index
    )


def fill_metric(num_frames: int, scale: float = 0.3) -> CoverageMetric:
    metric = create_metric()
    for index in range(num_frames):
        add_frame(metric, index, scale)
    return metric


def test_target_errors_are_numbers_with_units():
    assert TargetError.parse([]) is None
    assert TargetError.parse(["0.5%"]) == TargetError(detection=0.005)
    assert TargetError.parse([".02 m", " 1e-1 % "]) == TargetError(radius_m=0.02, detection=0.001)


@pytest.mark.parametrize(
    "word",
    ["0", "5", "0%", "-1m", "abc", "10cm", "nan%", "inf m", "1e999m", "1..2m", ".m", "%", "", "1 m 2%", "1,5m", "٣m"],
)
def test_invalid_target_errors_are_named(word):
    with pytest.raises(ValueError, match=f"target error {re.escape(word)}: a positive number with its unit"):
        TargetError.parse(["0.1%" if word != "%" else "1m", word])


def test_two_targets_in_one_unit_are_rejected():
    with pytest.raises(ValueError, match="target error 2%: another number in % was given before"):
        TargetError.parse(["1%", "1m", "2%"])


def test_target_errors_apply_to_numbers_and_differences():
    coverages = {
        "a": fill_metric(40).compute(),
        "b": fill_metric(40, scale=0.5).compute(),
        "c": fill_metric(40).compute(),
    }
    statuses = compute_convergence(TargetError(radius_m=0.1, detection=0.05), coverages, REGIONS)
    names = ["a", "b", "c", "b minus a", "c minus a"]
    quantities = ["radius_m", "detection_0.4m", "detection_0.8m"]
    # The band above has no observed cell, so it is not part of the target.
    assert [(status.region, status.band, status.rig, status.quantity) for status in statuses] == [
        (region, "all", name, quantity) for region in ("near", "far") for name in names for quantity in quantities
    ]
    assert {status.target for status in statuses if status.quantity == "radius_m"} == {0.1}
    assert {status.target for status in statuses if status.quantity != "radius_m"} == {0.05}
    by_name = {(status.rig, status.region, status.quantity): status.error for status in statuses}
    (near, _, far, _) = coverages["b"].summary(REGIONS)
    assert by_name["b", "near", "radius_m"] == near.numbers["radius_m"].error
    assert by_name["b", "far", "detection_0.4m"] == far.numbers["detection_0.4m"].error
    difference = coverages["b"].estimate(REGIONS[1], "all").subtract(coverages["a"].estimate(REGIONS[1], "all"))
    assert by_name["b minus a", "far", "radius_m"] == float(difference.error[0]) > 0
    assert by_name["c minus a", "far", "radius_m"] == 0.0
    only_radius = compute_convergence(TargetError(radius_m=0.1), coverages, REGIONS)
    assert {status.quantity for status in only_radius} == {"radius_m"}


def test_errors_fall_with_the_root_of_frames():
    status = ConvergenceStatus("a", "near", "all", "radius_m", error=0.3, target=0.1, num_frames=100)
    assert not status.is_reached
    assert status.frames_needed == pytest.approx(900, abs=1)
    unknown = ConvergenceStatus("a", "near", "all", "radius_m", error=math.nan, target=0.1, num_frames=100)
    assert (unknown.is_reached, unknown.frames_needed) == (False, None)
    early = ConvergenceStatus("a", "near", "all", "radius_m", error=0.0, target=0.1, num_frames=63)
    assert (early.is_reached, early.frames_needed) == (False, 64)


def test_runs_stop_after_two_successful_checks():
    target = TargetError(radius_m=0.025)
    metric = create_metric()
    rule = TargetErrorRule(target, {"a": CoverageObserver(metric)}, REGIONS)
    check_frames, was_reached, max_frames = [], [], 4096
    for index in range(max_frames):
        add_frame(metric, index)
        num_frames, before = index + 1, rule.next_check_frame
        assert rule.estimate_num_frames(max_frames) <= max_frames
        if rule.is_reached(num_frames):
            break
        if rule.next_check_frame != before:
            check_frames.append(num_frames)
            was_reached.append(rule.worst.error <= 0.025)
            assert rule.worst.region == "near"
            assert num_frames < rule.estimate_num_frames(max_frames)
    # 0.289 / sqrt(n) is the standard error of the mean of n uniform numbers in [0, 1).
    assert 0.5 * (0.289 / 0.025) ** 2 < num_frames < 2 * (0.289 / 0.025) ** 2
    assert check_frames[0] == 64
    assert was_reached[-1]
    assert not any(first and second for first, second in itertools.pairwise(was_reached))
    assert (np.diff([*check_frames, num_frames]) >= 3).all()
    assert len(check_frames) < 15
    record, lines = summarize_target_error(target, {"a": metric.compute()}, REGIONS, is_confirmed=True)
    assert record["reached"] is True
    assert record["frames_needed"] == num_frames
    assert record["unobserved"] == ["near above", "far above"]
    assert lines == [
        f"Target error reached after {num_frames} frames.",
        "Not part of the target, as none of its cells is observed: near above, far above.",
    ]


def test_one_successful_check_is_not_enough():
    coverages = {"a": fill_metric(64, scale=0.01).compute()}
    record, lines = summarize_target_error(TargetError(radius_m=1.0), coverages, REGIONS, is_confirmed=False)
    assert all(number["is_reached"] for number in record["numbers"])
    assert record["reached"] is False
    assert lines[0].startswith("Target error not reached in 64 frames: every error is small enough, but not yet at two")


@pytest.mark.parametrize("num_frames", [5, 63])
def test_no_run_ends_before_64_frames(num_frames):
    rule = TargetErrorRule(TargetError(radius_m=1e6), {"a": CoverageObserver(fill_metric(num_frames))}, REGIONS)
    assert not rule.is_reached(num_frames)
    record, (first, *_) = summarize_target_error(
        rule.target, {"a": fill_metric(num_frames).compute()}, REGIONS, is_confirmed=False
    )
    assert record["reached"] is False
    assert first.startswith(f"Target error not reached in {num_frames} frames")


def test_unobserved_regions_never_reach_the_target():
    metric = create_metric()
    for index in range(64):
        metric.update(torch.zeros(1, 3), torch.tensor([[-9.0, 0.0, 0.0]]), block_index=index)
    rule = TargetErrorRule(TargetError(radius_m=1.0), {"a": CoverageObserver(metric)}, REGIONS)
    assert not rule.is_reached(64)
    assert rule.estimate_num_frames(100) == 100
    record, lines = summarize_target_error(rule.target, {"a": metric.compute()}, REGIONS, is_confirmed=False)
    assert (record["reached"], record["frames_needed"], record["numbers"]) == (False, None, [])
    assert lines[0] == "Target error not reached: no region has an observed cell."


def test_lines_estimate_the_needed_frames():
    target = TargetError(radius_m=0.005, detection=0.5)
    record, lines = summarize_target_error(
        target, {"a": fill_metric(64, scale=0.01).compute()}, REGIONS, is_confirmed=False
    )
    assert re.fullmatch(
        r"  near all, radius_m of a: error 0\.03\d m \(target 0\.005 m\), about \d,\d00 different frames are needed",
        lines[1],
    )
    assert re.fullmatch(r"  far all, radius_m of a: error 0\.000\d+ m \(target 0\.005 m\), reached", lines[2])
    assert record["radius_m"] == 0.005
    worst = max(record["numbers"], key=lambda number: number["frames_needed"])
    assert record["frames_needed"] == worst["frames_needed"] == math.ceil(64 * (worst["error"] / 0.005) ** 2)
    json.dumps(record, allow_nan=False)


def test_constant_numbers_are_excluded_and_named():
    _, lines = summarize_target_error(
        TargetError(detection=0.5), {"a": fill_metric(64).compute()}, REGIONS, is_confirmed=True
    )
    assert [line for line in lines if "the same value" in line] == [
        "Not part of the target, as all frames have the same value: far all, detection_0.4m of a; "
        "far all, detection_0.8m of a."
    ]


def test_unknown_errors_give_no_frame_estimate():
    record, lines = summarize_target_error(
        TargetError(radius_m=0.01), {"a": fill_metric(5).compute()}, REGIONS, is_confirmed=False
    )
    assert record["frames_needed"] is None
    assert {number["error"] for number in record["numbers"]} == {None}
    assert lines[1] == "  near all, radius_m of a: not enough frames for an error"
    json.dumps(record, allow_nan=False)


def test_no_target_gives_no_lines():
    assert summarize_target_error(None, {"a": fill_metric(5).compute()}, REGIONS, is_confirmed=False) == (None, [])


@pytest.mark.parametrize(
    "sizes", [{}, {"radius_m": 0.0}, {"detection": -0.1}, {"radius_m": math.nan, "detection": 0.1}]
)
def test_unreachable_target_errors_are_rejected(sizes):
    with pytest.raises(ValueError, match="target error: "):
        TargetError(**sizes)


def test_target_errors_may_be_one_text():
    assert TargetError.parse("0.5%") == TargetError(detection=0.005)
    with pytest.raises(TypeError, match=r'numbers with their units are needed, "0\.1%"'):
        TargetError.parse(0.1)
