"""Colour scales: how the numbers of a map become colours.

Dark means blind. In a difference blue means better, red means worse.
"""

import math
from dataclasses import dataclass

import numpy as np
from torch import Tensor

# A few cells far behind an obstacle must not take the colours away from all others.
ROBUST_PERCENTILE = 98


@dataclass(frozen=True)
class ColourScale:
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
        >>> ColourScale("change of the blind spot radius", "m", "PuOr", -1.0, 1.0).label
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


def radius_scale(quantity: str, radius: Tensor) -> ColourScale:
    """Scale for blind spot radii, from 0 to the 98th percentile of the known, finite ones.

    Args:
        quantity: What is measured, for the colour bar.
        radius: Radii in metres, any shape: those of every map that shall be compared by eye. NaN is unknown.
    """
    return ColourScale(quantity, "m", "viridis_r", 0.0, _robust_end(radius))


def detection_scale(quantity: str) -> ColourScale:
    """Scale for detection probabilities in percent, always from 0 to 100."""
    return ColourScale(quantity, "%", "viridis", 0.0, 100.0)


def difference_scale(scale: ColourScale, difference: Tensor, *, lower_is_better: bool) -> ColourScale:
    """Scale for differences: white is none, blue is better, red is worse, both to the 98th percentile of the size.

    Args:
        scale: That of the quantity itself.
        difference: Differences, any shape: those of every map that shall be compared by eye. NaN is unknown.
        lower_is_better: Whether a negative difference is an improvement.
    """
    end = _robust_end(difference.abs())
    colormap = "RdBu_r" if lower_is_better else "RdBu"
    unit = "percentage points" if scale.unit == "%" else scale.unit
    return ColourScale(f"difference, {scale.quantity}", unit, colormap, -end, end)


def _robust_end(values: Tensor) -> float:
    known = values[values.isfinite()].cpu().numpy()
    high = float(np.percentile(known, ROBUST_PERCENTILE) or known.max()) if len(known) else 0.0
    return _round_up(high) or 1.0


def _round_up(value: float) -> float:
    """To two digits, so that the end of the colour bar is a number one can say."""
    if value <= 0:
        return 0.0
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / step - 1e-9) * step:.2g}")
