"""The paper under a picture, as large as what is on it, cells of maps a whole number of pixels; films of pictures."""

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

MAX_MAP_IN = (9.0, 6.0)
MAX_PAPER_IN = (14.0, 8.75)
# Between maps on one paper, with room for the outer labels of two axes; below, for a heading.
BESIDE_IN = 0.6
BELOW_IN = 0.4
# For a heading and the numbers of an axis.
LABELS_IN = 0.55
DOTS_PER_INCH = 150
# Of maps, at least, so that a cell is whole pixels, and not more of them than are read: each is drawn and compressed.
MIN_DOTS_PER_INCH = 110
# Beyond this, cells are smaller than pixels and are averaged.
MAX_DOTS_PER_INCH = 300
COLOUR_BAR_IN = 0.16
# The label of the colour bar needs this much.
MIN_COLOUR_BAR_IN = 2.4
GAP_IN = 0.15
X_LABEL_IN = 0.55
LEGEND_COLUMN_IN = 3.0
HEADING_POINTS = 18
ABOVE: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "offset points", "parse_math": False}


@dataclass(frozen=True)
class Sheet:
    """An empty map, x to the right and y upwards in equal metres, alone on its paper or beside others.

    These share the place of the `color_bar_axes`. So many columns of a legend fit beside each other.
    """

    figure: Figure
    axes: Axes
    color_bar_axes: Axes
    legend_columns: int
    meters_per_inch: float


