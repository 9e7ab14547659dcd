"""A scenario as geometry that rays can be cast at, in the vehicle frame."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import Box, invert
from torchcover.simulation.bodies import in_vehicle_frame
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.scenario import Scenario

EGO = 0  # the ego is the first body of every scene


class Scan(NamedTuple):
    """What one sensor saw: `points` (N, 3) float32 in the vehicle frame, and how many rays went where."""

    points: NDArray[np.float32]
    rays: int
    self_hits: int


class Scene:
    """The world around the ego and the ego's body, in the vehicle frame.

    Args:
        scenario: The world.

    Raises:
        FileNotFoundError: A mesh or vehicle file is missing.
        ValueError: A mesh cannot be used.
    """

    def __init__(self, scenario: Scenario) -> None:
        ego = in_vehicle_frame(scenario.ego.shape.mesh())
        # float64 until the ego's position is subtracted: world coordinates may be of UTM size.
        vehicle_T_world = invert(scenario.ego.pose.matrix())
        bodies = [mesh.moved(vehicle_T_world) for body in scenario.bodies for mesh in body.meshes()]
        self.ego_box = Box.around(ego.vertices_m)
        self._caster = RayCaster([ego, *bodies])

    def scan(
        self,
        vehicle_T_sensor: NDArray[np.float64],
        directions: NDArray[np.float32],
        *,
        min_range_m: float = 0.0,
        max_range_m: float = np.inf,
        threads: int = 1,
    ) -> Scan:
        """Cast the rays of one sensor. The ego occludes, but its own points are left out.

        Args:
            vehicle_T_sensor: (4, 4) pose of the sensor.
            directions: (3, N) unit directions in the sensor's frame.
            min_range_m: Closer hits give no point.
            max_range_m: Farther hits give no point.
            threads: Number of threads; the result does not depend on it.

        Returns:
            `Scan(points, rays, self_hits)`.
        """
        hits = self._caster.cast(
            vehicle_T_sensor[:3, 3],
            vehicle_T_sensor[:3, :3],
            directions,
            min_range_m=min_range_m,
            max_range_m=max_range_m,
            threads=threads,
        )
        outside = hits.body != EGO
        points = np.ascontiguousarray(hits.points[:, outside].T)
        return Scan(points, directions.shape[1], int(np.count_nonzero(~outside)))
