"""Metric with one number of the coverage as its result."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from torch import Tensor

from torchcover.coverage.aggregations import MeanOfMeans
from torchcover.coverage.grid import BevGrid
from torchcover.coverage.metric import CoverageMetric
from torchcover.coverage.regions import Region, check_regions
from torchcover.metrics import get_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class CoverageNumberMetric(CoverageMetric):
    """One number of `Coverage.summary`, for `torchmetrics.MetricTracker`, which needs a scalar and its direction.

    Higher is better for detection rates, lower for the radius. In a `MetricCollection`, numbers with the same `grid`
    and options share their sums, so that each frame is measured once.

    Args:
        quantity_key: "radius_m", or "detection_0.4m" with one of the thresholds.
        region: Region within the grid.
        band: Name of the height band.
        grid: As in `CoverageMetric`.
        thresholds_m: Detection thresholds in meters.
        options: Further arguments of `CoverageMetric`, such as `max_radius_m` or `has_area_weights`.

    Raises:
        ValueError: The quantity or band does not exist, the region reaches beyond the grid, or as in `CoverageMetric`.

    Example:
        >>> import torch
        >>> from torchmetrics.wrappers import MetricTracker
        >>> near = Region("near", x_m=(0.0, 2.0), y_m=(0.0, 1.0))
        >>> grid = BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0))
        >>> tracker = MetricTracker(CoverageNumberMetric("radius_m", near, "ground", grid))
        >>> for x_m in (1.0, 0.5, 1.5):
        ...     tracker.increment()
        ...     tracker.update(torch.zeros(1, 3), torch.tensor([[x_m, 0.0, 0.0]]))
        >>> tracker.best_metric(return_step=True)
        (0.5, 1)
    """

    def __init__(
        self,
        quantity_key: str,
        region: Region,
        band: str,
        grid: BevGrid,
        thresholds_m: Sequence[float] = (0.4,),
        **options: Any,  # noqa: ANN401  (arguments of CoverageMetric)
    ) -> None:
        super().__init__(grid, thresholds_m, **options)
        check_regions([region], grid)
        quantities = {quantity.key: quantity for quantity in MeanOfMeans(self.thresholds_m).quantities}
        if quantity_key not in quantities:
            raise ValueError(f"quantity: one of {', '.join(quantities)} is needed; got {quantity_key!r}")
        grid.get_band_index(band)  # raises for an unknown band
        self.quantity = quantities[quantity_key]
        self.region = region
        self.band = band

    @property
    def higher_is_better(self) -> bool:  # type: ignore[override]  # a constant of the class in torchmetrics
        """Direction of improvement of the number."""
        return not self.quantity.lower_is_better

    def compute(self) -> Tensor:  # type: ignore[override]  # another result from the sums of the base class
        """Compute the number over all frames: () float64 in meters or as a share; NaN if unknown."""
        coverage = super().compute()
        return coverage.estimate(self.region, self.band).value[coverage.quantities.index(self.quantity)]

    def plot(  # type: ignore[override]
        self, val: Tensor | Sequence[Tensor] | None = None, ax: "Axes | None" = None
    ) -> "tuple[Figure, Axes]":
        """Plot the number, or a sequence of numbers, as torchmetrics does.

        Args:
            val: Results of `compute` or `forward`; by default the current number.
            ax: Axes; by default those of a new pyplot figure.
        """
        fig, ax = get_figure(ax)
        self._plot(val, ax)
        return fig, ax
