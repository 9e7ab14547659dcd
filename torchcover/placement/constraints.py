"""Constraints and prices of a rig in a placement search, independent of its coverage."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import chain, combinations
from typing import Annotated

import numpy as np
from pydantic import Field, NonNegativeFloat

from torchcover.geometry.rigid import Matrix
from torchcover.placement.free_sensor import FreeSensor
from torchcover.simulation import Document, Rig, Sensor, list_builtin_names
from torchcover.simulation.mount_regions import Skin

MOUNT = "mount"  # key of the price of the mount that each sensor needs


class Constraints(Document):
    """Constraints that every candidate must satisfy.

    Args:
        min_distance_m: Minimum distance between a free sensor and any other; the default is the size of a housing.
        max_self_hit_share: Maximum share of a rig's rays that hit the vehicle; it is known after the scan.
        symmetric: Whether every sensor needs a mirror image on the other side of the plane y = 0, or must lie on it.
        max_cost_eur: Maximum cost of the rig in EUR, from `prices_eur` of the space.
    """

    min_distance_m: NonNegativeFloat = 0.1
    max_self_hit_share: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    symmetric: bool = False
    max_cost_eur: NonNegativeFloat | None = None

    def find_violations(self, rig: Rig, free_sensors: Collection[str], cost_eur: float | None) -> tuple[str, ...]:
        """Describe the constraints that a rig violates, except for self hits, which need a scan.

        Args:
            rig: The rig.
            free_sensors: Names of the sensors that the search places.
            cost_eur: Cost of the rig; None without prices.

        Returns:
            One sentence for each violation.
        """
        return (
            *self._find_close_pairs(rig, free_sensors),
            *self._find_asymmetric_sensors(rig),
            *self._check_cost(cost_eur),
        )

    def _find_close_pairs(self, rig: Rig, free_sensors: Collection[str]) -> Iterator[str]:
        """Yield a sentence for each free sensor that is too close to another sensor."""
        for first, second in combinations(rig.sensors, 2):
            if first.name not in free_sensors and second.name not in free_sensors:
                continue
            offset_m = first.mount.to_matrix()[:3, 3] - second.mount.to_matrix()[:3, 3]
            distance_m = float(np.linalg.norm(offset_m))
            if distance_m < self.min_distance_m:
                yield (
                    f"{first.name} and {second.name} are {distance_m:.3f} m apart; min_distance_m is "
                    f"{self.min_distance_m:g}"
                )

    def _find_asymmetric_sensors(self, rig: Rig) -> Iterator[str]:
        """Yield a sentence for each sensor without a mirror image at the plane y = 0."""
        if not self.symmetric:
            return
        mirror = np.diag([1.0, -1.0, 1.0, 1.0])
        tolerance = 1e-4  # meters, and entries of rotation matrices
        poses = [sensor.mount.to_matrix() for sensor in rig.sensors]
        for sensor, pose in zip(rig.sensors, poses, strict=True):
            mirrored = mirror @ pose @ mirror
            if not any(np.allclose(mirrored, candidate, rtol=0.0, atol=tolerance) for candidate in poses):
                yield f"{sensor.name} has no mirror image on the other side of the vehicle; symmetric is true"

    def _check_cost(self, cost_eur: float | None) -> Iterator[str]:
        """Yield a sentence if the cost exceeds its maximum."""
        if self.max_cost_eur is not None and cost_eur is not None and cost_eur > self.max_cost_eur:
            yield f"it costs {cost_eur:g} EUR; max_cost_eur is {self.max_cost_eur:g}"


def find_placement_error(sensor: Sensor, skin: Skin) -> str | None:
    """Describe why a sensor cannot be at its position: below the ground or inside the vehicle.

    Args:
        sensor: The sensor with its mount.
        skin: Surface of the vehicle.

    Returns:
        A sentence; None if the position is possible.
    """
    position_m: Matrix = sensor.mount.to_matrix()[:3, 3]
    if position_m[2] <= 0.0:
        return f"{sensor.name} at {position_m.round(3).tolist()} m is not above the ground"
    if skin.is_inside(position_m):
        return f"{sensor.name} at {position_m.round(3).tolist()} m is inside the vehicle's body"
    return None


def get_price_eur(prices_eur: Mapping[str, float], sensor_name: str, model: str | None) -> float:
    """Return the price of a sensor with its mount.

    Args:
        prices_eur: Prices by LiDAR model, by name of a sensor, and of "mount".
        sensor_name: Name of the sensor.
        model: LiDAR model of the sensor; its price is taken before that of the name.

    Raises:
        ValueError: The sensor has no price.

    Example:
        >>> get_price_eur({"velodyne_vlp16": 3000.0, "mount": 100.0}, "roof", "velodyne_vlp16")
        3100.0
    """
    key = sensor_name if model is None or model not in prices_eur else model
    if key not in prices_eur:
        raise ValueError(f"prices_eur: {model or sensor_name!r} of the sensor {sensor_name!r} has no price; add it")
    return prices_eur[key] + prices_eur.get(MOUNT, 0.0)


def check_prices(
    prices_eur: Mapping[str, float],
    max_cost_eur: float | None,
    sensors: Sequence[Sensor],
    free_sensors: Mapping[str, FreeSensor],
) -> None:
    """Check that all needed prices exist and that some rig is within the cost limit.

    Args:
        prices_eur: Prices by LiDAR model, by name of a sensor, and of "mount".
        max_cost_eur: Maximum cost of a rig; None without a limit.
        sensors: Sensors of the start.
        free_sensors: Free variables of sensors, by name.

    Raises:
        ValueError: A price is missing or belongs to nothing, or the cheapest rig exceeds the limit.
    """
    if not prices_eur:
        if max_cost_eur is not None:
            raise ValueError("constraints.max_cost_eur: there are no prices; add prices_eur")
        return
    models = set(chain.from_iterable(free.model or () for free in free_sensors.values()))
    names = {MOUNT, *models, *list_builtin_names("lidars"), *(sensor.name for sensor in sensors)}
    if unknown := [key for key in prices_eur if key not in names]:
        raise ValueError(f"prices_eur: {', '.join(unknown)} is no LiDAR model, no sensor of the rig, and not {MOUNT!r}")
    lowest_cost_eur = sum(min(_list_prices(prices_eur, sensor, sensors, free_sensors)) for sensor in sensors)
    if max_cost_eur is not None and lowest_cost_eur > max_cost_eur:
        raise ValueError(
            f"constraints.max_cost_eur: got {max_cost_eur:g}, but the cheapest rig of the space costs "
            f"{lowest_cost_eur:g}; raise it"
        )


def _list_prices(
    prices_eur: Mapping[str, float],
    sensor: Sensor,
    sensors: Sequence[Sensor],
    free_sensors: Mapping[str, FreeSensor],
) -> Iterator[float]:
    """Yield the price of a sensor for each of its models; 0 if it may be absent."""
    free, source = free_sensors.get(sensor.name), sensor
    if free is not None and free.mirror_of is not None:
        source = next(candidate for candidate in sensors if candidate.name == free.mirror_of)
        free = free_sensors[free.mirror_of]
    if free is not None and free.present is not None:
        yield 0.0
    for model in (free.model if free else None) or (getattr(source, "model", None),):
        yield get_price_eur(prices_eur, sensor.name, model)
