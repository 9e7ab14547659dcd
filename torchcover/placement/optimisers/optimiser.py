"""What proposes candidates, and the unit cube that it proposes them in."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Unit = NDArray[np.float64]
# Two places closer than this are one: no sensor is mounted to a millionth of its range.
DECIMALS = 6


@dataclass(frozen=True, eq=False)
class Cube:
    """The unit cube of a space's variables.

    Args:
        levels: One for each variable: how many options a choice has, 0 for a number.
        start: (variables,) where the rig is that the search starts from, whose gain is 0; None if it is outside.

    Example:
        >>> Cube(levels=(0, 2)).snapped(np.array([[0.123456789, 0.6]]))
        array([[0.123457, 0.75    ]])
    """

    levels: tuple[int, ...]
    start: Unit | None = None

    @property
    def combinations(self) -> int | None:
        """How many candidates there are; None where a number is free."""
        return None if 0 in self.levels else int(np.prod(self.levels, dtype=object))

    def snapped(self, units: Unit) -> Unit:
        """Places in the cube with every choice in the middle of its option, so that the same rig is the same place.

        Args:
            units: (..., variables) anywhere.
        """
        levels = np.array(self.levels)
        inside = np.clip(units, 0.0, 1.0)
        count = np.maximum(levels, 1)
        option = np.minimum(np.floor(inside * count), count - 1)
        return np.where(levels > 0, (option + 0.5) / count, inside.round(DECIMALS))


@runtime_checkable
class Optimiser(Protocol):
    """Proposes where in the unit cube to look next; it looks for the largest gain.

    What it asks for depends on its seed and on what it was told, and on nothing else: a search that is resumed tells it
    all of it again, in the same order, without asking.
    """

    def ask(self) -> Unit | None:
        """The next place, (variables,); None when there is none left."""

    def tell(self, unit: Unit, value: float, error: float) -> None:
        """What a place is worth.

        Args:
            unit: (variables,) the place; not always one that was asked for.
            value: Its gain over the start; NaN: no rig can be there.
            error: Standard error of the gain, as far as it comes from instants that were left out; 0: of none.
        """
