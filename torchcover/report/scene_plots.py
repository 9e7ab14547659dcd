"""Pictures of a frame, from above and as the cameras of a rig see it, and of the points on targets around a vehicle."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from matplotlib.ticker import LogLocator, NullFormatter
from numpy.typing import NDArray

from torchcover.coverage import BevGrid
from torchcover.report.colors import UNOBSERVED_STYLE, ColorScale, plot_cells, plot_color_bar
from torchcover.report.number_format import format_percent
from torchcover.report.overlay import HALO, plot_ego
from torchcover.report.plot_layout import (
    BELOW_IN,
    COLOUR_BAR_IN,
    DOTS_PER_INCH,
    GAP_IN,
    HEADING_POINTS,
    Bounds,
    Sheet,
    create_sheets,
    find_lower_left,
    fit_paper,
    stack_views,
    write_heading,
    write_legend,
    write_title,
)

Points = NDArray[np.floating]
Image = NDArray[np.floating]

WIDTH_IN = 13.0
REFERENCE, SENSOR = "#e0b878", "#3b6ea5"
# Kerbs are drawn, the road is not; greys of what is low and of what is high.
LOWEST_STANDING_M = 0.08
LOW_GREY, HIGH_GREY, GREY_HEIGHT_M = 0.92, 0.55, 3.0
# These have the same colours in every picture; others take what follows.
CATEGORIES = ("car", "truck", "bus", "cyclist", "motorcycle", "pedestrian")
COLOURS = ("#d55e00", "#7a3fa0", "#e6b400", "#009e73", "#8b5a2b", "#d62598", "#a3122f", "#555555", "#000000")
PATH = "#111111"
IMAGE_HEIGHT_IN = 2.4
SKY = "#dfe9f2"
MAX_ROW_IN = 13.5
# The colours leave out this share of the pixels at either end: a bumper, and a few walls at the horizon.
ROBUST_PERCENTILES = (0.5, 99.5)
FALLBACK_SCALE_M = (1.0, 100.0)


@dataclass(frozen=True, eq=False)
class ActorMark:
    """An actor as a frame shows it.

    Args:
        category: What it is; one colour each.
        outline_m: (K, 2) corners x, y in the vehicle frame in metres.
    """

    category: str
    outline_m: Points


@dataclass(frozen=True, eq=False)
class StaticFaces:
    """What stands in a frame and never moves.

    Args:
        triangles_m: (F, 3, 2) its faces from above, x, y in the vehicle frame in metres.
        height_m: (F,) how high each reaches above the ground under the vehicle.
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
    """Draw a frame.

    Args:
        x: Bounds forward in metres.
        y: Bounds to the left in metres.
        static_faces: What stands there.
        ego_outline_m: (K, 2) corners of the ego in the vehicle frame in metres.
        actors: The others; what lies beyond the bounds is left out.
        sensor_points: (N, 3) points of the rig.
        reference_points: (M, 3) points of the reference sensor, if there is one.
        title: First line.
        subtitle: Second line, smaller.
        path_m: (T, 2) the ego's way in the vehicle frame in metres; not drawn if it does not move.

    Returns:
        A figure of its own, outside pyplot.
    """
    figure, (axes,) = stack_views([(x, y)], width_in=WIDTH_IN)
    axes.set(xlabel="x forward (m)", ylabel="y left (m)")
    inside = [actor for actor in actors if _is_inside(actor.outline_m, x, y)]
    entries = [
        *_draw_standing(axes, static_faces),
        *([] if reference_points is None else _draw_cloud(axes, reference_points, REFERENCE, "reference points")),
        *_draw_cloud(axes, sensor_points, SENSOR, "points of the rig"),
        *_draw_actors(axes, inside),
        *([] if path_m is None else axes.plot(*path_m.T, color=PATH, linewidth=1.2, label="way of the ego", zorder=3)),
        *plot_ego(axes, ego_outline_m),
    ]
    write_title(axes, title, subtitle)
    write_legend(axes, entries, columns=4)
    fit_paper(figure)
    return figure


