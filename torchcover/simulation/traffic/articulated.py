"""Vehicles in two parts, of which the one draws the other along at a hitch, and how what is drawn along follows."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import BoundingBox
from torchcover.simulation.bodies import Vehicle, merge
from torchcover.simulation.shapes import Mesh

Numbers = NDArray[np.float64]

# Where built-in vehicles have their kingpin, and the middle axle of those behind it, in metres along x. At the limits
# of EU Directive 96/53/EC the kingpin is 12 m before the rear end, and the trailer's front turns 2.04 m around it.
HITCHES_M: Mapping[str, tuple[float, float]] = {"truck": (3.75, -4.66)}


class Articulated(NamedTuple):
    """A vehicle in two parts, each with the origin on the ground under its middle.

    Args:
        front: What draws.
        rear: What is drawn along; its axles never slip sideways.
        ahead_m: How far the middle of the front is before that of both.
        hitch_m: How far the hitch is before the middle of the front; negative behind it.
        rod_m: From the hitch back to the axles of the rear part.
        middle_m: From the hitch back to its middle.
    """

    front: Mesh
    rear: Mesh
    ahead_m: float
    hitch_m: float
    rod_m: float
    middle_m: float

    @classmethod
    def load(cls, name: str) -> "Articulated":
        """A built-in vehicle: its parts called trailer are drawn along."""
        vehicle, (hitch_m, axle_m) = Vehicle.load(name), HITCHES_M[name]
        meshes, middles_m = list[Mesh](), list[float]()
        for is_rear in (False, True):
            parts = tuple(part for part in vehicle.parts if part.name.startswith("trailer") is is_rear)
            meshes.append(vehicle.model_copy(update={"parts": parts}).mesh())
            ends = BoundingBox.around(merge([mesh for part in parts for mesh in part.meshes()]).vertices_m)
            middles_m.append((ends.lower_m[0] + ends.upper_m[0]) / 2)
        return cls(*meshes, middles_m[0], hitch_m - middles_m[0], hitch_m - axle_m, hitch_m - middles_m[1])

    @property
    def back_m(self) -> float:
        """How far the axles of the rear part are behind the middle of both, on a straight."""
        return self.rod_m - self.hitch_m - self.ahead_m

    @property
    def sizes_m(self) -> Numbers:
        """(2, 3) length, width and height of the front and the rear part."""
        return np.array([BoundingBox.around(mesh.vertices_m).size_m for mesh in (self.front, self.rear)])

    @property
    def size_m(self) -> tuple[float, float, float]:
        """Length on a straight, width and height of both together."""
        length_m, width_m, height_m = self.sizes_m.max(axis=0).tolist()
        length_m = float(self.sizes_m[:, 0].sum()) / 2 - self.hitch_m + self.middle_m
        return length_m, width_m, height_m

    def hitches_m(self, poses: Numbers) -> Numbers:
        """(T, 2) where the hitch is, at (T, 3) poses x, y and heading in radians of the front."""
        return _shifted_m(poses, self.hitch_m)[:, :2]

    def rear_poses(self, poses: Numbers, yaw: Numbers) -> Numbers:
        """(T, 3) poses of the rear part with (T,) headings, at (T, 3) poses of the front."""
        return _shifted_m(np.column_stack([self.hitches_m(poses), yaw]), -self.middle_m)


def rears_of(
    both: Mapping[int, Articulated], poses: Sequence[Numbers], start: Sequence[float] | None = None
) -> dict[int, Numbers]:
    """(T, 3) poses of what some bodies draw along, x, y and heading in radians, by their numbers.

    Args:
        both: Those of N bodies that are in two parts.
        poses: Of each of these such poses of its front; T may differ.
        start: Of each the heading of its rear part at first; straight behind if not given.
    """
    if not both:
        return {}
    lead_m = together([body.hitches_m(own) for body, own in zip(both.values(), poses, strict=True)])
    first = np.array([own[0, 2] for own in poses] if start is None else start)
    yaw = tractrix(lead_m, np.array([body.rod_m for body in both.values()]), first).T
    rows = zip(both.items(), poses, yaw, strict=True)
    return {number: body.rear_poses(own, turned[: len(own)]) for (number, body), own, turned in rows}


def together(ways_m: Sequence[Numbers]) -> Numbers:
    """(T, N, 2) N ways, of which each stays at its end until the longest is there."""
    longest = max(map(len, ways_m))
    return np.stack([np.pad(way_m, ((0, longest - len(way_m)), (0, 0)), "edge") for way_m in ways_m], axis=1)


def tractrix(lead_m: Numbers, length_m: Numbers, yaw: Numbers) -> Numbers:
    """Headings of rods that are drawn along at their front end, exactly for ways of straight pieces.

    Args:
        lead_m: (T, N, 2) where the front ends go.
        length_m: (N,) of the rods; their rear ends never slip sideways.
        yaw: (N,) headings at first, in radians.

    Returns:
        (T, N) headings, without leaps: with the angle a between rod and way, tan(a / 2) falls by exp(-way / length).
    """
    ways_m = np.diff(lead_m, axis=0)
    towards = np.arctan2(ways_m[..., 1], ways_m[..., 0])
    falls = np.exp(-np.hypot(ways_m[..., 0], ways_m[..., 1]) / length_m)
    found = np.empty(lead_m.shape[:2])
    found[0] = yaw
    for k, (toward, fall) in enumerate(zip(towards, falls, strict=True)):
        half = np.tan((toward - found[k]) / 2)
        found[k + 1] = found[k] + 2 * (np.arctan(half) - np.arctan(half * fall))
    return found


def _shifted_m(poses: Numbers, ahead_m: float) -> Numbers:
    """(T, 3) poses so much ahead."""
    yaw = poses[:, 2]
    return poses + ahead_m * np.stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))], axis=1)
