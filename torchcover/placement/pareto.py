"""Several objectives: which candidates no other beats, and how much they beat together. Higher is better."""

import numpy as np

from torchcover.geometry.arrays import Bools, Float64

# Of the sum beside the smallest: without it, weakly dominated candidates would be worth as much (Knowles 2006).
AUGMENTATION = 0.05


def non_dominated(values: Float64) -> Bools:
    """Which of (candidates, objectives) no other is as good as everywhere and better than somewhere; equal ones stay.

    A row with NaN is not among them.
    """
    known = np.logical_not(np.isnan(values).any(axis=1))
    as_good = np.all(values[:, None] >= values[None], axis=2)
    better = np.any(values[:, None] > values[None], axis=2)
    beaten: Bools = (known[:, None] & as_good & better).any(axis=0)
    return known & ~beaten


def hypervolume(values: Float64, reference: Float64) -> float:
    """Volume of what lies between (candidates, objectives) and a point that they are measured from, (objectives,).

    What is not above that in all of them adds nothing. By slices along the last objective, whose number is that of the
    candidates: exact, and quick for two or three.
    """
    above = values[(values > reference).all(axis=1)]
    if not len(above):
        return 0.0
    if values.shape[1] == 1:
        return float((above - reference).max())
    above = above[np.argsort(-above[:, -1], kind="stable")]
    heights = np.append(above[:, -1], reference[-1])
    slices = enumerate((heights[:-1] - heights[1:]).tolist(), start=1)
    return float(sum(each * hypervolume(above[:some, :-1], reference[:-1]) for some, each in slices if each > 0))


def chebyshev(values: Float64, weights: Float64) -> Float64:
    """(candidates,) one number of several objectives: the least weighted one, and a little of their sum.

    `values` (candidates, objectives) are in units that can be compared; weights are positive and add up to 1. Higher is
    better; whatever has the highest is dominated by none.
    """
    weighted = values * weights
    return np.asarray(weighted.min(axis=1) + AUGMENTATION * weighted.sum(axis=1))
