"""Queries of objectives around one vehicle, and the observers of `evaluate` that answer them for a rig."""

import math
import re
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from itertools import chain
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from torchcover.coverage import AGGREGATIONS, Aggregation, Average, BevGrid, CoverageSums, MeanOfMeans, Region
from torchcover.coverage.grid import PAPER_HEIGHTS
from torchcover.coverage.number import estimate_number, list_number_keys
from torchcover.coverage.quantities import RADIUS, make_detection_quantity, make_failure_quantity
from torchcover.estimation import Estimate
from torchcover.evaluation import CoverageObserver
from torchcover.evaluation.measurement import NUM_BLOCKS
from torchcover.geometry.arrays import Float64
from torchcover.placement.objective import DEFAULT_THRESHOLD_M, Objective
from torchcover.simulation import Areas, RegionsOfInterest, Rig, SurfaceReference
from torchcover.simulation.regions_of_interest import RegionOfInterest

ANY = "any"  # stands in a key for the sensor whose failure is worst
DETECTION_KEY = re.compile(r"(?:detection|sensors|detected_by_two)_(\d+(?:\.\d+)?)m")
FAILURE_KEY = re.compile(r"(.+)_without_(.+)")


class Queries(NamedTuple):
    """Regions, bands and thresholds that objectives query around one vehicle.

    Args:
        objectives: Objectives of regions by name; requirements of targets and encounters are excluded.
        regions: Regions by name.
        grid: Cells of 0.5 m around the regions.
        max_radius_m: Radius at which radii saturate: as in `evaluate`, or the largest threshold without a radius.
        thresholds_m: Thresholds in meters.
        objective_names: Names of all objectives, in order.
    """

    objectives: Mapping[str, Objective]
    regions: Mapping[str, Region]
    grid: BevGrid
    max_radius_m: float
    thresholds_m: tuple[float, ...]
    objective_names: tuple[str, ...]

    @classmethod
    def from_objectives(cls, objectives: Mapping[str, Objective], ego_outline_m: Float64) -> Self:
        """Collect the queries of objectives.

        Args:
            objectives: Objectives by name.
            ego_outline_m: (K, 2) corners x, y of the vehicle in meters.

        Raises:
            ValueError: A region or band is unknown, two regions have one name, or a region contains no cell center.
        """
        named_regions = {region.name: region for region in RegionsOfInterest().build_query_plan(ego_outline_m).regions}
        names = tuple(objectives)
        region_objectives = {name: objectives[name] for name in names if not objectives[name].requirement}
        # Requirements alone still need frames, and their number follows from some region.
        region_objectives = region_objectives or {"": Objective(region="20m", band="ground")}
        regions: dict[str, Region] = {}
        heights: dict[str, tuple[float, float]] = {}
        thresholds: set[float] = set()
        has_no_radius = True
        for name, objective in region_objectives.items():
            try:
                for region in objective.resolve_regions(named_regions):
                    if regions.setdefault(region.name, region) != region:
                        raise ValueError(f"region {region.name!r}: two objectives define it differently; rename one")
            except ValueError as error:
                raise ValueError(f"objective {name!r}: {error}") from error
            for _, band in objective.region_bands:
                heights[band] = PAPER_HEIGHTS[band]
            thresholds.update(float(threshold) for threshold in DETECTION_KEY.findall(objective.key))
            has_no_radius &= DETECTION_KEY.match(objective.key) is not None
        documents = {name: _to_document(region) for name, region in regions.items()}
        grid = RegionsOfInterest(regions=documents, heights=heights).build_query_plan(ego_outline_m, 0.5).grid
        thresholds_m = tuple(sorted(thresholds))
        max_radius_m = thresholds_m[-1] if has_no_radius and thresholds_m[-1] > 0 else grid.diagonal_m
        return cls(region_objectives, regions, _crop_grid(grid, regions.values()), max_radius_m, thresholds_m, names)

    @property
    def search_radius_m(self) -> float | None:
        """Distance from a reference point beyond which sensor points change no number; None if all matter."""
        return self.max_radius_m if self.max_radius_m in self.thresholds_m else None

    @property
    def areas(self) -> Areas:
        """Rectangles of whole cells around the regions, since an average over cells needs whole cells."""
        grids = [_crop_grid(self.grid, [region]) for region in self.regions.values()]
        return tuple((grid.x_m, grid.y_m) for grid in grids)

    def build_reference_sensor(self, num_rays: int) -> SurfaceReference:
        """Build a reference sensor that samples the queried regions and bands.

        Args:
            num_rays: Approximate number of rays.
        """
        bands_m = tuple(self.grid.heights.values())
        return SurfaceReference(self.areas, num_rays, bands_m=bands_m, band_frame=self.grid.band_frame)

    def mask_points(self, points: Tensor, heights_m: Tensor | None = None) -> Tensor:
        """Mask the points in a queried region and band.

        Args:
            points: (M, 3) points in the vehicle frame in meters.
            heights_m: (M,) heights above ground; None takes z.

        Returns:
            (M,) bool.
        """
        is_inside, band_points, cell = self.grid.assign_cells(points, heights_m)
        point_indices = is_inside[band_points]
        mask = torch.zeros(len(points), dtype=torch.bool, device="cpu")
        x, y = points[point_indices, :2].T
        bands = list(self.grid.heights)
        cells_per_band = self.grid.num_cells // len(bands)
        band_index, column = cell // cells_per_band, cell % cells_per_band
        for region_name, band in self._list_region_bands():
            region = self.regions[region_name]
            # An average by area needs points in the region, an average over cells all points of its cells.
            in_region = region.mask_points(x, y) | region.mask_cells(self.grid).view(-1)[column]
            mask[point_indices[in_region & (band_index == bands.index(band))]] = True
        return mask

    def check(self, rig: Rig) -> None:
        """Check that results of a rig contain the numbers of all objectives.

        Args:
            rig: The rig.

        Raises:
            ValueError: A number is unknown; the message has the most similar one.
        """
        queries = self._replace(thresholds_m=self.thresholds_m or (DEFAULT_THRESHOLD_M,))
        with warnings.catch_warnings(action="ignore"):  # the observer has no frames
            coverage = queries.build_observer(rig, "area").compute()
        keys = list_number_keys(coverage)
        quantities = (RADIUS, *(make_detection_quantity(threshold_m) for threshold_m in queries.thresholds_m))
        keys += [quantity.key for quantity in quantities]
        keys += [make_failure_quantity(ANY, quantity).key for quantity in quantities]
        for kind in AGGREGATIONS:
            keys += [quantity.key for quantity in kind.parse(kind.example).quantities]
        for name, objective in self.objectives.items():
            if objective.key not in keys:
                similar = get_close_matches(objective.key, keys, n=1, cutoff=0.0)
                raise ValueError(
                    f"objective {name!r}: results have no number {objective.key!r}; did you mean {similar[0]!r}?"
                )

    @property
    def aggregations(self) -> tuple[Aggregation, ...]:
        """Aggregations that the objectives need."""
        keys = {objective.key for objective in self.objectives.values()}
        aggregations = [kind.from_keys(keys) for kind in AGGREGATIONS]
        return tuple(aggregation for aggregation in aggregations if aggregation)

    def build_observer(self, rig: Rig, average: Average) -> CoverageObserver:
        """Build an observer of the coverage of a rig.

        Args:
            rig: The rig.
            average: Average of the numbers, "area" or "cells".

        Returns:
            An observer without frames.
        """
        needs_sensors = any(_needs_sensors(objective.key) for objective in self.objectives.values())
        coverage = CoverageSums(
            self.grid,
            self.thresholds_m,
            max_radius_m=self.max_radius_m,
            num_blocks=NUM_BLOCKS,
            regions=tuple(self.regions.values()),
            aggregations=self.aggregations,
            sensor_names=tuple(sensor.name for sensor in rig.sensors) if needs_sensors else (),
            has_area_weights=average == "area",
        )
        return CoverageObserver(coverage, rig.name)

    def estimate(self, metric: CoverageSums, met_shares: Mapping[str, Estimate]) -> Estimate:
        """Estimate the objectives, each a quantity under its own name.

        Args:
            metric: Metric of `build_observer` with the sums of all frames.
            met_shares: Name of an objective with a requirement -> share of positions or encounters that meet it, the
                same in every block.
        """
        parts = self._estimate_parts(metric)
        frame_counts = max((part.frame_counts for part in chain.from_iterable(parts.values())), key=len)
        missing = torch.full((len(frame_counts),), math.nan, dtype=torch.float64, device="cpu")
        quantities, values, values_without_block = [], [], []
        for name in self.objective_names:
            estimates = parts.get(name) or [met_shares[name]]
            quantities.append(estimates[0].quantities[0]._replace(key=name))
            values.append(torch.cat([estimate.value for estimate in estimates]).mean())
            if name in met_shares:
                values_without_block.append(values[-1].expand(len(frame_counts)))
            elif all(len(estimate.jackknife_values) == len(frame_counts) for estimate in estimates):
                values_without_block.append(
                    torch.cat([estimate.jackknife_values for estimate in estimates], dim=1).mean(dim=1)
                )
            else:
                values_without_block.append(missing)
        return Estimate(tuple(quantities), torch.stack(values), torch.stack(values_without_block, dim=1), frame_counts)

    def _estimate_parts(self, metric: CoverageSums) -> dict[str, list[Estimate]]:
        """Return for each objective its number in each of its regions and bands."""
        mean_keys = [quantity.key for quantity in MeanOfMeans(metric.thresholds_m).quantities]
        if metric.has_area_weights and all(objective.key in mean_keys for objective in self.objectives.values()):
            region_bands = self._list_region_bands()
            pairs = [(self.regions[region], band) for region, band in region_bands]
            area_estimates = dict(zip(region_bands, metric.estimate_regions(pairs), strict=True))

            def estimate_key(key: str, region: str, band: str) -> Estimate:
                estimates = area_estimates[region, band]
                index = [quantity.key for quantity in estimates.quantities].index(key)
                return estimates[index : index + 1]
        else:
            coverage = metric.compute()

            def estimate_key(key: str, region: str, band: str) -> Estimate:
                key = key if metric.has_area_weights else key.removeprefix("cells_")
                return estimate_number(coverage, key, self.regions[region], band)

        def estimate_part(key: str, region: str, band: str) -> Estimate:
            """Estimate a number in one region and band; the failure of any sensor is the worst of all failures."""
            failure = FAILURE_KEY.match(key)
            number, sensor = failure.groups() if failure else (key, "")
            if sensor == ANY:
                failures = [estimate_key(f"{number}_without_{name}", region, band) for name in metric.sensor_names]
                worst = _select_worst(failures)
                title = worst.quantities[0].title.removesuffix(metric.sensor_names[0]) + "any one sensor"
                return replace(worst, quantities=(worst.quantities[0]._replace(title=title),))
            # A sensor that the rig does not have cannot fail.
            return estimate_key(key if sensor in ("", *metric.sensor_names) else number, region, band)

        parts = {}
        for name, objective in self.objectives.items():
            parts[name] = [estimate_part(objective.key, region, band) for region, band in objective.region_bands]
        return parts

    def _list_region_bands(self) -> list[tuple[str, str]]:
        """List the queried pairs of region and band, each once."""
        region_bands = chain.from_iterable(objective.region_bands for objective in self.objectives.values())
        return list(dict.fromkeys(region_bands))


