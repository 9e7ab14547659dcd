"""Gentle slopes: one height for each place, streets and all else."""

from collections.abc import Iterator

import numpy as np

from torchcover.geometry.arrays import Float32, Float64
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.alignment import squared_distances

WAVELENGTHS_M = (250.0, 700.0)
WAVES = 3
# Between the corners of its squares the ground is nowhere farther from the hills than a centimetre or two; longer hills
# have larger ones.
SQUARE_M = 10.0


class Hills:
    """A few long waves with heights of a standard deviation, but nowhere steeper than a share; a plain if that is 0."""

    def __init__(
        self,
        height_m: float,
        generator: np.random.Generator,
        wavelengths_m: tuple[float, float] = WAVELENGTHS_M,
        steepest: float = np.inf,
    ) -> None:
        towards, phase = generator.uniform(0.0, 2 * np.pi, (2, WAVES))
        waves = 2 * np.pi / generator.uniform(*wavelengths_m, WAVES)
        self._waves_per_m = waves * np.array([np.cos(towards), np.sin(towards)])
        self._phase = phase
        self._wave_m = min(height_m * np.sqrt(2 / WAVES), steepest / waves.sum())

    @property
    def are_flat(self) -> bool:
        """Whether there are none."""
        return bool(self._wave_m == 0.0)

    def heights_m(self, places_m: Float64) -> Float64:
        """(...) at (..., 2) places, rounded to some micrometres."""
        if self.are_flat:
            return np.zeros(places_m.shape[:-1])
        waves = sum((np.sin(phase) for phase in self._phases(places_m)), start=np.float32(0.0))
        return np.asarray(self._wave_m * np.asarray(waves, dtype=np.float64))

    def stances(self, places_m: Float64, yaw_deg: Float64) -> Float64:
        """(..., 3) height in metres, and pitch and roll in degrees, of who stands at (..., 2) places with headings."""
        if self.are_flat:
            return np.zeros((*places_m.shape[:-1], 3))
        stances = np.zeros((3, *places_m.shape[:-1]), dtype=np.float32)
        height, pitch, roll = stances
        yaw = np.deg2rad(yaw_deg).astype(np.float32)
        cos, sin = np.cos(yaw), np.sin(yaw)
        for phase, (x_per_m, y_per_m) in zip(
            self._phases(places_m), self._waves_per_m.T.astype(np.float32), strict=True
        ):
            height += np.sin(phase)
            slope = np.cos(phase)
            # Up at the front is a negative pitch; up at the left lowers the right side.
            pitch -= slope * (x_per_m * cos + y_per_m * sin)
            roll += slope * (y_per_m * cos - x_per_m * sin)
        stances *= np.float32(self._wave_m)
        # The arc tangent of what is small.
        stances[1:] *= np.float32(np.rad2deg(1.0)) * (1 - stances[1:] ** 2 / 3)
        return np.moveaxis(stances, 0, -1).astype(np.float64)

    def _phases(self, places_m: Float64) -> Iterator[Float32]:
        """(...) of each wave. They are reduced in float64: sines and cosines of float32 take a fraction of the time."""
        x_m, y_m = places_m[..., 0], places_m[..., 1]
        for x_per_m, y_per_m, phase in zip(*self._waves_per_m, self._phase, strict=True):
            yield (x_per_m * x_m + y_per_m * y_m + phase).astype(np.float32)

    def mesh(self, way_m: Float64, within_m: float, square_m: float = SQUARE_M) -> Mesh:
        """The ground near a way, (N, 2) places, as one sheet of squares."""
        lower = np.floor((way_m.min(axis=0) - within_m) / square_m)
        columns, rows = (np.ceil((way_m.max(axis=0) + within_m) / square_m) - lower).astype(np.int64).tolist()
        row, column = np.indices((rows, columns)).reshape(2, -1)
        middles_m = square_m * (lower + 0.5 + np.stack([column, row], axis=1))
        near = squared_distances(middles_m, way_m).min(axis=1) < within_m**2
        here = (row * (columns + 1) + column)[near]
        right, above = here + 1, here + columns + 1
        across = above + 1
        faces = np.concatenate([np.stack([here, right, across], axis=1), np.stack([here, across, above], axis=1)])
        wanted = np.zeros((rows + 1) * (columns + 1), dtype=bool)
        wanted[faces] = True
        used, number = np.flatnonzero(wanted), np.cumsum(wanted) - 1
        places_m = square_m * (lower + np.stack([used % (columns + 1), used // (columns + 1)], axis=1))
        vertices_m, outward = np.column_stack([places_m, self.heights_m(places_m)]), np.zeros(len(faces), dtype=bool)
        return Mesh(vertices_m, number[faces], outward=outward).made_of("road")
