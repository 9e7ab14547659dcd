"""A vehicle from five sides with the regions of its skin, and a rig on it from above and from the side."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from torchcover.report.overlay import SensorView, get_sensor_color
from torchcover.report.plot_layout import (
    HEADING_POINTS,
    Bounds,
    fit_paper,
    stack_views,
    write_heading,
    write_legend,
    write_title,
)

Points = NDArray[np.float64]

LIGHT = np.array([0.3, -0.5, 0.81])


class View(NamedTuple):
    """Where one looks from: which directions of the vehicle frame are to the right, upwards, and towards the eye."""

    right: tuple[int, int, int]
    up: tuple[int, int, int]
    toward: tuple[int, int, int]

    def project(self, points_m: Points) -> Points:
        """(..., 2) what (..., 3) points are on the paper."""
        return np.stack([points_m @ np.array(self.right), points_m @ np.array(self.up)], axis=-1)


VIEWS = {
    "above": View((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "left": View((-1, 0, 0), (0, 0, 1), (0, 1, 0)),
    "right": View((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "front": View((0, 1, 0), (0, 0, 1), (1, 0, 0)),
    "rear": View((0, -1, 0), (0, 0, 1), (-1, 0, 0)),
}


def plot_mesh(axes: Axes, vertices_m: Points, faces: NDArray[np.int64], view: View) -> None:
    """Draw (F, 3) triangles between (V, 3) corners, shaded: what is nearer to the eye is drawn later."""
    corners = vertices_m[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    shade = 0.55 + 0.35 * np.clip(normals @ LIGHT, 0.0, 1.0)
    order = np.argsort((corners @ np.array(view.toward)).max(axis=1), kind="stable")
    colours = np.repeat(shade[order, None], 3, axis=1)
    shown = view.project(corners[order])
    axes.add_collection(PolyCollection(list(shown), facecolors=colours, edgecolors=colours, linewidths=0.3, zorder=1))


WIDTH_IN = 7.5
COLOURS = colormaps["turbo"]  # as many as there are regions, and no grey
# Space around the vehicle on the drawing of its skin, as a share of its length.
MARGIN_LENGTHS = 0.06
OPPOSITE = {"left": "right", "right": "left", "front": "rear", "rear": "front"}
HIGHLIGHT: dict[str, Any] = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.75}


class SkinPatch(NamedTuple):
    """A region of the skin.

    Args:
        name: What it is called.
        seen_from: "above", "front", "rear", "left" or "right".
        points_m: (K, L, 3) places on it, in rows and columns.
    """

    name: str
    seen_from: str
    points_m: Points


def plot_vehicle(
    vertices_m: Points, faces: NDArray[np.int64], patches: Sequence[SkinPatch], *, title: str, subtitle: str = ""
) -> Figure:
    """Draw a vehicle from five sides: each region filled where it is seen from, and its outline from beside it.

    Args:
        vertices_m: (V, 3) corners of the vehicle's body in the vehicle frame in metres.
        faces: (F, 3) its triangles.
        patches: The regions.
        title: First line.
        subtitle: Second line, smaller.

    Returns:
        A figure of its own, outside pyplot: from above, from the left, from the right, and from both ends.
    """
    around_m = MARGIN_LENGTHS * float(np.ptp(vertices_m[:, 0]))
    low, high = vertices_m.min(axis=0) - around_m, vertices_m.max(axis=0) + around_m
    half_m = float(max(high[0], -low[0], high[1] - low[1]))  # the front and the rear have half of the paper each
    x, z = (-half_m, half_m), (float(low[2]), float(high[2]))
    views: list[tuple[Bounds, Bounds]] = [(x, (float(low[1]), float(high[1]))), (x, z), (x, z), (x, z)]
    figure, (above, left, right, ends) = stack_views(views, width_in=WIDTH_IN)
    shown = [("above", above, 0.0), ("left", left, 0.0), ("right", right, 0.0)]
    shown += [("front", ends, -half_m / 2), ("rear", ends, half_m / 2)]
    for seen_from, axes, shift_m in shown:
        _draw_side(axes, vertices_m, faces, patches, seen_from, shift_m)
    above.set_ylabel("y left (m)")
    right.set_xlabel("x forward (m)")
    for axes in (left, right):
        axes.set_ylabel("z up (m)")
    for axes in (left, ends):
        axes.set_xticks([])
    write_heading(above, "from above")
    write_heading(left, "from the left")
    write_heading(right, "from the right")
    write_heading(ends, "from the front, and from the rear")
    write_title(above, title, subtitle, lift_points=HEADING_POINTS)
    fit_paper(figure)
    return figure


def _draw_side(
    axes: Axes,
    vertices_m: Points,
    faces: NDArray[np.int64],
    patches: Sequence[SkinPatch],
    seen_from: str,
    shift_m: float,
) -> None:
    view = VIEWS[seen_from]
    aside = shift_m * np.array(view.right)
    plot_mesh(axes, vertices_m + aside, faces, view)
    for at, patch in enumerate(patches):
        if patch.seen_from == OPPOSITE.get(seen_from):
            continue
        colour, flat = COLOURS((at + 0.5) / len(patches)), view.project(patch.points_m + aside)
        outline = np.concatenate([flat[:, 0], flat[-1], flat[::-1, -1], flat[0, ::-1]])
        axes.plot(*outline.T, color=colour, linewidth=0.7, zorder=2)
        if patch.seen_from == seen_from:
            corners = [flat[:-1, :-1], flat[1:, :-1], flat[1:, 1:], flat[:-1, 1:]]
            pieces = np.stack(corners, axis=2).reshape(-1, 4, 2)
            axes.add_collection(PolyCollection(list(pieces), facecolors=colour, alpha=0.6, linewidths=0, zorder=3))
            words: dict[str, Any] = {"fontsize": 6.5, "ha": "center", "va": "center", "bbox": HIGHLIGHT, "zorder": 4}
            x, y = outline.mean(axis=0).tolist()
            axes.text(x, y, patch.name, **words)


# Around the vehicle, in its lengths, but no less than this.
AROUND_LENGTHS, AROUND_M, ABOVE_M = 0.75, 2.0, 1.5
# Numbers stand at different distances along their directions, so that one does not hide another: shares of what the
# drawing shows around the vehicle.
FIRST_NUMBER, NUMBER_STEP, NUMBER_PLACES = 0.4, 0.07, 8
NUMBER_SHARE = 0.09
HIGHEST_RANGES_IN = 4.5
# What a range without limit is drawn with.
UNLIMITED_M = 300.0
GROUND_M = -0.4


def plot_rig(
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
        A figure of its own, outside pyplot: horizontal fields of view from above, which go on beyond the paper; from
        the side, sections through each sensor along the vehicle, down to the ground; and how far they reach.
    """
    x, y, top_m, around_m = _around(vertices_m, sensors)
    beyond_m = float(np.hypot(x[1] - x[0], y[1] - y[0]))
    ranges_m = [min(sensor.range_m, UNLIMITED_M) for sensor in sensors]
    wide = [sensor.compute_outline_m(range_m) for sensor, range_m in zip(sensors, ranges_m, strict=True)]
    views = [(x, y), (x, (GROUND_M, top_m)), _bounds_of_ranges([vertices_m[:, :2], *wide])]
    figure, (above, side, ranges) = stack_views(views, width_in=WIDTH_IN)
    for axes, seen_from in ((above, "above"), (side, "right"), (ranges, "above")):
        plot_mesh(axes, vertices_m, faces, VIEWS[seen_from])
    side.axhspan(GROUND_M, 0.0, facecolor="#d8d4cc", edgecolor="black", linewidth=0.8)
    for at, sensor in enumerate(sensors):
        near_m, place = min(ranges_m[at], beyond_m), sensor.position_m
        number_m = around_m * (FIRST_NUMBER + NUMBER_STEP * (at % NUMBER_PLACES))
        _draw_sensor(
            above, at, place[:2], [sensor.compute_outline_m(near_m)], [_along(sensor.compute_outline_m(number_m))]
        )
        fans, ends = _fans(sensor, near_m), [_along(fan) for fan in _fans(sensor, number_m)]
        _draw_sensor(side, at, place[[0, 2]], fans, ends)
        inwards = 1.0 - NUMBER_SHARE * (at % NUMBER_PLACES)
        _draw_sensor(ranges, at, place[:2], [wide[at]], [_along(sensor.compute_outline_m(inwards * ranges_m[at]))])
    for axes in (above, ranges):
        axes.set_ylabel("y left (m)")
    above.tick_params(labelbottom=False)
    side.set(ylabel="z up (m)")
    ranges.set(xlabel="x forward (m)")
    write_heading(above, "from above: horizontal fields of view, which go on beyond the paper")
    write_heading(side, "from the side: sections through each sensor along the vehicle, down to the ground")
    write_heading(ranges, "from above: how far they reach")
    write_title(above, title, subtitle, lift_points=HEADING_POINTS)
    write_legend(ranges, [_entry(at, sensor) for at, sensor in enumerate(sensors)], columns=2)
    fit_paper(figure)
    return figure


