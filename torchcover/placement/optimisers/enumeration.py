"""Every combination once, where all variables are choices and combinations are few."""

from itertools import product

import numpy as np

from torchcover.placement.optimisers.optimiser import Cube, Unit

# As many can be tried with racing, which drops most of them after a few instants.
MOST_COMBINATIONS = 200
# Beyond, a list of all of them does not fit into memory.
MOST_LISTED = 1_000_000


class Enumeration:
    """All combinations but the start, in a random order.

    Args:
        cube: What is free: choices only.
        seed: Of the order.

    Raises:
        ValueError: A number is free, or there are more than a million combinations.

    Example:
        >>> each = Enumeration(Cube(levels=(2,)), seed=0)
        >>> each.tell(each.ask(), 0.0, 0.0)
        >>> each.tell(each.ask(), 0.0, 0.0)
        >>> each.ask() is None
        True
    """

    def __init__(self, cube: Cube, seed: int) -> None:
        count = cube.combinations
        if count is None or count > MOST_LISTED:
            found = "a free number" if count is None else f"{count:,} combinations"
            raise ValueError(f"optimiser enumerate: choices only, {MOST_LISTED:,} combinations at most; got {found}")
        options = (tuple((option + 0.5) / level for option in range(level)) for level in cube.levels)
        places = np.array(list(product(*options)), dtype=np.float64).reshape(count, len(cube.levels))
        self._left = [tuple(place) for place in np.random.default_rng(seed).permutation(cube.snapped(places))]
        if cube.start is not None:
            self._forget(cube.snapped(cube.start))

    def ask(self) -> Unit | None:
        """The next combination that it was not told of."""
        return np.array(self._left[0]) if self._left else None

    def tell(self, unit: Unit, value: float, error: float) -> None:
        """It is not asked for again."""
        self._forget(unit)

    def _forget(self, unit: Unit) -> None:
        if tuple(unit) in self._left:
            self._left.remove(tuple(unit))