def create_sheets(grid: BevGrid, num_maps: int = 1) -> list[Sheet]:
    """Empty maps of the grid on one paper: long ones below each other, others beside each other.

    `grid`: bounds and cells; `num_maps`: how many. Returns the maps, row by row from the upper left.
    """
    _, rows, columns = grid.shape
    across, inches_per_cell = _arrange(grid, num_maps)
    dpi = min(math.ceil(MIN_DOTS_PER_INCH * inches_per_cell) / inches_per_cell, MAX_DOTS_PER_INCH)
    map_in = inches_per_cell * np.array([columns, rows])
    # Gaps of whole pixels, so that every cell of every map is whole pixels.
    step_in = map_in + np.round(np.array([BESIDE_IN, BELOW_IN]) * dpi) / dpi
    paper_in = map_in + step_in * [across - 1, math.ceil(num_maps / across) - 1]
    figure = Figure(figsize=tuple(paper_in), dpi=dpi)

    def place(left_in: float, top_in: float, size_in: NDArray[np.float64]) -> tuple[float, float, float, float]:
        corner = np.array([left_in, paper_in[1] - top_in - size_in[1]]) / paper_in
        return (*corner.tolist(), *(size_in / paper_in).tolist())

    views = []
    for at in range(num_maps):
        left_in, top_in = (step_in * [at % across, at // across]).tolist()
        views.append(figure.add_axes(place(left_in, top_in, map_in), xlim=grid.x_m, ylim=grid.y_m))
        left, lowest = at % across == 0, at + across >= num_maps
        views[-1].set(xlabel="x forward (m)" if lowest else "", ylabel="y left (m)" if left else "")
        views[-1].tick_params(labelbottom=lowest, labelleft=left)
    bar_in = np.array([COLOUR_BAR_IN, max(paper_in[1], MIN_COLOUR_BAR_IN)])
    gap_in = GAP_IN if num_maps == 1 else BESIDE_IN  # the axis of a map above the last row has labels beside the bar
    bar = figure.add_axes(place(paper_in[0] + gap_in, 0.0, bar_in))
    legend_columns = max(1, int(paper_in[0] / LEGEND_COLUMN_IN))
    scale = grid.cell_m / inches_per_cell
    return [Sheet(figure, axes, bar, legend_columns, scale) for axes in views]


def _arrange(grid: BevGrid, maps: int) -> tuple[int, float]:
    """How many maps beside each other, and inches for each cell: the most that the paper allows."""
    _, rows, columns = grid.shape
    width_in, height_in = MAX_MAP_IN if maps == 1 else MAX_PAPER_IN

    def inches_per_cell(across: int) -> float:
        return min(width_in / (across * columns), height_in / (math.ceil(maps / across) * rows))

    across = max(range(1, maps + 1), key=inches_per_cell)
    return across, inches_per_cell(across)


def stack_views(views: Sequence[tuple[Bounds, Bounds]], *, width_in: float) -> tuple[Figure, list[Axes]]:
    """Empty views in metres without cells, below each other, each in equal metres on both axes.

    `views`: bounds of the axis to the right, and of that upwards, in metres; from the top; `width_in`: width in inches.
    Returns the paper, and the views from the top.
    """
    heights_in = [width_in * (y[1] - y[0]) / (x[1] - x[0]) for x, y in views]
    paper_in = sum(heights_in) + LABELS_IN * (len(heights_in) - 1)
    figure = Figure(figsize=(width_in, paper_in), dpi=DOTS_PER_INCH)
    top_in, axes = paper_in, []
    for (x, y), height_in in zip(views, heights_in, strict=True):
        place = (0.0, (top_in - height_in) / paper_in, 1.0, height_in / paper_in)
        axes.append(figure.add_axes(place, xlim=x, ylim=y))
        top_in -= height_in + LABELS_IN
    return figure, axes


def create_charts(
    rows: int, columns: int, size_in: tuple[float, float], title: str, *, sharey: bool = False
) -> tuple[Figure, list[list[Axes]]]:
    """Empty charts in rows under a title, which matplotlib arranges: a figure of its own, outside pyplot."""
    figure = Figure(figsize=size_in, dpi=DOTS_PER_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, parse_math=False)
    return figure, [list(row) for row in figure.subplots(rows, columns, squeeze=False, sharey=sharey)]


def write_title(axes: Axes, title: str, subtitle: str, lift_points: float = 0.0) -> None:
    """Write two lines above the map, the second smaller, both as they are: `$` is no formula."""
    axes.annotate(title, (0, 1), (0, 22 + lift_points), fontsize=11, fontweight="bold", **ABOVE)
    axes.annotate(subtitle, (0, 1), (0, 8 + lift_points), fontsize=9, color="#404040", **ABOVE)


def write_heading(axes: Axes, heading: str) -> None:
    """Write a line above one map of several, which leaves room for a title if that is lifted by `HEADING_POINTS`."""
    axes.annotate(heading, (0, 1), (0, 5), fontsize=9, fontweight="bold", **ABOVE)


def find_lower_left(views: Iterable[Axes]) -> Axes:
    """The one in the lower left corner, under which the legend of all has its place."""
    return min(views, key=lambda axes: (axes.get_position().y0, axes.get_position().x0))


def write_legend(axes: Axes, entries: Sequence[Artist], columns: int) -> None:
    """Write the legend under the map, where it hides nothing; what several maps share is in it once."""
    below = ScaledTranslation(0, -X_LABEL_IN, axes.figure.dpi_scale_trans)
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
    """Make the paper as large as what is drawn on it, with a margin. Nothing is clipped, nothing changes its size."""
    FigureCanvasAgg(figure)
    drawn = figure.get_tightbbox().padded(GAP_IN)
    dots = figure.dpi
    left, bottom = (math.floor(edge * dots) / dots for edge in drawn.min)
    right, top = (math.ceil(edge * dots) / dots for edge in drawn.max)
    old, new = figure.get_size_inches(), (right - left, top - bottom)
    figure.set_size_inches(*new)
    for axes in figure.axes:
        corners = axes.get_position(original=True).get_points() * old - (left, bottom)
        axes.set_position(Bbox(corners / new))


WRITERS: dict[str, type[FFMpegWriter] | type[PillowWriter]] = {".gif": PillowWriter, ".mp4": FFMpegWriter}


def check_animation(path: Path) -> None:
    """Refuse, before the first figure is drawn, a film that could not be written.

    Raises:
        ValueError: Neither .gif nor .mp4.
        FileNotFoundError: .mp4, and the program ffmpeg is not there.
    """
    if path.suffix not in WRITERS:
        raise ValueError(f"a film is a .gif or .mp4 file; got {path.name!r}")
    if not WRITERS[path.suffix].isAvailable():
        raise FileNotFoundError(f"{path.name}: the program ffmpeg is needed for .mp4 and is not there; write a .gif")


def _pixels(figure: Figure) -> NDArray[np.uint8]:
    """(rows, columns, 4) red, green, blue, alpha."""
    canvas: Any = FigureCanvasAgg(figure)  # matplotlib has no types for it
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def write_animation(path: Path, figures: Iterable[Figure], *, frames_per_s: float) -> None:
    """Write figures as a film. It is as large as the first of them; what a later one has beyond that is cut off.

    Args:
        path: The file, .gif or .mp4; `check_animation` says whether it can be written.
        figures: At least one, each drawn when it is its turn.
        frames_per_s: How many of them a second shows.
    """
    write_atomically(path, partial(_write, figures, frames_per_s))


def _write(figures: Iterable[Figure], per_s: float, path: Path) -> None:
    writer: AbstractMovieWriter = WRITERS[path.suffix](fps=per_s)  # type: ignore[arg-type]  # any number will do
    screen: Figure | None = None
    for figure in figures:
        image = _pixels(figure)
        if screen is None:
            # What encodes films wants even numbers of pixels.
            height, width = (size + size % 2 for size in image.shape[:2])
            screen = Figure(figsize=(width / figure.dpi, height / figure.dpi), dpi=figure.dpi)
            FigureCanvasAgg(screen)
            writer.setup(screen, str(path), dpi=figure.dpi)
        screen.clear()
        # Images lie with their first row at the top of the screen.
        screen.figimage(image, 0, height - len(image))
        writer.grab_frame()
    writer.finish()
