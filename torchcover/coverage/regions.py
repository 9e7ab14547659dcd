"""Regions of interest: named rectangles and polygons in bird's-eye view."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchcover.coverage.grid import BevGrid
from torchcover.devices import run_with_float64

# Width of the strip around the vehicle that belongs to its near field.
NEAR_FIELD_M = 3.0


@dataclass(frozen=True)
class Region:
    """Rectangle in the vehicle frame, half-open on both axes, or polygon.

    Averages over area assign points to regions by their position; averages over cells, by the center of the cell.

    Args:
        name: Name in tables and loggers.
        x_m: Lower and upper bound along x (forward) in meters.
        y_m: Lower and upper bound along y (left) in meters.
        corners_m: Corners x, y of a polygon with these bounds, clockwise or counterclockwise; see
            `Region.from_corners`.
        bands: Names of the height bands for which tables have a row; all bands if empty.

    Raises:
        ValueError: The name is empty, bounds are inverted or not finite, or a polygon crosses or touches itself or has
            other bounds.

    Example:
        >>> grid = BevGrid(x_m=(-10.0, 10.0), y_m=(-5.0, 5.0), cell_m=0.5)
        >>> Region("rear", x_m=(-10.0, -2.5), y_m=(-2.5, 2.5)).mask_cells(grid).sum()
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
        """Create a polygon.

        Args:
            name: Name in tables and loggers.
            corners_m: Three or more corners x, y in meters, in order around the polygon.

        Raises:
            ValueError: There are fewer than three different corners, one is not finite, or edges cross or touch.

        Example:
            >>> corner = Region.from_corners("corner", [(2.0, 1.0), (5.0, 1.0), (2.0, 4.0)])
            >>> corner.x_m, corner.mask_cells(BevGrid(x_m=(0.0, 8.0), y_m=(0.0, 8.0), cell_m=1.0)).sum()
            ((2.0, 5.0), tensor(3))
        """
        corners = tuple((float(x), float(y)) for x, y in corners_m)
        if not all(math.isfinite(x) and math.isfinite(y) for x, y in corners):
            raise ValueError(f"region {name!r}: corners need finite coordinates in meters; got {corners}")
        if len(set(corners)) < 3:
            raise ValueError(f"region {name!r}: three different corners or more are needed; got {len(set(corners))}")
        x, y = zip(*corners, strict=True)
        return cls(name, (min(x), max(x)), (min(y), max(y)), corners)

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> "Region":
        """Create a region from its fields in JSON, as `dataclasses.asdict` returns them.

        Args:
            record: Fields.
        """
        corners_m = tuple((x_m, y_m) for x_m, y_m in record["corners_m"])
        return cls(record["name"], tuple(record["x_m"]), tuple(record["y_m"]), corners_m, tuple(record["bands"]))

    def _check_polygon(self) -> None:
        """Check that edges do not cross, and that the corners have the bounds of the region."""
        import shapely

        polygon = shapely.Polygon(self.corners_m)
        if not polygon.is_valid:
            raise ValueError(
                f"region {self.name!r}: its edges cross or touch each other ({shapely.is_valid_reason(polygon)}); give "
                "the corners one after the other around it"
            )
        if polygon.bounds != (self.x_m[0], self.y_m[0], self.x_m[1], self.y_m[1]):
            raise ValueError(f"region {self.name!r}: its corners have other bounds than x = {self.x_m}, y = {self.y_m}")

    @run_with_float64
    def mask_points(self, x_m: Tensor, y_m: Tensor) -> Tensor:
        """Test which positions lie in the region; reference points and cell centers are tested alike.

        A polygon contains a position if an odd number of its edges lie at larger x (ray casting). A position on an edge
        that two regions share belongs to one of them, the region at larger x and y.

        Args:
            x_m: x in meters, any floating-point type.
            y_m: y in meters, of a shape that broadcasts with that of `x_m`.

        Returns:
            bool of the broadcast shape.

        Example:
            >>> lane = Region("lane", x_m=(0.0, 20.0), y_m=(-1.5, 1.5))
            >>> lane.mask_points(torch.tensor([0.0, 3.0, 20.0]), torch.tensor([-1.5, 1.5, 0.0]))
            tensor([ True, False, False])
        """
        x_m, y_m = x_m.double(), y_m.double()
        is_in_bounds = (x_m >= self.x_m[0]) & (x_m < self.x_m[1]) & (y_m >= self.y_m[0]) & (y_m < self.y_m[1])
        if not self.corners_m:
            return is_in_bounds
        x_m, y_m = x_m.expand(is_in_bounds.shape)[is_in_bounds], y_m.expand(is_in_bounds.shape)[is_in_bounds]
        corners = torch.tensor(self.corners_m, dtype=torch.float64, device=x_m.device)
        next_corners = corners.roll(-1, 0)
        # Edges run upwards, so that an edge of two regions rounds alike in both.
        is_upwards = (corners[:, 1] <= next_corners[:, 1])[:, None]
        low, high = torch.where(is_upwards, corners, next_corners), torch.where(is_upwards, next_corners, corners)
        # In order of y, the positions in the y range of an edge are contiguous.
        sorted_y, order = y_m.sort()
        start = torch.searchsorted(sorted_y, low[:, 1].contiguous())
        end = torch.searchsorted(sorted_y, high[:, 1].contiguous())
        edge = torch.repeat_interleave(end - start)
        offset = (end - start).cumsum(0) - end
        position = order[torch.arange(len(edge), device=x_m.device) - offset[edge]]
        edge_start, edge_vector = low[edge], (high - low)[edge]
        edge_share = (y_m[position] - edge_start[:, 1]) / edge_vector[:, 1]
        is_left_of_edge = x_m[position] < edge_start[:, 0] + edge_share * edge_vector[:, 0]
        is_inside = torch.bincount(position[is_left_of_edge], minlength=len(x_m)) % 2 == 1
        return is_in_bounds.masked_scatter(is_in_bounds, is_inside)

    def is_within(self, grid: BevGrid) -> bool:
        """Return whether the region lies within the extents of a grid.

        Args:
            grid: Grid; only its bounds along x and y matter.

        Example:
            >>> Region("far", (0.0, 90.0), (-1.0, 1.0)).is_within(BevGrid(x_m=(0.0, 80.0), y_m=(-20.0, 20.0)))
            False
        """
        return _is_between(self.x_m, grid.x_m) and _is_between(self.y_m, grid.y_m)

    def mask_cells(self, grid: BevGrid) -> Tensor:
        """Test which cells have their center in the region.

        Args:
            grid: Cells.

        Returns:
            (Y, X) bool.

        Raises:
            ValueError: The region reaches beyond the grid, so that its number would describe a smaller region.
        """
        for axis, bounds, grid_bounds in (("x", self.x_m, grid.x_m), ("y", self.y_m, grid.y_m)):
            if not _is_between(bounds, grid_bounds):
                raise ValueError(
                    f"region {self.name!r} spans {axis} = {bounds[0]:g} to {bounds[1]:g} m, beyond the grid's "
                    f"{grid_bounds[0]:g} to {grid_bounds[1]:g} m; enlarge the grid or leave the region out"
                )
        return self.mask_points(grid.x_centers_m[None, :], grid.y_centers_m[:, None])

    def check_whole_cells(self, grid: BevGrid) -> None:
        """Check that all bounds are cell edges, so that the points in its cells are the points in the region.

        Args:
            grid: Cells.

        Raises:
            ValueError: A bound is no cell edge, or the region is a polygon.

        Example:
            >>> grid = BevGrid(x_m=(0.0, 4.0), y_m=(0.0, 1.0), cell_m=0.5)
            >>> Region("ahead", (0.0, 2.5), (0.0, 1.0)).check_whole_cells(grid)
        """
        tolerance_m = 1e-6 * grid.cell_m  # bounds and edges are both written in decimals
        is_whole = not self.corners_m
        for bounds, edges in ((self.x_m, grid.x_edges_m), (self.y_m, grid.y_edges_m)):
            for bound in bounds:
                is_whole &= float((edges - bound).abs().min()) <= tolerance_m
        if not is_whole:
            raise ValueError(
                f"region {self.name!r}: its points were not summed, and its bounds are not edges of the cells of "
                f"{grid.cell_m:g} m; give the region to the metric, or move its bounds to cell edges"
            )


