"""What a rig costs: a price for each LiDAR model, or for a sensor that has none, and one for each mount."""

from collections.abc import Iterator, Mapping, Sequence

from torchcover.placement.free_sensor import FreeSensor
from torchcover.simulation import Sensor, builtin_names

MOUNT = "mount"


def price_eur(cost: Mapping[str, float], sensor: str, model: str | None) -> float:
    """What a sensor costs, with its mount.

    Args:
        cost: Prices, by model, by the name of a sensor, and of `mount`.
        sensor: Its name.
        model: Its model; None if it has none.

    Raises:
        ValueError: It has no price.

    Example:
        >>> price_eur({"velodyne_vlp16": 3000.0, "mount": 100.0}, "roof", "velodyne_vlp16")
        3100.0
    """
    key = sensor if model is None or model not in cost else model
    if key not in cost:
        raise ValueError(f"cost: no price of {model or sensor!r}, for the sensor {sensor!r}; give it")
    return cost[key] + cost.get(MOUNT, 0.0)


def check_prices(
    cost: Mapping[str, float],
    max_cost_eur: float | None,
    sensors: Sequence[Sensor],
    free: Mapping[str, FreeSensor],
) -> None:
    """Whether all that may be chosen has a price, and the cheapest of it is not too dear.

    Args:
        cost: Prices; none at all is nothing to check, unless there is a limit.
        max_cost_eur: The limit, if there is one.
        sensors: Of the rig that the search starts from.
        free: What of them is free.

    Raises:
        ValueError: A price is missing, is one of nothing, or the limit is below the cheapest rig.
    """
    if not cost:
        if max_cost_eur is not None:
            raise ValueError("constraints.max_cost_eur: nothing has a price; give them as cost")
        return
    models = {model for one in free.values() for model in one.model or ()}
    known = {MOUNT, *models, *builtin_names("lidars"), *(sensor.name for sensor in sensors)}
    if unknown := [key for key in cost if key not in known]:
        raise ValueError(f"cost: {', '.join(unknown)}: no LiDAR model, no sensor of the rig, and not {MOUNT!r}")
    cheapest = sum(min(_prices(cost, sensor, sensors, free)) for sensor in sensors)
    if max_cost_eur is not None and cheapest > max_cost_eur:
        raise ValueError(
            f"constraints.max_cost_eur: {max_cost_eur:g}, but the cheapest rig of the space costs {cheapest:g}"
        )


def _prices(
    cost: Mapping[str, float], sensor: Sensor, sensors: Sequence[Sensor], free: Mapping[str, FreeSensor]
) -> Iterator[float]:
    """All that a sensor may cost."""
    own, made = free.get(sensor.name), sensor
    if own is not None and own.mirror_of is not None:
        made = next(other for other in sensors if other.name == own.mirror_of)
        own = free[own.mirror_of]
    if own is not None and own.present is not None:
        yield 0.0
    for model in (own.model if own else None) or (getattr(made, "model", None),):
        yield price_eur(cost, sensor.name, model)
