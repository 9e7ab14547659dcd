"""Pareto sets and hypervolumes."""

from itertools import combinations

import numpy as np
import pytest

from torchcover.placement.pareto import chebyshev, hypervolume, non_dominated


def drawn(seed, count=12, objectives=3):
    return np.random.default_rng(seed).integers(0, 5, (count, objectives)).astype(float)


def slow_volume(values, reference):
    """The volume of a union of boxes, by inclusion and exclusion."""
    volume = 0.0
    for size in range(1, len(values) + 1):
        for some in combinations(values, size):
            volume -= (-1) ** size * np.prod(np.maximum(np.min(some, axis=0) - reference, 0.0))
    return volume


@pytest.mark.parametrize("objectives", [1, 2, 3])
@pytest.mark.parametrize("seed", range(4))
def test_a_hypervolume_is_the_volume_of_the_union_of_boxes(objectives, seed):
    values, reference = drawn(seed, 8, objectives), np.full(objectives, 1.0)
    assert hypervolume(values, reference) == pytest.approx(slow_volume(values, reference), abs=1e-12)


def test_closed_forms_of_a_hypervolume():
    stairs = np.array([[k, 10.0 - k] for k in range(1, 10)])
    assert hypervolume(stairs, np.zeros(2)) == sum(range(1, 10))
    assert hypervolume(np.array([[2.0, 3.0, 4.0]]), np.zeros(3)) == 24.0
    assert hypervolume(np.array([[2.0, -1.0]]), np.zeros(2)) == 0.0
    assert hypervolume(np.zeros((0, 2)), np.zeros(2)) == 0.0


@pytest.mark.parametrize("seed", range(4))
def test_more_candidates_never_have_less_volume_and_dominated_ones_add_none(seed):
    values, reference = drawn(seed), np.zeros(3)
    volumes = [hypervolume(values[:count], reference) for count in range(len(values) + 1)]
    assert (np.diff(volumes) >= 0).all()
    assert hypervolume(values[non_dominated(values)], reference) == pytest.approx(volumes[-1])


@pytest.mark.parametrize("seed", range(4))
def test_the_set_that_none_beats_does_not_depend_on_the_order(seed):
    values = drawn(seed)
    order = np.random.default_rng(seed).permutation(len(values))
    kept = non_dominated(values)
    assert np.array_equal(non_dominated(values[order]), kept[order])
    for at in np.flatnonzero(kept):
        assert not ((values >= values[at]).all(1) & (values > values[at]).any(1)).any()
    for at in np.flatnonzero(~kept):
        assert ((values >= values[at]).all(1) & (values > values[at]).any(1)).any()


def test_equal_candidates_stay_together_and_unknown_ones_are_out():
    values = np.array([[1.0, 1.0], [1.0, 1.0], [np.nan, 9.0], [0.0, 2.0]])
    assert non_dominated(values).tolist() == [True, True, False, True]


@pytest.mark.parametrize("seed", range(4))
def test_the_highest_chebyshev_value_is_dominated_by_none(seed):
    values, draws = np.random.default_rng(seed).random((50, 3)), np.random.default_rng(seed)
    for _ in range(20):
        assert non_dominated(values)[np.argmax(chebyshev(values, draws.dirichlet(np.ones(3))))]
