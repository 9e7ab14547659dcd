"""Estimates, numbers and differences from sums in blocks, in closed form and against SciPy."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from torchcover.coverage.quantities import RADIUS, make_detection_quantity
from torchcover.estimation import Estimate
from torchcover.estimation.errors import BLIND_SIDE_FACTOR, compute_interval95

BOTH = (RADIUS, make_detection_quantity(0.4))


def sums(blocks, seed=0):
    """Sample the area of each block, and area times radius and detection."""
    random = np.random.default_rng(seed)
    m2 = 1.0 + random.random(blocks)
    return m2, m2[:, None] * random.random((blocks, 2))


def estimate(m2, each, steps=None):
    steps = torch.ones(len(m2), dtype=torch.int64) if steps is None else torch.tensor(steps)
    return Estimate.from_ratios(BOTH, torch.from_numpy(m2), torch.from_numpy(each), steps)


def test_jackknife_values_of_ratios_ignore_unused_blocks():
    m2, each = sums(9)
    m2[4], each[4] = 0.0, 0.0
    result = estimate(m2, each, [1, 1, 1, 1, 0, 1, 1, 1, 1])
    np.testing.assert_allclose(result.value, each.sum(axis=0) / m2.sum(), rtol=1e-12)
    assert len(result.jackknife_values) == len(result.frame_counts) == 8
    np.testing.assert_allclose(result.jackknife_values[-1], each[:-1].sum(axis=0) / m2[:-1].sum(), rtol=1e-12)
    of_each = estimate(np.stack([m2, m2]).T, each, [1, 1, 1, 1, 0, 1, 1, 1, 1])
    np.testing.assert_allclose(of_each.jackknife_values, result.jackknife_values, rtol=1e-12)


@pytest.mark.parametrize("blocks", [8, 19, 200])
def test_differences_of_scene_means_equal_paired_t_tests(blocks):
    random = np.random.default_rng(blocks)
    own, other = random.random((2, blocks, 2))
    one, two = (estimate(np.ones(blocks), each) for each in (own, other))
    result, mirrored = list(two.compute_differences(one).values()), list(one.compute_differences(two).values())
    for at, (difference, back) in enumerate(zip(result, mirrored, strict=True)):
        test = stats.ttest_rel(other[:, at], own[:, at])
        low, high = test.confidence_interval()
        assert difference.value == pytest.approx((other - own)[:, at].mean(), rel=1e-9)
        assert difference.value / difference.error == pytest.approx(test.statistic, rel=1e-9)
        assert difference.p_value == pytest.approx(test.pvalue, rel=1e-9)
        # Intervals of radii are longer on the side away from 0.
        below = BLIND_SIDE_FACTOR if at == 0 and difference.value < 0 else 1.0
        above = BLIND_SIDE_FACTOR if at == 0 and difference.value > 0 else 1.0
        middle = difference.value
        expected = middle - below * (middle - low), middle + above * (high - middle)
        assert (difference.low, difference.high) == pytest.approx(expected, rel=1e-3)
        assert (back.low, back.high) == pytest.approx((-difference.high, -difference.low), rel=1e-9)
        assert difference.is_significant is bool(test.pvalue < 0.05)
    # Lower is better for radii, higher for detection rates.
    assert [each.better_count for each in result] == [(other < own)[:, 0].sum(), (other > own)[:, 1].sum()]
    assert [each.improvement for each in result] == [-result[0].value, result[1].value]
    assert {each.block_count for each in result} == {blocks}


def test_dominated_blocks_give_errors_without_intervals():
    m2, each = sums(12)
    m2[3:] *= 1e-3
    each[3:] *= 1e-3
    lopsided = estimate(m2, each)
    assert float(lopsided.effective_blocks[0]) == pytest.approx(m2.sum() ** 2 / (m2**2).sum(), rel=1e-12)
    numbers, differences = (
        lopsided.to_numbers().values(),
        lopsided.compute_differences(estimate(m2, 0.5 * each)).values(),
    )
    assert all(number.error > 0 and math.isnan(number.low) for number in numbers)
    assert all(math.isnan(one.low) and one.is_significant is None and math.isnan(one.p_value) for one in differences)
    assert estimate(np.ones(8), each[:8]).has_intervals == [True, True]


def test_too_few_blocks_give_neither_errors_nor_tests():
    few = estimate(*sums(7))
    assert few.error.isnan().all()
    assert few.compute_errors(7).isfinite().all()
    for number, difference in zip(few.to_numbers().values(), few.compute_differences(few).values(), strict=True):
        assert number.has_value
        assert all(map(math.isnan, (*number[2:5], *difference[2:5], difference.p_value)))
        assert difference.is_significant is None


def test_blocks_that_all_say_the_same_prove_nothing():
    m2 = np.full(8, 2.0)
    numbers = estimate(m2, 0.5 * np.stack([m2, m2]).T).to_numbers().values()
    assert [number.value for number in numbers] == [0.5, 0.5]
    assert all(math.isnan(number.error) and math.isnan(number.low) for number in numbers)


def test_what_is_infinite_for_both_differs_by_nothing():
    blind = estimate(np.ones(8), np.tile([np.inf, 0.0], (8, 1)))
    radius, seen = blind.compute_differences(blind).values()
    assert (radius.value, seen.value) == (0.0, 0.0)
    assert math.isnan(radius.error)


def test_without_blocks_there_is_a_value_only():
    alone = Estimate.from_values(BOTH, torch.tensor([1.0, 0.5], dtype=torch.float64))
    assert [number.value for number in alone.to_numbers().values()] == [1.0, 0.5]
    assert alone.error.isnan().all()
    assert [difference.block_count for difference in alone.compute_differences(alone).values()] == [0, 0]
    assert alone[1:].quantities == (make_detection_quantity(0.4),)


def test_truncated_estimates_use_the_first_blocks_only():
    m2, each = sums(20)
    some, alone = estimate(m2, each).truncate_blocks(9), estimate(m2[:9], each[:9])
    for one, other in (
        (some.value, alone.value),
        (some.jackknife_values, alone.jackknife_values),
        (some.error, alone.error),
    ):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=0)
    assert some.frame_counts.tolist() == alone.frame_counts.tolist()


def drawn(blocks, mean, spread, seed, size=2.0):
    """Sample ratios of blocks with a known error."""
    ratios = mean + spread * torch.randn(blocks, 1, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    m2 = torch.full((blocks,), size, dtype=torch.float64)
    return Estimate.from_ratios((RADIUS,), m2, m2[:, None] * ratios, torch.ones(blocks, dtype=torch.int64))


def test_mixtures_have_welch_satterthwaite_degrees_of_freedom():
    strata = [(0.6, drawn(10, 2.0, 0.5, 1)), (0.3, drawn(25, 4.0, 0.1, 2)), (0.1, drawn(9, 1.0, 2.0, 3))]
    mixed = Estimate.from_strata(strata)
    variances = [(weight * float(one.error)) ** 2 for weight, one in strata]
    number = mixed.to_numbers()["radius_m"]
    assert number.value == pytest.approx(sum(weight * float(one.value) for weight, one in strata))
    assert number.error == pytest.approx(math.sqrt(sum(variances)))
    freedom = sum(variances) ** 2 / (variances[0] ** 2 / 9 + variances[1] ** 2 / 24 + variances[2] ** 2 / 8)
    assert mixed.degrees_of_freedom == [int(freedom)]
    assert (number.low, number.high) == compute_interval95(number.value, number.error, int(freedom), RADIUS)
    # The weight of a stratum does not depend on its number of blocks.
    alone = Estimate.from_strata([(1.0, strata[0][1])]).to_numbers()["radius_m"]
    assert alone == strata[0][1].to_numbers()["radius_m"]


def test_differences_of_mixtures_are_paired_in_each_stratum():
    shared = [drawn(12, 2.0, 1.0, 1), drawn(16, 5.0, 1.0, 2)]
    other = [replace(one, value=one.value - 0.3, jackknife_values=one.jackknife_values - 0.3) for one in shared]
    other[1] = replace(
        other[1], jackknife_values=other[1].jackknife_values + 1e-4 * torch.randn(16, 1, dtype=torch.float64)
    )
    one, another = (Estimate.from_strata(list(zip((0.5, 0.5), each, strict=True))) for each in (shared, other))
    difference = another.compute_differences(one)["radius_m"]
    assert difference.value == pytest.approx(-0.3)
    assert difference.error < 0.01 < float(one.error)
    assert difference.is_significant
    assert (difference.block_count, difference.better_count) == (28, 28)


@pytest.mark.parametrize("blocks", [7, 1])
def test_each_stratum_needs_enough_blocks(blocks):
    number = Estimate.from_strata([(0.99, drawn(1000, 2.0, 1.0, 1)), (0.01, drawn(blocks, 2.0, 1.0, 2))]).to_numbers()[
        "radius_m"
    ]
    assert math.isfinite(number.value)
    assert math.isnan(number.error)
    assert math.isnan(number.low)


def test_unknown_or_constant_strata_make_mixtures_unknown():
    known = drawn(16, 2.0, 1.0, 1)
    nothing = Estimate.from_values((RADIUS,), torch.tensor([math.nan], dtype=torch.float64))
    assert math.isnan(Estimate.from_strata([(0.5, known), (0.5, nothing)]).to_numbers()["radius_m"].value)
    same = Estimate.from_strata([(0.5, known), (0.5, drawn(16, 2.0, 0.0, 1))]).to_numbers()["radius_m"]
    assert same.value == pytest.approx(0.5 * float(known.value) + 1.0)
    assert math.isnan(same.error)
