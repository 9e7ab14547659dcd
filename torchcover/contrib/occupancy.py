"""Probabilistic occupancy grids: share of frames in which each voxel is inside an object."""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.contrib.voxels import VoxelGrid
from torchcover.detection import Boxes
from torchcover.geometry import BoundingBox
from torchcover.geometry.arrays import Bools, Float64, Int32, Int64

# Columns of the table of objects: index of the frame in time, hash of its content, index of the category (-1 for the
# row of the frame itself), and the box as in `Boxes.rows`.
NUM_COLUMNS = 10
BLOCK_INDEX_COLUMN = 0
CONTENT_COLUMN = 1
CATEGORY_COLUMN = 2
BOX_COLUMN = 3
FRAME_ROW = -1.0
# Offset against rounding of box coordinates to float32: the bottom of a box may be level with centers of voxels.
ROUNDING_M = 1e-5


def build_occupancy_rows(boxes: Boxes, block_index: int, categories: Sequence[str], region: BoundingBox) -> Tensor:
    """Build the rows of a frame in the table of objects.

    Args:
        boxes: Boxes of the frame.
        block_index: Index of the frame in time.
        categories: Categories of the metric; boxes of other categories are excluded.
        region: Region of the voxels; boxes that cannot overlap it are excluded.

    Returns:
        (1 + K, 10) float64: the row of the frame, and those of its K boxes, in ascending order.
    """
    boxes = boxes.select_categories(*categories)
    rows = boxes.rows.double().cpu()
    half_size = rows[:, 3:6] / 2
    half_size[:, :2] = torch.linalg.vector_norm(half_size[:, :2], dim=1, keepdim=True)
    low = torch.tensor(region.lower_m, dtype=torch.float64, device="cpu")
    high = torch.tensor(region.upper_m, dtype=torch.float64, device="cpu")
    is_near = ((rows[:, :3] + half_size >= low) & (rows[:, :3] - half_size <= high)).all(dim=1)
    category_indices = [categories.index(category) for category in boxes.categories]
    table = torch.zeros(1 + int(is_near.sum()), NUM_COLUMNS, dtype=torch.float64, device="cpu")
    table[0, CATEGORY_COLUMN] = FRAME_ROW
    table[1:, CATEGORY_COLUMN] = torch.tensor(category_indices, dtype=torch.float64, device="cpu")[is_near]
    table[1:, BOX_COLUMN:] = rows[is_near]
    sorted_table: Tensor = torch.unique(table, dim=0)
    # Frames with equal index and content are repetitions of one frame; 48 bits are exact in float64.
    digest = hashlib.sha256(sorted_table.numpy().tobytes()).digest()
    sorted_table[:, CONTENT_COLUMN] = int.from_bytes(digest[:6], "big")
    sorted_table[:, BLOCK_INDEX_COLUMN] = block_index
    return sorted_table


@dataclass(frozen=True, eq=False)
class Occupancy:
    """Number of frames in which each voxel was inside a box of one category, in blocks of contiguous scenes.

    Args:
        voxels: (K,) indices of voxels that were inside a box in any frame, ascending.
        pattern_indices: (K,) row of `counts` of each voxel; many voxels share a row.
        counts: (P, B) frames of each block.
        frame_counts: (B,) all frames of each block.
        box_count: Number of boxes that contained the center of a voxel.
    """

    voxels: Int64
    pattern_indices: Int64
    counts: Int64
    frame_counts: Int64
    box_count: int

    def compute_entropy_nats(
        self, voxel_multiplicities: NDArray[np.float64 | np.bool_], block_weights: Float64
    ) -> Float64:
        """Compute the sum over the voxels of Hb(p) = -p ln p - (1 - p) ln(1 - p).

        Args:
            voxel_multiplicities: (voxels of the grid,) how often each voxel counts.
            block_weights: (R, B) how often each block counts.

        Returns:
            (R,) nats; NaN where no frame counts.
        """
        pattern_multiplicities = np.bincount(
            self.pattern_indices, weights=voxel_multiplicities[self.voxels], minlength=len(self.counts)
        )
        frame_counts = block_weights @ self.frame_counts
        totals = []
        with np.errstate(invalid="ignore", divide="ignore"):
            for weights, frame_count in zip(block_weights, frame_counts, strict=True):
                entropies = compute_binary_entropy_nats(self.counts @ weights / frame_count)
                totals.append(entropies @ pattern_multiplicities)
        return np.where(frame_counts > 0, totals, np.nan)


def compute_binary_entropy_nats(probability: Float64) -> Float64:
    """Compute -p ln p - (1 - p) ln(1 - p), with 0 at p = 0 and p = 1.

    Args:
        probability: (...) probabilities p.

    Returns:
        (...) nats.
    """
    is_uncertain = (probability > 0) & (probability < 1)
    probability = np.where(is_uncertain, probability, 0.5)
    entropy = -probability * np.log(probability) - (1 - probability) * np.log1p(-probability)
    return np.where(is_uncertain, entropy, 0.0)


