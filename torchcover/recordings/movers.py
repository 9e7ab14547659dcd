"""What moves in a recording: clusters of what later scans have seen past, and their velocities, undone.

A cluster of one scan is moved with every velocity there could be, and the one with which most of it falls on such
points of the scans just before and after is its own. What other scans have of it is put where it is at the instant.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.recordings.free_space import get_fastest_kernel

Float64 = NDArray[np.float64]
Cells = NDArray[np.int64]

# Seen from above; parts of a thing are at most so many cells apart.
CELL_M, GAP = 0.3, 3
# Of fewer points nothing is known; of more, about so many are moved.
FEWEST, MOST = 5, 60
# Scans that a cluster is compared with; velocities that are tried, first by coarse steps; of several that fit as well
# the slower one: so much overlap is worth a metre a second. With less overlap nothing is found.
COMPARED, FASTEST_MPS, STEPS_MPS, SLOWER, OVERLAP = 8, 45.0, (1.5, 0.5, 0.25), 2e-3, 0.5
# What scans within this time have of it is put together; those within the longer one are compared.
TOGETHER_S, COMPARED_S = 0.31, 0.61
# Nothing is looked for farther away.
WITHIN_M = 165.0


class MovingCluster(NamedTuple):
    """Something that moves.

    `points_m`: (N, 3) where it is at the instant; `velocity_mps`: (2,) along x and y of the frame of the points.
    """

    points_m: Float64
    velocity_mps: Float64


def find_moving_clusters(scans_m: Sequence[Float64], times_s: Float64) -> list[MovingCluster]:
    """What moves, or has stood for a moment only.

    `scans_m`: (N, 3) points of each scan that belong to nothing that stands; `times_s`: (S,) when each scan was, from
    the instant on; those of one time are one.
    """
    found: list[MovingCluster] = []
    # What one of several sensors sees is in no scan of the others.
    times_s, turn = np.unique(times_s, return_inverse=True)
    of_times = (
        [each for each, of in zip(scans_m, turn, strict=True) if of == number] for number in range(len(times_s))
    )
    scans_m = [np.concatenate(of_time) for of_time in of_times]
    if sum(map(len, scans_m)) < FEWEST or len(scans_m) < 2:
        return found
    lower_m = np.min([points_m[:, :2].min(axis=0) for points_m in scans_m if len(points_m)], axis=0) - 2 * CELL_M
    cells = [((points_m[:, :2] - lower_m) / CELL_M).astype(np.int64) for points_m in scans_m]
    shape = np.max([cell.max(axis=0) for cell in cells if len(cell)], axis=0) + 3
    filled = np.stack([_filled(cell, shape) for cell in cells])
    left = [np.ones(len(points_m), np.bool_) for points_m in scans_m]
    together = sorted(map(int, np.flatnonzero(np.abs(times_s) <= TOGETHER_S)), key=lambda one: abs(times_s[one]))
    for scan in together:
        others = np.sort(np.argsort(np.abs(times_s - times_s[scan]), kind="stable")[1 : COMPARED + 1])
        since_s = np.ascontiguousarray(times_s[others] - times_s[scan])
        rows = np.flatnonzero(left[scan])
        for cluster in _clusters(cells[scan][rows], shape):
            if len(cluster) < FEWEST:
                continue
            own = rows[cluster]
            places_m = np.ascontiguousarray(scans_m[scan][own[:: max(1, len(own) // MOST)], :2])
            velocity_mps, overlap = _velocity(places_m - lower_m, since_s, np.ascontiguousarray(filled[others]))
            if overlap < OVERLAP:
                continue
            parts = []
            low = cells[scan][own].min(axis=0) - 1
            within = _filled(cells[scan][own] - low, cells[scan][own].max(axis=0) - low + 3) > 0
            for other in together:
                back_m = scans_m[other][:, :2] - velocity_mps * (times_s[other] - times_s[scan]) - lower_m
                cell = np.floor(back_m / CELL_M).astype(np.int64) - low
                same = np.flatnonzero(left[other] & ((cell >= 0) & (cell < within.shape)).all(axis=1))
                same = same[within[tuple(cell[same].T)]]
                left[other][same] = False
                there_m = scans_m[other][same].copy()
                there_m[:, :2] -= velocity_mps * times_s[other]
                parts.append(there_m)
            found.append(MovingCluster(np.concatenate(parts), velocity_mps))
    return found


def _filled(cells: Cells, shape: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Over all cells: 2 where one is filled, 1 beside one."""
    filled = np.zeros(shape, np.uint8)
    filled[tuple(cells.T)] = 1
    beside = filled.copy()
    for axis in (0, 1):
        ahead, behind = ((slice(1, None), slice(None)), (slice(None, -1), slice(None)))
        ahead, behind = (ahead, behind) if axis == 0 else (ahead[::-1], behind[::-1])
        grown = beside.copy()
        grown[ahead] |= beside[behind]
        grown[behind] |= beside[ahead]
        beside = grown
    return filled + beside


