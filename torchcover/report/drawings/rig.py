"""A rig on its vehicle, from above and from the side, with the fields of view of its sensors."""

from collections.abc import Sequence
from itertools import chain

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from torchcover.report.maps.overlay import COLOURS, SensorView
from torchcover.report.maps.sheet import (
    HEADING_POINTS,
    fit_paper,
    stack_views,
    write_heading,
    write_legend,
    write_title,
)

Points = NDArray[np.float64]

WIDTH_IN = 7.5
MARGIN_M = 0.6
# Fields of view are drawn to different distances, so that one does not hide another.
FIRST_REACH_M, REACH_STEP_M = 4.0, 0.6
ARC_POINTS = 241
GROUND_M = -0.4
LIGHT = np.array([0.3, -0.5, 0.81])


def draw_rig(
    vertices_m: Points, faces: NDArray[np.int64], sensors: Sequence[SensorView], *, title: str, subtitle: str = ""
) -> Figure:
    """Draw a rig on its vehicle.

    Args:
        vertices_m: (V, 3) corners of the vehicle's body in the vehicle frame in metres.
        faces: (F, 3) its triangles.
        sensors: What to draw.
        title: First line.
        subtitle: Second line, smaller.

    Returns:
        A figure of its own, outside pyplot: horizontal fields of view from above; from the side, sections through
        each sensor along the vehicle, down to the ground.
    """
    reaches_m = [FIRST_REACH_M + REACH_STEP_M * at for at in range(len(sensors))]
    sectors = [[_sector(sensor, reach_m)] for sensor, reach_m in zip(sensors, reaches_m, strict=True)]
    fans = [_fans(sensor, reach_m) for sensor, reach_m in zip(sensors, reaches_m, strict=True)]
    from_above, from_side = [vertices_m[:, :2], *chain(*sectors)], [vertices_m[:, [0, 2]], *chain(*fans)]
    x, y, top_m = _bounds(from_above + from_side, 0), _bounds(from_above, 1), _bounds(from_side, 1)[1]
    figure, (above, side) = stack_views(x, [y, (GROUND_M, top_m)], width_in=WIDTH_IN)
    _draw_body(above, vertices_m, faces, axis=2)
    _draw_body(side, vertices_m, faces, axis=1)
    side.axhspan(GROUND_M, 0.0, facecolor="#d8d4cc", edgecolor="black", linewidth=0.8)
    for at, sensor in enumerate(sensors):
        _draw_sensor(above, at, sensor.position_m[:2], sectors[at])
        _draw_sensor(side, at, sensor.position_m[[0, 2]], fans[at])
    above.set_ylabel("y left (m)")
    above.tick_params(labelbottom=False)
    side.set(xlabel="x forward (m)", ylabel="z up (m)")
    write_heading(above, "from above: horizontal fields of view")
    write_heading(side, "from the side: sections through each sensor along the vehicle, down to the ground")
    write_title(above, title, subtitle, lift_points=HEADING_POINTS)
    write_legend(side, [_entry(at, sensor) for at, sensor in enumerate(sensors)], columns=2)
    fit_paper(figure)
    return figure


def _sector(sensor: SensorView, reach_m: float) -> Points:
    """(K, 2) outline of the horizontal field of view: its arc last to first, and its corner if it has one."""
    half = sensor.horizontal_fov_deg / 2
    angles = np.deg2rad(np.linspace(sensor.yaw_deg - half, sensor.yaw_deg + half, ARC_POINTS))
    length_m = min(reach_m, sensor.range_m)
    arc = sensor.position_m[:2] + length_m * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return arc if sensor.horizontal_fov_deg == 360 else np.vstack([arc, sensor.position_m[:2]])


def _fans(sensor: SensorView, reach_m: float) -> list[Points]:
    """(K, 2) outlines x, z of the parts of the field of view in the vertical plane along the vehicle; maybe none."""
    angles = np.deg2rad(np.arange(-180.0, 180.0, 0.25))
    ray_x, ray_z = np.cos(angles), np.sin(angles)
    seen = sensor.sees(np.stack([ray_x, np.zeros_like(angles), ray_z], axis=1))
    place = sensor.position_m[[0, 2]]
    to_ground_m = np.where(ray_z < 0, place[1] / np.maximum(-ray_z, 1e-9), np.inf)
    length_m = np.minimum(np.maximum(to_ground_m, 0.0), min(reach_m, sensor.range_m))
    ends = place + length_m[:, None] * np.stack([ray_x, ray_z], axis=1)
    return [np.vstack([ends[run], place]) for run in _runs(seen)]


def _runs(seen: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """Indices of neighbours around a circle that are all true."""
    # The order begins with one that is not, so that no run begins before and ends after it.
    order = np.roll(np.arange(len(seen)), -int(np.argmin(seen)))
    pieces = np.split(order, np.flatnonzero(np.diff(seen[order])) + 1)
    return [piece for piece in pieces if seen[piece[0]]]


def _bounds(polygons: Sequence[Points], axis: int) -> tuple[float, float]:
    values = np.concatenate([polygon[:, axis] for polygon in polygons])
    return float(values.min()) - MARGIN_M, float(values.max()) + MARGIN_M


def _draw_body(axes: Axes, vertices_m: Points, faces: NDArray[np.int64], axis: int) -> None:
    """Draw a body, shaded, seen along an axis: 2 is from above, 1 from the right."""
    corners = vertices_m[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    shade = 0.55 + 0.35 * np.clip(normals @ LIGHT, 0.0, 1.0)
    nearness = corners[:, :, axis].max(axis=1) * (1 if axis == 2 else -1)
    order = np.argsort(nearness)
    colours = np.repeat(shade[order, None], 3, axis=1)
    shown = corners[order][:, :, [0, 1 if axis == 2 else 2]]
    axes.add_collection(PolyCollection(list(shown), facecolors=colours, edgecolors=colours, linewidths=0.3, zorder=1))


def _draw_sensor(axes: Axes, at: int, place: Points, views: Sequence[Points]) -> None:
    colour = COLOURS[at % len(COLOURS)]
    for outline in views:
        axes.add_patch(Polygon(outline, facecolor=colour, edgecolor="none", alpha=0.13, zorder=2))
        axes.add_patch(Polygon(outline, fill=False, edgecolor=colour, linewidth=1.0, zorder=3))
    axes.plot(*place, marker="o", markersize=5, markerfacecolor=colour, markeredgecolor="white", zorder=5)
    for end in [outline[len(outline) // 2] for outline in views] or [place]:
        disc = {"boxstyle": "circle,pad=0.25", "facecolor": colour, "edgecolor": "white"}
        axes.text(end[0], end[1], str(at + 1), color="white", fontsize=7, ha="center", va="center", bbox=disc, zorder=6)


def _entry(at: int, sensor: SensorView) -> Artist:
    low, high = sensor.vertical_fov_deg
    words = f"{sensor.horizontal_fov_deg:.1f}° wide, {low:.1f}° to {high:.1f}° high, to {sensor.range_m:g} m"
    return Line2D(
        [],
        [],
        linestyle="none",
        marker="o",
        color=COLOURS[at % len(COLOURS)],
        label=f"{at + 1}  {sensor.name}: {words}",
    )
