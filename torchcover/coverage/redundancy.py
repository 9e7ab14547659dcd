"""Redundancy: by how many sensors of a rig a place is seen, and what is lost when one of them fails."""

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
    """What a `CoverageMetric` with `sensor_names` knows of them.

    Args:
        sensor_names: Their names.
        observed_cells: The cells that it is known of.
        sparse_layers: In these, by the key of their quantity: for each threshold by how many sensors the points of a
            cell are seen ("sensors_0.4m") and the share that two or more see ("detected_by_two_0.4m"); for each sensor the
            radius and the detection without it ("radius_m_without_roof"). By area if the coverage is, else means of
            means.
    """

    sensor_names: tuple[str, ...]
    observed_cells: ObservedCells
    sparse_layers: Mapping[str, Layer]

    @property
    def layers(self) -> Mapping[str, Layer]:
        """The same over the grid."""
        return expand_layers(self.sparse_layers, self.observed_cells)


def expand_layers(sparse_layers: Mapping[str, Layer], observed_cells: ObservedCells) -> Mapping[str, Layer]:
    """Layers over the grid from those over the known cells."""
    return LazyMaps(sparse_layers, lambda layer: Layer(layer.quantity, observed_cells.expand_to_grid(layer.values)))


def list_redundancy_quantities(sensor_names: Sequence[str], thresholds_m: Sequence[float]) -> tuple[Quantity, ...]:
    """What there is a layer, and a number of each region, of: in the order in which they are summed up.

    Example:
        >>> [each.key for each in list_redundancy_quantities(["roof"], [0.4])]
        ['sensors_0.4m', 'detected_by_two_0.4m', 'radius_m_without_roof', 'detection_0.4m_without_roof']
    """
    several = [
        each(threshold) for threshold in thresholds_m for each in (make_sensor_count_quantity, make_redundancy_quantity)
    ]
    single = (RADIUS, *map(make_detection_quantity, thresholds_m))
    return (*several, *(make_failure_quantity(sensor, quantity) for sensor in sensor_names for quantity in single))


@dataclass(frozen=True)
class SensorFailures(Aggregation):
    """Sums of how many sensors see a point, and of what the rig would be without each of them.

    The radius of a rig is the smallest of those of its sensors, so that the radius without a sensor is the smallest of
    the others', and no search is made for it.
    """

    name: ClassVar[str] = "redundancy"
    description: ClassVar[str] = "redundancy"

    sensor_names: tuple[str, ...]
    thresholds_m: tuple[float, ...]
    has_area_weights: bool = False

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """As `list_redundancy_quantities`."""
        return list_redundancy_quantities(self.sensor_names, self.thresholds_m)

    def create_states(self, num_cells: int) -> dict[str, SumState]:
        """`sums` (V, C): means of each step, or with square metres those times them, and `m2` (C)."""
        m2 = (
            {"m2": SumState(torch.zeros(num_cells, dtype=torch.float64, device="cpu"))} if self.has_area_weights else {}
        )
        return {"sums": SumState(torch.zeros(len(self.quantities), num_cells, dtype=torch.float64, device="cpu")), **m2}

    def update(self, sums: Mapping[str, Tensor], frame: BinnedFrame) -> None:
        """Add the points of a step, whose last values are those of `values`."""
        own, weight = frame.cell_means.means[-len(self.quantities) :], frame.cell_means.weight_sums
        sums["sums"].add_(own * weight if self.has_area_weights else own)
        if self.has_area_weights:
            sums["m2"].add_(weight)

    def compute_values(self, sensor_distances_m: Sequence[Tensor], max_radius_m: float) -> Tensor:
        """(V, N) float64 what there is to say of each point, with radii that saturate.

        `sensor_distances_m` (S, N) are distances to the nearest point of each sensor, infinite where none is near: for the
        radius, then for each threshold.
        """
        rows = []
        for distance, threshold in zip(sensor_distances_m[1:], self.thresholds_m, strict=True):
            seeing = (distance <= threshold).sum(dim=0)
            rows += [seeing.double(), (seeing >= 2).double()]
        for radius, *others in zip(*map(_without_each, sensor_distances_m), strict=True):
            rows.append(radius.clamp(max=radius.new_tensor(max_radius_m)).double())
            pairs = zip(others, self.thresholds_m, strict=True)
            rows += [(distance <= threshold).double() for distance, threshold in pairs]
        return torch.stack(rows)

    def compute_layers(self, sums: Mapping[str, Tensor], observed_frames: Tensor, max_radius_m: float) -> list[Layer]:
        """One for each quantity; 0 / 0, which is NaN, where nothing was seen."""
        values = sums["sums"] / (sums["m2"] if self.has_area_weights else observed_frames)
        return list(map(Layer, self.quantities, values))


def _without_each(of_sensors: Tensor) -> Tensor:
    """(S, N) the smallest distances without each of the sensors."""
    nearest, which = of_sensors.min(dim=0)
    # Without any sensor but the nearest the distance stays as it is.
    second = of_sensors.scatter(0, which[None], torch.inf).amin(dim=0)
    failed = torch.arange(len(of_sensors), device=which.device)[:, None]
    return torch.where(which == failed, second, nearest)
