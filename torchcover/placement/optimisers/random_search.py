"""Random search: the control of every other optimiser."""

import numpy as np

from torchcover.placement.optimisers.optimiser import Cube, Unit


class RandomSearch:
    """Evenly distributed places, whatever it is told. `seed`: of its draws.

    Example:
        >>> RandomSearch(Cube(levels=(0, 3)), seed=0).ask().shape
        (2,)
    """

    def __init__(self, cube: Cube, seed: int) -> None:
        self._cube, self._seed, self._told = cube, seed, 0

    def ask(self) -> Unit:
        """The draw of this turn."""
        draws = np.random.default_rng([self._seed, self._told])
        return self._cube.snapped(draws.random(len(self._cube.levels)))

    def tell(self, unit: Unit, value: float, error: float) -> None:
        """Counted; nothing is learnt."""
        self._told += 1
