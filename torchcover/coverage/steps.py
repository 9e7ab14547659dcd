"""What the metric takes, checked once at the door."""

import math
import operator
from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor

from torchcover.coverage.aggregations import Aggregation, AreaAverage, MeanOfMeans
from torchcover.coverage.grid import BevGrid
from torchcover.coverage.quantity import MEASURED_WITHIN_M, make_detection_quantity
from torchcover.coverage.redundancy import SensorFailures
from torchcover.neighbors import check_cloud, check_tensor, check_weights

# The aggregations that a metric has by itself.
BUILT_IN = frozenset({MeanOfMeans.name, AreaAverage.name, SensorFailures.name})

# Steps are numbered in int64, and blocks double until one holds the last.
MAX_NUMBER = 10**15

# What rounding may move a point by, as a share of a cell or of the smallest threshold.
MOST_OF_A_CELL = 0.05

# One step, or a list with an entry for each.
Clouds: TypeAlias = Tensor | Sequence[Tensor]
# Of a rig whose sensors are told apart: by their names.
SensorClouds: TypeAlias = Clouds | Mapping[str, Tensor] | Sequence[Mapping[str, Tensor]]


class FrameInput(NamedTuple):
    """One step: clouds in the vehicle frame, weights and heights of the reference points, and its number in time.

    `sensor_clouds` has those of the rig by the names of the sensors; one without a name if they are not told apart. `errors_m`
    has by how many metres each of these points was measured off; None if none was.
    """

    sensor_clouds: Mapping[str, Tensor]
    errors_m: Mapping[str, Tensor] | None
    reference: Tensor
    weights: Tensor | None
    heights_m: Tensor | None
    block_index: int

    def select_points(self, min_error_m: float, max_error_m: float) -> list[Tensor]:
        """The points of each sensor that were measured farther off than the one, and no farther than the other."""
        if self.errors_m is None:
            return [cloud if min_error_m < 0 else cloud[:0] for cloud in self.sensor_clouds.values()]
        each = [(cloud, self.errors_m[name].to(cloud.device)) for name, cloud in self.sensor_clouds.items()]
        return [cloud[(error > min_error_m) & (error <= max_error_m)] for cloud, error in each]

    @property
    def is_blind(self) -> bool:
        """Whether the rig has no point that counts for the radius."""
        if self.errors_m is None:
            return not any(map(len, self.sensor_clouds.values()))
        return not any(bool((error <= MEASURED_WITHIN_M).any()) for error in self.errors_m.values())


class FrameSums(NamedTuple):
    """What one step adds to the sums of a `CoverageMetric`; it is small, and travels between processes.

    `cell_columns` (1 + C, K) float64 are those of the grid that it touches, and what it adds to their columns; `region_columns` the
    same of regions in bands. `block_index` decides about its block, `counts` says how much each count grows.
    """

    block_index: int
    counts: Mapping[str, int]
    cell_columns: Tensor
    region_columns: Tensor


def check_parameters(thresholds_m: Sequence[float], max_radius_m: float, aggregations: Sequence[Aggregation]) -> None:
    """Refuse parameters of a metric that make no sense."""
    if not isinstance(thresholds_m, Sequence) or not all(isinstance(threshold, Real) for threshold in thresholds_m):
        raise TypeError(f"thresholds: a sequence of metres, as in (0.4,), is needed; got {thresholds_m!r}")
    # Within an infinite distance lies whatever a blind rig has not seen.
    if not all(0 <= threshold < math.inf for threshold in thresholds_m):
        raise ValueError(f"thresholds: finite distances >= 0 in metres are needed; got {tuple(thresholds_m)}")
    if len({make_detection_quantity(threshold).key for threshold in thresholds_m}) != len(thresholds_m):
        raise ValueError(
            f"thresholds: each may be given once, to the six digits that name it; got {tuple(thresholds_m)}"
        )
    if not max_radius_m > 0:
        raise ValueError(f"max_radius: a positive distance in metres is needed; got {max_radius_m}")
    if any(threshold > max_radius_m for threshold in thresholds_m):
        raise ValueError(
            f"thresholds: at most max_radius = {max_radius_m} m, where r saturates, is possible; got {tuple(thresholds_m)}"
        )
    _check_aggregations(aggregations)


def _check_aggregations(aggregations: Sequence[Aggregation]) -> None:
    if not isinstance(aggregations, Sequence) or not all(isinstance(each, Aggregation) for each in aggregations):
        raise TypeError(f"aggregations: a sequence of objects such as Maximum() is needed; got {aggregations!r}")
    kinds = [aggregation.name for aggregation in aggregations]
    if len(set(kinds)) != len(kinds) or not BUILT_IN.isdisjoint(kinds):
        raise ValueError(
            "aggregations: one of each kind is possible, with several levels in it, and none of those that are built "
            f"in; got {', '.join(kinds)}"
        )


