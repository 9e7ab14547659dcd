"""Standard errors of ratios over the visible surface, cell by cell."""

import numpy as np
import torch

from torchcover.coverage.area_errors import area_errors
from torchcover.coverage.errors import jackknife_error


def blocks_of(runs: int, blocks: int = 16, seed: int = 0):
    """Square metres and detected ones, which go together, of some runs."""
    random = torch.Generator().manual_seed(seed)
    m2 = 0.5 + torch.rand(blocks, runs, generator=random, dtype=torch.float64)
    return m2, m2 * (0.4 * m2 + 0.2 * torch.rand(blocks, runs, generator=random, dtype=torch.float64)).clamp(max=1)


def test_it_is_the_spread_of_the_residuals():
    m2, sums = (each.numpy() for each in blocks_of(5))
    expected = []
    for cell in range(5):
        residual = sums[:, cell] - sums[:, cell].sum() / m2[:, cell].sum() * m2[:, cell]
        expected.append(np.sqrt(16 * residual.var(ddof=1)) / m2[:, cell].sum())
    np.testing.assert_allclose(area_errors(torch.from_numpy(m2), torch.from_numpy(sums)), expected, rtol=1e-12)


def test_it_is_the_spread_of_the_ratios_of_many_runs():
    m2, sums = blocks_of(4000)
    spread = float((sums.sum(dim=0) / m2.sum(dim=0)).std())
    assert abs(float(area_errors(m2, sums).square().mean().sqrt()) / spread - 1) < 0.1


def test_it_is_near_the_jackknife_of_the_same_ratio():
    m2, sums = blocks_of(50)
    left_out = (sums.sum(dim=0) - sums) / (m2.sum(dim=0) - m2)
    jackknife = jackknife_error(left_out, sums.sum(dim=0) / m2.sum(dim=0), torch.ones(16))
    torch.testing.assert_close(area_errors(m2, sums), jackknife, rtol=0.1, atol=0)


def test_the_unit_of_the_square_metres_does_not_matter():
    m2, sums = blocks_of(9)
    torch.testing.assert_close(area_errors(1e-6 * m2, 1e-6 * sums), area_errors(m2, sums), rtol=1e-9, atol=0)


def test_too_few_blocks_or_equal_ones_are_unknown_never_exact():
    m2 = torch.tensor([[1.0, 2.0, 1.0, 0.0]] * 3 + [[0.0, 1.0, 1.0, 0.0]] * 13, dtype=torch.float64)
    share = torch.tensor([0.5, 1.0, 0.0, 0.0], dtype=torch.float64)
    assert area_errors(m2, share * m2).isnan().all()
    radius = m2.clone()
    radius[:2, 0], radius[0, 2] = 5.0, 5.0
    # Three blocks do not make an error, sixteen do.
    assert area_errors(m2, radius).isnan().tolist() == [True, True, False, True]
    radius[0, 2] = torch.inf
    assert area_errors(m2, radius).isnan().all()
