"""The Intelligent Driver Model: how hard a driver accelerates behind another.

Treiber, Hennecke and Helbing, "Congested traffic states in empirical observations and microscopic simulations",
Physical Review E 62 (2000). People on foot queue by the same law with other numbers.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from torchcover.geometry.arrays import Float64

FloatOrArray = float | Float64

# What tyres give on a dry road; the model itself would ask for more when somebody appears right ahead.
HARDEST_BRAKING_MPS2 = 9.0
# Two bodies that touch would ask for infinite braking.
SMALLEST_GAP_M = 0.01
# The lorry that slopes are designed for, 120 kg to a kilowatt (AASHTO, "A Policy on Geometric Design of Highways and
# Streets"), with usual rolling resistance, and the drag of 40 t behind 6 m2.
LADEN_W_PER_KG, ROLLING, DRAG_PER_M, GRAVITY_MPS2 = 1000.0 / 120.0, 0.006, 9e-5, 9.81


@dataclass(frozen=True, eq=False)
class Driver:
    """How somebody drives; one number for one driver, or arrays (N,) for N of them.

    Speed and acceleration are those on an empty road, the gap is that in a queue, bumper to bumper, beyond which the
    headway is kept; the deceleration is comfortable.
    """

    desired_speed_mps: FloatOrArray
    headway_s: FloatOrArray = 1.2
    standstill_gap_m: FloatOrArray = 2.0
    acceleration_mps2: FloatOrArray = 1.5
    deceleration_mps2: FloatOrArray = 2.0

    def __post_init__(self) -> None:
        desired = self.desired_speed_mps
        # There are thousands in a world.
        if not (desired > 0.0 if isinstance(desired, float) else np.all(np.asarray(desired) > 0.0)):
            raise ValueError(f"a driver needs a desired speed above 0 m/s; got {self.desired_speed_mps}")

    @classmethod
    def stack(cls, drivers: Sequence["Driver"]) -> "Driver":
        """N drivers as one, with arrays (N,)."""
        return cls(
            *(np.array([getattr(one, name) for one in drivers], np.float64) for name in cls.__dataclass_fields__)
        )

    @cached_property
    def _braking_mps2(self) -> FloatOrArray:
        return 2 * np.sqrt(self.acceleration_mps2 * self.deceleration_mps2)


def compute_gap_ratio(driver: Driver, speed_mps: Float64, gap_m: Float64, closing_speed_mps: Float64) -> Float64:
    """The gap that N drivers would like to have as a multiple of the one that they have, which may be infinite.

    `closing_speed_mps` (N,) is their own speed minus that of the one ahead.
    """
    # In place, here and below: what is written anew has to come from farther away than what was read just now.
    gaps = speed_mps * closing_speed_mps
    gaps /= driver._braking_mps2
    gaps += speed_mps * driver.headway_s
    np.maximum(gaps, 0.0, out=gaps)
    gaps += driver.standstill_gap_m
    gaps /= np.maximum(gap_m, SMALLEST_GAP_M)
    return gaps


def compute_acceleration_mps2(
    driver: Driver, speed_mps: Float64, gap_ratio: Float64, desired_speed_mps: FloatOrArray
) -> Float64:
    """(N,) acceleration of N drivers, at least -9 m/s²; of several things ahead the largest tightness counts.

    `desired_speed_mps` is what they want to drive here: less than elsewhere in a curve.
    """
    wanted = speed_mps / desired_speed_mps
    # To the fourth by products, which are the same on every processor; of powers not even NumPy's own are.
    wanted *= wanted
    wanted *= wanted
    np.subtract(1.0, wanted, out=wanted)
    wanted -= gap_ratio**2
    wanted *= driver.acceleration_mps2
    return np.maximum(wanted, -HARDEST_BRAKING_MPS2, out=wanted)


def compute_max_truck_acceleration_mps2(speed_mps: Float64, slope: Float64) -> Float64:
    """(N,) the hardest that laden lorries accelerate at (N,) speeds up (N,) slopes, by their power.

    Example:
        >>> bool(compute_max_truck_acceleration_mps2(np.array(20.0), np.array(0.04)) < 0.0 < compute_max_truck_acceleration_mps2(np.array(20.0), np.array(0.02)))
        True
    """
    resisted_mps2 = GRAVITY_MPS2 * (slope + ROLLING) + DRAG_PER_M * speed_mps**2
    return np.asarray(LADEN_W_PER_KG / np.maximum(speed_mps, 1.0) - resisted_mps2)


def integrate_motion(
    speed_mps: Float64, acceleration_mps2: Float64, free_distance_m: Float64, time_step_s: float
) -> tuple[Float64, Float64]:
    """(N,) ways in metres and (N,) new speeds after one step of constant acceleration (the ballistic update).

    A driver who comes to a stop within the step stays there instead of driving backwards, and nobody goes farther than
    the room (N,) that was free when the step began: those ahead do not drive backwards either, so no step of any length
    leads through them.
    """
    end_speed = acceleration_mps2 * time_step_s
    end_speed += speed_mps
    (stops,) = (end_speed < 0.0).nonzero()
    end_speed[stops] = 0.0
    way = speed_mps + end_speed
    way /= 2
    way *= time_step_s
    way[stops] = speed_mps[stops] ** 2 / (-2 * acceleration_mps2[stops])
    room = np.maximum(free_distance_m, 0.0)
    end_speed[way > room] = 0.0
    return np.minimum(way, room, out=way), end_speed
