"""Optimisers, by the names that the command line knows them by."""

from collections.abc import Callable

from torchcover.placement.optimisers.cma_es import CmaEs
from torchcover.placement.optimisers.enumeration import MOST_COMBINATIONS, Enumeration
from torchcover.placement.optimisers.gaussian_process import GaussianProcessSearch
from torchcover.placement.optimisers.optimiser import Cube, Optimiser
from torchcover.placement.optimisers.random_search import RandomSearch

MakesOptimiser = Callable[[Cube, int], Optimiser]

OPTIMISERS: dict[str, MakesOptimiser] = {
    "gp": GaussianProcessSearch,
    "cmaes": CmaEs,
    "random": RandomSearch,
    "enumerate": Enumeration,
}
AUTO = "auto"
# Above, a Gaussian process learns too little from the values that a search can pay for.
MOST_NUMBERS_OF_GP = 6


def optimiser_for(levels: tuple[int, ...], objectives: int) -> str:
    """What `auto` means.

    Args:
        levels: As of `Cube`.
        objectives: How many.

    Example:
        >>> optimiser_for((0, 0, 0), 1), optimiser_for((0,) * 16, 1), optimiser_for((12, 12), 1)
        ('gp', 'cmaes', 'enumerate')
    """
    combinations = Cube(levels).combinations
    if combinations is not None and combinations <= MOST_COMBINATIONS:
        return "enumerate"
    return "cmaes" if objectives == 1 and levels.count(0) > MOST_NUMBERS_OF_GP else "gp"


__all__ = [
    "AUTO",
    "OPTIMISERS",
    "CmaEs",
    "Cube",
    "Enumeration",
    "GaussianProcessSearch",
    "MakesOptimiser",
    "Optimiser",
    "RandomSearch",
    "optimiser_for",
]
