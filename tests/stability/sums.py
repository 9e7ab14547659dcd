"""Sums of touched cells and mixtures of scenes at the limits."""

from functools import lru_cache, partial
from math import fsum

import numpy as np
import torch

from torchcover.estimation import Estimate, Quantity
from torchcover.estimation.errors import compute_jackknife_error
from torchcover.metrics.blocked_sums import sum_rows

from .case import Case, most, relative

ROWS = 1_000_000
LARGEST_KEY = 2**53
RADIUS = Quantity("radius_m", "radius", "m", lower_is_better=True)
TINY_WEIGHT = 1e-12


# Sums of touched cells


@lru_cache
def of_one_cell():
    """(N,) numbers of 1e-8 to 1e8, which go to one key."""
    generator = np.random.default_rng(0)
    return 10.0 ** generator.uniform(-8, 8, ROWS)


def one_cell():
    rows = torch.from_numpy(np.stack([np.full(ROWS, LARGEST_KEY - 1.0), of_one_cell()], axis=1))
    ((key, total),) = sum_rows(rows).tolist()
    return relative(total, fsum(of_one_cell().tolist())) if key == LARGEST_KEY - 1 else np.inf


def one_cell_in_float32():
    return relative(float(np.cumsum(of_one_cell(), dtype=np.float32)[-1]), fsum(of_one_cell().tolist()))


@lru_cache
def extreme_rows():
    """(N, 3) rows of neighbouring keys at 0, 2^31, 2^32 and 2^53, in any order; the last column is for maxima."""
    generator = np.random.default_rng(1)
    keys = np.concatenate([end - np.arange(200) for end in (199, 2**31 + 100, 2**32 + 100, LARGEST_KEY)])
    keys = generator.permutation(np.tile(keys, 5))
    powers = generator.choice([-300.0, -8.0, 0.0, 8.0, 300.0], len(keys))
    return np.stack([keys, generator.normal(size=len(keys)), -(10.0**powers)], axis=1)


def unlike_dense(found):
    """How many rows are not those of float64 sums and maxima over each place of a dense array, to the bit."""
    rows = extreme_rows()
    places = np.unique(rows[:, 0].astype(np.int64))
    place = np.searchsorted(places, rows[:, 0].astype(np.int64))
    sums, largest = np.zeros(len(places)), np.full(len(places), -np.inf)
    np.add.at(sums, place, rows[:, 1])
    np.maximum.at(largest, place, rows[:, 2])
    dense = {int(key): own for key, *own in zip(places, sums, largest, strict=True)}
    result = {int(key): own for key, *own in found.tolist()}
    return sum(result.get(key) != own for key, own in dense.items()) + len(result.keys() - dense.keys())


def keys_in_float32():
    rows = torch.from_numpy(extreme_rows())
    return sum_rows(torch.cat([rows[:, :1].float().double(), rows[:, 1:]], dim=1), 1)


# Mixtures


@lru_cache
def strata(scales):
    """Means over 16 worlds each, of numbers of these scales."""
    metres = np.random.default_rng(2).uniform(1.0, 2.0, (len(scales), 16))
    return metres * np.array(scales)[:, None]


def mixture(weights, scales):
    ones = torch.ones(16, dtype=torch.float64)
    each = [
        Estimate.from_ratios((RADIUS,), ones, torch.from_numpy(worlds)[:, None], ones.long())
        for worlds in strata(tuple(scales))
    ]
    return Estimate.from_strata(list(zip(weights, each, strict=True)))


def longdouble_error(weights, scales):
    """The standard error and the degrees of freedom of a weighted mean, from the variances of its means."""
    variances = strata(tuple(scales)).astype(np.longdouble).var(axis=1, ddof=1) / 16
    shares = np.asarray(weights, dtype=np.longdouble) ** 2 * variances
    return np.sqrt(shares.sum()), shares.sum() ** 2 / (shares**2 / 15).sum()


TINY = (TINY_WEIGHT, 1 - TINY_WEIGHT), (1e12, 1.0)
SMALL = (0.5, 0.5), (1e-85, 1e-85)


def error_of_a_mixture(case):
    return relative(mixture(*case).error.item(), float(longdouble_error(*case)[0]))


def error_without_squares(case):
    weights, scales = case
    variances = strata(tuple(scales)).var(axis=1, ddof=1) / 16
    return relative(np.sqrt((np.array(weights) * variances).sum()), float(longdouble_error(*case)[0]))


def freedom(case):
    """As whole numbers, which a rounding just below must not make one less."""
    return abs(mixture(*case).degrees_of_freedom[0] - int(longdouble_error(*case)[1] + 1e-9))


def freedom_of_all_worlds(case):
    return abs(2 * (16 - 1) - int(longdouble_error(*case)[1] + 1e-9))


def freedom_by_fourth_powers(case):
    """Squares of the variances vanish in float64."""
    weights, scales = case
    shares = np.array(weights) ** 2 * strata(tuple(scales)).var(axis=1, ddof=1) / 16
    with np.errstate(invalid="ignore"):
        return most(shares.sum() ** 2 / (shares**2 / 15).sum() - float(longdouble_error(*case)[1]))


# The sort along a curve


def jackknife(error_of):
    """Of 512 blocks of 1 to 1000 steps that differ by a millionth of what they say."""
    generator = np.random.default_rng(8)
    steps, says = generator.integers(1, 1000, 512), 1.0 + 1e-6 * generator.standard_normal(512)
    whole = (steps * says).sum() / steps.sum()
    left_out = (whole * steps.sum() - steps * says) / (steps.sum() - steps)
    exact, n = (each.astype(np.longdouble) for each in (left_out, steps))
    ratio, mean = n.sum() / n, np.longdouble(whole)
    pseudo = ratio * mean - (ratio - 1) * exact
    centre = 512 * mean - ((1 - 1 / ratio) * exact).sum()
    expected = np.sqrt(((pseudo - centre) ** 2 / (ratio - 1)).mean())
    return relative(float(error_of(*map(torch.from_numpy, (left_out, np.array(whole), steps)))), float(expected))


def jackknife_in_float32(left_out, whole, steps):
    return compute_jackknife_error(left_out.float(), whole.float(), steps.float())


CASES = [
    Case("1,000,000 rows of one cell, of 1e-8 to 1e8", "math.fsum", "relative", 1e-11, one_cell,
         "float32 running sum", one_cell_in_float32),
    Case("sums and maxima of cells with keys up to 2^53", "a dense float64 array", "of 800 wrong", 0,
         lambda: unlike_dense(sum_rows(torch.from_numpy(extreme_rows()), 1)),
         "float32 keys", lambda: unlike_dense(keys_in_float32())),
    Case("error of 512 blocks that differ by 1e-6", "longdouble", "relative", 1e-7,
         partial(jackknife, compute_jackknife_error),
         "float32", partial(jackknife, jackknife_in_float32)),
    Case("error of a mixture with weights of 1e-12 and 1", "longdouble", "relative", 1e-12,
         partial(error_of_a_mixture, TINY), "weights not squared", partial(error_without_squares, TINY)),
    Case("degrees of freedom of the same", "longdouble", "freedom", 0, partial(freedom, TINY),
         "worlds less strata", partial(freedom_of_all_worlds, TINY)),
    Case("degrees of freedom of numbers of 1e-85", "longdouble", "freedom", 0, partial(freedom, SMALL),
         "squares of variances", partial(freedom_by_fourth_powers, SMALL)),
]  # fmt: skip
