"""Moving objects without labels: clusters of points in free space, and their velocities.

A cluster of one scan is shifted with every velocity on a grid. The velocity with which most of it overlaps such points
of the scans just before and after is that of the cluster. Its points of all scans are moved to where it is in the frame
of interest.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.recordings.free_space import Float64, get_fastest_kernel

Cells = NDArray[np.int64]


@dataclass(frozen=True)
class MovingClusterParams:
    """Parameters of the search for moving objects.

    Args:
        cell_m: Side of a cell in bird's-eye view.
        max_gap_cells: Parts of one object are at most this many cells apart.
        min_points: Clusters of fewer points are ignored.
        max_shifted_points: Larger clusters are thinned to about this many points before they are shifted.
        num_compared_scans: Scans that a cluster is compared with.
        max_speed_mps: Largest speed that is tried, along each axis.
        speed_steps_mps: Steps of the velocity grid, from coarse to fine; each grid spans one step of the one before.
        overlap_per_mps: Overlap by which a velocity must be better per m/s of speed, so that of equal ones the slower
            one wins.
        min_overlap: Share of a cluster that must overlap for a velocity to count.
        max_merged_s: Points of scans within this time of the frame are merged into one object.
        max_compared_s: Scans within this time of the frame are compared.
        max_range_m: Points farther from the vehicle are ignored by callers.
    """

    cell_m: float = 0.3
    max_gap_cells: int = 3
    min_points: int = 5
    max_shifted_points: int = 60
    num_compared_scans: int = 8
    max_speed_mps: float = 45.0
    speed_steps_mps: tuple[float, ...] = (1.5, 0.5, 0.25)
    overlap_per_mps: float = 2e-3
    min_overlap: float = 0.5
    max_merged_s: float = 0.31
    max_compared_s: float = 0.61
    max_range_m: float = 165.0


class MovingCluster(NamedTuple):
    """Cluster of points that moves with one velocity.

    Args:
        points_m: (N, 3) points, moved to where the object is in the frame of interest.
        velocity_mps: (2,) velocity along x and y of the frame of the points.
    """

    points_m: Float64
    velocity_mps: Float64


def find_moving_clusters(
    scans_m: Sequence[Float64], times_s: Float64, params: MovingClusterParams = MovingClusterParams()
) -> list[MovingCluster]:
    """Find objects that move, or that stand in a place for a moment only.

    Args:
        scans_m: (N, 3) points of each scan that do not belong to static surfaces, in one fixed frame.
        times_s: (S,) time of each scan relative to the frame of interest; scans of equal times are joined.
        params: Parameters of the search.

    Returns:
        The objects; none if there are fewer than two times or hardly any points.
    """
    scans_m, times_s = _join_simultaneous_scans(scans_m, times_s)
    if sum(len(points_m) for points_m in scans_m) < params.min_points or len(scans_m) < 2:
        return []
    xy_m = np.concatenate(scans_m)[:, :2]
    lower_m = xy_m.min(axis=0) - 2 * params.cell_m
    all_cells = ((xy_m - lower_m) / params.cell_m).astype(np.int64)
    shape = all_cells.max(axis=0) + 3
    cells = np.split(all_cells, np.cumsum([len(points_m) for points_m in scans_m])[:-1])
    occupancy = np.stack([_rasterize_occupancy(cell, shape) for cell in cells])
    is_free = [np.ones(len(points_m), np.bool_) for points_m in scans_m]  # points that belong to no object yet
    distance_s = np.abs(times_s)
    merged_scans = np.flatnonzero(distance_s <= params.max_merged_s)
    merged_scans = merged_scans[np.argsort(distance_s[merged_scans], kind="stable")]
    moving_clusters: list[MovingCluster] = []
    for scan in merged_scans:
        order = np.argsort(np.abs(times_s - times_s[scan]), kind="stable")
        compared_scans = np.sort(order[1 : params.num_compared_scans + 1])
        offsets_s = np.ascontiguousarray(times_s[compared_scans] - times_s[scan])
        rows = np.flatnonzero(is_free[scan])
        for cluster in _find_clusters(cells[scan][rows], shape, params.max_gap_cells):
            if len(cluster) < params.min_points:
                continue
            members = rows[cluster]
            stride = max(1, len(members) // params.max_shifted_points)
            positions_m = np.ascontiguousarray(scans_m[scan][members[::stride], :2]) - lower_m
            velocity_mps, overlap = _estimate_velocity(
                positions_m, offsets_s, np.ascontiguousarray(occupancy[compared_scans]), params
            )
            if overlap < params.min_overlap:
                continue
            object_cells = cells[scan][members]
            first_cell = object_cells.min(axis=0) - 1
            footprint = _rasterize_occupancy(object_cells - first_cell, object_cells.max(axis=0) - first_cell + 3) > 0
            parts_m = []
            for merged_scan in merged_scans:
                points_m, time_s = scans_m[merged_scan], times_s[merged_scan]
                shifted_m = points_m[:, :2] - velocity_mps * (time_s - times_s[scan]) - lower_m
                cell = np.floor(shifted_m / params.cell_m).astype(np.int64) - first_cell
                is_inside = ((cell >= 0) & (cell < footprint.shape)).all(axis=1)
                same = np.flatnonzero(is_free[merged_scan] & is_inside)
                same = same[footprint[tuple(cell[same].T)]]
                is_free[merged_scan][same] = False
                part_m = points_m[same].copy()
                part_m[:, :2] -= velocity_mps * time_s
                parts_m.append(part_m)
            moving_clusters.append(MovingCluster(np.concatenate(parts_m), velocity_mps))
    return moving_clusters


def _join_simultaneous_scans(scans_m: Sequence[Float64], times_s: Float64) -> tuple[list[Float64], Float64]:
    """Join scans of one time: what one of several sensors observes may be in no scan of the others."""
    unique_times_s, time_index = np.unique(times_s, return_inverse=True)
    parts_m: list[list[Float64]] = [[] for _ in unique_times_s]
    for points_m, index in zip(scans_m, time_index, strict=True):
        parts_m[index].append(points_m)
    return [np.concatenate(parts) for parts in parts_m], unique_times_s


def _rasterize_occupancy(cells: Cells, shape: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Rasterize cells: 2 where a cell is occupied, 1 where one of its eight neighbors is, else 0."""
    occupied = np.zeros(shape, np.uint8)
    occupied[tuple(cells.T)] = 1
    over_rows = occupied.copy()
    over_rows[1:] |= occupied[:-1]
    over_rows[:-1] |= occupied[1:]
    neighborhood = over_rows.copy()
    neighborhood[:, 1:] |= over_rows[:, :-1]
    neighborhood[:, :-1] |= over_rows[:, 1:]
    return occupied + neighborhood


