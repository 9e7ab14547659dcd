"""What the reader of a table has to know about its numbers: as data, and as sentences."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from torchcover.estimation import blocks_needed
from torchcover.report.failures import sensors_of, single_point_of_failure
from torchcover.report.table import CoverageTable
from torchcover.report.wording import span, steps_and_cell

# Buildings and trees are above every band; where more than such a share is outside, the clouds may be elsewhere.
MOSTLY = 0.8


@dataclass(frozen=True)
class Remark:
    """One thing to know.

    Args:
        name: Which.
        count: How many there are.
        of: Of how many.
        sentence: In words.
    """

    name: str
    count: int
    of: int
    sentence: str


def remarks_on(table: CoverageTable, rig: str) -> tuple[Remark, ...]:
    """What is to be known about the numbers of a rig, of that which did happen."""
    return tuple(remark for remark in _looked_at(table, rig) if remark.count)


def _looked_at(table: CoverageTable, rig: str) -> Iterator[Remark]:
    summaries = [row.summary for row in table.rows[rig]]
    yield Remark("no_region", int(not summaries), 1, "No region, so no number: the maps cover the whole grid.")
    if table.measure == "area":
        seen = "Means over the square metres that the reference sees."
        yield Remark("visible_surface", len(summaries), len(summaries), seen)
    else:
        cells, known = sum(one.cells for one in summaries), sum(one.known_cells for one in summaries)
        flattered = "Means over the known cells only; the fewer are known, the more the numbers may flatter the rig."
        yield Remark("unknown_cells", cells - known, cells, flattered)
    yield from _on_errors(table, rig)
    counts, inside, limit_m = table.conditions[rig].counts, table.conditions[rig].points, table.max_radius
    every, outside = inside + counts["outside_points"], counts["outside_points"] - counts["no_ground_points"]
    far = "infinitely far" if math.isinf(limit_m) else f"{limit_m:.4g} m far, the limit"
    doubt = " Is the ground at z = 0, and x ahead?" if outside > MOSTLY * every else ""
    some = {**counts, "outside_points": outside}
    for name, of, words in (
        ("empty_sensor_steps", counts["steps"], "steps had no sensor point: they count as blind, not as missing."),
        ("empty_reference_steps", counts["steps"], "steps had no reference point: they say nothing."),
        ("saturated_points", inside, f"reference points count as {far}: no sensor point was nearer."),
        ("outside_points", every, f"reference points lie outside the grid: left out.{doubt}"),
        ("no_ground_points", every, "reference points have no known ground at or below them: in no band."),
    ):
        yield Remark(name, some[name], of, f"{some[name]:,} of {of:,} {words}")


def _on_errors(table: CoverageTable, rig: str) -> Iterator[Remark]:
    blocks, steps = table.conditions[rig].blocks, table.conditions[rig].steps_per_block or 0
    if blocks is None:
        return
    if not table.has_intervals:
        where = f" in {table.conditions[rig].fewest}" * bool(table.conditions[rig].fewest)
        needed = blocks_needed(blocks, table.first.effective[0])
        few = f"Not enough steps for intervals{where}: {blocks} block{'s' * (blocks != 1)}, about {needed} are needed."
        yield Remark("too_few_blocks", blocks, needed, few)
        return
    means = [quantity.key for quantity in table.means]  # of a largest radius no error is ever known
    numbers = [[row.summary.numbers[key] for key in means] for row in table.rows[rig]]
    without = sum(any(math.isfinite(number.value) and math.isnan(number.low) for number in row) for row in numbers)
    some = any(math.isfinite(number.low) for row in numbers for number in row)
    length = f"up to {steps:,} steps in a row" if steps > 1 else "a step"
    brackets = f"In brackets: 95 % intervals, from {blocks} blocks of {length}."
    yield Remark("intervals", blocks * some, blocks, brackets)
    unknown = "No interval where too few blocks have probed the region, or all say the same."
    yield Remark("no_intervals", without, len(numbers), unknown)


def notes_on(table: CoverageTable) -> list[str]:
    """What the numbers hold under and what went wrong, a sentence each; what is about one rig only begins with it."""
    of_rigs = in_common_first({rig: _of_rig(table, rig) for rig in table.rigs})
    shared = {"known": "they know the same cells", "area": "they are asked about the same square metres"}[table.measure]
    paired = [f"All rigs were measured against the same reference points, so {shared}."]
    return [*(paired if len(table.rigs) > 1 else []), *of_rigs, *table.notes]


def in_common_first(notes: Mapping[str, Sequence[str]]) -> list[str]:
    """What is said of all, then what is said of some, which begins with their names.

    Example:
        >>> in_common_first({"roof": ["8 steps.", "Blind."], "grille": ["8 steps."]})
        ['8 steps.', 'roof: Blind.']
    """
    common = [note for note in next(iter(notes.values())) if all(note in each for each in notes.values())]
    return [*common, *(f"{name}: {note}" for name, each in notes.items() for note in each if note not in common)]


def marks_on(table: CoverageTable) -> dict[str, str]:
    """What the marks of differences mean, by their names; empty where there are none."""
    several, by_sensor = len(table.rigs) > 1, any(sensors_of(rows) for rows in table.rows.values())
    if not (several or by_sensor) or not table.has_intervals:
        return {}
    best = {"best": "the best of its row, where its lead over the next is more than chance."} if several else {}
    chance = "more than chance, by Student's t at 95 %: of 20 rows without a difference, one is marked."
    return {**best, "significant": chance}


def _of_rig(table: CoverageTable, rig: str) -> list[str]:
    bands = ", ".join(f"{name} {span(table.grid, name)}" for name in table.grid.heights)
    first = f"{steps_and_cell(table.conditions[rig].counts['steps'], table.grid)}; {bands}."
    sentences = (remark.sentence for remark in remarks_on(table, rig))
    failure = single_point_of_failure(table, rig)
    return [first, *sentences, *([failure] if failure else [])]
