"""Choices and the Gaussian process of a search, against all subsets in fractions and against long double."""

from fractions import Fraction
from functools import lru_cache, partial
from itertools import combinations
from unittest.mock import patch

import mpmath
import numpy as np
import torch

from torchcover.placement import subsets
from torchcover.placement.optimisers.gaussian_process import log_expected_improvement
from torchcover.placement.optimisers.gp_model import LEAST_NOISE, GaussianProcess
from torchcover.placement.subsets import Candidates, Limits, best

from .case import Case, most, relative

WORLDS, COUNT, POINTS, MOST = 12, 7, 24, 3
BRANCH_AND_BOUND, HIGHS = 10**6, 1


@lru_cache
def choices(seed):
    """Points of a third, or nearly: what candidates see is often worth the same, and prices decide."""
    generator = np.random.default_rng(seed)
    worth = np.where(generator.random(POINTS) < 0.5, 1 / 3, 1 / 3 + 1e-12) / POINTS
    seen = generator.random((COUNT, POINTS)) < 0.5
    seen[4:] = seen[:3, ::-1] | (generator.random((3, POINTS)) < 0.1)
    return worth, seen, (generator.integers(1, 6, COUNT) * 100.0).tolist()


def every_subset():
    return [some for size in range(MOST + 1) for some in combinations(range(COUNT), size)]


@lru_cache
def right(seed):
    """The price of the best, in fractions: of those that are worth the same up to what counts as the same."""
    worth, seen, prices = choices(seed)
    exact = [Fraction(one) for one in worth.tolist()]
    values = {
        some: sum((one for one, there in zip(exact, seen[list(some)].any(axis=0), strict=True) if there), Fraction(0))
        for some in every_subset()
    }
    top = max(values.values())
    return min((sum(prices[k] for k in some), len(some)) for some, v in values.items() if v > top - Fraction(1, 10**9))


def wrong_choices(sets):
    """Of those that are not the best, the cheapest, or not proven."""
    wrong = 0
    with patch.object(subsets, "MOST_SETS", sets):
        for seed in range(WORLDS):
            worth, seen, prices = choices(seed)
            found = best(Candidates.grouped([worth], list(seen), np.zeros(POINTS, dtype=bool)), Limits(MOST, prices))
            paid = sum(prices[k] for k in found.chosen), len(found.chosen)
            wrong += paid != right(seed) or not found.proven
    return wrong


def wrong_by_floats():
    wrong = 0
    for seed in range(WORLDS):
        worth, seen, prices = choices(seed)
        top = max(every_subset(), key=lambda some: sum(worth[seen[list(some)].any(axis=0)]))
        wrong += (sum(prices[k] for k in top), len(top)) != right(seed)
    return wrong


def wrong_by_greed():
    wrong = 0
    for seed in range(WORLDS):
        worth, seen, prices = choices(seed)
        some = []
        for _ in range(MOST):
            some.append(max(range(COUNT), key=lambda k: worth[seen[[*some, k]].any(axis=0)].sum()))
        wrong += (sum(prices[k] for k in some), len(set(some))) != right(seed)
    return wrong


Z = (-1.0, -5.0, -20.0, -40.0, -1e3, -1e6)


@lru_cache
def improvements():
    """log(phi(z) + z Phi(z)); far below by its series, since the difference has no digits there."""
    with mpmath.workdps(60):
        found = []
        for z in map(mpmath.mpf, Z):
            series = mpmath.log(1 - 3 / z**2 + 15 / z**4 - 105 / z**6) - z * z / 2 - mpmath.log(2 * mpmath.pi) / 2
            exact = z > -500 and mpmath.log(mpmath.npdf(z) + z * mpmath.ncdf(z))
            found.append(float(exact or series - 2 * mpmath.log(-z)))
    return np.array(found)


def improvement_error():
    z = torch.tensor(Z, dtype=torch.float64)
    return relative(log_expected_improvement(z, torch.ones_like(z), 0.0, 1.0).numpy(), improvements())


def improvement_then_log():
    normal, z = torch.distributions.Normal(0.0, 1.0), torch.tensor(Z, dtype=torch.float64)
    return relative((normal.log_prob(z).exp() + z * normal.cdf(z)).log().numpy(), improvements())


@lru_cache
def process():
    """Values around a million at places of which every second one is there twice; and where it is asked."""
    generator = np.random.default_rng(3)
    places = np.repeat(generator.random((12, 2)), 2, axis=0)
    values, asked = 1e6 + np.sin(6 * places).sum(axis=1), generator.random((40, 2))
    told = torch.from_numpy(places), torch.from_numpy(values), torch.zeros(len(values), dtype=torch.float64)
    return GaussianProcess.fitted((0, 0), *told), values, asked


def kernel(model, first, second, dtype):
    """Matérn 5/2 with the model's hyperparameters."""
    first, second, lengths = (np.asarray(each).astype(dtype) for each in (first, second, model.log_lengths.exp()))
    far = np.sqrt(5 * (((first[:, None] - second) / lengths) ** 2).sum(axis=2))
    return np.exp(dtype(model.log_signal)) * (1 + far + far * far / 3) * np.exp(-far)


def noisy(model, dtype):
    noise = np.exp(dtype(model.log_noise)) + dtype(LEAST_NOISE)
    return kernel(model, model.places, model.places, dtype) + noise * np.eye(len(model.places), dtype=dtype)


@lru_cache
def expected_means():
    """By elimination in long double, which loses nothing of double precision."""
    model, values, asked = process()
    left = np.column_stack([noisy(model, np.longdouble), values.astype(np.longdouble) - values.mean()])
    for at in range(len(values)):
        left[at] /= left[at, at]
        others = np.arange(len(values)) != at
        left[others] -= left[others, at : at + 1] * left[at]
    return kernel(model, asked, model.places, np.longdouble) @ left[:, -1]


def process_error():
    model, values, asked = process()
    return most(model.predict(torch.from_numpy(asked))[0].numpy() - values.mean() - expected_means())


def in_float32():
    model, values, asked = process()
    off = (values - values.mean()).astype(np.float32)
    weights = np.linalg.lstsq(noisy(model, np.float32), off, rcond=None)[0]
    means = kernel(model, asked, model.places, np.float32) @ weights
    return most(means - expected_means())


CASES = (
    Case(
        "the best 3 of 7 that see points of 1/3 or 1e-12 more, by branch and bound",
        "all subsets, fractions",
        f"of {WORLDS} wrong",
        0,
        partial(wrong_choices, BRANCH_AND_BOUND),
        "the largest sum in float64",
        wrong_by_floats,
    ),
    Case(
        "the same by HiGHS",
        "all subsets, fractions",
        f"of {WORLDS} wrong",
        0,
        partial(wrong_choices, HIGHS),
        "what adds most, one by one",
        wrong_by_greed,
    ),
    Case(
        "log of expected improvement, 1 to 1e6 deviations below",
        "60 digits (mpmath)",
        "relative",
        1e-11,
        improvement_error,
        "improvement, then its logarithm",
        improvement_then_log,
    ),
    Case(
        "Gaussian process of values around 1e6, places there twice",
        "longdouble, elimination",
        "relative",
        1e-9,
        process_error,
        "least squares in float32",
        in_float32,
    ),
)
