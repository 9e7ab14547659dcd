"""What is asked about: regions, height bands and the grid, as YAML or in Python, and what follows for one vehicle."""

import math
import warnings
from dataclasses import replace
from typing import Annotated, ClassVar, NamedTuple, Self

from pydantic import Field, PositiveFloat, model_validator

from torchcover.coverage import BevGrid, Region, build_near_field_regions, check_regions, forward_regions
from torchcover.coverage.grid import PAPER_HEIGHTS, BandFrame
from torchcover.geometry.arrays import Float64
from torchcover.simulation.documents import Bounds, Coordinate, Document, FileDocument

# Holds the paper's regions, and the space beside and behind the vehicle.
GRID_X_M = (-40.0, 160.0)
GRID_Y_M = (-40.0, 40.0)
CELL_M = 0.25
# In front, where nothing is to be seen beyond a room, or beyond the range of the sensors.
NEAR_RANGES_M = (5.0, 10.0, 20.0)
# What height bands are over, where nothing else is said.
DEFAULT_BAND_FRAME: BandFrame = "ground"

# A rectangle of the ground in the vehicle frame in metres: ((x_low, x_high), (y_low, y_high)).
Area = tuple[tuple[float, float], tuple[float, float]]
Areas = tuple[Area, ...]
# Heights in metres: (low, high) of each.
Bands = tuple[tuple[float, float], ...]
NonEmptyName = Annotated[str, Field(min_length=1)]


class RegionOfInterest(Document):
    """A rectangle or a polygon on the ground, in the vehicle frame.

    Args:
        x_m: Lower and upper bound forward.
        y_m: Lower and upper bound to the left.
        polygon_m: Corners x, y of a polygon instead, one after the other around it.
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
        """The region under a name."""
        if self.x_m is not None and self.y_m is not None:
            return Region(name, self.x_m, self.y_m)
        assert self.polygon_m is not None  # checked in _check_one_of
        return Region.from_corners(name, self.polygon_m)


class GridSettings(Document):
    """What of the grid is not to be as usual.

    Args:
        x_m: Lower and upper bound forward.
        y_m: Lower and upper bound to the left.
        cell_m: Side of a cell.
    """

    x_m: Bounds | None = None
    y_m: Bounds | None = None
    cell_m: PositiveFloat | None = None


class RegionsOfInterest(FileDocument):
    """What a run is asked about, for any vehicle; with nothing given, the usual table.

    Args:
        regions: By name. Not given: the paper's three in front of the vehicle, and the near field on its four sides
            (`build_near_field_regions`), as far as the grid holds them.
        heights: Name of each height band -> lower and upper bound of z in metres; they may overlap. Not given: the
            paper's, ground and obstacle.
        grid: Extent and cell. Not given: x from -40 to 160 m, y from -40 to 40 m, more if regions need it, and cells
            of 0.25 m; where neither it nor regions are given, in a room of at most 40 m around the ego, or with sensors
            that reach no farther, that, with the regions 5m, 10m, 20m as far as they fit, and `room` or `range`.

    Raises:
        ValueError: Bounds that are inverted, equal or not finite, a polygon that crosses itself.

    Example:
        >>> behind = {"behind": {"x_m": (-4.0, -2.5), "y_m": (-1.0, 1.0)}}
        >>> asked = RegionsOfInterest(regions=behind, heights={"child": (0.1, 1.1)}).around()
        >>> asked.regions[0].x, asked.grid.heights, asked.areas[0]
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
        """What follows for one vehicle.

        Args:
            ego_outline_m: (K, 2) corners x, y of the vehicle; None if unknown: then there is no near field.
            cell_m: Side of a cell, whatever `grid` says.
            band_frame: What the height bands are over, as in `BevGrid`.
            visible_region: Beyond which nothing is to be seen, such as a room: where neither regions nor the extent of the grid
                are asked for, the grid is that, with the near field, and its name that of a region.

        Raises:
            ValueError: A region that the grid does not hold, or that holds no cell centre; a grid that cannot be.

        Warns:
            UserWarning: A region that lies within the vehicle.
        """
        vehicle = None if ego_outline_m is None else _bounds(ego_outline_m)
        cell_m = cell_m or self.grid.cell_m or CELL_M
        named = tuple(region.build_region(name) for name, region in self.regions.items())
        if named or self.grid.x_m or self.grid.y_m:
            visible_region = None
        grid = (
            self._grid(named, cell_m, band_frame)
            if visible_region is None
            else self._fitted(visible_region, vehicle, cell_m, band_frame)
        )
        if named:
            check_regions(named, grid)
            _warn_of_hidden(named, vehicle)
            return QueryPlan(grid, named, (*(_area(region) for region in named), (grid.x_m, grid.y_m)), named)
        ranges = forward_regions() if visible_region is None else forward_regions(NEAR_RANGES_M)
        forward = tuple(region for region in ranges if region.is_within(grid))
        if visible_region is not None:
            forward = *forward, Region(visible_region.name, grid.x_m, grid.y_m)
        check_regions(forward, grid)
        near = () if ego_outline_m is None else build_near_field(ego_outline_m)
        if not self.heights:  # of what is above the ground there, bodies are put there
            near = tuple(replace(region, bands=("ground",)) for region in near)
        # Cells may be larger than the near field.
        near = tuple(region for region in near if region.is_within(grid) and region.mask_cells(grid).any())
        around = (_around(near),) if near else ()
        usual = (*forward, *near) or (Region("grid", grid.x_m, grid.y_m),)
        return QueryPlan(grid, usual, (*map(_area, forward), *around, (grid.x_m, grid.y_m)), forward or usual)

    def _fitted(self, within: Region, vehicle: Area | None, cell_m: float, band_frame: BandFrame) -> BevGrid:
        """Of whole cells around what can be seen and the near field."""
        areas = [_area(within)] + ([] if vehicle is None else [_around(build_near_field_regions(*vehicle))])
        x, y = (
            (
                round(math.floor(min(low for low, _ in of) / cell_m) * cell_m, 9),
                round(math.ceil(max(high for _, high in of) / cell_m) * cell_m, 9),
            )
            for of in zip(*areas, strict=True)
        )
        return BevGrid(x, y, cell_m, self.heights or PAPER_HEIGHTS, band_frame)

    def _grid(self, regions: tuple[Region, ...], cell_m: float, band_frame: BandFrame) -> BevGrid:
        x = self.grid.x_m or _holding(GRID_X_M, [region.x_m for region in regions], cell_m)
        y = self.grid.y_m or _holding(GRID_Y_M, [region.y_m for region in regions], cell_m)
        return BevGrid(x, y, cell_m, self.heights or PAPER_HEIGHTS, band_frame)