def _find_clusters(cells: Cells, shape: NDArray[np.int64], max_gap_cells: int) -> list[Cells]:
    """Find the rows of (N, 2) cells that form each cluster: cells at most `max_gap_cells` apart are connected."""
    stride = shape[1] + max_gap_cells  # keeps the last cells of a row away from the first of the next
    numbers, cell_of_point = np.unique(cells[:, 0] * stride + cells[:, 1], return_inverse=True)
    x_steps, y_steps = np.indices((max_gap_cells + 1, 2 * max_gap_cells + 1)).reshape(2, -1)
    y_steps = y_steps - max_gap_cells
    is_ahead = (x_steps > 0) | (y_steps > 0)  # each pair of neighbors once
    pairs = []
    for step in (x_steps * stride + y_steps)[is_ahead]:
        position = np.minimum(np.searchsorted(numbers, numbers + step), max(len(numbers) - 1, 0))
        has_neighbor = np.flatnonzero(numbers[position] == numbers + step)
        pairs.append(np.stack([has_neighbor, position[has_neighbor]]))
    first, second = np.concatenate(pairs, axis=1)
    label = np.arange(len(numbers))
    while len(first):
        smaller = np.minimum(label[first], label[second])
        if (smaller == label[first]).all() and (smaller == label[second]).all():
            break
        np.minimum.at(label, label[first], smaller)
        np.minimum.at(label, label[second], smaller)
        label = label[label]
    label_of_point = label[cell_of_point]
    order = np.argsort(label_of_point, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(label_of_point[order])) + 1) if len(order) else []


def _estimate_velocity(
    positions_m: Float64, offsets_s: Float64, occupancy: NDArray[np.uint8], params: MovingClusterParams
) -> tuple[Float64, float]:
    """Estimate the velocity with which (N, 2) positions overlap the occupied cells of other times, and the overlap."""
    compute_overlap = get_fastest_kernel(compute_overlap_by_arrays)
    velocity_mps, half_width_mps = np.zeros(2), params.max_speed_mps
    for step_mps in params.speed_steps_mps:
        axis_mps = np.arange(-half_width_mps, half_width_mps + step_mps / 2, step_mps)
        grid_mps = np.stack(np.meshgrid(axis_mps, axis_mps, indexing="ij"), axis=-1).reshape(-1, 2)
        candidates_mps = velocity_mps + grid_mps
        overlap = np.empty(len(candidates_mps))
        compute_overlap(positions_m, offsets_s, occupancy, params.cell_m, candidates_mps, overlap)
        score = overlap - params.overlap_per_mps * np.linalg.norm(candidates_mps, axis=1)
        is_best = score >= score.max() - 1e-9
        velocity_mps, half_width_mps = candidates_mps[is_best].mean(axis=0), step_mps
    return velocity_mps, float(overlap[is_best].max())


def compute_overlap_by_arrays(
    positions_m: Float64,
    time_offsets_s: Float64,
    occupancy: NDArray[np.uint8],
    cell_m: float,
    velocities_mps: Float64,
    overlap: Float64,
) -> None:
    """Compute the overlap of moved positions with occupied cells, with NumPy where numba is missing.

    Args:
        positions_m: (N, 2) positions from the corner of cell (0, 0).
        time_offsets_s: (S,) time of each scan relative to the positions.
        occupancy: (S, columns, rows) 2 where a cell is occupied, 1 where a neighbor is.
        cell_m: Side of a cell.
        velocities_mps: (V, 2) candidates.
        overlap: (V,) result, 0 to 1, changed in place.
    """
    overlap[:] = 0.0
    for offset_s, grid in zip(time_offsets_s, occupancy, strict=True):
        cell = np.floor((positions_m + offset_s * velocities_mps[:, None]) / cell_m).astype(np.int64)
        inside = ((cell >= 0) & (cell < grid.shape)).all(axis=-1)
        x, y = np.where(inside[..., None], cell, 0).transpose(2, 0, 1)
        overlap += (grid[x, y] * inside).sum(axis=1)
    overlap /= 2.0 * len(time_offsets_s) * len(positions_m)
