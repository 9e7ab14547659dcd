"""Regions: named rectangles and polygons that a number is given for, and which points belong to them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchcover.coverage.grid import BevGrid
from torchcover.devices import run_with_float64

# How far around the vehicle its near field reaches.
NEAR_FIELD_M = 3.0
# A bound lies on an edge of a cell if it is within this share of one: both are written in decimals.
ON_AN_EDGE = 1e-6


@dataclass(frozen=True)
class Region:
    """A rectangle in the vehicle frame, half-open on both axes, or a polygon.

    By area, a point belongs to it by its own place; over known cells, a cell belongs to it if its centre does.

    Args:
        name: What tables and loggers call it.
        x_m: Lower and upper bound forward, in metres.
        y_m: Lower and upper bound to the left, in metres.
        corners_m: Corners x, y of a polygon, in either direction, which has these bounds; see `Region.polygon`.
        bands: Names of the height bands that tables show of it; all if empty.

    Raises:
        ValueError: No name, bounds that are inverted or not finite, a polygon that crosses or touches itself, or has
            other bounds.

    Example:
        >>> Region("rear", x_m=(-10.0, -2.5), y_m=(-2.5, 2.5)).mask_cells(BevGrid(x_m=(-10.0, 10.0), y_m=(-5.0, 5.0), cell_m=0.5)).sum()
        tensor(150)
    """

    name: str
    x_m: tuple[float, float]
    y_m: tuple[float, float]
    corners_m: tuple[tuple[float, float], ...] = ()
    bands: tuple[str, ...] = field(default=(), compare=False, repr=False)

    def __post_init__(self) -> None:
        if not self.name:
            raise ValueError("a region needs a name")
        for axis, (low, high) in (("x", self.x_m), ("y", self.y_m)):
            if not (-float("inf") < low < high < float("inf")):
                raise ValueError(f"region {self.name!r}: {axis} needs finite bounds, lower first; got {(low, high)}")
        if self.corners_m:
            self._check_polygon()

    @classmethod
    def from_corners(cls, name: str, corners_m: Sequence[tuple[float, float]]) -> "Region":
        """The region within some corners.

        Args:
            name: What tables and loggers call it.
            corners_m: Three or more corners x, y in metres, one after the other around it.

        Raises:
            ValueError: Fewer corners, one that is not finite, edges that cross or touch each other.

        Example:
            >>> corner = Region.from_corners("corner", [(2.0, 1.0), (5.0, 1.0), (2.0, 4.0)])
            >>> corner.x_m, corner.mask_cells(BevGrid(x_m=(0.0, 8.0), y_m=(0.0, 8.0), cell_m=1.0)).sum()
            ((2.0, 5.0), tensor(3))
        """
        corners = tuple((float(x), float(y)) for x, y in corners_m)
        if not all(math.isfinite(number) for corner in corners for number in corner):
            raise ValueError(f"region {name!r}: corners need finite coordinates in metres; got {corners}")
        if len(set(corners)) < 3:
            raise ValueError(f"region {name!r}: three different corners or more are needed; got {len(set(corners))}")
        x, y = zip(*corners, strict=True)
        return cls(name, (min(x), max(x)), (min(y), max(y)), corners)

    def _check_polygon(self) -> None:
        import shapely

        polygon = shapely.Polygon(self.corners_m)
        if not polygon.is_valid:
            raise ValueError(
                f"region {self.name!r}: its edges cross or touch each other ({shapely.is_valid_reason(polygon)}); give "
                "the corners one after the other around it"
            )
        (x_low, y_low, x_high, y_high), bounds = polygon.bounds, (self.x_m[0], self.y_m[0], self.x_m[1], self.y_m[1])
        if (x_low, y_low, x_high, y_high) != bounds:
            raise ValueError(f"region {self.name!r}: its corners have other bounds than x = {self.x_m}, y = {self.y_m}")

    @run_with_float64
    def mask_points(self, x_m: Tensor, y_m: Tensor) -> Tensor:
        """Which places belong to it: the one function that decides, of points as of the centres of cells.

        A polygon holds a place if an odd number of its edges lie further along x: of two regions that share an edge,
        one has it, the one further along x and y.

        Args:
            x_m: Metres forward, any floating-point type.
            y_m: Metres to the left; of a shape that goes with that of x.

        Returns:
            bool of the shape that both have together.

        Example:
            >>> lane = Region("lane", x_m=(0.0, 20.0), y_m=(-1.5, 1.5))
            >>> lane.mask_points(torch.tensor([0.0, 3.0, 20.0]), torch.tensor([-1.5, 1.5, 0.0]))
            tensor([ True, False, False])
        """
        x_m, y_m = x_m.double(), y_m.double()
        within = (x_m >= self.x_m[0]) & (x_m < self.x_m[1]) & (y_m >= self.y_m[0]) & (y_m < self.y_m[1])
        if not self.corners_m:
            return within
        x_m, y_m = (each.expand(within.shape)[within] for each in (x_m, y_m))
        corners = torch.tensor(self.corners_m, dtype=torch.float64, device=x_m.device)
        following = corners.roll(-1, 0)
        # From below in either direction, so that two regions round alike.
        upwards = (corners[:, 1] <= following[:, 1])[:, None]
        low, high = torch.where(upwards, corners, following), torch.where(upwards, following, corners)
        # In order of y, the places beside an edge are a range.
        ordered, order = y_m.sort()
        first, past = (torch.searchsorted(ordered, end[:, 1].contiguous()) for end in (low, high))
        edge = torch.repeat_interleave(past - first)
        before = (past - first).cumsum(0) - past
        place = order[torch.arange(len(edge), device=x_m.device) - before[edge]]
        low, along = low[edge], (high - low)[edge]
        share = (y_m[place] - low[:, 1]) / along[:, 1]
        inside = torch.bincount(place[x_m[place] < low[:, 0] + share * along[:, 0]], minlength=len(x_m)) % 2 == 1
        return within.masked_scatter(within, inside)

    def is_within(self, grid: BevGrid) -> bool:
        """Whether it lies within the grid.

        Example:
            >>> Region("far", (0.0, 90.0), (-1.0, 1.0)).is_within(BevGrid(x_m=(0.0, 80.0), y_m=(-20.0, 20.0)))
            False
        """
        return all(
            bounds[0] <= low and high <= bounds[1]
            for (low, high), bounds in ((self.x_m, grid.x_m), (self.y_m, grid.y_m))
        )

    def mask_cells(self, grid: BevGrid) -> Tensor:
        """(Y, X) bool: the cells of the grid that belong to the region.

        Raises:
            ValueError: The region reaches beyond the grid, so that its number would be about something smaller.
        """
        if not self.is_within(grid):
            axis, region, bounds = next(
                side
                for side in (("x", self.x_m, grid.x_m), ("y", self.y_m, grid.y_m))
                if side[1][0] < side[2][0] or side[1][1] > side[2][1]
            )
            raise ValueError(
                f"region {self.name!r} spans {axis} = {region[0]:g} to {region[1]:g} m, beyond the grid's "
                f"{bounds[0]:g} to {bounds[1]:g} m; enlarge the grid or leave the region out"
            )
        return self.mask_points(grid.x_centers_m[None, :], grid.y_centers_m[:, None])

    def has_whole_cells(self, grid: BevGrid) -> bool:
        """Whether its bounds are edges of cells, so that the points in its cells are those that belong to it.

        Example:
            >>> grid = BevGrid(x_m=(0.0, 4.0), y_m=(0.0, 1.0), cell_m=0.5)
            >>> [Region("ahead", (0.0, far), (0.0, 1.0)).has_whole_cells(grid) for far in (2.5, 2.6)]
            [True, False]
        """
        sides = ((self.x_m, grid.x_edges_m), (self.y_m, grid.y_edges_m))
        off = [float((edges - bound).abs().min()) for bounds, edges in sides for bound in bounds]
        return not self.corners_m and max(off) <= ON_AN_EDGE * grid.cell_m


class RegionBands:
    """The P places of a grid that numbers are given for: each region in each band, region by region."""

    def __init__(self, regions: Sequence[Region], grid: BevGrid) -> None:
        self.regions = tuple(regions)
        self.grid = grid
        self.num_region_bands = len(self.regions) * len(grid.heights)

    def find_index(self, region: Region, band: str) -> int | None:
        """Which place a region and a band are; None if they are none."""
        if region not in self.regions:
            return None
        return self.regions.index(region) * len(self.grid.heights) + list(self.grid.heights).index(band)

    def assign_points(self, points: Tensor, cell_indices: Tensor) -> tuple[Tensor, Tensor]:
        """For each place that a point lies in, (K,) the place and (K,) which point; a point may lie in several.

        Its band is that of its cell, (N,) int64.
        """
        band = cell_indices // math.prod(self.grid.shape[1:])
        x, y = points[:, 0].double(), points[:, 1].double()
        place, point = [band[:0]], [band[:0]]
        for number, region in enumerate(self.regions):
            point.append(region.mask_points(x, y).nonzero().squeeze(1))
            place.append(number * len(self.grid.heights) + band[point[-1]])
        return torch.cat(place), torch.cat(point)


def check_regions(regions: Sequence[Region], grid: BevGrid) -> None:
    """Refuse regions that no number of a grid can be given for.

    Raises:
        ValueError: One reaches beyond the grid, or holds no cell centre; two have one name.
    """
    names = [region.name for region in regions]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"regions: each name may be given once; got {', '.join(map(repr, twice))} again")
    for region in regions:
        if not region.mask_cells(grid).any():
            raise ValueError(f"region {region.name!r} holds no cell centre; use smaller cells than {grid.cell_m:g} m")


def list_region_bands(regions: Sequence[Region], grid: BevGrid) -> list[tuple[Region, str]]:
    """The regions, each with the height bands that tables show of it."""
    return [(region, band) for region in regions for band in grid.heights if not region.bands or band in region.bands]


def get_paper_regions(grid: BevGrid) -> tuple[Region, ...]:
    """Those of the paper's regions that the grid holds.

    Example:
        >>> [region.name for region in get_paper_regions(BevGrid(x_m=(0.0, 100.0), y_m=(-40.0, 40.0)))]
        ['20m', '80m']
    """
    return tuple(region for region in forward_regions() if region.is_within(grid))


def forward_regions(ranges: Sequence[float] = (20.0, 80.0, 160.0)) -> tuple[Region, ...]:
    """The paper's regions in front of the vehicle: x in [0, R), y in [-R/4, R/4).

    Args:
        ranges: R of each region in metres.

    Returns:
        One region a range, named after it: "20m", "80m", ...

    Example:
        >>> forward_regions((20,))
        (Region(name='20m', x_m=(0.0, 20.0), y_m=(-5.0, 5.0), corners_m=()),)
    """
    return tuple(Region(f"{reach:g}m", (0.0, float(reach)), (-reach / 4, reach / 4)) for reach in ranges)


def build_near_field_regions(
    x_m: tuple[float, float], y_m: tuple[float, float], distance_m: float = NEAR_FIELD_M
) -> tuple[Region, ...]:
    """The near field on the four sides of a vehicle; those in front and at the rear have the corners.

    Args:
        x_m: Rear and front end of the vehicle, in metres.
        y_m: Right and left side.
        distance_m: How far the regions reach from it.

    Returns:
        Four regions that do not overlap: "front_3m", "rear_3m", "left_3m", "right_3m".

    Example:
        >>> [(each.name, each.x_m, each.y_m) for each in build_near_field_regions((-0.5, 0.5), (-0.4, 0.4))][1:3]
        [('rear_3m', (-3.5, -0.5), (-3.4, 3.4)), ('left_3m', (-0.5, 0.5), (0.4, 3.4))]
    """
    across = y_m[0] - distance_m, y_m[1] + distance_m
    sides = {
        "front": ((x_m[1], x_m[1] + distance_m), across),
        "rear": ((x_m[0] - distance_m, x_m[0]), across),
        "left": (x_m, (y_m[1], across[1])),
        "right": (x_m, (across[0], y_m[0])),
    }
    return tuple(Region(f"{side}_{distance_m:g}m", *bounds) for side, bounds in sides.items())


# `torch.load` gives them back with weights_only=True, its default.
torch.serialization.add_safe_globals([Region])