def _clusters(cells: Cells, shape: NDArray[np.int64]) -> list[Cells]:
    """Numbers of the points of each cluster: of cells that are at most `GAP` apart, one after the other."""
    column = shape[1] + GAP  # so that the last cells of one are not beside the first of the next
    number, of_point = np.unique(cells[:, 0] * column + cells[:, 1], return_inverse=True)
    label = np.arange(len(number))
    steps = [dx * column + dy for dx in range(GAP + 1) for dy in range(-GAP, GAP + 1) if (dx, dy) > (0, 0)]
    pairs = []
    for step in steps:
        at = np.minimum(np.searchsorted(number, number + step), max(len(number) - 1, 0))
        near = np.flatnonzero(number[at] == number + step)
        pairs.append(np.stack([near, at[near]]))
    one, other = np.concatenate(pairs, axis=1)
    while len(one):
        low = np.minimum(label[one], label[other])
        if (low == label[one]).all() and (low == label[other]).all():
            break
        np.minimum.at(label, label[one], low)
        np.minimum.at(label, label[other], low)
        label = label[label]
    own = label[of_point]
    order = np.argsort(own, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(own[order])) + 1) if len(order) else []


def _velocity(places_m: Float64, since_s: Float64, filled: NDArray[np.uint8]) -> tuple[Float64, float]:
    """The velocity with which (N, 2) places fall on what is filled at other times, and how much of them does."""
    velocity_mps, half_mps = np.zeros(2), FASTEST_MPS
    for step_mps in STEPS_MPS:
        side = np.arange(-half_mps, half_mps + step_mps / 2, step_mps)
        tried = velocity_mps + np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
        overlap = np.empty(len(tried))
        get_fastest_kernel(compute_overlap_by_arrays)(places_m, since_s, filled, CELL_M, tried, overlap)
        worth = overlap - SLOWER * np.linalg.norm(tried, axis=1)
        best = worth >= worth.max() - 1e-9
        velocity_mps, half_mps = tried[best].mean(axis=0), step_mps
    return velocity_mps, float(overlap[best].max())


def compute_overlap_by_arrays(
    positions_m: Float64,
    time_offsets_s: Float64,
    occupancy: NDArray[np.uint8],
    cell_m: float,
    velocities_mps: Float64,
    overlap: Float64,
) -> None:
    """How much of what each velocity makes of places is filled at other times, where numba is missing."""
    overlap[:] = 0.0
    for apart_s, grid in zip(time_offsets_s, occupancy, strict=True):
        cell = np.floor((positions_m + apart_s * velocities_mps[:, None]) / cell_m).astype(np.int64)
        inside = ((cell >= 0) & (cell < grid.shape)).all(axis=-1)
        x, y = np.where(inside[..., None], cell, 0).transpose(2, 0, 1)
        overlap += (grid[x, y] * inside).sum(axis=1)
    overlap /= 2.0 * len(time_offsets_s) * len(positions_m)
