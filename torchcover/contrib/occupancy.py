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

from torchcover.contrib.voxel_walk import VoxelGrid
from torchcover.detection import Boxes
from torchcover.geometry import BoundingBox
from torchcover.geometry.arrays import Bools, Float64, Int32, Int64

# Columns of the table: the place in time of the frame, what stands for its content, the number of the category (of the
# frame itself: -1), and the box as in `Boxes.rows`.
COLUMNS = 10
PLACE, CONTENT, CATEGORY, BOX = 0, 1, 2, 3
FRAME = -1.0
# What float32 makes of a box's coordinates must not decide: its bottom on the ground may be level with centres.
ROUNDING_M = 1e-5


def occupancy_rows(boxes: Boxes, place_in_time: int, categories: Sequence[str], region: BoundingBox) -> Tensor:
    """(1 + K, 10) rows of a table for a frame: its own, and those of its boxes near the region."""
    boxes = boxes.of_category(*categories)
    rows = boxes.rows.double().cpu()
    half = rows[:, 3:6] / 2
    half[:, :2] = torch.linalg.vector_norm(half[:, :2], dim=1, keepdim=True)
    low, high = (torch.tensor(corner, dtype=torch.float64, device="cpu") for corner in (region.lower_m, region.upper_m))
    near = ((rows[:, :3] + half >= low) & (rows[:, :3] - half <= high)).all(dim=1)
    number = torch.tensor([categories.index(name) for name in boxes.categories], dtype=torch.float64, device="cpu")
    listed = torch.zeros(1 + int(near.sum()), COLUMNS, dtype=torch.float64, device="cpu")
    listed[0, CATEGORY] = FRAME
    listed[1:, CATEGORY] = number[near]
    listed[1:, BOX:] = rows[near]
    table: Tensor = torch.unique(listed, dim=0)
    # Frames of the same place and content are the same frame, seen again; 48 bits are exact in float64.
    table[:, CONTENT] = int.from_bytes(hashlib.sha256(table.numpy().tobytes()).digest()[:6], "big")
    table[:, PLACE] = place_in_time
    return table


@dataclass(frozen=True, eq=False)
class Occupancy:
    """In how many frames each voxel was inside a box of one category, in blocks of contiguous worlds.

    `voxels` (K,) are those that were in any, ascending; `pattern` (K,) is which row of `counts` (P, B), frames of each
    block, is theirs: many have the same. `steps` (B,) are all frames, `boxes` how many held the centre of a voxel.
    """

    voxels: Int64
    pattern: Int64
    counts: Int64
    steps: Int64
    boxes: int

    def entropy_nats(self, times: NDArray[np.float64 | np.bool_], weights: Float64) -> Float64:
        """(R,) sum over the voxels of Hb(p) = -p ln p - (1 - p) ln(1 - p); NaN where no frame counts.

        `times` (voxels of the grid,) is how often each voxel counts, `weights` (R, B) how often each block of worlds
        does.
        """
        of_pattern = np.bincount(self.pattern, weights=times[self.voxels], minlength=len(self.counts))
        steps = weights @ self.steps
        with np.errstate(invalid="ignore", divide="ignore"):
            total = [
                binary_entropy(self.counts @ one / all_steps) @ of_pattern
                for one, all_steps in zip(weights, steps, strict=True)
            ]
        return np.where(steps > 0, total, np.nan)


def binary_entropy(p: Float64) -> Float64:
    """-p ln p - (1 - p) ln(1 - p) in nats; 0 at 0 and 1."""
    inside = (p > 0) & (p < 1)
    p = np.where(inside, p, 0.5)
    return np.where(inside, -p * np.log(p) - (1 - p) * np.log1p(-p), 0.0)


