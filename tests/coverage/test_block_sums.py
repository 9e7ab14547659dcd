"""Sums in blocks as lists: they are the arrays that they were made from."""

import math

import numpy as np
import pytest
import torch

from torchcover.coverage.blocks import AreaSums

SHAPE, QUANTITIES = (5, 2, 3, 4), 3


def arrays(share, seed=0):
    """Arrays of which a share is not empty; a block and a cell are, in any case."""
    random = np.random.default_rng(seed)
    base = random.uniform(0.1, 9.0, SHAPE) * (random.random(SHAPE) < share)
    base[3], base[:, 1, 2, 3] = 0, 0
    sums = random.normal(size=(SHAPE[0], QUANTITIES, *SHAPE[1:])) * (base > 0)[:, None]
    if share:
        sums.flat[np.argmax(sums != 0)] = math.inf
    return base, sums


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 1.0])
def test_lists_say_what_the_arrays_said(share):
    base, sums = arrays(share)
    listed = AreaSums.of(torch.arange(5), *map(torch.from_numpy, (base, sums)))
    assert len(listed.at) == (base > 0).sum()
    np.testing.assert_array_equal(listed.m2, base)
    np.testing.assert_array_equal(listed.sums, sums)
    for blocks in (1, 3):
        enough = (base > 0).sum(axis=0) >= blocks
        cells, *spread = listed.spread_where(blocks)
        np.testing.assert_array_equal(cells, np.flatnonzero(enough))
        np.testing.assert_array_equal(spread[0], base[:, enough])
        np.testing.assert_array_equal(spread[1], sums[:, :, enough].swapaxes(0, 1))
    both = np.concatenate([base[:, None], sums], axis=1)
    np.testing.assert_allclose(listed.totals(), both.sum(axis=0), rtol=1e-14, atol=1e-14)
    some, band = np.random.default_rng(1).random(SHAPE[2:]) < 0.5, 1
    own = torch.from_numpy(some), band
    np.testing.assert_allclose(listed.over(*own), both[:, :, band, some].sum(axis=2), rtol=1e-14, atol=1e-14)
    known = some & (base[:, band] > 0).any(axis=0)
    spread = listed.spread_over(*own)
    np.testing.assert_array_equal(spread[0], base[:, band, known])
    np.testing.assert_array_equal(spread[1], sums[:, :, band, known].swapaxes(0, 1))


def test_nothing_in_the_lists_belongs_to_the_arrays():
    """A result stays what it is while its metric goes on."""
    steps, (base, sums) = torch.arange(5), map(torch.from_numpy, arrays(1.0))
    listed = AreaSums.of(steps, base, sums)
    before = [one.clone() for one in (listed.steps, listed.base, listed.listed)]
    for array in (steps, base, sums):
        array.add_(1)
    assert all(map(torch.equal, before, (listed.steps, listed.base, listed.listed)))
