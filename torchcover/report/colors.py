"""Colours: how the numbers of a map become colours, and what says what they mean.

Dark means blind. In a difference blue means better, red means worse. Unknown cells are hatched, and show through those
where little surface is seen.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.coverage import BevGrid
from torchcover.estimation import Quantity
from torchcover.report.number_format import format_percent, get_display_unit
from torchcover.report.overlay import SensorView, plot_ego, plot_sensor_positions, plot_sensors
from torchcover.report.plot_layout import (
    HEADING_POINTS,
    Sheet,
    create_sheets,
    find_lower_left,
    fit_paper,
    write_heading,
    write_legend,
    write_title,
)

# A few cells far behind an obstacle must not take the colours away from all others.
ROBUST_PERCENTILE = 98
UNKNOWN: dict[str, Any] = {"facecolor": "#c4c4c4", "edgecolor": "#b2b2b2", "hatch": "////"}
INFINITE = "#d55e00"
NEVER_PROBED = "never probed"
PALER = "paler: less visible surface in a step than open ground has"


@dataclass(frozen=True)
class ColorScale:
    """What a colour says.

    Args:
        quantity: What is measured, for the colour bar.
        unit: Its unit, for the colour bar.
        colormap: Name of a matplotlib colour map.
        low: Value of the first colour.
        high: Value of the last colour. Values beyond either end keep its colour, and the colour bar says so.
        logarithmic: Whether equal ratios, rather than equal differences, are equally far apart in colour.

    Raises:
        ValueError: `low` is not below `high`, or one of them is not finite; a logarithmic scale that does not begin
            above 0.

    Example:
        >>> ColorScale("change of the blind spot radius", "m", "PuOr", -1.0, 1.0).label
        'change of the blind spot radius (m)'
    """

    quantity: str
    unit: str
    colormap: str
    low: float
    high: float
    logarithmic: bool = False

    def __post_init__(self) -> None:
        if not (-math.inf < self.low < self.high < math.inf):
            raise ValueError(f"a colour scale needs finite low < high; got {self.low} and {self.high}")
        if self.logarithmic and not self.low > 0:
            raise ValueError(f"a logarithmic colour scale needs low > 0; got {self.low}")

    @property
    def label(self) -> str:
        """Quantity and unit."""
        return f"{self.quantity} ({self.unit})"


def build_color_scale(quantity: Quantity, values: Tensor) -> ColorScale:
    """Scale for a quantity as it is shown: shares from 0 to 100 %, others from 0 to the 98th percentile of the known.

    Args:
        quantity: What is shown; dark is the worse end.
        values: Any shape, in the unit that is shown: those of every map that shall be compared by eye. NaN is unknown.

    Example:
        >>> import torch
        >>> from torchcover.coverage.quantity import RADIUS
        >>> build_color_scale(RADIUS, torch.tensor([0.5, 2.04])).label
        'mean blind spot radius (m)'
    """
    unit = get_display_unit(quantity.unit)
    colormap = "viridis_r" if quantity.lower_is_better else "viridis"
    high = unit.max_value if math.isfinite(unit.max_value) else _robust_end(values)
    return ColorScale(quantity.title, unit.name, colormap, 0.0, high)


def build_difference_scale(quantity: Quantity, differences: Tensor) -> ColorScale:
    """Scale for differences: white is none, blue is better, red is worse, both to the 98th percentile of the size."""
    end = _robust_end(differences.abs())
    colormap = "RdBu_r" if quantity.lower_is_better else "RdBu"
    return ColorScale(
        f"difference, {quantity.title}", get_display_unit(quantity.unit).difference_name, colormap, -end, end
    )


def _robust_end(values: Tensor) -> float:
    each = values.cpu().numpy()
    known = each[np.isfinite(each)]
    high = float(np.percentile(known, ROBUST_PERCENTILE) or known.max()) if len(known) else 0.0
    return _round_up(high) or 1.0


def _round_up(value: float) -> float:
    """To two digits, so that the end of the colour bar is a number one can say."""
    if value <= 0:
        return 0.0
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / step - 1e-9) * step:.2g}")


def plot_cells(
    axes: Axes,
    array: NDArray[np.float64],
    scale: ColorScale,
    *,
    opacity: NDArray[np.float64] | None = None,
    infinite_color: str = INFINITE,
) -> AxesImage:
    """Colour (Y, X) cells; unknown ones, NaN, are hatched grey, infinite ones have a colour of their own.

    The axes have the grid's bounds as limits. Cells are opaque but for an `opacity` from 0 to 1 of each. Returns the
    image, for the colour bar.
    """
    # Each is drawn with several copies of all pixels, half as large as in float64.
    array, opacity = array.astype(np.float32), None if opacity is None else opacity.astype(np.float32)
    # Unknown cells are holes through which the ground of the axes shows.
    axes.patch.set(**UNKNOWN, linewidth=0)
    norm = (LogNorm if scale.logarithmic else Normalize)(scale.low, scale.high)
    image = _draw_image(axes, np.ma.masked_invalid(array), alpha=opacity, cmap=scale.colormap, norm=norm)
    endless = np.isinf(array)
    if endless.any():
        _draw_image(axes, np.ma.masked_where(~endless, endless), alpha=opacity, cmap=ListedColormap([infinite_color]))
    return image


def build_cell_legend(array: NDArray[np.float64], unobserved_label: str = NEVER_PROBED) -> list[Artist]:
    """The legend entries for cells without a colour of the scale.

    `array`: values of one map, or of several, NaN where unknown; `unobserved_label`: why they are.
    """
    unknown_share = format_percent(float(np.isnan(array).mean()))
    entries: list[Artist] = [Patch(label=f"unknown: {unobserved_label} ({unknown_share} % of the cells)", **UNKNOWN)]
    infinite = np.isinf(array)
    if infinite.any():
        label = f"infinite: a step saw nothing ({format_percent(float(infinite.mean()))} % of the cells)"
        entries.append(Patch(facecolor=INFINITE, label=label))
    return entries


def plot_color_bar(sheet: Sheet, image: AxesImage, array: NDArray[np.float64], scale: ColorScale) -> None:
    """Draw the colour bar with quantity and unit; if values lie beyond an end, an arrow and how many there are.

    Maps that share it are beside each other on the sheet; `array` has the values of all.
    """
    known = array[np.isfinite(array)]
    rounding = 1e-6 * (scale.high - scale.low)
    below, above = (known < scale.low - rounding).sum(), (known > scale.high + rounding).sum()
    extend = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}
    label = scale.label
    if beyond := below + above:
        label += f"\n{format_percent(float(beyond / len(known)))} % of the known cells lie beyond"
    sheet.figure.colorbar(image, cax=sheet.color_bar_axes, extend=extend[bool(below), bool(above)], label=label)


def _draw_image(axes: Axes, array: NDArray[Any], **colours: Any) -> AxesImage:  # noqa: ANN401  (imshow's own)
    # A cell is a whole number of pixels, or smaller than a pixel: then they are averaged.
    larger_than_pixel = axes.get_window_extent().width > 0.99 * array.shape[1]
    return axes.imshow(
        array,
        extent=(*axes.get_xlim(), *axes.get_ylim()),
        origin="lower",
        aspect="equal",
        interpolation="nearest" if larger_than_pixel else "antialiased",
        interpolation_stage="data" if larger_than_pixel else None,  # colours of all pixels take 80 MB
        **colours,
    )


def plot_side_by_side(
    values: Mapping[str, Tensor],
    grid: BevGrid,
    scale: ColorScale,
    *,
    title: str,
    subtitle: str = "",
    ego_outline_m: NDArray[np.floating] | None = None,
    sensors: Mapping[str, Sequence[SensorView]] | None = None,
    show_directions: bool = True,
    unobserved_label: str = NEVER_PROBED,
    opacity: Mapping[str, Tensor] | None = None,
) -> Figure:
    """Draw arrays over one grid, seen from above, with one colour bar: x forward to the right, y left upwards.

    Args:
        values: (Y, X) numbers in the unit of `scale`, by their headings, which may be empty. NaN is unknown and drawn
            hatched grey; infinity has a colour of its own.
        grid: The cells.
        scale: What the colours of all of them mean.
        title: First line.
        subtitle: Second line, smaller.
        ego_outline_m: (K, 2) corners x, y of the ego in the vehicle frame in metres.
        sensors: What to mark, by the headings.
        show_directions: Whether to draw directions and fields of view; else the places of the sensors only.
        unobserved_label: Why a cell is, for the legend.
        opacity: (Y, X) in [0, 1] by the headings, less where less of the surface is seen in a step; all cells alike if
            not given.

    Returns:
        A figure of its own, outside pyplot: `figure.savefig(path)`, or hand it to a logger.

    Raises:
        ValueError: An array or the outline has another shape.

    Example:
        >>> import torch
        >>> grid = BevGrid(x=(0.0, 2.0), y=(-1.0, 1.0), cell=1.0)
        >>> change = torch.tensor([[0.5, -0.5], [float("nan"), 0.0]])
        >>> scale = ColorScale("change of the blind spot radius", "m", "PuOr", -1.0, 1.0)
        >>> plot_side_by_side({"": change}, grid, scale, title="Rig B against rig A").axes[0].get_xlabel()
        'x forward (m)'
    """
    for name, given in (("values", values), ("opacity", opacity or {})):
        for one in given.values():
            if tuple(one.shape) != grid.shape[1:]:
                wanted = f"shape {grid.shape[1:]} is needed, as of a band of the grid"
                raise ValueError(f"{name}: {wanted}; got {tuple(one.shape)}")
    arrays = {name: to_array(value) for name, value in values.items()}
    opaque = {name: to_array(value) for name, value in (opacity or {}).items()}
    sheets = create_sheets(grid, len(arrays))
    images = [
        plot_cells(sheet.axes, array, scale, opacity=opaque.get(name))
        for sheet, (name, array) in zip(sheets, arrays.items(), strict=True)
    ]
    together = np.stack(list(arrays.values()))
    plot_color_bar(sheets[0], images[0], together, scale)
    entries = build_cell_legend(together, unobserved_label)
    if opacity:
        entries.append(Line2D([], [], linestyle="none", label=PALER))  # words only, as it is about every colour
    for sheet, name in zip(sheets, values, strict=True):
        if name:
            write_heading(sheet.axes, name)
        if ego_outline_m is not None:
            entries += plot_ego(sheet.axes, ego_outline_m)
        own = (sensors or {}).get(name, ())
        entries += (
            plot_sensors(sheet, own, show_names=not name) if show_directions else plot_sensor_positions(sheet, own)
        )
    write_title(sheets[0].axes, title, subtitle, lift_points=HEADING_POINTS if any(arrays) else 0.0)
    write_legend(find_lower_left(sheet.axes for sheet in sheets), entries, sheets[0].legend_columns)
    fit_paper(sheets[0].figure)
    return sheets[0].figure


def to_array(values: Tensor) -> NDArray[np.float64]:
    """Numbers of cells as matplotlib takes them."""
    return values.detach().cpu().double().numpy()