def occupancy_of(table: Float64, category: int, grid: VoxelGrid, blocks: int) -> Occupancy:
    """The occupancy by the boxes of one category, from (N, 10) rows of `occupancy_rows` in ascending order.

    A voxel is inside a box if its centre is; of a box that leaves the region, the voxels in the region count. Boxes of
    one frame that overlap count once. The number of blocks is even.
    """
    own, centres_m = table[:, CATEGORY] == FRAME, grid.centres_m()
    block_of = (table[:, PLACE] // block_length(table[own, PLACE], blocks)).astype(np.int64)
    in_frame, counted = np.zeros(grid.voxels, dtype=bool), np.zeros(grid.voxels, dtype=np.int32)
    found: list[tuple[Int64, Int32]] = []
    boxes = 0
    for block in range(blocks):
        touched = [np.empty(0, dtype=np.int64)]
        for frame in _frames(table[block_of == block]):
            seen_again = int((frame[:, CATEGORY] == FRAME).sum())
            rows = frame[frame[:, CATEGORY] == category, BOX:]
            inside = [voxels_in_box(centres_m, box) for box in rows[::seen_again]]
            boxes += seen_again * sum(len(voxels) > 0 for voxels in inside)
            for voxels in inside:
                first = voxels[~in_frame[voxels]]
                touched.append(first[counted[first] == 0])
                counted[first] += seen_again
                in_frame[first] = True
            for voxels in inside:
                in_frame[voxels] = False
        voxels = np.sort(np.concatenate(touched))
        found.append((voxels, counted[voxels]))
        counted[voxels] = 0
    for voxels, _ in found:
        in_frame[voxels] = True
    every = np.flatnonzero(in_frame)
    in_frame[every] = False
    pattern, counts = _patterns(every, found, in_frame)
    return Occupancy(every, pattern, counts, np.bincount(block_of[own], minlength=blocks), boxes)


def _patterns(
    every: Int64,
    found: Sequence[tuple[Int64, Int32]],
    marks: Bools,
) -> tuple[Int64, Int64]:
    """(K,) pattern of each voxel and (P, B) what the patterns are, from the voxels and their counts in each block."""
    pattern, counts = np.zeros(len(every), dtype=np.int64), np.zeros((1, 0), dtype=np.int64)
    for voxels, count in found:
        column = np.zeros(len(every), dtype=np.int64)
        marks[voxels] = True
        column[marks[every]] = count  # both are in ascending order
        marks[voxels] = False
        most = int(column.max(initial=0)) + 1
        pairs = pattern * most + column
        there = np.zeros(len(counts) * most, dtype=bool)
        there[pairs] = True
        pattern = (there.cumsum() - 1)[pairs]
        before, now = np.divmod(np.flatnonzero(there), most)
        counts = np.column_stack([counts[before], now])
    return pattern, counts


def block_length(places: Float64, blocks: int) -> int:
    """How many places in time are in a block, as `CoverageMetric` doubles it."""
    length = 1
    while len(places) and places.max() >= blocks * length:
        length *= 2
    return length


def voxels_in_box(centres_m: Sequence[Float64], box: Float64) -> Int64:
    """Numbers of the voxels whose centre, as of `VoxelGrid.centres_m`, is in a box, a row of `Boxes.rows`.

    Half-open: boxes side by side share none.

    Example:
        >>> grid = VoxelGrid(BoundingBox((0.0, 0.0, 0.0), (4.0, 4.0, 1.0)), 1.0)
        >>> voxels_in_box(grid.centres_m(), np.array([2.0, 0.5, 0.5, 2.0, 0.2, 1.0, 0.0]))
        array([4, 8])
    """
    (x_m, y_m, z_m), reach_m = centres_m, math.hypot(box[3], box[4]) / 2 + ROUNDING_M
    x0, x1 = np.searchsorted(x_m, (box[0] - reach_m, box[0] + reach_m))
    y0, y1 = np.searchsorted(y_m, (box[1] - reach_m, box[1] + reach_m))
    off_x, off_y = x_m[x0:x1, None] - box[0], y_m[y0:y1] - box[1]
    cosine, sine = math.cos(box[6]), math.sin(box[6])
    ahead, left = off_x * cosine + off_y * sine, off_y * cosine - off_x * sine
    x, y = (_within(ahead, box[3]) & _within(left, box[4])).nonzero()
    z = np.flatnonzero(_within(z_m - box[2], box[5]))
    column = (x + x0) * len(y_m) + y + y0
    return np.asarray((column[:, None] * len(z_m) + z).reshape(-1))


def _within(offset_m: Float64, extent_m: float) -> Bools:
    offset_m = offset_m + ROUNDING_M
    return np.asarray((offset_m >= -extent_m / 2) & (offset_m < extent_m / 2))


def _frames(table: Float64) -> list[Float64]:
    """The rows of each frame, from those of several in ascending order."""
    borders = np.flatnonzero((np.diff(table[:, : CONTENT + 1], axis=0) != 0).any(axis=1)) + 1
    return np.split(table, borders) if len(table) else []
