"""The geometry of bodies of one kind: made once, for all that share a mesh, in one world or in many."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import BoundingBox
from torchcover.simulation.culling import SLACK_M, SLACK_SHARE
from torchcover.simulation.patches import Patches
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.shapes import Mesh


class Solid:
    """The geometry of one kind of body in its own frame.

    `outline_m` (9, 3) has the corners of its box, grown a little, and the centre; no vertex is farther from that than
    `radius_m`, nor from the origin of the frame than `reach_m`.

    Args:
        mesh: Its form.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh
        self.box = BoundingBox.around(mesh.vertices_m)
        centre_m = (np.array(self.box.lower_m) + np.array(self.box.upper_m)) / 2
        self.radius_m = float(np.linalg.norm(mesh.vertices_m - centre_m, axis=1).max())
        # Of the corners as they are cast: in float32.
        slack_m = SLACK_M + SLACK_SHARE * float(np.abs(self.box.corners_m).max())
        grown_m = self.box.corners_m + slack_m * np.sign(self.box.corners_m - centre_m)
        self.outline_m: NDArray[np.float64] = np.vstack([grown_m, centre_m])
        self.reach_m = float(np.linalg.norm(centre_m)) + self.radius_m

    @cached_property
    def caster(self) -> RayCaster:
        """It alone, to cast rays at."""
        return RayCaster([self._mesh])

    @cached_property
    def patches(self) -> Patches:
        """All of its surface, cut small."""
        return Patches.of(self._mesh)


class Solids:
    """The solids of meshes, each made when first asked for and kept: one for each mesh object, whoever shares it."""

    def __init__(self) -> None:
        self._of: dict[int, tuple[Mesh, Solid]] = {}

    def of(self, mesh: Mesh) -> Solid:
        """That of a mesh."""
        if id(mesh) not in self._of:
            self._of[id(mesh)] = mesh, Solid(mesh)  # with the mesh, so that no other one gets its id
        return self._of[id(mesh)][1]
