"""The numbers of one region without each sensor, from what a metric knows of the sensors."""

import math

import torch
from torch import Tensor

from torchcover.coverage.aggregations import MeanOfMeans
from torchcover.coverage.quantity import without
from torchcover.coverage.redundancy import PlaceSums, Redundancy, redundancy_quantities
from torchcover.coverage.summary import RegionRedundancy
from torchcover.estimation import Estimate, Quantity


def quantities_of(redundancy: Redundancy, thresholds: tuple[float, ...]) -> tuple[Quantity, ...]:
    """The Q numbers with all sensors, then the V of `redundancy_quantities`."""
    return (*MeanOfMeans(thresholds).quantities, *redundancy_quantities(redundancy.sensors, thresholds))


def over_place(places: PlaceSums, place: int, quantities: tuple[Quantity, ...]) -> Estimate:
    """Means over the visible surface of one place, as `PlaceSums` has them."""
    return Estimate.of_ratios(quantities, places.m2[:, place], places.sums[:, :, place], places.steps)


def over_known(
    redundancy: Redundancy, with_all: Tensor, band: int, known: Tensor, quantities: tuple[Quantity, ...]
) -> Estimate:
    """Unweighted means over the known cells of a region; their errors are unknown.

    Args:
        redundancy: Of a coverage that is not by area.
        with_all: (Q,) the numbers with all sensors.
        band: Number of the height band.
        known: (Y, X) bool, the cells.
        quantities: As `quantities_of`.
    """
    values = torch.stack([layer.values[band][known].mean() for layer in redundancy.layers.values()])
    return Estimate.of(quantities, torch.cat([with_all, values]))


def region_redundancy(redundancy: Redundancy, thresholds: tuple[float, ...], estimate: Estimate) -> RegionRedundancy:
    """The numbers of a region without each sensor.

    Args:
        redundancy: Whose sensors.
        thresholds: Detection thresholds in metres.
        estimate: From `over_place` or `over_known`.
    """
    single, several = MeanOfMeans(thresholds).quantities, redundancy_quantities((), thresholds)
    numbers, count = estimate.numbers(intervals=False), len(single)
    each, change = {}, {}
    for at, sensor in enumerate(redundancy.sensors):
        start = count + len(several) + at * count
        own = estimate[start : start + count]
        each[sensor] = {quantity.key: numbers[without(sensor, quantity).key] for quantity in single}
        change[sensor] = Estimate(single, own.value, own.left_out, own.steps).differences(estimate[:count])
    decisive = single[min(1, count - 1)]
    losses = {sensor: _loss(changes[decisive.key].gain) for sensor, changes in change.items()}
    worst = max(losses, key=losses.__getitem__)
    seen_by = {quantity.key: numbers[quantity.key] for quantity in several}
    return RegionRedundancy(seen_by, each, change, worst if losses[worst] > 0 else None)


def _loss(gain: float) -> float:
    return 0.0 if math.isnan(gain) else -gain
