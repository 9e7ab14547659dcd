"""Target errors: what they may be, when a run stops, and what it says if it could not."""

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


def a_metric() -> CoverageMetric:
    return CoverageMetric(GRID, (0.4, 0.8), num_blocks=16)


def add(metric: CoverageMetric, index: int, scale: float = 0.3) -> None:
    """A radius between 0 and 1, and one that is `scale` of it."""
    radius = np.random.default_rng(index).random()
    reference = torch.tensor([[0.5, 0.5, 0.0], [1.5, 0.5, 0.0]])
    metric.update(
        reference - torch.tensor([[0.0, 0.0, radius], [0.0, 0.0, scale * radius]]), reference, block_index=index
    )


def filled(steps: int, scale: float = 0.3) -> CoverageMetric:
    metric = a_metric()
    for index in range(steps):
        add(metric, index, scale)
    return metric


def test_a_target_is_a_number_with_its_unit():
    assert TargetError.parse([]) is None
    assert TargetError.parse(["0.5%"]) == TargetError(detection=0.005)
    assert TargetError.parse([".02 m", " 1e-1 % "]) == TargetError(radius_m=0.02, detection=0.001)


@pytest.mark.parametrize(
    "word",
    ["0", "5", "0%", "-1m", "abc", "10cm", "nan%", "inf m", "1e999m", "1..2m", ".m", "%", "", "1 m 2%", "1,5m", "٣m"],
)
def test_rubbish_is_refused_by_its_name(word):
    with pytest.raises(ValueError, match=f"target error {re.escape(word)}: a positive number with its unit"):
        TargetError.parse(["0.1%" if word != "%" else "1m", word])


def test_two_targets_in_one_unit_are_refused():
    with pytest.raises(ValueError, match="target error 2%: another number in % was given before"):
        TargetError.parse(["1%", "1m", "2%"])


def test_every_known_number_of_every_rig_and_every_difference_counts():
    coverages = {"a": filled(40).compute(), "b": filled(40, scale=0.5).compute(), "c": filled(40).compute()}
    found = compute_convergence(TargetError(radius_m=0.1, detection=0.05), coverages, REGIONS)
    names = ["a", "b", "c", "b minus a", "c minus a"]
    quantities = ["radius_m", "detection_0.4m", "detection_0.8m"]
    # Nothing is known above: nothing waits for it.
    assert [(one.region, one.band, one.rig, one.quantity) for one in found] == [
        (region, "all", name, quantity) for region in ("near", "far") for name in names for quantity in quantities
    ]
    assert {one.target for one in found if one.quantity == "radius_m"} == {0.1}
    assert {one.target for one in found if one.quantity != "radius_m"} == {0.05}
    by_name = {(one.rig, one.region, one.quantity): one.error for one in found}
    (near, _, far, _) = coverages["b"].summary(REGIONS)
    assert by_name["b", "near", "radius_m"] == near.numbers["radius_m"].error
    assert by_name["b", "far", "detection_0.4m"] == far.numbers["detection_0.4m"].error
    difference = coverages["b"].estimate(REGIONS[1], "all").subtract(coverages["a"].estimate(REGIONS[1], "all"))
    assert by_name["b minus a", "far", "radius_m"] == float(difference.error[0]) > 0
    assert by_name["c minus a", "far", "radius_m"] == 0.0
    only_radius = compute_convergence(TargetError(radius_m=0.1), coverages, REGIONS)
    assert {one.quantity for one in only_radius} == {"radius_m"}


def test_errors_fall_with_the_root_of_the_steps():
    standing = ConvergenceStatus("a", "near", "all", "radius_m", error=0.3, target=0.1, num_frames=100)
    assert not standing.is_reached
    assert standing.frames_needed == pytest.approx(900, abs=1)
    unknown = ConvergenceStatus("a", "near", "all", "radius_m", error=math.nan, target=0.1, num_frames=100)
    assert (unknown.is_reached, unknown.frames_needed) == (False, None)
    early = ConvergenceStatus("a", "near", "all", "radius_m", error=0.0, target=0.1, num_frames=63)
    assert (early.is_reached, early.frames_needed) == (False, 64)


def test_a_run_stops_once_every_error_is_small_enough_at_two_looks_in_a_row():
    target = TargetError(radius_m=0.025)
    metric = a_metric()
    watch = TargetErrorRule(target, {"a": CoverageObserver(metric)}, REGIONS)
    looks, small, most = [], [], 4096
    for index in range(most):
        add(metric, index)
        steps, before = index + 1, watch.next_check_frame
        assert watch.estimate_num_frames(most) <= most
        if watch.is_reached(steps):
            break
        if watch.next_check_frame != before:
            looks.append(steps)
            small.append(watch.worst.error <= 0.025)
            assert watch.worst.region == "near"
            assert steps < watch.estimate_num_frames(most)
    # 0.29 / sqrt(steps) is the error of the mean of numbers in [0, 1).
    assert 0.5 * (0.289 / 0.025) ** 2 < steps < 2 * (0.289 / 0.025) ** 2
    assert looks[0] == 64
    assert small[-1]
    assert not any(first and second for first, second in itertools.pairwise(small))
    assert (np.diff([*looks, steps]) >= 3).all()
    assert len(looks) < 15
    record, lines = summarize_target_error(target, {"a": metric.compute()}, REGIONS, is_confirmed=True)
    assert record["reached"] is True
    assert record["frames_needed"] == steps
    assert record["unobserved"] == ["near above", "far above"]
    assert lines == [
        f"Target error reached after {steps} frames.",
        "Not part of the target, as none of its cells is observed: near above, far above.",
    ]


