"""What a reference sensor finds at one step: the vehicle, the scene around it, and its random numbers."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import BoundingBox
from torchcover.simulation.instant import Instant
from torchcover.simulation.scene import Scene

# A place inside a body is drawn again, at most this often.
MAX_DRAWS = 100

DrawPose = Callable[[BoundingBox, np.random.Generator], NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class Surroundings:
    """One step, as the simulator offers it to a reference sensor.

    Args:
        scene: The geometry of the world.
        instant: It at the time of the step.
        generator: Source of all random numbers of the sensor.
        name: What messages call the step.
        threads: On how many threads rays may be cast; no result depends on it.
    """

    scene: Scene
    instant: Instant
    generator: np.random.Generator
    name: str
    threads: int = 1

    def free_pose(self, draw: DrawPose) -> tuple[NDArray[np.float64], int]:
        """Draw a pose until it lies inside no body.

        Args:
            draw: From the ego's bounding box and the random numbers to a (4, 4) pose in the vehicle frame.

        Returns:
            The pose, and how many were thrown away.

        Raises:
            ValueError: 100 poses in a row lie inside bodies or below the ground.
        """
        for redrawn in range(MAX_DRAWS):
            vehicle_T_reference = draw(self.scene.ego_box, self.generator)
            if not self.instant.buried(vehicle_T_reference[:3, 3]):
                return vehicle_T_reference, redrawn
        raise ValueError(
            f"{self.name}: {MAX_DRAWS} places beside and above the ego lie inside other bodies or below the ground; "
            "does the ego stand on the ground, and do faces point outwards?"
        )
