"""What is drawn over a map: the ego vehicle, and the sensors with their directions; black and white, unlike data."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch, Polygon
from matplotlib.patheffects import AbstractPathEffect, withStroke
from numpy.typing import NDArray

from torchcover.geometry import convert_rotation_to_euler
from torchcover.report.plot_layout import Sheet

# Okabe and Ito's colours, which the colour-blind can tell apart; then all of them darker, then lighter.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#777777")
SHADES = ((1.0, 0.0), (0.5, 0.0), (0.5, 0.5))
ARROW_POINTS = 20.0
NUMBER_POINTS = 24.0
OVERLAP_POINTS = 9.0
DOT: dict[str, Any] = {"markersize": 4.5, "markerfacecolor": "black", "markeredgecolor": "white"}
HALO: Sequence[AbstractPathEffect] = [withStroke(linewidth=2.2, foreground="white")]
THIN_HALO: Sequence[AbstractPathEffect] = [withStroke(linewidth=1.8, foreground="white")]


@dataclass(frozen=True, eq=False)
class SensorView:
    """A sensor over a map, or on a drawing of its rig.

    Args:
        name: What the legend calls it.
        vehicle_T_sensor: (4, 4) pose; its frame is x forward, y left, z up.
        horizontal_fov_deg: Horizontal field of view about its x axis, in (0, 360].
        vertical_fov_deg: Its lowest and its highest elevation.
        range_m: Maximum range in metres, infinity if there is none.

    Raises:
        ValueError: A pose of another shape or that is not finite, a horizontal field of view outside (0, 360], a
            vertical one that is not lowest first, a range that is not positive.

    Example:
        >>> view = SensorView("front", np.eye(4), 90.0, (-10.0, 10.0), 50.0)
        >>> view.x_m, view.yaw_deg, view.sees(np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]))
        (0.0, 0.0, array([ True, False]))
    """

    name: str
    vehicle_T_sensor: NDArray[np.float64]
    horizontal_fov_deg: float
    vertical_fov_deg: tuple[float, float]
    range_m: float

    def __post_init__(self) -> None:
        pose, (low, high) = self.vehicle_T_sensor, self.vertical_fov_deg
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise ValueError(f"sensor {self.name!r}: vehicle_T_sensor must be (4, 4) and finite; got {pose}")
        if not 0 < self.horizontal_fov_deg <= 360:
            raise ValueError(f"sensor {self.name!r}: horizontal_fov_deg in (0, 360]; got {self.horizontal_fov_deg}")
        if not -90 <= low <= high <= 90:
            raise ValueError(f"sensor {self.name!r}: vertical_fov_deg in [-90, 90], lowest first; got {(low, high)}")
        if not self.range_m > 0:
            raise ValueError(f"sensor {self.name!r}: range_m must be positive; got {self.range_m}")

    @property
    def position_m(self) -> NDArray[np.float64]:
        """(3,) its place in the vehicle frame."""
        return self.vehicle_T_sensor[:3, 3]

    @property
    def x_m(self) -> float:
        """Its place forward."""
        return float(self.vehicle_T_sensor[0, 3])

    @property
    def y_m(self) -> float:
        """Its place to the left."""
        return float(self.vehicle_T_sensor[1, 3])

    @property
    def yaw_deg(self) -> float:
        """Its direction: 0 is forward, positive turns left."""
        return float(convert_rotation_to_euler(self.vehicle_T_sensor[:3, :3])[0])

    @property
    def tilt_deg(self) -> tuple[float, float]:
        """Its pitch and roll."""
        _, pitch_deg, roll_deg = convert_rotation_to_euler(self.vehicle_T_sensor[:3, :3])
        return float(pitch_deg), float(roll_deg)

    def compute_outline_m(self, max_range_m: float, num_points: int = 361) -> NDArray[np.float64]:
        """Trace the field of view from above, up to a reach, the range of the sensor, or the ground at z = 0.

        In each direction from above the ray decides that goes farthest. There is no ground below a sensor with z <= 0:
        such a frame has its origin in a sensor.

        Args:
            max_range_m: Longest ray in meters.
            num_points: Number of directions.

        Returns:
            (K, 2) corners x, y in the vehicle frame in meters.
        """
        position_m = self.position_m[:2]
        if not self.is_tilted:
            half_deg = self.horizontal_fov_deg / 2
            angles = np.deg2rad(np.linspace(self.yaw_deg - half_deg, self.yaw_deg + half_deg, num_points))
            radius_m = self.compute_level_range_m(max_range_m)
            arc_m = position_m + radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=1)
            return arc_m if self.horizontal_fov_deg == 360 else np.vstack([arc_m, position_m])
        angles = np.deg2rad(np.linspace(self.yaw_deg - 180, self.yaw_deg + 180, num_points))[:, None]
        elevations = np.deg2rad(np.linspace(-90.0, 90.0, 1441))[None]  # near the horizon, 0.125 degrees are meters
        level, up = np.cos(elevations), np.sin(elevations) + 0.0 * angles
        rays = np.stack([level * np.cos(angles), level * np.sin(angles), up], axis=-1)
        seen = self.mask_directions(rays.reshape(-1, 3)).reshape(rays.shape[:2])
        lengths_m = np.where(seen, self._horizontal_m(elevations, max_range_m), 0.0).max(axis=1, keepdims=True)
        return np.asarray(position_m + lengths_m * np.hstack([np.cos(angles), np.sin(angles)]))

    @property
    def is_tilted(self) -> bool:
        """Whether its pitch or roll differs from zero."""
        return not np.allclose(self.tilt_deg, 0.0)

    def compute_level_range_m(self, max_range_m: float) -> float:
        """Horizontal length in meters of the most level ray of a sensor that is not tilted, up to a reach."""
        most_level_deg = np.clip(0.0, *self.vertical_fov_deg)
        return float(self._horizontal_m(np.deg2rad(most_level_deg), max_range_m))

    def _horizontal_m(self, elevations: NDArray[np.float64], reach_m: float) -> NDArray[np.float64]:
        """Horizontal lengths in meters of rays of some elevations in radians, which end on the ground at z = 0."""
        height_m = self.position_m[2] if self.position_m[2] > 0 else math.inf
        to_ground_m = np.where(elevations < 0, height_m / np.maximum(-np.sin(elevations), 1e-9), math.inf)
        return np.asarray(np.minimum(to_ground_m, min(reach_m, self.range_m)) * np.cos(elevations))

    def mask_directions(self, directions: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which of (N, 3) directions in the vehicle frame lie in the field of view."""
        x, y, z = (directions @ self.vehicle_T_sensor[:3, :3]).T
        azimuth_deg = np.rad2deg(np.arctan2(y, x))
        elevation_deg = np.rad2deg(np.arctan2(z, np.hypot(x, y)))
        low, high = self.vertical_fov_deg
        inside: NDArray[np.bool_] = np.logical_and(low <= elevation_deg, elevation_deg <= high)
        inside &= abs(azimuth_deg) <= self.horizontal_fov_deg / 2
        return inside


