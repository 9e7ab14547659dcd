"""The result: maps over the grid, and one number a region."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from torchcover.coverage.aggregations import Layer, MeanOfMeans
from torchcover.coverage.averages import (
    Average,
    estimate_area_average,
    estimate_cell_average,
    estimate_cell_errors,
    estimate_redundancy,
)
from torchcover.coverage.coverage_file import read_coverage, write_coverage
from torchcover.coverage.grid import BandFrame, BevGrid
from torchcover.coverage.quantities import RADIUS, make_area_quantity, make_cells_quantity
from torchcover.coverage.redundancy import Redundancy, expand_layers, list_redundancy_quantities
from torchcover.coverage.region_sums import AggregatedNumbers, RegionSums
from torchcover.coverage.regions import Region, RegionBands, check_regions, get_paper_regions, list_region_bands
from torchcover.coverage.sparse_sums import BlockSums, LazyMaps, ObservedCells
from torchcover.coverage.summary import RegionSummary, summarize_region
from torchcover.coverage.target_sums import TargetSums
from torchcover.estimation import Estimate, Quantity
from torchcover.files import write_atomically
from torchcover.notebooks import build_dataframe, build_result_html, build_xarray_dataset

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.figure import Figure


class Coverage:
    """Coverage maps of a run: what `CoverageMetric.compute` returns.

    It is kept of the K known cells, which a reference point has probed; arrays over all cells have the grid's shape
    (H, Y, X), are made when they are asked for, and are NaN with count 0 where nothing is known.

    Args:
        grid: Cells and height bands.
        thresholds_m: Detection thresholds in metres.
        max_radius_m: Saturation of the radius in metres.
        observed_cells: The known cells, with their steps and points.
        layers: What was measured of them, (K,) each: the mean radius, the detection at each threshold, then those of
            other aggregations.
        counts: What happened on the way, one number for each name in `COUNTS`.
        block_sums: The sums in blocks of contiguous steps, if errors were asked for.
        area_sums: The sums over the visible surface, if the reference points had square metres.
        regions: What `summary` gives numbers for, unless it is told others; the paper's `forward_regions()` that fit
            the grid if not given.
        region_sums: The sums by area over `regions`, point by point; None if the reference points had no square metres.
        aggregated_numbers: What other aggregations than the mean of means say of `regions`, if there were any.
        redundancy: What each sensor of the rig adds, if the metric was told of the sensors.
        target_sums: What the rig sees of bodies that were put beside the vehicle, if any were.

    Attributes:
        sparse_layers: The layers over the known cells, by the key of their quantity.
    """

    COUNTS: ClassVar[tuple[str, ...]] = (
        "num_frames",
        "empty_sensor_frames",
        "empty_reference_frames",
        "saturated_points",
        "inside_points",
        "outside_points",
        "no_ground_points",
    )

    def __init__(
        self,
        *,
        grid: BevGrid,
        thresholds_m: Sequence[float],
        max_radius_m: float,
        observed_cells: ObservedCells,
        layers: Iterable[Layer],
        counts: Mapping[str, int],
        block_sums: BlockSums | None = None,
        area_sums: BlockSums | None = None,
        regions: Sequence[Region] | None = None,
        region_sums: RegionSums | None = None,
        aggregated_numbers: AggregatedNumbers | None = None,
        redundancy: Redundancy | None = None,
        target_sums: TargetSums | None = None,
    ) -> None:
        self.grid = grid
        self.thresholds_m = tuple(thresholds_m)
        self.max_radius_m = max_radius_m
        self.observed_cells = observed_cells
        self.sparse_layers: Mapping[str, Layer] = {layer.quantity.key: layer for layer in layers}
        self.counts = dict(counts)
        self.block_sums = block_sums
        self.area_sums = area_sums
        self.regions = get_paper_regions(grid) if regions is None else tuple(regions)
        self.region_sums = region_sums
        self.aggregated_numbers = aggregated_numbers
        self.redundancy = redundancy
        self.target_sums = target_sums
        self._estimates: dict[tuple[Region, str, Average], Estimate] = {}

    def __repr__(self) -> str:
        known = f"{len(self.observed_cells.cell_indices) / self.grid.num_cells:.1%} of the cells known"
        return f"Coverage({self.grid.shape} cells, {self.counts['num_frames']} steps, {known})"

    def _repr_html_(self) -> str:
        return build_result_html([repr(self)], self.plot())

    def plot(self, quantity_key: str | None = None, band: str | None = None) -> "Figure":
        """One layer in one height band, seen from above.

        Args:
            quantity_key: A key of `layers`; the detection at the first threshold if not given.
            band: Name of the band; the first if not given.

        Returns:
            A figure of its own, outside pyplot.

        Raises:
            ValueError: There is no such layer or band.
        """
        from matplotlib.figure import Figure

        from torchcover.coverage.plotting import plot_coverage

        figure = Figure(figsize=(9.0, 4.5), layout="constrained")
        plot_coverage(self, figure.subplots(), quantity_key, band)
        return figure

    def to_dataframe(self, regions: Sequence[Region] | None = None) -> "pandas.DataFrame":
        """The numbers of `scalars`, a row for each region of `summary` and height band, or body beside the vehicle.

        Raises:
            ModuleNotFoundError: pandas is not there.
        """
        rows, errors = self._rows(regions), self.block_sums is not None
        return build_dataframe(
            {"region": row.region, "band": row.band, **row.to_dict(include_errors=errors)} for row in rows
        )

    def to_xarray(self) -> "xarray.Dataset":
        """The maps: each layer, its standard error as `KEY_error`, `points` and `observed_frames`.

        Returns:
            Over `height`, names of bands, and `y_m` and `x_m`, the middles of the cells; NaN where nothing is known.

        Raises:
            ModuleNotFoundError: xarray is not there.
        """
        maps = {key: layer.values for key, layer in self.layers.items()}
        maps |= {f"{key}_error": values for key, values in self.errors.items()}
        maps |= {"point_counts": self.point_counts, "observed_frames": self.observed_frames}
        of_cells = {"y_m": self.grid.y_centers_m.numpy(), "x_m": self.grid.x_centers_m.numpy()}
        arrays = {key: values.cpu().numpy() for key, values in maps.items()}
        return build_xarray_dataset(arrays, {"band": list(self.grid.heights), **of_cells})

    @property
    def layers(self) -> Mapping[str, Layer]:
        """(H, Y, X) each, by the key of their quantity: `coverage.layers["radius_m"].values`."""
        return expand_layers(self.sparse_layers, self.observed_cells)

    @property
    def observed_frames(self) -> Tensor:
        """(H, Y, X) int64 steps that had a reference point in the cell."""
        return self.observed_cells.expand_to_grid(self.observed_cells.observed_frames, 0)

    @property
    def point_counts(self) -> Tensor:
        """(H, Y, X) int64 reference points in the cell."""
        return self.observed_cells.expand_to_grid(self.observed_cells.point_counts, 0)

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """What there is one number of for each region: the mean radius, then the detection at each threshold."""
        return MeanOfMeans(self.thresholds_m).quantities

    @property
    def band_frame(self) -> BandFrame:
        """What the height bands are over: "ground", the local ground, or "vehicle", z of the vehicle frame."""
        return self.grid.band_frame

    @property
    def radius(self) -> Tensor:
        """(H, Y, X) float64 mean blind spot radius in metres."""
        return self.layers[RADIUS.key].values

    @property
    def detection(self) -> Tensor:
        """(T, H, Y, X) float64 detection probability at each threshold."""
        each = [
            self.observed_cells.expand_to_grid(self.sparse_layers[quantity.key].values)
            for quantity in self.quantities[1:]
        ]
        return torch.stack(each) if each else self.radius.new_empty((0, *self.grid.shape))

    @property
    def errors(self) -> Mapping[str, Tensor]:
        """Key of a quantity -> (H, Y, X) standard errors; NaN where too few blocks probed, empty without blocks."""
        return LazyMaps(self.sparse_errors, self.observed_cells.expand_to_grid)

    @cached_property
    def sparse_errors(self) -> Mapping[str, Tensor]:
        """Key of a quantity -> (K,) standard errors in the known cells."""
        if self.block_sums is None:
            return {}
        errors = estimate_cell_errors(self.quantities, self.observed_cells, self.block_sums)
        if self.area_sums is not None:
            each = estimate_cell_errors(self.quantities, self.observed_cells, self.area_sums)
            errors |= {make_area_quantity(one).key: each[one.key] for one in self.quantities}
        return errors

    def summary(self, regions: Sequence[Region] | None = None) -> list[RegionSummary]:
        """One row for each region and height band that tables show of it.

        Args:
            regions: Regions within the grid; `self.regions` if not given.

        Returns:
            Rows in the order of the regions, then of the bands.

        Raises:
            ValueError: A region reaches beyond the grid, or holds no cell centre.
        """
        wanted = self.regions if regions is None else regions
        return [summarize_region(self, *place) for place in list_region_bands(wanted, self.grid)]

    @property
    def average(self) -> Average:
        """What its numbers are means over: "area" if the reference points had square metres, else "cells"."""
        return "cells" if self.area_sums is None else "area"

    def estimate(self, region: Region, band: str, average: Average | None = None) -> Estimate:
        """The numbers of one region in one band with what they become without each block, for errors of differences.

        Args:
            region: A region within the grid.
            band: Name of the band.
            average: "area", the mean over the visible surface (`torchcover.coverage.averages.sum_area_by_block`), or
                "cells", the paper's unweighted mean over the known cells. Not given: that of this result.

        Returns:
            That of `quantities`.

        Raises:
            ValueError: A region that reaches beyond the grid, or holds no cell centre; no such band; "area" of points
                without square metres, or of a region that was not asked for and whose edges are not those of cells.
        """
        key = region, band, average or self.average
        if key not in self._estimates:
            check_regions([region], self.grid)
            of_measure = estimate_area_average if key[2] == "area" else estimate_cell_average
            self._estimates[key] = of_measure(self, region, band)
        return self._estimates[key]

    def estimate_aggregated(self, region: Region, band: str) -> Estimate:
        """The numbers of other aggregations in one region and band; unknown where the metric was not told of it."""
        if self.aggregated_numbers is None:
            return self.estimate(region, band)[:0]
        quantities, value, left_out = self.aggregated_numbers
        place = self.find_region_band(region, band)
        if place is None or self.block_sums is None:
            return Estimate.from_values(
                quantities, torch.full_like(value[0], math.nan) if place is None else value[place]
            )
        used = self.block_sums.frame_counts > 0
        return Estimate(quantities, value[place], left_out[used, place], self.block_sums.frame_counts[used])

    def estimate_number(self, quantity_key: str, region: Region, band: str) -> Estimate:
        """Any one number, by the name of its column in `summary.csv`.

        Args:
            quantity_key: "radius_m", "detection_0.4m"; "cells_detection_0.4m" over the known cells of a result by area;
                "radius_maximum_m" of an aggregation; "radius_m_without_roof" and "detected_by_two_0.4m" of redundancy.
            region: A region within the grid.
            band: Name of the band.

        Raises:
            ValueError: There is no such number; as `estimate`.
        """
        for quantities, estimate in self._estimators.items():
            for at, quantity in enumerate(quantities):
                if quantity.key == quantity_key:
                    return replace(estimate(region, band)[at : at + 1], quantities=(quantity,))
        there = [quantity.key for quantity in self.all_quantities]
        nearest = get_close_matches(quantity_key, there, n=1) or there
        raise ValueError(f"{quantity_key}: the result has no such number; it has {', '.join(nearest)}")

    @property
    def all_quantities(self) -> tuple[Quantity, ...]:
        """All that `estimate_number` has a number of."""
        return tuple(quantity for quantities in self._estimators for quantity in quantities)

    @property
    def _estimators(self) -> dict[tuple[Quantity, ...], Callable[[Region, str], Estimate]]:
        estimators: dict[tuple[Quantity, ...], Callable[[Region, str], Estimate]] = {self.quantities: self.estimate}
        if self.aggregated_numbers is not None:
            estimators[self.aggregated_numbers.quantities] = self.estimate_aggregated
        if self.average == "area":
            estimators[tuple(map(make_cells_quantity, self.quantities))] = partial(self.estimate, average="cells")
        if self.redundancy is not None:
            own = list_redundancy_quantities(self.redundancy.sensor_names, self.thresholds_m)
            estimators[own] = lambda *place: estimate_redundancy(self, *place)[len(self.quantities) :]
        return estimators

    def scalars(self, regions: Sequence[Region] | None = None) -> dict[str, float]:
        """The summary as a flat dict for a logger, of the regions that `summary` takes.

        Returns:
            `"radius_m/20m/ground"`, `"detection_0.4m/20m/ground"`, `"observed_share/20m/ground"` and so on, and
            `"visible_m2/20m/ground"` if the reference points had square metres.
        """
        rows = self._rows(regions)
        return {
            key: value
            for row in rows
            for key, value in row.to_scalars(include_errors=self.block_sums is not None).items()
        }

    def _rows(self, regions: Sequence[Region] | None) -> list[RegionSummary]:
        return [*self.summary(regions), *(self.target_sums.summarize() if self.target_sums else ())]

    def save(self, path: str | Path) -> None:
        """Write everything to one `.npz` file, which NumPy reads too: lists over the known cells, and the blocks.

        What `load` gives back has the same numbers, errors and differences to the last bit.
        """
        write_atomically(Path(path), partial(write_coverage, self))

    @classmethod
    def load(cls, path: str | Path) -> "Coverage":
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: No such file.
            IsADirectoryError: A folder.
            BadFileError: Not a coverage file, a damaged one, one of another version, or too large a one.
        """
        return cls(**read_coverage(path))

    def find_region_band(self, region: Region, band: str) -> int | None:
        """Which of `regions` and bands it is, region by region; None if it is none."""
        self.get_band_index(band)
        return RegionBands(self.regions, self.grid).find_index(region, band)

    def get_cell_mask(self, region: Region) -> Tensor:
        """(Y, X) bool: the cells of a region."""
        return region.mask_cells(self.grid).to(self.observed_cells.cell_indices.device)

    def mask_observed_cells(self, region: Region, band: str) -> Tensor:
        """(K,) bool: which of the known cells lie in a region in a band."""
        return self.observed_cells.mask_cells(self.get_cell_mask(region), self.get_band_index(band))

    def get_band_index(self, band: str) -> int:
        """The number of a band; ValueError if there is none of this name."""
        if band not in self.grid.heights:
            raise ValueError(f"height {band!r}: the grid has {', '.join(self.grid.heights)}")
        return list(self.grid.heights).index(band)


# `torch.load` gives them back with weights_only=True, its default.
torch.serialization.add_safe_globals([Coverage, BlockSums, ObservedCells, AggregatedNumbers, RegionSums])
torch.serialization.add_safe_globals([Layer, Quantity, Redundancy])
