"""What a reference sensor is: another pattern is a class with these members and a line in `kinds.py`."""

from typing import ClassVar, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import BoundingBox
from torchcover.simulation.rays import Tile

# A rectangle of the ground in the vehicle frame in metres: ((x_low, x_high), (y_low, y_high)).
Area = tuple[tuple[float, float], tuple[float, float]]
Areas = tuple[Area, ...]


class ReferenceSensor(Protocol):
    """A sensor that no rig is measured to be better than: at every step its rays leave from another place at the ego.

    A value: equal ones cast the same rays, from random numbers of the generator that they are given and no others. It
    can be pickled, for it travels to the workers of a DataLoader.

    The order of calls at a step is `vehicle_T_reference` (again if the place is inside a body), `tiles`, `weights`.
    """

    name: ClassVar[str]
    """What it is registered as, and what `--reference` and `summary.json` call it."""

    @classmethod
    def from_rays(cls, areas: Areas, rays: int | None) -> Self:
        """The sensor for a question.

        Args:
            areas: The rectangles of the ground that are asked about; they may overlap.
            rays: About how many rays it casts at a step; None for the number that it does best with.

        Raises:
            ValueError: Areas or a number of rays that it cannot do with.
        """
        ...

    @property
    def shell_m(self) -> float:
        """How far its places lie from the ego's bounding box in metres, at most."""
        ...

    @property
    def max_range_m(self) -> float:
        """Hits that are farther from it, in metres, give no point."""
        ...

    def vehicle_T_reference(self, ego: BoundingBox, generator: np.random.Generator) -> NDArray[np.float64]:
        """Draw the pose of one step.

        Args:
            ego: Bounding box of the ego in the vehicle frame.
            generator: Source of the random numbers.

        Returns:
            (4, 4) transform; its place is outside the box.
        """
        ...

    def tiles(self, vehicle_T_reference: NDArray[np.float64], generator: np.random.Generator) -> tuple[Tile, ...]:
        """The rays of one step in the sensor's frame.

        Args:
            vehicle_T_reference: (4, 4) pose, from `vehicle_T_reference`.
            generator: Source of the random numbers.

        Returns:
            From `into_tiles`, of (3, rows, columns) unit directions.
        """
        ...

    def weights(
        self, vehicle_T_reference: NDArray[np.float64], tiles: tuple[Tile, ...], ray: NDArray[np.int64]
    ) -> NDArray[np.float32] | None:
        """What the points count for: the density per solid angle that is meant, over that of the rays.

        Args:
            vehicle_T_reference: (4, 4) pose, from `vehicle_T_reference`.
            tiles: The rays of the step, from `tiles`.
            ray: (N,) numbers of the rays that made a point, counted over the tiles.

        Returns:
            (N,) positive finite weights, or None if all weigh the same.
        """
        ...
