"""Map of one layer on matplotlib axes, for `Coverage.plot`; maps of whole runs are in `torchcover.report`."""

from typing import TYPE_CHECKING

import numpy as np

from torchcover.coverage.aggregations import Layer
from torchcover.coverage.grid import BevGrid

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot_layer(ax: "Axes | None", layer: Layer, grid: BevGrid, band: str | None, num_frames: int) -> "Figure":
    """Plot one layer in one height band in bird's-eye view: x to the right, y up, the vehicle at the origin.

    Dark cells are blind, gray cells unobserved. Values beyond the color scale, such as an infinite radius, have its
    last color.

    Args:
        ax: Axes to plot on; None for a new figure that pyplot does not manage.
        layer: (H, Y, X) layer.
        grid: Cells and height bands.
        band: Name of the height band; None for the first.
        num_frames: Number of frames, for the title.
    """
    if ax is None:
        from matplotlib.figure import Figure

        ax = Figure(figsize=(9.0, 4.5), layout="constrained").subplots()
    band = next(iter(grid.heights)) if band is None else band
    quantity, values = layer.quantity, layer.values[grid.get_band_index(band)].cpu().numpy()
    finite = values[np.isfinite(values)]
    vmax = 1.0
    if quantity.unit == "m" and len(finite):
        # The largest 2 % lie in a few cells far behind obstacles, and would compress the color scale.
        vmax = float(np.percentile(finite, 98)) or 1.0
    values = np.where(np.isinf(values), 2 * vmax, values)  # matplotlib would treat infinite cells as unobserved
    (x_low, x_high), (y_low, y_high) = grid.x_m, grid.y_m
    _, rows, columns = grid.shape
    mesh = ax.pcolormesh(
        np.linspace(x_low, x_high, columns + 1),
        np.linspace(y_low, y_high, rows + 1),
        np.ma.masked_where(np.isnan(values), values),
        cmap="viridis_r" if quantity.lower_is_better else "viridis",
        vmin=0.0,
        vmax=vmax,
        rasterized=True,
    )
    ax.set_facecolor("#c4c4c4")
    ax.plot(0.0, 0.0, ">", color="#d55e00", markeredgecolor="white", markersize=9, clip_on=False)
    ax.set(
        xlim=(min(x_low, 0.0), max(x_high, 0.0)),
        ylim=(min(y_low, 0.0), max(y_high, 0.0)),
        aspect="equal",
        xlabel="x forward (m)",
        ylabel="y left (m)",
        title=f"{quantity.title}, {band}, {num_frames} frames (gray: unobserved)",
    )
    label = f"{quantity.title} (m)" if quantity.unit == "m" else quantity.title
    ax.figure.colorbar(mesh, ax=ax, label=label, shrink=0.7, extend="max" if (values > vmax).any() else "neither")
    return ax.figure  # type: ignore[return-value]  # the figure around a subfigure is not needed
