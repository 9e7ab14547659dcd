"""Bodies that draw another one along at a hitch, and how that follows."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from torchcover.geometry.arrays import Float64


class Hitch(NamedTuple):
    """How a body draws another one along, of kind `rear`, whose axles never slip sideways.

    The middle of the front is `ahead_m` before that of both, on a straight, and the hitch `hitch_m` before the middle
    of the front, negative behind it. From the hitch, the axles of the rear are `rod_m` back, and its middle `middle_m`.
    """

    rear: str
    ahead_m: float
    hitch_m: float
    rod_m: float
    middle_m: float

    def hitches_m(self, poses: Float64) -> Float64:
        """(T, 2) where the hitch is, at (T, 3) poses x, y and heading in radians of the front."""
        return _shifted_m(poses, self.hitch_m)[:, :2]


# At the limits of EU Directive 96/53/EC the kingpin is 12 m before the rear end, and the front of the trailer turns
# 2.04 m around it.
DRAWS: Mapping[str, Hitch] = {"truck": Hitch("trailer", 4.925, -1.175, 8.41, 5.2)}


def rears_of(kinds: Sequence[str], poses: Sequence[Float64], start: Sequence[float] | None = None) -> list[Float64]:
    """(T, 3) poses x, y and heading in radians of what N bodies of these kinds draw along, whose own are likewise.

    T may differ. `start` are headings of the rears at first; straight behind if not given.
    """
    if not kinds:
        return []
    hitches = [DRAWS[kind] for kind in kinds]
    leads_m = [hitch.hitches_m(own) for hitch, own in zip(hitches, poses, strict=True)]
    first = np.array([own[0, 2] for own in poses] if start is None else start)
    yaws = tractrix(together(leads_m), np.array([hitch.rod_m for hitch in hitches]), first).T
    return [
        _shifted_m(np.column_stack([lead_m, yaw[: len(lead_m)]]), -hitch.middle_m)
        for hitch, lead_m, yaw in zip(hitches, leads_m, yaws, strict=True)
    ]


def together(ways_m: Sequence[Float64]) -> Float64:
    """(T, N, 2) N ways, of which each stays at its end until the longest is there."""
    longest = max(map(len, ways_m))
    return np.stack([np.pad(way_m, ((0, longest - len(way_m)), (0, 0)), "edge") for way_m in ways_m], axis=1)


def tractrix(lead_m: Float64, length_m: Float64, yaw: Float64) -> Float64:
    """(T, N) headings in radians, without leaps, of N rods that are drawn along at their front ends, (T, N, 2).

    Their rear ends never slip sideways. Exact for ways of straight pieces: with the angle a between rod and way, tan(a
    / 2) falls by exp(-way / length).
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


def _shifted_m(poses: Float64, ahead_m: float) -> Float64:
    """(T, 3) poses so much ahead."""
    yaw = poses[:, 2]
    return poses + ahead_m * np.stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))], axis=1)
