"""Regions of interest: regions, height bands and grid, as YAML or in Python, and the query plan for one vehicle."""

import math
import warnings
from collections.abc import Iterable
from dataclasses import replace
from typing import Annotated, ClassVar, NamedTuple, Self

from pydantic import Field, PositiveFloat, model_validator

from torchcover.coverage import BevGrid, Region, build_near_field_regions, check_regions, forward_regions
from torchcover.coverage.grid import PAPER_HEIGHTS, BandFrame
from torchcover.geometry.arrays import Float64
from torchcover.simulation.documents import Bounds, Coordinate, Document, FileDocument

# Default grid: it contains the regions of the paper, and the space on all sides of the vehicle.
GRID_X_M = (-40.0, 160.0)
GRID_Y_M = (-40.0, 40.0)
DEFAULT_BAND_FRAME: BandFrame = "ground"

# Rectangle on the ground in the vehicle frame in meters: ((x_low, x_high), (y_low, y_high)).
Area = tuple[tuple[float, float], tuple[float, float]]
Areas = tuple[Area, ...]
# (low, high) of each height band in meters.
Bands = tuple[tuple[float, float], ...]
NonEmptyName = Annotated[str, Field(min_length=1)]


class RegionOfInterest(Document):
    """Rectangle or polygon on the ground, in the vehicle frame.

    Args:
        x_m: Lower and upper bound of x (forward) of a rectangle.
        y_m: Lower and upper bound of y (left) of a rectangle.
        polygon_m: Corners x, y of a polygon in order, in place of `x_m` and `y_m`.
    """

    x_m: Bounds | None = None
    y_m: Bounds | None = None
    polygon_m: tuple[tuple[Coordinate, Coordinate], ...] | None = None

    @model_validator(mode="after")
    def _check_one_of(self) -> Self:
        if (self.x_m is None) != (self.y_m is None) or (self.x_m is None) == (self.polygon_m is None):
            raise ValueError("give x_m and y_m, two bounds each, or the corners of polygon_m")
        self.build_region("region")
        return self

    def build_region(self, name: str) -> Region:
        """Build the region.

        Args:
            name: Name of the region.

        Raises:
            ValueError: The polygon intersects itself.
        """
        if self.x_m is not None and self.y_m is not None:
            return Region(name, self.x_m, self.y_m)
        assert self.polygon_m is not None  # checked in _check_one_of
        return Region.from_corners(name, self.polygon_m)


class GridSettings(Document):
    """Settings of the grid; None for the default.

    Args:
        x_m: Lower and upper bound of x (forward).
        y_m: Lower and upper bound of y (left).
        cell_m: Side of a cell.
    """

    x_m: Bounds | None = None
    y_m: Bounds | None = None
    cell_m: PositiveFloat | None = None


class RegionsOfInterest(FileDocument):
    """Regions, height bands and grid of an evaluation, for any vehicle.

    Args:
        regions: Name -> region. By default the three regions of the paper in front of the vehicle and the near field
            on its four sides (`build_near_field_regions`), if the grid contains them.
        heights: Name of each height band -> lower and upper bound of z in meters; bands may overlap. By default
            `ground` and `obstacle` of the paper.
        grid: Extent and cell size. By default x from -40 to 160 m, y from -40 to 40 m, extended to contain the regions,
            and cells of 0.25 m. In a room of at most 40 m around the ego vehicle, or with sensors of shorter range, the
            default grid covers that space only, with the regions `5m`, `10m`, `20m` that it contains, and `room` or
            `range`.

    Raises:
        ValueError: Bounds that are inverted, equal or not finite, or a polygon that intersects itself.

    Example:
        >>> behind = {"behind": {"x_m": (-4.0, -2.5), "y_m": (-1.0, 1.0)}}
        >>> plan = RegionsOfInterest(regions=behind, heights={"child": (0.1, 1.1)}).build_query_plan()
        >>> plan.regions[0].x_m, plan.grid.heights, plan.areas[0]
        ((-4.0, -2.5), {'child': (0.1, 1.1)}, ((-4.0, -2.5), (-1.0, 1.0)))
    """

    kind: ClassVar[str] = "a file of regions"
    regions: dict[NonEmptyName, RegionOfInterest] = Field(default_factory=dict)
    heights: dict[NonEmptyName, Bounds] = Field(default_factory=dict)
    grid: GridSettings = GridSettings()

    def build_query_plan(
        self,
        ego_outline_m: Float64 | None = None,
        cell_m: float | None = None,
        band_frame: BandFrame = DEFAULT_BAND_FRAME,
        visible_region: Region | None = None,
    ) -> "QueryPlan":
        """Build the query plan for one vehicle.

        Args:
            ego_outline_m: (K, 2) corners x, y of the vehicle; None if unknown: then there is no near field.
            cell_m: Side of a cell, in place of that of `grid`.
            band_frame: Frame of the height bands, as in `BevGrid`.
            visible_region: Region outside of which nothing is visible, such as a room. Without regions and extent of
                the grid, the grid covers that region and the near field, and the region is one of the plan.

        Returns:
            Grid, regions, and areas for the reference sensor.

        Raises:
            ValueError: A region that the grid does not contain, or that contains no cell center; an invalid grid.

        Warns:
            UserWarning: A region inside the vehicle.
        """
        vehicle_area = None if ego_outline_m is None else _compute_bounds(ego_outline_m)
        cell_m = cell_m or self.grid.cell_m or 0.25
        named_regions = tuple(region.build_region(name) for name, region in self.regions.items())
        if named_regions or self.grid.x_m or self.grid.y_m or visible_region is None:
            visible_region = None
            grid = self._build_grid(named_regions, cell_m, band_frame)
        else:
            grid = self._build_fitted_grid(visible_region, vehicle_area, cell_m, band_frame)
        grid_area = (grid.x_m, grid.y_m)
        if named_regions:
            check_regions(named_regions, grid)
            _warn_about_regions_in_vehicle(named_regions, vehicle_area)
            areas = (*(_get_area(region) for region in named_regions), grid_area)
            return QueryPlan(grid, named_regions, areas, named_regions)
        candidates = forward_regions() if visible_region is None else forward_regions((5.0, 10.0, 20.0))
        forward = tuple(region for region in candidates if region.is_within(grid))
        if visible_region is not None:
            forward = *forward, Region(visible_region.name, grid.x_m, grid.y_m)
        check_regions(forward, grid)
        near_field = () if ego_outline_m is None else build_near_field(ego_outline_m)
        if not self.heights:  # test targets cover the space above the ground
            near_field = tuple(replace(region, bands=("ground",)) for region in near_field)
        # Cells may be larger than the near field.
        near_field = tuple(region for region in near_field if region.is_within(grid) and region.mask_cells(grid).any())
        near_areas = (_compute_enclosing_area(map(_get_area, near_field)),) if near_field else ()
        regions = (*forward, *near_field) or (Region("grid", grid.x_m, grid.y_m),)
        areas = (*map(_get_area, forward), *near_areas, grid_area)
        return QueryPlan(grid, regions, areas, forward or regions)

    def _build_fitted_grid(
        self, visible_region: Region, vehicle_area: Area | None, cell_m: float, band_frame: BandFrame
    ) -> BevGrid:
        """Build a grid of whole cells that contains the visible region and the near field."""
        areas = [_get_area(visible_region)]
        if vehicle_area is not None:
            areas += map(_get_area, build_near_field_regions(*vehicle_area))
        bounds = []
        for low, high in _compute_enclosing_area(areas):
            lower_m, upper_m = math.floor(low / cell_m) * cell_m, math.ceil(high / cell_m) * cell_m
            bounds.append((round(lower_m, 9), round(upper_m, 9)))
        x_m, y_m = bounds
        return BevGrid(x_m, y_m, cell_m, self.heights or PAPER_HEIGHTS, band_frame)

    def _build_grid(self, regions: tuple[Region, ...], cell_m: float, band_frame: BandFrame) -> BevGrid:
        x_m = self.grid.x_m or _extend_bounds(GRID_X_M, [region.x_m for region in regions], cell_m)
        y_m = self.grid.y_m or _extend_bounds(GRID_Y_M, [region.y_m for region in regions], cell_m)
        return BevGrid(x_m, y_m, cell_m, self.heights or PAPER_HEIGHTS, band_frame)


