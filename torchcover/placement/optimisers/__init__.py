"""Optimisers, by the names that the command line knows them by."""

from collections.abc import Callable

from torchcover.placement.optimisers.gaussian_process import GaussianProcessSearch
from torchcover.placement.optimisers.optimiser import Cube, Optimiser
from torchcover.placement.optimisers.random_search import RandomSearch

MakesOptimiser = Callable[[Cube, int], Optimiser]

OPTIMISERS: dict[str, MakesOptimiser] = {"gp": GaussianProcessSearch, "random": RandomSearch}

__all__ = ["OPTIMISERS", "Cube", "GaussianProcessSearch", "MakesOptimiser", "Optimiser", "RandomSearch"]
