"""Racing: a rig is scored at a few instants more at a time, and given up when it is clearly worse than another."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from torchcover.estimation import Estimate
from torchcover.geometry.arrays import Float64, Int64

TOGETHER = 3
ERRORS_BELOW = 2.0
# Differences in fewer worlds than this say nothing about their error.
MIN_WORLDS = 3


class Prefix(NamedTuple):
    """What is known of a rig after the first instants, in the one order that all rigs are scored in.

    `self_hit_share` is the share of the rig's rays that the vehicle itself took.
    """

    instants: int
    estimate: Estimate
    self_hit_share: float


def gains(estimate: Estimate, other: Estimate) -> tuple[Float64, Float64]:
    """(O,) what one rig has better than another after the same instants, and (O,) standard errors of that over worlds.

    In the units of the objectives, more is better; NaN where one is unknown, and errors for fewer than 3 worlds.
    """
    between = estimate.minus(other)
    sign = [quantity.gain(1.0) for quantity in between.quantities]
    return between.value.numpy() * sign, between.errors(MIN_WORLDS).numpy()


def racing_order(world_of: Sequence[int] | Int64, seed: int) -> Int64:
    """(n,) all instants in an order drawn at random, round by round of one instant of each world."""
    generator = np.random.default_rng(seed)
    shuffled = generator.permutation(len(world_of))
    worlds = np.asarray(world_of)[shuffled]
    # How many instants of its world come before each.
    rounds = np.array([np.count_nonzero(worlds[:k] == world) for k, world in enumerate(worlds)], dtype=np.int64)
    return np.asarray(shuffled[np.argsort(rounds, kind="stable")])


def race(
    prefixes: Iterable[Prefix], incumbents: Sequence[Sequence[Prefix]] = (), objectives: int | None = None
) -> tuple[Prefix, ...]:
    """Score a rig on until it is clearly below an incumbent after the same instants, or was scored at all of them.

    Clearly is two standard errors of their paired difference, over worlds, in every objective: of so many numbers, or
    all. Of `prefixes` no more is asked for than is needed. Of several objectives there may be several incumbents.
    """
    known: list[Prefix] = []
    for prefix in prefixes:
        known.append(prefix)
        against = (gains(prefix.estimate, other[len(known) - 1].estimate) for other in incumbents)
        if any((gain < -ERRORS_BELOW * error)[:objectives].all() for gain, error in against):
            break
    return tuple(known)
