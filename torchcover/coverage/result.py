"""The result: maps over the grid, and one number a region."""

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from torchcover.coverage.aggregations import MeanOfMeans
from torchcover.coverage.blocks import AreaSums, Blocks, BlockSums
from torchcover.coverage.coverage_file import CoverageParts, read_coverage, write_coverage
from torchcover.coverage.grid import BevGrid
from torchcover.coverage.layer import Layer
from torchcover.coverage.measures import Measure, area_in_blocks, estimate_area, estimate_known
from torchcover.coverage.quantity import RADIUS, by_area
from torchcover.coverage.redundancy import Redundancy
from torchcover.coverage.region_redundancy import over_known, over_place, quantities_of, region_redundancy
from torchcover.coverage.regions import Region, check_regions, regions_within
from torchcover.coverage.summary import RegionRedundancy, RegionSummary
from torchcover.estimation import MIN_BLOCKS_OF_A_CELL, Estimate, Number, Quantity, ratio_errors


class Coverage:
    """Coverage maps of a run: what `CoverageMetric.compute` returns.

    Arrays have the grid's shape (H, Y, X). An unknown cell, which no reference point ever probed, is NaN with count 0.

    Args:
        grid: Cells and height bands.
        thresholds: Detection thresholds in metres.
        max_radius: Saturation of the radius in metres.
        probed_steps: (H, Y, X) int64 steps that had a reference point in the cell.
        points: (H, Y, X) int64 reference points in the cell.
        layers: What was measured: the mean radius, the detection at each threshold, then those of other aggregations.
        counts: What happened on the way, one number for each name in `COUNTS`.
        blocks: The sums in blocks of contiguous steps, if errors were asked for.
        area: The sums over the visible surface, if the reference points had square metres.
        regions: What `summary` gives numbers for, unless it is told others; the paper's `forward_regions()` that fit
            the grid if not given.
        redundancy: What each sensor of the rig adds, if the metric was told of the sensors.

    Attributes:
        layers: By the key of their quantity: `coverage.layers["radius_m"].values`.
    """

    COUNTS: ClassVar[tuple[str, ...]] = (
        "steps",
        "empty_sensor_steps",
        "empty_reference_steps",
        "saturated_points",
        "inside_points",
        "outside_points",
    )

    def __init__(
        self,
        *,
        grid: BevGrid,
        thresholds: Sequence[float],
        max_radius: float,
        probed_steps: Tensor,
        points: Tensor,
        layers: Iterable[Layer],
        counts: Mapping[str, int],
        blocks: Blocks | None = None,
        area: AreaSums | None = None,
        regions: Sequence[Region] | None = None,
        redundancy: Redundancy | None = None,
    ) -> None:
        self.grid = grid
        self.thresholds = tuple(thresholds)
        self.max_radius = max_radius
        self.probed_steps = probed_steps
        self.points = points
        self.layers: Mapping[str, Layer] = {layer.quantity.key: layer for layer in layers}
        self.counts = dict(counts)
        self.blocks = blocks
        self.area = area
        self.regions = regions_within(grid) if regions is None else tuple(regions)
        self.redundancy = redundancy
        self._estimates: dict[tuple[Region, str, Measure], Estimate] = {}

    def __repr__(self) -> str:
        known = float((self.probed_steps > 0).double().mean())
        return f"Coverage({self.grid.shape} cells, {self.counts['steps']} steps, {known:.1%} of the cells known)"

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """What there is one number of for each region: the mean radius, then the detection at each threshold."""
        return MeanOfMeans(self.thresholds).quantities

    @property
    def radius(self) -> Tensor:
        """(H, Y, X) float64 mean blind spot radius in metres."""
        return self.layers[RADIUS.key].values

    @property
    def detection(self) -> Tensor:
        """(T, H, Y, X) float64 detection probability at each threshold."""
        return self._stacked({key: layer.values for key, layer in self.layers.items()})

    @cached_property
    def errors(self) -> Mapping[str, Tensor]:
        """Key of a quantity -> (H, Y, X) standard errors; NaN where too few blocks probed, empty without blocks."""
        if self.blocks is None:
            return {}
        errors = self._errors_of(self.blocks, self.quantities)
        if self.area is not None:
            each = self._errors_of(self.area, self.quantities)
            errors |= {by_area(one).key: each[one.key] for one in self.quantities}
        return errors

    def _errors_of(self, blocks: BlockSums, quantities: Sequence[Quantity]) -> dict[str, Tensor]:
        where = blocks.known_in() >= MIN_BLOCKS_OF_A_CELL
        base, sums = blocks.spread_over(where)
        errors = {}
        for one, own in zip(quantities, sums, strict=True):
            errors[one.key] = sums.new_full(self.grid.shape, math.nan)
            errors[one.key][where] = ratio_errors(base, own, one.unit)
        return errors

    @property
    def radius_error(self) -> Tensor | None:
        """(H, Y, X) standard error of `radius` in metres; None without blocks."""
        return self.errors.get(RADIUS.key)

    @property
    def detection_error(self) -> Tensor | None:
        """(T, H, Y, X) standard error of `detection`, likewise."""
        return self._stacked(self.errors) if self.errors else None

    def _stacked(self, by_key: Mapping[str, Tensor]) -> Tensor:
        """(T, H, Y, X) one entry for each threshold."""
        each = [by_key[quantity.key] for quantity in self.quantities[1:]]
        return torch.stack(each) if each else self.radius.new_empty((0, *self.grid.shape))

    def summary(self, regions: Sequence[Region] | None = None) -> list[RegionSummary]:
        """One row for each region and height band.

        Args:
            regions: Regions within the grid; `self.regions` if not given.

        Returns:
            Rows in the order of the regions, then of the bands.

        Raises:
            ValueError: A region reaches beyond the grid, or holds no cell centre.
        """
        wanted = self.regions if regions is None else regions
        return [self._summarise(region, height) for region in wanted for height in self.grid.heights]

    @property
    def measure(self) -> Measure:
        """What its numbers are means over: "area" if the reference points had square metres, else "known"."""
        return "known" if self.area is None else "area"

    def estimate(self, region: Region, height: str, measure: Measure | None = None) -> Estimate:
        """The numbers of one region in one band with what they become without each block, for errors of differences.

        Args:
            region: A region within the grid.
            height: Name of the band.
            measure: "area", the mean over the visible surface (`torchcover.coverage.measures.estimate_area`), for
                points that have square metres, or "known", the paper's unweighted mean over the known cells. Not given:
                that of this result.

        Raises:
            ValueError: A region that reaches beyond the grid, or holds no cell centre; no such band; "area" of points
                without square metres.
        """
        key = region, height, measure or self.measure
        if key not in self._estimates:
            self._estimates[key] = self._estimate(*key)
        return self._estimates[key]

    def _estimate(self, region: Region, height: str, measure: Measure) -> Estimate:
        check_regions([region], self.grid)
        cells = region.mask(self.grid).to(self.radius.device)
        if height not in self.grid.heights:
            raise ValueError(f"height {height!r}: the grid has {', '.join(self.grid.heights)}")
        band = list(self.grid.heights).index(height)
        if measure == "area":
            return estimate_area(self.quantities, self._square_metres(), band, cells)
        known = cells & (self.probed_steps[band] > 0)
        probed = self.probed_steps[band][known]
        sums = probed * torch.stack([self.layers[quantity.key].values[band][known] for quantity in self.quantities])
        return estimate_known(self.quantities, probed, sums, self.blocks, band, known)

    def _square_metres(self) -> AreaSums:
        if self.area is None:
            raise ValueError(
                "no estimate by area: the reference points had no square metres; take them from a SurfaceReference and "
                "give the metric square_metres=True"
            )
        return self.area

    def scalars(self, regions: Sequence[Region] | None = None) -> dict[str, float]:
        """The summary as a flat dict for a logger.

        Args:
            regions: As in `summary`.

        Returns:
            `"radius_m/20m/ground"`, `"detection_0.4m/20m/ground"`, `"known_share/20m/ground"` and so on, and
            `"visible_m2/20m/ground"` if the reference points had square metres.
        """
        flat = {}
        for row in self.summary(regions):
            place = f"{row.region}/{row.height}"
            for key, number in row.numbers.items():
                flat[f"{key}/{place}"] = number.value
                if self.blocks is not None:
                    flat[f"{key}_error/{place}"] = number.error
            flat[f"known_share/{place}"] = row.known_share
            if row.measure == "area":
                flat[f"visible_m2/{place}"] = row.visible_m2
        return flat

    def save(self, path: str | Path) -> None:
        """Write everything to one `.npz` file, which NumPy reads too: maps and their errors by key, and the blocks.

        What `load` gives back has the same numbers, errors and differences to the last bit.
        """
        parts: CoverageParts = {
            "grid": self.grid,
            "thresholds": self.thresholds,
            "max_radius": self.max_radius,
            "probed_steps": self.probed_steps,
            "points": self.points,
            "layers": list(self.layers.values()),
            "counts": self.counts,
            "blocks": self.blocks,
            "area": self.area,
            "regions": self.regions,
            "redundancy": self.redundancy,
        }
        write_coverage(parts, self.errors, Path(path))

    @classmethod
    def load(cls, path: str | Path) -> "Coverage":
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: No such file.
            IsADirectoryError: A folder.
            BadFileError: Not a coverage file, a damaged one, one of another version, or too large a one.
        """
        return cls(**read_coverage(path))

    def _summarise(self, region: Region, height: str) -> RegionSummary:
        cells, band = region.mask(self.grid), list(self.grid.heights).index(height)
        probed = self.probed_steps[band].cpu()[cells]
        known_cells = int((probed > 0).sum())
        return RegionSummary(
            region=region.name,
            height=height,
            cells=len(probed),
            known_cells=known_cells,
            measure=self.measure,
            numbers=self._numbers(region, height, self.measure, known_cells),
            known=self._numbers(region, height, "known", known_cells),
            visible_m2=math.nan if self.area is None else self._visible_m2(self.area, band, cells),
            redundancy=self._without_each(region, height),
        )

    def _numbers(self, region: Region, height: str, measure: Measure, known_cells: int) -> dict[str, Number]:
        # How often an interval around the mean over known cells holds the truth has not been measured.
        intervals = measure == "area"
        return self.estimate(region, height, measure).numbers(
            intervals=intervals, count=known_cells, count_of="known cells"
        )

    def _without_each(self, region: Region, height: str) -> RegionRedundancy | None:
        """What each sensor adds; by area it is known of the regions only that the metric was told of."""
        redundancy, band = self.redundancy, list(self.grid.heights).index(height)
        if redundancy is None or (redundancy.places is not None and region not in self.regions):
            return None
        quantities = quantities_of(redundancy, self.thresholds)
        if redundancy.places is not None:
            place = self.regions.index(region) * len(self.grid.heights) + band
            return region_redundancy(redundancy, self.thresholds, over_place(redundancy.places, place, quantities))
        known = region.mask(self.grid).to(self.radius.device) & (self.probed_steps[band] > 0)
        with_all = self.estimate(region, height, "known").value
        return region_redundancy(redundancy, self.thresholds, over_known(redundancy, with_all, band, known, quantities))

    def _visible_m2(self, area: AreaSums, band: int, cells: Tensor) -> float:
        total = float(area_in_blocks(area, band, cells.to(area.at.device))[:, 0].sum())
        return total / self.counts["steps"] if self.counts["steps"] else math.nan
