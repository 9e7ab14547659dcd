"""S-MIG (Hu et al. 2022): negative entropy of a probabilistic occupancy grid (POG) along the rays of a rig.

The state of the metric is a table with one row per object, which takes some megabytes for thousands of frames, whatever
the voxel size.
"""

import hashlib
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.contrib.frame_metric import BLOCKS, FrameMetric, describe_number
from torchcover.contrib.occupancy import NUM_COLUMNS, Occupancy, build_occupancy, build_occupancy_rows
from torchcover.contrib.voxels import (
    REGION,
    check_sensors,
    count_rays,
    create_voxel_grid,
    mark_crossed_before_hits,
    mark_crossed_by_rays,
)
from torchcover.estimation import Estimate, Number
from torchcover.frames import Frame
from torchcover.geometry import BoundingBox
from torchcover.metrics import insert_rows
from torchcover.neighbors import check_cloud
from torchcover.simulation import Sensor


class SMig(FrameMetric):
    """Negative entropy in nats of the occupancy of the voxels that the rays of a rig cross: S-MIG (Hu et al. 2022).

        p(v)  = share of frames in which voxel v is in a box of the category
        S-MIG = - sum over the distinct voxels v that any ray crosses of  -p ln p - (1 - p) ln(1 - p)

    with independent voxels. According to its authors, higher is better; yet it decreases with the number of crossed
    voxels, and a rig without rays has the highest value, 0. The entropy itself, in
    `parameters["entropy_captured_nats"]`, is maximized in roadside placement (EGVS, Jiang 2025, as far as its text was
    available). Compare only rigs with equal numbers of rays (`describe_unequal_rays`).

    A voxel is in a box if its center is; of a box that leaves the region, the part inside counts. Rays are not occluded
    and end at the border of the region or at the maximum range of the sensor. With `ends_at_hits` they end at the
    measured points, and the number is the mean over frames of the entropy along the rays; rays without a point are not
    recorded in frames and do not count. This number increases with missing returns: from -28,544 to -19,985 for `kitti`
    in `urban` with fog of 100 m visibility; `entropy_captured_nats` decreases.

    The standard error is that of the jackknife over 16 blocks of scenes, which change p. With `ends_at_hits` there is
    none, since it would need the crossed voxels of each block.

    Args:
        sensors: Sensors of the rig, with mounts and rays.
        voxel_m: Side length of a voxel in meters; 0.05 in the publication.
        region: Region of the voxels; by default that of the publication, 60 x 40 x 4 m.
        categories: Categories with separate occupancy and numbers; the first number is the sum of all.
        ends_at_hits: Rays end at their hits.
        kwargs: `rig_name` and `query_cache` of `FrameMetric`.

    Raises:
        ValueError: There is no sensor, no category or a repeated one, or voxels do not divide the region or do not fit
            into memory. From `update`: a frame has no boxes, or, with `ends_at_hits`, points of unknown sensors.

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
        categories: Sequence[str] = ("car", "pedestrian", "cyclist"),
        *,
        ends_at_hits: bool = False,
        **kwargs: Any,  # noqa: ANN401  (arguments of `FrameMetric`)
    ) -> None:
        check_sensors(sensors)
        if not categories or len(set(categories)) < len(categories):
            raise ValueError(f"categories: one or more different ones are needed; got {tuple(categories)}")
        # Work arrays of the computation take 6 bytes per voxel: crossing count (1), mark of a frame (1), count of a
        # block (4). With `ends_at_hits`, the state and its mean add 15.
        grid = create_voxel_grid(region, voxel_m, 21 if ends_at_hits else 6)
        definition = {
            "sensors": tuple(sensors),
            "voxel_m": float(voxel_m),
            "region": region,
            "categories": tuple(categories),
            "ends_at_hits": ends_at_hits,
        }
        super().__init__(definition, **kwargs)
        self.sensors = tuple(sensors)
        self.grid = grid
        self.categories = tuple(categories)
        self.ends_at_hits = ends_at_hits
        self.define_table("boxes", NUM_COLUMNS)
        if ends_at_hits:
            self.define_sum("crossings", (grid.num_voxels,), torch.int64)

    def _add_frame(self, frame: Frame) -> None:
        check_cloud(frame.reference, "reference")
        boxes = self.query_cache.get_boxes(frame)
        inputs = (self.categories, self.grid.region)
        rows = self.query_cache.get_or_compute(
            frame, ("occupancy", *inputs), build_occupancy_rows, boxes, frame.block_index, *inputs
        )
        if self.ends_at_hits:
            crossed = mark_crossed_before_hits(self.sensors, frame, self.rig_name, self.grid)
            self.crossings += torch.from_numpy(crossed.reshape(-1)).to(self.crossings)
        self.boxes = insert_rows(self.boxes, rows)

    def _compute_numbers(self) -> tuple[Estimate, Sequence[Number]]:
        occupancies, multiplicities = self._get_occupancies(), self._compute_multiplicities()
        prefix = "s_mig_occluded" if self.ends_at_hits else "s_mig"
        parameters: dict[str, Any] = {
            "voxel_m": self.grid.voxel_m,
            "region_m": (self.grid.region.lower_m, self.grid.region.upper_m),
            "rays": count_rays(self.sensors),
            "voxels_crossed": int((multiplicities > 0).sum()),
        }
        numbers = []
        for suffix in ("", *(f":{category}" for category in self.categories)):
            key = f"{prefix}_{self.grid.voxel_m:g}m{suffix}"
            numbers.append(describe_number(key, "nats", "boxes", **parameters))
        quantities = [number.quantity for number in numbers]
        frame_counts = torch.from_numpy(occupancies[0].frame_counts)
        recompute = partial(_recompute_s_mig, occupancies, multiplicities)
        estimate = Estimate.from_blocks(quantities, recompute, frame_counts[frame_counts > 0])
        if self.ends_at_hits:  # the crossed voxels of each block are unknown
            estimate = Estimate.from_values(quantities, estimate.value)
        box_counts = [occupancy.box_count for occupancy in occupancies]
        warning = "S-MIG falls as more is covered, and is 0 without rays: compare only rigs with equal numbers of rays"
        described = []
        for number, count, value in zip(numbers, [sum(box_counts), *box_counts], estimate.value.tolist(), strict=True):
            parameters = {**number.parameters, "entropy_captured_nats": -value}
            described.append(number._replace(count=count, parameters=parameters, warning=warning))
        return estimate, described

    def _compute_multiplicities(self) -> NDArray[np.float64 | np.bool_]:
        """Compute (voxels,) how often each voxel is crossed per frame."""
        if self.ends_at_hits:
            return self.crossings.cpu().numpy() / max(int(self.num_frames), 1)
        return mark_crossed_by_rays(self.sensors, self.grid).reshape(-1)

    def _get_occupancies(self) -> list[Occupancy]:
        """Return the occupancy of each category, which rigs with the same frames share."""
        table = self.boxes.cpu().numpy()
        key = ("occupancy", hashlib.sha256(table.tobytes()).digest(), self.grid, self.categories)

        def build_all() -> list[Occupancy]:
            return [build_occupancy(table, index, self.grid, BLOCKS) for index in range(len(self.categories))]

        return self.query_cache.get_or_compute_total(key, build_all)


def _recompute_s_mig(
    occupancies: Sequence[Occupancy], multiplicities: NDArray[np.float64 | np.bool_], weights: Tensor
) -> Tensor:
    """Recompute (R, 1 + C) numbers, the sum over categories first, for (R, g) weights of the used blocks."""
    block_weights = np.zeros((len(weights), BLOCKS))
    block_weights[:, occupancies[0].frame_counts > 0] = weights.cpu().numpy()
    values = np.full((len(weights), 1 + len(occupancies)), np.nan)
    known_columns = []
    for column, occupancy in enumerate(occupancies, 1):
        if occupancy.box_count:
            values[:, column] = -occupancy.compute_entropy_nats(multiplicities, block_weights)
            known_columns.append(column)
    if known_columns:
        values[:, 0] = values[:, known_columns].sum(axis=1)
    return torch.from_numpy(values)


def describe_unequal_rays(numbers: Mapping[str, Number]) -> str | None:
    """Describe that rigs have different numbers of rays, which makes their numbers incomparable.

    Args:
        numbers: Number of an `SMig` by the name of the rig.

    Returns:
        Sentence; None if all numbers of rays are equal.

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
    counts = ", ".join(f"{rig} {count:,}" for rig, count in rays.items())
    return f"{name}: the rigs have different numbers of rays ({counts}), and fewer rays score higher"
