"""Input of the coverage metric: checks and normalization of the arguments of `update`."""

import math
import operator
from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor

from torchcover.coverage.aggregations import Aggregation, AreaAverage, MeanOfMeans
from torchcover.coverage.grid import BevGrid
from torchcover.coverage.quantities import MEASURED_WITHIN_M, make_detection_quantity
from torchcover.coverage.redundancy import SensorFailures
from torchcover.neighbors import check_cloud, check_tensor, check_weights

# Names of the aggregations that a metric has without being asked for them.
BUILT_IN = frozenset({MeanOfMeans.name, AreaAverage.name, SensorFailures.name})

# One frame, or a list with one entry per frame.
Clouds: TypeAlias = Tensor | Sequence[Tensor]
# Clouds of a rig, for metrics with `sensor_names` by sensor name.
SensorClouds: TypeAlias = Clouds | Mapping[str, Tensor] | Sequence[Mapping[str, Tensor]]


class FrameInput(NamedTuple):
    """Checked input of one frame.

    Args:
        sensor_clouds: (N, 3) points of each sensor in the vehicle frame by sensor name; one entry without a name if the
            metric has no `sensor_names`.
        errors_m: (N,) distance of each of these points from its true position; None if all are 0.
        reference: (M, 3) reference points in the vehicle frame.
        weights: (M,) weights of the reference points, or None.
        heights_m: (M,) heights of the reference points above ground, or None.
        block_index: Index of the frame in time.
    """

    sensor_clouds: Mapping[str, Tensor]
    errors_m: Mapping[str, Tensor] | None
    reference: Tensor
    weights: Tensor | None
    heights_m: Tensor | None
    block_index: int

    def select_points(self, min_error_m: float, max_error_m: float) -> list[Tensor]:
        """Select the points of each sensor whose error lies in (min_error_m, max_error_m].

        Args:
            min_error_m: Exclusive lower bound in meters.
            max_error_m: Inclusive upper bound in meters.

        Returns:
            (K, 3) points of each sensor.
        """
        if self.errors_m is None:
            return [cloud if min_error_m < 0 else cloud[:0] for cloud in self.sensor_clouds.values()]
        selected = []
        for name, cloud in self.sensor_clouds.items():
            error_m = self.errors_m[name].to(cloud.device)
            selected.append(cloud[(error_m > min_error_m) & (error_m <= max_error_m)])
        return selected

    @property
    def is_blind(self) -> bool:
        """True if no point of the rig counts for the radius."""
        if self.errors_m is None:
            return not any(map(len, self.sensor_clouds.values()))
        return not any(bool((error_m <= MEASURED_WITHIN_M).any()) for error_m in self.errors_m.values())


class FrameSums(NamedTuple):
    """Contribution of one frame to the sums of a `CoverageMetric`; small, so that processes can exchange it.

    Args:
        block_index: Index of the frame in time, which determines its block.
        counts: Increment of each count.
        cell_columns: (1 + C, K) float64 touched cells of the grid, and the increments of their columns.
        region_columns: (1 + C, L) float64 touched regions in bands, and the increments of their columns.
    """

    block_index: int
    counts: Mapping[str, int]
    cell_columns: Tensor
    region_columns: Tensor


def check_parameters(thresholds_m: Sequence[float], max_radius_m: float, aggregations: Sequence[Aggregation]) -> None:
    """Raise unless the parameters of a metric are valid.

    Args:
        thresholds_m: Detection thresholds in meters.
        max_radius_m: Radius in meters at which r saturates.
        aggregations: Aggregations in addition to the mean of means.

    Raises:
        TypeError: Thresholds or aggregations are no sequences of numbers or aggregations.
        ValueError: A value that `CoverageSums` refuses.
    """
    if not isinstance(thresholds_m, Sequence) or not all(isinstance(threshold, Real) for threshold in thresholds_m):
        raise TypeError(
            f"thresholds_m: a sequence of distances in meters, as in (0.4,), is needed; got {thresholds_m!r}"
        )
    # With an infinite threshold even a rig without returns would detect everything.
    if not all(0 <= threshold < math.inf for threshold in thresholds_m):
        raise ValueError(f"thresholds_m: finite distances >= 0 in meters are needed; got {tuple(thresholds_m)}")
    if len({make_detection_quantity(threshold).key for threshold in thresholds_m}) != len(thresholds_m):
        raise ValueError(f"thresholds_m: values that differ in six digits are needed; got {tuple(thresholds_m)}")
    if not max_radius_m > 0:
        raise ValueError(f"max_radius_m: a positive distance in meters is needed; got {max_radius_m}")
    if any(threshold > max_radius_m for threshold in thresholds_m):
        raise ValueError(
            f"thresholds_m: at most max_radius_m = {max_radius_m} m, where r saturates, is possible; got "
            f"{tuple(thresholds_m)}"
        )
    _check_aggregations(aggregations)


