"""What there is to draw: the metrics of one coverage, or of several on one colour scale."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchcover.coverage import Coverage
from torchcover.coverage.errors import MIN_BLOCKS_OF_A_CELL
from torchcover.report.cells import NEVER_PROBED
from torchcover.report.scale import ColourScale, detection_scale, radius_scale


@dataclass(frozen=True)
class Metric:
    """A metric of some coverages.

    Args:
        stem: For file names.
        title: For titles.
        values: (H, Y, X) of each coverage, in the unit of the scale.
        scale: What the colours mean: the same for all bands and coverages.
        lower_is_better: Whether less of it is better.
        unknown: Why a cell has no number, for the legend.
    """

    stem: str
    title: str
    values: tuple[Tensor, ...]
    scale: ColourScale
    lower_is_better: bool
    unknown: str = NEVER_PROBED


def metrics_of(coverages: Sequence[Coverage]) -> Iterator[Metric]:
    """The metrics that all the coverages have.

    Args:
        coverages: One or several over the same grid, with the same thresholds and quantile levels.
    """
    first = coverages[0]
    yield _radius("radius", "mean blind spot radius", [coverage.radius for coverage in coverages])
    for at, threshold in enumerate(first.thresholds):
        yield Metric(
            f"detection_{threshold:g}m",
            f"Detection within {threshold:g} m",
            tuple(100 * coverage.detection[at] for coverage in coverages),
            detection_scale(f"detected within {threshold:g} m"),
            lower_is_better=False,
        )
    if maxima := _of_all([coverage.maximum for coverage in coverages]):
        yield _radius("radius_maximum", "largest blind spot radius", maxima)
    if pooled := _of_all([coverage.pooled for coverage in coverages]):
        yield _radius("radius_pooled", "pooled mean blind spot radius", pooled)
    if quantiles := _of_all([coverage.quantiles for coverage in coverages]):
        for at, level in enumerate(first.quantile_levels):
            quantity = f"{level:g} quantile of the blind spot radius"
            yield _radius(f"radius_q{level:g}", quantity, [values[at] for values in quantiles])


def error_metrics_of(coverages: Sequence[Coverage]) -> Iterator[Metric]:
    """The standard errors of the radius and of the detection at each threshold, if all the coverages have them.

    Args:
        coverages: As in `metrics_of`.
    """
    unknown = f"probed in fewer than {MIN_BLOCKS_OF_A_CELL} blocks of steps"
    if radii := _of_all([coverage.radius_error for coverage in coverages]):
        quantity = "standard error of the mean blind spot radius"
        yield replace(_radius("radius_error", quantity, radii), unknown=unknown)
    if detections := _of_all([coverage.detection_error for coverage in coverages]):
        for at, threshold in enumerate(coverages[0].thresholds):
            quantity = f"standard error of the detection within {threshold:g} m"
            points = [100 * values[at] for values in detections]
            scale = replace(radius_scale(quantity, torch.stack(points)), unit="percentage points")
            title = quantity[0].upper() + quantity[1:]
            yield Metric(f"detection_{threshold:g}m_error", title, tuple(points), scale, True, unknown)


def _radius(stem: str, quantity: str, values: Sequence[Tensor]) -> Metric:
    scale = radius_scale(quantity, torch.stack(list(values)))
    return Metric(stem, quantity[0].upper() + quantity[1:], tuple(values), scale, lower_is_better=True)


def _of_all(values: Sequence[Tensor | None]) -> list[Tensor]:
    given = [value for value in values if value is not None]
    return given if len(given) == len(values) else []
