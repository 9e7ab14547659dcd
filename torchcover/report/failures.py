"""Redundancy in words: by how many sensors places are seen, and what is lost when each one fails."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill

from torchcover.coverage import RegionRedundancy
from torchcover.coverage.quantity import RADIUS, seen_by_two, sensors_seeing
from torchcover.estimation import Quantity
from torchcover.report.table import CoverageTable, Row
from torchcover.report.wording import UNKNOWN, difference_heading, difference_words, number_words, value_words

MAX_HEADING_CHARS = 16
NONE = "none"


def decisive(table: CoverageTable) -> Quantity:
    """What sensors are judged by: the detection at the first threshold, or the radius where there is none."""
    return table.means[min(1, len(table.thresholds))]


def sensors_of(rows: Sequence[Row]) -> tuple[str, ...]:
    """The sensors that the rows of a rig have numbers without; none if that was not asked for."""
    known = (row.summary.redundancy for row in rows)
    return next((tuple(redundancy.without) for redundancy in known if redundancy), ())


def failure_title(table: CoverageTable, rig: str) -> str:
    """What stands above the part of the table that is about one rig."""
    beginning = f"{rig}: change" if len(table.rigs) > 1 else "Change"
    return f"{beginning} of {difference_heading(decisive(table))} when one sensor fails"


def failure_headings(table: CoverageTable, rig: str) -> list[str]:
    """Of its columns, but for the place."""
    several = [fill(heading, MAX_HEADING_CHARS) for heading in ("sensors that see it", "by two or more (%)")]
    return [*(several if table.thresholds else ()), *sensors_of(table.rows[rig]), "most lost with"]


def failure_words(table: CoverageTable, row: Row) -> list[tuple[str, bool]]:
    """The cells of one row but for the place, each with whether it is marked as more than chance."""
    redundancy, key = row.summary.redundancy, decisive(table).key
    sensors = sensors_of(table.rows[row.rig])
    if redundancy is None:
        return [(UNKNOWN, False)] * len(failure_headings(table, row.rig))
    words = []
    for threshold in table.thresholds[:1]:
        words.append((number_words(redundancy.seen_by[sensors_seeing(threshold).key]), False))
        words.append((number_words(redundancy.seen_by[seen_by_two(threshold).key]), False))
    for sensor in sensors:
        change = redundancy.change[sensor][key]
        words.append((difference_words(change), bool(change.significant)))
    known = not math.isnan(row.summary.numbers[key].value)
    return [*words, (redundancy.indispensable or (NONE if known else UNKNOWN), False)]


@dataclass(frozen=True)
class FailureParams:
    """When the loss of a sensor is called a single point of failure.

    Args:
        least_share: Least loss that is more than chance: the share of the detection that is lost, or by which the
            radius grows. A tenth is more than settings move a number, see docs/accuracy.md.
    """

    least_share: float = 0.1


def single_point_of_failure(table: CoverageTable, rig: str, params: FailureParams = FailureParams()) -> str:
    """Name the sensor of a rig with which most is lost, and where, if the loss is large and more than chance.

    Args:
        table: Of one rig or several.
        rig: Its name.
        params: What counts as a single point of failure.

    Returns:
        A sentence; empty if redundancy was not asked for.
    """
    quantity, rows = decisive(table), table.rows[rig]
    if not sensors_of(rows):
        return ""
    if all(math.isnan(row.summary.numbers[quantity.key].value) for row in rows):
        return "Whether one sensor is indispensable is unknown: nothing that was asked about was seen."
    if quantity.key != RADIUS.key and not any(row.summary.numbers[quantity.key].value > 0.0 for row in rows):
        return "Nothing of what was asked about is detected: no failure could take anything away."
    if len(sensors_of(rows)) == 1:
        return f"Its only sensor is {sensors_of(rows)[0]}: without it nothing is seen."
    large = [row for row in rows if _lost_share(row, quantity) >= params.least_share]
    real = [row for row in large if _is_significant(row, quantity)]
    worst = max(real or large, key=lambda row: _loss(row.summary.redundancy, quantity), default=None)
    if worst is None or (redundancy := worst.summary.redundancy) is None or redundancy.indispensable is None:
        least = f"{params.least_share:.0%}"
        return f"No single point of failure: no sensor's failure costs {least} or more of any number that is known."
    sensor = redundancy.indispensable
    before, after = worst.summary.numbers[quantity.key].value, redundancy.without[sensor][quantity.key].value
    whole, rest = (value_words(value, quantity.unit) for value in (before, after))
    unit = "m" if quantity.unit == "m" else "%"
    where = f"{worst.summary.region} {worst.summary.height}"
    change = f"{quantity.title} is {rest} {unit} in {where}, not {whole} {unit}"
    if real:
        return f"Single point of failure: {sensor}; without it {change}."
    return f"Most is lost without {sensor}: {change}; whether that is more than chance is unknown."


def _lost_share(row: Row, quantity: Quantity) -> float:
    """The loss with the sensor with which most is lost, as a share of the number with all sensors."""
    loss, whole = _loss(row.summary.redundancy, quantity), row.summary.numbers[quantity.key].value
    return loss / whole if loss > 0 and whole > 0 else 0.0


def _is_significant(row: Row, quantity: Quantity) -> bool:
    redundancy = row.summary.redundancy
    if redundancy is None or redundancy.indispensable is None:
        return False
    return bool(redundancy.change[redundancy.indispensable][quantity.key].significant)


def _loss(redundancy: RegionRedundancy | None, quantity: Quantity) -> float:
    if redundancy is None or redundancy.indispensable is None:
        return 0.0
    return -redundancy.change[redundancy.indispensable][quantity.key].gain
