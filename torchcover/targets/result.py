"""Maps of the visibility of a test target around the vehicle, and their files."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.coverage import BevGrid
from torchcover.geometry import BoundingBox
from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.notebooks import build_result_html, build_xarray_dataset
from torchcover.report import format_percent, plot_target_visibility
from torchcover.targets.placing import SIDES, Heading, Raster, compute_outline_offsets_m, find_sides

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.figure import Figure

# States of a position: room for the target in at least one frame; overlaps the vehicle; no room in any frame.
STATES = ("free", "occupied", "outside")
FREE = 0
OCCUPIED = 1
OUTSIDE = 2

# Arrays of a map that have one value for each cell, in the order of the columns of tables.
CELL_ARRAYS = (
    "state", "free_frames", "points", "detecting_sensors", "detected_share", "min_points", "min_sensors",
    "surface_share", "visible_m2",
)  # fmt: skip


class TargetPosition(NamedTuple):
    """Visibility of a target at one position.

    Args:
        x_m: Position forward in the vehicle frame.
        y_m: Position to the left.
        distance_m: Distance from the bounding box of the vehicle.
        side: Side of the vehicle in `SIDES`; empty within the box.
        points: Mean number of points of all sensors on the target.
        detecting_sensors: Mean number of sensors with enough points each.
        surface_share: Share of the visible surface within the threshold of a measured point.
    """

    x_m: float
    y_m: float
    distance_m: float
    side: str
    points: float
    detecting_sensors: float
    surface_share: float


class SideShare(NamedTuple):
    """Detection on one side of the vehicle, within a distance.

    Args:
        side: Side in `SIDES`.
        max_distance_m: Largest distance from the bounding box of the vehicle.
        free_cells: Number of cells in which the target has room.
        detected_share: Mean share of frames in which the target is detected there; NaN without free cells.
    """

    side: str
    max_distance_m: float
    free_cells: int
    detected_share: float


@dataclass(frozen=True, eq=False)
class PositionVisibility:
    """Visibility of a target for some sensors at P positions.

    Args:
        state: (P,) uint8 index in `STATES`.
        free_frames: (P,) frames in which the target has room.
        sensor_points: (S, P) mean number of points of each sensor on the target.
        detecting_sensors: (P,) mean number of sensors with enough points each.
        detected_share: (P,) share of the frames in which all sensors together have enough points.
        min_points: (P,) minimum over the frames of the points of all sensors.
        min_sensors: (P,) minimum over the frames of the number of sensors with enough points each.
        surface_share: (P,) share of the visible surface within the threshold of a measured point.
        visible_m2: (P,) visible surface in square meters.
    """

    state: NDArray[np.uint8]
    free_frames: Int64
    sensor_points: Float64
    detecting_sensors: Float64
    detected_share: Float64
    min_points: Float64
    min_sensors: Float64
    surface_share: Float64
    visible_m2: Float64


@dataclass(frozen=True, eq=False, repr=False)
class TargetMap(PositionVisibility):
    """Visibility of a target for a rig in every cell of a raster. Rows are y, columns are x; NaN without a target.

    Args:
        state: (Y, X) uint8 index in `STATES`.
        free_frames: (Y, X) frames in which the target has room.
        sensor_points: (S, Y, X) mean number of points of each sensor on the target.
        detecting_sensors: (Y, X) mean number of sensors with enough points each.
        detected_share: (Y, X) share of the frames in which all sensors together have enough points.
        min_points: (Y, X) minimum over the frames of the points of all sensors.
        min_sensors: (Y, X) minimum over the frames of the number of sensors with enough points each.
        surface_share: (Y, X) share of the visible surface within the threshold; also NaN where none is visible.
        visible_m2: (Y, X) visible surface in square meters.
        rig: Name of the rig.
        scenario: Name of the scenario.
        target: Name of the target.
        target_size_m: Size of its bounding box.
        target_bottom_m: Height of its lowest point above the ground.
        heading: Its orientation; see `Heading`.
        raster: The cells.
        vehicle_box: Bounding box of the vehicle.
        vehicle_outline_m: (K, 2) outline of the vehicle in plots.
        sensor_model: Sensor model, `ideal` or `real`.
        sensor_names: Names of the S sensors of the rig.
        sensor_positions_m: (S, 2) positions of the sensors in bird's-eye view.
        detection_points: Points that are enough to detect the target.
        threshold_m: Largest distance from a measured point at which a point of the surface counts as detected.
        seed: Seed of the simulation.
        num_frames: Number of simulated frames.
    """

    rig: str
    scenario: str
    target: str
    target_size_m: tuple[float, float, float]
    target_bottom_m: float
    heading: Heading
    raster: Raster
    vehicle_box: BoundingBox
    vehicle_outline_m: Float64
    sensor_model: str
    sensor_names: tuple[str, ...]
    sensor_positions_m: Float64
    detection_points: int
    threshold_m: float
    seed: int
    num_frames: int

    @property
    def x_m(self) -> Float64:
        """(X,) centers of the columns."""
        return self.raster.x_m

    @property
    def y_m(self) -> Float64:
        """(Y,) centers of the rows."""
        return self.raster.y_m

    @property
    def points(self) -> Float64:
        """(Y, X) mean number of points of all sensors on the target."""
        return np.asarray(self.sensor_points.sum(axis=0))

    @property
    def free_mask(self) -> Bools:
        """(Y, X) True where the target has room in at least one frame."""
        return np.asarray(self.state == FREE)

    @property
    def detected_mask(self) -> Bools:
        """(Y, X) True where the target has at least `detection_points` points in every frame."""
        has_enough_points: Bools = np.nan_to_num(self.min_points) >= self.detection_points
        return has_enough_points & self.free_mask

    @property
    def distance_m(self) -> Float64:
        """(Y, X) distance of the cell centers from the vehicle's box in bird's-eye view; 0 within the box."""
        offsets_m = compute_outline_offsets_m(self.vehicle_box, self.raster.positions_m)
        distance_m: Float64 = np.linalg.norm(offsets_m, axis=1)
        return distance_m.reshape(self.raster.shape)

    @property
    def side(self) -> Int64:
        """(Y, X) side of the vehicle as an index in `SIDES`; -1 within its box."""
        return find_sides(self.vehicle_box, self.raster.positions_m).reshape(self.raster.shape)

    def summarize_sides(self, max_distances_m: tuple[float, ...] = (1.0, 2.0, 3.0)) -> list[SideShare]:
        """Summarize the detection on each side of the vehicle.

        Args:
            max_distances_m: Distances from the vehicle's box; each row covers all cells up to one of them.

        Returns:
            One row for each side and distance.
        """
        side, distance_m, rows = self.side, self.distance_m, []
        for index, name in enumerate(SIDES):
            for max_distance_m in max_distances_m:
                mask = self.free_mask & (side == index) & (distance_m <= max_distance_m)
                detected_share = float(self.detected_share[mask].mean()) if mask.any() else math.nan
                rows.append(SideShare(name, max_distance_m, int(mask.sum()), detected_share))
        return rows

    def compute_detected_share(self, max_distance_m: float) -> float:
        """Compute the share of the free cells within a distance in which the target is detected; NaN if none is free.

        Args:
            max_distance_m: Largest distance from the vehicle's box.

        Returns:
            Share from 0 to 1.
        """
        mask = self.free_mask & (self.distance_m <= max_distance_m)
        return float(self.detected_mask[mask].mean()) if mask.any() else math.nan

    def compute_failure_effects_m2(self, max_distance_m: float) -> dict[str, float]:
        """Compute the area in which the target is no longer detected if one sensor fails.

        Args:
            max_distance_m: Largest distance from the vehicle's box.

        Returns:
            Lost area in square meters for each sensor.
        """
        mask = self.detected_mask & (self.distance_m <= max_distance_m)
        remaining_points = self.points - self.sensor_points
        is_lost = mask & (remaining_points < self.detection_points)
        lost_m2 = is_lost.sum(axis=(1, 2)) * self.raster.cell_m**2
        return dict(zip(self.sensor_names, lost_m2.tolist(), strict=True))

    def find_max_undetected_ranges_m(self) -> dict[str, float]:
        """Find the distance of the farthest free cell in which the target is not detected.

        Returns:
            Distance from the vehicle's box for each side; 0 if the target is detected in all free cells, NaN if no
            cell is free.
        """
        max_ranges_m = {}
        for index, name in enumerate(SIDES):
            mask = self.free_mask & (self.side == index)
            undetected_m = self.distance_m[mask & ~self.detected_mask]
            max_ranges_m[name] = float(undetected_m.max(initial=0.0)) if mask.any() else math.nan
        return max_ranges_m

    def find_worst_positions(self, count: int = 10, min_spacing_m: float = 1.0) -> list[TargetPosition]:
        """Find the free positions with the fewest points; among equals, the nearest first.

        Args:
            count: Largest number of positions.
            min_spacing_m: Smallest distance between two of them.

        Returns:
            The positions, the worst first.
        """
        row, column = np.nonzero(self.free_mask)
        order = np.lexsort((self.distance_m[row, column], self.points[row, column]))
        row, column = row[order], column[order]
        positions: list[TargetPosition] = []
        while len(row) and len(positions) < count:
            positions.append(self.get_position(int(row[0]), int(column[0])))
            spacing_m = np.hypot(self.x_m[column] - positions[-1].x_m, self.y_m[row] - positions[-1].y_m)
            row, column = row[spacing_m >= min_spacing_m], column[spacing_m >= min_spacing_m]
        return positions

    def get_position(self, row: int, column: int) -> TargetPosition:
        """Get the visibility in one cell.

        Args:
            row: Row of the cell.
            column: Column of the cell.

        Returns:
            The visibility.
        """
        side = int(self.side[row, column])
        return TargetPosition(
            x_m=float(self.x_m[column]),
            y_m=float(self.y_m[row]),
            distance_m=float(self.distance_m[row, column]),
            side="" if side < 0 else SIDES[side],
            points=float(self.points[row, column]),
            detecting_sensors=float(self.detecting_sensors[row, column]),
            surface_share=float(self.surface_share[row, column]),
        )

    def compute_detection_border_m(self) -> Float64:
        """Compute the border between free cells in which the target is detected and free cells in which it is not.

        Returns:
            (3 E, 2) both ends of each of E edges, followed by NaN, so that one plotted line shows all edges.
        """
        detected, free, half_m = self.detected_mask, self.free_mask, self.raster.cell_m / 2
        x, y = np.meshgrid(self.x_m, self.y_m)
        between_columns = (detected[:, 1:] != detected[:, :-1]) & free[:, 1:] & free[:, :-1]
        between_rows = (detected[1:] != detected[:-1]) & free[1:] & free[:-1]
        edges_along_y = x[:, :-1][between_columns], y[:, :-1][between_columns], (0.0, 2.0)
        edges_along_x = x[:-1][between_rows], y[:-1][between_rows], (2.0, 0.0)
        lines_m = []
        for center_x, center_y, direction in (edges_along_y, edges_along_x):
            begin_m = np.stack([center_x, center_y], axis=1) + half_m  # corner ahead and to the left
            end_m = begin_m - half_m * np.array(direction)
            lines_m.append(np.stack([begin_m, end_m, np.full_like(begin_m, math.nan)], axis=1))
        return np.asarray(np.concatenate(lines_m).reshape(-1, 2))

    def __repr__(self) -> str:
        return f"TargetMap of {self.target} around {self.rig}: {self.raster.shape} positions, {self.num_frames} frames"

    def _repr_html_(self) -> str:
        max_distance_m = 3.0
        shares = []
        for side in self.summarize_sides((max_distance_m,)):
            if side.free_cells:
                shares.append(f"{side.side} {format_percent(side.detected_share)} %")
        criterion = f"with {self.detection_points} points or more"
        sentence = f"Free positions within {max_distance_m:g} m {criterion}: {', '.join(shares)}."
        return build_result_html([f"Detection of {self.target} by {self.rig}", sentence], self.plot())

    @property
    def target_description(self) -> str:
        """Size of the target and its height above the ground."""
        length, width, height = self.target_size_m
        low, high = self.target_bottom_m, self.target_bottom_m + height
        return f"{length:.2f} x {width:.2f} x {height:.2f} m, {low:.2f} to {high:.2f} m above the ground"

    def plot(self) -> "Figure":
        """Plot the points on the target in every cell and the border of detection.

        Returns:
            A new figure.
        """
        heading = f"{self.heading} side to the vehicle" if isinstance(self.heading, str) else f"yaw {self.heading:g}°"
        frames = f"{self.num_frames} frame{'s' if self.num_frames > 1 else ''}"
        return plot_target_visibility(
            self.points,
            self.detected_mask,
            BevGrid(x_m=self.raster.x_bounds_m, y_m=self.raster.y_bounds_m, cell_m=self.raster.cell_m),
            vehicle_outline_m=self.vehicle_outline_m,
            vehicle_box_m=self.vehicle_box.outline_m,
            sensors_m=self.sensor_positions_m,
            min_points=self.detection_points,
            title=f"{self.rig}: points on {self.target}",
            subtitle=f"{self.target_description}, {heading}; {self.scenario}, {frames}",
        )

    def to_dataframe(self) -> "pandas.DataFrame":
        """Convert to a table with a row for each cell: its center, `distance_m`, `side`, `state` and all maps.

        Returns:
            The table.

        Raises:
            ModuleNotFoundError: pandas is not installed.
        """
        table = self.to_xarray().to_dataframe().reset_index()
        table["side"] = [SIDES[side] if side >= 0 else "" for side in self.side.ravel()]
        table["state"] = [STATES[state] for state in self.state.ravel()]
        return table

    def to_xarray(self) -> "xarray.Dataset":
        """Convert to maps over the cell centers `y_m` and `x_m`; `points_SENSOR` are the points of one sensor.

        Returns:
            The maps.

        Raises:
            ModuleNotFoundError: xarray is not installed.
        """
        maps: dict[str, NDArray[Any]] = {name: getattr(self, name) for name in ("distance_m", "side", *CELL_ARRAYS)}
        for name, sensor_points in zip(self.sensor_names, self.sensor_points, strict=True):
            maps[f"points_{name}"] = sensor_points
        return build_xarray_dataset(maps, {"y_m": self.y_m, "x_m": self.x_m})

    @property
    def counts(self) -> dict[str, int]:
        """Number of cells in each state, and of free cells whose surface is not visible from any viewpoint."""
        counts = {name: int((self.state == index).sum()) for index, name in enumerate(STATES)}
        counts["surface_share_unobserved"] = int((self.free_mask & np.isnan(self.surface_share)).sum())
        return counts

    def get_settings(self) -> dict[str, Any]:
        """Get the settings of the measurement, for JSON."""
        return {
            "rig": self.rig,
            "scenario": self.scenario,
            "target": self.target,
            "target_size_m": list(self.target_size_m),
            "target_bottom_m": self.target_bottom_m,
            "heading": self.heading,
            "raster": {
                "x_bounds_m": list(self.raster.x_bounds_m),
                "y_bounds_m": list(self.raster.y_bounds_m),
                "cell_m": self.raster.cell_m,
            },
            "sensor_model": self.sensor_model,
            "sensors": list(self.sensor_names),
            "detection_points": self.detection_points,
            "threshold_m": self.threshold_m,
            "seed": self.seed,
            "num_frames": self.num_frames,
        }
