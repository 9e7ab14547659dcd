"""Verdicts on requirements: bounds, measured numbers with their confidence intervals, and the comparison of both."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from torchcover.geometry.arrays import Float64

State = Literal["met", "not met", "not decided"]

# Numbers whose keys need words in tables.
BOUND_TITLES = {"ttc_s": "seconds to collision", "braking_margin_s": "braking margin in seconds"}


class Bound(NamedTuple):
    """Bound of one number.

    Args:
        key: Key of the number, such as `points` or `detection_0.4m`.
        value: The bound, in the unit of the number.
        is_minimum: Whether the number must be at least `value`, else at most.
    """

    key: str
    value: float
    is_minimum: bool = True

    @property
    def text(self) -> str:
        """The bound in words, as in `points >= 5`."""
        return f"{BOUND_TITLES.get(self.key, self.key)} {'>=' if self.is_minimum else '<='} {self.value:g}"


class Readings(NamedTuple):
    """Measured values of one number, for example one for each position of a test target.

    Args:
        value: (N,) values; NaN where unknown.
        low: (N,) lower ends of the 95 % confidence intervals: the value itself where it is exact, NaN without interval.
        high: (N,) upper ends; inf where the number may be anything above `low`.
        locations: Name of the position, region or encounter of each value.
        occupied_count: Number of further positions that another body occupied.
    """

    value: Float64
    low: Float64
    high: Float64
    locations: Sequence[str]
    occupied_count: int = 0


class Verdict(NamedTuple):
    """Result of one bound of a requirement.

    Args:
        requirement: Text of the requirement.
        bound: The bound.
        state: Whether it is met.
        value: Worst known value.
        low: Lower end of its 95 % confidence interval.
        high: Upper end.
        margin: Distance from the bound to the worst value in its unit; negative if the bound is not met, NaN if not
            decided.
        total_count: Number of positions, regions or encounters.
        not_met_count: How many of them do not meet the bound.
        undecided_count: How many are not decided.
        worst_locations: Up to 5 worst locations that do not meet the bound, else of the undecided ones, else of all.
        occupied_count: Number of positions that another body occupied; they are not part of `total_count`.
    """

    requirement: str
    bound: Bound
    state: State
    value: float
    low: float
    high: float
    margin: float
    total_count: int
    not_met_count: int
    undecided_count: int
    worst_locations: tuple[str, ...]
    occupied_count: int = 0


def judge_bound(
    requirement: str, bound: Bound, readings: Readings, *, rounding: float = 1e-9, max_locations: int = 5
) -> Verdict:
    """Judge a bound: met if every interval meets it completely, not met if one interval misses it completely.

    Any other bound is not decided.

    Args:
        requirement: Text of the requirement.
        bound: One of its bounds.
        readings: Values of the number; the bound is not decided if there are none.
        rounding: Error that a mean over frames may have from rounding.
        max_locations: Maximum number of worst locations.

    Returns:
        The verdict.

    Example:
        >>> points = np.array([9.0, 3.0])
        >>> verdict = judge_bound("child", Bound("points", 5.0), Readings(points, points, points, ["ahead", "behind"]))
        >>> verdict.state, verdict.margin, verdict.worst_locations
        ('not met', -2.0, ('behind',))
    """
    sign = 1.0 if bound.is_minimum else -1.0
    margin = sign * (readings.value - bound.value)
    margin_of_low, margin_of_high = sign * (readings.low - bound.value), sign * (readings.high - bound.value)
    # Both comparisons are false for NaN, which leaves the value undecided.
    is_met = np.minimum(margin_of_low, margin_of_high) >= -rounding
    is_not_met = np.maximum(margin_of_low, margin_of_high) < -rounding
    is_undecided = ~(is_met | is_not_met)
    state: State = "met"
    reported = is_met
    if is_not_met.any():
        state, reported = "not met", is_not_met
    elif is_undecided.any() or not len(is_met):
        state, reported = "not decided", is_undecided
    worst_first = np.argsort(margin, kind="stable")  # NaN is last
    worst_locations = [readings.locations[index] for index in worst_first[reported[worst_first]][:max_locations]]
    value = low = high = worst_margin = np.nan
    if len(worst_first):
        worst = worst_first[0]
        value, low, high = float(readings.value[worst]), float(readings.low[worst]), float(readings.high[worst])
        worst_margin = np.nan if state == "not decided" else float(margin[worst])
    return Verdict(
        requirement,
        bound,
        state,
        value,
        low,
        high,
        worst_margin,
        total_count=len(is_met),
        not_met_count=int(is_not_met.sum()),
        undecided_count=int(is_undecided.sum()),
        worst_locations=tuple(worst_locations),
        occupied_count=readings.occupied_count,
    )