def _around(vertices_m: Points, sensors: Sequence[SensorView]) -> tuple[Bounds, Bounds, float, float]:
    """Bounds x and y around the vehicle and its sensors, the top in z, and how far around it is."""
    every = np.vstack([vertices_m, *(sensor.position_m[None] for sensor in sensors)])
    low, high = every.min(axis=0).tolist(), every.max(axis=0).tolist()
    around_m = max(AROUND_M, AROUND_LENGTHS * (high[0] - low[0]))
    x, y = ((low[axis] - around_m, high[axis] + around_m) for axis in (0, 1))
    return x, y, high[2] + ABOVE_M, around_m


def _bounds_of_ranges(polygons: Sequence[Points]) -> tuple[Bounds, Bounds]:
    """Bounds of all of them, wide enough that the view is not too high."""
    every = np.concatenate(polygons)
    margin_m = 0.05 * float(np.ptp(every, axis=0).max())
    (left, low), (right, high) = every.min(axis=0) - margin_m, every.max(axis=0) + margin_m
    missing_m = max(0.0, WIDTH_IN / HIGHEST_RANGES_IN * float(high - low) - float(right - left))
    return (float(left) - missing_m / 2, float(right) + missing_m / 2), (float(low), float(high))


def _along(outline: Points) -> Points:
    """The middle of an arc, where its number stands."""
    return np.asarray(outline[len(outline) // 2])


def _fans(sensor: SensorView, reach_m: float) -> list[Points]:
    """(K, 2) outlines x, z of the parts of the field of view in the vertical plane along the vehicle; maybe none."""
    angles = np.deg2rad(np.arange(-180.0, 180.0, 0.25))
    ray_x, ray_z = np.cos(angles), np.sin(angles)
    seen = sensor.mask_directions(np.stack([ray_x, np.zeros_like(angles), ray_z], axis=1))
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


def _draw_sensor(axes: Axes, at: int, place: Points, views: Sequence[Points], numbers: Sequence[Points]) -> None:
    colour = get_sensor_color(at)
    for outline in views:
        axes.add_patch(Polygon(outline, facecolor=colour, edgecolor="none", alpha=0.1, zorder=2))
        axes.add_patch(Polygon(outline, fill=False, edgecolor=colour, linewidth=1.0, zorder=3))
    axes.plot(*place, marker="o", markersize=4, markerfacecolor=colour, markeredgecolor="white", zorder=5)
    for end in numbers or [place]:
        disc = {"boxstyle": "circle,pad=0.2", "facecolor": colour, "edgecolor": "white"}
        words: dict[str, Any] = {"color": "white", "fontsize": 6.5, "ha": "center", "va": "center", "clip_on": True}
        axes.text(end[0], end[1], str(at + 1), bbox=disc, zorder=6, **words)


def _entry(at: int, sensor: SensorView) -> Artist:
    low, high = sensor.vertical_fov_deg
    reach = f"to {sensor.range_m:g} m" if np.isfinite(sensor.range_m) else "without a limit"
    words = f"{sensor.horizontal_fov_deg:.1f}° wide, {low:.1f}° to {high:.1f}° high, {reach}"
    return Line2D(
        [], [], linestyle="none", marker="o", color=get_sensor_color(at), label=f"{at + 1}  {sensor.name}: {words}"
    )
