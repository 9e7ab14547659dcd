"""The numbers of a row: the radius, and the detection at each threshold; how they are called, written and ranked."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torchcover.coverage import RegionSummary
from torchcover.report.wording import metres, metres_more, percent, points_more


@dataclass(frozen=True)
class Quantity:
    """One of the numbers of a row.

    Args:
        column: Its name in files.
        title: Its name in tables, with its unit.
        difference_title: The name of its differences, with their unit.
        words: A number and its standard error as text.
        difference_words: A difference and its standard error as text.
        lower_is_better: Whether less of it is better.
        threshold: For a detection, its threshold in metres.
    """

    column: str
    title: str
    difference_title: str
    words: Callable[[float, float], str]
    difference_words: Callable[[float, float], str]
    lower_is_better: bool
    threshold: float | None = None

    def of(self, row: RegionSummary) -> float:
        """The number itself."""
        return row.radius_m if self.threshold is None else row.detection[self.threshold]

    def error_of(self, row: RegionSummary) -> float:
        """Its standard error; NaN if unknown."""
        return row.radius_error_m if self.threshold is None else row.detection_error[self.threshold]

    def best(self, rows: Sequence[RegionSummary]) -> list[bool]:
        """Which rows have the best number, to the digits that are shown."""
        known = [row for row in rows if not math.isnan(self.of(row))]
        if not known:
            return [False] * len(rows)
        best = (min if self.lower_is_better else max)(known, key=self.of)
        return [self.of(row) == self.of(best) or self._digits(row) == self._digits(best) for row in rows]

    def _digits(self, row: RegionSummary) -> str:
        return self.words(self.of(row), self.error_of(row)).split(" ")[0]


def quantities_of(thresholds: Sequence[float]) -> list[Quantity]:
    """The radius, and the detection at each threshold in metres: in the order of `RegionEstimate.value`."""
    detection = [
        Quantity(
            f"detection_{threshold:g}m",
            f"Detection within {threshold:g} m (%)",
            f"detection within {threshold:g} m (percentage points)",
            percent,
            points_more,
            lower_is_better=False,
            threshold=threshold,
        )
        for threshold in thresholds
    ]
    radius = Quantity(
        "radius_m",
        "Mean blind spot radius (m)",
        "mean blind spot radius (m)",
        metres,
        metres_more,
        lower_is_better=True,
    )
    return [radius, *detection]