def _draw_standing(axes: Axes, standing: StaticFaces) -> list[Artist]:
    """Faces from above, the highest last; the ground itself is not drawn."""
    stands = standing.height_m > LOWEST_STANDING_M
    height_m = standing.height_m[stands]
    order = np.argsort(height_m)
    grey = HIGH_GREY + (LOW_GREY - HIGH_GREY) * np.exp(-height_m[order] / GREY_HEIGHT_M)
    colours = np.repeat(grey[:, None], 3, axis=1)
    faces = list(standing.triangles_m[stands][order])
    axes.add_collection(PolyCollection(faces, facecolors=colours, edgecolors=colours, linewidths=0.4, zorder=0.5))
    if not faces:
        return []
    words = "what stands there, the darker the higher"
    return [Patch(facecolor=str((LOW_GREY + HIGH_GREY) / 2), edgecolor="none", label=words)]


def _draw_cloud(axes: Axes, points: Points, colour: str, label: str) -> list[Artist]:
    # A point is a pixel, however many there are.
    axes.plot(points[:, 0], points[:, 1], linestyle="none", marker=",", color=colour, zorder=1)
    return [Line2D([], [], linestyle="none", marker=".", color=colour, label=f"{label} ({len(points):,})")]


def _draw_actors(axes: Axes, actors: Sequence[ActorMark]) -> list[Artist]:
    counts = Counter(actor.category for actor in actors)
    known = [*CATEGORIES, *sorted(set(counts) - set(CATEGORIES))]
    colours = {category: COLOURS[at % len(COLOURS)] for at, category in enumerate(known) if category in counts}
    for actor in actors:
        colour = colours[actor.category]
        axes.add_patch(Polygon(actor.outline_m, facecolor=(colour, 0.45), edgecolor=colour, linewidth=0.9, zorder=2))
    return [
        Patch(facecolor=(colour, 0.45), edgecolor=colour, label=f"{category} ({counts[category]})")
        for category, colour in colours.items()
    ]


def _is_inside(outline_m: Points, x: Bounds, y: Bounds) -> bool:
    low, high = outline_m.min(axis=0), outline_m.max(axis=0)
    return bool(high[0] >= x[0] and low[0] <= x[1] and high[1] >= y[0] and low[1] <= y[1])


def plot_depth_images(images: Mapping[str, Image], *, title: str, subtitle: str = "") -> Figure:
    """Draw depth images.

    Args:
        images: (rows, columns) distances along the ray in metres, by the name of the camera; infinite where a ray hits
            nothing within its range, NaN where a pixel has no ray. Their sizes may differ.
        title: First line.
        subtitle: Second line, smaller.

    Returns:
        A figure of its own, outside pyplot. Colours are logarithmic: twice as far is the same step everywhere.

    Raises:
        ValueError: No image, or one that has not two dimensions or no pixel.

    Example:
        >>> figure = plot_depth_images({"front": np.array([[2.0, np.inf], [1.0, np.nan]])}, title="My rig")
        >>> [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
        ['nothing within range (25.0 % of the pixels)', 'no ray: beyond the lens (25.0 % of the pixels)']
    """
    arrays = {name: _checked(name, image) for name, image in images.items()}
    if not arrays:
        raise ValueError("images: at least one is needed; got none")
    scale = _scale(np.concatenate([array.ravel() for array in arrays.values()]))
    figure = _paper(list(arrays.values()))
    *views, bar = figure.axes
    for axes, (name, array) in zip(views, arrays.items(), strict=True):
        # The first row of an image is its top; the first row of cells is their bottom.
        image = plot_cells(axes, array[::-1], scale, infinite_color=SKY)
        write_heading(axes, name)
    colours = figure.colorbar(
        image, cax=bar, extend="both", label=scale.label, ticks=LogLocator(subs=(1, 2, 5)), format="{x:g}"
    )
    colours.minorformatter = NullFormatter()
    write_title(views[0], title, subtitle, lift_points=HEADING_POINTS)
    write_legend(find_lower_left(views), _entries(arrays), columns=2)
    fit_paper(figure)
    return figure


def _checked(name: str, image: Image) -> NDArray[np.float64]:
    array = np.asarray(image, dtype=np.float64)
    if array.ndim != 2 or array.size == 0:
        raise ValueError(f"image {name!r}: (rows, columns) distances are needed; got shape {array.shape}")
    return array


