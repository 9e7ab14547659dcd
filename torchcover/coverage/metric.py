"""Coverage as a metric of torchmetrics."""

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from torchcover.coverage.frame_input import Clouds, SensorClouds, to_list
from torchcover.coverage.result import Coverage
from torchcover.coverage.sums import CoverageSums
from torchcover.metrics import MergeableMetric, get_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class CoverageMetric(MergeableMetric, CoverageSums):
    """`CoverageSums` as a metric of torchmetrics: `compute` adds up the sums of all ranks.

    Args:
        args: Arguments of `CoverageSums`.
        kwargs: Keyword arguments of `CoverageSums` and of `torchmetrics.Metric` (`sync_on_compute`, `dist_sync_fn`,
            ...).

    Example:
        >>> import torch
        >>> from torchcover import BevGrid
        >>> metric = CoverageMetric(BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0), cell_m=1.0, heights={"all": (-1.0, 1.0)}))
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
        """Add frames as `CoverageSums.update` does.

        Args:
            sensor: Points of the rig; see `CoverageSums.update` for details of all arguments.
            reference: Points of the reference sensor.
            weights: Area of each reference point in m2.
            heights_m: Height of each reference point above ground.
            block_index: Index of the frame in time.
            errors_m: Measurement error of each point of the rig.

        Raises:
            ValueError: As in `CoverageSums.update`.
            TypeError: As in `CoverageSums.update`.

        Warns:
            UserWarning: Once, if weights are passed that the metric does not average over.
        """
        options = {"weights": weights, "heights_m": heights_m, "block_index": block_index, "errors_m": errors_m}
        CoverageSums.update(self, sensor, reference, **options)  # type: ignore[arg-type]  # each of its own type
        self._is_updated = True
        if weights is not None and len(weights) and not self.has_area_weights:
            self._warn_once(
                "weights",
                "areas were passed, but this metric averages over cells; has_area_weights=True adds averages over area",
            )

    def forward(self, sensor: SensorClouds, reference: Clouds, **options: Any) -> Coverage:  # noqa: ANN401
        """Add frames and return the coverage of these frames alone.

        Args:
            sensor: As in `update`.
            reference: As in `update`.
            options: Further arguments of `update`.
        """
        if options.get("block_index") is None:  # torchmetrics adds frames to an empty state, which would count from 0
            num_new_frames = len(to_list(reference, "reference"))
            first = int(self.num_frames)
            options["block_index"] = list(range(first, first + num_new_frames))
        return super().forward(sensor, reference, **options)  # type: ignore[no-any-return]

    def compute(self) -> Coverage:
        """Compute the coverage over all added frames. Cells without any reference point are NaN with count 0.

        Warns:
            UserWarning: Once, if nearly all reference points lie in no cell.
        """
        num_inside, num_outside = int(self.inside_points), int(self.outside_points)
        # 90 % of the points in no cell, and at least 900 points, suggest clouds in another coordinate frame.
        if self._is_updated and num_outside > 0.9 * max(num_inside + num_outside, 1000):
            self._warn_once(
                "reference",
                f"{num_outside:,} of {num_inside + num_outside:,} points lie outside the grid or in no height band; "
                "are the clouds in the vehicle frame (z = 0 on the ground), not in that of a sensor?",
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
        """Plot one layer in one height band in bird's-eye view.

        Args:
            val: Result of `compute` or `forward`; by default the coverage so far.
            ax: Axes to plot on; by default those of a new figure of pyplot.
            quantity_key: Key of `Coverage.layers`; by default the detection rate at the first threshold.
            band: Name of the band; by default the first.

        Returns:
            The figure and its axes.

        Raises:
            TypeError: `val` is not a single `Coverage`.
            ValueError: The layer or the band does not exist.
        """
        fig, ax = get_figure(ax)
        coverage = self.compute() if val is None else val
        if not isinstance(coverage, Coverage):
            raise TypeError(f"val: one Coverage, as compute() returns it, is needed; got {type(coverage).__name__}")
        coverage.plot(quantity_key, band, ax)
        return fig, ax
