"""Map of one layer on matplotlib axes, for `CoverageMetric.plot`; maps of whole runs are in `torchcover.report`."""

from typing import TYPE_CHECKING

import numpy as np

from torchcover.coverage.quantities import make_area_quantity
from torchcover.coverage.result import Coverage

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def plot_coverage(coverage: object, ax: "Axes", quantity_key: str | None, band: str | None) -> None:
    """Plot one layer in one height band in bird's-eye view: x to the right, y up, the vehicle at the origin.

    Dark cells are blind, gray cells unobserved. Values beyond the color scale, such as an infinite radius, have its
    last color.

    Args:
        coverage: Result of a `CoverageMetric`.
        ax: Axes to plot on.
        quantity_key: Key of the layer; by default the detection at the first threshold, or the radius without
            thresholds, by area if the result is.
        band: Name of the height band; by default the first.

    Raises:
        TypeError: `coverage` is not a single `Coverage`.
        ValueError: The layer or the band does not exist.
    """
    if not isinstance(coverage, Coverage):
        raise TypeError(f"val: one Coverage, as compute() returns it, is needed; got {type(coverage).__name__}")
    bands = list(coverage.grid.heights)
    if quantity_key is None:
        quantity = coverage.quantities[min(1, len(coverage.thresholds_m))]
        quantity_key = (quantity if coverage.average == "cells" else make_area_quantity(quantity)).key
    if quantity_key not in coverage.layers:
        raise ValueError(f"layer: one of {', '.join(coverage.layers)} is needed; got {quantity_key!r}")
    if band is None:
        band = bands[0]
    if band not in bands:
        raise ValueError(f"height: one of {', '.join(bands)} is needed; got {band!r}")
    layer = coverage.layers[quantity_key]
    quantity, values = layer.quantity, layer.values[bands.index(band)].cpu().numpy()
    finite = values[np.isfinite(values)]
    vmax = 1.0
    if quantity.unit == "m" and len(finite):
        # The largest 2 % lie in a few cells far behind obstacles, and would compress the color scale.
        vmax = float(np.percentile(finite, 98)) or 1.0
    values = np.where(np.isinf(values), 2 * vmax, values)  # matplotlib would treat infinite cells as unobserved
    (x_low, x_high), (y_low, y_high) = coverage.grid.x_m, coverage.grid.y_m
    _, rows, columns = coverage.grid.shape
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
        title=f"{quantity.title}, {band}, {coverage.counts['num_frames']} frames (gray: unobserved)",
    )
    label = f"{quantity.title} (m)" if quantity.unit == "m" else quantity.title
    ax.figure.colorbar(mesh, ax=ax, label=label, shrink=0.7, extend="max" if (values > vmax).any() else "neither")
