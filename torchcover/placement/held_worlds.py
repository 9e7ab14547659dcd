"""Worlds and their references in the memory of one process, at which rigs look."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.neighbors import nearest
from torchcover.placement.question_grid import ReferencePoints
from torchcover.placement.sites import HeldInstant, Site
from torchcover.simulation import Rig, Simulator


class Look(NamedTuple):
    """What a rig sees at an instant: `seen` (thresholds, bytes) packed bits of the reference points, and rays."""

    seen: NDArray[np.uint8]
    self_hits: int
    rays: int


class HeldWorlds:
    """Worlds that are built once, with the reference points of their instants.

    Args:
        sites: The scenarios.
        instants: The instants in the worlds that this process holds.
        budget_bytes: What these may take.

    Raises:
        FileNotFoundError: A mesh, vehicle or trajectory file is missing.
        ValueError: A world that cannot be built, or more than the budget.
    """

    def __init__(self, sites: Sequence[Site], instants: Sequence[HeldInstant], budget_bytes: float) -> None:
        self._simulators = [site.simulator() for site in sites]
        self._instants = {instant.number: instant for instant in instants}
        self._rig: Rig | None = None
        self._mounted: dict[int, Simulator] = {}
        self._points: dict[int, Tensor] = {}
        self.references: dict[int, ReferencePoints] = {}
        thresholds = dict.fromkeys(question.threshold_m for question in sites[0].grid.questions)
        self._thresholds_m = tuple(thresholds)
        worlds = sorted({instant.world for instant in instants})
        bytes_of: list[float] = []
        for world in worlds:
            bytes_of.append(self._build([instant for instant in instants if instant.world == world], sites))
            _check_budget(bytes_of, len(worlds), budget_bytes)

    def _build(self, instants: Sequence[HeldInstant], sites: Sequence[Site]) -> float:
        """Build one world; its bytes."""
        held_bytes = 0.0
        for instant in instants:
            seen = self._simulators[instant.site].step(instant.step)
            assert seen.reference_weights is not None  # those of a SurfaceReference
            points, reference = sites[instant.site].grid.sorted_in(
                torch.from_numpy(seen.reference), torch.from_numpy(seen.reference_weights)
            )
            self._points[instant.number], self.references[instant.number] = points, reference
            held_bytes += points.nbytes + reference.bytes
        first = instants[0]
        return held_bytes + self._simulators[first.site].scene_of(first.step)[0].bytes

    def look(self, rig: Rig, numbers: Sequence[int]) -> list[Look]:
        """What a rig sees.

        Args:
            rig: The sensors.
            numbers: Of the instants, all held here.

        Raises:
            ValueError: The rig cannot be mounted.
        """
        looks = []
        for number in numbers:
            instant = self._instants[number]
            scans = self._with(rig, instant.site).scans(instant.step)[rig.name]
            points, farthest_m = self._points[number], max(self._thresholds_m)
            cloud = torch.from_numpy(np.concatenate([scan.points for scan in scans]))
            distance, _ = nearest(points, cloud, max_distance=farthest_m)
            seen = np.stack([np.packbits((distance <= threshold).numpy()) for threshold in self._thresholds_m])
            looks.append(Look(seen, sum(scan.self_hits for scan in scans), sum(scan.rays for scan in scans)))
        return looks

    def _with(self, rig: Rig, site: int) -> Simulator:
        """A site with the rig, which is kept until another one comes: a race asks about it again and again."""
        if rig != self._rig:
            self._rig, self._mounted = rig, {}
        if site not in self._mounted:
            self._mounted[site] = self._simulators[site].with_rigs({rig.name: rig})
        return self._mounted[site]


def _check_budget(bytes_of: Sequence[float], worlds: int, budget_bytes: float) -> None:
    """Refuse more than there is room for, judged by the worlds that were built so far."""
    expected = sum(bytes_of) + max(bytes_of) * (worlds - len(bytes_of))
    if expected > budget_bytes:
        fit = int(budget_bytes // max(bytes_of))
        raise ValueError(
            f"budget_bytes: {worlds} worlds in a process take about {expected / 1e6:.0f} MB, and "
            f"{budget_bytes / 1e6:.0f} MB are given, in which {fit} fit; use fewer worlds, or more memory"
        )
