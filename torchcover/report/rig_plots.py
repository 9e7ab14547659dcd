"""Plots of a vehicle with its mount regions from five sides, and of a rig on its vehicle from above and the side."""

from collections.abc import Sequence
from dataclasses import dataclass
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
from torchcover.report.plot_layout import Bounds, fit_paper, stack_views, write_heading, write_legend, write_title

Points = NDArray[np.float64]


class Projection(NamedTuple):
    """Orthographic projection of the vehicle frame to paper.

    Args:
        right: Direction of the vehicle frame that points to the right on paper.
        up: Direction that points upwards on paper.
        toward: Direction that points toward the viewer.
    """

    right: tuple[int, int, int]
    up: tuple[int, int, int]
    toward: tuple[int, int, int]

    def project(self, points_m: Points) -> Points:
        """Project points.

        Args:
            points_m: (..., 3) points in the vehicle frame.

        Returns:
            (..., 2) points on paper in meters.
        """
        return np.stack([points_m @ np.array(self.right), points_m @ np.array(self.up)], axis=-1)


PROJECTIONS = {
    "above": Projection((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "left": Projection((-1, 0, 0), (0, 0, 1), (0, 1, 0)),
    "right": Projection((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "front": Projection((0, 1, 0), (0, 0, 1), (1, 0, 0)),
    "rear": Projection((0, -1, 0), (0, 0, 1), (-1, 0, 0)),
}


@dataclass(frozen=True)
class RigPlotParams:
    """Parameters of plots of a vehicle and its rig.

    Args:
        width_in: Width of the plots in inches.
        margin_lengths: Margin around the vehicle on the plot of its mount regions, in vehicle lengths.
        surroundings_lengths: Surroundings of the vehicle on the plot of a rig, in vehicle lengths.
        min_surroundings_m: Minimum of these surroundings.
        headroom_m: Space above the highest sensor.
        ground_depth_m: Height of the strip of ground below z = 0.
        max_ranges_height_in: Maximum height of the view of ranges in inches.
        unlimited_range_m: Plotted range of a sensor without a limit.
        num_label_positions: Number of positions of sensor numbers along their directions, so that numbers of adjacent
            sensors do not overlap.
        first_label_share: First position, as a share of the surroundings.
        label_step_share: Distance between positions, as a share of the surroundings.
        range_label_step_share: Distance between positions on the view of ranges, as a share of the range.
    """

    width_in: float = 7.5
    margin_lengths: float = 0.06
    surroundings_lengths: float = 0.75
    min_surroundings_m: float = 2.0
    headroom_m: float = 1.5
    ground_depth_m: float = 0.4
    max_ranges_height_in: float = 4.5
    unlimited_range_m: float = 300.0
    num_label_positions: int = 8
    first_label_share: float = 0.4
    label_step_share: float = 0.07
    range_label_step_share: float = 0.09


class SkinPatch(NamedTuple):
    """Mount region on the surface of a vehicle.

    Args:
        name: Name of the region.
        side: "above", "front", "rear", "left" or "right".
        points_m: (K, L, 3) points on the surface in rows and columns.
    """

    name: str
    side: str
    points_m: Points


def plot_mesh(axes: Axes, vertices_m: Points, faces: NDArray[np.int64], projection: Projection) -> None:
    """Plot a shaded mesh; triangles that are closer to the viewer cover others.

    Args:
        axes: Axes in meters.
        vertices_m: (V, 3) vertices.
        faces: (F, 3) vertex indices of triangles.
        projection: Projection to the axes.
    """
    corners = vertices_m[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    light = np.array([0.3, -0.5, 0.81])  # from above, slightly from ahead and from the right
    shade = 0.55 + 0.35 * np.clip(normals @ light, 0.0, 1.0)
    order = np.argsort((corners @ np.array(projection.toward)).max(axis=1), kind="stable")
    colors = np.repeat(shade[order, None], 3, axis=1)
    triangles = list(projection.project(corners[order]))
    axes.add_collection(PolyCollection(triangles, facecolors=colors, edgecolors=colors, linewidths=0.3, zorder=1))


def plot_vehicle(
    vertices_m: Points,
    faces: NDArray[np.int64],
    patches: Sequence[SkinPatch],
    *,
    title: str,
    subtitle: str = "",
    params: RigPlotParams = RigPlotParams(),
) -> Figure:
    """Plot a vehicle from five sides with its mount regions: filled on their side, outlined on adjacent sides.

    Args:
        vertices_m: (V, 3) vertices of the vehicle in the vehicle frame, in meters.
        faces: (F, 3) vertex indices of triangles.
        patches: Mount regions.
        title: First line.
        subtitle: Second line, smaller.
        params: Sizes.

    Returns:
        A new figure outside pyplot with views from above, from the left, from the right, and from both ends.
    """
    margin_m = params.margin_lengths * float(np.ptp(vertices_m[:, 0]))
    low, high = vertices_m.min(axis=0) - margin_m, vertices_m.max(axis=0) + margin_m
    half_m = float(max(high[0], -low[0], high[1] - low[1]))  # front and rear share a view, each with half of its width
    x, z = (-half_m, half_m), (float(low[2]), float(high[2]))
    views: list[tuple[Bounds, Bounds]] = [(x, (float(low[1]), float(high[1]))), (x, z), (x, z), (x, z)]
    figure, (above, left, right, ends) = stack_views(views, width_in=params.width_in)
    _plot_side(above, vertices_m, faces, patches, "above")
    _plot_side(left, vertices_m, faces, patches, "left")
    _plot_side(right, vertices_m, faces, patches, "right")
    _plot_side(ends, vertices_m, faces, patches, "front", shift_m=-half_m / 2)
    _plot_side(ends, vertices_m, faces, patches, "rear", shift_m=half_m / 2)
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
    write_title(above, title, subtitle, has_heading=True)
    fit_paper(figure)
    return figure


def _plot_side(
    axes: Axes,
    vertices_m: Points,
    faces: NDArray[np.int64],
    patches: Sequence[SkinPatch],
    side: str,
    shift_m: float = 0.0,
) -> None:
    """Plot the vehicle and its mount regions from one side, shifted to the right on paper."""
    projection = PROJECTIONS[side]
    offset_m = shift_m * np.array(projection.right)
    plot_mesh(axes, vertices_m + offset_m, faces, projection)
    opposite_side = {"left": "right", "right": "left", "front": "rear", "rear": "front"}.get(side)
    label_box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.75}
    for index, patch in enumerate(patches):
        if patch.side == opposite_side:
            continue
        color = colormaps["turbo"]((index + 0.5) / len(patches))  # distinct colors for any number of regions, no gray
        flat = projection.project(patch.points_m + offset_m)
        outline = np.concatenate([flat[:, 0], flat[-1], flat[::-1, -1], flat[0, ::-1]])
        axes.plot(*outline.T, color=color, linewidth=0.7, zorder=2)
        if patch.side == side:
            corners = [flat[:-1, :-1], flat[1:, :-1], flat[1:, 1:], flat[:-1, 1:]]
            pieces = np.stack(corners, axis=2).reshape(-1, 4, 2)
            axes.add_collection(PolyCollection(list(pieces), facecolors=color, alpha=0.6, linewidths=0, zorder=3))
            style: dict[str, Any] = {"fontsize": 6.5, "ha": "center", "va": "center", "bbox": label_box, "zorder": 4}
            x, y = outline.mean(axis=0).tolist()
            axes.text(x, y, patch.name, **style)


def plot_rig(
    vertices_m: Points,
    faces: NDArray[np.int64],
    sensors: Sequence[SensorView],
    *,
    title: str,
    subtitle: str = "",
    params: RigPlotParams = RigPlotParams(),
) -> Figure:
    """Plot a rig on its vehicle.

    Args:
        vertices_m: (V, 3) vertices of the vehicle in the vehicle frame, in meters.
        faces: (F, 3) vertex indices of triangles.
        sensors: Sensors of the rig.
        title: First line.
        subtitle: Second line, smaller.
        params: Sizes.

    Returns:
        A new figure outside pyplot: horizontal fields of view from above, which continue beyond the paper; vertical
        sections through each sensor along the vehicle, down to the ground; and ranges from above.
    """
    x, y, top_m, surroundings_m = _compute_bounds(vertices_m, sensors, params)
    diagonal_m = float(np.hypot(x[1] - x[0], y[1] - y[0]))
    ranges_m = [min(sensor.range_m, params.unlimited_range_m) for sensor in sensors]
    outlines = [sensor.compute_outline_m(range_m) for sensor, range_m in zip(sensors, ranges_m, strict=True)]
    range_bounds = _compute_range_bounds([vertices_m[:, :2], *outlines], params)
    views = [(x, y), (x, (-params.ground_depth_m, top_m)), range_bounds]
    figure, (above, side, ranges) = stack_views(views, width_in=params.width_in)
    plot_mesh(above, vertices_m, faces, PROJECTIONS["above"])
    plot_mesh(side, vertices_m, faces, PROJECTIONS["right"])
    plot_mesh(ranges, vertices_m, faces, PROJECTIONS["above"])
    side.axhspan(-params.ground_depth_m, 0.0, facecolor="#d8d4cc", edgecolor="black", linewidth=0.8)
    for index, sensor in enumerate(sensors):
        near_m, position_m = min(ranges_m[index], diagonal_m), sensor.position_m
        label_index = index % params.num_label_positions
        label_m = surroundings_m * (params.first_label_share + params.label_step_share * label_index)
        label_points = [_get_middle(sensor.compute_outline_m(label_m))]
        _plot_sensor(above, index, position_m[:2], [sensor.compute_outline_m(near_m)], label_points)
        label_points = [_get_middle(section) for section in _compute_sections(sensor, label_m)]
        _plot_sensor(side, index, position_m[[0, 2]], _compute_sections(sensor, near_m), label_points)
        range_share = 1.0 - params.range_label_step_share * label_index
        label_points = [_get_middle(sensor.compute_outline_m(range_share * ranges_m[index]))]
        _plot_sensor(ranges, index, position_m[:2], [outlines[index]], label_points)
    for axes in (above, ranges):
        axes.set_ylabel("y left (m)")
    above.tick_params(labelbottom=False)
    side.set(ylabel="z up (m)")
    ranges.set(xlabel="x forward (m)")
    write_heading(above, "from above: horizontal fields of view, which continue beyond the paper")
    write_heading(side, "from the side: sections through each sensor along the vehicle, down to the ground")
    write_heading(ranges, "from above: ranges")
    write_title(above, title, subtitle, has_heading=True)
    write_legend(ranges, [_build_legend_entry(index, sensor) for index, sensor in enumerate(sensors)], columns=2)
    fit_paper(figure)
    return figure


def _compute_bounds(
    vertices_m: Points, sensors: Sequence[SensorView], params: RigPlotParams
) -> tuple[Bounds, Bounds, float, float]:
    """Compute bounds x and y, the upper bound of z, and the size of the surroundings."""
    points_m = np.vstack([vertices_m, *(sensor.position_m[None] for sensor in sensors)])
    low, high = points_m.min(axis=0).tolist(), points_m.max(axis=0).tolist()
    surroundings_m = max(params.min_surroundings_m, params.surroundings_lengths * (high[0] - low[0]))
    x, y = ((low[axis] - surroundings_m, high[axis] + surroundings_m) for axis in (0, 1))
    return x, y, high[2] + params.headroom_m, surroundings_m


def _compute_range_bounds(polygons: Sequence[Points], params: RigPlotParams) -> tuple[Bounds, Bounds]:
    """Compute bounds of all polygons, wide enough that the view does not exceed its maximum height."""
    points_m = np.concatenate(polygons)
    margin_m = 0.05 * float(np.ptp(points_m, axis=0).max())
    (left, low), (right, high) = points_m.min(axis=0) - margin_m, points_m.max(axis=0) + margin_m
    missing_m = max(0.0, params.width_in / params.max_ranges_height_in * float(high - low) - float(right - left))
    return (float(left) - missing_m / 2, float(right) + missing_m / 2), (float(low), float(high))


def _get_middle(outline: Points) -> Points:
    """Return the middle of an arc, where the number of the sensor is."""
    return np.asarray(outline[len(outline) // 2])


def _compute_sections(sensor: SensorView, max_range_m: float) -> list[Points]:
    """Compute outlines (K, 2) x, z of the field of view in the vertical plane along the vehicle; maybe none."""
    angles = np.deg2rad(np.arange(-180.0, 180.0, 0.25))
    ray_x, ray_z = np.cos(angles), np.sin(angles)
    is_in_fov = sensor.mask_directions(np.stack([ray_x, np.zeros_like(angles), ray_z], axis=1))
    position_m = sensor.position_m[[0, 2]]
    to_ground_m = np.where(ray_z < 0, position_m[1] / np.maximum(-ray_z, 1e-9), np.inf)
    length_m = np.minimum(np.maximum(to_ground_m, 0.0), min(max_range_m, sensor.range_m))
    ends_m = position_m + length_m[:, None] * np.stack([ray_x, ray_z], axis=1)
    # The circle is cut at a direction outside the field of view, so that no section crosses the cut.
    order = np.roll(np.arange(len(is_in_fov)), -int(np.argmin(is_in_fov)))
    sections = []
    for run in np.split(order, np.flatnonzero(np.diff(is_in_fov[order])) + 1):
        if is_in_fov[run[0]]:
            sections.append(np.vstack([ends_m[run], position_m]))
    return sections


def _plot_sensor(
    axes: Axes, index: int, position_m: Points, outlines: Sequence[Points], label_points: Sequence[Points]
) -> None:
    """Plot a sensor, its field of view, and its number at some points, or at the sensor if there are none."""
    color = get_sensor_color(index)
    for outline in outlines:
        axes.add_patch(Polygon(outline, facecolor=color, edgecolor="none", alpha=0.1, zorder=2))
        axes.add_patch(Polygon(outline, fill=False, edgecolor=color, linewidth=1.0, zorder=3))
    axes.plot(*position_m, marker="o", markersize=4, markerfacecolor=color, markeredgecolor="white", zorder=5)
    disc = {"boxstyle": "circle,pad=0.2", "facecolor": color, "edgecolor": "white"}
    style: dict[str, Any] = {"color": "white", "fontsize": 6.5, "ha": "center", "va": "center", "clip_on": True}
    for point in label_points or [position_m]:
        axes.text(point[0], point[1], str(index + 1), bbox=disc, zorder=6, **style)


def _build_legend_entry(index: int, sensor: SensorView) -> Artist:
    """Build the legend entry of a sensor with its field of view and range."""
    low, high = sensor.vertical_fov_deg
    max_range = f"to {sensor.range_m:g} m" if np.isfinite(sensor.range_m) else "without a limit"
    field_of_view = f"{sensor.horizontal_fov_deg:.1f}° wide, {low:.1f}° to {high:.1f}° high"
    label = f"{index + 1}  {sensor.name}: {field_of_view}, {max_range}"
    return Line2D([], [], linestyle="none", marker="o", color=get_sensor_color(index), label=label)
