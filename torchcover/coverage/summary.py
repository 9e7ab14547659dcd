"""The numbers of a region, as tables and loggers take them."""

from collections.abc import Mapping
from dataclasses import dataclass

from torchcover.coverage.measures import Measure
from torchcover.estimation import Difference, Number


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