def _is_between(bounds: tuple[float, float], limits: tuple[float, float]) -> bool:
    return limits[0] <= bounds[0] and bounds[1] <= limits[1]


class RegionBands:
    """Pairs of a region and a height band, ordered by region, then by band.

    Args:
        regions: R regions.
        grid: Grid with H bands; there are R * H pairs.
    """

    def __init__(self, regions: Sequence[Region], grid: BevGrid) -> None:
        self.regions = tuple(regions)
        self.grid = grid
        self.num_region_bands = len(self.regions) * len(grid.heights)

    def find_index(self, region: Region, band: str) -> int | None:
        """Find the index of a pair.

        Args:
            region: Region.
            band: Name of a band of the grid.

        Returns:
            Index, or None if the region is not among the regions.
        """
        band_index = self.grid.get_band_index(band)
        return self.regions.index(region) * len(self.grid.heights) + band_index if region in self.regions else None

    def assign_points(self, points: Tensor, cell_indices: Tensor) -> tuple[Tensor, Tensor]:
        """Find the regions of points; a point may lie in several.

        Args:
            points: (N, 3) points in meters.
            cell_indices: (N,) int64 cell of each point, which determines its band.

        Returns:
            (K,) int64 index of the region and band, and (K,) int64 index of the point.
        """
        band = cell_indices // math.prod(self.grid.shape[1:])
        x, y = points[:, 0].double(), points[:, 1].double()
        region_bands, point_indices = [band[:0]], [band[:0]]
        for region_index, region in enumerate(self.regions):
            inside = region.mask_points(x, y).nonzero().squeeze(1)
            point_indices.append(inside)
            region_bands.append(region_index * len(self.grid.heights) + band[inside])
        return torch.cat(region_bands), torch.cat(point_indices)


