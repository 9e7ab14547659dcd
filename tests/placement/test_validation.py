"""Paired improvements, and the validation on held-out worlds."""

import numpy as np
import pytest
from scipy import stats

from tests.placement.worlds import create_frames, estimate_values, lidar, rig, yard
from torchcover.placement import Objective, validation
from torchcover.placement.search import compute_improvements, find_non_dominated
from torchcover.placement.validation import SideEffect, _list_extra_objectives, adjust_holm, validate

WORLDS, PER_WORLD = 6, 3
WORLD = np.repeat(np.arange(WORLDS), PER_WORLD)


def test_improvements_follow_a_paired_t_test():
    generator = np.random.default_rng(0)
    one, other = generator.normal(size=(2, 18, 2))
    lower = {"lower_is_better": ["o1"]}
    gain, error = compute_improvements(estimate_values(one, WORLD, **lower), estimate_values(other, WORLD, **lower))
    of_worlds = (one - other).reshape(6, 3, 2).mean(axis=1)
    expected = stats.ttest_1samp(of_worlds, 0.0)
    np.testing.assert_allclose(gain, of_worlds.mean(axis=0) * [1, -1])
    np.testing.assert_allclose(gain / error, expected.statistic * [1, -1])


@pytest.mark.parametrize("seed", range(4))
def test_pareto_front_contains_all_undominated_candidates(seed):
    values = np.random.default_rng(seed).integers(0, 5, (12, 3)).astype(float)
    order, front = np.random.default_rng(seed).permutation(12), find_non_dominated(values)
    assert np.array_equal(find_non_dominated(values[order]), front[order])
    for at, is_on_front in enumerate(front):
        assert is_on_front != ((values >= values[at]).all(1) & (values > values[at]).any(1)).any()


def test_two_worlds_have_no_error_however_many_frames():
    values = np.random.default_rng(0).normal(size=12)
    gain, error = compute_improvements(estimate_values(values, [0, 1] * 6), estimate_values(np.zeros(12), [0, 1] * 6))
    assert np.isnan(error[0])
    assert gain[0] == pytest.approx(values.mean())


def test_pairing_removes_common_scene_effects():
    generator = np.random.default_rng(1)
    city = generator.normal(0, 0.07, (400, 1))
    own = generator.normal([0.5, 0.51], 0.009, (400, 2))
    one, other = (city + own[:, :1])[:, 0], (city + own[:, 1:])[:, 0]
    _, error = compute_improvements(estimate_values(other, range(400)), estimate_values(one, range(400)))
    unpaired = np.sqrt((one.var(ddof=1) + other.var(ddof=1)) / 400)
    assert (unpaired / error[0]) ** 2 > 30


def test_number_without_average_is_tested_once():
    low, high = rig(lidar(mount={"z_m": 1.6}), name="low"), rig(lidar(mount={"z_m": 2.4}), name="high")
    keys = {"near": "radius_m", "largest": "radius_maximum_m", "cells": "cells_radius_m"}
    objectives = {name: Objective(number=key, region="20m") for name, key in keys.items()}
    with create_frames(objectives=objectives, average="cells", num_scenes=2) as search_frames:
        found = validate({"higher": high}, low, search_frames, test_seed=1, num_scenes=2).improvements["higher"]
    said = [("near", "cells"), ("largest", "-"), ("cells", "cells")]
    assert [(gain.objective, gain.average) for gain in found] == said


def test_validation_uses_other_scenes_and_reports_optimism(frames):
    low, high = rig(lidar(mount={"z_m": 1.6}), name="low"), rig(lidar(mount={"z_m": 2.4}), name="high")
    test = validate({"higher": high}, low, frames, test_seed=1, num_scenes=8)
    found, others = test.improvements["higher"], _list_extra_objectives(frames.objectives, has_failures=False)[0]
    anew = create_frames(seed=1, num_scenes=8, objectives={**frames.objectives, **others})
    assert [(gain.objective, gain.average) for gain in found] == [(name, "area") for name in ("near", "far", "bay")]
    by_test, by_search = ([of.score(one).estimate for one in (high, low)] for of in (anew, frames))
    expected, in_search = by_test[0].compute_differences(by_test[1]), by_search[0].subtract(by_search[1])
    for column, gain in enumerate(found):
        np.testing.assert_equal(gain.difference, expected[gain.objective])
        assert gain.search_improvement == float(in_search.value[column])
        np.testing.assert_equal(gain.optimism, gain.search_improvement - expected[gain.objective].value)
    assert found[1].difference.p_value < 0.5
    assert {change.name for change in test.side_effects} == others.keys()
    # What a gain is made of sums up to it, whatever else the parts are; a loss has no share of a gain.
    for name in ("near", "far", "bay"):
        shares = [change.objective_shares[name] for change in test.side_effects if name in change.objective_shares]
        assert len(shares) == len(frames.objectives[name].region_bands)
        assert sum(shares) == pytest.approx(1)
    lost = validate({"lower": low}, high, frames, test_seed=1, num_scenes=2)
    assert not any(change.objective_shares for change in lost.side_effects)
    with pytest.raises(ValueError, match="seed: got 0, the seed of these frames; give another one"):
        frames.resample(0, 4, {})
    with pytest.raises(ValueError, match="scenarios: 'yard' is the same for any seed"):
        create_frames([yard()], {"far": frames.objectives["far"]}).resample(1, 4, {})


def test_null_searches_rarely_report_side_effects():
    draws, alarms = np.random.default_rng(0), 0
    for _ in range(200):
        shared = draws.normal(0.0, 1.0, (16, 4)) @ draws.normal(0.0, 1.0, (4, 33))  # regions overlap
        one, other = (estimate_values(shared + draws.normal(0.0, 0.5, (16, 33)), np.arange(16)) for _ in range(2))
        tests = list(one.compute_differences(other).values())
        changes = [
            SideEffect("a", test, p, {})
            for test, p in zip(tests, adjust_holm([test.p_value for test in tests]), strict=True)
        ]
        alarms += any(change.is_worse for change in changes)
    assert alarms <= 10


def test_targets_are_counted_around_the_vehicle(frames, monkeypatch):
    monkeypatch.setattr(validation, "TARGETS", ("child",))
    low, high = rig(lidar(mount={"z_m": 1.6}), name="low"), rig(lidar(mount={"z_m": 2.4}), name="high")
    (change,) = validation._compare_targets(high, low, frames, validation.TargetRasterParams()).values()
    assert change.improvement > 0
    assert change.p_value < 0.05
    assert change.block_count == 16
