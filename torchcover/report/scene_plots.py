"""Plots of a frame: in bird's-eye view, and as depth images."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from matplotlib.ticker import LogLocator, NullFormatter
from numpy.typing import NDArray

from torchcover.report.colors import UNOBSERVED_STYLE, ColorScale, plot_cells
from torchcover.report.number_format import format_percent
from torchcover.report.overlay import plot_ego
from torchcover.report.plot_layout import (
    LAYOUT,
    Bounds,
    find_lower_left,
    fit_paper,
    stack_views,
    write_heading,
    write_legend,
    write_title,
)

Points = NDArray[np.floating]
Image = NDArray[np.floating]


@dataclass(frozen=True)
class ScenePlotParams:
    """Colors and sizes of plots of a frame.

    Args:
        width_in: Width of the bird's-eye view in inches.
        sensor_color: Color of sensor points.
        reference_color: Color of reference points.
        path_color: Color of the path of the ego vehicle.
        sky_color: Color of pixels of a depth image whose rays hit nothing within range.
        category_colors: Color of each category of actors; other categories share `other_colors`.
        other_colors: Colors of other categories, in alphabetical order.
        min_static_height_m: Lower faces are not plotted: curbs are plotted, roads are not.
        low_gray: Brightness of low static faces.
        high_gray: Brightness of high static faces.
        gray_height_m: Height at which the brightness has changed by 63 % from low to high.
        image_height_in: Height of a depth image in inches.
        max_row_in: Maximum width of a row of depth images in inches.
        depth_percentiles: Percentiles of depths at the ends of the colors: the bumper and walls at the horizon must not
            dominate them.
        default_depths_m: Ends of the colors if there is no depth.
    """

    width_in: float = 13.0
    sensor_color: str = "#3b6ea5"
    reference_color: str = "#e0b878"
    path_color: str = "#111111"
    sky_color: str = "#dfe9f2"
    category_colors: tuple[tuple[str, str], ...] = (
        ("car", "#d55e00"),
        ("truck", "#7a3fa0"),
        ("bus", "#e6b400"),
        ("cyclist", "#009e73"),
        ("motorcycle", "#8b5a2b"),
        ("pedestrian", "#d62598"),
    )
    other_colors: tuple[str, ...] = ("#a3122f", "#555555", "#000000")
    min_static_height_m: float = 0.08
    low_gray: float = 0.92
    high_gray: float = 0.55
    gray_height_m: float = 3.0
    image_height_in: float = 2.4
    max_row_in: float = 13.5
    depth_percentiles: tuple[float, float] = (0.5, 99.5)
    default_depths_m: tuple[float, float] = (1.0, 100.0)


PARAMS = ScenePlotParams()


@dataclass(frozen=True, eq=False)
class ActorMark:
    """Actor in a plot of a frame.

    Args:
        category: Category, which has one color.
        outline_m: (K, 2) corners x, y in the vehicle frame, in meters.
    """

    category: str
    outline_m: Points


@dataclass(frozen=True, eq=False)
class StaticFaces:
    """Static part of a scene in a plot of a frame.

    Args:
        triangles_m: (F, 3, 2) corners x, y of faces in the vehicle frame, in meters.
        height_m: (F,) height of the highest corner above the ground under the vehicle.
    """

    triangles_m: Points
    height_m: Points


def plot_scene(
    x: Bounds,
    y: Bounds,
    *,
    static_faces: StaticFaces,
    ego_outline_m: Points,
    actors: Sequence[ActorMark],
    sensor_points: Points,
    reference_points: Points | None = None,
    title: str,
    subtitle: str = "",
    path_m: Points | None = None,
) -> Figure:
    """Plot a frame in bird's-eye view.

    Args:
        x: Bounds forward in meters.
        y: Bounds to the left in meters.
        static_faces: Static part of the scene.
        ego_outline_m: (K, 2) corners of the ego vehicle in the vehicle frame, in meters.
        actors: Actors; those beyond the bounds are not plotted.
        sensor_points: (N, 3) points of the rig.
        reference_points: (M, 3) reference points; None without a reference.
        title: First line.
        subtitle: Second line, smaller.
        path_m: (T, 2) path of the ego vehicle in the vehicle frame, in meters; None if it does not move.

    Returns:
        A new figure outside pyplot.
    """
    figure, (axes,) = stack_views([(x, y)], width_in=PARAMS.width_in)
    axes.set(xlabel="x forward (m)", ylabel="y left (m)")
    entries = _plot_static_faces(axes, static_faces)
    if reference_points is not None:
        entries.append(_plot_points(axes, reference_points, PARAMS.reference_color, "reference points"))
    entries.append(_plot_points(axes, sensor_points, PARAMS.sensor_color, "points of the rig"))
    entries += _plot_actors(axes, [actor for actor in actors if _is_inside(actor.outline_m, x, y)])
    if path_m is not None:
        label = "path of the ego vehicle"
        entries += axes.plot(path_m[:, 0], path_m[:, 1], color=PARAMS.path_color, linewidth=1.2, label=label, zorder=3)
    entries += plot_ego(axes, ego_outline_m)
    write_title(axes, title, subtitle)
    write_legend(axes, entries, columns=4)
    fit_paper(figure)
    return figure


def _plot_static_faces(axes: Axes, static_faces: StaticFaces) -> list[Artist]:
    """Plot faces above the ground, the highest last."""
    is_above_ground = static_faces.height_m > PARAMS.min_static_height_m
    height_m = static_faces.height_m[is_above_ground]
    order = np.argsort(height_m)
    contrast = PARAMS.low_gray - PARAMS.high_gray
    gray = PARAMS.high_gray + contrast * np.exp(-height_m[order] / PARAMS.gray_height_m)
    colors = np.repeat(gray[:, None], 3, axis=1)
    triangles = list(static_faces.triangles_m[is_above_ground][order])
    axes.add_collection(PolyCollection(triangles, facecolors=colors, edgecolors=colors, linewidths=0.4, zorder=0.5))
    if not triangles:
        return []
    medium_gray = str((PARAMS.low_gray + PARAMS.high_gray) / 2)
    return [Patch(facecolor=medium_gray, edgecolor="none", label="static objects, higher ones darker")]


def _plot_points(axes: Axes, points: Points, color: str, label: str) -> Artist:
    """Plot a point cloud and return its legend entry with the number of points."""
    # Each point is one pixel, for any number of points.
    axes.plot(points[:, 0], points[:, 1], linestyle="none", marker=",", color=color, zorder=1)
    return Line2D([], [], linestyle="none", marker=".", color=color, label=f"{label} ({len(points):,})")


def _plot_actors(axes: Axes, actors: Sequence[ActorMark]) -> list[Artist]:
    """Plot outlines of actors in the color of their category; the legend counts each category."""
    counts = Counter(actor.category for actor in actors)
    colors = dict(PARAMS.category_colors)
    palette = (*colors.values(), *PARAMS.other_colors)
    for category in sorted(set(counts) - set(colors)):
        colors[category] = palette[len(colors) % len(palette)]
    for actor in actors:
        color = colors[actor.category]
        axes.add_patch(Polygon(actor.outline_m, facecolor=(color, 0.45), edgecolor=color, linewidth=0.9, zorder=2))
    entries: list[Artist] = []
    for category, color in colors.items():
        if category in counts:
            label = f"{category} ({counts[category]})"
            entries.append(Patch(facecolor=(color, 0.45), edgecolor=color, label=label))
    return entries


def _is_inside(outline_m: Points, x: Bounds, y: Bounds) -> bool:
    """Test whether the bounding box of an outline overlaps the bounds."""
    low, high = outline_m.min(axis=0), outline_m.max(axis=0)
    return bool(high[0] >= x[0] and low[0] <= x[1] and high[1] >= y[0] and low[1] <= y[1])


def plot_depth_images(images: Mapping[str, Image], *, title: str, subtitle: str = "") -> Figure:
    """Plot depth images with logarithmic colors.

    Args:
        images: Name of the camera -> (rows, columns) distances along the ray in meters; infinite where a ray hits
            nothing within range, NaN where a pixel has no ray. Sizes may differ.
        title: First line.
        subtitle: Second line, smaller.

    Returns:
        A new figure outside pyplot.

    Raises:
        ValueError: No image, or an image without two dimensions or without pixels.

    Example:
        >>> figure = plot_depth_images({"front": np.array([[2.0, np.inf], [1.0, np.nan]])}, title="My rig")
        >>> [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
        ['nothing within range (25.0 % of the pixels)', 'no ray: beyond the lens (25.0 % of the pixels)']
    """
    arrays = {name: _check_image(name, image) for name, image in images.items()}
    if not arrays:
        raise ValueError("images: got none; give at least one")
    depths_m = np.concatenate([array.ravel() for array in arrays.values()])
    scale = _build_depth_scale(depths_m)
    figure = _create_image_axes(list(arrays.values()))
    *views, color_bar_axes = figure.axes
    for axes, (name, array) in zip(views, arrays.items(), strict=True):
        # The first row of an image is its top; the first row of cells is at the bottom.
        image = plot_cells(axes, array[::-1], scale, infinite_color=PARAMS.sky_color)
        write_heading(axes, name)
    color_bar = figure.colorbar(
        image, cax=color_bar_axes, extend="both", label=scale.label, ticks=LogLocator(subs=(1, 2, 5)), format="{x:g}"
    )
    color_bar.minorformatter = NullFormatter()
    write_title(views[0], title, subtitle, has_heading=True)
    write_legend(find_lower_left(views), _build_depth_legend(depths_m), columns=2)
    fit_paper(figure)
    return figure


def _check_image(name: str, image: Image) -> NDArray[np.float64]:
    """Convert a depth image to float64, or raise ValueError if it is no image."""
    array = np.asarray(image, dtype=np.float64)
    if array.ndim != 2 or array.size == 0:
        raise ValueError(f"image {name!r}: got shape {array.shape}; give (rows, columns) distances")
    return array


def _build_depth_scale(depths_m: NDArray[np.float64]) -> ColorScale:
    """Build the logarithmic color scale of all depths, robust to outliers."""
    hits_m = depths_m[np.isfinite(depths_m) & (depths_m > 0)]
    low, high = np.percentile(hits_m, PARAMS.depth_percentiles) if len(hits_m) else PARAMS.default_depths_m
    # A scale needs low < high, also if all depths are equal.
    high = max(high, 1.01 * low)
    return ColorScale("distance along the ray", "m", "viridis_r", float(low), float(high), logarithmic=True)


def _create_image_axes(arrays: list[NDArray[np.float64]]) -> Figure:
    """Create axes of images of equal height, in rows up to the maximum width; the axes of the color bar come last."""
    height_in, gap_in = PARAMS.image_height_in, LAYOUT.margin_in
    corners_in, widths_in, row, row_width_in = [], [], 0, -gap_in
    paper_width_in = 0.0
    for array in arrays:
        width_in = height_in * array.shape[1] / array.shape[0]
        if row_width_in > 0 and row_width_in + gap_in + width_in > PARAMS.max_row_in:
            row, row_width_in = row + 1, -gap_in
        corners_in.append((row_width_in + gap_in, row * (height_in + LAYOUT.row_gap_in)))
        widths_in.append(width_in)
        row_width_in += gap_in + width_in
        paper_width_in = max(paper_width_in, row_width_in)
    paper_height_in = (row + 1) * (height_in + LAYOUT.row_gap_in) - LAYOUT.row_gap_in
    figure = Figure(figsize=(paper_width_in, paper_height_in), dpi=LAYOUT.dots_per_inch)

    def build_box(left_in: float, top_in: float, width_in: float) -> tuple[float, float, float, float]:
        bottom_in = paper_height_in - top_in - height_in
        relative_left, relative_width = left_in / paper_width_in, width_in / paper_width_in
        return relative_left, bottom_in / paper_height_in, relative_width, height_in / paper_height_in

    for array, (left_in, top_in), width_in in zip(arrays, corners_in, widths_in, strict=True):
        rows, columns = array.shape
        axes = figure.add_axes(build_box(left_in, top_in, width_in))
        axes.set(xlim=(-0.5, columns - 0.5), ylim=(-0.5, rows - 0.5), xticks=[], yticks=[])
    figure.add_axes(build_box(paper_width_in + gap_in, 0.0, LAYOUT.color_bar_width_in))
    return figure


def _build_depth_legend(depths_m: NDArray[np.float64]) -> list[Artist]:
    """Build the entries of pixels without a hit and without a ray, as far as there are any."""
    infinite_share, missing_share = float(np.isinf(depths_m).mean()), float(np.isnan(depths_m).mean())
    entries: list[Artist] = []
    if infinite_share:
        label = f"nothing within range ({format_percent(infinite_share)} % of the pixels)"
        entries.append(Patch(facecolor=PARAMS.sky_color, edgecolor="#9fb0c0", label=label))
    if missing_share:
        label = f"no ray: beyond the lens ({format_percent(missing_share)} % of the pixels)"
        entries.append(Patch(label=label, **UNOBSERVED_STYLE))
    return entries
