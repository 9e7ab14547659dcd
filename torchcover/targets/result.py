"""What a rig sees of a target, for every place around the vehicle, and the files of such a map."""

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

import json
from pathlib import Path

from torchcover.files import format_csv, write_npz

# What a cell is: there is room for the target in a step at least; the vehicle is there; there is none in any step.
STATES = ("free", "occupied", "outside")
FREE, OCCUPIED, OUTSIDE = range(3)
WITHIN_M = (1.0, 2.0, 3.0)
MAPS = ("distance_m", "side", "state", "free_frames", "points", "detecting_sensors", "detected_share", "min_points", "min_sensors", "surface_share",
        "visible_m2")  # fmt: skip


class TargetPosition(NamedTuple):
    """A target at one cell: where it stands, how far from the vehicle's outline, on which side, what is seen of it."""

    x_m: float
    y_m: float
    distance_m: float
    side: str
    points: float
    detecting_sensors: float
    surface_share: float


class SideShare(NamedTuple):
    """Of the cells of one side within a distance: how many are free, and the share of the steps with enough points."""

    side: str
    max_distance_m: float
    free_cells: int
    detected_share: float


@dataclass(frozen=True, eq=False)
class PositionVisibility:
    """What some sensors get of a target at P places: the arrays of `TargetMap` that are called so, of one row."""

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
    """What a rig sees of a target, for every cell of a raster. Rows are y, columns are x; NaN where it cannot stand.

    Args:
        rig: Name of the rig.
        scenario: Name of the world.
        target: Name of the target.
        target_size_m: Extent of its box.
        target_bottom_m: Height of its lowest point above the ground.
        heading: How it stands; see `Heading`.
        raster: The cells.
        vehicle_box: Box of the vehicle.
        vehicle_outline_m: (K, 2) what is drawn of it.
        sensor_model: What its sensors make of their hits, `ideal` or `real`.
        sensor_names: Of the rig.
        sensor_positions_m: (S, 2) where they are, seen from above.
        detection_points: How many points are enough.
        threshold_m: How near a point of its surface must be to a measured one.
        seed: Of the simulation.
        num_frames: How many steps were simulated.
        state: (Y, X) uint8, a number of `STATES`.
        steps: (Y, X) in how many of them the target had room.
        sensor_points: (S, Y, X) mean number of points of each sensor on it.
        sensors: (Y, X) mean number of sensors with enough points each.
        seen: (Y, X) share of the steps with enough points of all sensors together.
        min_points: (Y, X) fewest points on it in any step.
        min_sensors: (Y, X) fewest sensors with enough points each in any step.
        share: (Y, X) share of its visible surface within the threshold; NaN too where none is visible.
        visible_m2: (Y, X) its visible surface.
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
        """(X,) middles of the columns."""
        return self.raster.x_m

    @property
    def y_m(self) -> Float64:
        """(Y,) middles of the rows."""
        return self.raster.y_m

    @property
    def points(self) -> Float64:
        """(Y, X) mean number of points on it, of all sensors."""
        return np.asarray(self.sensor_points.sum(axis=0))

    @property
    def free_mask(self) -> Bools:
        """(Y, X) whether it can stand there."""
        return np.asarray(self.state == FREE)

    @property
    def detected_mask(self) -> Bools:
        """(Y, X) whether it is seen: by `hits` points at least, in every step."""
        enough: Bools = np.nan_to_num(self.min_points) >= self.detection_points
        return enough & self.free_mask

    @property
    def distance_m(self) -> Float64:
        """(Y, X) from the middle of each cell to the vehicle's box, seen from above; 0 within it."""
        away_m: Float64 = np.linalg.norm(compute_outline_offsets_m(self.vehicle_box, self.raster.positions_m), axis=1)
        return away_m.reshape(self.raster.shape)

    @property
    def side(self) -> Int64:
        """(Y, X) number in `SIDES` of the side that each cell is on, from corners at 45 degrees; -1 within the box."""
        return find_sides(self.vehicle_box, self.raster.positions_m).reshape(self.raster.shape)

    def summarize_sides(self, max_distances_m: tuple[float, ...] = WITHIN_M) -> list[SideShare]:
        """Where it is seen, side by side: for each side, within each distance; NaN where no cell is free."""
        side, distance_m, rows = self.side, self.distance_m, []
        for number, name in enumerate(SIDES):
            for limit_m in max_distances_m:
                there = self.free_mask & (side == number) & (distance_m <= limit_m)
                cells = int(there.sum())
                rows.append(
                    SideShare(name, limit_m, cells, float(self.detected_share[there].mean()) if cells else math.nan)
                )
        return rows

    def compute_detected_share(self, max_distance_m: float) -> float:
        """Share of the free places within a distance where it is seen; NaN if none is free."""
        near = self.free_mask & (self.distance_m <= max_distance_m)
        return float(self.detected_mask[near].mean()) if near.any() else math.nan

    def compute_failure_effects_m2(self, max_distance_m: float) -> dict[str, float]:
        """For each sensor, how much more is not seen within a distance when it fails: fewer points than enough."""
        near = self.detected_mask & (self.distance_m <= max_distance_m)
        left = self.points - self.sensor_points
        m2 = (near & (left < self.detection_points)).sum(axis=(1, 2)) * self.raster.cell_m**2
        return dict(zip(self.sensor_names, m2.tolist(), strict=True))

    def find_max_undetected_ranges_m(self) -> dict[str, float]:
        """For each side, how far the farthest free cell without enough points is; 0 if all have, NaN if none is."""
        farthest_m = {}
        for number, name in enumerate(SIDES):
            there = self.free_mask & (self.side == number)
            unseen_m = self.distance_m[there & ~self.detected_mask]
            farthest_m[name] = float(unseen_m.max(initial=0.0)) if there.any() else math.nan
        return farthest_m

    def find_worst_positions(self, count: int = 10, min_spacing_m: float = 1.0) -> list[TargetPosition]:
        """The places with the fewest points, and of those the nearest first; no two within a distance of each other."""
        row, column = np.nonzero(self.free_mask)
        order = np.lexsort((self.distance_m[row, column], self.points[row, column]))
        row, column = row[order], column[order]
        worst: list[TargetPosition] = []
        while len(row) and len(worst) < count:
            worst.append(self.get_position(int(row[0]), int(column[0])))
            away_m = np.hypot(self.x_m[column] - worst[-1].x_m, self.y_m[row] - worst[-1].y_m)
            row, column = row[away_m >= min_spacing_m], column[away_m >= min_spacing_m]
        return worst

    def get_position(self, row: int, column: int) -> TargetPosition:
        """What is seen at one cell."""
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
        """(3 E, 2) the border between free cells where it is seen and where not: the ends of each edge, and NaN."""
        seen, free, half_m = self.detected_mask, self.free_mask, self.raster.cell_m / 2
        x, y = np.meshgrid(self.x_m, self.y_m)
        upright = (seen[:, 1:] != seen[:, :-1]) & free[:, 1:] & free[:, :-1]
        level = (seen[1:] != seen[:-1]) & free[1:] & free[:-1]
        parts = []
        for at, (of_x, of_y), along in (
            (upright, (x[:, :-1], y[:, :-1]), (0.0, 2.0)),
            (level, (x[:-1], y[:-1]), (2.0, 0.0)),
        ):
            end = np.stack([of_x[at], of_y[at]], axis=1) + half_m  # ahead and to the left
            parts.append(np.stack([end, end - half_m * np.array(along), np.full_like(end, math.nan)], axis=1))
        return np.asarray(np.concatenate(parts).reshape(-1, 2))

    def __repr__(self) -> str:
        return f"TargetMap of {self.target} around {self.rig}: {self.raster.shape} places, {self.num_frames} steps"

    def _repr_html_(self) -> str:
        near = (
            f"{side.side} {format_percent(side.detected_share)} %"
            for side in self.summarize_sides(WITHIN_M[-1:])
            if side.free_cells
        )
        where = f"Free places within {WITHIN_M[-1]:g} m where it gets {self.detection_points} points or more: {', '.join(near)}."
        return build_result_html([f"Would {self.rig} see {self.target}?", where], self.plot())

    @property
    def target_description(self) -> str:
        """Extent of the target, and how high above the ground it is."""
        length, width, height = self.target_size_m
        low, high = self.target_bottom_m, self.target_bottom_m + height
        return f"{length:.2f} x {width:.2f} x {height:.2f} m, {low:.2f} to {high:.2f} m above the ground"

    def plot(self) -> "Figure":
        """The points on the target at every place, with the border of what is seen: a figure of its own."""
        heading = f"{self.heading} side to the vehicle" if isinstance(self.heading, str) else f"yaw {self.heading:g}°"
        steps = f"{self.num_frames} step{'s' if self.num_frames > 1 else ''}"
        return plot_target_visibility(
            self.points,
            self.detected_mask,
            BevGrid(x_m=self.raster.x_bounds_m, y_m=self.raster.y_bounds_m, cell_m=self.raster.cell_m),
            vehicle_outline_m=self.vehicle_outline_m,
            vehicle_box_m=self.vehicle_box.outline_m,
            sensors_m=self.sensor_positions_m,
            min_points=self.detection_points,
            title=f"{self.rig}: points on {self.target}",
            subtitle=f"{self.target_description}, {heading}; {self.scenario}, {steps}",
        )

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row for each cell, with its middle, `distance_m`, `side`, `state` and all maps.

        Raises:
            ModuleNotFoundError: pandas is not there.
        """
        maps = self.to_xarray().to_dataframe().reset_index()
        maps["side"] = [SIDES[side] if side >= 0 else "" for side in self.side.ravel()]
        maps["state"] = [STATES[state] for state in self.state.ravel()]
        return maps

    def to_xarray(self) -> "xarray.Dataset":
        """The maps, and `points_SENSOR` of each sensor, over `y_m` and `x_m`, the middles of the cells.

        Raises:
            ModuleNotFoundError: xarray is not there.
        """
        maps: dict[str, NDArray[Any]] = {name: getattr(self, name) for name in MAPS}
        maps |= {f"points_{name}": of for name, of in zip(self.sensor_names, self.sensor_points, strict=True)}
        return build_xarray_dataset(maps, {"y_m": self.y_m, "x_m": self.x_m})

    @property
    def counts(self) -> dict[str, int]:
        """How many cells there are of each state, and how many are free and have an unknown share."""
        states = {name: int((self.state == number).sum()) for number, name in enumerate(STATES)}
        return {**states, "surface_share_unobserved": int((self.free_mask & np.isnan(self.surface_share)).sum())}

    def get_settings(self) -> dict[str, Any]:
        """What it is of, for JSON."""
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


COLUMNS = ("x_m", "y_m", "distance_m", "side", "state", "free_frames", "points", "detecting_sensors", "detected_share", "min_points",
           "min_sensors", "surface_share", "visible_m2")  # fmt: skip

ARRAYS = ("x_m", "y_m", "state", "free_frames", "points", "sensor_points", "detecting_sensors", "detected_share", "min_points",
          "min_sensors", "surface_share", "visible_m2",
          "distance_m", "side", "vehicle_outline_m")  # fmt: skip


def write_csv(target_map: TargetMap, path: Path) -> None:
    """One row a cell, row by row; empty where nothing is known. Last columns: the points of each sensor."""
    rows: list[list[object]] = [[*COLUMNS, *(f"points_{name}" for name in target_map.sensor_names)]]
    points = target_map.points
    for row, column in np.ndindex(target_map.raster.shape):
        at = row, column
        place = target_map.get_position(row, column)
        means = points[at], target_map.detecting_sensors[at], target_map.detected_share[at]
        known = (
            *means,
            target_map.min_points[at],
            target_map.min_sensors[at],
            target_map.surface_share[at],
            target_map.visible_m2[at],
        )
        of_sensors = target_map.sensor_points[(slice(None), row, column)]
        rows.append([
            f"{place.x_m:.9g}", f"{place.y_m:.9g}", f"{place.distance_m:.9g}", place.side, STATES[target_map.state[at]],
            int(target_map.free_frames[at]), *(_number(value) for value in (*known, *of_sensors)),
        ])  # fmt: skip
    path.write_text(format_csv(rows), encoding="utf-8")


def _number(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.9g}"


def write_arrays(target_map: TargetMap, path: Path) -> None:
    """All arrays, and the settings as JSON text in `settings`; `np.load` reads it."""
    arrays = {name: getattr(target_map, name) for name in ARRAYS}
    write_npz(
        path,
        {
            **arrays,
            "detection_border_m": target_map.compute_detection_border_m(),
            "settings": np.array(json.dumps(target_map.get_settings())),
        },
    )