def test_small_enough_once_is_not_reached():
    coverages = {"a": filled(64, scale=0.01).compute()}
    record, lines = summarize_target_error(TargetError(radius_m=1.0), coverages, REGIONS, is_confirmed=False)
    assert all(number["is_reached"] for number in record["numbers"])
    assert record["reached"] is False
    assert lines[0].startswith("Target error not reached in 64 frames: every error is small enough, but not yet at two")


@pytest.mark.parametrize("steps", [5, 63])
def test_however_good_it_looks_no_run_ends_before_64_steps(steps):
    watch = TargetErrorRule(TargetError(radius_m=1e6), {"a": CoverageObserver(filled(steps))}, REGIONS)
    assert not watch.is_reached(steps)
    record, (first, *_) = summarize_target_error(
        watch.target, {"a": filled(steps).compute()}, REGIONS, is_confirmed=False
    )
    assert record["reached"] is False
    assert first.startswith(f"Target error not reached in {steps} frames")


def test_nothing_known_is_not_good_enough():
    metric = a_metric()
    for index in range(64):
        metric.update(torch.zeros(1, 3), torch.tensor([[-9.0, 0.0, 0.0]]), block_index=index)
    watch = TargetErrorRule(TargetError(radius_m=1.0), {"a": CoverageObserver(metric)}, REGIONS)
    assert not watch.is_reached(64)
    assert watch.estimate_num_frames(100) == 100
    record, lines = summarize_target_error(watch.target, {"a": metric.compute()}, REGIONS, is_confirmed=False)
    assert (record["reached"], record["frames_needed"], record["numbers"]) == (False, None, [])
    assert lines[0] == "Target error not reached: no region has an observed cell."


def test_what_was_not_reached_is_told_for_each_region_with_the_steps_it_would_take():
    target = TargetError(radius_m=0.005, detection=0.5)
    record, lines = summarize_target_error(target, {"a": filled(64, scale=0.01).compute()}, REGIONS, is_confirmed=False)
    assert re.fullmatch(
        r"  near all, radius_m of a: error 0\.03\d m \(target 0\.005 m\), about \d,\d00 different frames are needed",
        lines[1],
    )
    assert re.fullmatch(r"  far all, radius_m of a: error 0\.000\d+ m \(target 0\.005 m\), reached", lines[2])
    assert record["radius_m"] == 0.005
    worst = max(record["numbers"], key=lambda number: number["frames_needed"])
    assert record["frames_needed"] == worst["frames_needed"] == math.ceil(64 * (worst["error"] / 0.005) ** 2)
    json.dumps(record, allow_nan=False)


def test_what_all_steps_say_alike_is_not_waited_for_and_named():
    _, lines = summarize_target_error(
        TargetError(detection=0.5), {"a": filled(64).compute()}, REGIONS, is_confirmed=True
    )
    assert [line for line in lines if "the same value" in line] == [
        "Not part of the target, as all frames have the same value: far all, detection_0.4m of a; "
        "far all, detection_0.8m of a."
    ]


def test_without_an_error_no_number_of_steps_is_made_up():
    record, lines = summarize_target_error(
        TargetError(radius_m=0.01), {"a": filled(5).compute()}, REGIONS, is_confirmed=False
    )
    assert record["frames_needed"] is None
    assert {number["error"] for number in record["numbers"]} == {None}
    assert lines[1] == "  near all, radius_m of a: not enough frames for an error"
    json.dumps(record, allow_nan=False)


def test_without_a_target_nothing_is_said():
    assert summarize_target_error(None, {"a": filled(5).compute()}, REGIONS, is_confirmed=False) == (None, [])


@pytest.mark.parametrize(
    "sizes", [{}, {"radius_m": 0.0}, {"detection": -0.1}, {"radius_m": math.nan, "detection": 0.1}]
)
def test_a_target_that_no_run_or_every_run_reaches_is_refused(sizes):
    with pytest.raises(ValueError, match="target error: "):
        TargetError(**sizes)


def test_words_may_stand_alone_and_numbers_need_a_unit():
    assert TargetError.parse("0.5%") == TargetError(detection=0.005)
    with pytest.raises(TypeError, match=r'numbers with their units are needed, "0\.1%"'):
        TargetError.parse(0.1)
