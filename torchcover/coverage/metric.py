"""The coverage metric: clouds in, fixed-size sums, coverage out."""

import hashlib
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric

from torchcover.coverage.binning import mean_per_cell
from torchcover.coverage.grid import BevGrid, bin_of
from torchcover.coverage.result import Coverage, histogram_quantiles
from torchcover.neighbors import check_cloud, nearest

# Bins of the histogram behind the quantiles: 20 a decade from 1 cm to 100 m, and one beyond each end.
QUANTILE_EDGES_M = torch.cat([torch.tensor([0.0]), torch.logspace(-2, 2, 81), torch.tensor([math.inf])]).double()


class CoverageMetric(Metric):
    """Blind spot radius and detection over a grid, as a mean over steps of means over reference points.

        radius[h, y, x]    = E_t[ E_q in cell [ r(q) ] ]
        detection[h, y, x] = E_t[ E_q in cell [ 1(r(q) <= threshold) ] ]

    with r(q) from `torchcover.blind_spot_radius`; a step counts in a cell only if it had a reference point there
    (Uecker & Zöllner 2024). The state is a few sums for each cell, whatever the number of steps: two metrics over
    different steps merge exactly (`merge_state`), and ranks are added up when `compute` is called.

    The state is part of `state_dict()`; `metric.persistent(False)` takes it out.

    Args:
        grid: Cells and height bands.
        thresholds: Radii in metres up to which a point counts as detected, each of them >= 0 and at most
            `max_radius`.
        max_radius: Saturation of r in metres. An empty sensor cloud gives r = `max_radius`: with the default,
            infinity, such a step makes the radius of its cells infinite.
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
            positive; a quantile outside [0, 1].

    Example:
        >>> metric = CoverageMetric(BevGrid(x=(0.0, 2.0), y=(0.0, 1.0), cell=1.0, heights={"all": (-1.0, 1.0)}))
        >>> metric.update(sensor=torch.zeros(1, 3), reference=torch.tensor([[0.3, 0.0, 0.0], [0.5, 0.0, 0.0]]))
        >>> metric.compute().radius
        tensor([[[0.4000,    nan]]], dtype=torch.float64)
    """

    is_differentiable = False
    higher_is_better = None
    full_state_update = False

    frames: Tensor
    points: Tensor
    radius_sum: Tensor
    detection_sum: Tensor
    radius_max: Tensor
    pooled_sum: Tensor
    histogram: Tensor
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
        maximum: bool = False,
        pooled: bool = False,
        quantiles: Sequence[float] = (),
        backend: str = "auto",
        memory_mb: float = 256.0,
        **kwargs: Any,  # noqa: ANN401  (whatever torchmetrics takes)
    ) -> None:
        super().__init__(**kwargs)
        _check_parameters(thresholds, max_radius, quantiles)
        self.grid = grid
        self.thresholds = tuple(float(threshold) for threshold in thresholds)
        self.max_radius = float(max_radius)
        self.maximum = maximum
        self.pooled = pooled
        self.quantiles = tuple(float(quantile) for quantile in quantiles)
        self.backend = backend
        self.memory_mb = memory_mb
        self._add_states(grid.cells)

    def _add_states(self, cells: int) -> None:
        def add_sum(name: str, shape: tuple[int, ...], dtype: torch.dtype) -> None:
            self.add_state(name, torch.zeros(shape, dtype=dtype), dist_reduce_fx="sum", persistent=True)

        add_sum("frames", (cells,), torch.int64)
        add_sum("points", (cells,), torch.int64)
        add_sum("radius_sum", (cells,), torch.float64)
        add_sum("detection_sum", (len(self.thresholds), cells), torch.float64)
        if self.pooled:
            add_sum("pooled_sum", (cells,), torch.float64)
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
        meaning = [self.grid, self.thresholds, self.max_radius, self.maximum, self.pooled, bool(self.quantiles)]
        return torch.tensor(list(hashlib.sha256(repr(meaning).encode()).digest()))

    def update(self, sensor: Tensor | Sequence[Tensor], reference: Tensor | Sequence[Tensor]) -> None:
        """Add one step, or one step for each entry of two lists.

        Args:
            sensor: (N, 3) points of the rig in the vehicle frame in metres, or a list of them. N = 0: a blind step.
            reference: (M, 3) points of the reference sensor in the same frame, or a list of the same length. M = 0:
                the step says nothing.

        Raises:
            ValueError: Lists of different length, a shape other than (N, 3), NaN or infinite coordinates.
            TypeError: A cloud is not a floating-point tensor.
        """
        sensors, references = _as_list(sensor), _as_list(reference)
        if len(sensors) != len(references):
            raise ValueError(f"{len(sensors)} sensor clouds for {len(references)} reference clouds; one pair a step")
        for step, (sensor_cloud, reference_cloud) in enumerate(zip(sensors, references, strict=True)):
            check_cloud(sensor_cloud, f"sensor[{step}]")
            check_cloud(reference_cloud, f"reference[{step}]")
        for sensor_cloud, reference_cloud in zip(sensors, references, strict=True):
            self._add_step(sensor_cloud, reference_cloud)

    @torch.no_grad()  # torchmetrics enables gradients in `forward`; the sums would hold on to every step's graph
    def _add_step(self, sensor: Tensor, reference: Tensor) -> None:
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
        self._accumulate(cell[inside].to(self.frames.device), distance.to(self.frames.device))
        self.steps += 1
        self.empty_sensor_steps += len(sensor) == 0
        self.empty_reference_steps += len(reference) == 0
        self.outside_points += len(reference) - len(distance)
        self.saturated_points += (distance >= self.max_radius).sum().to(self.frames.device)

    def _accumulate(self, cell: Tensor, distance: Tensor) -> None:
        # Before saturation: a point with nothing within `max_radius` is not detected at a threshold of `max_radius`.
        detected = [distance <= threshold for threshold in self.thresholds]
        radius = distance.clamp(max=distance.new_tensor(self.max_radius))
        values = torch.stack([radius.double(), *(row.double() for row in detected)])
        step = mean_per_cell(cell, values, self.grid.cells)
        self.frames[step.cell] += 1
        self.points[step.cell] += step.points
        self.radius_sum[step.cell] += step.mean[0]
        self.detection_sum[:, step.cell] += step.mean[1:]
        if self.pooled:
            self.pooled_sum[step.cell] += step.mean[0] * step.points
        if self.maximum:
            self.radius_max.scatter_reduce_(0, cell, radius.double(), "amax")
        if self.quantiles:
            weight = 1.0 / torch.bincount(cell, minlength=self.grid.cells)[cell].double()
            bin_and_cell = bin_of(radius.double().clamp(max=1e300), QUANTILE_EDGES_M) * self.grid.cells + cell
            self.histogram.view(-1).index_add_(0, bin_and_cell, weight)

    def compute(self) -> Coverage:
        """The coverage so far. Cells that no reference point ever probed are NaN with count 0."""
        shape = self.grid.shape
        probed = self.frames > 0
        frames = self.frames.double().where(probed, math.nan)
        points = self.points.double().where(probed, math.nan)
        return Coverage(
            grid=self.grid,
            thresholds=self.thresholds,
            max_radius=self.max_radius,
            frames=self.frames.view(shape).clone(),
            points=self.points.view(shape).clone(),
            radius=(self.radius_sum / frames).view(shape),
            detection=(self.detection_sum / frames).view(-1, *shape),
            maximum=self.radius_max.where(probed, math.nan).view(shape) if self.maximum else None,
            pooled=(self.pooled_sum / points).view(shape) if self.pooled else None,
            quantile_levels=self.quantiles,
            quantiles=self._quantiles() if self.quantiles else None,
            counts={name: int(getattr(self, name)) for name in Coverage.COUNTS},
        )

    def merge_state(self, incoming_state: "dict[str, Any] | Metric") -> None:
        """Add the steps of another metric over the same grid, which is left as it was.

        Args:
            incoming_state: A `CoverageMetric` with the same parameters, or its `metric_state`.

        Raises:
            ValueError: The other metric differs in its grid, thresholds, `max_radius`, `maximum`, `pooled` or
                `quantiles`, or is no coverage metric.
        """
        if isinstance(incoming_state, CoverageMetric):
            for name in ("grid", "thresholds", "max_radius", "maximum", "pooled", "quantiles"):
                mine, other = getattr(self, name), getattr(incoming_state, name)
                if mine != other:
                    raise ValueError(f"cannot merge metrics with different {name}: {mine} and {other}")
        elif isinstance(incoming_state, dict):
            self._check_fingerprint(incoming_state.get("fingerprint"))
        super().merge_state(incoming_state)
        # torchmetrics would go on answering from the result it had cached.
        self._computed = None
        self._update_count = int(self.steps)

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


def _check_parameters(thresholds: Sequence[float], max_radius: float, quantiles: Sequence[float]) -> None:
    if not all(threshold >= 0 for threshold in thresholds):
        raise ValueError(f"thresholds: distances >= 0 in metres are needed; got {tuple(thresholds)}")
    if len(set(thresholds)) != len(thresholds):
        raise ValueError(f"thresholds: each may be given once; got {tuple(thresholds)}")
    if not max_radius > 0:
        raise ValueError(f"max_radius: a positive distance in metres is needed; got {max_radius}")
    if any(threshold > max_radius for threshold in thresholds):
        raise ValueError(
            f"thresholds: at most max_radius = {max_radius} m, where r saturates, is possible; got {tuple(thresholds)}"
        )
    if not all(0 <= quantile <= 1 for quantile in quantiles):
        raise ValueError(f"quantiles: numbers in [0, 1] are needed; got {tuple(quantiles)}")


def _as_list(clouds: Tensor | Sequence[Tensor]) -> list[Tensor]:
    return [clouds] if isinstance(clouds, Tensor) else list(clouds)
