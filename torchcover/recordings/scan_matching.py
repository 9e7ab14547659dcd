"""Measure how well two scans match once poses have moved one of them.

A scan becomes a map of Gaussians, one for each voxel, as in the normal distributions transform (Biber and Strasser,
IROS 2003): points of another scan match where surfaces are. The ground, which any motion matches, is left out.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry.rigid import Matrix
from torchcover.recordings.sweeps import voxels


@dataclass(frozen=True)
class MatchingParams:
    """Parameters of a map of Gaussians.

    Args:
        max_range_m: Points farther from the origin are ignored.
        voxel_m: Side of a voxel.
        min_points: Points that a voxel needs for a Gaussian.
        min_thickness_m: Standard deviation below which a surface counts as this thick; above range noise.
        max_normal_z: A surface with a normal more upright than this, and thin, is ground.
        thin_ratio: A surface is thin if its smallest variance is below this share of the second one.
        max_queries: Points of a scan that are matched, sampled at random.
    """

    max_range_m: float = 40.0
    voxel_m: float = 1.0
    min_points: int = 6
    min_thickness_m: float = 0.1
    max_normal_z: float = 0.8
    thin_ratio: float = 0.25
    max_queries: int = 1500


class SurfaceMap:
    """Gaussians of the surfaces of a scan.

    Args:
        points_m: (N, 3) points of the scan.
        params: Parameters of the map.

    Example:
        >>> y, z = np.random.default_rng(0).uniform(0, 9, (2, 4000))
        >>> wall = SurfaceMap(np.stack([np.full(4000, 5.1), y, z], axis=1))
        >>> [round(wall.match(wall.points_m + [offset_m, 0.2, 0.1]), 1) for offset_m in (0.0, 0.5)]
        [1.0, 0.0]
    """

    def __init__(self, points_m: NDArray[np.floating], params: MatchingParams | None = None) -> None:
        self._params = params = params or MatchingParams()
        near_m: Matrix = points_m[np.linalg.norm(points_m, axis=1) < params.max_range_m].astype(np.float64)
        numbers, voxel_of_point = np.unique(voxels(near_m, params.voxel_m), return_inverse=True)
        counts = np.bincount(voxel_of_point)
        sums = [np.bincount(voxel_of_point, coordinate_m, len(counts)) for coordinate_m in near_m.T]
        mean_m = np.stack(sums, axis=1) / counts[:, None]
        offset_m = near_m - mean_m[voxel_of_point]
        covariance = np.empty((len(counts), 3, 3))
        for a, b in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
            product = np.bincount(voxel_of_point, offset_m[:, a] * offset_m[:, b], len(counts)) / counts
            covariance[:, a, b] = covariance[:, b, a] = product
        is_surface = counts >= params.min_points
        variances, axes = np.linalg.eigh(covariance[is_surface])
        self._numbers, self._mean_m = numbers[is_surface], mean_m[is_surface]
        inverse_variances = 1.0 / np.maximum(variances, params.min_thickness_m**2)
        self._inverse = (axes * inverse_variances[:, None]) @ axes.swapaxes(1, 2)
        is_upright = np.abs(axes[:, 2, 0]) <= params.max_normal_z
        is_surface[is_surface] = is_upright | (variances[:, 0] >= params.thin_ratio * variances[:, 1])
        above_ground_m = near_m[is_surface[voxel_of_point]]
        self.points_m = np.random.default_rng(0).permutation(above_ground_m)[: params.max_queries]
        self._own_match = 1.0
        self._own_match = self.match(self.points_m) if len(self.points_m) else 1.0

    @property
    def has_enough_points(self) -> bool:
        """Whether enough points above the ground are left to be matched."""
        return len(self.points_m) >= self._params.max_queries // 10

    def match(self, points_m: Matrix) -> float:
        """Return how well (N, 3) points match: 0 not at all, 1 as well as the points of the map.

        It is the mean of exp(-d^2 / 2), d the Mahalanobis distance to the Gaussian in the voxel of a point.
        """
        numbers = voxels(points_m, self._params.voxel_m)
        position = np.searchsorted(self._numbers, numbers).clip(max=len(self._numbers) - 1)
        inside = np.flatnonzero(self._numbers[position] == numbers)
        offset_m = points_m[inside] - self._mean_m[position[inside]]
        squared = np.einsum("ni,nij,nj->n", offset_m, self._inverse[position[inside]], offset_m)
        return float(np.exp(-squared / 2).sum() / len(points_m)) / self._own_match
