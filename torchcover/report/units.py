"""What a reader expects of a unit: its name, its factor, and how many digits."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from torchcover.coverage.quantity import Unit


class ShownUnit(NamedTuple):
    """How numbers of a unit are shown.

    Args:
        name: Behind a number.
        difference_name: Behind a difference of two of them.
        factor: From the unit of the quantity to what is shown.
        decimals: Of a number without an error.
        max_decimals: More than anybody can use, however small the error.
        highest: The largest number there is, as it is shown.
    """

    name: str
    difference_name: str
    factor: float
    decimals: int
    max_decimals: int
    highest: float


UNITS: Mapping[Unit, ShownUnit] = MappingProxyType(
    {
        "m": ShownUnit("m", "m", 1.0, 2, 4, math.inf),
        "share": ShownUnit("%", "percentage points", 100.0, 1, 3, 100.0),
    }
)
