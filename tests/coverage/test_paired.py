"""Differences between rigs: what is significant, by SciPy's own tests."""

import numpy as np
import pytest
import torch
from scipy import stats

from torchcover.coverage import BevGrid, CoverageMetric, Region, differences

SQUARE = BevGrid(x=(0.0, 10.0), y=(-5.0, 5.0), cell=1.0)
NEAR = Region("near", (0.0, 5.0), (-5.0, 5.0))


@pytest.mark.parametrize("shift", [0.0, 0.05, 0.1, 0.3])
@pytest.mark.parametrize("seed", range(4))
def test_significant_is_what_a_paired_t_test_calls_so(shift, seed):
    """One step a block and one cell: radii whose differences are `shift` and noise."""
    random = np.random.default_rng(seed)
    shared = 1 + random.random(16)
    radii = {"a": shared, "b": shared + shift + 0.2 * random.standard_normal(16)}
    coverages = {}
    for name, own in radii.items():
        metric = CoverageMetric(SQUARE, blocks=16)
        for at, radius in enumerate(own.tolist()):
            metric.update(torch.tensor([[0.5, 0.5, -radius]]), torch.tensor([[0.5, 0.5, 0.0]]), place_in_time=at)
        coverages[name] = metric.compute()
    itself, other = differences(coverages, NEAR, "ground").values()
    found = other["radius_m"]
    test = stats.ttest_rel(radii["b"], radii["a"])
    assert found.value == pytest.approx(radii["b"].mean() - radii["a"].mean(), abs=1e-6)
    assert abs(found.value) / found.error == pytest.approx(abs(test.statistic), rel=1e-4)
    assert found.significant is bool(test.pvalue < 0.05)
    assert found.p == pytest.approx(test.pvalue, rel=1e-3)
    assert (found.blocks, found.better) == (16, (radii["b"] < radii["a"]).sum())
    # Of lengths the end that is farther from 0 is a quarter longer.
    low, high = (end - found.value for end in test.confidence_interval())
    reach = (low, 1.25 * high) if found.value > 0 else (1.25 * low, high)
    assert (found.low - found.value, found.high - found.value) == pytest.approx(reach, abs=1e-3)
    assert itself["radius_m"][1:3] == (0.0, 0.0)
    assert itself["radius_m"].significant is False
