"""Paired differences, and the order in which instants are added."""

import numpy as np

from torchcover.placement.evaluation import Float64, Numbers

# Instants that are added before it is asked again whether a candidate is beaten.
BATCH = 3


def paired(differences: Float64, worlds: Numbers) -> tuple[Float64, Float64]:
    """Mean of differences, and its standard error over worlds.

    Args:
        differences: (n, objectives) at instants; NaN where one is unknown.
        worlds: (n,) which world each instant is of.

    Returns:
        (objectives,) each; NaN where nothing is known, and an error of fewer than two worlds.
    """
    known = ~np.isnan(differences)
    count = known.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(known, differences, 0.0).sum(axis=0) / count
        of_world = (worlds[:, None] == np.unique(worlds)).T.astype(np.float64)
        off = of_world @ np.where(known, differences - mean, 0.0)
        seen = (of_world @ known > 0).sum(axis=0)
        error = np.sqrt((off**2).sum(axis=0) * seen / (seen - 1)) / count
    return mean, np.where(seen > 1, error, np.nan)


def batches(world_of: Numbers, seed: int, number: int) -> list[Numbers]:
    """All instants, a few at a time, each time of other worlds; another order for each evaluation."""
    draws = np.random.default_rng([seed, number])
    rank = draws.permutation(int(world_of.max()) + 1)
    shuffled = draws.permutation(len(world_of))
    turn = np.zeros(len(world_of), dtype=np.int64)
    seen: dict[int, int] = {}
    for at in shuffled:
        turn[at] = seen[int(world_of[at])] = seen.get(int(world_of[at]), -1) + 1
    order = np.lexsort((rank[world_of], turn))
    return [order[first : first + BATCH] for first in range(0, len(order), BATCH)]
