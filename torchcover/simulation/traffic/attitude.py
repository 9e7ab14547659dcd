"""How the ego's body tilts: with braking and starting, with curves, and with the road."""

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.float64]

# A soft-sprung passenger car: it dives by some 3 degrees at 1 g, and leans a little more in a curve.
PITCH_DEG_PER_MPS2 = 0.3
ROLL_DEG_PER_MPS2 = 0.4
# The springs do not go farther, and bumpers sit on the axles behind them.
MAX_SPRING_PITCH_DEG, MAX_SPRING_ROLL_DEG = 1.5, 1.1
SPRING_TIME_S = 0.35
# Unevenness of a road: shares of one bump's angle at wavelengths from a patch to a long swell.
WAVELENGTHS_M = np.array([9.0, 17.0, 37.0, 71.0])
PITCH_WAVES_DEG = np.array([0.08, 0.10, 0.10, 0.10])
ROLL_WAVES_DEG = np.array([0.06, 0.08, 0.10, 0.14])


def attitude(
    times_s: Numbers, way_m: Numbers, speed_mps: Numbers, yaw_deg: Numbers, generator: np.random.Generator
) -> Numbers:
    """Yaw, pitch and roll of a car about the point on the road under its middle.

    The wheels of a car pivot about a point midway between the axles, so a pitch of 1 degree lifts or lowers them by
    under 3 cm: the springs' stroke, which a rigid body has to show at its wheels. |pitch| < 2 and |roll| < 1.5 degrees.

    Args:
        times_s: (T,) evenly spaced times.
        way_m: (T,) way driven; the road's unevenness depends on it alone, so a standing car does not rock.
        speed_mps: (T,) speed.
        yaw_deg: (T,) heading.
        generator: Draws the unevenness of the road.

    Returns:
        (T, 3) yaw, pitch and roll in degrees. Braking turns the nose down (positive pitch); in a left-hand curve the
        right side goes down (positive roll).
    """
    forward = np.gradient(speed_mps, times_s)
    leftward = speed_mps * np.gradient(np.unwrap(np.deg2rad(yaw_deg)), times_s)
    pitch = _limit(-PITCH_DEG_PER_MPS2 * forward, MAX_SPRING_PITCH_DEG)
    roll = _limit(ROLL_DEG_PER_MPS2 * leftward, MAX_SPRING_ROLL_DEG)
    pitch = _settle(times_s, pitch) + _unevenness(way_m, PITCH_WAVES_DEG, generator)
    roll = _settle(times_s, roll) + _unevenness(way_m, ROLL_WAVES_DEG, generator)
    return np.stack([yaw_deg, pitch, roll], axis=1)


def _limit(angle_deg: Numbers, largest_deg: float) -> Numbers:
    return largest_deg * np.tanh(angle_deg / largest_deg)


def _settle(times_s: Numbers, wanted_deg: Numbers) -> Numbers:
    """Follow the wanted angle with the delay of a damped spring (a first-order low pass, exact for each step)."""
    share = 1.0 - np.exp(-np.diff(times_s) / SPRING_TIME_S)
    settled = wanted_deg.copy()
    for step, part in enumerate(share):
        settled[step + 1] = settled[step] + part * (wanted_deg[step + 1] - settled[step])
    return settled


def _unevenness(way_m: Numbers, waves_deg: Numbers, generator: np.random.Generator) -> Numbers:
    phase = generator.uniform(0, 2 * np.pi, size=len(WAVELENGTHS_M))
    return np.asarray(np.sin(2 * np.pi * way_m[:, None] / WAVELENGTHS_M + phase) @ waves_deg)
