"""Color scales and cells of maps, and legends that explain them.

Dark colors mean poor coverage. In a difference blue means better, red means worse. Unobserved cells are hatched, and
show through cells with little visible surface.
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
    Sheet,
    create_sheets,
    find_lower_left,
    fit_paper,
    write_heading,
    write_legend,
    write_title,
)

UNOBSERVED_STYLE: dict[str, Any] = {"facecolor": "#c4c4c4", "edgecolor": "#b2b2b2", "hatch": "////"}
INFINITE_COLOR = "#d55e00"
UNOBSERVED = "unobserved"


@dataclass(frozen=True)
class ColorScale:
    """Mapping from numbers to colors.

    Args:
        quantity: Measured quantity, for the color bar.
        unit: Its unit, for the color bar.
        colormap: Name of a matplotlib colormap.
        low: Value of the first color.
        high: Value of the last color. Values beyond an end have its color, and the color bar shows their share.
        logarithmic: Whether colors are uniform in the logarithm of the value.

    Raises:
        ValueError: `low` is not below `high`, one of them is not finite, or `low` of a logarithmic scale is not
            positive.

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
            raise ValueError(f"low, high: got {self.low} and {self.high}; a color scale needs finite low < high")
        if self.logarithmic and not self.low > 0:
            raise ValueError(f"low: got {self.low}; a logarithmic color scale needs low > 0")

    @property
    def label(self) -> str:
        """Quantity and unit."""
        return f"{self.quantity} ({self.unit})"


def build_color_scale(quantity: Quantity, values: Tensor) -> ColorScale:
    """Build the color scale of a quantity: shares from 0 to 100 %, others from 0 to the 98th percentile.

    Args:
        quantity: Quantity; dark colors are its worse end.
        values: Values of all maps that share the scale, of any shape, in the shown unit. NaN is ignored.

    Example:
        >>> import torch
        >>> from torchcover.coverage.quantities import RADIUS
        >>> build_color_scale(RADIUS, torch.tensor([0.5, 2.04])).label
        'mean blind spot radius (m)'
    """
    unit = get_display_unit(quantity.unit)
    colormap = "viridis_r" if quantity.lower_is_better else "viridis"
    high = unit.max_value if math.isfinite(unit.max_value) else _find_robust_end(values)
    return ColorScale(quantity.title, unit.name, colormap, 0.0, high)


def build_difference_scale(quantity: Quantity, differences: Tensor) -> ColorScale:
    """Build the color scale of differences: white is 0, blue better, red worse, up to the 98th percentile of the size.

    Args:
        quantity: Quantity of the difference.
        differences: Differences of all maps that share the scale, of any shape, in the shown unit.
    """
    end = _find_robust_end(differences.abs())
    colormap = "RdBu_r" if quantity.lower_is_better else "RdBu"
    unit = get_display_unit(quantity.unit).difference_name
    return ColorScale(f"difference, {quantity.title}", unit, colormap, -end, end)


def _find_robust_end(values: Tensor) -> float:
    """Return the 98th percentile of finite values, since a few cells behind obstacles must not dominate the colors."""
    array = values.cpu().numpy()
    finite = array[np.isfinite(array)]
    high = float(np.percentile(finite, 98) or finite.max()) if len(finite) else 0.0
    return _round_up(high) or 1.0


def _round_up(value: float) -> float:
    """Round up to two digits, for a short label of the color bar."""
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
    infinite_color: str = INFINITE_COLOR,
) -> AxesImage:
    """Plot colored cells over the limits of the axes; NaN is hatched gray, infinity has its own color.

    Args:
        axes: Axes of a map.
        array: (Y, X) values.
        scale: Color scale.
        opacity: (Y, X) opacity in [0, 1]; None for opaque cells.
        infinite_color: Color of infinity.

    Returns:
        The image, for the color bar.
    """
    # matplotlib holds several copies of all pixels, half as large as in float64.
    array, opacity = array.astype(np.float32), None if opacity is None else opacity.astype(np.float32)
    # Unobserved cells are holes through which the background of the axes shows.
    axes.patch.set(**UNOBSERVED_STYLE, linewidth=0)
    norm = (LogNorm if scale.logarithmic else Normalize)(scale.low, scale.high)
    image = _plot_image(axes, np.ma.masked_invalid(array), alpha=opacity, cmap=scale.colormap, norm=norm)
    is_infinite = np.isinf(array)
    if is_infinite.any():
        masked = np.ma.masked_where(~is_infinite, is_infinite)
        _plot_image(axes, masked, alpha=opacity, cmap=ListedColormap([infinite_color]))
    return image


def build_cell_legend(array: NDArray[np.float64], unobserved_label: str = UNOBSERVED) -> list[Artist]:
    """Build the legend entries of cells that have no color of the scale.

    Args:
        array: Values of one map, or of several; NaN is unobserved.
        unobserved_label: Label of unobserved cells.
    """
    unobserved_share = format_percent(float(np.isnan(array).mean()))
    entries: list[Artist] = [Patch(label=f"{unobserved_label} ({unobserved_share} % of the cells)", **UNOBSERVED_STYLE)]
    is_infinite = np.isinf(array)
    if is_infinite.any():
        share = format_percent(float(is_infinite.mean()))
        label = f"infinite: no sensor points in some frame ({share} % of the cells)"
        entries.append(Patch(facecolor=INFINITE_COLOR, label=label))
    return entries


