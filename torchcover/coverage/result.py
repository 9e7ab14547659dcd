"""Result of a coverage metric: maps over the grid and numbers of regions."""

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from torchcover.coverage.aggregations import Layer, MeanOfMeans
from torchcover.coverage.averages import Average, estimate_cell_average, estimate_cell_errors
from torchcover.coverage.coverage_file import read_coverage, write_coverage
from torchcover.coverage.grid import BandFrame, BevGrid
from torchcover.coverage.plotting import plot_layer
from torchcover.coverage.quantities import RADIUS, make_area_quantity
from torchcover.coverage.redundancy import Redundancy, expand_layers
from torchcover.coverage.region_sums import AggregatedNumbers, RegionSums
from torchcover.coverage.regions import Region, RegionBands, check_regions, get_paper_regions, list_region_bands
from torchcover.coverage.sparse_sums import BlockSums, LazyMaps, ObservedCells
from torchcover.coverage.summary import RegionSummary, convert_to_cell_numbers, summarize_redundancy
from torchcover.estimation import Estimate, Quantity
from torchcover.files import write_atomically
from torchcover.notebooks import build_dataframe, build_result_html, build_xarray_dataset

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray


class Coverage:
    """Coverage maps and numbers of a run, the result of `CoverageMetric.compute`.

    The result stores the K observed cells, which contained reference points. Arrays over all cells have the shape
    (H, Y, X) of the grid, are created on access, and are NaN with count 0 in unobserved cells.

    Args:
        grid: Cells and height bands.
        thresholds_m: Detection thresholds in meters.
        max_radius_m: Radius in meters at which r saturates.
        observed_cells: Observed cells with their numbers of frames and points.
        layers: (K,) layers, which the attribute `sparse_layers` has by key: the mean radius, the detection at each
            threshold, then those of other aggregations.
        counts: Numbers of frames and points by the names in `COUNTS`.
        block_sums: Sums in blocks of contiguous frames, for errors; None without blocks.
        area_sums: Sums over the visible surface; None without area weights.
        regions: Regions of `summary`; by default the regions of `forward_regions()` that fit the grid.
        region_sums: Sums over area in `regions`, by the position of each point; None without area weights.
        aggregated_numbers: Numbers of other aggregations in `regions`; None without them.
        redundancy: Coverage without each sensor; None if the metric does not distinguish sensors.
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
    ) -> None:
        self.grid, self.thresholds_m, self.max_radius_m = grid, tuple(thresholds_m), max_radius_m
        self.observed_cells = observed_cells
        self.sparse_layers: Mapping[str, Layer] = {layer.quantity.key: layer for layer in layers}
        self.counts = dict(counts)
        self.block_sums, self.area_sums, self.region_sums = block_sums, area_sums, region_sums
        self.regions = get_paper_regions(grid) if regions is None else tuple(regions)
        self.aggregated_numbers, self.redundancy = aggregated_numbers, redundancy
        self._paper_means: dict[tuple[Region, str], Estimate] = {}

    def __repr__(self) -> str:
        share, num_frames = len(self.observed_cells.cell_indices) / self.grid.num_cells, self.counts["num_frames"]
        return f"Coverage({self.grid.shape} cells, {num_frames} frames, {share:.1%} of the cells observed)"

    def _repr_html_(self) -> str:
        return build_result_html([repr(self)], self.plot())

    def plot(self, quantity_key: str | None = None, band: str | None = None, ax: "Axes | None" = None) -> "Figure":
        """Plot one layer in one height band in bird's-eye view (`torchcover.coverage.plotting.plot_layer`).

        Args:
            quantity_key: Key of `layers`; by default the detection at the first threshold, or the radius without
                thresholds, by area if the result is.
            band: Name of the height band; by default the first.
            ax: Axes to plot on; by default those of a new figure that pyplot does not manage.

        Raises:
            ValueError: The layer or the band does not exist.
        """
        if quantity_key is None:
            quantity = self.quantities[min(1, len(self.thresholds_m))]
            quantity_key = (quantity if self.average == "cells" else make_area_quantity(quantity)).key
        if quantity_key not in self.layers:
            raise ValueError(f"layer: one of {', '.join(self.layers)} is needed; got {quantity_key!r}")
        return plot_layer(ax, self.layers[quantity_key], self.grid, band, self.counts["num_frames"])

    def to_dataframe(self, regions: Sequence[Region] | None = None) -> "pandas.DataFrame":
        """Convert the numbers of `scalars` to a table with one row per region and height band.

        Args:
            regions: As in `summary`.

        Raises:
            ModuleNotFoundError: pandas is not installed.
        """
        records = []
        for row in self.summary(regions):
            values = row.to_dict(include_errors=self.block_sums is not None)
            records.append({"region": row.region, "band": row.band, **values})
        return build_dataframe(records)

    def to_xarray(self) -> "xarray.Dataset":
        """Convert the maps to a data set: layers, standard errors as `KEY_error`, `point_counts`, `observed_frames`.

        Returns:
            Data set over `band`, names of height bands, and `y_m` and `x_m`, cell centers; NaN in unobserved cells.

        Raises:
            ModuleNotFoundError: xarray is not installed.
        """
        maps = {key: layer.values for key, layer in self.layers.items()}
        maps |= {f"{key}_error": values for key, values in self.errors.items()}
        maps |= {"point_counts": self.point_counts, "observed_frames": self.observed_frames}
        y_m, x_m = self.grid.y_centers_m.numpy(), self.grid.x_centers_m.numpy()
        axes: dict[str, Any] = {"band": list(self.grid.heights), "y_m": y_m, "x_m": x_m}
        return build_xarray_dataset({key: values.cpu().numpy() for key, values in maps.items()}, axes)

    @property
    def layers(self) -> Mapping[str, Layer]:
        """(H, Y, X) layers by the key of their quantity: `coverage.layers["radius_m"].values`."""
        return expand_layers(self.sparse_layers, self.observed_cells)

    @property
    def observed_frames(self) -> Tensor:
        """(H, Y, X) int64 number of frames with a reference point in the cell."""
        return self.observed_cells.expand_to_grid(self.observed_cells.observed_frames, 0)

    @property
    def point_counts(self) -> Tensor:
        """(H, Y, X) int64 number of reference points in the cell."""
        return self.observed_cells.expand_to_grid(self.observed_cells.point_counts, 0)

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Quantities with a number for each region: the mean radius, then the detection at each threshold."""
        return MeanOfMeans(self.thresholds_m).quantities

    @property
    def band_frame(self) -> BandFrame:
        """Zero of the height bands: "ground" for the local ground, or "vehicle" for z of the vehicle frame."""
        return self.grid.band_frame

    @property
    def radius(self) -> Tensor:
        """(H, Y, X) float64 mean blind spot radius in meters."""
        return self.layers[RADIUS.key].values

    @property
    def detection(self) -> Tensor:
        """(T, H, Y, X) float64 detection rate at each threshold."""
        detections = [self.layers[quantity.key].values for quantity in self.quantities[1:]]
        return torch.stack(detections) if detections else self.radius.new_empty((0, *self.grid.shape))

    @property
    def errors(self) -> Mapping[str, Tensor]:
        """(H, Y, X) standard errors by key; NaN where fewer than 8 blocks observed the cell; empty without blocks."""
        return LazyMaps(self.sparse_errors, self.observed_cells.expand_to_grid)

    @cached_property
    def sparse_errors(self) -> Mapping[str, Tensor]:
        """(K,) standard errors in the observed cells by the key of their quantity."""
        if self.block_sums is None:
            return {}
        errors = estimate_cell_errors(self.quantities, self.observed_cells, self.block_sums)
        if self.area_sums is not None:
            area_quantities = [make_area_quantity(quantity) for quantity in self.quantities]
            errors |= estimate_cell_errors(area_quantities, self.observed_cells, self.area_sums)
        return errors

    def summary(self, regions: Sequence[Region] | None = None) -> list[RegionSummary]:
        """Summarize each region in each height band.

        Args:
            regions: Regions within the grid; by default `self.regions`.

        Returns:
            Rows ordered by region, then by band; a region with `bands` has rows for these bands only.

        Raises:
            ValueError: A region reaches beyond the grid, or contains no cell center.
        """
        regions = self.regions if regions is None else regions
        return [self._summarize_region(region, band) for region, band in list_region_bands(regions, self.grid)]

    @property
    def average(self) -> Average:
        """Average of the numbers: "area" for means over the visible surface, else "cells"."""
        return "cells" if self.area_sums is None else "area"

    def _summarize_region(self, region: Region, band: str) -> RegionSummary:
        """Compute the numbers of one region in one height band."""
        observed_cells = int(self.mask_observed_cells(region, band).sum())
        is_by_area, num_frames = self.average == "area", self.counts["num_frames"]
        redundancy = None  # by area it is known only for the regions that the metric summed
        if self.redundancy is not None and (not is_by_area or region in self.regions):
            estimate = self.estimate_redundancy(region, band)
            redundancy = summarize_redundancy(self.redundancy.sensor_names, self.thresholds_m, estimate)
        visible_m2 = math.nan
        if is_by_area and num_frames:
            visible_m2 = float(self._sum_area_by_block(region, band)[1][:, 0].sum()) / num_frames
        estimates = self.estimate(region, band), self.estimate_aggregated(region, band), self.paper_mean(region, band)
        numbers, aggregated_numbers, cell_averages = convert_to_cell_numbers(estimates, observed_cells)
        return RegionSummary(
            region=region.name,
            band=band,
            num_cells=int(self.get_cell_mask(region).sum()),
            observed_cells=observed_cells,
            average=self.average,
            numbers=numbers | aggregated_numbers,
            cell_averages=cell_averages,
            visible_m2=visible_m2,
            redundancy=redundancy,
        )

    def estimate(self, region: Region, band: str) -> Estimate:
        """Estimate the numbers of one region in one band, with jackknife values for errors of differences.

        By area, the mean R = E[ sum of r dA ] / E[ sum of dA ] of a quantity r is a ratio of additive sums: it does not
        depend on the number of points, the cell size or the share of observed cells.

        Args:
            region: Region within the grid.
            band: Name of the height band.

        Returns:
            Estimate of `quantities`: the mean over the visible surface, or `paper_mean` without area weights.

        Raises:
            ValueError: The region reaches beyond the grid or contains no cell center, the band does not exist; or by
                area, the metric did not sum the region, and its bounds are not cell edges.
        """
        if self.average == "cells":
            return self.paper_mean(region, band)
        check_regions([region], self.grid)
        frame_counts, sums = self._sum_area_by_block(region, band)
        return Estimate.from_ratios(self.quantities, sums[:, 0], sums[:, 1:], frame_counts)

    def paper_mean(self, region: Region, band: str) -> Estimate:
        """Estimate the unweighted mean over the observed cells of a region in one band (Uecker & Zöllner 2024).

        It depends on the number of reference points: results of different numbers cannot be compared.

        Args:
            region: Region within the grid.
            band: Name of the height band.

        Returns:
            Estimate of `quantities`.

        Raises:
            ValueError: The region reaches beyond the grid or contains no cell center, or the band does not exist.
        """
        key = region, band
        if key not in self._paper_means:
            check_regions([region], self.grid)
            values = torch.stack([self.sparse_layers[quantity.key].values for quantity in self.quantities])
            cell_mask, band_index = self.get_cell_mask(region), self.grid.get_band_index(band)
            self._paper_means[key] = estimate_cell_average(
                self.quantities, self.observed_cells, values, self.block_sums, cell_mask, band_index
            )
        return self._paper_means[key]

    def _sum_area_by_block(self, region: Region, band: str) -> tuple[Tensor, Tensor]:
        """Return (B,) frames per block and (B, 1 + Q) sums over the visible surface: area in m2, area times values."""
        assert self.area_sums is not None
        index, region_sums = self.find_region_band(region, band), self.region_sums
        if region_sums is not None and index is not None:
            sums = region_sums.sums[:, : len(self.quantities), index]
            return region_sums.frame_counts, torch.cat([region_sums.areas_m2[:, index, None], sums], dim=1)
        region.check_whole_cells(self.grid)  # only then do its cells contain the same points as the region
        sums = self.area_sums.sum_cells(self.get_cell_mask(region), self.grid.get_band_index(band))
        return self.area_sums.frame_counts, sums

    def estimate_aggregated(self, region: Region, band: str) -> Estimate:
        """Estimate the numbers of other aggregations than the mean of means in one region and band.

        Args:
            region: Region within the grid.
            band: Name of the height band.

        Returns:
            Estimate without numbers if there is no other aggregation; NaN for regions that the metric did not sum.
        """
        if self.aggregated_numbers is None:
            return self.estimate(region, band)[:0]
        frame_counts = None if self.block_sums is None else self.block_sums.frame_counts
        return self.aggregated_numbers.estimate(self.find_region_band(region, band), frame_counts)

    def estimate_redundancy(self, region: Region, band: str) -> Estimate:
        """Estimate the numbers of a region with all sensors, followed by its redundancy (`list_redundancy_quantities`).

        Args:
            region: Region within the grid.
            band: Name of the height band.

        Returns:
            By area, numbers are NaN for regions that the metric did not sum. Over cells, numbers have no errors.
        """
        assert self.redundancy is not None
        quantities = (*self.quantities, *self.redundancy.quantities)
        index = self.find_region_band(region, band)
        if self.region_sums is not None and index is not None:
            return self.region_sums.estimate(quantities, index)
        if self.average == "area":
            unknown = torch.full((len(quantities),), math.nan, dtype=torch.float64, device="cpu")
            return Estimate.from_values(quantities, unknown)
        observed = self.mask_observed_cells(region, band)
        means = torch.stack([layer.values[observed].mean() for layer in self.redundancy.sparse_layers.values()])
        return Estimate.from_values(quantities, torch.cat([self.paper_mean(region, band).value, means]))

    def scalars(self, regions: Sequence[Region] | None = None) -> dict[str, float]:
        """Convert the summary to a flat dict for a logger.

        Args:
            regions: As in `summary`.

        Returns:
            Values by region and band: `"radius_m/20m/ground"`; with area weights `"visible_m2/20m/ground"`, too.
        """
        values: dict[str, float] = {}
        for row in self.summary(regions):
            values |= row.to_scalars(include_errors=self.block_sums is not None)
        return values

    def save(self, path: str | Path, further_arrays: "Mapping[str, NDArray[Any]] | None" = None) -> None:
        """Write the result to one `.npz` file, which NumPy can read: lists over observed cells, and the blocks.

        `load` restores numbers, errors and differences to the last bit.

        Args:
            path: File; it is replaced atomically.
            further_arrays: Arrays by name that the file also contains; `load` skips them.
        """
        attributes = {**vars(self), "sparse_errors": self.sparse_errors}
        write_atomically(Path(path), partial(write_coverage, attributes, further_arrays or {}))

    @classmethod
    def load(cls, path: str | Path) -> "Coverage":
        """Read a file that `save` wrote.

        Args:
            path: File.

        Raises:
            FileNotFoundError: The file does not exist.
            IsADirectoryError: The path is a folder.
            BadFileError: The file is not a coverage file, damaged, of another version, or too large.
        """
        return cls(**read_coverage(path))

    def find_region_band(self, region: Region, band: str) -> int | None:
        """Find the index of a pair of region and band as `RegionBands.find_index`."""
        return RegionBands(self.regions, self.grid).find_index(region, band)

    def get_cell_mask(self, region: Region) -> Tensor:
        """Return the (Y, X) bool cells of a region within the grid, on the device of the result."""
        return region.mask_cells(self.grid).to(self.observed_cells.cell_indices.device)

    def mask_observed_cells(self, region: Region, band: str) -> Tensor:
        """Return a (K,) bool mask of the observed cells of a region in a band."""
        return self.observed_cells.mask_cells(self.get_cell_mask(region), self.grid.get_band_index(band))


# Allows `torch.load` with weights_only=True, its default.
torch.serialization.add_safe_globals([Coverage, BlockSums, ObservedCells, AggregatedNumbers, RegionSums])
torch.serialization.add_safe_globals([Layer, Quantity, Redundancy])
