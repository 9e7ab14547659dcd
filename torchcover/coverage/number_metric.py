"""One number of the coverage as a metric of its own."""

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
    """One number of `Coverage.summary`, for torchmetrics' `MetricTracker`, which wants one and its better direction.

    Of detection more is better, of the radius less. In a `MetricCollection`, numbers with the same `grid` and options
    share their sums: each step is measured once.

    Args:
        quantity_key: "radius_m", or "detection_0.4m" with one of the thresholds.
        region: Where.
        band: Name of the band.
        grid: As in `CoverageMetric`, and so are the others.
        thresholds: Detection thresholds in metres.
        options: `max_radius`, `square_metres`, ...

    Raises:
        ValueError: No such quantity or band, a region that the grid does not hold, or as `CoverageMetric`.

    Example:
        >>> import torch
        >>> from torchmetrics.wrappers import MetricTracker
        >>> near = Region("near", x_m=(0.0, 2.0), y_m=(0.0, 1.0))
        >>> tracker = MetricTracker(CoverageNumberMetric("radius_m", near, "ground", BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0))))
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
        **options: Any,  # noqa: ANN401  (whatever CoverageMetric takes)
    ) -> None:
        super().__init__(grid, thresholds_m, **options)
        check_regions([region], grid)
        quantities = MeanOfMeans(self.thresholds_m).quantities
        keys = [known.key for known in quantities]
        for name, given, there in (("quantity", quantity_key, keys), ("height", band, list(grid.heights))):
            if given not in there:
                raise ValueError(f"{name}: one of {', '.join(there)} is needed; got {given!r}")
        self.quantity_key = quantities[keys.index(quantity_key)]
        self.region = region
        self.band = band

    @property
    def higher_is_better(self) -> bool:  # type: ignore[override]  # a constant of the class, in torchmetrics
        """Whether more of it is better."""
        return not self.quantity_key.lower_is_better

    def compute(self) -> Tensor:  # type: ignore[override]  # the sums are those of its parent, what comes out is not
        """() float64 the number so far, in metres or as a share; NaN where it is unknown."""
        coverage = super().compute()
        return coverage.estimate(self.region, self.band).value[coverage.quantities.index(self.quantity_key)]

    def plot(  # type: ignore[override]
        self, val: Tensor | Sequence[Tensor] | None = None, ax: "Axes | None" = None
    ) -> "tuple[Figure, Axes]":
        """Draw the number, or several of them in a row, as torchmetrics does.

        Args:
            val: What `compute` or `forward` returned, once or several times; the number so far if not given.
            ax: Where to; a new figure of pyplot's if not given.
        """
        fig, ax = get_figure(ax)
        self._plot(val, ax)
        return fig, ax
