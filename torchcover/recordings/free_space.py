"""Free space that scans observed: test whether a later ray passed through a point.

A point that one scan measured is contradicted by another scan if that scan returned from clearly beyond it in the same
direction. Removert (Kim and Kim, 2020) compares range images in the same way; DUFOMap (Duberg et al., 2024) traverses
voxels instead.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import transform_points
from torchcover.geometry.rigid import Matrix

Float64 = NDArray[np.float64]
Votes = NDArray[np.int16]
ScanKey = tuple[str, int]  # sensor name, index of the frame
Kernel = Callable[..., None]


@dataclass(frozen=True)
class FreeSpaceParams:
    """Parameters of the free-space test.

    Args:
        columns: Azimuth bins of the finest range image (0.2 degrees each).
        rows: Elevation bins of the finest range image, uniform in the sine of the elevation (0.25 degrees at the
            horizon).
        coarsening: Factors, powers of two, by which bins may grow for sensors with fewer rays, tried in this order.
        min_neighbor_share: Bins are large enough if this share of the occupied bins has an occupied neighbor per axis.
        margin_m: A return must lie beyond `range + margin_m + relative_margin * range` to contradict a point.
        relative_margin: Part of that margin per meter of range.
    """

    columns: int = 1800
    rows: int = 480
    coarsening: tuple[int, ...] = (1, 2, 4, 8)
    min_neighbor_share: float = 0.8
    margin_m: float = 0.4
    relative_margin: float = 0.12


@dataclass(frozen=True)
class RangeImage:
    """Range image of one scan that stores up to which range each direction was free.

    Args:
        free_range_m: (rows, columns) float32 range up to which a bin is free; 0 where the scan has no return.
        first_row: Row of the full image to which row 0 of `free_range_m` corresponds; lower rows are empty.
        sensor_T_local: (4, 4) transform from the frame of the queried points to the sensor.
        max_free_range_m: Largest value of `free_range_m`; points beyond it cannot be contradicted.
        params: Bin sizes and margins.
    """

    free_range_m: NDArray[np.float32]
    first_row: int
    sensor_T_local: Matrix
    max_free_range_m: float
    params: FreeSpaceParams = FreeSpaceParams()

    @classmethod
    def from_points(
        cls, points_m: NDArray[np.floating], sensor_T_local: Matrix, params: FreeSpaceParams = FreeSpaceParams()
    ) -> "RangeImage":
        """Build the image from the returns of one scan.

        Args:
            points_m: (N, 3) returns in the sensor frame.
            sensor_T_local: (4, 4) transform from the frame of later queries to the sensor frame.
            params: Bin sizes and margins.

        Returns:
            The image; it marks nothing as free if the scan has no returns.
        """
        if not len(points_m):
            return cls(np.zeros((0, params.columns), np.float32), 0, sensor_T_local, 0.0, params)
        row, column, range_m = bin_directions(points_m.astype(np.float64), params.columns, params.rows)
        nearest_m, first_row = _rasterize_nearest_range(row, column, range_m, params)
        occupied = np.isfinite(nearest_m[1:-1, 1:-1])
        # The nearest return of the 3 x 3 neighborhood decides: rays that pass an edge, or graze the road, must not
        # contradict the edge or the road.
        over_rows_m = np.minimum(np.minimum(nearest_m[:-2], nearest_m[1:-1]), nearest_m[2:])
        conservative_m = np.minimum(np.minimum(over_rows_m[:, :-2], over_rows_m[:, 1:-1]), over_rows_m[:, 2:])
        free_range_m = np.maximum((conservative_m - params.margin_m) / (1 + params.relative_margin), 0.0)
        free_range_m = np.where(occupied, free_range_m, 0.0)
        return cls(free_range_m.astype(np.float32), first_row, sensor_T_local, float(free_range_m.max()), params)

    def add_votes(self, points_m: Float64, votes: Votes, increment: int = 1) -> None:
        """Add to the votes of the points that lie in the free space of this scan.

        Args:
            points_m: (N, 3) points in the local frame, contiguous.
            votes: (N,) int16 counts, changed in place.
            increment: Number that is added; -1 takes an earlier vote back.
        """
        count_votes = get_fastest_kernel(count_votes_by_arrays)
        image = (self.free_range_m, self.first_row, self.sensor_T_local, self.max_free_range_m)
        count_votes(points_m, *image, self.params.columns, self.params.rows, votes, increment)


class FreeSpaceCounter:
    """Counter of the scans that contradict each point of a sliding window.

    Counts are updated incrementally: a call only tests scans that entered or left the window since the last call.
    """

    def __init__(self) -> None:
        self._counted: dict[ScanKey, tuple[Votes, frozenset[ScanKey]]] = {}
        self._images: dict[ScanKey, RangeImage] = {}

    def update(self, scans: Mapping[ScanKey, Float64], images: Mapping[ScanKey, RangeImage]) -> dict[ScanKey, Votes]:
        """Move the window to these scans.

        Args:
            scans: (N, 3) points of each scan whose points are counted, in the local frame.
            images: Range image of each scan that may contradict them.

        Returns:
            (N,) number of contradicting scans for each point of each scan.
        """
        available_images = {**self._images, **images}
        window = frozenset(images)
        votes_of_scans: dict[ScanKey, Votes] = {}
        for key, points_m in scans.items():
            votes, counted_scans = self._counted.get(key, (np.zeros(len(points_m), np.int16), frozenset[ScanKey]()))
            if len(counted_scans ^ window) > len(window):  # to start over is cheaper than to update
                votes, counted_scans = np.zeros(len(points_m), np.int16), frozenset[ScanKey]()
            for changed_scan in counted_scans ^ window:
                available_images[changed_scan].add_votes(points_m, votes, 1 if changed_scan in window else -1)
            votes_of_scans[key] = votes
        self._counted = {key: (votes, window) for key, votes in votes_of_scans.items()}
        self._images = dict(images)
        return votes_of_scans


def bin_directions(
    points_m: Float64, columns: int, rows: int, coarsening: int = 1
) -> tuple[NDArray[np.int64], NDArray[np.int64], Float64]:
    """Compute the image bin and the range of points in the sensor frame.

    Args:
        points_m: (N, 3) points in the sensor frame.
        columns: Columns of the finest image.
        rows: Rows of the finest image.
        coarsening: Number of finest bins per bin, in each axis.

    Returns:
        (N,) row, (N,) column and (N,) range in meters.
    """
    x, y, z = points_m.T
    range_m = np.sqrt(x * x + y * y + z * z)
    sine_of_elevation = z / np.maximum(range_m, 1e-9)
    row = np.minimum(((1 + sine_of_elevation) * (rows / 2)).astype(np.int64), rows - 1)
    column = (_approximate_azimuth(x, y) * (columns / 4)).astype(np.int64) % columns
    return row // coarsening, column // coarsening, range_m


def _approximate_azimuth(x: Float64, y: Float64) -> Float64:
    """Approximate the azimuth in quarter turns, [0, 4], within 0.3 degrees.

    A quadratic approximation of the arctangent per octant, four times as fast as `np.arctan2`. The error is harmless
    because the same function bins the scans and the queries.
    """
    smaller = np.minimum(np.abs(x), np.abs(y))
    larger = np.maximum(np.maximum(np.abs(x), np.abs(y)), 1e-9)
    octant = smaller / larger * (0.64 - 0.14 * (smaller / larger))
    quadrant = np.where(np.abs(y) > np.abs(x), 1 - octant, octant)
    half_turn = np.where(x < 0, 2 - quadrant, quadrant)
    return np.where(y < 0, 4 - half_turn, half_turn)


def _rasterize_nearest_range(
    row: NDArray[np.int64], column: NDArray[np.int64], range_m: Float64, params: FreeSpaceParams
) -> tuple[Float64, int]:
    """Rasterize returns into the finest image in which most occupied bins have occupied neighbors.

    Returns:
        The nearest range per bin (inf where empty; one bin of padding per side, columns wrap around) and its first row.
    """
    for coarsening in params.coarsening:
        first_row = int(row.min()) // coarsening
        row_count = int(row.max()) // coarsening - first_row + 1
        nearest_m = np.full((row_count + 2, params.columns // coarsening + 2), np.inf)
        np.minimum.at(nearest_m, (row // coarsening - first_row + 1, column // coarsening + 1), range_m)
        occupied = np.isfinite(nearest_m)
        vertical_pairs = (occupied[:-1] & occupied[1:]).sum()
        horizontal_pairs = (occupied[:, :-1] & occupied[:, 1:]).sum()
        if min(vertical_pairs, horizontal_pairs) >= params.min_neighbor_share * occupied.sum():
            break
    nearest_m[:, 0], nearest_m[:, -1] = nearest_m[:, -2], nearest_m[:, 1]
    return nearest_m, first_row


def count_votes_by_arrays(
    points_m: Float64,
    free_range_m: NDArray[np.float32],
    first_row: int,
    sensor_T_local: Matrix,
    max_free_range_m: float,
    columns: int,
    rows: int,
    votes: Votes,
    increment: int,
) -> None:
    """Add votes to the points in the free space of a range image, with NumPy where numba is missing.

    Args:
        points_m: (N, 3) points in the local frame.
        free_range_m: Free range of each bin of the image.
        first_row: Row of the full image at which it begins.
        sensor_T_local: (4, 4) transform from the local frame to the sensor.
        max_free_range_m: Largest free range.
        columns: Columns of the finest image.
        rows: Rows of the finest image.
        votes: (N,) int16 counts, changed in place.
        increment: Number that is added.
    """
    coarsening = columns // free_range_m.shape[1]
    row, column, range_m = bin_directions(transform_points(sensor_T_local, points_m), columns, rows, coarsening)
    is_covered = (row >= first_row) & (row < first_row + len(free_range_m))
    candidates = np.flatnonzero(is_covered & (range_m < max_free_range_m))
    is_free = range_m[candidates] < free_range_m[row[candidates] - first_row, column[candidates]]
    votes[candidates[is_free]] += increment


@cache
def get_fastest_kernel(array_kernel: Kernel) -> Kernel:
    """Get the compiled twin of a function over arrays.

    Args:
        array_kernel: Function `..._by_arrays`, whose twin in `compiled_kernels` is called `..._by_loop`.

    Returns:
        The twin; the function itself where numba is missing.
    """
    try:
        from torchcover.recordings import compiled_kernels
    except ImportError:
        return array_kernel
    kernel: Kernel = getattr(compiled_kernels, array_kernel.__name__.replace("arrays", "loop"))
    return kernel
