"""The cells of a map as colours, and the colour bar and legend entries that say what the colours mean."""

from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, LogNorm, Normalize
from matplotlib.image import AxesImage
from matplotlib.patches import Patch
from numpy.typing import NDArray

from torchcover.report.maps.scale import ColourScale
from torchcover.report.maps.sheet import Sheet
from torchcover.report.wording import percent

UNKNOWN: dict[str, Any] = {"facecolor": "#c4c4c4", "edgecolor": "#b2b2b2", "hatch": "////"}
INFINITE = "#d55e00"
NEVER_PROBED = "never probed"


def draw_cells(axes: Axes, array: NDArray[np.float64], scale: ColourScale, *, infinite: str = INFINITE) -> AxesImage:
    """Colour each cell; unknown ones are hatched grey, infinite ones have a colour of their own.

    Args:
        axes: Axes of a map, with limits set to the grid's bounds.
        array: (Y, X) values, NaN where unknown.
        scale: What the colours mean.
        infinite: Colour of infinite cells.

    Returns:
        The image, for the colour bar.
    """
    # Unknown cells are holes through which the ground of the axes shows.
    axes.patch.set(**UNKNOWN, linewidth=0)
    norm = (LogNorm if scale.logarithmic else Normalize)(scale.low, scale.high)
    image = _draw_image(axes, np.ma.masked_invalid(array), cmap=scale.colormap, norm=norm)
    endless = np.isinf(array)
    if endless.any():
        _draw_image(axes, np.ma.masked_where(~endless, endless), cmap=ListedColormap([infinite]))
    return image


def cell_entries(array: NDArray[np.float64], unknown: str = NEVER_PROBED) -> list[Artist]:
    """The legend entries for cells without a colour of the scale.

    Args:
        array: Values of one map, or of several, NaN where unknown.
        unknown: Why they are.
    """
    unknown_share = percent(float(np.isnan(array).mean()))
    entries: list[Artist] = [Patch(label=f"unknown: {unknown} ({unknown_share} % of the cells)", **UNKNOWN)]
    infinite = np.isinf(array)
    if infinite.any():
        label = f"infinite: a step saw nothing ({percent(float(infinite.mean()))} % of the cells)"
        entries.append(Patch(facecolor=INFINITE, label=label))
    return entries


def draw_colour_bar(sheet: Sheet, image: AxesImage, array: NDArray[np.float64], scale: ColourScale) -> None:
    """Draw the colour bar with quantity and unit; if values lie beyond an end, an arrow and how many there are.

    Args:
        sheet: The sheet of the map, or of one of several that share the colour bar.
        image: What `draw_cells` returned.
        array: Values of all the maps, NaN where unknown.
        scale: What the colours mean.
    """
    known = array[np.isfinite(array)]
    rounding = 1e-6 * (scale.high - scale.low)
    below, above = (known < scale.low - rounding).sum(), (known > scale.high + rounding).sum()
    extend = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}
    label = scale.label
    if beyond := below + above:
        label += f"\n{percent(float(beyond / len(known)))} % of the known cells lie beyond"
    sheet.figure.colorbar(image, cax=sheet.bar, extend=extend[bool(below), bool(above)], label=label)


def _draw_image(axes: Axes, array: NDArray[Any], **colours: Any) -> AxesImage:  # noqa: ANN401  (imshow's own)
    # A cell is a whole number of pixels, or smaller than a pixel: then they are averaged.
    larger_than_pixel = axes.get_window_extent().width > 0.99 * array.shape[1]
    return axes.imshow(
        array,
        extent=(*axes.get_xlim(), *axes.get_ylim()),
        origin="lower",
        aspect="equal",
        interpolation="nearest" if larger_than_pixel else "auto",
        **colours,
    )
