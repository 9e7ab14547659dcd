"""The coverage metric: the sums of coverage as a metric of torchmetrics."""

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from torchcover.coverage.plotting import plot_coverage
from torchcover.coverage.result import Coverage
from torchcover.coverage.steps import Clouds, SensorClouds, to_list
from torchcover.coverage.sums import CoverageSums
from torchcover.metrics import MergeableMetric, get_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# With a larger share of the reference points, and of as many at least, in no cell, the clouds are probably in another
# frame.
MOST_OUTSIDE = 0.9
MIN_POINTS = 1000


class CoverageMetric(MergeableMetric, CoverageSums):
    """`CoverageSums` as a metric of torchmetrics: added up over ranks when `compute` is called.

    It takes what these take, and arguments of `torchmetrics.Metric` (`sync_on_compute`, `dist_sync_fn`, ...).

    Example:
        >>> import torch
        >>> from torchcover import BevGrid
        >>> metric = CoverageMetric(BevGrid(x=(0.0, 2.0), y=(0.0, 1.0), cell=1.0, heights={"all": (-1.0, 1.0)}))
        >>> metric.update(sensor=torch.zeros(1, 3), reference=torch.tensor([[0.3, 0.0, 0.0], [0.5, 0.0, 0.0]]))
        >>> metric.compute().radius
        tensor([[[0.4000,    nan]]], dtype=torch.float64)
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:  # noqa: ANN401  (of `CoverageSums`)
        super().__init__(*args, **kwargs)
        self._is_updated, self._warnings = False, set[str]()

    def update(
        self,
        sensor: SensorClouds,
        reference: Clouds,
        *,
        weights: Clouds | None = None,
        heights_m: Clouds | None = None,
        block_index: int | Sequence[int] | None = None,
        errors_m: Clouds | None = None,
    ) -> None:
        """Add steps as `CoverageSums.update` does, which says what it takes and refuses.

        Warns:
            UserWarning: Once, of square metres that the metric does not average over.
        """
        given = {"weights": weights, "heights_m": heights_m, "block_index": block_index, "errors_m": errors_m}
        CoverageSums.update(self, sensor, reference, **given)  # type: ignore[arg-type]  # each of its own type
        self._is_updated = True
        if weights is not None and len(weights) and not self.has_area_weights:
            self._warn_once(
                "weights",
                "square metres were given, but this metric averages over cells; square_metres=True makes it average "
                "over area, too",
            )

    def forward(self, sensor: SensorClouds, reference: Clouds, **options: Any) -> Coverage:  # noqa: ANN401
        """Add steps as `update` does, which takes the same, and return the coverage of these steps alone."""
        if options.get("block_index") is None:  # torchmetrics adds steps to an empty state: counting would start at 0
            steps = range(len(to_list(reference, "reference")))
            options["block_index"] = [int(self.num_frames) + step for step in steps]
        return super().forward(sensor, reference, **options)  # type: ignore[no-any-return]

    def compute(self) -> Coverage:
        """The coverage so far. Cells that no reference point ever probed are NaN with count 0.

        Warns:
            UserWarning: Once, if nearly all reference points that `update` was given are in no cell.
        """
        inside, outside = int(self.inside_points), int(self.outside_points)
        if self._is_updated and outside > MOST_OUTSIDE * max(inside + outside, MIN_POINTS):
            self._warn_once(
                "reference",
                f"{outside:,} of {inside + outside:,} points lie outside the grid or in no height band; are the clouds "
                "in the vehicle frame (z = 0 on the ground), not that of a sensor?",
            )
        return CoverageSums.compute(self)

    def _warn_once(self, subject: str, message: str) -> None:
        if subject not in self._warnings:
            self._warnings.add(subject)
            warnings.warn(f"{subject}: {message}", stacklevel=3)

    def plot(
        self,
        val: Coverage | None = None,
        ax: "Axes | None" = None,
        *,
        quantity_key: str | None = None,
        band: str | None = None,
    ) -> "tuple[Figure, Axes]":
        """Draw one layer in one height band, seen from above, as `torchcover.coverage.plotting.plot_coverage` does.

        Args:
            val: What `compute` or `forward` returned; the coverage so far if not given.
            ax: Where to; a new figure of pyplot's if not given.
            quantity_key: A key of `Coverage.layers`; the detection at the first threshold if not given.
            band: Name of the band; the first if not given.
        """
        fig, ax = get_figure(ax)
        plot_coverage(self.compute() if val is None else val, ax, quantity_key, band)
        return fig, ax
