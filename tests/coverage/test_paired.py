"""Differences between rigs and their significance, against SciPy."""

import numpy as np
import pytest
import torch
from scipy import stats

from torchcover.coverage import BevGrid, CoverageMetric, Region, check_paired, compute_differences

SQUARE = BevGrid(x_m=(0.0, 10.0), y_m=(-5.0, 5.0), cell_m=1.0)
NEAR = Region("near", (0.0, 5.0), (-5.0, 5.0))


def measured(*, weighed=False, steps=(0, 1), radius=1.0, more=0, num_blocks=8):
    metric = CoverageMetric(SQUARE, num_blocks=num_blocks, has_area_weights=weighed)
    for at in steps:
        reference = torch.tensor([[0.5, 0.5, 0.0], [3.5, 0.5, 0.0], [3.6, 0.5, 0.0]])[: 2 + more]
        weights = {"weights": torch.ones(len(reference))} if weighed else {}
        metric.update(reference - torch.tensor([0.0, 0.0, radius]), reference, **weights, block_index=at)
    return metric.compute()


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"weighed": True}, "they have different layers"),
        ({"more": 1}, "different reference points"),
        ({"more": -1}, "different reference points"),
        ({"steps": (0, 0)}, "different reference points"),
        ({"steps": (0, 1, 1)}, "different reference points"),
        ({"num_blocks": 1}, "different reference points"),
    ],
)
def test_only_paired_results_can_be_compared(other, message):
    check_paired({"a": measured(), "b": measured(radius=2.0), "c": measured(radius=0.5)})
    for pair in ((measured(), measured(**other)), (measured(**other), measured())):
        with pytest.raises(ValueError, match=rf"'a' and 'b' cannot be compared: .*{message}"):
            check_paired(dict(zip("ab", pair, strict=True)))
    with pytest.raises(ValueError, match=r"a comparison needs at least two rigs; got a$"):
        check_paired({"a": measured()})


@pytest.mark.parametrize("shift", [0.0, 0.05, 0.1, 0.3])
@pytest.mark.parametrize("seed", range(4))
def test_significance_equals_a_paired_t_test(shift, seed):
    """One frame per block and one cell: radii that differ by `shift` and noise."""
    random = np.random.default_rng(seed)
    shared = 1 + random.random(16)
    radii = {"a": shared, "b": shared + shift + 0.2 * random.standard_normal(16)}
    coverages = {}
    for name, own in radii.items():
        metric = CoverageMetric(SQUARE, num_blocks=16)
        for at, radius in enumerate(own.tolist()):
            metric.update(torch.tensor([[0.5, 0.5, -radius]]), torch.tensor([[0.5, 0.5, 0.0]]), block_index=at)
        coverages[name] = metric.compute()
    itself, other = compute_differences(coverages, NEAR, "ground").values()
    result = other["radius_m"]
    test = stats.ttest_rel(radii["b"], radii["a"])
    assert result.value == pytest.approx(radii["b"].mean() - radii["a"].mean(), abs=1e-6)
    assert abs(result.value) / result.error == pytest.approx(abs(test.statistic), rel=1e-4)
    assert result.is_significant is bool(test.pvalue < 0.05)
    assert result.p_value == pytest.approx(test.pvalue, rel=1e-3)
    assert (result.block_count, result.better_count) == (16, (radii["b"] < radii["a"]).sum())
    # The interval of a length reaches 1.25 times as far on the side away from 0.
    low, high = (end - result.value for end in test.confidence_interval())
    reach = (low, 1.25 * high) if result.value > 0 else (1.25 * low, high)
    assert (result.low - result.value, result.high - result.value) == pytest.approx(reach, abs=1e-3)
    assert itself["radius_m"][1:3] == (0.0, 0.0)
    assert itself["radius_m"].is_significant is False
