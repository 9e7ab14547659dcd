"""How often each voxel is inside an object: the probabilistic occupancy grid (POG), and its entropy.

Its state is the objects' boxes, a row for each: some megabytes for thousands of frames, whatever the size of a voxel.
"""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.data import Frame
from torchcover.geometry import BoundingBox, VoxelGrid

# Columns of the table: the place in time of the frame, what stands for its content, the number of the category (of the
# frame itself: -1), and the box as in `Boxes.rows`.
COLUMNS = 10
PLACE, CONTENT, CATEGORY, BOX = 0, 1, 2, 3
FRAME = -1.0
# Voxels whose entropy is computed together.
VOXELS_AT_ONCE = 1 << 16


def occupancy_rows(frame: Frame, categories: Sequence[str], region: BoundingBox) -> Tensor:
    """(1 + K, 10) rows of a table for a frame: its own, and those of its boxes near the region.

    Raises:
        ValueError: The frame has no boxes, not even an empty list of them.
    """
    if frame.boxes is None:
        raise ValueError(
            f"frame {frame.name!r} has no boxes, which occupancy is made of; SimulatedFrames(..., boxes=True) makes "
            "them"
        )
    boxes = frame.boxes.of_category(*categories)
    rows = boxes.rows.double().cpu()
    half = rows[:, 3:6] / 2
    half[:, :2] = torch.linalg.vector_norm(half[:, :2], dim=1, keepdim=True)
    low, high = (torch.tensor(corner, dtype=torch.float64) for corner in (region.lower_m, region.upper_m))
    near = ((rows[:, :3] + half >= low) & (rows[:, :3] - half <= high)).all(dim=1)
    number = torch.tensor([categories.index(name) for name in boxes.categories], dtype=torch.float64)
    table = torch.zeros(1 + int(near.sum()), COLUMNS, dtype=torch.float64)
    table[0, CATEGORY] = FRAME
    table[1:, CATEGORY] = number[near]
    table[1:, BOX:] = rows[near]
    table = torch.unique(table, dim=0)
    # Frames of the same place and content are the same frame, seen again; 48 bits are exact in float64.
    table[:, CONTENT] = int.from_bytes(hashlib.sha256(table.numpy().tobytes()).digest()[:6], "big")
    table[:, PLACE] = frame.place_in_time
    return table


