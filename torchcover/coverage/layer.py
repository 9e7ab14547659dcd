"""A layer of a result: one quantity over the grid."""

from typing import NamedTuple

from torch import Tensor

from torchcover.estimation import Quantity


class Layer(NamedTuple):
    """One quantity over the grid.

    Args:
        quantity: What the values are.
        values: (H, Y, X) float64 in the quantity's unit, or (C,) before it has the shape of the grid; NaN in a
            cell that no reference point ever probed.
    """

    quantity: Quantity
    values: Tensor
