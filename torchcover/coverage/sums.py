"""The sums of coverage: clouds in, sums over the cells that were touched, coverage out."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchcover.coverage.aggregations import Aggregation, AreaAverage, MeanOfMeans
from torchcover.coverage.blocks import BlockSums, ObservedCells
from torchcover.coverage.columns import CellSums, SumColumns
from torchcover.coverage.grid import BevGrid
from torchcover.coverage.measures import Average
from torchcover.coverage.quantity import MEASURED_WITHIN_M
from torchcover.coverage.redundancy import Redundancy, SensorFailures
from torchcover.coverage.region_sums import RegionSums, compute_aggregated_numbers
from torchcover.coverage.regions import Region, RegionBands, check_regions, get_paper_regions
from torchcover.coverage.result import Coverage
from torchcover.coverage.steps import (
    Clouds,
    FrameInput,
    FrameSums,
    SensorClouds,
    build_frame_inputs,
    check_parameters,
)
from torchcover.devices import ensure_float64, map_tensors
from torchcover.estimation import Estimate
from torchcover.metrics import BlockedSums, SparseSums, sum_rows
from torchcover.metrics.blocked_sums import FINE_BLOCKS_PER_BLOCK
from torchcover.neighbors import nearest


class CoverageSums(BlockedSums):
    """Blind spot radius and detection over a grid, as a mean over steps of means over reference points.

        radius[h, y, x]    = E_t[ E_q in cell [ r(q) ] ]
        detection[h, y, x] = E_t[ E_q in cell [ 1(r(q) <= threshold) ] ]

    with r(q) from `torchcover.blind_spot_radius`; a step counts in a cell only if it had a reference point there
    (Uecker & Zöllner 2024). The state is a few sums for each cell and region that a step has touched: two metrics over
    different steps merge exactly (`merge_state`), and ranks are added up when `compute` is called. Steps are added up
    in the order in which they come; in another one, or in parts, the last bits may differ, as of any sum of floats.

    With `blocks` the sums are kept in as many blocks of contiguous steps, and the result has standard errors: steps
    that follow each other are alike, blocks that are longer than the likeness lasts are independent.

    Args:
        grid: Cells and height bands; its `band_frame` decides whether `update` needs heights above the ground.
        thresholds_m: Radii in metres up to which a point counts as detected, each of them finite, >= 0 and at most
            `max_radius_m`.
        max_radius_m: Saturation of r in metres. An empty sensor cloud gives r = `max_radius_m`: with the default,
            infinity, such a step makes the radius of its cells infinite.
        blocks: 1 for no errors, or an even number from 8 on, half of which at least are in use at the end of a long
            run.
        aggregations: Others than the mean of means, from `torchcover.coverage`: `Maximum()`, `PooledMean()`,
            `Quantiles(levels)`, `FrameQuantiles(levels)`, or a class of one's own; at most one of each. Each gives maps,
            and numbers of `regions`.
        regions: What the result gives numbers for; the paper's `forward_regions()` that fit the grid if not given. By
            area, a reference point belongs to a region by its own place, so that cells decide about maps only.
        sensor_names: Names of the rig's sensors, for `Coverage.redundancy`: then `update` takes a cloud for each by its
            name, and what the rig is without each of them is known as well.
        needs_radii: Whether radii are asked for. Without, they are NaN, and the search ends at the largest threshold: the
            clouds may lack points that are farther from any reference point.
        has_area_weights: Whether there is to be an estimate by area too; then every step needs the square metres of its
            reference points, as `SurfaceReference` gives them.
        backend: Nearest-neighbour search, as in `torchcover.nearest`.
        memory_mb: As in `torchcover.nearest`.
        kwargs: For the next base, as `MergeableMetric` of torchmetrics is one.

    Raises:
        ValueError: A threshold that is negative, not finite, over `max_radius_m`, or given twice; a `max_radius_m` that is
            not positive; a number of blocks that is neither 1 nor even and 8 or more; two aggregations of one kind; a
            region beyond the grid, or without a cell centre.

    Example:
        >>> metric = CoverageSums(BevGrid(x=(0.0, 2.0), y=(0.0, 1.0), cell=1.0, heights={"all": (-1.0, 1.0)}))
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
            raise ValueError("radii: aggregations and sensors need them, and without there has to be a threshold")
        regions = get_paper_regions(grid) if regions is None else tuple(regions)
        check_regions(regions, grid)
        thresholds_m, max_radius_m = tuple(float(threshold) for threshold in thresholds_m), float(max_radius_m)
        meaning = {
            "grid": grid,
            "thresholds_m": thresholds_m,
            "max_radius_m": max_radius_m,
            "num_blocks": num_blocks,
            "aggregations": tuple(aggregations),
            "has_area_weights": has_area_weights,
            **({"sensor_names": tuple(sensor_names)} if sensor_names else {}),
            **({} if needs_radii else {"needs_radii": needs_radii}),
            **({"regions": regions} if has_area_weights or aggregations else {}),
        }
        super().__init__(num_blocks, meaning, **kwargs)
        self.grid, self.thresholds_m, self.max_radius_m = grid, thresholds_m, max_radius_m
        self.regions, self.sensor_names, self.has_area_weights = regions, tuple(sensor_names), has_area_weights
        self.needs_radii, self.backend, self.memory_mb = needs_radii, backend, memory_mb
        over_area = [AreaAverage(thresholds_m)] if has_area_weights else []
        self._of_grid: tuple[Aggregation, ...] = (MeanOfMeans(thresholds_m), *over_area, *aggregations)
        self._failures = SensorFailures(self.sensor_names, thresholds_m, has_area_weights) if sensor_names else None
        self.aggregations: tuple[Aggregation, ...] = (*self._of_grid, *([self._failures] if self._failures else []))
        self._aggregated, self._columns = tuple(aggregations), SumColumns(self.aggregations)
        self._places = RegionBands(regions if has_area_weights or aggregations else (), grid)
        shape: dict[str, Any] = {"num_columns": self._columns.num_columns, "num_maxima": self._columns.num_maxima}
        self.define_sparse_sums("cell_sums", grid.num_cells, **shape)
        self.define_sparse_sums("region_sums", self._places.num_region_bands, **shape, is_fine=True)
        for name in Coverage.COUNTS[1:]:  # the base counts the frames
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
        """Add one step, or one step for each entry of two lists.

        Args:
            sensor: (N, 3) points of the rig in the vehicle frame in metres, where they truly are if that is known, or a
                list of them. N = 0: a blind step. Of a metric with `sensors`: name of the sensor -> its points, or a
                list of such dicts.
            reference: (M, 3) points of the reference sensor in the same frame, or a list of the same length. M = 0:
                the step says nothing.
            weights: (M,) square metres that each reference point stands for (`frame.reference_weights`), or a list of
                the same length: what it weighs in the mean over its cell in its step, and in the estimate by area. Not
                given: all weigh the same.
            heights_m: (M,) height of each reference point above the local ground (`frame.reference_heights_m`), or a list
                of the same length, for a grid whose `band_frame` is "ground", and no other. NaN, where there is no
                ground at or below a point: it is in no band, and counted.
            block_index: Number of the step, 10^15 at most, or a list of them (`frame.block_index`); it decides
                about the block, so that steps of one number, as of an instant that is seen again, share one. Not
                given: counted on from the steps so far.
            errors_m: (N,) by how many metres each point of the rig was measured off its place, along its ray, those of
                several sensors one after the other, or a list of them. A point covers nothing at thresholds below that,
                and counts for radii up to `MEASURED_WITHIN_M`, 0.4. Not given: none is off.

        Raises:
            ValueError: Lists of different length, a shape other than (N, 3), NaN or infinite coordinates; weights,
                heights, places in time or errors as `torchcover.coverage.steps.build_frame_inputs` refuses them.
            TypeError: A cloud is not a floating-point tensor, a place in time not a whole number.
        """
        given = {"weights": weights, "heights_m": heights_m, "block_index": block_index, "errors_m": errors_m}
        for sums in self.compute_sums(sensor, reference, **given):
            self.add_sums(sums)

    def compute_sums(self, sensor: SensorClouds, reference: Clouds, **options: Any) -> list[FrameSums]:  # noqa: ANN401
        """What `update` adds for each step: the same in any process, where the metric has the same parameters.

        It takes and refuses what `update` does.
        """
        options = dict.fromkeys(("weights", "heights_m", "block_index", "errors_m")) | options
        sensor, reference, options = map_tensors((sensor, reference, options), ensure_float64)
        parameters: dict[str, Any] = {
            name: getattr(self, name) for name in ("grid", "thresholds_m", "has_area_weights")
        }
        parameters |= {"sensor_names": self.sensor_names, "first_block_index": int(self.num_frames)}
        return list(map(self._sums_of, build_frame_inputs(sensor, reference, **options, **parameters)))

    @torch.no_grad()  # the sums would hold on to every step's graph
    def _sums_of(self, step: FrameInput) -> FrameSums:
        _, _, reference, weights, height, block_index = step
        inside, of, cell = self.grid.assign_cells(reference, height)
        # Only the reference may be cropped: the nearest sensor point may lie outside the grid.
        of_sensors = self._distances(reference[inside], step)
        distance = of_sensors[0].amin(dim=0)
        values, points = self._values([one[:, of] for one in of_sensors]), reference[inside[of]]
        weights = None if weights is None else weights.to(reference.device)[inside[of]]
        place, point = self._places.assign_points(points, cell)
        counts = {
            "num_frames": 1,
            "empty_sensor_frames": int(step.is_blind),
            "empty_reference_frames": int(len(reference) == 0),
            "saturated_points": int((distance >= self.max_radius_m).sum()) if self.needs_radii else 0,
            "inside_points": len(distance),
            "outside_points": len(reference) - len(distance),
            "no_ground_points": 0 if height is None else int(height.isnan().sum()),
        }
        return FrameSums(
            block_index,
            counts,
            self._columns.compute_columns(cell, values, weights),
            self._columns.compute_columns(place, values[:, point], None if weights is None else weights[point]),
        )

    def add_sums(self, sums: FrameSums) -> None:
        """Add a step that `sums_of` a metric of the same parameters has measured."""
        block, fine = self._assign_block(sums.block_index), self._get_fine_block(sums.block_index)
        self.add_to_sparse_sums("cell_sums", block, sums.cell_columns)
        self.add_to_sparse_sums("region_sums", fine, sums.region_columns)
        for name, count in sums.counts.items():
            getattr(self, name).add_(count)
        self._handle_added_frames()

    def _distances(self, reference: Tensor, step: FrameInput) -> list[Tensor]:
        """(S, M) metres to the nearest point of each sensor that counts for the radius, then those for each threshold.

        Each point is searched in once, beside those that the same thresholds take: most are off by less than any.
        """
        found: dict[float, Tensor] = {}
        beyond_m, distance = -math.inf, None
        for within_m in sorted({MEASURED_WITHIN_M, *self.thresholds_m}):
            for_radii = self.needs_radii and within_m <= MEASURED_WITHIN_M
            reach_m = self.max_radius_m if for_radii else max(self.thresholds_m)
            some = step.select_points(beyond_m, within_m)
            if distance is None or any(map(len, some)):
                how: dict[str, Any] = {"backend": self.backend, "memory_mb": self.memory_mb, "max_distance": reach_m}
                each = torch.stack([nearest(reference, one.to(reference.device), **how).distance for one in some])
                distance = each if distance is None else torch.minimum(distance, each)
            found[within_m], beyond_m = distance, within_m
        return [found[within_m] for within_m in (MEASURED_WITHIN_M, *self.thresholds_m)]

    def _values(self, of_sensors: Sequence[Tensor]) -> Tensor:
        """(V, N) float64 values of points, from what `_distances` found."""
        distance, *of_thresholds = (one.amin(dim=0) for one in of_sensors)
        # Before saturation: a point with nothing within `max_radius` is not detected at a threshold of `max_radius`.
        pairs = zip(of_thresholds, self.thresholds_m, strict=True)
        detected = [(near <= threshold).double() for near, threshold in pairs]
        radius = distance.clamp(max=distance.new_tensor(self.max_radius_m)).double()
        radius = radius if self.needs_radii else torch.full_like(radius, math.nan)
        values = torch.stack([radius, *detected])
        if self._failures:
            values = torch.cat([values, self._failures.compute_values(of_sensors, self.max_radius_m)])
        return values

    def compute(self) -> Coverage:
        """The coverage so far. Cells that no reference point ever probed are NaN with count 0."""
        cells, table = self.grid.num_cells, self.cell_sums
        whole = sum_rows(torch.cat([table[:, :1] % cells, table[:, 1:]], dim=1), self._columns.num_maxima)
        at, sums = whole[:, 0].long(), self._columns.split_columns(whole[:, 1:].T)

        known = ObservedCells(self.grid.shape, at, sums.observed_frames.long(), sums.point_counts.long())
        failures = sums.compute_layers(self._failures, self.max_radius_m) if self._failures else []
        in_blocks = self._columns.split_columns(table[:, 1:].T)
        listed = self.block_frame_counts.clone(), (self.num_blocks, *self.grid.shape), table[:, 0].long()
        mean, area = (in_blocks.sums_by_aggregation.get(kind.name, {}) for kind in (MeanOfMeans, AreaAverage))
        return Coverage(
            grid=self.grid,
            thresholds_m=self.thresholds_m,
            max_radius_m=self.max_radius_m,
            observed_cells=known,
            layers=[layer for one in self._of_grid for layer in sums.compute_layers(one, self.max_radius_m)],
            block_sums=BlockSums(*listed, in_blocks.observed_frames.long(), mean["sums"])
            if self.num_blocks > 1
            else None,
            area_sums=BlockSums(*listed, area["m2"], area["sums"]) if area else None,
            counts={name: int(getattr(self, name)) for name in Coverage.COUNTS},
            regions=self.regions,
            region_sums=self._by_area(),
            aggregated_numbers=compute_aggregated_numbers(
                self._in_places(fine=False), self._aggregated, self.max_radius_m
            )
            if self._aggregated and self._places.num_region_bands
            else None,
            redundancy=Redundancy(self.sensor_names, known, {one.quantity.key: one for one in failures})
            if failures
            else None,
        )

    def _in_places(self, *, fine: bool) -> CellSums:
        """The sums of (..., B, P) places in blocks, the fine ones or the others."""
        together = 1 if fine else min(int(self.frames_per_block), FINE_BLOCKS_PER_BLOCK)  # so many fine blocks are one
        blocks, count = self.num_fine_blocks if fine else self.num_blocks, self._places.num_region_bands
        key, columns = self.region_sums.split_with_sizes([1, self._columns.num_columns], dim=1)
        key = key.div(together * count, rounding_mode="floor") * count + key % count
        rows = sum_rows(torch.cat([key, columns], dim=1), self._columns.num_maxima)
        sums = columns.new_zeros(self._columns.num_columns, blocks * count)
        sums[self._columns.num_columns - self._columns.num_maxima :] = -math.inf
        sums[:, rows[:, 0].long()] = rows[:, 1:].T
        return self._columns.split_columns(sums.view(-1, blocks, count))

    def _by_area(self) -> RegionSums | None:
        if not (self.has_area_weights and self._places.num_region_bands):
            return None
        sums = self._in_places(fine=True).sums_by_aggregation
        own = [sums[kind.name]["sums"] for kind in (AreaAverage, SensorFailures) if kind.name in sums]
        return RegionSums(
            self.fine_block_frame_counts.clone(), sums[AreaAverage.name]["m2"], torch.cat(own).movedim(0, 1)
        )

    def estimate_regions(self, region_bands: Sequence[tuple[Region, str]], average: Average) -> list[Estimate]:
        """The numbers of regions in bands so far: those of `compute().estimate`, but no maps are made for them.

        Args:
            region_bands: Regions within the grid, each with the name of a band.
            average: What the numbers are means over, as there.

        Raises:
            ValueError: As there.
        """
        sums, numbers = self._by_area(), [self._places.find_index(*place) for place in region_bands]
        if average == "area" and sums and None not in numbers:
            quantities = MeanOfMeans(self.thresholds_m).quantities
            return [sums.estimate(quantities, number) for number in numbers if number is not None]
        coverage = self.compute()
        return [coverage.estimate(region, height, average) for region, height in region_bands]
