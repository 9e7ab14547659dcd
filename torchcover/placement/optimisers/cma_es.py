"""CMA-ES, for many free numbers: the package `cmaes`, extra `search`."""

from typing import TYPE_CHECKING

import numpy as np

from torchcover.placement.optimisers.optimiser import DECIMALS, Cube, Unit

if TYPE_CHECKING:
    from cmaes import CMA, CMAwM

# Of each range: as far as the first generation strays from the start.
SIGMA = 0.25


class CmaEs:
    """Covariance matrix adaptation, from the start; with margins (CMAwM, Hamano et al. 2022) where there are choices.

    Where a distribution has converged, another begins at the best place so far. What was not asked for, it cannot use.

    Args:
        cube: What is free: two variables or more.
        seed: Of its draws.

    Raises:
        ValueError: One variable only, or `cmaes` is not installed.

    Example:
        >>> search = CmaEs(Cube(levels=(0, 0), start=np.array([0.5, 0.5])), seed=0)
        >>> for _ in range(100):
        ...     search.tell(unit := search.ask(), -float(((unit - 0.3) ** 2).sum()), 0.0)
        >>> bool((abs(search.ask() - 0.3) < 0.1).all())
        True
    """

    def __init__(self, cube: Cube, seed: int) -> None:
        self._free = np.array([level != 1 for level in cube.levels])
        if self._free.sum() < 2:
            raise ValueError("optimiser cmaes: two free variables are needed; got one, for which gp or random will do")
        self._cube, self._seed, self._begun = cube, seed, 0
        self._levels = np.array(cube.levels)[self._free]
        self._best = cube.snapped(np.full(len(cube.levels), 0.5) if cube.start is None else cube.start)
        self._most = 0.0 if cube.start is not None else -np.inf
        self._generation: list[tuple[Unit, float]] = []
        self._asked: tuple[Unit, Unit] | None = None
        self._cma = self._begin()

    def ask(self) -> Unit:
        """The next draw of this generation."""
        if self._asked is None:
            drawn = self._cma.ask()
            evaluated, told = drawn if isinstance(drawn, tuple) else (drawn, drawn)
            unit = self._best.copy()
            unit[self._free] = self._of_options(evaluated)
            self._asked = self._cube.snapped(unit), told
        return self._asked[0]

    def tell(self, unit: Unit, value: float, error: float) -> None:
        """A value more of this generation, if it is the one that was, or would be, asked for."""
        asked = self.ask()
        if not np.allclose(asked, unit, rtol=0.0, atol=2 * 10.0**-DECIMALS):
            return
        assert self._asked is not None  # `ask` has set it
        self._generation.append((self._asked[1], value))
        self._asked = None
        if value > self._most:
            self._best, self._most = asked, value
        if len(self._generation) == self._cma.population_size:
            self._adapt()

    def _adapt(self) -> None:
        values = np.array([value for _, value in self._generation])
        worst = np.nanmax(-values, initial=0.0)  # it minimises, and looks at the order only
        losses = np.where(np.isnan(values), worst + 1.0, -values)
        self._cma.tell([(place, float(loss)) for (place, _), loss in zip(self._generation, losses, strict=True)])
        self._generation = []
        if self._cma.should_stop():
            self._cma = self._begin()

    def _begin(self) -> "CMA | CMAwM":
        try:
            from cmaes import CMA, CMAwM
        except ImportError as error:
            raise ValueError(
                "optimiser cmaes: the package cmaes is needed: pip install 'torchcover[search]'"
            ) from error
        seed = int(np.random.default_rng([self._seed, self._begun]).integers(2**31))
        self._begun += 1
        bounds = np.tile([0.0, 1.0], (len(self._levels), 1))
        mean = self._best[self._free]
        if not (self._levels > 0).any():
            return CMA(mean=mean, sigma=SIGMA, bounds=bounds, seed=seed)
        steps = np.where(self._levels > 0, 1.0 / np.maximum(self._levels - 1, 1), 0.0)
        return CMAwM(mean=self._of_steps(mean), sigma=SIGMA, bounds=bounds, steps=steps, seed=seed)

    def _of_options(self, places: Unit) -> Unit:
        """From steps of 0 to 1, ends included, to the middles of options."""
        count = np.maximum(self._levels, 1)
        return np.where(self._levels > 0, (np.round(places * (count - 1)) + 0.5) / count, places)

    def _of_steps(self, units: Unit) -> Unit:
        """The inverse of `_of_options`."""
        count = np.maximum(self._levels, 1)
        return np.where(self._levels > 0, (units * count - 0.5) / np.maximum(count - 1, 1), units)
