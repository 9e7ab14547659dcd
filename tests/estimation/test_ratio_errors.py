"""Standard errors of ratios of sums in cells, over frames and over area."""

import numpy as np
import pytest
import torch

from torchcover.estimation import compute_jackknife_error, estimate_ratio_errors


def blocks_of(cells: int, blocks: int = 16, seed: int = 0):
    """Sample areas and detected areas, which are correlated."""
    random = torch.Generator().manual_seed(seed)
    m2 = 0.5 + torch.rand(blocks, cells, generator=random, dtype=torch.float64)
    return m2, m2 * (0.4 * m2 + 0.2 * torch.rand(blocks, cells, generator=random, dtype=torch.float64)).clamp(max=1)


@pytest.mark.parametrize(("unit", "blind"), [("share", lambda ratio: 0.0), ("m", lambda ratio: 5.0 * ratio)])
def test_ratio_errors_use_two_pseudo_blocks(unit, blind):
    m2, sums = (each.numpy() for each in blocks_of(5))
    expected = []
    for cell in range(5):
        ratio, mean_m2 = sums[:, cell].sum() / m2[:, cell].sum(), m2[:, cell].mean()
        covered = 1.0 if unit == "share" else 0.0
        base = np.append(m2[:, cell], [mean_m2, mean_m2])
        residual = np.append(sums[:, cell], [covered * mean_m2, blind(ratio) * mean_m2]) - ratio * base
        expected.append(np.sqrt((residual**2).sum() * 18 / 17) / base.sum())
    result = estimate_ratio_errors(torch.from_numpy(m2), torch.from_numpy(sums), unit)
    np.testing.assert_allclose(result, expected, rtol=1e-12)


def test_ratio_errors_approach_the_jackknife():
    m2, sums = blocks_of(50, blocks=2000)
    left_out = (sums.sum(dim=0) - sums) / (m2.sum(dim=0) - m2)
    jackknife = compute_jackknife_error(left_out, sums.sum(dim=0) / m2.sum(dim=0), torch.ones(2000))
    torch.testing.assert_close(estimate_ratio_errors(m2, sums, "share"), jackknife, rtol=0.02, atol=0)


def test_ratio_errors_are_independent_of_area_units():
    m2, sums = blocks_of(9)
    torch.testing.assert_close(
        estimate_ratio_errors(1e-6 * m2, 1e-6 * sums, "share"),
        estimate_ratio_errors(m2, sums, "share"),
        rtol=1e-9,
        atol=0,
    )


def test_two_errors_cover_a_share_near_one():
    """Blocks of six samples with 95 % detected: with the plain spread, 14 of 100 intervals would miss."""
    random = np.random.default_rng(3)
    for blocks in (11, 16):
        sums = torch.from_numpy(random.binomial(6, 0.95, (blocks, 4000)).astype(float))
        m2 = torch.full_like(sums, 6.0)
        ratio, error = sums.sum(dim=0) / m2.sum(dim=0), estimate_ratio_errors(m2, sums, "share")
        assert float(((ratio - 0.95).abs() <= 2 * error).double().mean()) >= 0.93


def test_what_few_blocks_know_is_unknown():
    m2 = torch.tensor([[1.0, 2.0, 0.0]] * 7 + [[0.0, 1.0, 0.0]] * 9, dtype=torch.float64)
    assert estimate_ratio_errors(m2, 0.5 * m2, "share").isnan().tolist() == [True, False, True]
    infinite = torch.where(m2 > 0, torch.inf, 0.0)
    assert estimate_ratio_errors(m2, infinite, "m").isnan().all()