def get_sensor_color(index: int) -> str:
    """The colour of a sensor by its number, from 0 on: no other of the first 21 has it.

    Example:
        >>> get_sensor_color(0), get_sensor_color(7), get_sensor_color(14)
        ('#0072b2', '#003959', '#80b8d8')
    """
    share, white = SHADES[index // len(COLOURS) % len(SHADES)]
    red_green_blue = np.array([int(COLOURS[index % len(COLOURS)][digit : digit + 2], 16) for digit in (1, 3, 5)])
    return "#" + "".join(f"{value:02x}" for value in np.rint(share * red_green_blue + 255 * white).astype(int).tolist())


def plot_ego(axes: Axes, outline_m: NDArray[np.floating]) -> list[Artist]:
    """Fill the ego's outline.

    `axes`: axes of a map; `outline_m`: (K, 2) corners x, y in the vehicle frame in metres, K >= 3. Returns legend
    entries. ValueError: another shape.
    """
    outline = np.asarray(outline_m)
    if outline.ndim != 2 or outline.shape[1] != 2 or len(outline) < 3:
        raise ValueError(f"ego_outline_m: (K, 2) corners x, y with K >= 3 are needed; got shape {outline.shape}")
    ego = Polygon(outline, closed=True, facecolor="white", edgecolor="black", linewidth=1.0, zorder=3, label="ego")
    axes.add_patch(ego)
    return [ego]


def plot_sensors(sheet: Sheet, sensors: Sequence[SensorView], *, show_names: bool = True) -> list[Artist]:
    """Draw each sensor as a dot with an arrow in its direction, numbered if there are several, and its field of view.

    `sheet`: the sheet of the map; `sensors`: what to draw; `show_names`: whether the legend names each; else there are no
    numbers either. Returns legend entries.
    """
    if not sensors:
        return []
    view = Line2D([], [], color="black", linewidth=0.8, linestyle=(0, (5, 3)), label="field of view, up to its range")
    for sensor in sensors:
        _draw_view(sheet, sensor)
    for sensor in sensors:
        _draw_arrow(sheet, sensor)
    if not show_names:
        return [Line2D([], [], linestyle="none", marker="o", label="sensor, with its direction", **DOT), view]
    if len(sensors) > 1:
        _draw_numbers(sheet, sensors)
    marks = [f"${number}$" if len(sensors) > 1 else "o" for number in range(1, len(sensors) + 1)]
    return [*(_legend_entry(sheet, *pair) for pair in zip(marks, sensors, strict=True)), view]


def plot_sensor_positions(sheet: Sheet, sensors: Sequence[SensorView]) -> list[Artist]:
    """Draw each sensor as a dot, and nothing over the cells around it; returns legend entries."""
    for sensor in sensors:
        sheet.axes.plot(sensor.x_m, sensor.y_m, linestyle="none", marker="o", zorder=5, **DOT)
    return [Line2D([], [], linestyle="none", marker="o", label="sensor", **DOT)] if sensors else []


def _draw_view(sheet: Sheet, sensor: SensorView) -> None:
    start = sensor.x_m, sensor.y_m
    furthest = max(math.dist(start, corner) for corner in product(sheet.axes.get_xlim(), sheet.axes.get_ylim()))
    # Infinity cannot be drawn; beyond the map all ranges look the same.
    wedge = Polygon(
        sensor.compute_outline_m(2 * furthest),
        fill=False,
        edgecolor="black",
        linewidth=0.8,
        linestyle=(0, (5, 3)),
        zorder=2.5,
        path_effects=THIN_HALO,
    )
    sheet.axes.add_patch(wedge)


def _draw_arrow(sheet: Sheet, sensor: SensorView) -> None:
    start, tip = (sensor.x_m, sensor.y_m), _ahead(sheet, sensor, ARROW_POINTS)
    arrow = FancyArrowPatch(
        start, tip, arrowstyle="-|>", mutation_scale=9, shrinkA=0, shrinkB=0, linewidth=1.2, color="black", zorder=4
    )
    arrow.set(path_effects=HALO)
    sheet.axes.add_patch(arrow)
    sheet.axes.plot(*start, linestyle="none", marker="o", zorder=5, **DOT)


def _draw_numbers(sheet: Sheet, sensors: Sequence[SensorView]) -> None:
    for (x, y), numbers in _places(sheet, sensors).items():
        # The text grows away from the arrow.
        side = {1: "left", 0: "center", -1: "right"}[round(math.cos(math.radians(sensors[numbers[0] - 1].yaw_deg)))]
        text = sheet.axes.text(x, y, ", ".join(map(str, numbers)), fontsize=8, ha=side, va="center", clip_on=True)
        text.set(zorder=5, path_effects=HALO)


def _places(sheet: Sheet, sensors: Sequence[SensorView]) -> dict[tuple[float, float], list[int]]:
    """Where to write which numbers: sensors whose numbers would overlap share a place."""
    places: dict[tuple[float, float], list[int]] = {}
    for number, sensor in enumerate(sensors, start=1):
        wanted = _ahead(sheet, sensor, NUMBER_POINTS)
        near = (place for place in places if math.dist(place, wanted) < OVERLAP_POINTS / 72 * sheet.meters_per_inch)
        places.setdefault(next(near, wanted), []).append(number)
    return places


def _legend_entry(sheet: Sheet, mark: str, sensor: SensorView) -> Artist:
    (left, right), (bottom, top) = sheet.axes.get_xlim(), sheet.axes.get_ylim()
    inside = left <= sensor.x_m <= right and bottom <= sensor.y_m <= top
    label = f"{sensor.name}{'' if inside else ' (beyond the map)'}"
    style = (
        DOT if mark == "o" else {"color": "black", "markeredgewidth": 0, "markersize": 3.5 * len(mark.strip("$")) + 2.5}
    )
    return Line2D([], [], linestyle="none", marker=mark, label=label, **style)


def _ahead(sheet: Sheet, sensor: SensorView, points: float) -> tuple[float, float]:
    """The place so many points (1/72 inch) in front of the sensor, in metres."""
    reach, yaw = points / 72 * sheet.meters_per_inch, math.radians(sensor.yaw_deg)
    return sensor.x_m + reach * math.cos(yaw), sensor.y_m + reach * math.sin(yaw)
