"""The ground: one sheet without seams through all streets, and how whoever stands on it is tilted."""

import numpy as np
from numpy.typing import NDArray

from torchcover.simulation.height_field import CELL_M, MARGIN_M, Ground, Plain, Slopes, corners_of, middles_m, spread
from torchcover.simulation.sumo.vicinity import Vicinity

Numbers = NDArray[np.float64]

# Rounds of smoothing between the streets, at each scale; the streets' own heights stay.
SMOOTHINGS = 4


def ground_of(vicinity: Vicinity) -> Plain | Slopes:
    """The ground around the ego's way: plain if all lanes are of one height, else through all that are no bridges.

    Raises:
        ValueError: The way is so long that the ground would have more than four million corners.
    """
    lower_m, upper_m = vicinity.lower_m - MARGIN_M, vicinity.upper_m + MARGIN_M
    places_m = vicinity.samples_m[~vicinity.on_deck]
    if np.ptp(vicinity.samples_m[:, 2]) == 0.0:
        return Plain(float(places_m[0, 2]), lower_m, upper_m)
    rows, columns = corners_of(lower_m, upper_m)
    total, weight = spread((places_m[:, :2] - lower_m) / CELL_M, places_m[:, 2], rows, columns)
    wanted = vicinity.sees(middles_m(lower_m, rows, columns)).reshape(rows - 1, columns - 1)
    return Slopes(lower_m, _filled(total, weight), wanted)


def _filled(total: Numbers, weight: Numbers) -> Numbers:
    """Means where there is a weight; elsewhere what a raster of half the size has, smoothed."""
    known = weight > 0
    means: Numbers = total / np.where(known, weight, 1.0)
    if known.all() or min(means.shape) < 2:
        return means if known.any() else np.zeros_like(means)
    padding = [(0, size % 2) for size in means.shape]
    halves = []
    for raster in (total, weight):
        even = np.pad(raster, padding)
        halves.append(even.reshape(even.shape[0] // 2, 2, -1, 2).sum(axis=(1, 3)))
    coarse = _filled(halves[0], halves[1])
    found = np.where(known, means, coarse.repeat(2, axis=0).repeat(2, axis=1)[: means.shape[0], : means.shape[1]])
    for _ in range(SMOOTHINGS):
        around = np.pad(found, 1, mode="edge")
        mean = (around[:-2, 1:-1] + around[2:, 1:-1] + around[1:-1, :-2] + around[1:-1, 2:]) / 4
        found = np.where(known, found, mean)
    return found


def tilts_deg(ground: Ground, places_m: Numbers, yaw_deg: Numbers, size_m: tuple[float, float]) -> Numbers:
    """(N, 2) pitch and roll of bodies of a length and width, with the middle at (N, 2) places, on the ground."""
    yaw = np.deg2rad(yaw_deg)
    forward = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    left = np.stack([-forward[:, 1], forward[:, 0]], axis=1)
    rises = [
        ground.heights_m(places_m + half * way) - ground.heights_m(places_m - half * way)
        for way, half in ((forward, size_m[0] / 3), (left, size_m[1] / 2))
    ]
    # Up at the front is a negative pitch; up at the left lowers the right side.
    pitch, roll = np.arctan2(-rises[0], 2 * size_m[0] / 3), np.arctan2(rises[1], size_m[1])
    tilts: Numbers = np.rad2deg(np.stack([pitch, roll], axis=1))
    return tilts