def _needs_sensors(key: str) -> bool:
    """Test whether a number, such as `detection_0.4m_without_roof`, needs a metric that distinguishes the sensors."""
    return FAILURE_KEY.match(key) is not None or not key.startswith(("radius", "detection", "cells_"))


def _select_worst(estimates: Sequence[Estimate]) -> Estimate:
    """Select the worst value of one number of several rigs, also without each block."""
    quantity = estimates[0].quantities[0]
    reduce: Any = torch.amax if quantity.lower_is_better else torch.amin
    value = reduce(torch.stack([estimate.value for estimate in estimates]), dim=0)
    jackknife_values = reduce(torch.stack([estimate.jackknife_values for estimate in estimates]), dim=0)
    return Estimate(estimates[0].quantities, value, jackknife_values, estimates[0].frame_counts)


def _to_document(region: Region) -> RegionOfInterest:
    """Convert a region to the document of a configuration."""
    if region.corners_m:
        return RegionOfInterest(polygon_m=region.corners_m)
    return RegionOfInterest(x_m=region.x_m, y_m=region.y_m)


def _crop_grid(grid: BevGrid, regions: Collection[Region]) -> BevGrid:
    """Crop a grid to the smallest range of its cells that contains the regions."""

    def find_range(edges: Tensor, bounds: Sequence[tuple[float, float]]) -> tuple[float, float]:
        """Find the smallest range of cell edges that contains all bounds."""
        low, high = min(low for low, _ in bounds), max(high for _, high in bounds)
        return float(edges[edges <= low].max()), float(edges[edges >= high].min())

    x = find_range(grid.x_edges_m, [region.x_m for region in regions])
    y = find_range(grid.y_edges_m, [region.y_m for region in regions])
    return BevGrid(x, y, grid.cell_m, grid.heights, grid.band_frame)
