"""Objects over time, seen at some instants and wanted at others."""

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch

from torchcover.detection.box_layouts import upright_rows
from torchcover.detection.boxes import Boxes
from torchcover.geometry.rigid import Matrix, rigid, transform

# A key frame of a label that is nearer than this is that of the instant.
SAME_TIME_S = 1e-3


class Seen(NamedTuple):
    """An object at an instant.

    Args:
        time_s: When.
        world_T_box: (4, 4) where: its centre, x along its length.
        size_m: Length, width, height.
        category: What it is.
    """

    time_s: float
    world_T_box: Matrix
    size_m: tuple[float, float, float]
    category: str


class Tracks:
    """Objects by name, each seen at ascending times; between two of them it moves evenly.

    Args:
        tracks: Name -> when and where it was seen, in any order.
        longest_gap_s: Where it was unseen for longer, nobody knows where it was.
    """

    def __init__(self, tracks: Mapping[str, Sequence[Seen]], longest_gap_s: float = 1.0) -> None:
        self._tracks = {name: sorted(seen, key=lambda one: one.time_s) for name, seen in tracks.items()}
        self._times = {name: [one.time_s for one in seen] for name, seen in self._tracks.items()}
        self._longest_gap_s = longest_gap_s

    def at(self, time_s: float, vehicle_T_world: Matrix) -> Boxes:
        """The objects of an instant that lies within their tracks, in the vehicle frame."""
        found = {}
        for name, seen in self._tracks.items():
            one = self._between(seen, self._times[name], time_s)
            if one is not None:
                found[name] = one
        poses = np.array([one.world_T_box for one in found.values()]).reshape(-1, 4, 4)
        rows = upright_rows(
            transform(vehicle_T_world, poses[:, :3, 3]),
            np.array([one.size_m for one in found.values()]).reshape(-1, 3),
            poses[:, :3, 0] @ vehicle_T_world[:3, :3].T,
            None,
        )
        names = tuple(one.category for one in found.values())
        return (
            Boxes.from_rows(rows, ids=tuple(found), categories=names) if found else Boxes.from_rows(torch.empty(0, 7))
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
