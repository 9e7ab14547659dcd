"""Gentle slopes: one height for each place, streets and all else."""

import numpy as np
from numpy.typing import NDArray

from torchcover.simulation.shapes import Mesh

Numbers = NDArray[np.float64]

WAVELENGTHS_M = (250.0, 700.0)
WAVES = 4
# Between the corners of its squares the ground is nowhere farther from the hills than a centimetre or two.
SQUARE_M = 10.0


class Hills:
    """A few long waves; a plain if they have no height.

    Args:
        height_m: Standard deviation of the heights.
        generator: Draws the waves.
    """

    def __init__(self, height_m: float, generator: np.random.Generator) -> None:
        towards, phase = generator.uniform(0.0, 2 * np.pi, (2, WAVES))
        waves = 2 * np.pi / generator.uniform(*WAVELENGTHS_M, WAVES)
        self._waves_per_m = waves * np.array([np.cos(towards), np.sin(towards)])
        self._phase = phase
        self._wave_m = height_m * np.sqrt(2 / WAVES)

    @property
    def are_flat(self) -> bool:
        """Whether there are none."""
        return self._wave_m == 0.0

    @property
    def steepest(self) -> float:
        """A slope that is nowhere exceeded."""
        return float(self._wave_m * np.linalg.norm(self._waves_per_m, axis=0).sum())

    def heights_m(self, places_m: Numbers) -> Numbers:
        """(...) at (..., 2) places."""
        if self.are_flat:
            return np.zeros(places_m.shape[:-1])
        heights: Numbers = self._wave_m * np.sin(places_m @ self._waves_per_m + self._phase).sum(axis=-1)
        return heights

    def tilts_deg(self, places_m: Numbers, yaw_deg: Numbers) -> Numbers:
        """(..., 2) pitch and roll of who stands at (..., 2) places, with (...) headings."""
        if self.are_flat:
            return np.zeros(places_m.shape)
        slope = self._wave_m * np.cos(places_m @ self._waves_per_m + self._phase) @ self._waves_per_m.T
        yaw = np.deg2rad(yaw_deg)
        cos, sin = np.cos(yaw), np.sin(yaw)
        ahead, left = slope[..., 0] * cos + slope[..., 1] * sin, slope[..., 1] * cos - slope[..., 0] * sin
        # Up at the front is a negative pitch; up at the left lowers the right side.
        tilts: Numbers = np.rad2deg(np.arctan(np.stack([-ahead, left], axis=-1)))
        return tilts

    def mesh(self, way_m: Numbers, within_m: float) -> Mesh:
        """The ground near a way, (N, 2) places, as one sheet of squares."""
        lower = np.floor((way_m.min(axis=0) - within_m) / SQUARE_M)
        columns, rows = (np.ceil((way_m.max(axis=0) + within_m) / SQUARE_M) - lower).astype(np.int64).tolist()
        row, column = np.indices((rows, columns)).reshape(2, -1)
        middles_m = SQUARE_M * (lower + 0.5 + np.stack([column, row], axis=1))
        near = np.zeros(len(middles_m), dtype=bool)
        for place_m in way_m:
            near |= ((middles_m - place_m) ** 2).sum(axis=1) < within_m**2
        here = (row * (columns + 1) + column)[near]
        right, above = here + 1, here + columns + 1
        across = above + 1
        faces = np.concatenate([np.stack([here, right, across], axis=1), np.stack([here, across, above], axis=1)])
        used, faces = np.unique(faces, return_inverse=True)
        places_m = SQUARE_M * (lower + np.stack([used % (columns + 1), used // (columns + 1)], axis=1))
        return Mesh(np.column_stack([places_m, self.heights_m(places_m)]), faces.reshape(-1, 3))
