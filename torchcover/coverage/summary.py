"""The numbers of a region, as tables and loggers take them."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class RegionNumbers:
    """Means over the cells of one region in one height band, every cell weighing the same.

    Args:
        radius_m: Mean blind spot radius in metres; NaN if no cell is known.
        detection: Threshold in metres -> mean detection probability.
        radius_error_m: Standard error of `radius_m`; NaN if it was not asked for, or if there are not enough steps.
        detection_error: Threshold -> standard error of `detection`.
    """

    radius_m: float
    detection: Mapping[float, float]
    radius_error_m: float
    detection_error: Mapping[float, float]


@dataclass(frozen=True)
class RegionSummary(RegionNumbers):
    """The numbers of one region in one height band, over its known cells.

    Args:
        region: Name of the region.
        height: Name of the height band.
        cells: Number of cells in the region.
        known_cells: How many of them a reference point has probed.
        unseen_cells: About how many more would become known with more steps.
        completed: The numbers with these cells, as far as can be told; less biased as long as there are many. See
            `torchcover.coverage.estimate.completed_mean`.
    """

    region: str
    height: str
    cells: int
    known_cells: int
    unseen_cells: float
    completed: RegionNumbers

    @property
    def known_share(self) -> float:
        """Share of the region's cells that are known. The numbers are about this share, and biased when it is low."""
        return self.known_cells / self.cells
