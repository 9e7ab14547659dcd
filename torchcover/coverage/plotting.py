"""One map of a result on matplotlib's axes, for `CoverageMetric.plot`; the maps of a whole run are in `report`."""

from typing import TYPE_CHECKING

import numpy as np

from torchcover.coverage.quantities import make_area_quantity
from torchcover.coverage.result import Coverage

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# A few cells far behind an obstacle must not take the colours away from all others.
ROBUST_PERCENTILE = 98


def plot_coverage(coverage: object, ax: "Axes", quantity_key: str | None, band: str | None) -> None:
    """Draw one layer in one height band, seen from above: x forward to the right, y left upwards, the vehicle at 0, 0.

    Dark is blind, grey is unknown; what is beyond the colours, such as an infinite radius, has the last one. If not
    given, the layer is the detection at the first threshold, or the radius if there is none, by area where the points
    have square metres; the band is the first.
    """
    if not isinstance(coverage, Coverage):
        raise TypeError(f"val: one Coverage, as compute() returns it, is needed; got {type(coverage).__name__}")
    bands = list(coverage.grid.heights)
    first = coverage.quantities[min(1, len(coverage.thresholds_m))]
    first = first if coverage.average == "cells" else make_area_quantity(first)
    key = first.key if quantity_key is None else quantity_key
    band_name = bands[0] if band is None else band
    for name, given, there in (("layer", key, list(coverage.layers)), ("height", band_name, bands)):
        if given not in there:
            raise ValueError(f"{name}: one of {', '.join(there)} is needed; got {given!r}")
    quantity, values = coverage.layers[key].quantity, coverage.layers[key].values[bands.index(band_name)].cpu().numpy()
    finite = values[np.isfinite(values)]
    highest = (float(np.percentile(finite, ROBUST_PERCENTILE)) if quantity.unit == "m" and len(finite) else 0.0) or 1.0
    values = np.where(np.isinf(values), 2 * highest, values)  # what is infinite matplotlib would leave out, as unknown
    (x_low, x_high), (y_low, y_high) = coverage.grid.x_m, coverage.grid.y_m
    _, rows, columns = coverage.grid.shape
    mesh = ax.pcolormesh(
        np.linspace(x_low, x_high, columns + 1),
        np.linspace(y_low, y_high, rows + 1),
        np.ma.masked_where(np.isnan(values), values),
        cmap="viridis_r" if quantity.lower_is_better else "viridis",
        vmin=0.0,
        vmax=highest,
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
        title=f"{quantity.title}, {band_name}, {coverage.counts['num_frames']} steps (grey: unknown)",
    )
    label = f"{quantity.title} (m)" if quantity.unit == "m" else quantity.title
    ax.figure.colorbar(mesh, ax=ax, label=label, shrink=0.7, extend="max" if (values > highest).any() else "neither")
