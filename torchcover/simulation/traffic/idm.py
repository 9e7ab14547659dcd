"""Intelligent Driver Model (IDM): longitudinal acceleration of a driver behind another road user.

Treiber, Hennecke and Helbing, "Congested traffic states in empirical observations and microscopic simulations",
Physical Review E 62 (2000). Pedestrians queue by the same law with other parameters.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from torchcover.geometry.arrays import Float64

FloatOrArray = float | Float64


@dataclass(frozen=True)
class AccelerationLimits:
    """Limits that keep the accelerations of the model finite and physical.

    Args:
        max_braking_mps2: Largest deceleration: the grip of tires on a dry road. The model alone asks for more when a
            road user appears directly ahead.
        min_gap_m: Smallest gap that the model divides by; vehicles that touch would demand infinite braking.
    """

    max_braking_mps2: float = 9.0
    min_gap_m: float = 0.01


@dataclass(frozen=True)
class TruckParams:
    """Laden truck that limits the speed on grades.

    Args:
        power_w_per_kg: Engine power per mass: the truck of 120 kg/kW that slopes are designed for (AASHTO, "A Policy on
            Geometric Design of Highways and Streets").
        rolling_resistance: Usual rolling resistance coefficient of truck tires.
        drag_per_m: Air drag per mass and squared speed in 1/m, of 40 t behind a front of 6 m2.
        gravity_mps2: Gravitational acceleration.
    """

    power_w_per_kg: float = 1000.0 / 120.0
    rolling_resistance: float = 0.006
    drag_per_m: float = 9e-5
    gravity_mps2: float = 9.81


@dataclass(frozen=True, eq=False)
class Driver:
    """Parameters of one driver (numbers) or of N drivers (arrays (N,)).

    Args:
        desired_speed_mps: Speed on an empty road; must be positive.
        headway_s: Time gap to the vehicle ahead, in addition to `standstill_gap_m`.
        standstill_gap_m: Gap in a standing queue, bumper to bumper.
        acceleration_mps2: Acceleration from standstill on an empty road.
        deceleration_mps2: Comfortable deceleration.

    Example:
        >>> Driver.stack([Driver(10.0), Driver(14.0)]).desired_speed_mps
        array([10., 14.])
    """

    desired_speed_mps: FloatOrArray
    headway_s: FloatOrArray = 1.2
    standstill_gap_m: FloatOrArray = 2.0
    acceleration_mps2: FloatOrArray = 1.5
    deceleration_mps2: FloatOrArray = 2.0

    def __post_init__(self) -> None:
        desired = self.desired_speed_mps
        # A scene has thousands of drivers: the comparison of a float avoids an array for each of them.
        is_positive = desired > 0.0 if isinstance(desired, float) else np.all(np.asarray(desired) > 0.0)
        if not is_positive:
            raise ValueError(f"a driver needs a desired speed above 0 m/s; got {self.desired_speed_mps}")

    @classmethod
    def stack(cls, drivers: Sequence["Driver"]) -> "Driver":
        """Combine N drivers into one object with arrays (N,)."""
        columns = {}
        for name in cls.__dataclass_fields__:
            columns[name] = np.array([getattr(driver, name) for driver in drivers], np.float64)
        return cls(**columns)

    @cached_property
    def _interaction_mps2(self) -> FloatOrArray:
        return 2 * np.sqrt(self.acceleration_mps2 * self.deceleration_mps2)


def compute_gap_ratio(
    driver: Driver,
    speed_mps: Float64,
    gap_m: Float64,
    closing_speed_mps: Float64,
    limits: AccelerationLimits = AccelerationLimits(),
) -> Float64:
    """Compute the desired gap of N drivers divided by their actual gap.

    Args:
        driver: Parameters of the N drivers.
        speed_mps: (N,) speeds.
        gap_m: (N,) gaps to the road user or stop line ahead; may be infinite.
        closing_speed_mps: (N,) own speed minus the speed of the road user ahead.
        limits: Smallest gap that counts.

    Returns:
        (N,) ratios; 0 for an infinite gap.
    """
    # Arrays are updated in place, here and below: new arrays would have to come from slower memory.
    gaps = speed_mps * closing_speed_mps
    gaps /= driver._interaction_mps2
    gaps += speed_mps * driver.headway_s
    np.maximum(gaps, 0.0, out=gaps)
    gaps += driver.standstill_gap_m
    gaps /= np.maximum(gap_m, limits.min_gap_m)
    return gaps


def compute_acceleration_mps2(
    driver: Driver,
    speed_mps: Float64,
    gap_ratio: Float64,
    desired_speed_mps: FloatOrArray,
    limits: AccelerationLimits = AccelerationLimits(),
) -> Float64:
    """Compute the acceleration of N drivers.

    Args:
        driver: Parameters of the N drivers.
        speed_mps: (N,) speeds.
        gap_ratio: (N,) ratios from `compute_gap_ratio`; the largest one if there are several obstacles ahead.
        desired_speed_mps: Desired speed at this position, which is lower in a curve than elsewhere.
        limits: Largest deceleration.

    Returns:
        (N,) accelerations, at least `-limits.max_braking_mps2`.
    """
    speed_ratio = speed_mps / desired_speed_mps
    # Products give the same fourth power on every processor; the powers of NumPy do not.
    speed_ratio *= speed_ratio
    speed_ratio *= speed_ratio
    acceleration_mps2 = np.subtract(1.0, speed_ratio, out=speed_ratio)
    acceleration_mps2 -= gap_ratio**2
    acceleration_mps2 *= driver.acceleration_mps2
    return np.maximum(acceleration_mps2, -limits.max_braking_mps2, out=acceleration_mps2)


def compute_max_truck_acceleration_mps2(
    speed_mps: Float64, slope: Float64, params: TruckParams = TruckParams()
) -> Float64:
    """Compute the largest acceleration that the engine power of a laden truck permits.

    Args:
        speed_mps: (N,) speeds.
        slope: (N,) slopes, positive uphill.
        params: Power and resistance of the truck.

    Returns:
        (N,) accelerations; negative where the truck cannot hold its speed.

    Example:
        >>> speed_mps = np.array(20.0)
        >>> bool(compute_max_truck_acceleration_mps2(speed_mps, np.array(0.04)) < 0.0)
        True
    """
    resistance_mps2 = params.gravity_mps2 * (slope + params.rolling_resistance) + params.drag_per_m * speed_mps**2
    return np.asarray(params.power_w_per_kg / np.maximum(speed_mps, 1.0) - resistance_mps2)


def integrate_motion(
    speed_mps: Float64, acceleration_mps2: Float64, free_distance_m: Float64, time_step_s: float
) -> tuple[Float64, Float64]:
    """Integrate one time step of constant acceleration (the ballistic update).

    A driver who stops within the step stays there instead of driving backwards. No driver goes farther than the
    distance that was free when the step began, so that a step of any length leads through no other road user.

    Args:
        speed_mps: (N,) speeds at the beginning of the step.
        acceleration_mps2: (N,) accelerations.
        free_distance_m: (N,) distances to the road user ahead.
        time_step_s: Duration of the step.

    Returns:
        (N,) distances in meters and (N,) speeds at the end of the step.
    """
    end_speed_mps = acceleration_mps2 * time_step_s
    end_speed_mps += speed_mps
    (stopping,) = (end_speed_mps < 0.0).nonzero()
    end_speed_mps[stopping] = 0.0
    distance_m = speed_mps + end_speed_mps
    distance_m /= 2
    distance_m *= time_step_s
    distance_m[stopping] = speed_mps[stopping] ** 2 / (-2 * acceleration_mps2[stopping])
    max_distance_m = np.maximum(free_distance_m, 0.0)
    end_speed_mps[distance_m > max_distance_m] = 0.0
    return np.minimum(distance_m, max_distance_m, out=distance_m), end_speed_mps
