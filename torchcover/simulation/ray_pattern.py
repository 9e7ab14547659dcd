"""Reference sensors that are a pattern of rays: a pose, the rays from there, what their hits weigh."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import BoundingBox
from torchcover.simulation.rays import Tile
from torchcover.simulation.reference_sensor import ReferenceScan
from torchcover.simulation.surroundings import Surroundings


class RayPattern(Protocol):
    """Rays over directions. The order of calls at a step is as below; `vehicle_T_reference` again if it is buried."""

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


def cast_pattern(pattern: RayPattern, surroundings: Surroundings, *, ego_points: bool = False) -> ReferenceScan:
    """What a pattern of rays sees: every ray that hits something makes a point, one that hits the ego if wanted."""
    pose, redrawn = surroundings.free_pose(pattern.vehicle_T_reference)
    tiles = pattern.tiles(pose, surroundings.generator)
    scan = surroundings.instant.scan(
        pose, tiles, max_range_m=pattern.max_range_m, ego_points=ego_points, threads=surroundings.threads
    )
    weights = pattern.weights(pose, tiles, scan.ray)
    return ReferenceScan(
        points=scan.points,
        weights=weights,
        weight_kind=None if weights is None else "density",
        rays=scan.rays,
        self_hits=scan.self_hits,
        body_casts=scan.body_casts,
        redrawn=redrawn,
    )
