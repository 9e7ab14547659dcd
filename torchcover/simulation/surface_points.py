"""Points drawn evenly over a surface, stratified by boxes."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.simulation.patches import Bounds, Patches

Bools = NDArray[np.bool_]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Numbers = NDArray[np.int64]

# Patches are looked up with this much to spare: drawn points are rounded to float32.
SLACK_M = 1e-3
# Steps of a sequence in the plane whose points keep apart, whatever their number (Roberts 2018, "R2").
PLANE_STEPS = (0.7548776662466927, 0.5698402909980532)
# Where a stratum holds little of its patches, at most this many points are drawn for one that is wanted.
MOST_DRAWN = 16.0


class SurfacePoints(NamedTuple):
    """K points of a surface.

    `points_m` (K, 3) where; `normals` (K, 3) of length one on the side from which they are looked at; `per_m2` (K,) how
    many points a square metre was given there, from all strata together.
    """

    points_m: Float32
    normals: Float32
    per_m2: Float64


class SurfaceStrata:
    """A surface, ready to draw points from: evenly within each of some boxes, which may overlap.

    Args:
        patches: The surface in the frame of the boxes.
        boxes: The strata, half-open: lower bounds belong to them.
    """

    def __init__(self, patches: Patches, boxes: Bounds) -> None:
        self._patches = patches
        self._boxes = boxes
        normals = patches.normals_m2
        twice_m2 = np.sqrt((normals**2).sum(axis=0))
        self._m2 = twice_m2.astype(np.float64) / 2
        self._normals = normals / np.maximum(twice_m2, np.finfo(np.float32).tiny)
        lower_m, upper_m = patches.lower_m - np.float32(SLACK_M), patches.upper_m + np.float32(SLACK_M)
        self._within = [_within(lower_m, upper_m, *box) for box in zip(*boxes, strict=True)]

    def draw(self, place_m: Float64, each: float, generator: np.random.Generator) -> SurfacePoints:
        """Points on the patches that a place is in front of.

        Args:
            place_m: (3,) the place.
            each: About how many points each stratum gets; if it is below 1, one with this probability.
            generator: Source of the random numbers.
        """
        height_m = (self._normals * (place_m.astype(np.float32)[:, None] - self._patches.corner_m)).sum(axis=0)
        front = (height_m > 0) | (~self._patches.outward & (height_m < 0))
        stratum, patch, per_m2 = [], [], np.zeros(len(self._within))
        for k, (numbers, share) in enumerate(self._within):
            kept = front[numbers]
            drawn, per_m2[k] = _drawn(self._m2[numbers[kept]], share[kept], each, generator)
            patch.append(numbers[kept][drawn])
            stratum.append(np.full(len(drawn), k))
        return self._points(np.concatenate(patch), np.concatenate(stratum), per_m2, height_m, generator)

    def _points(
        self, patch: Numbers, stratum: Numbers, per_m2: Float64, height_m: Float32, generator: np.random.Generator
    ) -> SurfacePoints:
        """One point on each of the patches, if it lies in its stratum."""
        start = generator.random((2, 1))
        a, b = ((start + np.arange(len(patch)) * np.array(PLANE_STEPS)[:, None]) % 1).astype(np.float32)
        beyond = a + b > 1
        a, b = np.where(beyond, 1 - a, a), np.where(beyond, 1 - b, b)
        corner_m, first_m, second_m, _ = self._patches.taken(patch)
        points_m = (corner_m + a * first_m + b * second_m).T
        inside = np.stack([((points_m >= low) & (points_m < high)).all(axis=1) for low, high in zip(*self._boxes)])
        kept = inside[stratum, np.arange(len(patch))]
        patch = patch[kept]
        return SurfacePoints(
            np.ascontiguousarray(points_m[kept]),
            (self._normals[:, patch] * np.sign(height_m[patch])).T,
            per_m2 @ inside[:, kept],
        )


def _within(lower_m: Float32, upper_m: Float32, low: Float64, high: Float64) -> tuple[Numbers, Float64]:
    """Numbers of the patches that may meet a box, and about which share of each lies in it, judged by its own box."""
    numbers = np.arange(lower_m.shape[1])
    share = np.ones(lower_m.shape[1])
    for axis in (0, 1, 2):
        from_m, to_m = lower_m[axis, numbers], upper_m[axis, numbers]
        kept = (to_m >= low[axis]) & (from_m <= high[axis])
        numbers, from_m, to_m = numbers[kept], from_m[kept], to_m[kept]
        share = share[kept] * (np.minimum(to_m, high[axis]) - np.maximum(from_m, low[axis])) / (to_m - from_m)
    return numbers, share


def _drawn(m2: Float64, share: Float64, each: float, generator: np.random.Generator) -> tuple[Numbers, float]:
    """Numbers of patches, drawn by their area so that about `each` points lie in the stratum, and points per m2."""
    up_to_m2 = np.cumsum(m2)
    whole_m2 = float(up_to_m2[-1]) if len(m2) else 0.0
    if whole_m2 == 0:
        return np.empty(0, dtype=np.int64), 0.0
    wanted = each * min(whole_m2 / max(float(m2 @ share), whole_m2 / MOST_DRAWN), MOST_DRAWN)
    expected = float(round(wanted)) if wanted >= 1 else wanted
    count = int(expected + generator.random())
    # One in each of as many equal parts of the area: the order of patches is one of places.
    at_m2 = (np.arange(count) + generator.random(count)) / max(count, 1) * whole_m2
    numbers = np.minimum(np.searchsorted(up_to_m2, at_m2, side="right"), len(m2) - 1)
    return numbers.astype(np.int64), expected / whole_m2
