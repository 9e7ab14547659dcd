"""Layout of figures: maps, views and charts on paper that fits their content, and animations of figures."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.animation import AbstractMovieWriter, FFMpegWriter, PillowWriter
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox, ScaledTranslation
from numpy.typing import NDArray

from torchcover.coverage import BevGrid
from torchcover.files import write_atomically

Bounds = tuple[float, float]


@dataclass(frozen=True)
class LayoutParams:
    """Sizes of figures.

    Args:
        map_size_in: Maximum width and height of a single map, in inches.
        paper_size_in: Maximum width and height of all maps of a figure, in inches.
        column_gap_in: Horizontal gap between maps, with room for the labels of two axes.
        row_gap_in: Vertical gap between maps or images, with room for a heading.
        view_gap_in: Vertical gap between views in meters, with room for a heading and the numbers of an axis.
        margin_in: Margin of the paper, and gap between an image and the color bar.
        dots_per_inch: Resolution of figures other than maps.
        min_map_dots_per_inch: Minimum resolution of maps, whose cells are whole pixels.
        max_map_dots_per_inch: Maximum resolution of maps; smaller cells are averaged.
        color_bar_width_in: Width of the color bar.
        min_color_bar_height_in: Minimum height of the color bar, so that its label fits.
        x_label_in: Gap between a map and its legend, with room for the label of the x axis.
        legend_column_in: Width of a column of the legend.
    """

    map_size_in: tuple[float, float] = (9.0, 6.0)
    paper_size_in: tuple[float, float] = (14.0, 8.75)
    column_gap_in: float = 0.6
    row_gap_in: float = 0.4
    view_gap_in: float = 0.55
    margin_in: float = 0.15
    dots_per_inch: int = 150
    min_map_dots_per_inch: int = 110
    max_map_dots_per_inch: int = 300
    color_bar_width_in: float = 0.16
    min_color_bar_height_in: float = 2.4
    x_label_in: float = 0.55
    legend_column_in: float = 3.0


LAYOUT = LayoutParams()


@dataclass(frozen=True)
class Sheet:
    """Empty map, x forward to the right and y left upwards on equal scales, alone on its paper or with others.

    Args:
        figure: Figure of the map.
        axes: Axes of the map.
        color_bar_axes: Axes of the color bar, which all maps of a figure share.
        legend_columns: Number of columns of a legend that fit the paper.
        meters_per_inch: Scale of the map.
    """

    figure: Figure
    axes: Axes
    color_bar_axes: Axes
    legend_columns: int
    meters_per_inch: float


def create_sheets(grid: BevGrid, num_maps: int = 1) -> list[Sheet]:
    """Create empty maps of a grid on one paper: long maps below each other, others next to each other.

    Args:
        grid: Bounds and cells of each map.
        num_maps: Number of maps.

    Returns:
        The maps, row by row from the upper left.
    """
    _, rows, columns = grid.shape
    maps_per_row, cell_in = _arrange_maps(grid, num_maps)
    dpi = min(math.ceil(LAYOUT.min_map_dots_per_inch * cell_in) / cell_in, LAYOUT.max_map_dots_per_inch)
    map_in = cell_in * np.array([columns, rows])
    # Gaps are whole pixels, so that each cell of each map is a whole number of pixels.
    pitch_in = map_in + np.round(np.array([LAYOUT.column_gap_in, LAYOUT.row_gap_in]) * dpi) / dpi
    paper_in = map_in + pitch_in * [maps_per_row - 1, math.ceil(num_maps / maps_per_row) - 1]
    figure = Figure(figsize=tuple(paper_in), dpi=dpi)

    def build_box(left_in: float, top_in: float, size_in: NDArray[np.float64]) -> tuple[float, float, float, float]:
        """Build the box of axes in figure coordinates from its upper left corner and size in inches."""
        corner = np.array([left_in, paper_in[1] - top_in - size_in[1]]) / paper_in
        return (*corner.tolist(), *(size_in / paper_in).tolist())

    maps = []
    for index in range(num_maps):
        left_in, top_in = (pitch_in * [index % maps_per_row, index // maps_per_row]).tolist()
        axes = figure.add_axes(build_box(left_in, top_in, map_in), xlim=grid.x_m, ylim=grid.y_m)
        is_leftmost, is_lowest = index % maps_per_row == 0, index + maps_per_row >= num_maps
        axes.set(xlabel="x forward (m)" if is_lowest else "", ylabel="y left (m)" if is_leftmost else "")
        axes.tick_params(labelbottom=is_lowest, labelleft=is_leftmost)
        maps.append(axes)
    bar_in = np.array([LAYOUT.color_bar_width_in, max(paper_in[1], LAYOUT.min_color_bar_height_in)])
    # With several rows, the axis of a map above the last row has labels next to the color bar.
    gap_in = LAYOUT.margin_in if num_maps == 1 else LAYOUT.column_gap_in
    color_bar_axes = figure.add_axes(build_box(paper_in[0] + gap_in, 0.0, bar_in))
    legend_columns = max(1, int(paper_in[0] / LAYOUT.legend_column_in))
    return [Sheet(figure, axes, color_bar_axes, legend_columns, grid.cell_m / cell_in) for axes in maps]


def _arrange_maps(grid: BevGrid, num_maps: int) -> tuple[int, float]:
    """Find the number of maps per row with the largest cells, and the size of a cell in inches."""
    _, rows, columns = grid.shape
    width_in, height_in = LAYOUT.map_size_in if num_maps == 1 else LAYOUT.paper_size_in
    best_maps_per_row, best_cell_in = 1, 0.0
    for maps_per_row in range(1, num_maps + 1):
        map_rows = math.ceil(num_maps / maps_per_row)
        cell_in = min(width_in / (maps_per_row * columns), height_in / (map_rows * rows))
        if cell_in > best_cell_in:
            best_maps_per_row, best_cell_in = maps_per_row, cell_in
    return best_maps_per_row, best_cell_in


def stack_views(views: Sequence[tuple[Bounds, Bounds]], *, width_in: float) -> tuple[Figure, list[Axes]]:
    """Create empty views below each other, each with equal scales of both axes.

    Args:
        views: Horizontal and vertical bounds of each view in meters, from the top.
        width_in: Width in inches.

    Returns:
        The figure, and the axes from the top.
    """
    heights_in = [width_in * (y[1] - y[0]) / (x[1] - x[0]) for x, y in views]
    paper_in = sum(heights_in) + LAYOUT.view_gap_in * (len(heights_in) - 1)
    figure = Figure(figsize=(width_in, paper_in), dpi=LAYOUT.dots_per_inch)
    top_in, axes = paper_in, []
    for (x, y), height_in in zip(views, heights_in, strict=True):
        box = (0.0, (top_in - height_in) / paper_in, 1.0, height_in / paper_in)
        axes.append(figure.add_axes(box, xlim=x, ylim=y))
        top_in -= height_in + LAYOUT.view_gap_in
    return figure, axes


def create_charts(
    rows: int, columns: int, size_in: tuple[float, float], title: str, *, sharey: bool = False
) -> tuple[Figure, list[list[Axes]]]:
    """Create empty charts in rows under a title, arranged by matplotlib, outside pyplot.

    Args:
        rows: Number of rows.
        columns: Number of charts per row.
        size_in: Width and height of the figure in inches.
        title: Title of the figure, as plain text.
        sharey: Whether all charts have the same y axis.

    Returns:
        The figure, and the axes of each row.
    """
    figure = Figure(figsize=size_in, dpi=LAYOUT.dots_per_inch, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, parse_math=False)
    return figure, [list(row) for row in figure.subplots(rows, columns, squeeze=False, sharey=sharey)]


def write_title(axes: Axes, title: str, subtitle: str, *, has_heading: bool = False) -> None:
    """Write two lines of plain text above a map, the second smaller.

    Args:
        axes: Axes of the first map.
        title: First line.
        subtitle: Second line.
        has_heading: Whether there is a heading between the map and the title.
    """
    lift_points = 18 if has_heading else 0
    _write_above(axes, title, 22 + lift_points, fontsize=11, fontweight="bold")
    _write_above(axes, subtitle, 8 + lift_points, fontsize=9, color="#404040")


def write_heading(axes: Axes, heading: str) -> None:
    """Write a line of plain text above one map of several.

    Args:
        axes: Axes of the map.
        heading: The line.
    """
    _write_above(axes, heading, 5, fontsize=9, fontweight="bold")


def _write_above(axes: Axes, text: str, points: float, **style: Any) -> None:  # noqa: ANN401  (style of matplotlib)
    """Write plain text at a distance above the axes, in points."""
    axes.annotate(
        text, (0, 1), (0, points), xycoords="axes fraction", textcoords="offset points", parse_math=False, **style
    )


def find_lower_left(views: Iterable[Axes]) -> Axes:
    """Find the axes in the lower left corner, under which the common legend is.

    Args:
        views: Axes of one figure.
    """

    def get_lower_left(axes: Axes) -> tuple[float, float]:
        box = axes.get_position()
        return box.y0, box.x0

    return min(views, key=get_lower_left)


def write_legend(axes: Axes, entries: Sequence[Artist], columns: int) -> None:
    """Write the legend below a map; entries with the same label appear once.

    Args:
        axes: Axes of the map.
        entries: Entries of all maps.
        columns: Number of columns.
    """
    below = ScaledTranslation(0, -LAYOUT.x_label_in, axes.figure.dpi_scale_trans)
    legend = axes.legend(
        handles=list({entry.get_label(): entry for entry in entries}.values()),
        loc="upper left",
        bbox_to_anchor=(0, 0),
        bbox_transform=axes.transAxes + below,
        borderaxespad=0,
        ncols=columns,
        fontsize=8,
        frameon=False,
    )
    for text in legend.get_texts():
        text.set_parse_math(False)


def fit_paper(figure: Figure) -> None:
    """Resize the paper to its content with a margin, without clipping or scaling.

    Args:
        figure: Finished figure.
    """
    FigureCanvasAgg(figure)
    content = figure.get_tightbbox().padded(LAYOUT.margin_in)
    dpi = figure.dpi
    left, bottom = (math.floor(edge * dpi) / dpi for edge in content.min)
    right, top = (math.ceil(edge * dpi) / dpi for edge in content.max)
    old_size, new_size = figure.get_size_inches(), (right - left, top - bottom)
    figure.set_size_inches(*new_size)
    for axes in figure.axes:
        corners = axes.get_position(original=True).get_points() * old_size - (left, bottom)
        axes.set_position(Bbox(corners / new_size))


ANIMATION_WRITERS: dict[str, type[FFMpegWriter] | type[PillowWriter]] = {".gif": PillowWriter, ".mp4": FFMpegWriter}


def check_animation(path: Path) -> None:
    """Check that an animation can be written, before its first figure is plotted.

    Args:
        path: File of the animation.

    Raises:
        ValueError: The file is neither .gif nor .mp4.
        FileNotFoundError: The program ffmpeg, which .mp4 needs, is missing.
    """
    if path.suffix not in ANIMATION_WRITERS:
        raise ValueError(f"an animation is a .gif or .mp4 file; got {path.name!r}")
    if not ANIMATION_WRITERS[path.suffix].isAvailable():
        raise FileNotFoundError(f"{path.name}: .mp4 needs the program ffmpeg, which is missing; write a .gif")


def write_animation(path: Path, figures: Iterable[Figure], *, frames_per_s: float) -> None:
    """Write figures as an animation with the size of the first figure; larger figures are cropped.

    Args:
        path: File that passes `check_animation`.
        figures: At least one figure; each is plotted on demand.
        frames_per_s: Figures per second.
    """
    write_atomically(path, partial(_write_frames, figures, frames_per_s))


def _write_frames(figures: Iterable[Figure], frames_per_s: float, path: Path) -> None:
    """Render figures one by one and append them to the animation."""
    writer: AbstractMovieWriter = ANIMATION_WRITERS[path.suffix](fps=frames_per_s)  # type: ignore[arg-type]  # not only int
    screen: Figure | None = None
    for figure in figures:
        canvas: Any = FigureCanvasAgg(figure)  # matplotlib has no types for it
        canvas.draw()
        image = np.asarray(canvas.buffer_rgba())
        if screen is None:
            # Video encoders need even numbers of pixels.
            height, width = (size + size % 2 for size in image.shape[:2])
            screen = Figure(figsize=(width / figure.dpi, height / figure.dpi), dpi=figure.dpi)
            FigureCanvasAgg(screen)
            writer.setup(screen, str(path), dpi=figure.dpi)
        screen.clear()
        # The first row of an image is at the top of the screen.
        screen.figimage(image, 0, height - len(image))
        writer.grab_frame()
    writer.finish()
