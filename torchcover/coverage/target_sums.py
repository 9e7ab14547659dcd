"""Bodies beside the vehicle: in which share of the free places a rig sees them, and how much of them."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

from torch import Tensor

from torchcover.coverage.grid import BevGrid
from torchcover.coverage.regions import Region
from torchcover.coverage.summary import RegionSummary
from torchcover.estimation import Estimate, Quantity

# Of a body in a region: places that were tried, those that were free, those of them where it was seen; square metres
# of it that could be seen there, those of them that were.
TRIED, FREE, SEEN, VISIBLE, NEAR = COLUMNS = range(5)


@dataclass(frozen=True, eq=False)
class TargetSums:
    """Sums over the places where bodies were put, one at a time and seen by nothing else, in B fine blocks of steps.

    Args:
        target_names: Their names.
        regions: Where their middles stood.
        detection_points: How many points are enough to see one.
        threshold_m: How near a point on it must be to its surface.
        grid: Cells of the maps.
        frame_counts: (B,) int64 steps in each block at which bodies were put.
        sums: (B, bodies, regions, 5) float64 of `TRIED`, `FREE`, `SEEN`, `VISIBLE`, `NEAR`.
        position_counts: (bodies, Y, X, 2) float64 places that were free, and those where the body was seen.
    """

    target_names: tuple[str, ...]
    regions: tuple[Region, ...]
    detection_points: int
    threshold_m: float
    grid: BevGrid
    frame_counts: Tensor
    sums: Tensor
    position_counts: Tensor

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """What there is a number of for each region and body: the share of places, and of surface."""
        seen = f"free places with {self.detection_points} points or more"
        near = f"surface within {self.threshold_m:g} m of a point"
        return (
            Quantity(f"target_positions_{self.detection_points}_points", seen, "share", lower_is_better=False),
            Quantity(f"target_surface_{self.threshold_m:g}m", near, "share", lower_is_better=False),
        )

    @property
    def region_targets(self) -> list[tuple[Region, str]]:
        """The regions and bodies that there are numbers of."""
        return [(region, body) for region in self.regions for body in self.target_names]

    def estimate(self, region: Region, target_name: str) -> Estimate:
        """The numbers of a body in a region; NaN where no place was free, or nothing of it could be seen."""
        own = self._of(region, target_name)
        return Estimate.from_ratios(self.quantities, own[:, [FREE, VISIBLE]], own[:, [SEEN, NEAR]], self.frame_counts)

    def summarize(self) -> list[RegionSummary]:
        """A row for each of `places`: its cells are places that were tried, the known ones those that were free."""
        rows = []
        for region, body in self.region_targets:
            tried, free, _, visible_m2, _ = self._of(region, body).sum(dim=0).tolist()
            numbers = self.estimate(region, body).to_numbers(count=int(free), counted_items="free places")
            m2 = visible_m2 / free if free else math.nan
            rows.append(RegionSummary(region.name, body, int(tried), int(free), "target_positions", numbers, {}, m2))
        return rows

    def to_record(self) -> dict[str, Any]:
        """All but the tensors, for JSON."""
        told = {name: getattr(self, name) for name in ("target_names", "detection_points", "threshold_m")}
        extent = {"x_m": self.grid.x_m, "y_m": self.grid.y_m, "cell_m": self.grid.cell_m}
        return {**told, "regions": [asdict(region) for region in self.regions], "grid": extent}

    def _of(self, region: Region, body: str) -> Tensor:
        return self.sums[:, self.target_names.index(body), self.regions.index(region)]


class TargetMixture(NamedTuple):
    """What `TargetSums` says of one kind of world, of a mixture: of the same `region_targets` in each, with weights."""

    parts: Sequence[tuple[float, TargetSums]]
    region_targets: Sequence[tuple[Region, str]]

    def estimate(self, region: Region, target_name: str) -> Estimate:
        """As `TargetSums.estimate`."""
        return Estimate.from_strata([(weight, part.estimate(region, target_name)) for weight, part in self.parts])

    def summarize(self) -> list[RegionSummary]:
        """As `TargetSums.summary`; places are those of all kinds together."""
        rows = []
        for place, *each in zip(self.region_targets, *(part.summarize() for _, part in self.parts), strict=True):
            tried, free = (sum(getattr(row, name) for row in each) for name in ("num_cells", "observed_cells"))
            numbers = self.estimate(*place).to_numbers(count=free, counted_items="free places")
            m2 = sum(weight * row.visible_m2 for (weight, _), row in zip(self.parts, each, strict=True))
            rows.append(replace(each[0], num_cells=tried, observed_cells=free, numbers=numbers, visible_m2=m2))
        return rows
