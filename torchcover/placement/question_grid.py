"""The cells that objectives ask about, and the reference that is aimed at them."""

from collections.abc import Mapping
from typing import NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.coverage import BevGrid, Region
from torchcover.coverage.grid import PAPER_HEIGHTS
from torchcover.placement.objective import Objective, Question
from torchcover.simulation import Areas, SurfaceReference
from torchcover.simulation.regions_of_interest import RegionOfInterest, RegionsOfInterest

# Of the "known cells" measure.
CELL_M = 0.5

Float64 = NDArray[np.float64]
Numbers = NDArray[np.int64]


class ReferencePoints(NamedTuple):
    """The reference points of one instant that are asked about, each counted in every cell that it is in.

    Args:
        points: How many there are.
        of: (P,) int64 which point, for each pair of a point and a cell.
        m2: (P,) square metres that it stands for.
        cell: (P,) int64 number of the cell among those that have points.
        cell_m2: (C,) square metres of the points in each of these cells.
        cells_of: For each question, int64 numbers of its cells among these.
    """

    points: int
    of: Numbers
    m2: Float64
    cell: Numbers
    cell_m2: Float64
    cells_of: tuple[Numbers, ...]

    @property
    def bytes_of_bits(self) -> int:
        """How many bytes a bit for each point takes."""
        return -(-self.points // 8)

    @property
    def bytes(self) -> int:
        """How much memory it takes."""
        return sum(part.nbytes for part in (self.of, self.m2, self.cell, self.cell_m2, *self.cells_of))


class QuestionGrid(NamedTuple):
    """What objectives ask about around one vehicle.

    Args:
        grid: Cells and height bands.
        questions: In the order of the columns of `Scores`.
        asked: For each question, (cells,) bool which cells of the grid it is about.
        areas: Rectangles of whole cells around the regions.
    """

    grid: BevGrid
    questions: tuple[Question, ...]
    asked: tuple[Tensor, ...]
    areas: Areas

    @classmethod
    def around(cls, ego_outline_m: Float64, objectives: Mapping[str, Objective]) -> Self:
        """What follows for one vehicle.

        Args:
            ego_outline_m: (K, 2) its corners x, y.
            objectives: By name.

        Raises:
            ValueError: A region or a band that nobody knows; two regions of one name; one that holds no cell centre.
        """
        usual = {region.name: region for region in RegionsOfInterest().around(ego_outline_m).regions}
        regions: dict[str, Region] = {}
        for name, objective in objectives.items():
            try:
                for region in objective.regions(usual):
                    if regions.setdefault(region.name, region) != region:
                        raise ValueError(f"region {region.name!r}: another objective calls another region so")
                _check_bands(objective)
            except ValueError as error:
                raise ValueError(f"objective {name!r}: {error}") from error
        questions = tuple(dict.fromkeys(one for objective in objectives.values() for one in objective.questions))
        bands = {band: PAPER_HEIGHTS[band] for band in dict.fromkeys(question.band for question in questions)}
        written = {name: _written(region) for name, region in regions.items()}
        grid = RegionsOfInterest(regions=written, heights=bands).around(ego_outline_m, CELL_M).grid
        masks = {name: region.mask(grid) for name, region in regions.items()}
        asked = []
        for question in questions:
            cells = torch.zeros(grid.shape, dtype=torch.bool)
            cells[list(bands).index(question.band)] = masks[question.region]
            asked.append(cells.view(-1))
        return cls(grid, questions, tuple(asked), tuple(_whole_cells(grid, mask) for mask in masks.values()))

    def reference_sensor(self, rays: int) -> SurfaceReference:
        """One that is aimed at what is asked about."""
        return SurfaceReference.from_rays(self.areas, rays, tuple(self.grid.heights.values()))

    def sorted_in(self, points: Tensor, m2: Tensor) -> tuple[Tensor, ReferencePoints]:
        """Those of the points of an instant that are asked about, and where they are.

        Args:
            points: (M, 3) float32 points of the reference.
            m2: (M,) float32 their square metres.

        Returns:
            (K, 3) points, and what they count for.
        """
        bins = self.grid.bins(points)
        kept = torch.stack(self.asked).any(dim=0)[bins.cell]
        point, of = torch.unique(bins.inside[bins.of[kept]], return_inverse=True)
        cells, cell = torch.unique(bins.cell[kept], return_inverse=True)
        weight = m2[point][of].double()
        cell_m2 = torch.bincount(cell, weights=weight, minlength=len(cells)).double()
        cells_of = tuple(asked[cells].nonzero().squeeze(1).numpy() for asked in self.asked)
        held = ReferencePoints(len(point), of.numpy(), weight.numpy(), cell.numpy(), cell_m2.numpy(), cells_of)
        return points[point], held


def _check_bands(objective: Objective) -> None:
    if unknown := [one.band for one in objective.questions if one.band not in PAPER_HEIGHTS]:
        raise ValueError(f"band {unknown[0]!r}: {' or '.join(map(repr, PAPER_HEIGHTS))} is needed")
    if not objective.questions:
        raise ValueError("band: at least one is needed")


def _written(region: Region) -> RegionOfInterest:
    if region.corners_m:
        return RegionOfInterest(polygon_m=region.corners_m)
    return RegionOfInterest(x_m=region.x, y_m=region.y)


def _whole_cells(grid: BevGrid, mask: Tensor) -> tuple[tuple[float, float], tuple[float, float]]:
    """The rectangle around cells: a cell counts as a whole, so that all of it is to be probed."""
    (y_low, y_high), (x_low, x_high) = (
        (float(edges[used.min()]), float(edges[used.max() + 1]))
        for edges, used in (
            (grid.y_edges_m, mask.any(dim=1).nonzero()),
            (grid.x_edges_m, mask.any(dim=0).nonzero()),
        )
    )
    return (x_low, x_high), (y_low, y_high)
