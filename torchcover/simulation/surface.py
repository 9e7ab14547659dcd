"""The surface of a world, cut small once; what is near the vehicle is looked up at every step."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import invert, transform
from torchcover.simulation.instant import Instant
from torchcover.simulation.patches import Bounds, Patches
from torchcover.simulation.shapes import Mesh

Float64 = NDArray[np.float64]
Numbers = NDArray[np.int64]

# Side of the squares of the ground by which patches are looked up.
CELL_M = 16.0
# A drive is followed by boxes around stretches of it of this length.
STRETCH_M = 100.0
# Boxes are grown by this much for the rounding of float32 coordinates.
SLACK_M = 0.01


class Cells(NamedTuple):
    """C groups of neighbouring patches.

    `first` (C + 1,) number of the first patch of each, and of all; `bounds` (C boxes) what they fill.
    """

    first: Numbers
    bounds: Bounds


class Surface:
    """The surface of what never moves, in the order of places on the ground, and of each body that moves.

    Args:
        static: What never moves, without the ego, in the frame of the ray caster of it.
        moving: The bodies that move, by number, in their own frames; bodies of one kind share one mesh object.
        bounds: Boxes in the frame of what never moves, outside of which it is never asked for.
    """

    def __init__(self, static: Sequence[Mesh], moving: dict[int, Mesh], bounds: Bounds) -> None:
        patches = Patches.joined([Patches.of(mesh, bounds) for mesh in static])
        order, cell = _by_place(patches)
        self._static = patches.taken(order)
        self._cells = _cells(self._static, cell)
        kinds = {id(mesh): Patches.of(mesh) for mesh in {id(mesh): mesh for mesh in moving.values()}.values()}
        self._moving = {body: kinds[id(mesh)] for body, mesh in moving.items()}

    def near(self, instant: Instant, boxes: Bounds) -> Patches:
        """The patches that may meet boxes of the vehicle frame, in that frame, and some that do not.

        Args:
            instant: The scene at one time.
            boxes: In the vehicle frame.
        """
        vehicle_T_static = invert(instant.static_T_vehicle)
        cells = np.flatnonzero(boxes.meet(*_moved_bounds(vehicle_T_static, self._cells.bounds)))
        near = [self._static.taken(_ranges(self._cells.first[cells], self._cells.first[cells + 1]))]
        near[0] = near[0].moved(vehicle_T_static)
        bodies = [part for part in instant.moving if part.body != instant.ego]
        centres_m = np.array([part.centre_m for part in bodies]).reshape(-1, 3)
        radii_m = np.array([part.radius_m for part in bodies])[:, None]
        for k in np.flatnonzero(boxes.meet(centres_m - radii_m, centres_m + radii_m)).tolist():
            near.append(self._moving[bodies[k].body].moved(invert(bodies[k].part_T_vehicle)))
        return Patches.joined(near)


def bounds_along(static_T_vehicle: Float64, box: Bounds) -> Bounds:
    """Upright boxes in a frame that holds the drive of a vehicle, around all places of a box that it carries along.

    Args:
        static_T_vehicle: (T, 4, 4) poses of the vehicle, one after the other.
        box: One box in the vehicle frame.
    """
    lower_m, upper_m = (
        np.concatenate(side) for side in zip(*(_moved_bounds(pose, box) for pose in static_T_vehicle), strict=True)
    )
    way_m = np.cumsum(np.linalg.norm(np.diff(static_T_vehicle[:, :3, 3], axis=0, prepend=0), axis=1))
    first = np.flatnonzero(np.diff(way_m // STRETCH_M, prepend=-1))
    lower_m, upper_m = np.minimum.reduceat(lower_m, first), np.maximum.reduceat(upper_m, first)
    return Bounds(lower_m - SLACK_M, upper_m + SLACK_M)


def _by_place(patches: Patches) -> tuple[Numbers, Numbers]:
    """The order in which neighbours on the ground follow each other, and the cell of each patch in that order."""
    if patches.outward.size == 0:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    middle_m = (patches.corner_m + (patches.first_m + patches.second_m) / 3)[:2]
    # To a metre: a million on a side are enough for any drive.
    place = np.clip(middle_m - middle_m.min(axis=1, keepdims=True), 0, 2**20).astype(np.int64)
    cell = _interleaved(place // int(CELL_M))
    order = np.lexsort((_interleaved(place), cell))
    return order, cell[order]


def _interleaved(place: Numbers) -> Numbers:
    """(N,) numbers along a curve on which (2, N) places with coordinates below 2^21 are near what is near to them."""
    spread = place
    for bits, mask in ((16, 0x0000FFFF0000FFFF), (8, 0x00FF00FF00FF00FF), (4, 0x0F0F0F0F0F0F0F0F)):
        spread = (spread | (spread << bits)) & mask
    for bits, mask in ((2, 0x3333333333333333), (1, 0x5555555555555555)):
        spread = (spread | (spread << bits)) & mask
    interleaved: Numbers = spread[0] | (spread[1] << 1)
    return interleaved


def _cells(patches: Patches, cell: Numbers) -> Cells:
    first = np.flatnonzero(np.diff(cell, prepend=-1))
    if len(first) == 0:
        return Cells(np.zeros(1, dtype=np.int64), Bounds(np.empty((0, 3)), np.empty((0, 3))))
    lower_m = np.minimum.reduceat(patches.lower_m, first, axis=1).T.astype(np.float64)
    upper_m = np.maximum.reduceat(patches.upper_m, first, axis=1).T.astype(np.float64)
    return Cells(np.append(first, len(cell)), Bounds(lower_m - SLACK_M, upper_m + SLACK_M))


def _ranges(first: Numbers, end: Numbers) -> Numbers:
    """The numbers from each first to before each end, one range after the other."""
    count = end - first
    return np.repeat(first - np.concatenate([[0], np.cumsum(count)[:-1]]), count) + np.arange(count.sum())


def _moved_bounds(destination_T_source: Float64, bounds: Bounds) -> tuple[Float64, Float64]:
    """Upright boxes in another frame around boxes that were upright in theirs."""
    middle_m = transform(destination_T_source, (bounds.lower_m + bounds.upper_m) / 2)
    half_m = (bounds.upper_m - bounds.lower_m) / 2 @ np.abs(destination_T_source[:3, :3]).T
    return middle_m - half_m, middle_m + half_m