class QueryPlan(NamedTuple):
    """Regions of an evaluation for one vehicle.

    Args:
        grid: Cells and height bands.
        regions: Regions whose numbers are reported.
        areas: Rectangles that the reference sensor samples; they contain the regions and the grid.
        target_regions: Regions whose standard errors must reach a target error: all regions that the user named, or by
            default those in front of the vehicle.
    """

    grid: BevGrid
    regions: tuple[Region, ...]
    areas: Areas
    target_regions: tuple[Region, ...]

    @property
    def bands_m(self) -> Bands:
        """Height bands that the reference sensor samples."""
        return tuple(self.grid.heights.values())


def build_near_field(ego_outline_m: Float64) -> tuple[Region, ...]:
    """Build the near-field regions of a vehicle, see `build_near_field_regions`.

    Args:
        ego_outline_m: (K, 2) corners x, y of the vehicle.
    """
    return build_near_field_regions(*_compute_bounds(ego_outline_m))


def _compute_bounds(outline_m: Float64) -> Area:
    """Compute the bounds x and y of a vehicle, rounded to millimeters."""
    lower, upper = outline_m.min(axis=0).round(3).tolist(), outline_m.max(axis=0).round(3).tolist()
    return (lower[0], upper[0]), (lower[1], upper[1])


def _get_area(region: Region) -> Area:
    return region.x_m, region.y_m


def _compute_enclosing_area(areas: Iterable[Area]) -> Area:
    """Compute the smallest rectangle that contains all areas; one large area needs fewer rays than many small ones."""
    x, y = zip(*areas, strict=True)
    x_lows, x_highs = zip(*x, strict=True)
    y_lows, y_highs = zip(*y, strict=True)
    return (min(x_lows), max(x_highs)), (min(y_lows), max(y_highs))


def _extend_bounds(
    default: tuple[float, float], region_bounds: list[tuple[float, float]], cell_m: float
) -> tuple[float, float]:
    """Extend the default bounds by whole cells to contain all regions."""
    below_m = max(0.0, default[0] - min([low for low, _ in region_bounds], default=default[0]))
    above_m = max(0.0, max([high for _, high in region_bounds], default=default[1]) - default[1])
    return default[0] - math.ceil(below_m / cell_m) * cell_m, default[1] + math.ceil(above_m / cell_m) * cell_m


def _warn_about_regions_in_vehicle(regions: tuple[Region, ...], vehicle_area: Area | None) -> None:
    if vehicle_area is None:
        return
    (x_low, x_high), (y_low, y_high) = vehicle_area
    for region in regions:
        is_inside_x = x_low <= region.x_m[0] and region.x_m[1] <= x_high
        is_inside_y = y_low <= region.y_m[0] and region.y_m[1] <= y_high
        if is_inside_x and is_inside_y:
            warnings.warn(
                f"region {region.name!r} lies within the vehicle (x = {x_low:g} to {x_high:g} m, y = {y_low:g} to "
                f"{y_high:g} m): only surfaces below it can be observed, so its numbers may be unknown",
                stacklevel=3,
            )
