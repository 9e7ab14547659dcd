"""Redundancy: by how many sensors of a rig a place is seen, and what is lost when one of them fails."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchcover.coverage.aggregations import Aggregation, BinnedStep, Layer, State
from torchcover.coverage.blocks import KnownCells, Maps
from torchcover.coverage.quantity import RADIUS, detection, seen_by_two, sensors_seeing, without
from torchcover.estimation import Quantity


@dataclass(frozen=True)
class Redundancy:
    """What a `CoverageMetric` with `sensors` knows of them.

    Args:
        sensors: Their names.
        known: The cells that it is known of.
        listed: In these, by the key of their quantity: for each threshold by how many sensors the points of a
            cell are seen ("sensors_0.4m") and the share that two or more see ("seen_by_two_0.4m"); for each sensor the
            radius and the detection without it ("radius_m_without_roof"). By area if the coverage is, else means of
            means.
    """

    sensors: tuple[str, ...]
    known: KnownCells
    listed: Mapping[str, Layer]

    @property
    def layers(self) -> Mapping[str, Layer]:
        """The same over the grid."""
        return layers_of(self.listed, self.known)


def layers_of(listed: Mapping[str, Layer], known: KnownCells) -> Mapping[str, Layer]:
    """Layers over the grid from those over the known cells."""
    return Maps(listed, lambda layer: Layer(layer.quantity, known.spread(layer.values)))


def redundancy_quantities(sensors: Sequence[str], thresholds: Sequence[float]) -> tuple[Quantity, ...]:
    """What there is a layer, and a number of each region, of: in the order in which they are summed up.

    Example:
        >>> [each.key for each in redundancy_quantities(["roof"], [0.4])]
        ['sensors_0.4m', 'seen_by_two_0.4m', 'radius_m_without_roof', 'detection_0.4m_without_roof']
    """
    several = [each(threshold) for threshold in thresholds for each in (sensors_seeing, seen_by_two)]
    single = (RADIUS, *map(detection, thresholds))
    return (*several, *(without(sensor, quantity) for sensor in sensors for quantity in single))


@dataclass(frozen=True)
class SensorFailures(Aggregation):
    """Sums of how many sensors see a point, and of what the rig would be without each of them.

    The radius of a rig is the smallest of those of its sensors, so that the radius without a sensor is the smallest of
    the others', and no search is made for it.
    """

    name: ClassVar[str] = "redundancy"
    words: ClassVar[str] = "redundancy"

    sensors: tuple[str, ...]
    thresholds: tuple[float, ...]
    square_metres: bool = False

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """As `redundancy_quantities`."""
        return redundancy_quantities(self.sensors, self.thresholds)

    def states(self, cells: int) -> dict[str, State]:
        """`sums` (V, C): means of each step, or with square metres those times them, and `m2` (C)."""
        m2 = {"m2": State(torch.zeros(cells, dtype=torch.float64, device="cpu"))} if self.square_metres else {}
        return {"sums": State(torch.zeros(len(self.quantities), cells, dtype=torch.float64, device="cpu")), **m2}

    def update(self, sums: Mapping[str, Tensor], step: BinnedStep) -> None:
        """Add the points of a step, whose last values are those of `values`."""
        own, weight = step.means.mean[-len(self.quantities) :], step.means.weight
        sums["sums"].add_(own * weight if self.square_metres else own)
        if self.square_metres:
            sums["m2"].add_(weight)

    def values(self, of_sensors: Sequence[Tensor], max_radius: float) -> Tensor:
        """(V, N) float64 what there is to say of each point, with radii that saturate.

        `of_sensors` (S, N) are distances to the nearest point of each sensor, infinite where none is near: for the
        radius, then for each threshold.
        """
        rows = []
        for distance, threshold in zip(of_sensors[1:], self.thresholds, strict=True):
            seeing = (distance <= threshold).sum(dim=0)
            rows += [seeing.double(), (seeing >= 2).double()]
        for radius, *others in zip(*map(_without_each, of_sensors), strict=True):
            rows.append(radius.clamp(max=radius.new_tensor(max_radius)).double())
            pairs = zip(others, self.thresholds, strict=True)
            rows += [(distance <= threshold).double() for distance, threshold in pairs]
        return torch.stack(rows)

    def layers(self, sums: Mapping[str, Tensor], probed_steps: Tensor, max_radius: float) -> list[Layer]:
        """One for each quantity; 0 / 0, which is NaN, where nothing was seen."""
        values = sums["sums"] / (sums["m2"] if self.square_metres else probed_steps)
        return list(map(Layer, self.quantities, values))


def _without_each(of_sensors: Tensor) -> Tensor:
    """(S, N) the smallest distances without each of the sensors."""
    nearest, which = of_sensors.min(dim=0)
    # Without any sensor but the nearest the distance stays as it is.
    second = of_sensors.scatter(0, which[None], torch.inf).amin(dim=0)
    failed = torch.arange(len(of_sensors), device=which.device)[:, None]
    return torch.where(which == failed, second, nearest)
