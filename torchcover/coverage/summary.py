"""The numbers of a region, as tables and loggers take them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from torchcover.coverage.estimate import Measure


class Number(NamedTuple):
    """A number in the unit of its quantity, its standard error and its 95 % interval; NaN where it is not known.

    Args:
        value: The number.
        error: Its standard error.
        low: Lower end of the interval, from `torchcover.coverage.intervals.interval95`; NaN for means over known cells.
        high: Upper end.
    """

    value: float
    error: float
    low: float = math.nan
    high: float = math.nan


@dataclass(frozen=True)
class RegionSummary:
    """The numbers of one region in one height band.

    Args:
        region: Name of the region.
        height: Name of the height band.
        cells: Number of cells in the region.
        known_cells: How many of them a reference point has probed.
        measure: What `numbers` are means over: "area", the visible surface, or "known", the known cells.
        numbers: Key of the quantity, such as `"radius_m"` or `"detection_0.4m"` -> its number; the error is NaN if it
            was not asked for, or if there are not enough steps.
        known: The numbers over the known cells, every cell weighing the same; `numbers` itself if that is its measure.
        visible_m2: Mean over the steps of the square metres of the region's surface that the reference sees; NaN where
            its points have none.
    """

    region: str
    height: str
    cells: int
    known_cells: int
    measure: Measure
    numbers: Mapping[str, Number]
    known: Mapping[str, Number]
    visible_m2: float

    @property
    def known_share(self) -> float:
        """Share of the region's cells that are known. `known` is about this share, and biased when it is low."""
        return self.known_cells / self.cells
