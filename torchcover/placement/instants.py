"""What rigs are scored on."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from torchcover.placement.scores import Scores
from torchcover.simulation import Rig


class Instants(Protocol):
    """Instants of many worlds: `CommonInstants`, or anything else that can be asked so."""

    @property
    def seed(self) -> int:
        """Of the worlds."""
        ...

    @property
    def world_of(self) -> NDArray[np.int64]:
        """(instants,) which world each is of."""
        ...

    def __len__(self) -> int: ...

    def score(self, rig: Rig, instants: Sequence[int] | NDArray[np.int64] | None = None) -> Scores:
        """What a rig scores at some instants, or all; ValueError if it cannot be mounted."""
        ...

    def anew(self, seed: int, worlds: int) -> "Instants":
        """Instants of other worlds; ValueError if there are none."""
        ...

    def close(self) -> None:
        """End what holds the worlds."""
        ...
