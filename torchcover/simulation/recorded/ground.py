"""Ground below recorded tracks: a height field through the places on which road users stood."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import shapely

from torchcover.geometry import fitted
from torchcover.geometry.arrays import Float64
from torchcover.simulation.height_field import CELL_M, MARGIN_M, Plain, Slopes, corners_of, middles_m
from torchcover.simulation.traffic.assemble import HORIZON_M
from torchcover.simulation.world import Actor

# Squares a little beyond what is seen are built, so that none ends in sight; bodies are as long as this.
BEYOND_M = 25.0
# Somebody who stays where it is counts once in so many metres, however long it was watched.
STAYS_M = 1.0
# Wheels are so far apart, as shares of the body; and what lies to the left of a direction.
WHEELS = 0.6
LEFT_OF = np.array([[0.0, 1.0], [-1.0, 0.0]])
SCALES_M = tuple(CELL_M * factor for factor in (16.0, 8.0, 4.0, 2.0, 1.0))


def ground_below(places_m: Float64, ego_m: Float64) -> Plain | Slopes:
    """The ground around the ego's way: plain if everybody stands at one height.

    The (T, 3) places on which the ego stood are believed; of the (N, 3) of others some may be wrong.
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
    across_m, over_m = places_m[inside, :2] - lower_m, places_m[inside, 2] - base_m
    rows, columns = corners_of(lower_m, upper_m)
    field = fitted(across_m, over_m, upper_m - lower_m, SCALES_M, trusted=trusted[inside])
    corners: Float64 = CELL_M * np.indices((rows, columns))[::-1].reshape(2, -1).T.astype(np.float64)
    way_m = ego_m[:, :2] if len(ego_m) > 1 else np.repeat(ego_m[:, :2], 2, axis=0)
    way = shapely.LineString(way_m - lower_m).simplify(0.5)
    shapely.prepare(way)
    seen = shapely.dwithin(shapely.points(middles_m(np.zeros(2), rows, columns)), way, HORIZON_M + BEYOND_M)
    return Slopes(
        lower_m, base_m + field.heights_m(corners).reshape(rows, columns), seen.reshape(rows - 1, columns - 1)
    )


def thinned(places_m: Float64) -> Float64:
    """(N, 3) the middle of each stay of (K, 3) places that follow each other."""
    way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places_m[:, :2], axis=0), axis=1))])
    stay = np.cumsum(np.diff(way_m // STAYS_M, prepend=0.0) > 0)
    count = np.bincount(stay)
    sums = [np.bincount(stay, axis) for axis in (places_m - places_m[0]).T]
    return np.asarray(places_m[0] + np.stack(sums, axis=1) / count[:, None])


def stood_on(tracks: Sequence[Float64]) -> Float64:
    """(N, 3) all the places of some tracks, (K, 3) each, that say something new."""
    return np.concatenate([np.empty((0, 3)), *map(thinned, tracks)])


def tilted(body: Actor, ground: Plain | Slopes) -> Actor:
    """The body with the slope of the ground below its wheels, if its own was not recorded; people stand upright."""
    own = body.trajectory
    if isinstance(ground, Plain) or body.category == "pedestrian" or own.angles_deg[:, 1:].any():
        return body
    angles_deg, yaw = own.angles_deg.copy(), np.deg2rad(own.angles_deg[:, 0])
    ahead, (length, width, _) = np.stack([np.cos(yaw), np.sin(yaw)], axis=1), np.ptp(body.mesh.vertices_m, axis=0)
    for axis, way, apart_m, sign in ((1, ahead, WHEELS * length, -1), (2, ahead @ LEFT_OF, WHEELS * width, 1)):
        over_m, under_m = (ground.heights_m(own.positions_m[:, :2] + end * apart_m / 2 * way) for end in (1, -1))
        angles_deg[:, axis] = sign * np.rad2deg(np.arctan((over_m - under_m) / apart_m))
    return replace(body, trajectory=replace(own, angles_deg=angles_deg))
