"""What the reader of a table has to know about its numbers: as data, and as sentences."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from torchcover.estimation import MIN_BLOCKS
from torchcover.report.failures import sensors_of, single_point_of_failure
from torchcover.report.table import CoverageTable
from torchcover.report.wording import span, steps_and_cell

RemarkName = Literal[
    "no_region",
    "visible_surface",
    "unknown_cells",
    "too_few_blocks",
    "intervals",
    "no_intervals",
    "empty_sensor_steps",
    "empty_reference_steps",
    "saturated_points",
    "outside_points",
    "no_ground_points",
]

# Buildings and trees are above every band; where more than such a share is outside, the clouds may be elsewhere.
MOSTLY = 0.8


@dataclass(frozen=True)
class Remark:
    """One thing to know.

    Args:
        name: Which.
        count: How many there are.
        of: Of how many.
    """

    name: RemarkName
    count: int
    of: int


def remarks_on(table: CoverageTable, rig: str) -> tuple[Remark, ...]:
    """What is to be known about the numbers of a rig, of that which did happen."""
    counts, inside = table.conditions[rig].counts, table.conditions[rig].points
    rows, every = table.rows[rig], inside + counts["outside_points"]
    found = [
        Remark("no_region", int(not rows), 1),
        *_on_measure(table, rig),
        *_on_errors(table, rig),
        Remark("empty_sensor_steps", counts["empty_sensor_steps"], counts["steps"]),
        Remark("empty_reference_steps", counts["empty_reference_steps"], counts["steps"]),
        Remark("saturated_points", counts["saturated_points"], inside),
        Remark("outside_points", counts["outside_points"] - counts["no_ground_points"], every),
        Remark("no_ground_points", counts["no_ground_points"], every),
    ]
    return tuple(remark for remark in found if remark.count)


def _on_measure(table: CoverageTable, rig: str) -> list[Remark]:
    summaries = [row.summary for row in table.rows[rig]]
    if table.measure == "area":
        return [Remark("visible_surface", len(summaries), len(summaries))]
    cells, known = sum(summary.cells for summary in summaries), sum(summary.known_cells for summary in summaries)
    return [Remark("unknown_cells", cells - known, cells)]


def _on_errors(table: CoverageTable, rig: str) -> list[Remark]:
    blocks = table.conditions[rig].blocks
    if blocks is None:
        return []
    if blocks < MIN_BLOCKS:
        return [Remark("too_few_blocks", blocks, MIN_BLOCKS)]
    means = [quantity.key for quantity in table.means]  # of a largest radius no error is ever known
    numbers = [[row.summary.numbers[key] for key in means] for row in table.rows[rig]]
    without = sum(any(math.isfinite(number.value) and math.isnan(number.low) for number in row) for row in numbers)
    some = any(math.isfinite(number.low) for row in numbers for number in row)
    return [Remark("intervals", blocks * some, blocks), Remark("no_intervals", without, len(numbers))]


def notes_on(table: CoverageTable) -> list[str]:
    """What the numbers hold under and what went wrong, a sentence each; what is about one rig only begins with it."""
    by_rig = {rig: _of_rig(table, rig) for rig in table.rigs}
    common = [note for note in by_rig[table.rigs[0]] if all(note in notes for notes in by_rig.values())]
    own = [f"{rig}: {note}" for rig, notes in by_rig.items() for note in notes if note not in common]
    shared = {"known": "they know the same cells", "area": "they are asked about the same square metres"}[table.measure]
    paired = [f"All rigs were measured against the same reference points, so {shared}."]
    return [*(paired if len(table.rigs) > 1 else []), *common, *own, *table.notes]


def marks_on(table: CoverageTable) -> dict[str, str]:
    """What the marks of differences mean, by their names; empty where there are none."""
    several, by_sensor = len(table.rigs) > 1, any(sensors_of(rows) for rows in table.rows.values())
    if not (several or by_sensor) or (table.first.blocks or 0) < MIN_BLOCKS:
        return {}
    best = {"best": "the best of its row, where its lead over the next is more than chance."} if several else {}
    chance = "more than chance, by Student's t at 95 %: of 20 rows without a difference, one is marked."
    return {**best, "significant": chance}


def _of_rig(table: CoverageTable, rig: str) -> list[str]:
    bands = ", ".join(f"{name} {span(table.grid, name)}" for name in table.grid.heights)
    first = f"{steps_and_cell(table.conditions[rig].counts['steps'], table.grid)}; {bands}."
    sentences = (SENTENCES[remark.name](remark, table, rig) for remark in remarks_on(table, rig))
    failure = single_point_of_failure(table, rig)
    return [first, *sentences, *([failure] if failure else [])]


def _too_few_blocks(remark: Remark, _: CoverageTable, __: str) -> str:
    blocks = f"{remark.count} block{'s' * (remark.count != 1)}"
    return f"Not enough steps for errors: {blocks}, {remark.of} are needed."


def _intervals(remark: Remark, table: CoverageTable, rig: str) -> str:
    steps = table.conditions[rig].steps_per_block or 0
    length = f"up to {steps:,} steps in a row" if steps > 1 else "a step"
    return f"In brackets: 95 % intervals, from {remark.count} blocks of {length}."


def _saturated(remark: Remark, table: CoverageTable, _: str) -> str:
    limit_m = table.max_radius
    far = "infinitely far" if math.isinf(limit_m) else f"{limit_m:.4g} m far, the limit"
    return f"{_some(remark)} reference points count as {far}: no sensor point was nearer."


def _outside(remark: Remark, *_: object) -> str:
    doubt = " Is the ground at z = 0, and x ahead?" if remark.count > MOSTLY * remark.of else ""
    return f"{_some(remark)} reference points lie outside the grid: left out.{doubt}"


def _some(remark: Remark) -> str:
    return f"{remark.count:,} of {remark.of:,}"


SENTENCES: Mapping[RemarkName, Callable[[Remark, CoverageTable, str], str]] = MappingProxyType(
    {
        "no_region": lambda *_: "No region, so no number: the maps cover the whole grid.",
        "visible_surface": lambda *_: "Means over the square metres that the reference sees.",
        "unknown_cells": lambda *_: (
            "Means over the known cells only; the fewer are known, the more the numbers may flatter the rig."
        ),
        "too_few_blocks": _too_few_blocks,
        "intervals": _intervals,
        "no_intervals": lambda *_: "No interval where too few blocks have probed the region, or all say the same.",
        "empty_sensor_steps": lambda remark, *_: (
            f"{_some(remark)} steps had no sensor point: they count as blind, not as missing."
        ),
        "empty_reference_steps": lambda remark, *_: f"{_some(remark)} steps had no reference point: they say nothing.",
        "saturated_points": _saturated,
        "outside_points": _outside,
        "no_ground_points": lambda remark, *_: (
            f"{_some(remark)} reference points have no known ground at or below them: in no band."
        ),
    }
)
