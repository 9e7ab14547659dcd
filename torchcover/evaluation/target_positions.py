"""Positions of test targets in requirements: points, or an area around the vehicle."""

from typing import Annotated, Literal, Self

import numpy as np
import shapely
from pydantic import Field, PositiveFloat, model_validator

from torchcover.geometry import BoundingBox
from torchcover.geometry.arrays import Float64
from torchcover.simulation.documents import Bounds, Coordinate, Document
from torchcover.targets import SIDES
from torchcover.targets.placing import find_sides

Side = Literal["front", "rear", "left", "right"]
Corners = tuple[tuple[Coordinate, Coordinate], ...]

# Vehicle with which a file is checked before its own vehicle is known: regions have the same names around any vehicle.
EXAMPLE_VEHICLE = BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5))


class TargetPositions(Document):
    """Positions of the center of a test target: one of five forms, in meters.

    Args:
        within_m: All positions up to this distance from the vehicle's box.
        sides: With `within_m`: only on these sides, which are divided by 45 degree lines from the corners of the box.
        x_m: Bounds of a rectangle in the forward direction; the length of the vehicle if only y_m is given.
        y_m: Bounds to the left; the width of the vehicle if only x_m is given.
        polygon_m: Corners x, y of an area, in order.
        line_m: Corners x, y of a line.
        points_m: Single points x, y; an occupied one makes the requirement undecided.
        relative_to: Side of the vehicle's box whose center is the origin of x and y; the vehicle frame if not given.
        spacing_m: Distance between neighboring positions.

    Raises:
        ValueError: Not exactly one form, a polygon that crosses itself, or more than 1000 positions along one axis.

    Example:
        >>> car = BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5))
        >>> positions = TargetPositions(x_m=(-1.0, -0.2), relative_to="rear", spacing_m=2.0)
        >>> positions.compute_positions_m(car).tolist()
        [[-3.0, -1.0], [-2.2, -1.0], [-3.0, 1.0], [-2.2, 1.0]]
    """

    within_m: PositiveFloat | None = None
    sides: tuple[Side, ...] | None = Field(default=None, min_length=1)
    x_m: Bounds | None = None
    y_m: Bounds | None = None
    polygon_m: Annotated[Corners, Field(min_length=3)] | None = None
    line_m: Annotated[Corners, Field(min_length=2)] | None = None
    points_m: Annotated[Corners, Field(min_length=1)] | None = None
    relative_to: Side | None = None
    spacing_m: Annotated[float, Field(ge=0.01)] = 0.2

    @model_validator(mode="after")
    def _check_form(self) -> Self:
        """Raise ValueError unless exactly one form of positions is given, with valid values."""
        forms = (self.within_m, self.x_m or self.y_m, self.polygon_m, self.line_m, self.points_m)
        if sum(form is not None for form in forms) != 1:
            raise ValueError("give one of within_m, x_m and y_m, polygon_m, line_m, points_m")
        if (self.sides and not self.within_m) or (self.relative_to and self.within_m):
            raise ValueError("sides go with within_m, and relative_to with the other forms")
        if self.polygon_m and not shapely.Polygon(self.polygon_m).is_valid:
            raise ValueError("polygon_m: its sides cross or overlap")
        self.compute_positions_m(EXAMPLE_VEHICLE)  # raises if there are too many
        return self

    def compute_positions_m(self, vehicle: BoundingBox) -> Float64:
        """Compute the positions around a vehicle.

        Args:
            vehicle: Bounding box of the vehicle in its own frame.

        Returns:
            (P, 2) x and y in the vehicle frame in meters.

        Raises:
            ValueError: More than 1000 positions along one axis.
        """
        lower_m, upper_m = np.array(vehicle.lower_m[:2]), np.array(vehicle.upper_m[:2])
        origin_m = np.zeros(2)
        if self.relative_to:
            direction = {"front": (1, 0), "rear": (-1, 0), "left": (0, 1), "right": (0, -1)}[self.relative_to]
            origin_m = (lower_m + upper_m + (upper_m - lower_m) * direction) / 2
        if self.line_m is not None:
            line = shapely.LineString(self.line_m)
            positions_m = shapely.get_coordinates(line.interpolate(self._sample_evenly(0.0, line.length)))
        elif self.points_m is not None:
            positions_m = np.array(self.points_m, dtype=np.float64)
        else:
            positions_m = self._compute_area_positions_m(vehicle, lower_m - origin_m, upper_m - origin_m)
        return np.asarray(origin_m + positions_m)

    def _compute_area_positions_m(self, vehicle: BoundingBox, lower_m: Float64, upper_m: Float64) -> Float64:
        """Compute the raster positions in an area; `lower_m` and `upper_m` are corners of the vehicle's box."""
        (x_min_m, x_max_m), (y_min_m, y_max_m) = (
            self.x_m or (lower_m[0], upper_m[0]),
            self.y_m or (lower_m[1], upper_m[1]),
        )
        rectangle = shapely.box(x_min_m, y_min_m, x_max_m, y_max_m)
        area = shapely.Polygon(self.polygon_m) if self.polygon_m else rectangle
        area = area.buffer(self.within_m or 0.0)
        x_min_m, y_min_m, x_max_m, y_max_m = area.bounds
        axes_m = self._sample_evenly(x_min_m, x_max_m), self._sample_evenly(y_min_m, y_max_m)
        raster_m = np.stack(np.meshgrid(*axes_m), axis=-1).reshape(-1, 2)
        is_inside = shapely.intersects_xy(area, raster_m)
        if self.within_m:
            side_indices = [SIDES.index(side) for side in self.sides or SIDES]
            is_inside &= np.isin(find_sides(vehicle, raster_m), side_indices)
        return np.asarray(raster_m[is_inside])

    def _sample_evenly(self, low_m: float, high_m: float, max_intervals: int = 1000) -> Float64:
        """Divide an interval evenly into the fewest parts of at most `spacing_m`; both ends are included."""
        num_intervals = int(np.ceil((high_m - low_m) / self.spacing_m - 1e-9))  # rounding must not add an interval
        if num_intervals > max_intervals:
            raise ValueError(
                f"positions over {high_m - low_m:g} m with a spacing of {self.spacing_m:g} m are more than "
                f"{max_intervals:,}; use a larger spacing_m"
            )
        return np.linspace(low_m, high_m, num_intervals + 1)