class QueryPlan(NamedTuple):
    """What a run is asked about.

    Args:
        grid: Cells and height bands.
        regions: Those that numbers are given for.
        areas: The rectangles that the reference sensor is aimed at, which hold them and the grid.
        target_regions: The regions whose errors a target error waits for: all that were asked for by name; in the usual table
            those in front.
    """

    grid: BevGrid
    regions: tuple[Region, ...]
    areas: Areas
    target_regions: tuple[Region, ...]

    @property
    def bands_m(self) -> Bands:
        """The height bands that the reference sensor is aimed at."""
        return tuple(self.grid.heights.values())


def build_near_field(ego_outline_m: Float64) -> tuple[Region, ...]:
    """That of a vehicle with (K, 2) corners x, y; see `build_near_field_regions`."""
    return build_near_field_regions(*_bounds(ego_outline_m))


def _bounds(outline_m: Float64) -> Area:
    """The bounds x and y of a vehicle, to the millimetre."""
    lower, upper = outline_m.min(axis=0).round(3).tolist(), outline_m.max(axis=0).round(3).tolist()
    return (lower[0], upper[0]), (lower[1], upper[1])


def _area(region: Region) -> Area:
    return region.x_m, region.y_m


def _around(regions: tuple[Region, ...]) -> Area:
    """One rectangle around all of them: it takes fewer rays from the others than each would for itself."""
    x, y = zip(*map(_area, regions), strict=True)
    return (
        (min(low for low, _ in x), max(high for _, high in x)),
        (min(low for low, _ in y), max(high for _, high in y)),
    )


def _holding(usual: tuple[float, float], wanted: list[tuple[float, float]], cell_m: float) -> tuple[float, float]:
    """The usual bounds, with as many whole cells more as regions need."""
    below = max(0.0, usual[0] - min([low for low, _ in wanted], default=usual[0]))
    above = max(0.0, max([high for _, high in wanted], default=usual[1]) - usual[1])
    return usual[0] - math.ceil(below / cell_m) * cell_m, usual[1] + math.ceil(above / cell_m) * cell_m


def _warn_of_hidden(regions: tuple[Region, ...], vehicle: Area | None) -> None:
    for region in regions:
        if vehicle and all(
            low <= own[0] and own[1] <= high for own, (low, high) in zip(_area(region), vehicle, strict=True)
        ):
            warnings.warn(
                f"region {region.name!r} lies within the vehicle (x = {vehicle[0][0]:g} to {vehicle[0][1]:g} m, y = "
                f"{vehicle[1][0]:g} to {vehicle[1][1]:g} m): only what can be seen beneath it counts, and a number "
                "that nothing counts for is unknown",
                stacklevel=3,
            )
