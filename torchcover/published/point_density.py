"""How many points a rig has, how dense they are, and how evenly they lie."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchcover.coverage import BevGrid, Region, check_regions
from torchcover.data import Frame
from torchcover.neighbors import check_cloud
from torchcover.published.places import coarse_grid
from torchcover.published.sights import rig_of
from torchcover.published.world_ratios import Ratio, WorldRatios


class PointDensity(WorldRatios):
    """Points of the rig in a frame; over the grid and in regions those for each square metre, and their uniformity.

    The density is over the ground as drawn, be it visible or not. The uniformity is (sum n)^2 / (C sum n^2) over the
    points n in C square cells: 1 if all cells have as many, 1 / C if one has all. Density and uniformity are what Cai
    et al. (2023) look at; their own formula of uniformity could not be read.

    Args:
        grid: Where points count: its extent and its height bands.
        regions: Those that have numbers of their own; one without the centre of a cell has no uniformity.
        cell_m: Side of the cells of the uniformity.
        rig: Whose clouds; those of the only rig if not given.
        kwargs: For `torchmetrics.Metric`.

    Raises:
        ValueError: Regions that the grid does not hold.

    Example:
        >>> metric = PointDensity(BevGrid(x=(0.0, 4.0), y=(0.0, 1.0), cell=1.0), ())
        >>> cloud = torch.tensor([[0.5, 0.5, 0.0], [1.5, 0.5, 0.0], [9.0, 0.0, 0.0]])
        >>> metric.update(Frame({"rig": cloud}, torch.zeros(0, 3), 0, "a"))
        >>> [(one.name, one.value) for one in metric.compute()]
        [('points', 3.0), ('point_density', 0.5), ('point_uniformity_1m', 0.5)]
    """

    def __init__(
        self,
        grid: BevGrid,
        regions: Sequence[Region],
        cell_m: float = 1.0,
        *,
        rig: str | None = None,
        **kwargs: Any,  # noqa: ANN401  (whatever torchmetrics takes)
    ) -> None:
        check_regions(regions, grid)
        coarse = coarse_grid(grid, cell_m)
        areas = [_everywhere(grid), *(region.mask(grid).flatten() for region in regions)]
        masks = {"": _everywhere(coarse)} | {f":{region.name}": region.mask(coarse).flatten() for region in regions}
        masks = {name: mask for name, mask in masks.items() if mask.any()}
        names = ["", *(f":{region.name}" for region in regions)]
        given = {"cell_m": float(cell_m)}
        ratios = [
            Ratio("points", "points", True, "frames"),
            *(Ratio(f"point_density{name}", "points/m2", True, "frames") for name in names),
            *(Ratio(f"point_uniformity_{cell_m:g}m{name}", "share", True, "frames", given) for name in masks),
        ]
        super().__init__(ratios, {"grid": grid, "regions": tuple(regions), **given}, rig, **kwargs)
        self.grid = grid
        self.coarse = coarse
        self._areas = areas
        self._masks = tuple(masks.values())

    def _of_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        cloud = frame.cloud_of(rig_of(frame, self.rig))
        check_cloud(cloud, "sensor")
        rows = [(1.0, float(len(cloud)), 1.0)]
        inside, of, cell = self.grid.bins(cloud)
        fine, area_m2 = _counted(cell, self.grid), self.grid.cell**2
        rows += [(int(mask.sum()) * area_m2, float(fine[mask].sum()), 1.0) for mask in self._areas]
        own = _counted(self.coarse.bins(cloud[inside[of]]).cell, self.coarse)
        for mask in self._masks:
            each = own[mask]
            squares = float(each.square().sum())
            even = (1.0, float(each.sum()) ** 2 / (len(each) * squares), 1.0) if squares else (0.0, 0.0, 0.0)
            rows.append(even)
        base, sums, counts = torch.tensor(rows, dtype=torch.float64).T
        return base, sums, counts.long()


def _everywhere(grid: BevGrid) -> Tensor:
    return torch.ones(grid.shape[1] * grid.shape[2], dtype=torch.bool)


def _counted(cell: Tensor, grid: BevGrid) -> Tensor:
    """(Y * X) float64 points in each cell, all bands together, on the CPU."""
    flat = grid.shape[1] * grid.shape[2]
    return torch.bincount(cell % flat, minlength=flat).double().cpu()
