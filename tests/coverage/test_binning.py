"""Means over the points of each cell."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchcover.coverage.binning import compute_cell_means


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32), points=st.integers(0, 60), cells=st.integers(1, 20), rows=st.integers(0, 3))
def test_means_are_those_of_a_loop(seed, points, cells, rows):
    generator = torch.Generator().manual_seed(seed)
    cell = torch.randint(cells, (points,), generator=generator)
    values = torch.randn(rows, points, generator=generator)
    result = compute_cell_means(cell, values)
    assert result.cell_indices.tolist() == sorted(set(cell.tolist()))
    assert result.means.shape == (rows, len(result.cell_indices))
    for at, number in enumerate(result.cell_indices.tolist()):
        chosen = values.double().numpy()[:, cell.numpy() == number]
        assert result.point_counts[at] == chosen.shape[1]
        np.testing.assert_allclose(result.means[:, at].numpy(), chosen.mean(axis=1), rtol=1e-13, atol=1e-15)


def test_sums_are_taken_in_float64():
    """2**24 + 1 is not a float32, and a sum of 300,000 times 0.1 in float32 drifts by more than 1e-5."""
    count = 300_000
    values = torch.full((1, count), 0.1)
    result = compute_cell_means(torch.zeros(count, dtype=torch.int64), values)
    assert result.means.dtype == result.weight_sums.dtype == torch.float64
    np.testing.assert_allclose(result.means.item(), float(np.float32(0.1)), rtol=1e-12)
    large = torch.tensor([[2.0**24, 1.0, 1.0, 1.0]])
    assert compute_cell_means(torch.zeros(4, dtype=torch.int64), large).means.item() == (2.0**24 + 3) / 4


def test_infinite_values_stay_in_their_cell():
    result = compute_cell_means(torch.tensor([0, 0, 2]), torch.tensor([[1.0, torch.inf, 3.0]]))
    assert result.means.tolist() == [[torch.inf, 3.0]]
    assert (result.cell_indices.dtype, result.point_counts.dtype) == (torch.int64, torch.int64)


@pytest.mark.parametrize("weights", [None, torch.zeros(0)])
def test_no_points_touch_no_cell(weights):
    result = compute_cell_means(torch.zeros(0, dtype=torch.int64), torch.zeros(2, 0), weights)
    assert (result.cell_indices.numel(), result.point_counts.numel(), result.means.shape) == (0, 0, (2, 0))
    assert result.means.dtype == result.weight_sums.dtype == torch.float64
