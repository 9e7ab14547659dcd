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
from torchcover.targets.placing import SIDES, Heading, Raster, from_outline_m, side_of

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
MAPS = ("distance_m", "side", "state", "steps", "points", "sensors", "seen", "least_points", "least_sensors", "share",
        "visible_m2")  # fmt: skip


class Place(NamedTuple):
    """A target at one cell: where it stands, how far from the vehicle's outline, on which side, what is seen of it."""

    x_m: float
    y_m: float
    distance_m: float
    side: str
    points: float
    sensors: float
    share: float


class SideShare(NamedTuple):
    """Of the cells of one side within a distance: how many are free, and the share of the steps with enough points."""

    side: str
    within_m: float
    cells: int
    seen: float


@dataclass(frozen=True, eq=False)
class Spots:
    """What some sensors get of a target at P places: the arrays of `TargetMap` that are called so, of one row."""

    state: NDArray[np.uint8]
    steps: Int64
    sensor_points: Float64
    sensors: Float64
    seen: Float64
    least_points: Float64
    least_sensors: Float64
    share: Float64
    visible_m2: Float64


@dataclass(frozen=True, eq=False, repr=False)
class TargetMap(Spots):
    """What a rig sees of a target, for every cell of a raster. Rows are y, columns are x; NaN where it cannot stand.

    Args:
        rig: Name of the rig.
        scenario: Name of the world.
        target: Name of the target.
        target_size_m: Extent of its box.
        target_bottom_m: Height of its lowest point above the ground.
        heading: How it stands; see `Heading`.
        raster: The cells.
        vehicle: Box of the vehicle.
        vehicle_outline_m: (K, 2) what is drawn of it.
        sensor_model: What its sensors make of their hits, `ideal` or `real`.
        sensor_names: Of the rig.
        sensors_m: (S, 2) where they are, seen from above.
        hits: How many points are enough.
        threshold_m: How near a point of its surface must be to a measured one.
        seed: Of the simulation.
        step_count: How many steps were simulated.
        state: (Y, X) uint8, a number of `STATES`.
        steps: (Y, X) in how many of them the target had room.
        sensor_points: (S, Y, X) mean number of points of each sensor on it.
        sensors: (Y, X) mean number of sensors with enough points each.
        seen: (Y, X) share of the steps with enough points of all sensors together.
        least_points: (Y, X) fewest points on it in any step.
        least_sensors: (Y, X) fewest sensors with enough points each in any step.
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
    vehicle: BoundingBox
    vehicle_outline_m: Float64
    sensor_model: str
    sensor_names: tuple[str, ...]
    sensors_m: Float64
    hits: int
    threshold_m: float
    seed: int
    step_count: int

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
    def free(self) -> Bools:
        """(Y, X) whether it can stand there."""
        return np.asarray(self.state == FREE)

    @property
    def enough(self) -> Bools:
        """(Y, X) whether it is seen: by `hits` points at least, in every step."""
        enough: Bools = np.nan_to_num(self.least_points) >= self.hits
        return enough & self.free

    @property
    def distance_m(self) -> Float64:
        """(Y, X) from the middle of each cell to the vehicle's box, seen from above; 0 within it."""
        away_m: Float64 = np.linalg.norm(from_outline_m(self.vehicle, self.raster.positions_m), axis=1)
        return away_m.reshape(self.raster.shape)

    @property
    def side(self) -> Int64:
        """(Y, X) number in `SIDES` of the side that each cell is on, from corners at 45 degrees; -1 within the box."""
        return side_of(self.vehicle, self.raster.positions_m).reshape(self.raster.shape)

    def sides(self, within_m: tuple[float, ...] = WITHIN_M) -> list[SideShare]:
        """Where it is seen, side by side: for each side, within each distance; NaN where no cell is free."""
        side, distance_m, rows = self.side, self.distance_m, []
        for number, name in enumerate(SIDES):
            for limit_m in within_m:
                there = self.free & (side == number) & (distance_m <= limit_m)
                cells = int(there.sum())
                rows.append(SideShare(name, limit_m, cells, float(self.seen[there].mean()) if cells else math.nan))
        return rows

    def share_seen(self, within_m: float) -> float:
        """Share of the free places within a distance where it is seen; NaN if none is free."""
        near = self.free & (self.distance_m <= within_m)
        return float(self.enough[near].mean()) if near.any() else math.nan

    def losses_m2(self, within_m: float) -> dict[str, float]:
        """For each sensor, how much more is not seen within a distance when it fails: fewer points than enough."""
        near = self.enough & (self.distance_m <= within_m)
        left = self.points - self.sensor_points
        m2 = (near & (left < self.hits)).sum(axis=(1, 2)) * self.raster.step_m**2
        return dict(zip(self.sensor_names, m2.tolist(), strict=True))

    def unseen_to_m(self) -> dict[str, float]:
        """For each side, how far the farthest free cell without enough points is; 0 if all have, NaN if none is."""
        farthest_m = {}
        for number, name in enumerate(SIDES):
            there = self.free & (self.side == number)
            unseen_m = self.distance_m[there & ~self.enough]
            farthest_m[name] = float(unseen_m.max(initial=0.0)) if there.any() else math.nan
        return farthest_m

    def worst(self, count: int = 10, apart_m: float = 1.0) -> list[Place]:
        """The places with the fewest points, and of those the nearest first; no two within a distance of each other."""
        row, column = np.nonzero(self.free)
        order = np.lexsort((self.distance_m[row, column], self.points[row, column]))
        row, column = row[order], column[order]
        worst: list[Place] = []
        while len(row) and len(worst) < count:
            worst.append(self.place(int(row[0]), int(column[0])))
            away_m = np.hypot(self.x_m[column] - worst[-1].x_m, self.y_m[row] - worst[-1].y_m)
            row, column = row[away_m >= apart_m], column[away_m >= apart_m]
        return worst

    def place(self, row: int, column: int) -> Place:
        """What is seen at one cell."""
        side = int(self.side[row, column])
        return Place(
            x_m=float(self.x_m[column]),
            y_m=float(self.y_m[row]),
            distance_m=float(self.distance_m[row, column]),
            side="" if side < 0 else SIDES[side],
            points=float(self.points[row, column]),
            sensors=float(self.sensors[row, column]),
            share=float(self.share[row, column]),
        )

    def border_m(self) -> Float64:
        """(3 E, 2) the border between free cells where it is seen and where not: the ends of each edge, and NaN."""
        seen, free, half_m = self.enough, self.free, self.raster.step_m / 2
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
        return f"TargetMap of {self.target} around {self.rig}: {self.raster.shape} places, {self.step_count} steps"

    def _repr_html_(self) -> str:
        near = (f"{side.side} {format_percent(side.seen)} %" for side in self.sides(WITHIN_M[-1:]) if side.cells)
        where = f"Free places within {WITHIN_M[-1]:g} m where it gets {self.hits} points or more: {', '.join(near)}."
        return build_result_html([f"Would {self.rig} see {self.target}?", where], self.plot())

    @property
    def target_words(self) -> str:
        """Extent of the target, and how high above the ground it is."""
        length, width, height = self.target_size_m
        low, high = self.target_bottom_m, self.target_bottom_m + height
        return f"{length:.2f} x {width:.2f} x {height:.2f} m, {low:.2f} to {high:.2f} m above the ground"

    def plot(self) -> "Figure":
        """The points on the target at every place, with the border of what is seen: a figure of its own."""
        heading = f"{self.heading} side to the vehicle" if isinstance(self.heading, str) else f"yaw {self.heading:g}°"
        steps = f"{self.step_count} step{'s' if self.step_count > 1 else ''}"
        return plot_target_visibility(
            self.points,
            self.enough,
            BevGrid(x_m=self.raster.x, y_m=self.raster.y, cell_m=self.raster.step_m),
            vehicle_outline_m=self.vehicle_outline_m,
            vehicle_box_m=self.vehicle.outline_m,
            sensors_m=self.sensors_m,
            min_points=self.hits,
            title=f"{self.rig}: points on {self.target}",
            subtitle=f"{self.target_words}, {heading}; {self.scenario}, {steps}",
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
        return {**states, "share_unknown": int((self.free & np.isnan(self.share)).sum())}

    def settings(self) -> dict[str, Any]:
        """What it is of, for JSON."""
        return {
            "rig": self.rig,
            "scenario": self.scenario,
            "target": self.target,
            "target_size_m": list(self.target_size_m),
            "target_bottom_m": self.target_bottom_m,
            "heading": self.heading,
            "raster": {"x": list(self.raster.x), "y": list(self.raster.y), "step_m": self.raster.step_m},
            "sensor_model": self.sensor_model,
            "sensors": list(self.sensor_names),
            "hits": self.hits,
            "threshold_m": self.threshold_m,
            "seed": self.seed,
            "steps": self.step_count,
        }


COLUMNS = ("x_m", "y_m", "distance_m", "side", "state", "steps", "points", "sensors", "seen", "least_points",
           "least_sensors", "share", "visible_m2")  # fmt: skip

ARRAYS = ("x_m", "y_m", "state", "steps", "points", "sensor_points", "sensors", "seen", "least_points",
          "least_sensors", "share", "visible_m2",
          "distance_m", "side", "vehicle_outline_m")  # fmt: skip


def write_csv(seen: TargetMap, path: Path) -> None:
    """One row a cell, row by row; empty where nothing is known. Last columns: the points of each sensor."""
    rows: list[list[object]] = [[*COLUMNS, *(f"points_{name}" for name in seen.sensor_names)]]
    points = seen.points
    for row, column in np.ndindex(seen.raster.shape):
        at = row, column
        place = seen.place(row, column)
        means = points[at], seen.sensors[at], seen.seen[at]
        known = *means, seen.least_points[at], seen.least_sensors[at], seen.share[at], seen.visible_m2[at]
        of_sensors = seen.sensor_points[(slice(None), row, column)]
        rows.append([
            f"{place.x_m:.9g}", f"{place.y_m:.9g}", f"{place.distance_m:.9g}", place.side, STATES[seen.state[at]],
            int(seen.steps[at]), *(_number(value) for value in (*known, *of_sensors)),
        ])  # fmt: skip
    path.write_text(format_csv(rows), encoding="utf-8")


def _number(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.9g}"


def write_arrays(seen: TargetMap, path: Path) -> None:
    """All arrays, and the settings as JSON text in `settings`; `np.load` reads it."""
    arrays = {name: getattr(seen, name) for name in ARRAYS}
    write_npz(path, {**arrays, "border_m": seen.border_m(), "settings": np.array(json.dumps(seen.settings()))})
