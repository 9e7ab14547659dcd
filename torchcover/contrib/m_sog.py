"""M-SOG: the mean entropy of a semantic occupancy grid along the rays of a rig (Place3D, Li et al. 2024)."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcover.contrib.frame_metric import BLOCKS, FrameMetric, said
from torchcover.contrib.region_voxels import REGION, check_sensors, checked_grid, crossed_by, ray_count
from torchcover.estimation import Estimate, Number
from torchcover.frames import Frame
from torchcover.geometry import BoundingBox
from torchcover.metrics import SumsInBlocks
from torchcover.neighbors import check_cloud
from torchcover.simulation import Sensor

# Numbers that are kept of each voxel and block: frames in which it is labelled as the category, and as anything else.
LABELS = 2
# Numbers that are worked out together: voxels, of each draw.
AT_ONCE = 1 << 20
RANKS_ONLY = (
    "only for ranks of rigs at voxels of one size: printed values are a million times smaller than a mean entropy, and "
    "the size is not printed"
)


class MSog(SumsInBlocks, FrameMetric):
    """Mean entropy in nats of what the voxels on the way of a rig's rays hold, as a loss: M-SOG (Place3D, 2024).

        H(v)  = - sum over c of p_c(v) ln p_c(v)         c: the category, anything else, empty
        M-SOG = - mean over the distinct voxels v on the way of any ray of H(v)

    where p_c is the share of frames in which the voxel has the label c. Higher is better. This is the paper's variant
    for detection. A frame's label of a voxel comes from the reference points in it: the category if at least half of
    them are in its boxes (`points_in_boxes`), else anything else; empty if there is none, whether the reference saw
    that it is empty or did not see it.

    Nothing hides anything from the rays, which go to the wall of the region or the end of the sensor's range; and a
    voxel that is crossed once counts as much as one that is crossed often. At 1 m nearly every voxel is crossed by any
    rig: the size of a voxel is part of the name. The error is the jackknife's over 16 blocks of worlds.

    Args:
        sensors: Those of the rig, with mounts and rays.
        voxel_m: Side of a voxel; the paper does not print its own.
        region: What the voxels fill, 60 x 40 x 4 m as of S-MIG if not given.
        category: Of the boxes that have a label of their own.
        kwargs: `rig` and `sights` of `FrameMetric`, and those of `torchmetrics.Metric`.

    Raises:
        ValueError: No sensor, voxels that do not divide the region or do not fit into the memory. From `update`: a
            frame without boxes.

    Example:
        >>> from torchcover.detection import Boxes
        >>> from torchcover.simulation import Rig
        >>> car = Boxes.from_rows(torch.tensor([[10.0, 0.0, 0.8, 4.0, 2.0, 1.6, 0.0]]), categories=("car",))
        >>> metric = MSog(Rig.load("hu2022_center").sensors)
        >>> seen = torch.tensor([[8.1, 0.1, 0.6]])  # its rear, in one of two frames
        >>> for index, points in enumerate((seen, seen[:0])):
        ...     metric.update(Frame({"rig": torch.zeros(0, 3)}, points, index, str(index), boxes=car))
        >>> number = metric.compute()[0]
        >>> number.quantity.key, round(number.value * number.count / math.log(2), 9)
        ('m_sog_car_0.5m', -1.0)
    """

    labelled: Tensor

    def __init__(
        self,
        sensors: Sequence[Sensor],
        voxel_m: float = 0.5,
        region: BoundingBox = REGION,
        category: str = "car",
        **kwargs: Any,  # noqa: ANN401  (whatever torchmetrics takes)
    ) -> None:
        check_sensors(sensors)
        grid = checked_grid(region, voxel_m, BLOCKS * LABELS * 8)
        meaning = {"sensors": tuple(sensors), "voxel_m": float(voxel_m), "region": region, "category": category}
        super().__init__(BLOCKS, meaning, **kwargs)
        self.sensors = tuple(sensors)
        self.grid = grid
        self.category = category
        self.add_block_sum("labelled", (LABELS, grid.voxels), torch.int64)

    def _add_frame(self, frame: Frame) -> None:
        check_cloud(frame.reference, "reference")
        labels = self.sights.once(frame, ("labels", self.category, self.grid), lambda: self._labels(frame))
        block = self._block_of(frame.place_in_time)
        for label, voxels in enumerate(labels):
            self.labelled[block, label, voxels.to(self.labelled.device)] += 1

    def _labels(self, frame: Frame) -> tuple[Tensor, Tensor]:
        """The voxels that have the label of the category in a frame, and those that hold anything else."""
        boxes = self.sights.boxes(frame)
        of_category = torch.tensor([each == self.category for each in boxes.categories], dtype=torch.bool, device="cpu")
        inside = self.sights.reference_in_boxes(frame)
        votes = np.zeros(len(frame.reference), dtype=bool)
        votes[inside.point.cpu()[of_category[inside.box.cpu()]].numpy()] = True
        voxel = self.grid.number_of(frame.reference.cpu().numpy())
        occupied, which, points = np.unique(voxel[voxel >= 0], return_inverse=True, return_counts=True)
        chosen = 2 * np.bincount(which, weights=votes[voxel >= 0], minlength=len(occupied)) >= points
        return torch.from_numpy(occupied[chosen]), torch.from_numpy(occupied[~chosen])

    def _found(self) -> tuple[Estimate, Sequence[Number]]:
        crossed = torch.from_numpy(crossed_by(self.sensors, self.grid).reshape(-1).nonzero()[0])
        about = said(
            f"m_sog_{self.category}_{self.grid.voxel_m:g}m",
            "nats",
            "voxels",
            voxel_m=self.grid.voxel_m,
            region_m=(self.grid.region.lower_m, self.grid.region.upper_m),
            category=self.category,
            rays=ray_count(self.sensors),
            crossed_share=len(crossed) / self.grid.voxels,
        )
        used = self.block_steps.cpu() > 0
        # Unknown if the category was never seen.
        on_the_way = crossed.to(self.labelled.device) if self.labelled[:, 0].any() else crossed[:0]
        labelled, steps = self.labelled[:, :, on_the_way].cpu()[used], self.block_steps.cpu()[used]
        estimate = Estimate.of_blocks([about.quantity], partial(_again, labelled, steps), steps)
        return estimate, [about._replace(count=0 if estimate.value[0].isnan() else len(crossed), warning=RANKS_ONLY)]


def _again(labelled: Tensor, steps: Tensor, weights: Tensor) -> Tensor:
    """(R, 1) the number of voxels labelled (g, 2, K) times in blocks of steps (g,), if these weigh (R, g)."""
    of_all, voxels = weights @ steps.double(), labelled.shape[2]
    total, part = torch.zeros(len(weights), dtype=torch.float64, device="cpu"), max(AT_ONCE // len(weights), 1)
    for start in range(0, voxels, part):
        some = labelled[:, :, start : start + part].double()
        share = torch.tensordot(weights, some, dims=1) / of_all[:, None, None]
        empty = (1.0 - share.sum(dim=1)).clamp(min=0.0)
        total += torch.special.entr(share).sum(dim=(1, 2)) + torch.special.entr(empty).sum(dim=1)
    known = (of_all > 0) & (voxels > 0)
    return torch.where(known, -total / max(voxels, 1), math.nan)[:, None]
