"""Overlays of maps in black and white: the ego vehicle, and the sensors with their directions."""

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

# Colors of Okabe and Ito, which are distinct for color-blind readers.
SENSOR_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#777777")
DOT: dict[str, Any] = {"markersize": 4.5, "markerfacecolor": "black", "markeredgecolor": "white"}
HALO: Sequence[AbstractPathEffect] = [withStroke(linewidth=2.2, foreground="white")]
THIN_HALO: Sequence[AbstractPathEffect] = [withStroke(linewidth=1.8, foreground="white")]


@dataclass(frozen=True, eq=False)
class SensorView:
    """Sensor on a map or on a plot of its rig.

    Args:
        name: Name in the legend.
        vehicle_T_sensor: (4, 4) extrinsics; the sensor frame is x forward, y left, z up.
        horizontal_fov_deg: Horizontal field of view around the x axis, in (0, 360].
        vertical_fov_deg: Lowest and highest elevation.
        range_m: Maximum range in meters; infinity without a limit.

    Raises:
        ValueError: The pose has another shape or is not finite, the horizontal field of view is outside (0, 360], the
            vertical one is not in ascending order, or the range is not positive.

    Example:
        >>> view = SensorView("front", np.eye(4), 90.0, (-10.0, 10.0), 50.0)
        >>> view.x_m, view.yaw_deg, view.mask_directions(np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]))
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
        """(3,) position in the vehicle frame."""
        return self.vehicle_T_sensor[:3, 3]

    @property
    def x_m(self) -> float:
        """Position forward in meters."""
        return float(self.vehicle_T_sensor[0, 3])

    @property
    def y_m(self) -> float:
        """Position to the left in meters."""
        return float(self.vehicle_T_sensor[1, 3])

    @property
    def yaw_deg(self) -> float:
        """Yaw in degrees: 0 is forward, positive to the left."""
        return float(convert_rotation_to_euler(self.vehicle_T_sensor[:3, :3])[0])

    @property
    def tilt_deg(self) -> tuple[float, float]:
        """Pitch and roll in degrees."""
        _, pitch_deg, roll_deg = convert_rotation_to_euler(self.vehicle_T_sensor[:3, :3])
        return float(pitch_deg), float(roll_deg)

    def compute_outline_m(self, max_range_m: float, num_points: int = 361) -> NDArray[np.float64]:
        """Compute the outline of the field of view in bird's-eye view, up to a range or the ground at z = 0.

        In each direction the longest ray decides. A sensor with z <= 0 has no ground below it, since such a frame has
        its origin in a sensor.

        Args:
            max_range_m: Maximum length of a ray in meters.
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
        is_in_fov = self.mask_directions(rays.reshape(-1, 3)).reshape(rays.shape[:2])
        lengths_m = np.where(is_in_fov, self._compute_horizontal_m(elevations, max_range_m), 0.0).max(
            axis=1, keepdims=True
        )
        return np.asarray(position_m + lengths_m * np.hstack([np.cos(angles), np.sin(angles)]))

    @property
    def is_tilted(self) -> bool:
        """True if pitch or roll differs from zero."""
        return not np.allclose(self.tilt_deg, 0.0)

    def compute_level_range_m(self, max_range_m: float) -> float:
        """Compute the horizontal length of the most level ray of a sensor that is not tilted.

        Args:
            max_range_m: Maximum length of a ray in meters.
        """
        most_level_deg = np.clip(0.0, *self.vertical_fov_deg)
        return float(self._compute_horizontal_m(np.deg2rad(most_level_deg), max_range_m))

    def _compute_horizontal_m(self, elevations: NDArray[np.float64], max_range_m: float) -> NDArray[np.float64]:
        """Return horizontal lengths in meters of rays with elevations in radians, which end on the ground at z = 0."""
        height_m = self.position_m[2] if self.position_m[2] > 0 else math.inf
        to_ground_m = np.where(elevations < 0, height_m / np.maximum(-np.sin(elevations), 1e-9), math.inf)
        return np.asarray(np.minimum(to_ground_m, min(max_range_m, self.range_m)) * np.cos(elevations))

    def mask_directions(self, directions: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Mask the directions in the field of view.

        Args:
            directions: (N, 3) directions in the vehicle frame.

        Returns:
            (N,) bool.
        """
        x, y, z = (directions @ self.vehicle_T_sensor[:3, :3]).T
        azimuth_deg = np.rad2deg(np.arctan2(y, x))
        elevation_deg = np.rad2deg(np.arctan2(z, np.hypot(x, y)))
        low, high = self.vertical_fov_deg
        is_in_fov: NDArray[np.bool_] = np.logical_and(low <= elevation_deg, elevation_deg <= high)
        is_in_fov &= abs(azimuth_deg) <= self.horizontal_fov_deg / 2
        return is_in_fov


def get_sensor_color(index: int) -> str:
    """Return the color of a sensor; the first 21 are distinct.

    Args:
        index: Index of the sensor, from 0.

    Example:
        >>> get_sensor_color(0), get_sensor_color(7), get_sensor_color(14)
        ('#0072b2', '#003959', '#80b8d8')
    """
    shades = ((1.0, 0.0), (0.5, 0.0), (0.5, 0.5))  # all colors, then darker, then lighter
    share, white = shades[index // len(SENSOR_COLORS) % len(shades)]
    color = SENSOR_COLORS[index % len(SENSOR_COLORS)]
    red_green_blue = np.array([int(color[digit : digit + 2], 16) for digit in (1, 3, 5)])
    mixed = np.rint(share * red_green_blue + 255 * white).astype(int).tolist()
    return "#" + "".join(f"{value:02x}" for value in mixed)


def plot_ego(axes: Axes, outline_m: NDArray[np.floating]) -> list[Artist]:
    """Plot the outline of the ego vehicle.

    Args:
        axes: Axes of a map.
        outline_m: (K, 2) corners x, y in the vehicle frame in meters, K >= 3.

    Returns:
        Legend entries.

    Raises:
        ValueError: The outline has another shape.
    """
    outline = np.asarray(outline_m)
    if outline.ndim != 2 or outline.shape[1] != 2 or len(outline) < 3:
        raise ValueError(f"ego_outline_m: got shape {outline.shape}; give (K, 2) corners x, y with K >= 3")
    ego = Polygon(
        outline, closed=True, facecolor="white", edgecolor="black", linewidth=1.0, zorder=3, label="ego vehicle"
    )
    axes.add_patch(ego)
    return [ego]


def plot_sensors(sheet: Sheet, sensors: Sequence[SensorView], *, show_names: bool = True) -> list[Artist]:
    """Plot each sensor as a dot with an arrow in its direction, and its field of view; several sensors are numbered.

    Args:
        sheet: Sheet of the map.
        sensors: Sensors to plot.
        show_names: Whether to number the sensors and list their names in the legend.

    Returns:
        Legend entries.
    """
    if not sensors:
        return []
    view = Line2D([], [], color="black", linewidth=0.8, linestyle=(0, (5, 3)), label="field of view, up to its range")
    for sensor in sensors:
        _plot_field_of_view(sheet, sensor)
    for sensor in sensors:
        _plot_arrow(sheet, sensor)
    if not show_names:
        return [Line2D([], [], linestyle="none", marker="o", label="sensor, with its direction", **DOT), view]
    if len(sensors) > 1:
        _plot_numbers(sheet, sensors)
    marks = [f"${number}$" if len(sensors) > 1 else "o" for number in range(1, len(sensors) + 1)]
    return [*(_build_legend_entry(sheet, *pair) for pair in zip(marks, sensors, strict=True)), view]


def plot_sensor_positions(sheet: Sheet, sensors: Sequence[SensorView]) -> list[Artist]:
    """Plot each sensor as a dot, so that the cells around it stay visible.

    Args:
        sheet: Sheet of the map.
        sensors: Sensors to plot.

    Returns:
        Legend entries.
    """
    for sensor in sensors:
        sheet.axes.plot(sensor.x_m, sensor.y_m, linestyle="none", marker="o", zorder=5, **DOT)
    return [Line2D([], [], linestyle="none", marker="o", label="sensor", **DOT)] if sensors else []


def _plot_field_of_view(sheet: Sheet, sensor: SensorView) -> None:
    """Fill the horizontal field of view up to its range or the edge of the map."""
    start = sensor.x_m, sensor.y_m
    furthest = max(math.dist(start, corner) for corner in product(sheet.axes.get_xlim(), sheet.axes.get_ylim()))
    # Infinity cannot be plotted; beyond the map all ranges look the same.
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


def _plot_arrow(sheet: Sheet, sensor: SensorView) -> None:
    """Plot an arrow in the direction of a sensor."""
    start, tip = (sensor.x_m, sensor.y_m), _find_point_ahead(sheet, sensor, 20.0)
    arrow = FancyArrowPatch(
        start, tip, arrowstyle="-|>", mutation_scale=9, shrinkA=0, shrinkB=0, linewidth=1.2, color="black", zorder=4
    )
    arrow.set(path_effects=HALO)
    sheet.axes.add_patch(arrow)
    sheet.axes.plot(*start, linestyle="none", marker="o", zorder=5, **DOT)


def _plot_numbers(sheet: Sheet, sensors: Sequence[SensorView]) -> None:
    """Write the numbers of sensors, with one label for sensors at the same position."""
    for (x, y), numbers in _assign_label_positions(sheet, sensors).items():
        # The text grows away from the arrow.
        side = {1: "left", 0: "center", -1: "right"}[round(math.cos(math.radians(sensors[numbers[0] - 1].yaw_deg)))]
        text = sheet.axes.text(x, y, ", ".join(map(str, numbers)), fontsize=8, ha=side, va="center", clip_on=True)
        text.set(zorder=5, path_effects=HALO)


def _assign_label_positions(sheet: Sheet, sensors: Sequence[SensorView]) -> dict[tuple[float, float], list[int]]:
    """Return the positions of numbers; sensors whose numbers would overlap share a position."""
    positions: dict[tuple[float, float], list[int]] = {}
    for number, sensor in enumerate(sensors, start=1):
        position = _find_point_ahead(sheet, sensor, 24.0)
        min_distance_m = 9.0 / 72 * sheet.meters_per_inch  # height of the text
        overlapping = [taken for taken in positions if math.dist(taken, position) < min_distance_m]
        positions.setdefault(overlapping[0] if overlapping else position, []).append(number)
    return positions


def _build_legend_entry(sheet: Sheet, mark: str, sensor: SensorView) -> Artist:
    """Build the entry of one sensor, which says whether it lies outside the map."""
    (left, right), (bottom, top) = sheet.axes.get_xlim(), sheet.axes.get_ylim()
    is_on_map = left <= sensor.x_m <= right and bottom <= sensor.y_m <= top
    label = f"{sensor.name}{'' if is_on_map else ' (outside the map)'}"
    style = (
        DOT if mark == "o" else {"color": "black", "markeredgewidth": 0, "markersize": 3.5 * len(mark.strip("$")) + 2.5}
    )
    return Line2D([], [], linestyle="none", marker=mark, label=label, **style)


def _find_point_ahead(sheet: Sheet, sensor: SensorView, points: float) -> tuple[float, float]:
    """Return the position in meters that lies a number of points (1/72 inch) in front of the sensor."""
    distance_m, yaw_rad = points / 72 * sheet.meters_per_inch, math.radians(sensor.yaw_deg)
    return sensor.x_m + distance_m * math.cos(yaw_rad), sensor.y_m + distance_m * math.sin(yaw_rad)
