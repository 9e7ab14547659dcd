"""Constraints: what a rig must keep to, whatever its coverage, and what it costs."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import combinations
from typing import Annotated

import numpy as np
from pydantic import Field, NonNegativeFloat

from torchcover.geometry.rigid import Matrix
from torchcover.placement.free_sensor import FreeSensor
from torchcover.simulation import Document, Rig, Sensor, list_builtin_names
from torchcover.simulation.mount_regions import Skin

# Sensors whose poses differ by less are each other's mirror images.
MIRRORED_M = 1e-4
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
# A housing has about this size; closer, two sensors are at one place.
APART_M = 0.1
# Among prices: that of the mount of each sensor.
MOUNT = "mount"


class Constraints(Document):
    """What a rig must keep to.

    Args:
        min_distance_m: Between a sensor that is free and any other.
        max_self_hit_share: Share of a rig's rays that may end on the vehicle; known once it has been scanned.
        symmetric: Whether every sensor must have its mirror image beyond the vehicle's middle, or lie on that.
        max_cost_eur: What the rig may cost; see `cost` of the space.
    """

    min_distance_m: NonNegativeFloat = APART_M
    max_self_hit_share: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    symmetric: bool = False
    max_cost_eur: NonNegativeFloat | None = None

    def find_violations(self, rig: Rig, free_sensors: Collection[str], cost_eur: float | None) -> tuple[str, ...]:
        """What of it a rig does not keep to, in words; not its self-hits, which only a scan knows.

        `free_sensors` are the names of the sensors that a search may place.
        """
        return (*self._too_close(rig, free_sensors), *self._lopsided(rig), *self._too_dear(cost_eur))

    def _too_close(self, rig: Rig, free: Collection[str]) -> Iterator[str]:
        for one, other in combinations(rig.sensors, 2):
            if one.name not in free and other.name not in free:
                continue
            apart_m = float(np.linalg.norm(one.mount.to_matrix()[:3, 3] - other.mount.to_matrix()[:3, 3]))
            if apart_m < self.min_distance_m:
                yield (
                    f"{one.name} and {other.name} are {apart_m:.3f} m apart; min_distance_m is {self.min_distance_m:g}"
                )

    def _lopsided(self, rig: Rig) -> Iterator[str]:
        if not self.symmetric:
            return
        poses = [sensor.mount.to_matrix() for sensor in rig.sensors]
        for sensor, pose in zip(rig.sensors, poses, strict=True):
            mirrored = MIRROR @ pose @ MIRROR
            if not any(np.allclose(mirrored, other, rtol=0.0, atol=MIRRORED_M) for other in poses):
                yield f"{sensor.name} has no mirror image on the other side of the vehicle; symmetric is true"

    def _too_dear(self, cost_eur: float | None) -> Iterator[str]:
        if self.max_cost_eur is not None and cost_eur is not None and cost_eur > self.max_cost_eur:
            yield f"it costs {cost_eur:g} EUR; max_cost_eur is {self.max_cost_eur:g}"


def find_placement_error(sensor: Sensor, skin: Skin) -> str | None:
    """Why a sensor cannot be where it is: below the ground, or inside the vehicle; None if it can."""
    place_m: Matrix = sensor.mount.to_matrix()[:3, 3]
    if place_m[2] <= 0.0:
        return f"{sensor.name} at {place_m.round(3).tolist()} m is not above the ground"
    if skin.is_inside(place_m):
        return f"{sensor.name} at {place_m.round(3).tolist()} m is inside the vehicle's body"
    return None


def get_price_eur(prices_eur: Mapping[str, float], sensor_name: str, model: str | None) -> float:
    """What a sensor costs, with its mount, by its model or by its name. ValueError: it has no price.

    Example:
        >>> get_price_eur({"velodyne_vlp16": 3000.0, "mount": 100.0}, "roof", "velodyne_vlp16")
        3100.0
    """
    key = sensor_name if model is None or model not in prices_eur else model
    if key not in prices_eur:
        raise ValueError(f"cost: no price of {model or sensor_name!r}, for the sensor {sensor_name!r}; give it")
    return prices_eur[key] + prices_eur.get(MOUNT, 0.0)


def check_prices(
    prices_eur: Mapping[str, float],
    max_cost_eur: float | None,
    sensors: Sequence[Sensor],
    free_sensors: Mapping[str, FreeSensor],
) -> None:
    """ValueError: a price is missing, is one of nothing, or the limit, if there is one, is below the cheapest rig."""
    if not prices_eur:
        if max_cost_eur is not None:
            raise ValueError("constraints.max_cost_eur: nothing has a price; give them as cost")
        return
    models = {model for one in free_sensors.values() for model in one.model or ()}
    known = {MOUNT, *models, *list_builtin_names("lidars"), *(sensor.name for sensor in sensors)}
    if unknown := [key for key in prices_eur if key not in known]:
        raise ValueError(f"cost: {', '.join(unknown)}: no LiDAR model, no sensor of the rig, and not {MOUNT!r}")
    cheapest = sum(min(_prices(prices_eur, sensor, sensors, free_sensors)) for sensor in sensors)
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
        yield get_price_eur(cost, sensor.name, model)