def check_regions(regions: Sequence[Region], grid: BevGrid) -> None:
    """Check that a grid can give a number for each region.

    Args:
        regions: Regions of interest.
        grid: Cells.

    Raises:
        ValueError: A region reaches beyond the grid or contains no cell center, or two regions have the same name.
    """
    names = [region.name for region in regions]
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"regions: each name may be given once; got {', '.join(map(repr, repeated))} again")
    for region in regions:
        if not region.mask_cells(grid).any():
            raise ValueError(f"region {region.name!r} holds no cell center; use smaller cells than {grid.cell_m:g} m")


def list_region_bands(regions: Sequence[Region], grid: BevGrid) -> list[tuple[Region, str]]:
    """List each region with the height bands for which tables have a row.

    Args:
        regions: Regions of interest; their `bands` select bands.
        grid: Grid with the bands.
    """
    return [(region, band) for region in regions for band in grid.heights if not region.bands or band in region.bands]


def get_paper_regions(grid: BevGrid) -> tuple[Region, ...]:
    """Return the regions of the paper that lie within a grid.

    Args:
        grid: Grid; regions that reach beyond it are excluded.

    Example:
        >>> [region.name for region in get_paper_regions(BevGrid(x_m=(0.0, 100.0), y_m=(-40.0, 40.0)))]
        ['20m', '80m']
    """
    return tuple(region for region in forward_regions() if region.is_within(grid))


def forward_regions(ranges: Sequence[float] = (20.0, 80.0, 160.0)) -> tuple[Region, ...]:
    """Build the regions of the paper in front of the vehicle: x in [0, R), y in [-R/4, R/4).

    Args:
        ranges: R of each region in meters.

    Returns:
        One region per range, named after it: "20m", "80m", ...

    Example:
        >>> forward_regions((20,))
        (Region(name='20m', x_m=(0.0, 20.0), y_m=(-5.0, 5.0), corners_m=()),)
    """
    return tuple(Region(f"{range_m:g}m", (0.0, float(range_m)), (-range_m / 4, range_m / 4)) for range_m in ranges)


def build_near_field_regions(
    x_m: tuple[float, float], y_m: tuple[float, float], distance_m: float = NEAR_FIELD_M
) -> tuple[Region, ...]:
    """Build the near field on the four sides of a vehicle; front and rear include the corners.

    Args:
        x_m: Rear and front end of the vehicle in meters.
        y_m: Right and left side of the vehicle in meters.
        distance_m: Width of the regions in meters.

    Returns:
        Four regions that do not overlap: "front_3m", "rear_3m", "left_3m", "right_3m".

    Example:
        >>> rear = build_near_field_regions((-0.5, 0.5), (-0.4, 0.4))[1]
        >>> rear.name, rear.x_m, rear.y_m
        ('rear_3m', (-3.5, -0.5), (-3.4, 3.4))
    """
    full_width_m = y_m[0] - distance_m, y_m[1] + distance_m
    bounds_by_side = {
        "front": ((x_m[1], x_m[1] + distance_m), full_width_m),
        "rear": ((x_m[0] - distance_m, x_m[0]), full_width_m),
        "left": (x_m, (y_m[1], full_width_m[1])),
        "right": (x_m, (full_width_m[0], y_m[0])),
    }
    return tuple(Region(f"{side}_{distance_m:g}m", *bounds) for side, bounds in bounds_by_side.items())


# Allows `torch.load` with weights_only=True, its default.
torch.serialization.add_safe_globals([Region])
