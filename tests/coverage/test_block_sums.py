"""Sparse sums in blocks equal the dense arrays they were made from."""

import math

import numpy as np
import pytest
import torch

from torchcover.coverage.sparse_sums import BlockSums

SHAPE, QUANTITIES = (5, 2, 3, 4), 3


def arrays(share, seed=0):
    """Sample arrays with a share of entries; at least one block and one cell are empty."""
    random = np.random.default_rng(seed)
    base = random.uniform(0.1, 9.0, SHAPE) * (random.random(SHAPE) < share)
    base[3], base[:, 1, 2, 3] = 0, 0
    sums = random.normal(size=(SHAPE[0], QUANTITIES, *SHAPE[1:])) * (base > 0)[:, None]
    if share:
        sums.flat[np.argmax(sums != 0)] = math.inf
    return base, sums


def listed_of(base, sums):
    at, flat = np.flatnonzero(base), np.moveaxis(sums, 1, 0).reshape(QUANTITIES, -1)
    return BlockSums(torch.arange(5), SHAPE, *map(torch.from_numpy, (at, base.flat[at], flat[:, at])))


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 1.0])
def test_lists_say_what_the_arrays_said(share):
    base, sums = arrays(share)
    listed = listed_of(base, sums)
    assert len(listed.cell_indices) == (base > 0).sum()
    for blocks in (1, 3):
        enough = (base > 0).sum(axis=0) >= blocks
        cells, *spread = listed.extract_common_cells(blocks)
        np.testing.assert_array_equal(cells, np.flatnonzero(enough))
        np.testing.assert_array_equal(spread[0], base[:, enough])
        np.testing.assert_array_equal(spread[1], sums[:, :, enough].swapaxes(0, 1))
    both = np.concatenate([base[:, None], sums], axis=1)
    np.testing.assert_allclose(listed.sum_blocks(), both.sum(axis=0), rtol=1e-14, atol=1e-14)
    some, band = np.random.default_rng(1).random(SHAPE[2:]) < 0.5, 1
    own = torch.from_numpy(some), band
    np.testing.assert_allclose(listed.sum_cells(*own), both[:, :, band, some].sum(axis=2), rtol=1e-14, atol=1e-14)
    known = some & (base[:, band] > 0).any(axis=0)
    spread = listed.extract_cells(*own)
    np.testing.assert_array_equal(spread[0], base[:, band, known])
    np.testing.assert_array_equal(spread[1], sums[:, :, band, known].swapaxes(0, 1))


def test_remapped_cells_are_summed_within_their_block():
    base, sums = arrays(0.5)
    moved = listed_of(base, sums).remap_cells(lambda cell: cell // 2, SHAPE[1] * SHAPE[2] * 2, (*SHAPE[1:3], 2))
    halves = base.reshape(*SHAPE[:3], 2, 2).sum(axis=-1)
    np.testing.assert_array_equal(moved.cell_indices, np.flatnonzero(halves))
    np.testing.assert_allclose(moved.denominators, halves[halves > 0], rtol=1e-14)
    halves_of_sums = np.moveaxis(sums.reshape(5, QUANTITIES, *SHAPE[1:3], 2, 2).sum(axis=-1), 1, 0)
    np.testing.assert_allclose(moved.sums, halves_of_sums[:, halves > 0], rtol=1e-13, atol=1e-13)
