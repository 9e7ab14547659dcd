"""How many points a rig has, how dense they are, and how evenly they lie."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchcover.coverage import BevGrid, Region, check_regions
from torchcover.data import Frame
from torchcover.neighbors import check_cloud
from torchcover.published.sights import rig_of
from torchcover.published.world_ratios import Ratio, WorldRatios


class PointDensity(WorldRatios):
    """Points of the rig in a frame; in each region its points for each square metre of ground, and their uniformity.

    The density is over the region as drawn, be it visible or not. The uniformity is (sum n)^2 / (C sum n^2) over the
    points n in the C square cells of the region: 1 if all cells have as many, 1 / C if one has all. Density and
    uniformity are what Cai et al. (2023) optimise; their own formula of uniformity could not be read.

    Args:
        regions: Those that have numbers.
        height_m: Lower and upper bound of z of the points that count.
        cell_m: Side of the cells.
        rig: Whose clouds; those of the only rig if not given.
        kwargs: For `torchmetrics.Metric`.

    Raises:
        ValueError: Two regions of one name, or one without a cell centre; bounds of z that are no interval.

    Example:
        >>> metric = PointDensity([Region("near", (0.0, 4.0), (0.0, 1.0))], (-0.5, 2.0))
        >>> cloud = torch.tensor([[0.5, 0.5, 0.0], [1.5, 0.5, 0.0], [9.0, 0.0, 0.0]])
        >>> metric.update(Frame({"rig": cloud}, torch.zeros(0, 3), 0, "a"))
        >>> [(one.name, one.value) for one in metric.compute()]
        [('points', 3.0), ('point_density_near', 0.5), ('point_uniformity_1m_near', 0.5)]
    """

    def __init__(
        self,
        regions: Sequence[Region],
        height_m: tuple[float, float],
        cell_m: float = 1.0,
        *,
        rig: str | None = None,
        **kwargs: Any,  # noqa: ANN401  (whatever torchmetrics takes)
    ) -> None:
        grid = _grid_around(regions, height_m, cell_m)
        check_regions(regions, grid)
        given = {"height_m": tuple(map(float, height_m)), "cell_m": float(cell_m)}
        named = [
            ("point_density", "points/m2", "frames"),
            (f"point_uniformity_{cell_m:g}m", "share", "frames with points there"),
        ]
        ratios = [
            Ratio("points", "points", True, "frames"),
            *(
                Ratio(f"{name}_{region.name}", unit, True, over, given)
                for name, unit, over in named
                for region in regions
            ),
        ]
        super().__init__(ratios, {"regions": tuple(regions), **given}, rig, **kwargs)
        self.grid = grid
        self.regions = tuple(regions)
        self._cells = [region.mask(grid).flatten() for region in regions]

    def _of_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        cloud = frame.cloud_of(rig_of(frame, self.rig))
        check_cloud(cloud, "sensor")
        cells = torch.bincount(self.grid.bins(cloud).cell, minlength=self.grid.cells).double()
        rows = [(1.0, float(len(cloud)), 1.0)]
        inside = [cells[mask.to(cells.device)] for mask in self._cells]
        rows += [(len(own) * self.grid.cell**2, float(own.sum()), 1.0) for own in inside]
        for own in inside:
            squares = float(own.square().sum())
            rows.append((1.0, float(own.sum()) ** 2 / (len(own) * squares), 1.0) if squares else (0.0, 0.0, 0.0))
        base, sums, counts = torch.tensor(rows, dtype=torch.float64).T
        return base, sums, counts.long()


def _grid_around(regions: Sequence[Region], height_m: tuple[float, float], cell_m: float) -> BevGrid:
    """Whole cells around all regions, in one band."""

    def around(bounds: Sequence[tuple[float, float]]) -> tuple[float, float]:
        low = math.floor(min([low for low, _ in bounds], default=0.0) / cell_m)
        return low * cell_m, max(low + 1, math.ceil(max([high for _, high in bounds], default=0.0) / cell_m)) * cell_m

    x, y = around([region.x for region in regions]), around([region.y for region in regions])
    return BevGrid(x, y, cell_m, {"all": height_m})
