"""The coverage metric: clouds in, fixed-size sums, coverage out."""

import hashlib
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities.distributed import gather_all_tensors

from torchcover.coverage.binning import mean_per_cell
from torchcover.coverage.blocks import Blocks, check_blocks, pair_up
from torchcover.coverage.grid import BevGrid
from torchcover.coverage.quantiles import QUANTILE_EDGES_M, bin_of, histogram_quantiles
from torchcover.coverage.result import Coverage
from torchcover.coverage.steps import Clouds, Step, as_list, check_parameters, checked_steps
from torchcover.neighbors import nearest


class CoverageMetric(Metric):
    """Blind spot radius and detection over a grid, as a mean over steps of means over reference points.

        radius[h, y, x]    = E_t[ E_q in cell [ r(q) ] ]
        detection[h, y, x] = E_t[ E_q in cell [ 1(r(q) <= threshold) ] ]

    with r(q) from `torchcover.blind_spot_radius`; a step counts in a cell only if it had a reference point there
    (Uecker & Zöllner 2024). The state is a few sums for each cell, whatever the number of steps: two metrics over
    different steps merge exactly (`merge_state`), and ranks are added up when `compute` is called.

    With `blocks` the sums are kept in as many blocks of contiguous steps, and the result has standard errors. Steps
    that follow each other are alike, so that their number says little about the error; blocks that are longer than
    the likeness lasts are independent. Blocks start with one step each; whenever a step comes that is past the last
    one, neighbours are added up in pairs and blocks become twice as long.

    The state is part of `state_dict()`; `metric.persistent(False)` takes it out.

    Args:
        grid: Cells and height bands.
        thresholds: Radii in metres up to which a point counts as detected, each of them >= 0 and at most
            `max_radius`.
        max_radius: Saturation of r in metres. An empty sensor cloud gives r = `max_radius`: with the default,
            infinity, such a step makes the radius of its cells infinite.
        blocks: 1 for no errors, or an even number from 8 on: at least half as many blocks are in use at the end of a
            long run. The state grows with it: 24 bytes a cell and block.
        maximum: Also keep the largest r of each cell.
        pooled: Also keep the pooled mean, in which every point weighs the same instead of every step.
        quantiles: Also estimate these quantiles of r in each cell, steps weighing the same, from a histogram with 20
            bins a decade from 1 cm to 100 m. The error is at most a bin: 12 % of the value, or 1 cm; a quantile over
            100 m is given as `max_radius`.
        backend: Nearest-neighbour search, as in `torchcover.nearest`.
        memory_mb: As in `torchcover.nearest`.
        kwargs: For `torchmetrics.Metric` (`sync_on_compute`, `dist_sync_fn`, ...).

    Raises:
        ValueError: A threshold that is negative, NaN, over `max_radius`, or given twice; a `max_radius` that is not
            positive; a quantile outside [0, 1]; a number of blocks that is neither 1 nor even and 8 or more.

    Example:
        >>> metric = CoverageMetric(BevGrid(x=(0.0, 2.0), y=(0.0, 1.0), cell=1.0, heights={"all": (-1.0, 1.0)}))
        >>> metric.update(sensor=torch.zeros(1, 3), reference=torch.tensor([[0.3, 0.0, 0.0], [0.5, 0.0, 0.0]]))
        >>> metric.compute().radius
        tensor([[[0.4000,    nan]]], dtype=torch.float64)
    """

    is_differentiable = False
    higher_is_better = None
    full_state_update = False

    probed_steps: Tensor
    points: Tensor
    radius_sum: Tensor
    detection_sum: Tensor
    radius_max: Tensor
    pooled_sum: Tensor
    weight_sum: Tensor
    histogram: Tensor
    block_length: Tensor
    block_steps: Tensor
    steps: Tensor
    empty_sensor_steps: Tensor
    empty_reference_steps: Tensor
    saturated_points: Tensor
    outside_points: Tensor
    fingerprint: Tensor

    def __init__(
        self,
        grid: BevGrid,
        thresholds: Sequence[float] = (0.4,),
        *,
        max_radius: float = math.inf,
        blocks: int = 1,
        maximum: bool = False,
        pooled: bool = False,
        quantiles: Sequence[float] = (),
        backend: str = "auto",
        memory_mb: float = 256.0,
        **kwargs: Any,  # noqa: ANN401  (whatever torchmetrics takes)
    ) -> None:
        super().__init__(**kwargs)
        check_parameters(thresholds, max_radius, quantiles)
        check_blocks(blocks)
        self.grid = grid
        self.thresholds = tuple(float(threshold) for threshold in thresholds)
        self.max_radius = float(max_radius)
        self.blocks = blocks
        self.maximum = maximum
        self.pooled = pooled
        self.quantiles = tuple(float(quantile) for quantile in quantiles)
        self.backend = backend
        self.memory_mb = memory_mb
        self._add_states(grid.cells)

    def _add_states(self, cells: int) -> None:
        def add_sum(name: str, shape: tuple[int, ...], dtype: torch.dtype) -> None:
            self.add_state(name, torch.zeros(shape, dtype=dtype), dist_reduce_fx="sum", persistent=True)

        add_sum("probed_steps", (self.blocks, cells), torch.int64)
        add_sum("points", (cells,), torch.int64)
        add_sum("radius_sum", (self.blocks, cells), torch.float64)
        add_sum("detection_sum", (self.blocks, len(self.thresholds), cells), torch.float64)
        add_sum("block_steps", (self.blocks,), torch.int64)
        self.add_state("block_length", torch.tensor(1), dist_reduce_fx="max", persistent=True)
        if self.pooled:
            add_sum("pooled_sum", (cells,), torch.float64)
            add_sum("weight_sum", (cells,), torch.float64)
        if self.quantiles:
            add_sum("histogram", (len(QUANTILE_EDGES_M) - 1, cells), torch.float64)
        if self.maximum:
            none_yet = torch.full((cells,), -math.inf, dtype=torch.float64)
            self.add_state("radius_max", none_yet, dist_reduce_fx="max", persistent=True)
        for name in Coverage.COUNTS:
            add_sum(name, (), torch.int64)
        # As a state, it keeps a MetricCollection from sharing the sums of metrics that happen to agree after the first
        # step, and sums made for something else from being merged or loaded.
        self.add_state("fingerprint", self._fingerprint(), dist_reduce_fx="max", persistent=True)

    def _fingerprint(self) -> Tensor:
        """(32,) int64 numbers in [0, 256), equal for two metrics exactly if their sums mean the same."""
        options = [self.maximum, self.pooled, bool(self.quantiles)]
        meaning = [self.grid, self.thresholds, self.max_radius, self.blocks, *options]
        return torch.tensor(list(hashlib.sha256(repr(meaning).encode()).digest()))

    def update(
        self,
        sensor: Clouds,
        reference: Clouds,
        *,
        weights: Clouds | None = None,
        index: int | Sequence[int] | None = None,
    ) -> None:
        """Add one step, or one step for each entry of two lists.

        Args:
            sensor: (N, 3) points of the rig in the vehicle frame in metres, or a list of them. N = 0: a blind step.
            reference: (M, 3) points of the reference sensor in the same frame, or a list of the same length. M = 0:
                the step says nothing.
            weights: (M,) weight of each reference point in the mean over its cell in its step, or a list of the same
                length. For reference sensors whose density within a cell is not the one that is asked for: the
                weights are the second divided by the first. Not given: every point weighs the same.
            index: Number of the step in time, or a list of the same length; it decides about the block. Not given:
                counted on from the steps so far.

        Raises:
            ValueError: Lists of different length, a shape other than (N, 3), NaN or infinite coordinates, weights
                that are not positive and finite, a negative index.
            TypeError: A cloud is not a floating-point tensor.
        """
        for step in checked_steps(sensor, reference, weights, index, first=int(self.steps)):
            self._add_step(step)

    def forward(
        self,
        sensor: Clouds,
        reference: Clouds,
        *,
        weights: Clouds | None = None,
        index: int | Sequence[int] | None = None,
    ) -> Coverage:
        """Add steps as `update` does, and return the coverage of these steps alone."""
        if index is None:  # torchmetrics adds the steps to an empty state first: counting would start at 0
            index = [int(self.steps) + step for step in range(len(as_list(sensor)))]
        coverage: Coverage = super().forward(sensor, reference, weights=weights, index=index)
        return coverage

    @torch.no_grad()  # torchmetrics enables gradients in `forward`; the sums would hold on to every step's graph
    def _add_step(self, step: Step) -> None:
        sensor, reference, weights, index = step
        cell = self.grid.cell_of(reference)
        inside = cell >= 0
        # Only the reference may be cropped: the nearest sensor point may lie outside the grid.
        distance = nearest(
            reference[inside],
            sensor.to(reference.device),
            max_distance=self.max_radius,
            backend=self.backend,
            memory_mb=self.memory_mb,
        ).distance
        device = self.probed_steps.device
        weights = None if weights is None else weights.to(reference.device)[inside].to(device)
        block = self._block_of(index)
        self._accumulate(block, cell[inside].to(device), distance.to(device), weights)
        self.block_steps[block] += 1
        self.steps += 1
        self.empty_sensor_steps += len(sensor) == 0
        self.empty_reference_steps += len(reference) == 0
        self.outside_points += len(reference) - len(distance)
        self.saturated_points += (distance >= self.max_radius).sum().to(device)

    def _block_of(self, index: int) -> int:
        """The block of a step; makes room for it."""
        if self.blocks == 1:
            return 0
        while index >= self.blocks * int(self.block_length):
            pair_up(self.metric_state)
        return index // int(self.block_length)

    def _accumulate(self, block: int, cell: Tensor, distance: Tensor, weights: Tensor | None) -> None:
        # Before saturation: a point with nothing within `max_radius` is not detected at a threshold of `max_radius`.
        detected = [distance <= threshold for threshold in self.thresholds]
        radius = distance.clamp(max=distance.new_tensor(self.max_radius))
        values = torch.stack([radius.double(), *(row.double() for row in detected)])
        step = mean_per_cell(cell, values, self.grid.cells, weights)
        self.probed_steps[block, step.cell] += 1
        self.points[step.cell] += step.points
        self.radius_sum[block, step.cell] += step.mean[0]
        self.detection_sum[block][:, step.cell] += step.mean[1:]
        if self.pooled:
            self.pooled_sum[step.cell] += step.mean[0] * step.weight
            self.weight_sum[step.cell] += step.weight
        if self.maximum:
            self.radius_max.scatter_reduce_(0, cell, radius.double(), "amax")
        if self.quantiles:
            share = torch.ones_like(radius, dtype=torch.float64) if weights is None else weights.double()
            share = share / torch.bincount(cell, weights=share, minlength=self.grid.cells)[cell]
            bin_and_cell = bin_of(radius.double().clamp(max=1e300), QUANTILE_EDGES_M) * self.grid.cells + cell
            self.histogram.view(-1).index_add_(0, bin_and_cell, share)

    def compute(self) -> Coverage:
        """The coverage so far. Cells that no reference point ever probed are NaN with count 0."""
        shape = self.grid.shape
        probed_steps = self.probed_steps.sum(dim=0)
        known = probed_steps > 0
        steps = probed_steps.double().where(known, math.nan)
        return Coverage(
            grid=self.grid,
            thresholds=self.thresholds,
            max_radius=self.max_radius,
            probed_steps=probed_steps.view(shape),
            points=self.points.view(shape).clone(),
            radius=(self.radius_sum.sum(dim=0) / steps).view(shape),
            detection=(self.detection_sum.sum(dim=0) / steps).view(-1, *shape),
            blocks=self._blocks() if self.blocks > 1 else None,
            maximum=self.radius_max.where(known, math.nan).view(shape) if self.maximum else None,
            pooled=(self.pooled_sum / self.weight_sum.where(known, math.nan)).view(shape) if self.pooled else None,
            quantile_levels=self.quantiles,
            quantiles=self._quantiles() if self.quantiles else None,
            counts={name: int(getattr(self, name)) for name in Coverage.COUNTS},
        )

    def _blocks(self) -> Blocks:
        shape = self.grid.shape
        return Blocks(
            steps=self.block_steps.clone(),
            probed_steps=self.probed_steps.view(-1, *shape).clone(),
            radius_sum=self.radius_sum.view(-1, *shape).clone(),
            detection_sum=self.detection_sum.view(self.blocks, -1, *shape).clone(),
        )

    def merge_state(self, incoming_state: "dict[str, Any] | Metric") -> None:
        """Add the steps of another metric over the same grid, which is left as it was.

        Args:
            incoming_state: A `CoverageMetric` with the same parameters, or its `metric_state`.

        Raises:
            ValueError: The other metric differs in its grid, thresholds, `max_radius`, `blocks`, `maximum`, `pooled`
                or `quantiles`, or is no coverage metric.
        """
        if isinstance(incoming_state, CoverageMetric):
            for name in ("grid", "thresholds", "max_radius", "blocks", "maximum", "pooled", "quantiles"):
                mine, other = getattr(self, name), getattr(incoming_state, name)
                if mine != other:
                    raise ValueError(f"cannot merge metrics with different {name}: {mine} and {other}")
        elif isinstance(incoming_state, dict):
            self._check_fingerprint(incoming_state.get("fingerprint"))
        super().merge_state(incoming_state)
        # torchmetrics would go on answering from the result it had cached.
        self._computed = None
        self._update_count = int(self.steps)

    def _reduce_states(self, incoming_state: dict[str, Any]) -> None:
        # Blocks of the same length only can be added up.
        incoming = {name: value.clone() for name, value in incoming_state.items()}
        longest = max(int(self.block_length), int(incoming["block_length"]))
        while int(self.block_length) < longest:
            pair_up(self.metric_state)
        while int(incoming["block_length"]) < longest:
            pair_up(incoming)
        super()._reduce_states(incoming)

    def _sync_dist(self, dist_sync_fn: Callable[..., Any] = gather_all_tensors, process_group: Any = None) -> None:  # noqa: ANN401
        lengths = dist_sync_fn(self.block_length, group=process_group or self.process_group)
        while int(self.block_length) < max(map(int, lengths)):
            pair_up(self.metric_state)
        super()._sync_dist(dist_sync_fn, process_group)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:  # noqa: ANN401
        # torchmetrics keeps the very tensors it is given, of any shape, and `update` adds into them in place.
        for name in self._defaults:
            if (loaded := state_dict.get(prefix + name)) is not None:
                expected = getattr(self, name).shape
                if loaded.shape != expected:
                    raise ValueError(
                        f"state {name!r} has shape {tuple(loaded.shape)}; this metric's grid and thresholds need "
                        f"{tuple(expected)}"
                    )
                mine = getattr(self, name)
                state_dict[prefix + name] = loaded.to(device=mine.device, dtype=mine.dtype, copy=True)
        if prefix + "fingerprint" in state_dict:
            self._check_fingerprint(state_dict[prefix + "fingerprint"])
        super()._load_from_state_dict(state_dict, prefix, *args)
        self._computed = None
        self._update_count = int(self.steps)

    def _check_fingerprint(self, other: Tensor | None) -> None:
        if other is None or not torch.equal(other.to(self.fingerprint), self.fingerprint):
            raise ValueError("the state was made with another grid, thresholds, max_radius or options than this metric")

    def _apply(self, fn: Callable[[Tensor], Tensor], *args: Any, **kwargs: Any) -> "CoverageMetric":  # noqa: ANN401
        """Move the state to another device, but leave its type: `.to(torch.float16)` may not round the sums."""

        def moved(state: Tensor) -> Tensor:
            converted = fn(state)
            return converted if converted.dtype == state.dtype else state.to(converted.device)

        super()._apply(moved, *args, **kwargs)
        return self

    def _quantiles(self) -> Tensor:
        values = histogram_quantiles(self.histogram, QUANTILE_EDGES_M.to(self.histogram.device), self.quantiles)
        return values.clamp(max=self.max_radius).view(-1, *self.grid.shape)
