"""Which places beside a street are its own."""

import numpy as np
from numpy.typing import NDArray

from torchcover.simulation.traffic.alignment import Alignment, squared_distances

Numbers = NDArray[np.float64]
Flags = NDArray[np.bool_]

SAMPLE_EVERY_M = 8.0
# Halvings of what is a hundred metres.
HALVINGS = 5


class Territory:
    """The places that are nearest to the stretch of the street that they were measured from.

    No two stretches share any of it: what is built within cannot lie on another street, nor on what belongs to it.

    Args:
        street: The street.
        span_m: First and last station that matter.
    """

    def __init__(self, street: Alignment, span_m: tuple[float, float]) -> None:
        self._street = street
        self._span_m = span_m
        self._samples_m = np.arange(*span_m, SAMPLE_EVERY_M)
        self._places_m = street.poses(self._samples_m, 0.0)[:, :2]

    def stations_m(self, every_m: float) -> Numbers:
        """(N,) stations of its street, at even distances."""
        return np.arange(*self._span_m, every_m)

    def covers(self, stations_m: Numbers) -> Flags:
        """(N,) whether stations are among those that matter."""
        return (stations_m > self._span_m[0]) & (stations_m < self._span_m[1])

    def owns(self, stations_m: Numbers, left_m: Numbers) -> Flags:
        """(N,) whether places beside the street are their own stretch's."""
        if self._street.is_straight:
            return np.ones(len(stations_m), dtype=bool)
        nearest = self.nearest(self._street.poses(stations_m, left_m)[:, :2])
        return np.asarray(np.abs(nearest - stations_m) <= SAMPLE_EVERY_M)

    def nearest(self, places_m: Numbers) -> Numbers:
        """(N,) stations of the nearest samples."""
        return np.asarray(self._samples_m[squared_distances(places_m, self._places_m).argmin(axis=1)])

    def reaches_m(self, stations_m: Numbers, side: int, near_m: float, far_m: float) -> Numbers:
        """(N,) how far from the middle it goes, on the left (1) or on the right (-1), from near to far."""
        least, most = np.full(len(stations_m), near_m), np.full(len(stations_m), far_m)
        if self._street.is_straight:
            return most
        least[self.owns(stations_m, side * most)] = far_m
        for _ in range(HALVINGS):
            middle = (least + most) / 2
            owned = self.owns(stations_m, side * middle)
            least, most = np.where(owned, np.maximum(least, middle), least), np.where(owned, most, middle)
        return least
