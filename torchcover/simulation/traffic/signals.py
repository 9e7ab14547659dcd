"""Lights with fixed cycles, two phases to a junction."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Whoever follows the main street, on wheels or on foot, goes in one phase; whoever crosses it goes in the other.
MAIN, CROSS = 0, 1


@dataclass(frozen=True, eq=False)
class Signals:
    """The lights of J junctions: main green, amber, all red, cross green, amber, all red, and again.

    Args:
        offset_s: (J,) how far into its cycle each junction is at time 0.
        green_s: Length of the main and of the cross green.
        amber_s: Time after green in which those who cannot stop any more still enter.
        clear_s: Time after amber in which all have red.
    """

    offset_s: NDArray[np.float64]
    green_s: tuple[float, float] = (26.0, 18.0)
    amber_s: float = 3.0
    clear_s: float = 3.0

    @classmethod
    def none(cls) -> "Signals":
        """For lanes without junctions: the lights of one that no lane leads to."""
        return cls(np.zeros(1))

    @property
    def cycle_s(self) -> float:
        """Time after which the lights repeat."""
        return sum(self.green_s) + 2 * (self.amber_s + self.clear_s)

    def green_left_s(self, time_s: ArrayLike) -> NDArray[np.float64]:
        """(..., J, 2) seconds of green left to the main and the cross phase at (...) times; negative without green."""
        now = np.mod(np.asarray(time_s)[..., None] + self.offset_s, self.cycle_s)
        cross_start = self.green_s[MAIN] + self.amber_s + self.clear_s
        left = np.empty((*now.shape, 2))
        left[..., MAIN] = self.green_s[MAIN] - now
        left[..., CROSS] = np.where(now < cross_start, -np.inf, cross_start + self.green_s[CROSS] - now)
        return left
