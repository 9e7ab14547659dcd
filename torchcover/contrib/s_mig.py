"""S-MIG (Hu et al. 2022): the entropy of a probabilistic occupancy grid (POG) along the rays of a rig, with minus.

The grid says how often each voxel is inside an object. Its state is the boxes of the objects, a row for each: some
megabytes for thousands of frames, whatever the size of a voxel.
"""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.contrib.frame_metric import BLOCKS, FrameMetric, describe_number
from torchcover.contrib.voxels import (
    REGION,
    VoxelGrid,
    check_sensors,
    count_rays,
    create_voxel_grid,
    mark_crossed_before_hits,
    mark_crossed_by_rays,
)
from torchcover.detection import Boxes
from torchcover.estimation import Estimate, Number
from torchcover.frames import Frame
from torchcover.geometry import BoundingBox
from torchcover.geometry.arrays import Bools, Float64, Int32, Int64
from torchcover.metrics import insert_rows
from torchcover.neighbors import check_cloud
from torchcover.simulation import Sensor

# Columns of the table: the place in time of the frame, what stands for its content, the number of the category (of the
# frame itself: -1), and the box as in `Boxes.rows`.
COLUMNS = 10
PLACE, CONTENT, CATEGORY, BOX = 0, 1, 2, 3
FRAME = -1.0
# What float32 makes of a box's coordinates must not decide: its bottom on the ground may be level with centres.
ROUNDING_M = 1e-5


def build_occupancy_rows(boxes: Boxes, block_index: int, categories: Sequence[str], region: BoundingBox) -> Tensor:
    """(1 + K, 10) rows of a table for a frame: its own, and those of its boxes near the region."""
    boxes = boxes.select_categories(*categories)
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
    table[:, PLACE] = block_index
    return table


@dataclass(frozen=True, eq=False)
class Occupancy:
    """In how many frames each voxel was inside a box of one category, in blocks of contiguous worlds.

    `voxels` (K,) are those that were in any, ascending; `pattern_indices` (K,) is which row of `counts` (P, B), frames of each
    block, is theirs: many have the same. `frame_counts` (B,) are all frames, `box_count` how many held the centre of a voxel.
    """

    voxels: Int64
    pattern_indices: Int64
    counts: Int64
    frame_counts: Int64
    box_count: int

    def compute_entropy_nats(
        self, voxel_multiplicities: NDArray[np.float64 | np.bool_], block_weights: Float64
    ) -> Float64:
        """(R,) sum over the voxels of Hb(p) = -p ln p - (1 - p) ln(1 - p); NaN where no frame counts.

        `voxel_multiplicities` (voxels of the grid,) is how often each voxel counts, `block_weights` (R, B) how often each block of worlds
        does.
        """
        of_pattern = np.bincount(
            self.pattern_indices, weights=voxel_multiplicities[self.voxels], minlength=len(self.counts)
        )
        steps = block_weights @ self.frame_counts
        with np.errstate(invalid="ignore", divide="ignore"):
            total = [
                compute_binary_entropy_nats(self.counts @ one / all_steps) @ of_pattern
                for one, all_steps in zip(block_weights, steps, strict=True)
            ]
        return np.where(steps > 0, total, np.nan)


def compute_binary_entropy_nats(probability: Float64) -> Float64:
    """-p ln p - (1 - p) ln(1 - p) in nats; 0 at 0 and 1."""
    inside = (probability > 0) & (probability < 1)
    probability = np.where(inside, probability, 0.5)
    return np.where(inside, -probability * np.log(probability) - (1 - probability) * np.log1p(-probability), 0.0)


