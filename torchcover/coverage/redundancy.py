"""Redundancy: number of sensors that detect a point, and coverage of the rig when one sensor fails."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchcover.coverage.aggregations import Aggregation, BinnedFrame, Layer, SumState
from torchcover.coverage.quantities import (
    RADIUS,
    make_detection_quantity,
    make_failure_quantity,
    make_redundancy_quantity,
    make_sensor_count_quantity,
)
from torchcover.coverage.sparse_sums import LazyMaps, ObservedCells
from torchcover.estimation import Quantity


@dataclass(frozen=True)
class Redundancy:
    """Maps of a `CoverageMetric` with `sensor_names`.

    Args:
        sensor_names: Names of the sensors.
        observed_cells: K observed cells.
        sparse_layers: (K,) layers by the key of their quantity, means over area if the coverage is, else means of
            means: for each threshold the number of sensors that detect a point ("sensors_0.4m") and the share of points
            that two or more detect ("detected_by_two_0.4m"); for each sensor the radius and the detection rates without
            it ("radius_m_without_roof").
    """

    sensor_names: tuple[str, ...]
    observed_cells: ObservedCells
    sparse_layers: Mapping[str, Layer]

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Quantities of the layers, as in `list_redundancy_quantities`."""
        return tuple(layer.quantity for layer in self.sparse_layers.values())

    @property
    def layers(self) -> Mapping[str, Layer]:
        """Layers over the full grid."""
        return expand_layers(self.sparse_layers, self.observed_cells)


def expand_layers(sparse_layers: Mapping[str, Layer], observed_cells: ObservedCells) -> Mapping[str, Layer]:
    """Expand layers to the full grid, each on access.

    Args:
        sparse_layers: (K,) layers over the observed cells.
        observed_cells: K observed cells.
    """

    def expand(layer: Layer) -> Layer:
        return Layer(layer.quantity, observed_cells.expand_to_grid(layer.values))

    return LazyMaps(sparse_layers, expand)


def list_redundancy_quantities(sensor_names: Sequence[str], thresholds_m: Sequence[float]) -> tuple[Quantity, ...]:
    """List the quantities of redundancy in the order of their sums.

    Args:
        sensor_names: Names of the sensors.
        thresholds_m: Detection thresholds in meters.

    Example:
        >>> [quantity.key for quantity in list_redundancy_quantities(["roof"], [0.4])]
        ['sensors_0.4m', 'detected_by_two_0.4m', 'radius_m_without_roof', 'detection_0.4m_without_roof']
    """
    quantities = []
    for threshold_m in thresholds_m:
        quantities += [make_sensor_count_quantity(threshold_m), make_redundancy_quantity(threshold_m)]
    for sensor in sensor_names:
        quantities.append(make_failure_quantity(sensor, RADIUS))
        quantities += [make_failure_quantity(sensor, make_detection_quantity(value_m)) for value_m in thresholds_m]
    return tuple(quantities)


@dataclass(frozen=True)
class SensorFailures(Aggregation):
    """Sums of the number of detecting sensors, and of radius and detections without each sensor.

    The radius of a rig is the smallest radius of its sensors. The radius without a sensor is therefore the smallest of
    the other sensors and needs no further search.

    Args:
        sensor_names: Names of the sensors.
        thresholds_m: Detection thresholds in meters.
        has_area_weights: Sum over area instead of means of frames.
    """

    name: ClassVar[str] = "redundancy"
    description: ClassVar[str] = "redundancy"

    sensor_names: tuple[str, ...]
    thresholds_m: tuple[float, ...]
    has_area_weights: bool = False

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Quantities as in `list_redundancy_quantities`."""
        return list_redundancy_quantities(self.sensor_names, self.thresholds_m)

    def create_states(self, num_cells: int) -> dict[str, SumState]:
        """Create `sums` (V, C) of the means of frames; with area weights, of values times area, and `m2` (C,)."""
        states = {"sums": SumState(torch.zeros(len(self.quantities), num_cells, dtype=torch.float64, device="cpu"))}
        if self.has_area_weights:
            states["m2"] = SumState(torch.zeros(num_cells, dtype=torch.float64, device="cpu"))
        return states

    def update(self, sums: Mapping[str, Tensor], frame: BinnedFrame) -> None:
        """Add the points of a frame; `compute_values` gives their last values."""
        means, weight_sums = frame.cell_means.means[-len(self.quantities) :], frame.cell_means.weight_sums
        if self.has_area_weights:
            sums["sums"].add_(means * weight_sums)
            sums["m2"].add_(weight_sums)
        else:
            sums["sums"].add_(means)

    def compute_values(self, sensor_distances_m: Sequence[Tensor], max_radius_m: float) -> Tensor:
        """Compute the values of each point, in the order of `quantities`.

        Args:
            sensor_distances_m: (S, N) distances to the nearest point of each sensor, infinite without one: for the
                radius, then for each threshold.
            max_radius_m: Radius in meters at which r saturates.

        Returns:
            (V, N) float64.
        """
        rows = []
        for distances_m, threshold_m in zip(sensor_distances_m[1:], self.thresholds_m, strict=True):
            detecting_sensors = (distances_m <= threshold_m).sum(dim=0)
            rows += [detecting_sensors.double(), (detecting_sensors >= 2).double()]
        distances_without = [_compute_minimum_without_each(distances_m) for distances_m in sensor_distances_m]
        for radius, *detection_distances in zip(*distances_without, strict=True):
            rows.append(radius.clamp(max=radius.new_tensor(max_radius_m)).double())
            for distance_m, threshold_m in zip(detection_distances, self.thresholds_m, strict=True):
                rows.append((distance_m <= threshold_m).double())
        return torch.stack(rows)

    def compute_layers(self, sums: Mapping[str, Tensor], observed_frames: Tensor, max_radius_m: float) -> list[Layer]:
        """Compute one layer per quantity; NaN (0 / 0) in cells without reference points."""
        values = sums["sums"] / (sums["m2"] if self.has_area_weights else observed_frames)
        return [Layer(quantity, row) for quantity, row in zip(self.quantities, values, strict=True)]


def _compute_minimum_without_each(sensor_distances_m: Tensor) -> Tensor:
    """Compute the (S, N) smallest distances without each of the sensors."""
    nearest, nearest_sensor = sensor_distances_m.min(dim=0)
    # Without any other sensor than the nearest, the distance does not change.
    second = sensor_distances_m.scatter(0, nearest_sensor[None], torch.inf).amin(dim=0)
    failed_sensor = torch.arange(len(sensor_distances_m), device=nearest_sensor.device)[:, None]
    return torch.where(nearest_sensor == failed_sensor, second, nearest)
