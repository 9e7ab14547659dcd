"""What the cameras of a rig see: their depth images side by side, on one colour scale."""

from collections.abc import Mapping
from itertools import accumulate

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullFormatter
from numpy.typing import NDArray

from torchcover.report.maps.cells import UNKNOWN, draw_cells
from torchcover.report.maps.scale import ColourScale
from torchcover.report.maps.sheet import (
    BELOW_IN,
    COLOUR_BAR_IN,
    DOTS_PER_INCH,
    GAP_IN,
    HEADING_POINTS,
    fit_paper,
    write_heading,
    write_legend,
    write_title,
)
from torchcover.report.wording import percent

Image = NDArray[np.floating]

IMAGE_HEIGHT_IN = 2.4
SKY = "#dfe9f2"
MAX_ROW_IN = 13.5
# The colours leave out this share of the pixels at either end: a bumper, and a few walls at the horizon.
ROBUST_PERCENTILES = (0.5, 99.5)
FALLBACK_SCALE_M = (1.0, 100.0)


def draw_depths(images: Mapping[str, Image], *, title: str, subtitle: str = "") -> Figure:
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
        >>> figure = draw_depths({"front": np.array([[2.0, np.inf], [1.0, np.nan]])}, title="My rig")
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
        image = draw_cells(axes, array[::-1], scale, infinite=SKY)
        write_heading(axes, name)
    colours = figure.colorbar(
        image, cax=bar, extend="both", label=scale.label, ticks=LogLocator(subs=(1, 2, 5)), format="{x:g}"
    )
    colours.minorformatter = NullFormatter()
    write_title(views[0], title, subtitle, lift_points=HEADING_POINTS)
    lowest = min(views, key=lambda axes: (axes.get_position().y0, axes.get_position().x0))
    write_legend(lowest, _entries(arrays), columns=2)
    fit_paper(figure)
    return figure


def _checked(name: str, image: Image) -> NDArray[np.float64]:
    array = np.asarray(image, dtype=np.float64)
    if array.ndim != 2 or array.size == 0:
        raise ValueError(f"image {name!r}: (rows, columns) distances are needed; got shape {array.shape}")
    return array


def _scale(values: NDArray[np.float64]) -> ColourScale:
    hits = values[np.isfinite(values) & (values > 0)]
    low, high = np.percentile(hits, ROBUST_PERCENTILES) if len(hits) else FALLBACK_SCALE_M
    # A wall at one distance has no range of colours of its own.
    high = max(high, 1.01 * low)
    return ColourScale("distance along the ray", "m", "viridis_r", float(low), float(high), logarithmic=True)


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
        label = f"nothing within range ({percent(infinite)} % of the pixels)"
        entries.append(Patch(facecolor=SKY, edgecolor="#9fb0c0", label=label))
    if none:
        entries.append(Patch(label=f"no ray: beyond the lens ({percent(none)} % of the pixels)", **UNKNOWN))
    return entries
