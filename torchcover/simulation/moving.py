"""The bodies that move, placed at one instant."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import invert
from torchcover.simulation.culling import SLACK_M
from torchcover.simulation.raycaster import RayCaster

Float64 = NDArray[np.float64]
Numbers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Moving:
    """P bodies that move, placed at one instant.

    Args:
        casters: Of each, in its own frame; bodies of one kind share one.
        vehicle_T_part: (P, 4, 4) where they are.
        body: (P,) their numbers.
        corners_m: (P, 8, 3) of the boxes around them in the vehicle frame.
        centre_m: (P, 3) of balls around them, likewise.
        radius_m: (P,) of these balls.
    """

    casters: Sequence[RayCaster]
    vehicle_T_part: Float64
    body: Numbers
    corners_m: Float64
    centre_m: Float64
    radius_m: Float64

    def __len__(self) -> int:
        return len(self.casters)

    @cached_property
    def part_T_vehicle(self) -> Float64:
        """(P, 4, 4) from the vehicle frame to theirs."""
        return invert(self.vehicle_T_part)

    @cached_property
    def kinds(self) -> tuple[Sequence[RayCaster], Numbers]:
        """The different casters, and (P,) which of them each body has."""
        different = list(dict.fromkeys(self.casters))
        number = {caster: k for k, caster in enumerate(different)}
        return different, np.array([number[caster] for caster in self.casters], dtype=np.int64)

    def touched_by(self, place_m: Float64, places_m: Float64) -> NDArray[np.bool_]:
        """(P,) whether a (3,) place of the vehicle frame, `places_m` (P, 3) from there, lies on a face of each body."""
        touched: NDArray[np.bool_] = np.linalg.norm(self.centre_m - place_m, axis=1) <= self.radius_m + SLACK_M
        for k in np.flatnonzero(touched).tolist():
            touched[k] = len(self.casters[k].touched(places_m[k])) > 0
        return touched

    def from_there_m(self, place_m: Float64) -> Float64:
        """(P, 3) a (3,) place of the vehicle frame in the frame of each body, as `transform` has it."""
        rotation, translation = self.part_T_vehicle[:, :3, :3], self.part_T_vehicle[:, :3, 3:]
        back = rotation.swapaxes(1, 2)
        place: Float64 = ((place_m + (back @ translation)[..., 0])[:, None] @ back)[:, 0]
        return place
