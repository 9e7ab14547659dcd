"""S-MIG: the entropy of an occupancy grid along the rays of a rig (Hu et al. 2022), and its negative."""

import hashlib
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.contrib.frame_metric import BLOCKS, FrameMetric, said
from torchcover.contrib.occupancy import COLUMNS, Occupancy, occupancy_of, occupancy_rows
from torchcover.contrib.region_voxels import (
    REGION,
    check_sensors,
    checked_grid,
    crossed_by,
    crossed_on_the_way,
    ray_count,
)
from torchcover.estimation import Estimate, Number
from torchcover.frames import Frame
from torchcover.geometry import BoundingBox
from torchcover.metrics import with_rows
from torchcover.neighbors import check_cloud
from torchcover.simulation import Sensor

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
    number of rays (`unequal_rays`).

    A voxel is in a box if its centre is; of a box that leaves the region, the part within counts. Rays go through
    everything, to the wall of the region or the end of the sensor's range. With `occlusion` they end at the points that
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
        occlusion: Whether rays end at what they hit.
        kwargs: `rig` and `sights` of `FrameMetric`, and those of `torchmetrics.Metric`.

    Raises:
        ValueError: No sensor, no category or one twice, voxels that do not divide the region or do not fit into the
            memory. From `update`: a frame without boxes; with occlusion, points of unknown sensors.

    Example:
        >>> from torchcover.detection import Boxes
        >>> from torchcover.simulation import Rig
        >>> car = Boxes.from_rows(torch.tensor([[10.0, 0.0, 0.8, 4.0, 2.0, 1.6, 0.0]]), categories=("car",))
        >>> metric = SMig(Rig.load("hu2022_center").sensors)
        >>> for index, boxes in enumerate((car, car.of_category())):  # a car that is there in half of the frames
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
        occlusion: bool = False,
        **kwargs: Any,  # noqa: ANN401  (whatever torchmetrics takes)
    ) -> None:
        check_sensors(sensors)
        if not categories or len(set(categories)) < len(categories):
            raise ValueError(f"categories: one or more different ones are needed; got {tuple(categories)}")
        grid = checked_grid(region, voxel_m, BYTES_A_VOXEL_OCCLUDED if occlusion else BYTES_A_VOXEL)
        meaning = {
            "sensors": tuple(sensors),
            "voxel_m": float(voxel_m),
            "region": region,
            "categories": tuple(categories),
            "occlusion": occlusion,
        }
        super().__init__(meaning, **kwargs)
        self.sensors = tuple(sensors)
        self.grid = grid
        self.categories = tuple(categories)
        self.occlusion = occlusion
        self.add_table("boxes", COLUMNS)
        if occlusion:
            self.add_sum("crossings", (grid.voxels,), torch.int64)

    def _add_frame(self, frame: Frame) -> None:
        check_cloud(frame.reference, "reference")
        boxes = self.sights.boxes(frame)
        rows = self.sights.once(
            frame,
            ("occupancy", self.categories, self.grid.region),
            lambda: occupancy_rows(boxes, frame.place_in_time, self.categories, self.grid.region),
        )
        if self.occlusion:
            crossed = crossed_on_the_way(self.sensors, frame, self.rig, self.grid)
            self.crossings += torch.from_numpy(crossed.reshape(-1)).to(self.crossings)
        self.boxes = with_rows(self.boxes, rows)

    def _found(self) -> tuple[Estimate, Sequence[Number]]:
        of_each, times, rays = self._occupancies(), self._crossings(), ray_count(self.sensors)
        about = [
            said(
                f"s_mig{'_occluded' if self.occlusion else ''}_{self.grid.voxel_m:g}m{name}",
                "nats",
                "boxes",
                voxel_m=self.grid.voxel_m,
                region_m=(self.grid.region.lower_m, self.grid.region.upper_m),
                rays=rays,
                voxels_crossed=int((times > 0).sum()),
            )
            for name in ("", *(f":{category}" for category in self.categories))
        ]
        quantities, steps = [one.quantity for one in about], torch.from_numpy(of_each[0].steps)
        estimate = Estimate.of_blocks(quantities, partial(_again, of_each, times), steps[steps > 0])
        if self.occlusion:  # what was crossed in each block is unknown
            estimate = Estimate.of(quantities, estimate.value)
        boxes = [one.boxes for one in of_each]
        return estimate, [
            one._replace(count=count, parameters={**one.parameters, "entropy_captured_nats": -value}, warning=FALLS)
            for one, count, value in zip(about, [sum(boxes), *boxes], estimate.value.tolist(), strict=True)
        ]

    def _crossings(self) -> NDArray[np.float64 | np.bool_]:
        """(voxels,) how often each voxel is crossed in a frame, on average."""
        if self.occlusion:
            return self.crossings.cpu().numpy() / max(int(self.steps), 1)
        return crossed_by(self.sensors, self.grid).reshape(-1)

    def _occupancies(self) -> list[Occupancy]:
        """That of each category; rigs that saw the same frames share them."""
        table = self.boxes.cpu().numpy()
        what = ("occupancy", hashlib.sha256(table.tobytes()).digest(), self.grid, self.categories)
        return self.sights.after_all(
            what, lambda: [occupancy_of(table, number, self.grid, BLOCKS) for number in range(len(self.categories))]
        )


def _again(of_each: Sequence[Occupancy], times: NDArray[np.float64 | np.bool_], weights: Tensor) -> Tensor:
    """(R, 1 + C) the sum over the categories, and each; NaN where there was no box."""
    of_blocks = np.zeros((len(weights), BLOCKS))
    of_blocks[:, of_each[0].steps > 0] = weights.cpu().numpy()
    values = np.full((len(weights), 1 + len(of_each)), np.nan)
    for column, one in enumerate(of_each, 1):
        if one.boxes:
            values[:, column] = -one.entropy_nats(times, of_blocks)
    known = [column for column, one in enumerate(of_each, 1) if one.boxes]
    if known:
        values[:, 0] = values[:, known].sum(axis=1)
    return torch.from_numpy(values)


def unequal_rays(numbers: Mapping[str, Number]) -> str | None:
    """What is to be said of the numbers of several rigs: that one has more rays than another; None if none has.

    Args:
        numbers: Name of the rig -> its number, of one `SMig` each.

    Example:
        >>> one, two = (said("s_mig_0.2m", "nats", "boxes", rays=rays) for rays in (4000, 90))
        >>> unequal_rays({"one": one, "two": two})
        's_mig_0.2m: the rigs have different numbers of rays (one 4,000, two 90), and fewer rays score higher'
        >>> unequal_rays({"one": one, "same": one})
    """
    rays = {rig: number.parameters["rays"] for rig, number in numbers.items()}
    if len(set(rays.values())) < 2:
        return None
    name = next(iter(numbers.values())).quantity.key
    each = ", ".join(f"{rig} {count:,}" for rig, count in rays.items())
    return f"{name}: the rigs have different numbers of rays ({each}), and fewer rays score higher"
