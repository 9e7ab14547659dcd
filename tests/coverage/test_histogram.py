"""Quantiles from histograms of fixed size."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchcover.coverage.aggregations.quantiles import check_levels, compute_histogram_quantiles, find_bins


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(-5, 5), min_size=2, max_size=6).map(sorted), st.floats(-6, 6))
def test_bin_of_is_the_definition(edges, value):
    result = find_bins(torch.tensor([value], dtype=torch.float64), torch.tensor(edges, dtype=torch.float64)).item()
    bins = [i for i in range(len(edges) - 1) if edges[i] <= value < edges[i + 1]]
    assert result == (bins[0] if bins else -1)


@settings(max_examples=60, deadline=None)
@given(
    values=st.lists(st.floats(0, 9.999), min_size=1, max_size=30),
    level=st.sampled_from([0.0, 0.25, 0.5, 0.75, 1.0]),
)
def test_quantiles_lie_in_the_true_bin(values, level):
    edges = torch.arange(0, 11, dtype=torch.float64)
    histogram = torch.zeros(10, 2, dtype=torch.float64)
    for value in values:
        histogram[int(value), 0] += 1.0
    result = compute_histogram_quantiles(histogram, edges, (level,))
    true = np.quantile(values, level, method="inverted_cdf")
    assert math.floor(true) <= result[0, 0].item() <= math.floor(true) + 1
    assert result[0, 1].isnan()


def test_quantiles_are_linear_within_a_bin():
    edges = torch.tensor([0.0, 1.0, 3.0, math.inf], dtype=torch.float64)
    histogram = torch.tensor([[0.0], [4.0], [1.0]], dtype=torch.float64)
    result = compute_histogram_quantiles(histogram, edges, (0.0, 0.2, 0.4, 0.8, 0.9, 1.0))
    assert result.flatten().tolist() == [1.0, 1.5, 2.0, 3.0, math.inf, math.inf]


@pytest.mark.parametrize("weights", [(0.1, 0.2, 0.3, 0.6), (1, 2, 3, 6), (0.7, 0.1, 0.8), (1 / 3, 1 / 3, 2 / 3)])
@pytest.mark.parametrize("scale", [1e-9, 0.1, 0.3, 1.0, 7e9])
def test_ties_do_not_depend_on_rounding_of_weights(weights, scale):
    """With half of the weight below 1 and half from 10 on, the median is 1, never 10."""
    *below, above = weights
    edges = torch.tensor([*torch.linspace(0, 1, len(below) + 1), 10.0, 11.0], dtype=torch.float64)
    histogram = scale * torch.tensor([*below, 0.0, above], dtype=torch.float64)[:, None]
    assert compute_histogram_quantiles(histogram, edges, (0.5,)).item() == pytest.approx(1.0)


@pytest.mark.parametrize("levels", [(), (0.5, 1.1), (math.nan,), (-0.1,), (0.5, 0.5), (0.5, 0.5000001)])
def test_levels_that_make_no_sense_are_refused(levels):
    with pytest.raises(ValueError, match=r"levels: different numbers in \[0, 1\] are needed; got"):
        check_levels(levels)
