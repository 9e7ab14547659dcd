"""Optimisers, by the names that the command line knows them by."""

from collections.abc import Callable

from torchcover.placement.optimisers.enumeration import MOST_COMBINATIONS, Enumeration
from torchcover.placement.optimisers.gaussian_process import GaussianProcessSearch
from torchcover.placement.optimisers.optimiser import Cube, Optimiser
from torchcover.placement.optimisers.random_search import RandomSearch

MakesOptimiser = Callable[[Cube, int], Optimiser]

OPTIMISERS: dict[str, MakesOptimiser] = {
    "gp": GaussianProcessSearch,
    "random": RandomSearch,
    "enumerate": Enumeration,
}
AUTO = "auto"


def optimiser_for(levels: tuple[int, ...]) -> str:
    """What `auto` means.

    Args:
        levels: As of `Cube`.

    Example:
        >>> optimiser_for((0, 0, 0)), optimiser_for((12, 12))
        ('gp', 'enumerate')
    """
    combinations = Cube(levels).combinations
    return "enumerate" if combinations is not None and combinations <= MOST_COMBINATIONS else "gp"


__all__ = [
    "AUTO",
    "OPTIMISERS",
    "Cube",
    "Enumeration",
    "GaussianProcessSearch",
    "MakesOptimiser",
    "Optimiser",
    "RandomSearch",
    "optimiser_for",
]
