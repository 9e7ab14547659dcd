"""How many points a rig has, how dense they are, and how evenly they lie."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchcover.contrib.frame_metric import WorldRatios, said
from torchcover.contrib.sights import rig_of
from torchcover.coverage import BevGrid, Region, check_regions
from torchcover.frames import Frame
from torchcover.neighbors import check_cloud, nearest


class PointDensity(WorldRatios):
    """Points of the rig in a frame; over the grid and in regions those for each square metre, and their uniformity.

    The density is over the ground as drawn, be it visible or not. The uniformity is (sum n)^2 / (C sum n^2) over the
    points n in C square cells: 1 if all cells have as many, 1 / C if one has all. Density and uniformity are what Cai
    et al. (2023) look at; their own formula of uniformity could not be read. It does not ask how many points there are:
    those that are missed may raise it, by 0.0004 within 3 m ahead of `kitti` in fog of 100 m.

    Args:
        grid: Where points count: its extent, its height bands, and the cells of the uniformity. The ground below a
            point is that below the reference point which, seen from above, is next to it.
        regions: Those that have numbers of their own.
        kwargs: `rig` and `sights` of `FrameMetric`, and those of `torchmetrics.Metric`.

    Raises:
        ValueError: Regions that the grid does not hold.

    Example:
        >>> metric = PointDensity(BevGrid(x=(0.0, 4.0), y=(0.0, 1.0), cell=1.0), ())
        >>> cloud = torch.tensor([[0.5, 0.5, 0.0], [1.5, 0.5, 0.0], [9.0, 0.0, 0.0]])
        >>> metric.update(Frame({"rig": cloud}, torch.zeros(0, 3), 0, "a"))
        >>> [(one.quantity.key, one.value) for one in metric.compute()]
        [('points', 3.0), ('point_density', 0.5), ('point_uniformity_1m', 0.5)]
    """

    def __init__(
        self,
        grid: BevGrid,
        regions: Sequence[Region],
        **kwargs: Any,  # noqa: ANN401  (whatever torchmetrics takes)
    ) -> None:
        check_regions(regions, grid)
        names = ["", *(f":{region.name}" for region in regions)]
        ratios = [
            said("points", "points", "frames"),
            *(said(f"point_density{name}", "points/m2", "frames") for name in names),
            *(said(f"point_uniformity_{grid.cell:g}m{name}", "share", "frames") for name in names),
        ]
        super().__init__(ratios, {"grid": grid, "regions": tuple(regions)}, **kwargs)
        self.grid = grid
        everywhere = torch.ones(grid.shape[1:], dtype=torch.bool, device="cpu")
        self._members = torch.stack([everywhere, *(region.mask(grid) for region in regions)]).flatten(1).double()

    def _of_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        cloud = frame.cloud_of(rig_of(frame, self.rig))
        check_cloud(cloud, "sensor")
        height = None if self.grid.band_frame == "vehicle" else _heights_m(cloud, frame)
        each = self.grid.points_by_column(cloud, height).flatten().cpu()
        cells = self._members.sum(dim=1)
        points, squares = (self._members @ torch.stack([each, each.square()], dim=1)).T
        somewhere = (points > 0).double()
        uniformity = points.square() / (cells * squares).where(points > 0, 1.0)
        one, all_points = cells.new_ones(1), cells.new_tensor([len(cloud)])
        base = torch.cat([one, cells * self.grid.cell**2, somewhere])
        counts = torch.cat([one, torch.ones_like(cells), somewhere]).long()
        return base, torch.cat([all_points, points, uniformity]), counts


def _heights_m(cloud: Tensor, frame: Frame) -> Tensor:
    """(N,) how high points lie above the ground, NaN where it is unknown everywhere."""
    heights_m = frame.heights_in("ground")
    assert heights_m is not None  # those over z alone are
    known = heights_m.isfinite()
    ground_m = torch.cat([(frame.reference[:, 2] - heights_m)[known], heights_m.new_tensor([math.nan])])
    from_above = cloud.new_tensor([1.0, 1.0, 0.0])
    return cloud[:, 2] - ground_m[nearest(cloud * from_above, frame.reference[known] * from_above).index]
