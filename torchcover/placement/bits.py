"""Which reference points a rig sees, as bits: those of two rigs together are the bits of either."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Bits:
    """Which reference points of some instants have a point of a rig within each threshold.

    The distance to the nearest point of several sensors is the least of their distances, so that the bits of a rig are
    the OR of those of its sensors: `CommonInstants.scores` of it is the score of the rig. Noise and drop-out are drawn
    anew for each place in a rig's list of sensors: there it is the score of other draws.

    Args:
        instants: (n,) int64 numbers of the instants.
        seen: (thresholds, B) uint8, eight points a byte as `numpy.packbits` has them, instant by instant; each instant
            begins a byte of its own.
        self_hits: (n,) int64 rays that the vehicle itself took.
        rays: Rays at one instant.

    Example:
        >>> one = Bits(np.array([0]), np.array([[0b1010_0000]], dtype=np.uint8), np.array([5]), 100)
        >>> other = Bits(np.array([0]), np.array([[0b0110_0000]], dtype=np.uint8), np.array([0]), 200)
        >>> both = one | other
        >>> np.unpackbits(both.seen)[:3].tolist(), both.rays
        ([1, 1, 1], 300)
    """

    instants: NDArray[np.int64]
    seen: NDArray[np.uint8]
    self_hits: NDArray[np.int64]
    rays: int

    def __or__(self, other: "Bits") -> "Bits":
        """What both rigs together see.

        Raises:
            ValueError: They are of other instants.
        """
        if not np.array_equal(self.instants, other.instants):
            raise ValueError("bits: those of the same instants in the same order are needed")
        return Bits(self.instants, self.seen | other.seen, self.self_hits + other.self_hits, self.rays + other.rays)