def _scale(values: NDArray[np.float64]) -> ColorScale:
    hits = values[np.isfinite(values) & (values > 0)]
    low, high = np.percentile(hits, ROBUST_PERCENTILES) if len(hits) else FALLBACK_SCALE_M
    # A wall at one distance has no range of colours of its own.
    high = max(high, 1.01 * low)
    return ColorScale("distance along the ray", "m", "viridis_r", float(low), float(high), logarithmic=True)


def _paper(arrays: list[NDArray[np.float64]]) -> Figure:
    """Empty images of one height, in rows as long as the paper allows, and the place of the colour bar last."""
    widths_in = [IMAGE_HEIGHT_IN * array.shape[1] / array.shape[0] for array in arrays]
    rows = _rows(widths_in)
    paper_in = (
        max(sum(row) + GAP_IN * (len(row) - 1) for row in rows),
        len(rows) * (IMAGE_HEIGHT_IN + BELOW_IN) - BELOW_IN,
    )
    figure = Figure(figsize=paper_in, dpi=DOTS_PER_INCH)

    def place(left_in: float, top_in: float, width_in: float) -> tuple[float, float, float, float]:
        bottom_in = paper_in[1] - top_in - IMAGE_HEIGHT_IN
        return left_in / paper_in[0], bottom_in / paper_in[1], width_in / paper_in[0], IMAGE_HEIGHT_IN / paper_in[1]

    shapes = iter(array.shape for array in arrays)
    for at, row in enumerate(rows):
        lefts_in = accumulate(row[:-1], lambda left_in, width_in: left_in + width_in + GAP_IN, initial=0.0)
        for left_in, width_in in zip(lefts_in, row, strict=True):
            height, width = next(shapes)
            figure.add_axes(
                place(left_in, at * (IMAGE_HEIGHT_IN + BELOW_IN), width_in),
                xlim=(-0.5, width - 0.5),
                ylim=(-0.5, height - 0.5),
                xticks=[],
                yticks=[],
            )
    figure.add_axes(place(paper_in[0] + GAP_IN, 0.0, COLOUR_BAR_IN))
    return figure


def _rows(widths_in: list[float]) -> list[list[float]]:
    rows = [[widths_in[0]]]
    for width_in in widths_in[1:]:
        if sum(rows[-1]) + width_in + GAP_IN * len(rows[-1]) > MAX_ROW_IN:
            rows.append([])
        rows[-1].append(width_in)
    return rows


def _entries(arrays: Mapping[str, NDArray[np.float64]]) -> list[Artist]:
    values = np.concatenate([array.ravel() for array in arrays.values()])
    infinite, none = float(np.isinf(values).mean()), float(np.isnan(values).mean())
    entries: list[Artist] = []
    if infinite:
        label = f"nothing within range ({format_percent(infinite)} % of the pixels)"
        entries.append(Patch(facecolor=SKY, edgecolor="#9fb0c0", label=label))
    if none:
        entries.append(
            Patch(label=f"no ray: beyond the lens ({format_percent(none)} % of the pixels)", **UNOBSERVED_STYLE)
        )
    return entries


Float64 = NDArray[np.float64]
Bools = NDArray[np.bool_]

UNSEEN = "#d55e00"
ROBUST_PERCENTILE = 98
RINGS_M = (1.0, 2.0, 3.0)
CORNER_POINTS = 25


def plot_target_visibility(
    point_counts: Float64,
    detected: Bools,
    grid: BevGrid,
    *,
    vehicle_outline_m: Float64,
    vehicle_box_m: Float64,
    sensors_m: Float64,
    min_points: int,
    title: str,
    subtitle: str = "",
) -> Figure:
    """Draw how many points there are on a target.

    Args:
        point_counts: (Y, X) number of points, NaN where the target cannot stand.
        detected: (Y, X) whether that is enough to see it.
        grid: The cells.
        vehicle_outline_m: (K, 2) what the vehicle looks like from above.
        vehicle_box_m: (4, 2) its box, from which the dashed lines are 1, 2 and 3 m away.
        sensors_m: (S, 2) where sensors are.
        min_points: How many points are enough, for the legend.
        title: First line.
        subtitle: Second line, smaller.

    Returns:
        A figure of its own, outside pyplot. Lines divide places where it is seen from those where it is not.

    Raises:
        ValueError: Arrays of another shape than the grid.
    """
    for name, array in (("points", point_counts), ("enough", detected)):
        if array.shape != grid.shape[1:]:
            raise ValueError(f"{name}: shape {grid.shape[1:]} is needed, as of the grid; got {array.shape}")
    (sheet,) = create_sheets(grid)
    entries = _draw_points(sheet, point_counts)
    entries += _draw_rings(sheet.axes, vehicle_box_m)
    entries += _draw_boundary(sheet.axes, detected, ~np.isnan(point_counts), grid, min_points)
    entries += plot_ego(sheet.axes, vehicle_outline_m)
    sheet.axes.plot(*sensors_m.T, linestyle="none", marker="o", markersize=3.5, color="black", zorder=4)
    entries.append(Line2D([], [], linestyle="none", marker="o", markersize=3.5, color="black", label="sensors"))
    write_title(sheet.axes, title, subtitle)
    write_legend(sheet.axes, entries, sheet.legend_columns)
    fit_paper(sheet.figure)
    return sheet.figure