def plot_color_bar(sheet: Sheet, image: AxesImage, array: NDArray[np.float64], scale: ColorScale) -> None:
    """Plot the color bar with quantity and unit, and with the share of values beyond its ends.

    Args:
        sheet: Sheet of a map; maps that share the color bar are next to each other.
        image: Result of `plot_cells`.
        array: Values of all maps.
        scale: Color scale.
    """
    finite = array[np.isfinite(array)]
    tolerance = 1e-6 * (scale.high - scale.low)
    below_count, above_count = (finite < scale.low - tolerance).sum(), (finite > scale.high + tolerance).sum()
    extensions = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}
    extend = extensions[bool(below_count), bool(above_count)]
    label = scale.label
    if below_count + above_count:
        share = format_percent(float((below_count + above_count) / len(finite)))
        label += f"\n{share} % of the observed cells lie beyond"
    sheet.figure.colorbar(image, cax=sheet.color_bar_axes, extend=extend, label=label)


def _plot_image(axes: Axes, array: NDArray[Any], **options: Any) -> AxesImage:  # noqa: ANN401  (options of imshow)
    """Plot an array over the limits of the axes; only cells below pixel size are averaged."""
    # A cell is a whole number of pixels, or smaller than a pixel: then they are averaged.
    is_larger_than_pixel = axes.get_window_extent().width > 0.99 * array.shape[1]
    return axes.imshow(
        array,
        extent=(*axes.get_xlim(), *axes.get_ylim()),
        origin="lower",
        aspect="equal",
        interpolation="nearest" if is_larger_than_pixel else "antialiased",
        interpolation_stage="data" if is_larger_than_pixel else None,  # colors of all pixels need 80 MB
        **options,
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
    unobserved_label: str = UNOBSERVED,
    opacity: Mapping[str, Tensor] | None = None,
) -> Figure:
    """Plot arrays over one grid in bird's-eye view with one color bar: x forward to the right, y left upwards.

    Args:
        values: Heading, which may be empty -> (Y, X) numbers in the unit of `scale`. NaN is hatched gray, infinity has
            its own color.
        grid: Grid of the cells.
        scale: Color scale of all arrays.
        title: First line.
        subtitle: Second line, smaller.
        ego_outline_m: (K, 2) corners x, y of the ego vehicle in the vehicle frame in meters.
        sensors: Heading -> sensors to plot.
        show_directions: Whether to plot directions and fields of view of the sensors, not only their positions.
        unobserved_label: Label of unobserved cells in the legend.
        opacity: Heading -> (Y, X) in [0, 1], less where less surface is visible in a frame; None for opaque cells.

    Returns:
        A new figure outside pyplot, for `figure.savefig(path)` or a logger.

    Raises:
        ValueError: An array or the outline has another shape.

    Example:
        >>> import torch
        >>> grid = BevGrid(x_m=(0.0, 2.0), y_m=(-1.0, 1.0), cell_m=1.0)
        >>> change = torch.tensor([[0.5, -0.5], [float("nan"), 0.0]])
        >>> scale = ColorScale("change of the blind spot radius", "m", "PuOr", -1.0, 1.0)
        >>> plot_side_by_side({"": change}, grid, scale, title="Rig B against rig A").axes[0].get_xlabel()
        'x forward (m)'
    """
    opacity = opacity or {}
    for name, tensors in (("values", values), ("opacity", opacity)):
        for tensor in tensors.values():
            if tuple(tensor.shape) != grid.shape[1:]:
                raise ValueError(f"{name}: got shape {tuple(tensor.shape)}; give that of a band, {grid.shape[1:]}")
    arrays = {name: to_array(value) for name, value in values.items()}
    sheets = create_sheets(grid, len(arrays))
    images = []
    for sheet, (name, array) in zip(sheets, arrays.items(), strict=True):
        cell_opacity = to_array(opacity[name]) if name in opacity else None
        images.append(plot_cells(sheet.axes, array, scale, opacity=cell_opacity))
    stacked = np.stack(list(arrays.values()))
    plot_color_bar(sheets[0], images[0], stacked, scale)
    entries = build_cell_legend(stacked, unobserved_label)
    if opacity:  # a line of text without a symbol, since it concerns all colors
        label = "paler: less visible surface per frame than open ground"
        entries.append(Line2D([], [], linestyle="none", label=label))
    for sheet, name in zip(sheets, values, strict=True):
        if name:
            write_heading(sheet.axes, name)
        if ego_outline_m is not None:
            entries += plot_ego(sheet.axes, ego_outline_m)
        views = (sensors or {}).get(name, ())
        if show_directions:
            entries += plot_sensors(sheet, views, show_names=not name)
        else:
            entries += plot_sensor_positions(sheet, views)
    write_title(sheets[0].axes, title, subtitle, has_heading=any(arrays))
    write_legend(find_lower_left(sheet.axes for sheet in sheets), entries, sheets[0].legend_columns)
    fit_paper(sheets[0].figure)
    return sheets[0].figure


def to_array(values: Tensor) -> NDArray[np.float64]:
    """Convert numbers of cells for matplotlib.

    Args:
        values: Tensor on any device.

    Returns:
        float64 array of the same shape.
    """
    return values.detach().cpu().double().numpy()