def build_occupancy(table: Float64, category_index: int, grid: VoxelGrid, num_blocks: int) -> Occupancy:
    """Compute the occupancy by the boxes of one category.

    A voxel is inside a box if its center is; of a box that leaves the region, the voxels in the region count.
    Overlapping boxes of one frame count once.

    Args:
        table: (N, 10) rows of `build_occupancy_rows`, in ascending order.
        category_index: Index of the category.
        grid: Voxels.
        num_blocks: Even number of blocks.
    """
    is_frame_row, centers_m = table[:, CATEGORY_COLUMN] == FRAME_ROW, grid.compute_centers_m()
    block_indices = table[:, BLOCK_INDEX_COLUMN]
    frames_per_block = compute_frames_per_block(block_indices[is_frame_row], num_blocks)
    row_blocks = (block_indices // frames_per_block).astype(np.int64)
    is_marked, counts = np.zeros(grid.num_voxels, dtype=bool), np.zeros(grid.num_voxels, dtype=np.int32)
    block_counts: list[tuple[Int64, Int32]] = []
    box_count = 0
    for block in range(num_blocks):
        touched = [np.empty(0, dtype=np.int64)]
        for frame_rows in _split_frames(table[row_blocks == block]):
            repetitions = int((frame_rows[:, CATEGORY_COLUMN] == FRAME_ROW).sum())
            box_rows = frame_rows[frame_rows[:, CATEGORY_COLUMN] == category_index, BOX_COLUMN:]
            box_voxels = [find_voxels_in_box(centers_m, box_row) for box_row in box_rows[::repetitions]]
            for voxels in box_voxels:
                box_count += repetitions * (len(voxels) > 0)
                new_voxels = voxels[~is_marked[voxels]]
                touched.append(new_voxels[counts[new_voxels] == 0])
                counts[new_voxels] += repetitions
                is_marked[new_voxels] = True
            for voxels in box_voxels:
                is_marked[voxels] = False
        voxels = np.sort(np.concatenate(touched))
        block_counts.append((voxels, counts[voxels]))
        counts[voxels] = 0
    for voxels, _ in block_counts:
        is_marked[voxels] = True
    occupied = np.flatnonzero(is_marked)
    is_marked[occupied] = False
    pattern_indices, patterns = _compress_counts(occupied, block_counts, is_marked)
    frame_counts = np.bincount(row_blocks[is_frame_row], minlength=num_blocks)
    return Occupancy(occupied, pattern_indices, patterns, frame_counts, box_count)


def _compress_counts(
    occupied: Int64, block_counts: Sequence[tuple[Int64, Int32]], is_marked: Bools
) -> tuple[Int64, Int64]:
    """Compress counts over voxels and blocks to (K,) indices of patterns and (P, B) distinct patterns.

    Args:
        occupied: (K,) voxels, ascending.
        block_counts: Voxels, ascending, and their counts for each block.
        is_marked: Work array over all voxels, False everywhere.
    """
    pattern, patterns = np.zeros(len(occupied), dtype=np.int64), np.zeros((1, 0), dtype=np.int64)
    for voxels, count in block_counts:
        column = np.zeros(len(occupied), dtype=np.int64)
        is_marked[voxels] = True
        column[is_marked[occupied]] = count  # both are in ascending order
        is_marked[voxels] = False
        base = int(column.max(initial=0)) + 1
        pairs = pattern * base + column
        is_present = np.zeros(len(patterns) * base, dtype=bool)
        is_present[pairs] = True
        pattern = (is_present.cumsum() - 1)[pairs]
        previous, last = np.divmod(np.flatnonzero(is_present), base)
        patterns = np.column_stack([patterns[previous], last])
    return pattern, patterns


def compute_frames_per_block(block_indices: Float64, num_blocks: int) -> int:
    """Compute the length of blocks, which doubles as in `CoverageMetric`.

    Args:
        block_indices: Indices of all frames in time.
        num_blocks: Number of blocks.

    Returns:
        Number of indices per block.
    """
    length = 1
    while len(block_indices) and block_indices.max() >= num_blocks * length:
        length *= 2
    return length


def find_voxels_in_box(centers_m: Sequence[Float64], box_row: Float64) -> Int64:
    """Find the voxels whose center is in a half-open box, so that adjacent boxes share none.

    Args:
        centers_m: (X,), (Y,) and (Z,) coordinates, as from `VoxelGrid.compute_centers_m`.
        box_row: (7,) row of `Boxes.rows`.

    Returns:
        (K,) indices of voxels.

    Example:
        >>> grid = VoxelGrid(BoundingBox((0.0, 0.0, 0.0), (4.0, 4.0, 1.0)), 1.0)
        >>> find_voxels_in_box(grid.compute_centers_m(), np.array([2.0, 0.5, 0.5, 2.0, 0.2, 1.0, 0.0]))
        array([4, 8])
    """
    x_m, y_m, z_m = centers_m
    reach_m = math.hypot(box_row[3], box_row[4]) / 2 + ROUNDING_M
    x0, x1 = np.searchsorted(x_m, (box_row[0] - reach_m, box_row[0] + reach_m))
    y0, y1 = np.searchsorted(y_m, (box_row[1] - reach_m, box_row[1] + reach_m))
    offset_x_m, offset_y_m = x_m[x0:x1, None] - box_row[0], y_m[y0:y1] - box_row[1]
    cosine, sine = math.cos(box_row[6]), math.sin(box_row[6])
    forward_m, left_m = offset_x_m * cosine + offset_y_m * sine, offset_y_m * cosine - offset_x_m * sine
    x, y = (_is_in_extent(forward_m, box_row[3]) & _is_in_extent(left_m, box_row[4])).nonzero()
    z = np.flatnonzero(_is_in_extent(z_m - box_row[2], box_row[5]))
    column = (x + x0) * len(y_m) + y + y0
    return np.asarray((column[:, None] * len(z_m) + z).reshape(-1))


def _is_in_extent(offset_m: Float64, extent_m: float) -> Bools:
    """Return whether offsets from a center lie in a half-open extent."""
    offset_m = offset_m + ROUNDING_M
    return np.asarray((offset_m >= -extent_m / 2) & (offset_m < extent_m / 2))


def _split_frames(table: Float64) -> list[Float64]:
    """Split rows in ascending order by frame."""
    is_new_frame = (np.diff(table[:, : CONTENT_COLUMN + 1], axis=0) != 0).any(axis=1)
    return np.split(table, np.flatnonzero(is_new_frame) + 1) if len(table) else []
