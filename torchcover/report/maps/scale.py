"""Colour scales: how the numbers of a map become colours.

Dark means blind. In a difference blue means better, red means worse.
"""

import math
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from torchcover.coverage import Quantity
from torchcover.report.units import UNITS

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


def scale_of(quantity: Quantity, values: Tensor) -> ColourScale:
    """Scale for a quantity as it is shown: shares from 0 to 100 %, others from 0 to the 98th percentile of the known.

    Args:
        quantity: What is shown; dark is the worse end.
        values: Any shape, in the unit that is shown: those of every map that shall be compared by eye. NaN is unknown.

    Example:
        >>> import torch
        >>> from torchcover.coverage.quantity import RADIUS
        >>> scale_of(RADIUS, torch.tensor([0.5, 2.04])).label
        'mean blind spot radius (m)'
    """
    unit = UNITS[quantity.unit]
    colormap = "viridis_r" if quantity.lower_is_better else "viridis"
    high = unit.highest if math.isfinite(unit.highest) else _robust_end(values)
    return ColourScale(quantity.title, unit.name, colormap, 0.0, high)


def error_scale(quantity: Quantity, errors: Tensor) -> ColourScale:
    """Scale for standard errors, from 0 to the 98th percentile of the known; as `scale_of`."""
    unit = UNITS[quantity.unit].difference_name
    return ColourScale(quantity.title, unit, "viridis_r", 0.0, _robust_end(errors))


def difference_scale(quantity: Quantity, differences: Tensor) -> ColourScale:
    """Scale for differences: white is none, blue is better, red is worse, both to the 98th percentile of the size.

    Args:
        quantity: What differs.
        differences: As in `scale_of`.
    """
    end = _robust_end(differences.abs())
    colormap = "RdBu_r" if quantity.lower_is_better else "RdBu"
    return ColourScale(f"difference, {quantity.title}", UNITS[quantity.unit].difference_name, colormap, -end, end)


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
