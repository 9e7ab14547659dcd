"""The numbers of a region, as tables and loggers take them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from torchcover.coverage.estimate import Measure, RegionEstimate
from torchcover.coverage.intervals import is_significant


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


class Difference(NamedTuple):
    """What a rig has more than the first one, in the same steps and against the same reference points.

    Args:
        value: Metres, or a share in [-1, 1]; NaN if unknown.
        error: Standard error of `value` itself, which is less than that of the two numbers: what makes a step easy or
            hard for both rigs cancels out. NaN if there are not enough blocks.
        significant: Whether the difference is more than chance, by Student's t at 95 %; None if that is unknown.
    """

    value: float
    error: float
    significant: bool | None


def differences_of(estimate: RegionEstimate, first: RegionEstimate) -> list[Difference]:
    """The differences of one estimate to another over the same steps, quantity by quantity."""
    # Two infinite numbers are equal; their difference would be NaN, which means unknown.
    values = (estimate.value - first.value).where(estimate.value != first.value, 0.0)
    errors = estimate.minus(first).error
    freedom = len(estimate.steps) - 1
    return [
        Difference(value, error, is_significant(value, error, freedom))
        for value, error in zip(values.tolist(), errors.tolist(), strict=True)
    ]


@dataclass(frozen=True)
class RegionRedundancy:
    """By how many sensors one region is seen in one height band, and what is lost with each.

    Args:
        seen_by: Key of the quantity, `"sensors_0.4m"`: mean number of sensors that see a point within the threshold,
            or `"seen_by_two_0.4m"`: share that two or more see -> its number. By one or more: the detection.
        without: Name of the sensor -> key of the quantity, as in `RegionSummary.numbers` -> its number without it.
        change: The same less the number with all sensors; of detection at most 0, of the radius at least 0.
        indispensable: The sensor without which most is lost: of the detection at the first threshold, or of the radius
            where there is no threshold; None where no sensor's failure changes a number, or nothing is known.
    """

    seen_by: Mapping[str, Number]
    without: Mapping[str, Mapping[str, Number]]
    change: Mapping[str, Mapping[str, Difference]]
    indispensable: str | None


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
        redundancy: What each sensor adds; None if that was not asked for.
    """

    region: str
    height: str
    cells: int
    known_cells: int
    measure: Measure
    numbers: Mapping[str, Number]
    known: Mapping[str, Number]
    visible_m2: float
    redundancy: RegionRedundancy | None = None

    @property
    def known_share(self) -> float:
        """Share of the region's cells that are known. `known` is about this share, and biased when it is low."""
        return self.known_cells / self.cells
