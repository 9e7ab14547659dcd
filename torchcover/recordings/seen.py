"""Objects as annotators saw them: each at some instants, and wanted at others or as a track."""

import math
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import torch

from torchcover.detection.boxes import Boxes, upright_rows
from torchcover.geometry.rigid import Matrix, rigid, transform

# A key frame of a label that is nearer than this is that of the instant.
SAME_TIME_S = 1e-3


class Seen(NamedTuple):
    """An object at an instant: `world_T_box` is its centre, x along its length; length, width, height are its size.

    `visibility` as `Boxes` has it.
    """

    name: str
    time_s: float
    world_T_box: Matrix
    size_m: tuple[float, float, float]
    category: str
    visibility: float = math.nan


def by_name(seen: Iterable[Seen]) -> dict[str, list[Seen]]:
    """Those of each object, in the order of time."""
    found: dict[str, list[Seen]] = {}
    for one in sorted(seen, key=lambda one: one.time_s):
        found.setdefault(one.name, []).append(one)
    return found


class SeenObjects:
    """Objects at any time; between two of theirs they move evenly.

    `seen`: when and where they were seen, in any order; `longest_gap_s`: where one was unseen for longer, it is unknown
    where it was.
    """

    def __init__(self, seen: Sequence[Seen], longest_gap_s: float = 1.0) -> None:
        ordered = by_name(seen)
        self._seen = {name: ordered[name] for name in dict.fromkeys(one.name for one in seen)}
        self._times = {name: [one.time_s for one in of] for name, of in self._seen.items()}
        self._longest_gap_s = longest_gap_s

    def at(self, time_s: float, vehicle_T_world: Matrix) -> Boxes:
        """The objects of an instant that lies within their times, in the vehicle frame."""
        between = (self._between(seen, self._times[name], time_s) for name, seen in self._seen.items())
        found = [one for one in between if one is not None]
        poses = np.array([one.world_T_box for one in found]).reshape(-1, 4, 4)
        rows = upright_rows(
            transform(vehicle_T_world, poses[:, :3, 3]),
            np.array([one.size_m for one in found]).reshape(-1, 3),
            poses[:, :3, 0] @ vehicle_T_world[:3, :3].T,
            None,
        )
        return Boxes.from_rows(
            rows,
            ids=tuple(one.name for one in found),
            categories=tuple(one.category for one in found),
            visibility=torch.tensor([one.visibility for one in found], dtype=torch.float32, device="cpu"),
        )

    def _between(self, seen: Sequence[Seen], times_s: Sequence[float], time_s: float) -> Seen | None:
        after = bisect_left(times_s, time_s - SAME_TIME_S)
        if after == len(seen):
            return None
        if abs(times_s[after] - time_s) <= SAME_TIME_S:
            return seen[after]
        if after == 0 or times_s[after] - times_s[after - 1] > self._longest_gap_s:
            return None
        first, second = seen[after - 1], seen[after]
        share = (time_s - first.time_s) / (second.time_s - first.time_s)
        return first._replace(time_s=time_s, world_T_box=_blend(first.world_T_box, second.world_T_box, share))


def _blend(first: Matrix, second: Matrix, share: float) -> Matrix:
    """Between two poses: the places evenly, the heading about z the shorter way."""
    place_m = first[:3, 3] + share * (second[:3, 3] - first[:3, 3])
    turn = first[:3, :3].T @ second[:3, :3]
    angle = share * np.arctan2(turn[1, 0], turn[0, 0])
    about_z = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    return rigid(first[:3, :3] @ about_z, place_m)