def _draw_points(sheet: Sheet, points: Float64) -> list[Artist]:
    some = points[points > 0]
    high = max(float(np.percentile(some, ROBUST_PERCENTILE)), 10.0) if len(some) else 10.0
    scale = ColorScale("points on the target", "mean of the steps", "viridis", 1.0, high, logarithmic=True)
    # Fewer than one in the mean is as dark as one.
    shown = np.where(points > 0, np.maximum(points, 1.0), np.nan)
    plot_color_bar(sheet, plot_cells(sheet.axes, shown, scale), shown, scale)
    unseen = np.ma.masked_where(points != 0, np.ones_like(points))
    sheet.axes.imshow(
        unseen,
        extent=(*sheet.axes.get_xlim(), *sheet.axes.get_ylim()),
        origin="lower",
        interpolation="nearest",
        cmap=ListedColormap([UNSEEN]),
    )
    entries: list[Artist] = []
    if (points == 0).any():
        entries.append(Patch(facecolor=UNSEEN, label="no point at all"))
    if np.isnan(points).any():
        entries.append(Patch(label="no room for it", **UNOBSERVED_STYLE))
    return entries


def _draw_boundary(axes: Axes, enough: Bools, free: Bools, grid: BevGrid, hits: int) -> list[Artist]:
    """Lines along the edges between cells that are seen and cells that are not."""
    x, y = np.linspace(*grid.x_m, enough.shape[1] + 1), np.linspace(*grid.y_m, enough.shape[0] + 1)
    row, column = np.nonzero((enough[:, 1:] != enough[:, :-1]) & free[:, 1:] & free[:, :-1])
    upright = [((x[c + 1], y[r]), (x[c + 1], y[r + 1])) for r, c in zip(row, column, strict=True)]
    row, column = np.nonzero((enough[1:] != enough[:-1]) & free[1:] & free[:-1])
    level = [((x[c], y[r + 1]), (x[c + 1], y[r + 1])) for r, c in zip(row, column, strict=True)]
    lines = LineCollection(upright + level, colors="black", linewidths=1.4, zorder=2, path_effects=HALO)
    axes.add_collection(lines)
    return [Line2D([], [], color="black", linewidth=1.4, label=f"between fewer than {hits} points and more")]


def _draw_rings(axes: Axes, box_m: Float64) -> list[Artist]:
    low, high = box_m.min(axis=0), box_m.max(axis=0)
    for ring_m in RINGS_M:
        axes.plot(*_ring(low, high, ring_m).T, color="white", linewidth=0.9, linestyle=(0, (4, 4)), zorder=1.5)
    words = ", ".join(f"{ring_m:g}" for ring_m in RINGS_M)
    patch = Line2D([], [], color="#808080", linewidth=0.9, linestyle=(0, (4, 4)), label=f"{words} m from the vehicle")
    return [patch]


def _ring(low: Float64, high: Float64, away_m: float) -> Float64:
    """(K, 2) closed line at a distance from a rectangle."""
    angles = np.linspace(0.0, 2 * np.pi, 4 * CORNER_POINTS, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    corners = np.array([high, (low[0], high[1]), low, (high[0], low[1])])
    ring = corners.repeat(CORNER_POINTS, axis=0) + away_m * circle
    return np.vstack([ring, ring[:1]])
