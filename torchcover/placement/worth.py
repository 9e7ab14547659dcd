"""What each reference point is worth: an objective is a sum over the points that a rig sees."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from torchcover.coverage import Measure
from torchcover.placement.bits import Bits
from torchcover.placement.common_instants import CommonInstants

Float64 = NDArray[np.float64]
Bytes = NDArray[np.uint8]

LOW_HALF = np.uint8(15)
# Row k has the bits of k, the highest first, as `numpy.packbits` has them.
BITS_OF_HALF = np.unpackbits(np.arange(16, dtype=np.uint8)[:, None], axis=1)[:, 4:].astype(np.float64)


class Worth:
    """Sums of what points are worth, from their bits.

    The mean of an objective over worlds has the same denominators for every rig. It is a sum of weights over the points
    that the rig sees, by either measure, and so it is monotone and submodular in the set of its sensors.

    Args:
        of_bits: (thresholds, 8 B) float64 weight of each bit, in the order of `Bits.seen`; of padding 0.

    Example:
        >>> worth = Worth(np.array([[0.5, 0.25, 0.125, 0, 0, 0, 0, 0]]))
        >>> worth.of(np.array([[0b1010_0000]], dtype=np.uint8)), worth.total
        (0.625, 0.875)
    """

    def __init__(self, of_bits: Float64) -> None:
        self.total = float(of_bits.sum())
        halves = of_bits.reshape(-1, 2, 4) @ BITS_OF_HALF.T
        self._high, self._low = halves[:, 0].copy(), halves[:, 1].copy()
        self._at = np.arange(len(halves))

    @classmethod
    def of_objective(cls, instants: CommonInstants, name: str, measure: Measure = "area") -> "Worth":
        """What the points of common instants add to the mean of an objective over its worlds.

        Args:
            instants: The instants.
            name: The objective.
            measure: As in `Scores.by_world`.
        """
        parts = instants.parts[name]
        counts = (
            _square_metres(instants, parts) if measure == "area" else _instants_with_cells(instants, parts)
        )  # (worlds, parts)
        # A world that shows nothing of one part has no value.
        counts[(counts == 0).any(axis=1)] = np.inf
        worlds = np.isfinite(counts).all(axis=1).sum()
        of_bits = np.zeros((len(instants.thresholds_m), 8 * sum(one.bytes_of_bits for one in instants.references)))
        start = 0
        for reference, world in zip(instants.references, instants.world_of.tolist(), strict=True):
            own = of_bits[:, start : start + reference.points]
            start += 8 * reference.bytes_of_bits
            for column, part in enumerate(parts):
                cells = reference.cells_of[part]
                of_cell = np.zeros(len(reference.cell_m2))
                of_cell[cells] = 1.0 if measure == "area" else 1.0 / (reference.cell_m2[cells] * len(cells))
                of_cell /= counts[world, column] * len(parts) * worlds
                row = instants.thresholds_m.index(instants.questions[part].threshold_m)
                weights = reference.m2 * of_cell[reference.cell]
                own[row] += np.bincount(reference.of, weights, minlength=reference.points)
        return cls(of_bits)

    def of(self, seen: Bytes) -> float:
        """The sum over the points that are seen.

        Args:
            seen: (thresholds, B), as of `Bits`.
        """
        flat = seen.reshape(-1)
        return float(self._high[self._at, flat >> 4].sum() + self._low[self._at, flat & LOW_HALF].sum())


def _square_metres(instants: CommonInstants, parts: Sequence[int]) -> Float64:
    """(worlds, parts) visible surface."""
    nothing = instants.scores(_nothing(instants))
    return _by_world(instants, nothing.visible_m2[:, list(parts)])


def _instants_with_cells(instants: CommonInstants, parts: Sequence[int]) -> Float64:
    """(worlds, parts) how many instants have known cells."""
    known = np.array([[len(one.cells_of[part]) > 0 for part in parts] for one in instants.references])
    return _by_world(instants, known.astype(np.float64))


def _by_world(instants: CommonInstants, of_instants: Float64) -> Float64:
    sums = np.zeros((int(instants.world_of.max()) + 1, of_instants.shape[1]))
    np.add.at(sums, instants.world_of, of_instants)
    return sums


def _nothing(instants: CommonInstants) -> Bits:
    size = len(instants.thresholds_m), sum(one.bytes_of_bits for one in instants.references)
    count = len(instants)
    return Bits(np.arange(count), np.zeros(size, dtype=np.uint8), np.zeros(count, dtype=np.int64), rays=1)