def _check_aggregations(aggregations: Sequence[Aggregation]) -> None:
    is_valid = isinstance(aggregations, Sequence) and all(isinstance(entry, Aggregation) for entry in aggregations)
    if not is_valid:
        raise TypeError(f"aggregations: a sequence of objects such as Maximum() is needed; got {aggregations!r}")
    names = [aggregation.name for aggregation in aggregations]
    if len(set(names)) != len(names) or not BUILT_IN.isdisjoint(names):
        raise ValueError(
            "aggregations: at most one of each class, with several levels in it, and none of the built-in ones is "
            f"possible; got {', '.join(names)}"
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
    """Check the arguments of `CoverageSums.update` and split them into frames.

    Args:
        sensor: As in `CoverageSums.update`, like the next five.
        reference: Likewise.
        weights: Likewise.
        heights_m: Likewise.
        block_index: Likewise.
        errors_m: Likewise.
        grid: As in `CoverageSums`, like the next three.
        thresholds_m: Likewise.
        has_area_weights: Likewise.
        sensor_names: Likewise.
        first_block_index: Index of the first frame if `block_index` is None.

    Returns:
        One entry per frame, in order.

    Raises:
        ValueError: As in `CoverageSums.update`.
        TypeError: As in `CoverageSums.update`.
    """
    if has_area_weights and weights is None:
        raise ValueError(
            "weights: the area of each reference point in m2 is needed, as SurfaceReference provides it; got none "
            "(without has_area_weights=True, points need no weights)"
        )
    rigs = [sensor] if isinstance(sensor, Mapping) else to_list(sensor, "sensor")
    rig_clouds = [_get_clouds_by_name(rig, sensor_names) for rig in rigs]
    references = to_list(reference, "reference")
    num_frames = len(references)
    weight_list = _expand_optional(weights, num_frames, "weights")
    height_list = _expand_optional(heights_m, num_frames, "heights_m")
    if block_index is None:
        block_indices = list(range(first_block_index, first_block_index + num_frames))
    else:
        block_indices = _parse_block_indices(block_index)
    if len(rig_clouds) != num_frames:
        raise ValueError(
            f"{len(rig_clouds)} sensor clouds for {num_frames} reference clouds; each frame needs one of each"
        )
    error_list = _expand_optional(errors_m, num_frames, "errors_m")
    if {len(weight_list), len(height_list), len(block_indices), len(error_list)} != {num_frames}:
        raise ValueError(
            f"{len(weight_list)} weights, {len(height_list)} heights, {len(block_indices)} block indices and "
            f"{len(error_list)} errors for {num_frames} reference clouds; each frame needs one of each"
        )
    frames = []
    for index, clouds in enumerate(rig_clouds):
        for name, cloud in clouds.items():
            label = f"sensor[{index}]" + f"[{name!r}]" * bool(name)
            check_cloud(cloud, label)
            _check_resolution(cloud, grid, thresholds_m, label)
        error_m = error_list[index]
        sensor_errors_m = None if error_m is None else _split_errors(error_m, rigs[index], clouds, f"errors_m[{index}]")
        frame = FrameInput(
            clouds, sensor_errors_m, references[index], weight_list[index], height_list[index], block_indices[index]
        )
        check_cloud(frame.reference, f"reference[{index}]")
        _check_resolution(frame.reference, grid, thresholds_m, f"reference[{index}]")
        check_weights(frame.weights, len(frame.reference), f"weights[{index}]")
        _check_heights(frame.heights_m, frame.reference, grid, f"heights_m[{index}]")
        _check_block_index(frame.block_index, f"block_index[{index}]")
        frames.append(frame)
    return frames


def _expand_optional(values: Clouds | None, num_frames: int, name: str) -> Sequence[Tensor | None]:
    return [None] * num_frames if values is None else to_list(values, name)


def _check_block_index(block_index: int, name: str) -> None:
    largest = 10**15  # indices are int64, and the length of blocks doubles until a block contains the last one
    if not 0 <= block_index <= largest:
        raise ValueError(f"{name}: a number from 0 to {largest:,} is needed; got {block_index}")


def _check_resolution(cloud: Tensor, grid: BevGrid, thresholds_m: Sequence[float], name: str) -> None:
    """Refuse coordinate types that are too coarse at the borders of the grid."""
    max_relative_error = 0.05  # rounding may move a point by this share of a cell or of the smallest threshold
    all_bounds_m = (grid.x_m, grid.y_m, *grid.heights.values())
    farthest_m = max(max(abs(low), abs(high)) for low, high in all_bounds_m)
    spacing_m = farthest_m * torch.finfo(cloud.dtype).eps
    finest_m = min([grid.cell_m, *(threshold for threshold in thresholds_m if threshold > 0)])
    if spacing_m > max_relative_error * finest_m:
        raise ValueError(
            f"{name}: {str(cloud.dtype).removeprefix('torch.')} coordinates are {spacing_m:.2g} m apart at "
            f"{farthest_m:,.0f} m, where the grid ends, too coarse for cells or thresholds of {finest_m:g} m; "
            "subtract a position near the vehicle from clouds and grid, or pass a wider type (a precision of Lightning "
            "such as bf16-true converts tensors of a batch, but no FrameBatch)"
        )


def _split_errors(
    error_m: Tensor, rig: Tensor | Mapping[str, Tensor], clouds: Mapping[str, Tensor], name: str
) -> Mapping[str, Tensor]:
    """Split the errors of all points of a rig by sensor, in the order in which the caller passed the sensors."""
    check_tensor(error_m, name)
    sensor_names = list(rig) if isinstance(rig, Mapping) else list(clouds)
    sizes = [len(clouds[sensor]) for sensor in sensor_names]
    if error_m.shape != (sum(sizes),) or bool(error_m.isnan().any()):
        raise ValueError(
            f"{name}: the error in meters of each of {sum(sizes)} points of the rig is needed; got shape "
            f"{tuple(error_m.shape)} with {int(error_m.isnan().sum())} NaN"
        )
    return dict(zip(sensor_names, torch.split(error_m.abs(), sizes), strict=True))


def to_list(clouds: Any, name: str) -> list[Any]:  # noqa: ANN401
    """Convert one tensor, or a sequence with one entry per frame, to a list.

    Args:
        clouds: Tensor or sequence.
        name: Name of the argument in messages.
    """
    if isinstance(clouds, Tensor):
        return [clouds]
    if not isinstance(clouds, Sequence):
        check_tensor(clouds, f"{name} (one, or a list with one per frame)")
    return list(clouds)


def _get_clouds_by_name(rig: Any, sensor_names: Sequence[str]) -> Mapping[str, Tensor]:  # noqa: ANN401
    if not sensor_names:
        if isinstance(rig, Mapping):
            raise TypeError(
                "sensor: one cloud per frame is needed; got clouds by name, for which the metric needs sensor_names="
            )
        return {"": rig}
    if not isinstance(rig, Mapping) or set(rig) != set(sensor_names):
        arrived = ", ".join(rig) if isinstance(rig, Mapping) else type(rig).__name__
        raise ValueError(f"sensor: a dict with the clouds of {', '.join(sensor_names)} is needed; got {arrived}")
    return {name: rig[name] for name in sensor_names}


def _parse_block_indices(block_index: Any) -> list[int]:  # noqa: ANN401
    values = block_index if isinstance(block_index, Sequence) else [block_index]
    try:
        return [operator.index(value) for value in values]
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"block_index: an integer, or a list with one per frame, is needed; got {block_index!r}"
        ) from error


def _check_heights(heights_m: Tensor | None, points: Tensor, grid: BevGrid, name: str) -> None:
    """Check that each frame has heights above ground if and only if the bands need them."""
    if heights_m is not None:
        check_tensor(heights_m, name)
    grid.check_heights(points, heights_m, name)
    if heights_m is not None and bool(heights_m.isinf().any()):
        raise ValueError(f"{name}: finite meters are needed, NaN where there is no ground; got infinite ones")
