"""Sums of coverage: point clouds become sums over touched cells, and these sums become a `Coverage`."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchcover.coverage.aggregations import Aggregation, AreaAverage, MeanOfMeans
from torchcover.coverage.frame_input import (
    Clouds,
    FrameInput,
    FrameSums,
    SensorClouds,
    build_frame_inputs,
    check_parameters,
)
from torchcover.coverage.grid import BevGrid
from torchcover.coverage.quantities import MEASURED_WITHIN_M
from torchcover.coverage.redundancy import Redundancy, SensorFailures
from torchcover.coverage.region_sums import RegionSums, compute_aggregated_numbers
from torchcover.coverage.regions import Region, RegionBands, check_regions, get_paper_regions
from torchcover.coverage.result import Coverage
from torchcover.coverage.sparse_sums import BlockSums, ObservedCells
from torchcover.coverage.sum_columns import CellSums, SumColumns
from torchcover.devices import ensure_float64, map_tensors
from torchcover.estimation import Estimate
from torchcover.metrics import BlockedSums, SparseSums, sum_rows
from torchcover.metrics.blocked_sums import FINE_BLOCKS_PER_BLOCK
from torchcover.neighbors import nearest


class CoverageSums(BlockedSums):
    """Blind spot radius and detection rate over a grid: means over frames of means over reference points.

        radius[h, y, x]    = E_t[ E_q in cell [ r(q) ] ]
        detection[h, y, x] = E_t[ E_q in cell [ 1(r(q) <= threshold) ] ]

    with r(q) from `torchcover.blind_spot_radius`; a frame counts in a cell only if it has a reference point there
    (Uecker & Zöllner 2024). The state consists of a few sums for each cell and region that a frame touched: two metrics
    over different frames merge exactly (`merge_state`), and `compute` adds up the sums of all ranks. Frames are added
    in the order of their arrival; another order, or merging, may change the last bits, as for any sum of floats.

    With several blocks the sums are kept per block of contiguous frames, and the result has standard errors: successive
    frames are correlated, but blocks that are longer than the correlation time are independent.

    Args:
        grid: Cells and height bands; its `band_frame` determines whether `update` needs heights above ground.
        thresholds_m: Radii in meters up to which a point counts as detected; finite, >= 0 and at most `max_radius_m`.
        max_radius_m: Radius in meters at which r saturates. An empty sensor cloud gives r = `max_radius_m`; with the
            default, infinity, such a frame makes the radius of its cells infinite.
        num_blocks: 1 for no standard errors, or an even number from 8 on. At least half of the blocks are in use at the
            end of a long run.
        aggregations: Aggregations in addition to the mean of means, from `torchcover.coverage`: `Maximum()`,
            `PooledMean()`, `Quantiles(levels)`, `FrameQuantiles(levels)`, or a custom class; at most one of each class.
            Each yields maps, and numbers of `regions`.
        regions: Regions for which the result has numbers; by default the regions of `forward_regions()` that fit the
            grid. Averages over area assign each reference point to regions by its position, so that cells only affect
            maps.
        sensor_names: Names of the sensors of the rig, for `Coverage.redundancy`; `update` then takes one cloud per
            sensor by name, and the result describes the rig without each of them.
        needs_radii: Compute radii. Without them radii are NaN, and the search ends at the largest threshold: the clouds
            may lack points that are farther from any reference point.
        has_area_weights: Compute averages over area as well; each frame then needs the area of its reference points, as
            `SurfaceReference` provides it.
        backend: Nearest-neighbor search, as in `torchcover.nearest`.
        memory_mb: Memory limit in megabytes, as in `torchcover.nearest`.
        kwargs: Keyword arguments of the next base class, such as `MergeableMetric`.

    Raises:
        ValueError: A threshold is negative, not finite, above `max_radius_m` or repeated; `max_radius_m` is not
            positive; `num_blocks` is neither 1 nor even and 8 or more; two aggregations have one class; a region
            reaches beyond the grid or contains no cell center.

    Example:
        >>> metric = CoverageSums(BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0), cell_m=1.0, heights={"all": (-1.0, 1.0)}))
        >>> metric.update(sensor=torch.zeros(1, 3), reference=torch.tensor([[0.3, 0.0, 0.0], [0.5, 0.0, 0.0]]))
        >>> metric.compute().radius
        tensor([[[0.4000,    nan]]], dtype=torch.float64)
    """

    cell_sums = SparseSums()
    region_sums = SparseSums()
    empty_sensor_frames: Tensor
    empty_reference_frames: Tensor
    saturated_points: Tensor
    inside_points: Tensor
    outside_points: Tensor
    no_ground_points: Tensor

    def __init__(
        self,
        grid: BevGrid,
        thresholds_m: Sequence[float] = (0.4,),
        *,
        max_radius_m: float = math.inf,
        num_blocks: int = 1,
        aggregations: Sequence[Aggregation] = (),
        regions: Sequence[Region] | None = None,
        sensor_names: Sequence[str] = (),
        needs_radii: bool = True,
        has_area_weights: bool = False,
        backend: str = "auto",
        memory_mb: float = 256.0,
        **kwargs: Any,  # noqa: ANN401  (of the next base)
    ) -> None:
        check_parameters(thresholds_m, max_radius_m, aggregations)
        if not needs_radii and (aggregations or sensor_names or not thresholds_m):
            raise ValueError(
                "needs_radii: aggregations and sensor_names need radii, and without radii a threshold is needed"
            )
        regions = get_paper_regions(grid) if regions is None else tuple(regions)
        check_regions(regions, grid)
        thresholds_m, max_radius_m = tuple(float(threshold) for threshold in thresholds_m), float(max_radius_m)
        definition: dict[str, object] = {
            "grid": grid,
            "thresholds_m": thresholds_m,
            "max_radius_m": max_radius_m,
            "num_blocks": num_blocks,
            "aggregations": tuple(aggregations),
            "has_area_weights": has_area_weights,
        }
        if sensor_names:
            definition["sensor_names"] = tuple(sensor_names)
        if not needs_radii:
            definition["needs_radii"] = needs_radii
        if has_area_weights or aggregations:
            definition["regions"] = regions
        super().__init__(num_blocks, definition, **kwargs)
        self.grid, self.thresholds_m, self.max_radius_m = grid, thresholds_m, max_radius_m
        self.regions, self.sensor_names, self.has_area_weights = regions, tuple(sensor_names), has_area_weights
        self.needs_radii, self.backend, self.memory_mb = needs_radii, backend, memory_mb
        area_averages = [AreaAverage(thresholds_m)] if has_area_weights else []
        self._map_aggregations: tuple[Aggregation, ...] = (MeanOfMeans(thresholds_m), *area_averages, *aggregations)
        self._failures = SensorFailures(self.sensor_names, thresholds_m, has_area_weights) if sensor_names else None
        failures = [self._failures] if self._failures else []
        self.aggregations: tuple[Aggregation, ...] = (*self._map_aggregations, *failures)
        self._extra_aggregations, self._columns = tuple(aggregations), SumColumns(self.aggregations)
        self._region_bands = RegionBands(regions if has_area_weights or aggregations else (), grid)
        layout: dict[str, Any] = {"num_columns": self._columns.num_columns, "num_maxima": self._columns.num_maxima}
        self.define_sparse_sums("cell_sums", grid.num_cells, **layout)
        self.define_sparse_sums("region_sums", self._region_bands.num_region_bands, **layout, is_fine=True)
        for name in Coverage.COUNTS[1:]:  # the base class counts the frames
            self.define_sum(name, (), torch.int64)

    def update(
        self,
        sensor: SensorClouds,
        reference: Clouds,
        *,
        weights: Clouds | None = None,
        heights_m: Clouds | None = None,
        block_index: int | Sequence[int] | None = None,
        errors_m: Clouds | None = None,
    ) -> None:
        """Add one frame, or one frame per entry of two lists.

        Args:
            sensor: (N, 3) points of the rig in the vehicle frame in meters, at their true positions if these are known,
                or a list of such clouds. N = 0 is a frame without returns. With `sensor_names`: a dict from sensor name
                to points, or a list of such dicts.
            reference: (M, 3) points of the reference sensor in the same frame, or a list of the same length. A frame
                with M = 0 adds nothing.
            weights: (M,) area in m2 that each reference point represents (`frame.reference_weights`), or a list: weight
                in the mean over a cell in this frame and in averages over area. By default all points weigh the same.
            heights_m: (M,) height of each reference point above ground in meters (`frame.reference_heights_m`), or a
                list; required if `grid.band_frame` is "ground", refused otherwise. A point with NaN, without ground at
                or below it, is in no band and is counted.
            block_index: Index of the frame in time, at most 10^15, or a list (`frame.block_index`). It determines the
                block; frames with the same index, such as two passes of one recorded time, share one. By default
                frames are numbered in the order of their arrival.
            errors_m: (N,) distance in meters by which each point was measured off its true position along its ray, in
                the order of the sensors, or a list. A point detects nothing at thresholds below its error and counts
                for radii if the error is at most `MEASURED_WITHIN_M`, 0.4 m. By default all errors are 0.

        Raises:
            ValueError: Lists of different length, a shape other than (N, 3), NaN or infinite coordinates, or weights,
                heights, block indices or errors that `torchcover.coverage.frame_input.build_frame_inputs` refuses.
            TypeError: A cloud is not a floating-point tensor, or a block index is not an integer.
        """
        options = {"weights": weights, "heights_m": heights_m, "block_index": block_index, "errors_m": errors_m}
        for sums in self.compute_sums(sensor, reference, **options):
            self.add_sums(sums)

    def compute_sums(self, sensor: SensorClouds, reference: Clouds, **options: Any) -> list[FrameSums]:  # noqa: ANN401
        """Compute what `update` adds for each frame; the result is the same in any process with the same parameters.

        Args:
            sensor: As in `update`.
            reference: As in `update`.
            options: Further arguments of `update`.

        Returns:
            One entry per frame, for `add_sums`.
        """
        options = dict.fromkeys(("weights", "heights_m", "block_index", "errors_m")) | options
        sensor, reference, options = map_tensors((sensor, reference, options), ensure_float64)
        frames = build_frame_inputs(
            sensor,
            reference,
            **options,
            grid=self.grid,
            thresholds_m=self.thresholds_m,
            has_area_weights=self.has_area_weights,
            sensor_names=self.sensor_names,
            first_block_index=int(self.num_frames),
        )
        return [self._compute_frame_sums(frame) for frame in frames]

    @torch.no_grad()  # the sums would keep the graph of each frame alive
    def _compute_frame_sums(self, frame: FrameInput) -> FrameSums:
        """Compute the sums that one frame adds to cells and regions."""
        _, _, reference, weights, heights_m, block_index = frame
        point_indices, point_positions, cell_indices = self.grid.assign_cells(reference, heights_m)
        # Only the reference may be cropped: the nearest sensor point may lie outside the grid.
        sensor_distances = self._measure_sensor_distances(reference[point_indices], frame)
        distance = sensor_distances[0].amin(dim=0)
        values = self._compute_values([distances[:, point_positions] for distances in sensor_distances])
        points = reference[point_indices[point_positions]]
        weights = None if weights is None else weights.to(reference.device)[point_indices[point_positions]]
        region_bands, region_points = self._region_bands.assign_points(points, cell_indices)
        region_weights = None if weights is None else weights[region_points]
        counts = {
            "num_frames": 1,
            "empty_sensor_frames": int(frame.is_blind),
            "empty_reference_frames": int(len(reference) == 0),
            "saturated_points": int((distance >= self.max_radius_m).sum()) if self.needs_radii else 0,
            "inside_points": len(distance),
            "outside_points": len(reference) - len(distance),
            "no_ground_points": 0 if heights_m is None else int(heights_m.isnan().sum()),
        }
        return FrameSums(
            block_index,
            counts,
            self._columns.compute_columns(cell_indices, values, weights),
            self._columns.compute_columns(region_bands, values[:, region_points], region_weights),
        )

    def add_sums(self, sums: FrameSums) -> None:
        """Add the sums of one frame.

        Args:
            sums: Result of `compute_sums` of a metric with the same parameters.
        """
        block = self._assign_block(sums.block_index)
        self.add_to_sparse_sums("cell_sums", block, sums.cell_columns)
        self.add_to_sparse_sums("region_sums", self._get_fine_block(sums.block_index), sums.region_columns)
        for name, count in sums.counts.items():
            getattr(self, name).add_(count)
        self._handle_added_frames()

    def _measure_sensor_distances(self, reference: Tensor, frame: FrameInput) -> list[Tensor]:
        """Compute (S, M) distances to the nearest point of each sensor: for the radius, then for each threshold.

        Points are grouped by their error, and each group is searched once: most errors are below all thresholds.
        """
        distances_by_error: dict[float, Tensor] = {}
        lower_error_m, distance = -math.inf, None
        for error_m in sorted({MEASURED_WITHIN_M, *self.thresholds_m}):
            counts_for_radii = self.needs_radii and error_m <= MEASURED_WITHIN_M
            reach_m = self.max_radius_m if counts_for_radii else max(self.thresholds_m)
            clouds = frame.select_points(lower_error_m, error_m)
            if distance is None or any(map(len, clouds)):
                search = partial(nearest, max_distance=reach_m, backend=self.backend, memory_mb=self.memory_mb)
                distances = torch.stack([search(reference, cloud.to(reference.device)).distance for cloud in clouds])
                distance = distances if distance is None else torch.minimum(distance, distances)
            distances_by_error[error_m], lower_error_m = distance, error_m
        return [distances_by_error[error_m] for error_m in (MEASURED_WITHIN_M, *self.thresholds_m)]

    def _compute_values(self, sensor_distances: Sequence[Tensor]) -> Tensor:
        """Compute (V, N) float64 values of points from the result of `_measure_sensor_distances`."""
        distance, *threshold_distances = (distances.amin(dim=0) for distances in sensor_distances)
        # Before saturation: a point without a sensor point within max_radius_m is not detected at that threshold.
        pairs = zip(threshold_distances, self.thresholds_m, strict=True)
        detections = [(distances <= threshold_m).double() for distances, threshold_m in pairs]
        radius = distance.clamp(max=distance.new_tensor(self.max_radius_m)).double()
        radius = radius if self.needs_radii else torch.full_like(radius, math.nan)
        values = torch.stack([radius, *detections])
        if self._failures:
            values = torch.cat([values, self._failures.compute_values(sensor_distances, self.max_radius_m)])
        return values

    def compute(self) -> Coverage:
        """Compute the coverage over all added frames. Cells without any reference point are NaN with count 0."""
        num_cells, table = self.grid.num_cells, self.cell_sums
        rows = sum_rows(torch.cat([table[:, :1] % num_cells, table[:, 1:]], dim=1), self._columns.num_maxima)
        sums = self._columns.split_columns(rows[:, 1:].T)
        observed_cells = ObservedCells(
            self.grid.shape, rows[:, 0].long(), sums.observed_frames.long(), sums.point_counts.long()
        )
        layers = []
        for aggregation in self._map_aggregations:
            layers += sums.compute_layers(aggregation, self.max_radius_m)
        block_sums, area_sums = self._build_block_sums(table)
        redundancy = None
        if self._failures:
            failure_layers = sums.compute_layers(self._failures, self.max_radius_m)
            redundancy = Redundancy(
                self.sensor_names, observed_cells, {layer.quantity.key: layer for layer in failure_layers}
            )
        aggregated_numbers = None
        if self._extra_aggregations and self._region_bands.num_region_bands:
            aggregated_numbers = compute_aggregated_numbers(
                self._sum_regions(use_fine_blocks=False), self._extra_aggregations, self.max_radius_m
            )
        return Coverage(
            grid=self.grid,
            thresholds_m=self.thresholds_m,
            max_radius_m=self.max_radius_m,
            observed_cells=observed_cells,
            layers=layers,
            block_sums=block_sums,
            area_sums=area_sums,
            counts={name: int(getattr(self, name)) for name in Coverage.COUNTS},
            regions=self.regions,
            region_sums=self._build_region_sums(),
            aggregated_numbers=aggregated_numbers,
            redundancy=redundancy,
        )

    def _build_block_sums(self, table: Tensor) -> tuple[BlockSums | None, BlockSums | None]:
        """Build the sums in blocks for means over frames, and those for averages over area."""
        sums = self._columns.split_columns(table[:, 1:].T)
        lists = self.block_frame_counts.clone(), (self.num_blocks, *self.grid.shape), table[:, 0].long()
        means = sums.sums_by_aggregation[MeanOfMeans.name]
        has_blocks = self.num_blocks > 1
        block_sums = BlockSums(*lists, sums.observed_frames.long(), means["sums"]) if has_blocks else None
        if not self.has_area_weights:
            return block_sums, None
        areas = sums.sums_by_aggregation[AreaAverage.name]
        return block_sums, BlockSums(*lists, areas["m2"], areas["sums"])

    def _sum_regions(self, *, use_fine_blocks: bool) -> CellSums:
        """Compute the sums (..., B, P) of P regions and bands, in fine blocks or in blocks."""
        # A block with fewer frames than fine blocks consists of one fine block per frame.
        fine_per_block = 1 if use_fine_blocks else min(int(self.frames_per_block), FINE_BLOCKS_PER_BLOCK)
        num_blocks = self.num_fine_blocks if use_fine_blocks else self.num_blocks
        num_region_bands, num_columns = self._region_bands.num_region_bands, self._columns.num_columns
        keys, columns = self.region_sums.split_with_sizes([1, num_columns], dim=1)
        block_indices = keys.div(fine_per_block * num_region_bands, rounding_mode="floor")
        keys = block_indices * num_region_bands + keys % num_region_bands
        rows = sum_rows(torch.cat([keys, columns], dim=1), self._columns.num_maxima)
        sums = columns.new_zeros(num_columns, num_blocks * num_region_bands)
        sums[num_columns - self._columns.num_maxima :] = -math.inf
        sums[:, rows[:, 0].long()] = rows[:, 1:].T
        return self._columns.split_columns(sums.view(-1, num_blocks, num_region_bands))

    def _build_region_sums(self) -> RegionSums | None:
        if not (self.has_area_weights and self._region_bands.num_region_bands):
            return None
        sums = self._sum_regions(use_fine_blocks=True).sums_by_aggregation
        names = [name for name in (AreaAverage.name, SensorFailures.name) if name in sums]
        values = torch.cat([sums[name]["sums"] for name in names]).movedim(0, 1)
        return RegionSums(self.fine_block_frame_counts.clone(), sums[AreaAverage.name]["m2"], values)

    def estimate_regions(self, region_bands: Sequence[tuple[Region, str]]) -> list[Estimate]:
        """Compute the numbers of regions over all added frames as `compute().estimate`, without computing maps.

        Args:
            region_bands: Regions within the grid, each with the name of a band.

        Raises:
            ValueError: As in `Coverage.estimate`.
        """
        sums = self._build_region_sums()
        indices = [self._region_bands.find_index(region, band) for region, band in region_bands]
        if sums and None not in indices:
            quantities = MeanOfMeans(self.thresholds_m).quantities
            return [sums.estimate(quantities, index) for index in indices if index is not None]
        coverage = self.compute()
        return [coverage.estimate(region, band) for region, band in region_bands]
