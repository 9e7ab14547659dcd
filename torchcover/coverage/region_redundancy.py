"""The numbers of one region without each sensor, from what a metric knows of the sensors."""

import math

import torch
from torch import Tensor

from torchcover.coverage.estimate import RegionEstimate, estimate_ratio
from torchcover.coverage.quantity import RADIUS, Quantity, detection
from torchcover.coverage.redundancy import PlaceSums, Redundancy, redundancy_quantities
from torchcover.coverage.summary import Number, RegionRedundancy, differences_of


def over_place(places: PlaceSums, place: int) -> RegionEstimate:
    """(Q + V,) means over the visible surface of one place, as `PlaceSums` has them."""
    return estimate_ratio(places.m2[:, place], places.sums[:, :, place], places.steps)


def over_known(redundancy: Redundancy, with_all: Tensor, band: int, known: Tensor) -> RegionEstimate:
    """(Q + V,) unweighted means over the known cells of a region; nobody knows their errors.

    Args:
        redundancy: Of a coverage that is not by area.
        with_all: (Q,) the numbers with all sensors.
        band: Number of the height band.
        known: (Y, X) bool, the cells.
    """
    without = torch.stack([layer.values[band][known].mean() for layer in redundancy.layers.values()])
    value = torch.cat([with_all, without])
    return RegionEstimate(value, value.new_empty((0, len(value))), value.new_empty(0))


def region_redundancy(
    redundancy: Redundancy, thresholds: tuple[float, ...], estimate: RegionEstimate
) -> RegionRedundancy:
    """The numbers of a region without each sensor.

    Args:
        redundancy: Whose sensors.
        thresholds: Detection thresholds in metres.
        estimate: From `over_place` or `over_known`.
    """
    single = (RADIUS, *map(detection, thresholds))
    count, keys = len(single), [quantity.key for quantity in single]
    values, errors = estimate.value.tolist(), estimate.error.tolist()
    numbers = [Number(value, error) for value, error in zip(values, errors, strict=True)]
    several = redundancy_quantities((), thresholds)
    seen_by = {quantity.key: number for quantity, number in zip(several, numbers[count:], strict=False)}
    without, change = {}, {}
    first = _part(estimate, slice(0, count))
    for at, sensor in enumerate(redundancy.sensors):
        start = count + len(several) + at * count
        own = slice(start, start + count)
        without[sensor] = dict(zip(keys, numbers[own], strict=True))
        change[sensor] = dict(zip(keys, differences_of(_part(estimate, own), first), strict=True))
    decisive = single[min(1, count - 1)]
    losses = {sensor: _loss(changes[decisive.key].value, decisive) for sensor, changes in change.items()}
    worst = max(losses, key=losses.__getitem__)
    return RegionRedundancy(seen_by, without, change, worst if losses[worst] > 0 else None)


def _part(estimate: RegionEstimate, which: slice) -> RegionEstimate:
    return RegionEstimate(estimate.value[which], estimate.left_out[:, which], estimate.steps)


def _loss(change: float, quantity: Quantity) -> float:
    if math.isnan(change):
        return 0.0
    return change if quantity.lower_is_better else -change
