"""What carries the rigs of a space: the skin that sensors are mounted on."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import BoundingBox
from torchcover.simulation import Scenario
from torchcover.simulation.bodies import mount_regions_of
from torchcover.simulation.mount_regions import MountRegion, Skin


class Carrier(NamedTuple):
    """The vehicle that all candidates are mounted on.

    Args:
        name: What messages call it.
        skin: Of its body.
        regions: By name, where sensors can be mounted.
    """

    name: str
    skin: Skin
    regions: dict[str, MountRegion]

    @property
    def outline_m(self) -> NDArray[np.float64]:
        """(4, 2) corners x, y of the vehicle."""
        return BoundingBox.around(self.skin.mesh.vertices_m).outline_m

    @classmethod
    def of(cls, scenarios: Sequence[Scenario]) -> "Carrier":
        """The ego of all scenarios.

        Raises:
            ValueError: They have different ones.
            FileNotFoundError: A mesh or vehicle file is missing.
        """
        first, *others = scenarios
        shape = first.ego.shape if first.ego else None
        if any((other.ego.shape if other.ego else None) != shape for other in others):
            egos = ", ".join(f"{each.name} {each.ego_name}" for each in scenarios)
            raise ValueError(f"scenario: their egos differ ({egos}), but a rig is mounted on one; say which by vehicle")
        return cls(first.ego_name, Skin(first.ego_mesh()), mount_regions_of(shape))

    def region(self, name: str) -> MountRegion:
        """A mount region by its name.

        Raises:
            ValueError: There is none; the message lists those that there are.
        """
        if name not in self.regions:
            told = ", ".join(self.regions) or "none at all: add mount_regions to its document"
            raise ValueError(f"region: {self.name} has no {name!r}; it has {told}")
        return self.regions[name]