def build_occupancy(table: Float64, category_index: int, grid: VoxelGrid, num_blocks: int) -> Occupancy:
    """The occupancy by the boxes of one category, from (N, 10) rows of `build_occupancy_rows` in ascending order.

    A voxel is inside a box if its centre is; of a box that leaves the region, the voxels in the region count. Boxes of
    one frame that overlap count once. The number of blocks is even.
    """
    own, centres_m = table[:, CATEGORY] == FRAME, grid.compute_centers_m()
    block_of = (table[:, PLACE] // compute_frames_per_block(table[own, PLACE], num_blocks)).astype(np.int64)
    in_frame, counted = np.zeros(grid.num_voxels, dtype=bool), np.zeros(grid.num_voxels, dtype=np.int32)
    found: list[tuple[Int64, Int32]] = []
    boxes = 0
    for block in range(num_blocks):
        touched = [np.empty(0, dtype=np.int64)]
        for frame in _frames(table[block_of == block]):
            seen_again = int((frame[:, CATEGORY] == FRAME).sum())
            rows = frame[frame[:, CATEGORY] == category_index, BOX:]
            inside = [find_voxels_in_box(centres_m, box) for box in rows[::seen_again]]
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
    return Occupancy(every, pattern, counts, np.bincount(block_of[own], minlength=num_blocks), boxes)


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


def compute_frames_per_block(block_indices: Float64, num_blocks: int) -> int:
    """How many places in time are in a block, as `CoverageMetric` doubles it."""
    length = 1
    while len(block_indices) and block_indices.max() >= num_blocks * length:
        length *= 2
    return length


def find_voxels_in_box(centers_m: Sequence[Float64], box_row: Float64) -> Int64:
    """Numbers of the voxels whose centre, as of `VoxelGrid.centres_m`, is in a box, a row of `Boxes.rows`.

    Half-open: boxes side by side share none.

    Example:
        >>> grid = VoxelGrid(BoundingBox((0.0, 0.0, 0.0), (4.0, 4.0, 1.0)), 1.0)
        >>> find_voxels_in_box(grid.compute_centers_m(), np.array([2.0, 0.5, 0.5, 2.0, 0.2, 1.0, 0.0]))
        array([4, 8])
    """
    (x_m, y_m, z_m), reach_m = centers_m, math.hypot(box_row[3], box_row[4]) / 2 + ROUNDING_M
    x0, x1 = np.searchsorted(x_m, (box_row[0] - reach_m, box_row[0] + reach_m))
    y0, y1 = np.searchsorted(y_m, (box_row[1] - reach_m, box_row[1] + reach_m))
    off_x, off_y = x_m[x0:x1, None] - box_row[0], y_m[y0:y1] - box_row[1]
    cosine, sine = math.cos(box_row[6]), math.sin(box_row[6])
    ahead, left = off_x * cosine + off_y * sine, off_y * cosine - off_x * sine
    x, y = (_within(ahead, box_row[3]) & _within(left, box_row[4])).nonzero()
    z = np.flatnonzero(_within(z_m - box_row[2], box_row[5]))
    column = (x + x0) * len(y_m) + y + y0
    return np.asarray((column[:, None] * len(z_m) + z).reshape(-1))


def _within(offset_m: Float64, extent_m: float) -> Bools:
    offset_m = offset_m + ROUNDING_M
    return np.asarray((offset_m >= -extent_m / 2) & (offset_m < extent_m / 2))


def _frames(table: Float64) -> list[Float64]:
    """The rows of each frame, from those of several in ascending order."""
    borders = np.flatnonzero((np.diff(table[:, : CONTENT + 1], axis=0) != 0).any(axis=1)) + 1
    return np.split(table, borders) if len(table) else []


CATEGORIES = ("car", "pedestrian", "cyclist")
FALLS = "S-MIG falls as more is covered, and is 0 without any ray: compare it among rigs with as many rays only"
# While it is computed: how often it is crossed, in a box of a frame, of a block. With occlusion the state, too.
BYTES_A_VOXEL, BYTES_A_VOXEL_OCCLUDED = 6, 21


class SMig(FrameMetric):
    """Entropy in nats of what is in the voxels that the rays of a rig cross, as a loss: S-MIG (Hu et al. 2022).

        p(v)  = share of frames in which voxel v is in a box of the category
        S-MIG = - sum over the distinct voxels v on the way of any ray of  -p ln p - (1 - p) ln(1 - p)

    with independent voxels. Higher is better, say its authors; yet it falls as more voxels are crossed, and a rig
    without rays has the highest value, 0. Its negative, which is in its `parameters["entropy_captured_nats"]`, is
    what roadside placement maximises (EGVS, Jiang 2025, as far as its text could be read). Compare rigs of the same
    number of rays (`describe_unequal_rays`).

    A voxel is in a box if its centre is; of a box that leaves the region, the part within counts. Rays go through
    everything, to the wall of the region or the end of the sensor's range. With `ends_at_hits` they end at the points that
    the rig measured, and the number is the mean over frames of the entropy on their way; rays that gave no point are
    left out, for a frame does not know them. So it rises by its sign with what a rig misses: from -28,544 to -19,985
    for `kitti` in `urban` when fog of 100 m comes; `entropy_captured_nats` falls.

    The error is the jackknife's over 16 blocks of worlds, as they change p; with occlusion there is none: that would
    need the voxels crossed in each block.

    Args:
        sensors: Those of the rig, with mounts and rays.
        voxel_m: Side of a voxel; the published one is 0.05.
        region: What the voxels fill, the published 60 x 40 x 4 m if not given.
        categories: Each has its own occupancy and number. The number of all is their sum.
        ends_at_hits: Whether rays end at what they hit.
        kwargs: `rig_name` and `query_cache` of `FrameMetric`.

    Raises:
        ValueError: No sensor, no category or one twice, voxels that do not divide the region or do not fit into the
            memory. From `update`: a frame without boxes; with occlusion, points of unknown sensors.

    Example:
        >>> from torchcover.detection import Boxes
        >>> from torchcover.simulation import Rig
        >>> car = Boxes.from_rows(torch.tensor([[10.0, 0.0, 0.8, 4.0, 2.0, 1.6, 0.0]]), categories=("car",))
        >>> metric = SMig(Rig.load("hu2022_center").sensors)
        >>> for index, boxes in enumerate((car, car.select_categories())):  # a car in every second frame
        ...     metric.update(Frame({"rig": torch.zeros(0, 3)}, torch.zeros(0, 3), index, str(index), boxes=boxes))
        >>> number = metric.compute()[1]
        >>> number.quantity.key, round(number.value / np.log(2))
        ('s_mig_0.2m:car', -1600)
    """

    boxes: Tensor
    crossings: Tensor

    def __init__(
        self,
        sensors: Sequence[Sensor],
        voxel_m: float = 0.2,
        region: BoundingBox = REGION,
        categories: Sequence[str] = CATEGORIES,
        *,
        ends_at_hits: bool = False,
        **kwargs: Any,  # noqa: ANN401  (arguments of `FrameMetric`)
    ) -> None:
        check_sensors(sensors)
        if not categories or len(set(categories)) < len(categories):
            raise ValueError(f"categories: one or more different ones are needed; got {tuple(categories)}")
        grid = create_voxel_grid(region, voxel_m, BYTES_A_VOXEL_OCCLUDED if ends_at_hits else BYTES_A_VOXEL)
        meaning = {
            "sensors": tuple(sensors),
            "voxel_m": float(voxel_m),
            "region": region,
            "categories": tuple(categories),
            "ends_at_hits": ends_at_hits,
        }
        super().__init__(meaning, **kwargs)
        self.sensors = tuple(sensors)
        self.grid = grid
        self.categories = tuple(categories)
        self.ends_at_hits = ends_at_hits
        self.define_table("boxes", COLUMNS)
        if ends_at_hits:
            self.define_sum("crossings", (grid.num_voxels,), torch.int64)

    def _add_frame(self, frame: Frame) -> None:
        check_cloud(frame.reference, "reference")
        boxes = self.query_cache.get_boxes(frame)
        rows = self.query_cache.get_or_compute(
            frame,
            ("occupancy", self.categories, self.grid.region),
            lambda: build_occupancy_rows(boxes, frame.block_index, self.categories, self.grid.region),
        )
        if self.ends_at_hits:
            crossed = mark_crossed_before_hits(self.sensors, frame, self.rig_name, self.grid)
            self.crossings += torch.from_numpy(crossed.reshape(-1)).to(self.crossings)
        self.boxes = insert_rows(self.boxes, rows)

    def _compute_numbers(self) -> tuple[Estimate, Sequence[Number]]:
        of_each, times, rays = self._occupancies(), self._crossings(), count_rays(self.sensors)
        about = [
            describe_number(
                f"s_mig{'_occluded' if self.ends_at_hits else ''}_{self.grid.voxel_m:g}m{name}",
                "nats",
                "boxes",
                voxel_m=self.grid.voxel_m,
                region_m=(self.grid.region.lower_m, self.grid.region.upper_m),
                rays=rays,
                voxels_crossed=int((times > 0).sum()),
            )
            for name in ("", *(f":{category}" for category in self.categories))
        ]
        quantities, steps = [one.quantity for one in about], torch.from_numpy(of_each[0].frame_counts)
        estimate = Estimate.from_blocks(quantities, partial(_again, of_each, times), steps[steps > 0])
        if self.ends_at_hits:  # what was crossed in each block is unknown
            estimate = Estimate.from_values(quantities, estimate.value)
        boxes = [one.box_count for one in of_each]
        return estimate, [
            one._replace(count=count, parameters={**one.parameters, "entropy_captured_nats": -value}, warning=FALLS)
            for one, count, value in zip(about, [sum(boxes), *boxes], estimate.value.tolist(), strict=True)
        ]

    def _crossings(self) -> NDArray[np.float64 | np.bool_]:
        """(voxels,) how often each voxel is crossed in a frame, on average."""
        if self.ends_at_hits:
            return self.crossings.cpu().numpy() / max(int(self.num_frames), 1)
        return mark_crossed_by_rays(self.sensors, self.grid).reshape(-1)

    def _occupancies(self) -> list[Occupancy]:
        """That of each category; rigs that saw the same frames share them."""
        table = self.boxes.cpu().numpy()
        what = ("occupancy", hashlib.sha256(table.tobytes()).digest(), self.grid, self.categories)
        return self.query_cache.get_or_compute_total(
            what, lambda: [build_occupancy(table, number, self.grid, BLOCKS) for number in range(len(self.categories))]
        )


def _again(of_each: Sequence[Occupancy], times: NDArray[np.float64 | np.bool_], weights: Tensor) -> Tensor:
    """(R, 1 + C) the sum over the categories, and each; NaN where there was no box."""
    of_blocks = np.zeros((len(weights), BLOCKS))
    of_blocks[:, of_each[0].frame_counts > 0] = weights.cpu().numpy()
    values = np.full((len(weights), 1 + len(of_each)), np.nan)
    for column, one in enumerate(of_each, 1):
        if one.box_count:
            values[:, column] = -one.compute_entropy_nats(times, of_blocks)
    known = [column for column, one in enumerate(of_each, 1) if one.box_count]
    if known:
        values[:, 0] = values[:, known].sum(axis=1)
    return torch.from_numpy(values)


def describe_unequal_rays(numbers: Mapping[str, Number]) -> str | None:
    """What is to be said of the numbers of several rigs: that one has more rays than another; None if none has.

    Args:
        numbers: Name of the rig -> its number, of one `SMig` each.

    Example:
        >>> dense = describe_number("s_mig_0.2m", "nats", "boxes", rays=4000)
        >>> sparse = describe_number("s_mig_0.2m", "nats", "boxes", rays=90)
        >>> describe_unequal_rays({"dense": dense, "sparse": sparse})
        's_mig_0.2m: the rigs have different numbers of rays (dense 4,000, sparse 90), and fewer rays score higher'
        >>> describe_unequal_rays({"dense": dense, "equal": dense})
    """
    rays = {rig: number.parameters["rays"] for rig, number in numbers.items()}
    if len(set(rays.values())) < 2:
        return None
    name = next(iter(numbers.values())).quantity.key
    each = ", ".join(f"{rig} {count:,}" for rig, count in rays.items())
    return f"{name}: the rigs have different numbers of rays ({each}), and fewer rays score higher"
