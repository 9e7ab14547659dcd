"""Where a metric's `plot` draws."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def figure_of(ax: "Axes | None") -> "tuple[Figure, Axes]":
    """The axes that a metric was given and their figure, or new ones of pyplot's, as torchmetrics has it."""
    if ax is None:
        import matplotlib.pyplot as plt

        return plt.subplots(layout="constrained")
    figure = ax.get_figure(root=True)
    assert figure is not None, "axes that were removed from their figure"
    return figure, ax
