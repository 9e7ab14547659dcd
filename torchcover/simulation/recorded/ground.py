"""Ground below recorded tracks: a height field through the places on which road users stood."""

from collections.abc import Callable, Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from torchcover.simulation.height_field import CELL_M, MARGIN_M, Plain, Slopes, corners_of, middles_m, spread
from torchcover.simulation.traffic.assemble import HORIZON_M

Numbers = NDArray[np.float64]
Heights = Callable[[Numbers], Numbers]

# Squares a little beyond what is seen are built, so that none ends in sight; bodies are as long as this.
BEYOND_M = 25.0
# Somebody who stays where it is counts once in so many metres, however long it was watched.
STAYS_M = 1.0
# From coarse to fine: each scale takes what the one before left over.
SCALES = tuple(CELL_M * factor for factor in (16.0, 8.0, 4.0, 2.0, 1.0))
ROUNDS = 4
# Somebody farther off than this share of a scale's square, above what all about it stand on, counts for nothing: it is
# on a bridge or on stairs, or its box is wrong. No street is so steep.
STEEPEST = 0.15
# What a corner of the raster needs, in people that stand on it, to be believed by half.
DOUBT = 0.01
# A plane through places that are hardly wider than this may not lean to their side.
NARROW_M = 3.0


def ground_below(places_m: Numbers, ego_m: Numbers) -> Plain | Slopes:
    """The ground around the ego's way: plain if everybody stands at one height.

    Args:
        places_m: (N, 3) on which others stood; some may be wrong.
        ego_m: (T, 3) on which the ego stood: these are believed.

    Raises:
        ValueError: The way is so long that the ground would have more than four million corners.
    """
    margin_m = HORIZON_M + MARGIN_M
    lower_m, upper_m = ego_m[:, :2].min(axis=0) - margin_m, ego_m[:, :2].max(axis=0) + margin_m
    # From the first corner, in float64: the places may be of UTM size.
    places_m = np.concatenate([ego_m, places_m])
    trusted = np.arange(len(places_m)) < len(ego_m)
    base_m = float(ego_m[0, 2])
    if (places_m[:, 2] == base_m).all():
        return Plain(base_m, lower_m, upper_m)
    inside = ((places_m[:, :2] > lower_m) & (places_m[:, :2] < upper_m)).all(axis=1)
    across_m, heights_m = places_m[inside, :2] - lower_m, places_m[inside, 2] - base_m
    rows, columns = corners_of(lower_m, upper_m)
    fitted = fit(across_m, heights_m, trusted[inside], upper_m - lower_m)
    corners: Numbers = CELL_M * np.indices((rows, columns))[::-1].reshape(2, -1).T.astype(np.float64)
    way_m = ego_m[:, :2] if len(ego_m) > 1 else np.repeat(ego_m[:, :2], 2, axis=0)
    way = shapely.LineString(way_m - lower_m).simplify(0.5)
    shapely.prepare(way)
    seen = shapely.dwithin(shapely.points(middles_m(np.zeros(2), rows, columns)), way, HORIZON_M + BEYOND_M)
    return Slopes(lower_m, base_m + fitted(corners).reshape(rows, columns), seen.reshape(rows - 1, columns - 1))


def thinned(places_m: Numbers) -> Numbers:
    """(N, 3) the middle of each stay of (K, 3) places that follow each other."""
    way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places_m[:, :2], axis=0), axis=1))])
    stay = np.cumsum(np.diff(way_m // STAYS_M, prepend=0.0) > 0)
    count = np.bincount(stay)
    sums = [np.bincount(stay, axis) for axis in (places_m - places_m[0]).T]
    middles: Numbers = places_m[0] + np.stack(sums, axis=1) / count[:, None]
    return middles


def fit(across_m: Numbers, heights_m: Numbers, trusted: NDArray[np.bool_], size_m: Numbers) -> Heights:
    """Heights everywhere, through most of (N, 2) places.

    A plane that goes on level beyond the places, and on it, from coarse to fine, what is left over.

    Args:
        across_m: The places.
        heights_m: (N,) their heights.
        trusted: (N,) which ones are right for sure.
        size_m: (2,) how far the raster reaches from 0.
    """
    weights = np.ones(len(heights_m))
    plane = _plane(across_m, heights_m, weights)
    for _ in range(ROUNDS):
        weights = _weights(heights_m - plane(across_m), trusted, 2 * SCALES[0])
        plane = _plane(across_m, heights_m, weights)
    layers: list[Heights] = [plane]
    left_m = heights_m - plane(across_m)
    for scale_m in SCALES:
        weights = _weights(left_m, trusted, scale_m)
        for _ in range(ROUNDS):
            layer = _layer(across_m, left_m, weights, scale_m, size_m)
            weights = _weights(left_m - layer(across_m), trusted, scale_m)
        layers.append(layer)
        left_m = left_m - layer(across_m)
    return lambda places_m: np.sum([layer(places_m) for layer in layers], axis=0)


def _weights(left_m: Numbers, trusted: NDArray[np.bool_], scale_m: float) -> Numbers:
    """Tukey's: (N,) 1 for whom nothing is left over, 0 for whom it is too much."""
    weights: Numbers = np.where(trusted, 1.0, np.clip(1.0 - (left_m / (STEEPEST * scale_m)) ** 2, 0.0, 1.0) ** 2)
    return weights


def _plane(across_m: Numbers, heights_m: Numbers, weights: Numbers) -> Heights:
    """Least squares; level beyond the places."""
    middle_m = np.average(across_m, axis=0, weights=weights)
    height_m = float(np.average(heights_m, weights=weights))
    apart_m = across_m - middle_m
    spread_m2 = (weights[:, None] * apart_m).T @ apart_m / weights.sum() + NARROW_M**2 * np.eye(2)
    slope = np.linalg.solve(spread_m2, (weights * (heights_m - height_m)) @ apart_m / weights.sum())
    lower_m, upper_m = across_m.min(axis=0), across_m.max(axis=0)
    return lambda places_m: height_m + (np.clip(places_m, lower_m, upper_m) - middle_m) @ slope


def _layer(across_m: Numbers, left_m: Numbers, weights: Numbers, scale_m: float, size_m: Numbers) -> Heights:
    """The raster of one scale: 0 where nobody stands."""
    first_m = np.full(2, -2 * scale_m)
    columns, rows = (np.ceil(size_m / scale_m).astype(np.int64) + 5).tolist()
    total, weight = spread((across_m - first_m) / scale_m, left_m, rows, columns, weights)
    return Slopes(first_m, total / (weight + DOUBT), np.empty((0, 0), dtype=bool), scale_m).heights_m


def stood_on(tracks: Sequence[Numbers]) -> Numbers:
    """(N, 3) all the places of some tracks, (K, 3) each, that say something new."""
    return np.concatenate([np.empty((0, 3)), *map(thinned, tracks)])