@dataclass(frozen=True, eq=False)
class Occupancy:
    """In how many frames each voxel was inside a box of one category, in blocks of contiguous worlds.

    Args:
        voxels: (K,) numbers of the voxels that were in any, ascending.
        counts: (K, B) frames of each block.
        steps: (B,) frames of each block in all.
        boxes: How many boxes there were that hold the centre of a voxel.
    """

    voxels: NDArray[np.int64]
    counts: NDArray[np.int32]
    steps: NDArray[np.int64]
    boxes: int

    @property
    def probability(self) -> NDArray[np.float64]:
        """(K,) share of all frames."""
        share: NDArray[np.float64] = self.counts.sum(axis=1) / self.steps.sum()
        return share

    def entropy_nats(
        self, weights: NDArray[np.float64], times: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """(R,) sum over the voxels of Hb(p) = -p ln p - (1 - p) ln(1 - p).

        Args:
            weights: (R, B) how often each block counts.
            times: (K,) how often each voxel does; once if not given.

        Returns:
            NaN where no frame counts.
        """
        steps = weights @ self.steps
        total = np.zeros(len(weights))
        with np.errstate(invalid="ignore", divide="ignore"):
            for start in range(0, len(self.voxels), VOXELS_AT_ONCE):
                some = slice(start, start + VOXELS_AT_ONCE)
                entropy = binary_entropy(self.counts[some] @ weights.T / steps)
                total += entropy.sum(axis=0) if times is None else times[some] @ entropy
        return np.where(steps > 0, total, np.nan)


def binary_entropy(p: NDArray[np.float64]) -> NDArray[np.float64]:
    """-p ln p - (1 - p) ln(1 - p) in nats; 0 at 0 and 1.

    Example:
        >>> binary_entropy(np.array([0.0, 0.1, 0.5, 1.0])).round(6).tolist()
        [0.0, 0.325083, 0.693147, 0.0]
    """
    inside = (p > 0) & (p < 1)
    p = np.where(inside, p, 0.5)
    return np.where(inside, -p * np.log(p) - (1 - p) * np.log1p(-p), 0.0)


def occupancy_of(
    table: NDArray[np.float64], category: int, grid: VoxelGrid, blocks: int, within: NDArray[np.bool_] | None = None
) -> Occupancy:
    """The occupancy by the boxes of one category.

    A voxel is inside a box if its centre is, sides included; of a box that leaves the region, the voxels in the region
    count. Boxes of one frame that overlap count once.

    Args:
        table: (N, 10) rows of frames, from `occupancy_rows`, in ascending order.
        category: Number of the category.
        grid: The voxels.
        blocks: Number of blocks, an even number.
        within: (X, Y, Z) the voxels that are asked for; all if not given.
    """
    own, centres_m = table[:, CATEGORY] == FRAME, grid.centres_m()
    length = block_length(table[own, PLACE], blocks)
    block_of = (table[:, PLACE] // length).astype(np.int64)
    wanted = np.ones(grid.voxels, dtype=bool) if within is None else within.reshape(-1)
    in_frame, counted = np.zeros(grid.voxels, dtype=bool), np.zeros(grid.voxels, dtype=np.int32)
    found: list[tuple[NDArray[np.int64], NDArray[np.int32]]] = []
    boxes = 0
    for block in range(blocks):
        touched = [np.empty(0, dtype=np.int64)]
        for frame in _frames(table[block_of == block]):
            seen_again = int((frame[:, CATEGORY] == FRAME).sum())
            rows = frame[frame[:, CATEGORY] == category, BOX:]
            inside = [voxels_in_box(centres_m, box) for box in rows[:: max(seen_again, 1)]]
            boxes += seen_again * sum(len(voxels) > 0 for voxels in inside)
            for voxels in inside:
                first = voxels[~in_frame[voxels] & wanted[voxels]]
                touched.append(first[counted[first] == 0])
                counted[first] += seen_again
                in_frame[voxels] = True
            for voxels in inside:
                in_frame[voxels] = False
        voxels = np.sort(np.concatenate(touched))
        found.append((voxels, counted[voxels]))
        counted[voxels] = 0
    every = np.unique(np.concatenate([voxels for voxels, _ in found]))
    counts = np.zeros((len(every), blocks), dtype=np.int32)
    for block, (voxels, count) in enumerate(found):
        counts[np.searchsorted(every, voxels), block] = count
    return Occupancy(every, counts, np.bincount(block_of[own], minlength=blocks), boxes)


def block_length(places: NDArray[np.float64], blocks: int) -> int:
    """How many places in time are in a block, as `CoverageMetric` doubles it."""
    length = 1
    while len(places) and places.max() >= blocks * length:
        length *= 2
    return length


def voxels_in_box(centres_m: Sequence[NDArray[np.float64]], box: NDArray[np.float64]) -> NDArray[np.int64]:
    """Numbers of the voxels whose centre is in a box.

    Args:
        centres_m: (X,), (Y,) and (Z,) from `VoxelGrid.centres_m`.
        box: x, y, z of the centre, length, width, height, yaw.

    Example:
        >>> grid = VoxelGrid(BoundingBox((0.0, 0.0, 0.0), (4.0, 4.0, 1.0)), 1.0)
        >>> voxels_in_box(grid.centres_m(), np.array([2.0, 0.5, 0.5, 2.0, 0.2, 1.0, 0.0]))
        array([4, 8])
    """
    (x_m, y_m, z_m), reach = centres_m, math.hypot(box[3], box[4]) / 2
    x0, x1 = np.searchsorted(x_m, (box[0] - reach, box[0] + reach))
    y0, y1 = np.searchsorted(y_m, (box[1] - reach, box[1] + reach))
    beside_x, beside_y = x_m[x0:x1, None] - box[0], y_m[y0:y1] - box[1]
    cosine, sine = math.cos(box[6]), math.sin(box[6])
    beside = (np.abs(beside_x * cosine + beside_y * sine) <= box[3] / 2) & (
        np.abs(beside_y * cosine - beside_x * sine) <= box[4] / 2
    )
    x, y = beside.nonzero()
    z = np.flatnonzero(np.abs(z_m - box[2]) <= box[5] / 2)
    column = (x + x0) * len(y_m) + y + y0
    return (column[:, None] * len(z_m) + z).reshape(-1)


def _frames(table: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """The rows of each frame, from those of several in ascending order."""
    borders = np.flatnonzero((np.diff(table[:, : CONTENT + 1], axis=0) != 0).any(axis=1)) + 1
    return np.split(table, borders) if len(table) else []