def build_frame_inputs(
    sensor: SensorClouds,
    reference: Clouds,
    weights: Clouds | None,
    heights_m: Clouds | None,
    block_index: int | Sequence[int] | None,
    errors_m: Clouds | None,
    *,
    grid: BevGrid,
    thresholds_m: Sequence[float],
    has_area_weights: bool,
    sensor_names: Sequence[str] = (),
    first_block_index: int,
) -> list[FrameInput]:
    """The steps of an update, in order; the arguments and errors are those of `CoverageMetric` and its `update`."""
    if has_area_weights and weights is None:
        raise ValueError(
            "weights: the square metres of each reference point are needed, as a SurfaceReference gives them; got "
            "none (without square_metres=True, points may do without)"
        )
    rigs = [sensor] if isinstance(sensor, Mapping) else to_list(sensor, "sensor")
    sensors = [_by_name(rig, sensor_names) for rig in rigs]
    references = to_list(reference, "reference")
    count = len(references)
    every_weights: Sequence[Tensor | None] = [None] * count if weights is None else to_list(weights, "weights")
    every_height: Sequence[Tensor | None] = [None] * count if heights_m is None else to_list(heights_m, "height")
    numbers = (
        list(range(first_block_index, first_block_index + count)) if block_index is None else _numbers(block_index)
    )
    if len(sensors) != count:
        raise ValueError(f"{len(sensors)} sensor clouds for {count} reference clouds; one pair a step")
    errors: Sequence[Tensor | None] = [None] * count if errors_m is None else to_list(errors_m, "error")
    if {len(every_weights), len(every_height), len(numbers), len(errors)} != {count}:
        raise ValueError(
            f"{len(every_weights)} weights, {len(every_height)} heights, {len(numbers)} places in time and "
            f"{len(errors)} errors for {count} reference clouds; one a step each"
        )
    each = zip(sensors, errors, references, every_weights, every_height, numbers, strict=True)
    steps = []
    for at, (clouds, off, *parts) in enumerate(each):
        for name, cloud in clouds.items():
            check_cloud(cloud, f"sensor[{at}]" + f"[{name!r}]" * bool(name))
            _check_resolution(cloud, grid, thresholds_m, f"sensor[{at}]" + f"[{name!r}]" * bool(name))
        step = FrameInput(clouds, None if off is None else _by_sensor(off, rigs[at], clouds, f"error[{at}]"), *parts)
        steps.append(step)
        check_cloud(step.reference, f"reference[{at}]")
        _check_resolution(step.reference, grid, thresholds_m, f"reference[{at}]")
        check_weights(step.weights, len(step.reference), f"weights[{at}]")
        _check_height(step.heights_m, step.reference, grid, f"height[{at}]")
        if not 0 <= step.block_index <= MAX_NUMBER:
            raise ValueError(f"block_index[{at}]: a number from 0 to {MAX_NUMBER:,} is needed; got {step.block_index}")
    return steps


def _check_resolution(cloud: Tensor, grid: BevGrid, thresholds: Sequence[float], name: str) -> None:
    """Refuse coordinates of a type whose numbers are too far apart at the end of the grid."""
    farthest_m = max(abs(bound) for bounds in (grid.x_m, grid.y_m, *grid.heights.values()) for bound in bounds)
    apart_m = farthest_m * torch.finfo(cloud.dtype).eps
    finest_m = min([grid.cell_m, *(threshold for threshold in thresholds if threshold > 0)])
    if apart_m > MOST_OF_A_CELL * finest_m:
        raise ValueError(
            f"{name}: {str(cloud.dtype).removeprefix('torch.')} coordinates are {apart_m:.2g} m apart at "
            f"{farthest_m:,.0f} m, where the grid ends, and its cells, or a threshold, are {finest_m:g} m; subtract a "
            "place near the vehicle from clouds and grid, or give a wider type (a precision of Lightning such as "
            "bf16-true casts tensors of a batch, but no FrameBatch)"
        )


def _by_sensor(
    error: Tensor, rig: Tensor | Mapping[str, Tensor], clouds: Mapping[str, Tensor], name: str
) -> Mapping[str, Tensor]:
    """How far off the points of each sensor are, whatever the sign: in the order in which these were given."""
    check_tensor(error, name)
    names = list(rig) if isinstance(rig, Mapping) else list(clouds)
    sizes = [len(clouds[sensor]) for sensor in names]
    if error.shape != (sum(sizes),) or bool(error.isnan().any()):
        raise ValueError(
            f"{name}: metres of each of {sum(sizes)} points of the rig are needed; got {tuple(error.shape)} with "
            f"{int(error.isnan().sum())} NaN"
        )
    return dict(zip(names, torch.split(error.abs(), sizes), strict=True))


def to_list(clouds: Any, name: str) -> list[Any]:  # noqa: ANN401
    """A list with an entry for each step."""
    if isinstance(clouds, Tensor):
        return [clouds]
    if not isinstance(clouds, Sequence):
        check_tensor(clouds, f"{name} (one, or a list with one for each step)")
    return list(clouds)


def _by_name(rig: Any, names: Sequence[str]) -> Mapping[str, Tensor]:  # noqa: ANN401  (whatever the caller gave)
    if not names:
        if isinstance(rig, Mapping):
            raise TypeError(
                "sensor: one cloud a step is needed; got clouds by name, for which the metric needs sensors="
            )
        return {"": rig}
    if not isinstance(rig, Mapping) or set(rig) != set(names):
        arrived = ", ".join(rig) if isinstance(rig, Mapping) else type(rig).__name__
        raise ValueError(f"sensor: the clouds of {', '.join(names)}, by these names, are needed; got {arrived}")
    return {name: rig[name] for name in names}


def _numbers(block_index: Any) -> list[int]:  # noqa: ANN401  (whatever the caller gave)
    each = block_index if isinstance(block_index, Sequence) else [block_index]
    try:
        return [operator.index(number) for number in each]
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"block_index: a whole number, or a list with one for each step, is needed; got {block_index!r}"
        ) from error


def _check_height(height: Tensor | None, points: Tensor, grid: BevGrid, name: str) -> None:
    if height is not None:
        check_tensor(height, name)
    grid.check_heights(points, height, name)
    if height is not None and bool(height.isinf().any()):
        raise ValueError(f"{name}: metres are needed, NaN where there is no ground; got infinite ones")
