"""A table in sentences: what is lost when a sensor fails, what a reader has to know, and the answer in plain words."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from textwrap import fill

from torchcover.coverage import Region, RegionRedundancy
from torchcover.coverage.quantity import RADIUS, make_redundancy_quantity, make_sensor_count_quantity
from torchcover.estimation import MIN_BLOCKS, Quantity, estimate_blocks_needed
from torchcover.report.number_format import (
    UNKNOWN,
    format_difference,
    format_difference_heading,
    format_height_band,
    format_number,
    format_resolution,
    format_square_meters,
    format_value,
)
from torchcover.report.table import CoverageTable, Row

MAX_HEADING_CHARS = 16
NONE = "none"


def get_main_quantity(table: CoverageTable) -> Quantity:
    """What sensors are judged by: the detection at the first threshold, or the radius where there is none."""
    return table.mean_quantities[min(1, len(table.thresholds_m))]


def get_failure_sensors(rows: Sequence[Row]) -> tuple[str, ...]:
    """The sensors that the rows of a rig have numbers without; none if that was not asked for."""
    known = (row.summary.redundancy for row in rows)
    return next((tuple(redundancy.failure_numbers) for redundancy in known if redundancy), ())


def format_failure_title(table: CoverageTable, rig: str) -> str:
    """What stands above the part of the table that is about one rig."""
    beginning = f"{rig}: change" if len(table.rigs) > 1 else "Change"
    return f"{beginning} of {format_difference_heading(get_main_quantity(table))} when one sensor fails"


def format_failure_headings(table: CoverageTable, rig: str) -> list[str]:
    """Of its columns, but for the place."""
    several = [fill(heading, MAX_HEADING_CHARS) for heading in ("sensors that see it", "by two or more (%)")]
    return [*(several if table.thresholds_m else ()), *get_failure_sensors(table.rows[rig]), "most lost with"]


def format_failure_cells(table: CoverageTable, row: Row) -> list[tuple[str, bool]]:
    """The cells of one row but for the place, each with whether it is marked as more than chance."""
    redundancy, key = row.summary.redundancy, get_main_quantity(table).key
    sensors = get_failure_sensors(table.rows[row.rig])
    if redundancy is None:
        return [(UNKNOWN, False)] * len(format_failure_headings(table, row.rig))
    words = []
    for threshold in table.thresholds_m[:1]:
        words.append((format_number(redundancy.detecting_sensors[make_sensor_count_quantity(threshold).key]), False))
        words.append((format_number(redundancy.detecting_sensors[make_redundancy_quantity(threshold).key]), False))
    for sensor in sensors:
        change = redundancy.failure_effects[sensor][key]
        words.append((format_difference(change), bool(change.is_significant)))
    known = not math.isnan(row.summary.numbers[key].value)
    return [*words, (redundancy.most_critical_sensor or (NONE if known else UNKNOWN), False)]


@dataclass(frozen=True)
class FailureParams:
    """When the loss of a sensor is called a single point of failure.

    Args:
        min_share: Least loss that is more than chance: the share of the detection that is lost, or by which the
            radius grows. A tenth is more than settings move a number, see docs/accuracy.md.
    """

    min_share: float = 0.1


def describe_single_point_of_failure(table: CoverageTable, rig: str, params: FailureParams = FailureParams()) -> str:
    """Name the sensor of a rig with which most is lost, and where, if the loss is large and more than chance.

    Args:
        table: Of one rig or several.
        rig: Its name.
        params: What counts as a single point of failure.

    Returns:
        A sentence; empty if redundancy was not asked for.
    """
    quantity, rows = get_main_quantity(table), table.rows[rig]
    if not get_failure_sensors(rows):
        return ""
    if all(math.isnan(row.summary.numbers[quantity.key].value) for row in rows):
        return "Whether one sensor is indispensable is unknown: nothing that was asked about was seen."
    if quantity.key != RADIUS.key and not any(row.summary.numbers[quantity.key].value > 0.0 for row in rows):
        return "Nothing of what was asked about is detected: no failure could take anything away."
    if len(get_failure_sensors(rows)) == 1:
        return f"Its only sensor is {get_failure_sensors(rows)[0]}: without it nothing is seen."
    large = [row for row in rows if _lost_share(row, quantity) >= params.min_share]
    large = [row for row in large if _is_significant(row, quantity) is not False]
    real = [row for row in large if _is_significant(row, quantity)]
    worst = max(real or large, key=lambda row: _loss(row.summary.redundancy, quantity), default=None)
    if worst is None or (redundancy := worst.summary.redundancy) is None or redundancy.most_critical_sensor is None:
        least = f"{100 * params.min_share:g} %"
        return f"No single point of failure: no sensor's failure costs {least} or more of any number beyond chance."
    sensor = redundancy.most_critical_sensor
    before, after = worst.summary.numbers[quantity.key].value, redundancy.failure_numbers[sensor][quantity.key].value
    whole, rest = (format_value(value, quantity.unit) for value in (before, after))
    unit = "m" if quantity.unit == "m" else "%"
    where = f"{worst.summary.region} {worst.summary.band}"
    change = f"{quantity.title} is {rest} {unit} in {where}, not {whole} {unit}"
    if real:
        return f"Single point of failure: {sensor}; without it {change}."
    return f"Most is lost without {sensor}: {change}; whether that is more than chance is unknown."


def _lost_share(row: Row, quantity: Quantity) -> float:
    """The loss with the sensor with which most is lost, as a share of the number with all sensors."""
    loss, whole = _loss(row.summary.redundancy, quantity), row.summary.numbers[quantity.key].value
    return loss / whole if loss > 0 and whole > 0 else 0.0


def _is_significant(row: Row, quantity: Quantity) -> bool | None:
    """Whether the loss with the sensor with which most is lost is more than chance; None if that is unknown."""
    redundancy = row.summary.redundancy
    if redundancy is None or redundancy.most_critical_sensor is None:
        return None
    return redundancy.failure_effects[redundancy.most_critical_sensor][quantity.key].is_significant


def _loss(redundancy: RegionRedundancy | None, quantity: Quantity) -> float:
    if redundancy is None or redundancy.most_critical_sensor is None:
        return 0.0
    return -redundancy.failure_effects[redundancy.most_critical_sensor][quantity.key].improvement


# Buildings and trees are above every band; where more than such a share is outside, the clouds may be elsewhere.
MOSTLY = 0.8


@dataclass(frozen=True)
class TableNote:
    """One thing to know.

    Args:
        name: Which.
        count: How many there are.
        total: Of how many.
        sentence: In words.
    """

    name: str
    count: int
    total: int
    sentence: str


def collect_table_notes(table: CoverageTable, rig: str) -> tuple[TableNote, ...]:
    """What is to be known about the numbers of a rig, of that which did happen."""
    return tuple(remark for remark in _looked_at(table, rig) if remark.count)


def _looked_at(table: CoverageTable, rig: str) -> Iterator[TableNote]:
    summaries = [row.summary for row in table.rows[rig]]
    yield TableNote("no_region", int(not summaries), 1, "No region, so no number: the maps cover the whole grid.")
    if table.average == "area":
        seen = "Means over the square metres that the reference sees."
        yield TableNote("visible_surface", len(summaries), len(summaries), seen)
    else:
        cells, known = sum(one.num_cells for one in summaries), sum(one.observed_cells for one in summaries)
        flattered = "Means over the known cells only; the fewer are known, the more the numbers may flatter the rig."
        yield TableNote("unknown_cells", cells - known, cells, flattered)
    yield from _on_errors(table, rig)
    counts, inside, limit_m = table.conditions[rig].counts, table.conditions[rig].point_count, table.max_radius_m
    every, outside = inside + counts["outside_points"], counts["outside_points"] - counts["no_ground_points"]
    far = "infinitely far" if math.isinf(limit_m) else f"{limit_m:.4g} m far, the limit"
    doubt = " Is the ground at z = 0, and x ahead?" if outside > MOSTLY * every else ""
    some = {**counts, "outside_points": outside}
    for name, of, words in (
        (
            "empty_sensor_frames",
            counts["num_frames"],
            "steps had no sensor point: they count as blind, not as missing.",
        ),
        ("empty_reference_frames", counts["num_frames"], "steps had no reference point: they say nothing."),
        ("saturated_points", inside, f"reference points count as {far}: no sensor point was nearer."),
        ("outside_points", every, f"reference points lie outside the grid: left out.{doubt}"),
        ("no_ground_points", every, "reference points have no known ground at or below them: in no band."),
    ):
        yield TableNote(name, some[name], of, f"{some[name]:,} of {of:,} {words}")


def _on_errors(table: CoverageTable, rig: str) -> Iterator[TableNote]:
    blocks, steps = table.conditions[rig].blocks, table.conditions[rig].frames_per_block or 0
    if blocks is None:
        return
    if not table.has_intervals:
        where = f" in {table.conditions[rig].smallest_scene_kind}" * bool(table.conditions[rig].smallest_scene_kind)
        needed = estimate_blocks_needed(blocks, table.first_conditions.effective_blocks[0])
        few = f"Not enough steps for intervals{where}: {blocks} block{'s' * (blocks != 1)}, about {needed} are needed."
        yield TableNote("too_few_blocks", blocks, needed, few)
        return
    means = [quantity.key for quantity in table.mean_quantities]  # of a largest radius no error is ever known
    numbers = [[row.summary.numbers[key] for key in means] for row in table.rows[rig]]
    without = sum(any(math.isfinite(number.value) and math.isnan(number.low) for number in row) for row in numbers)
    some = any(math.isfinite(number.low) for row in numbers for number in row)
    length = f"up to {steps:,} steps in a row" if steps > 1 else "a step"
    brackets = f"In brackets: 95 % intervals, from {blocks} blocks of {length}."
    yield TableNote("intervals", blocks * some, blocks, brackets)
    unknown = "No interval where too few blocks have probed the region, or all say the same."
    yield TableNote("no_intervals", without, len(numbers), unknown)


def list_notes(table: CoverageTable) -> list[str]:
    """What the numbers hold under and what went wrong, a sentence each; what is about one rig only begins with it."""
    of_rigs = merge_notes({rig: _of_rig(table, rig) for rig in table.rigs})
    shared = {"cells": "they know the same cells", "area": "they are asked about the same square metres"}[table.average]
    paired = [f"All rigs were measured against the same reference points, so {shared}."]
    return [*(paired if len(table.rigs) > 1 else []), *of_rigs, *table.notes]


def merge_notes(notes: Mapping[str, Sequence[str]]) -> list[str]:
    """What is said of all, then what is said of some, which begins with their names.

    Example:
        >>> merge_notes({"roof": ["8 steps.", "Blind."], "grille": ["8 steps."]})
        ['8 steps.', 'roof: Blind.']
    """
    common = [note for note in next(iter(notes.values())) if all(note in each for each in notes.values())]
    return [*common, *(f"{name}: {note}" for name, each in notes.items() for note in each if note not in common)]


def explain_marks(table: CoverageTable) -> dict[str, str]:
    """What the marks of differences mean, by their names; empty where there are none."""
    several, by_sensor = len(table.rigs) > 1, any(get_failure_sensors(rows) for rows in table.rows.values())
    if not (several or by_sensor) or not table.has_intervals:
        return {}
    best = {"best": "the best of its row, where its lead over the next is more than chance."} if several else {}
    chance = "more than chance, by Student's t at 95 %: of 20 rows without a difference, one is marked."
    return {**best, "significant": chance}


def _of_rig(table: CoverageTable, rig: str) -> list[str]:
    bands = ", ".join(f"{name} {format_height_band(table.grid, name)}" for name in table.grid.heights)
    first = f"{format_resolution(table.conditions[rig].counts['num_frames'], table.grid)}; {bands}."
    sentences = (remark.sentence for remark in collect_table_notes(table, rig))
    failure = describe_single_point_of_failure(table, rig)
    return [first, *sentences, *([failure] if failure else [])]


# The range that is told is that of the region ahead that reaches farthest, but no farther than this.
RANGE_M = 80.0
BANDS = {"ground": "ground", "obstacle": "obstacles"}
# Of so many places that all say the same, at least nine in ten say it anywhere, with 95 % confidence: 0.9**30 < 0.05.
LEAST_AGREED = 30
SIDES = {"front_3m": "in front", "rear_3m": "behind", "left_3m": "on the left", "right_3m": "on the right"}


def summarize_findings(table: CoverageTable) -> tuple[str, ...]:
    """What a meeting is told of a table; the first sentence says most.

    Args:
        table: Of one rig, or of several that are compared.

    Returns:
        Sentences: on bodies beside the vehicle, on the range, on the failure of a sensor; those that there are numbers
        for, or that steps are too few.
    """
    told = tuple(filter(None, (rule(table) for rule in RULES)))
    return tuple(filter(None, (*told, explain_missing_intervals(table, "ranges" if told else "an answer"))))


def explain_missing_intervals(table: CoverageTable, subject: str) -> str:
    """Say that frames are too few for intervals, where these were asked for, and how many would give them.

    Args:
        table: Of one rig or several.
        subject: What intervals are needed for: "an answer".

    Returns:
        A sentence; empty where some number has an interval, or where none was asked for.
    """
    steps, blocks = table.first_conditions.counts["num_frames"], table.first_conditions.blocks
    if blocks is None or table.has_intervals:
        return ""
    needed, ends = estimate_blocks_needed(blocks, table.first_conditions.effective_blocks[0]), table.block_ends
    begin = f"Not enough frames for {subject}: {steps:,} form {blocks} block{'s' * (blocks != 1)} of time, "
    if ends and len(ends) < needed:
        return f"{begin}intervals need about {needed}, and this source has {len(ends)} in all."
    frames = ends[needed - 1] if ends else needed * (table.first_conditions.frames_per_block or 1)
    return f"{begin}intervals need about {needed}, which are {frames:,} frames (`--num-frames`)."


def describe_near_field(table: CoverageTable) -> str:
    """At what share of the free places beside the vehicle the first body is seen, side by side."""
    rows = list(zip(*table.target_rows.values(), strict=True))
    if not rows:
        return ""
    body, key = rows[0][0].summary.band, table.target_quantities[0].key
    near = [of for of in rows if of[0].summary.band == body and of[0].region.name in SIDES]
    of_sides = {SIDES[of[0].region.name]: of for of in near}
    enough = (table.first_conditions.blocks or 0) >= MIN_BLOCKS
    told = {
        side: _told(of, key, enough=enough and of[0].summary.numbers[key].count >= LEAST_AGREED)
        for side, of in of_sides.items()
    }
    known = [f"{side} {words}" for side, words in told.items() if words]
    criterion = table.target_quantities[0].title.removeprefix("free places with ")
    seen = f"{format_target_name(body)} is seen ({criterion})"
    if known:
        return f"Free places within 3 m where {seen}: {'; '.join(known)}."
    unknown = all(math.isnan(row.summary.numbers[key].error) for of in of_sides.values() for row in of)
    several = len(table.rigs) > 1 and not unknown
    return f"Of the places within 3 m where {seen}, no rig has more than the others beyond chance." * several


def describe_range(table: CoverageTable) -> str:
    """What is detected ahead: of one rig with intervals, of several who leads by more than chance."""
    region = find_forward_region(table)
    if region is None or not table.thresholds_m or not table.has_intervals:
        return ""
    key, where = get_main_quantity(table).key, f"to {region.x_m[1]:g} m ahead ({detected_words(table)})"
    bands = [of for of in table.rows_by_region if of[0].region is region]
    told = {surface_words(table, of[0]): _told(of, key, enough=True) for of in bands}
    known = [f"of {band} {words}" for band, words in told.items() if words]
    if known:
        return f"Detected {where}: {'; '.join(known)}."
    return f"No rig detects more than the others {where} beyond chance." * (len(table.rigs) > 1)


def detected_words(table: CoverageTable) -> str:
    """Describe the criterion of detection: how near a point of the rig must be."""
    return f"a point within {table.thresholds_m[0]:g} m"


def surface_words(table: CoverageTable, row: Row) -> str:
    """Describe the surface to which the numbers of a row refer: visible square meters, or observed cells.

    Args:
        table: Table of the row.
        row: One region and height band.

    Returns:
        Words such as "512.3 m² of visible ground".
    """
    surface = BANDS.get(row.summary.band, row.summary.band)
    if table.average == "area":
        return f"{format_square_meters(row.summary.visible_m2)} m² of visible {surface}"
    return f"{row.summary.observed_cells:,} observed cells of {surface}"


def find_forward_region(table: CoverageTable) -> Region | None:
    """The region that the range is told of: of those that begin at the vehicle the farthest to `RANGE_M`; else none."""
    regions = dict.fromkeys(of[0].region for of in table.rows_by_region)
    reached = [one for one in regions if one.x_m[0] == 0.0 and one.x_m[1] <= RANGE_M and not one.corners_m]
    return max(reached, key=lambda one: one.x_m[1], default=None)


def describe_failures(table: CoverageTable) -> str:
    """The sensor that most hangs on, of each rig."""
    asked = [rig for rig in table.rigs if get_failure_sensors(table.rows[rig])]
    several = len(table.rigs) > 1
    return " ".join(f"{rig}: " * several + describe_single_point_of_failure(table, rig) for rig in asked)


RULES: tuple[Callable[[CoverageTable], str], ...] = (describe_near_field, describe_range, describe_failures)


def _told(rows: Sequence[Row], key: str, *, enough: bool) -> str:
    """A share of one rig with its interval; of several who leads by more than chance; no words if nobody knows."""
    if len(rows) == 1:
        number = rows[0].summary.numbers[key]
        # Where all blocks say the same there is no interval, and nothing is left to chance.
        agreed = math.isnan(number.low) and number.value in (0.0, 1.0) and enough
        interval = "" if agreed else f" [{format_whole_percent(number.low)}, {format_whole_percent(number.high)}]"
        return f"{format_whole_percent(number.value)} %{interval}" if agreed or not math.isnan(number.low) else ""
    leader = next((row for row in rows if key in row.leading_keys), None)
    if leader is None:
        return ""
    second = max((row for row in rows if row is not leader), key=lambda row: row.summary.numbers[key].value)
    return ", ".join(f"{row.rig} {format_whole_percent(row.summary.numbers[key].value)} %" for row in (leader, second))


def format_target_name(name: str) -> str:
    """What a body is called in a sentence.

    Example:
        >>> format_target_name("child_110cm"), format_target_name("adult")
        ('a child', 'an adult')
    """
    plain = name.partition("_")[0]
    return f"{'an' if plain[:1] in 'aeiou' else 'a'} {plain}"


def format_whole_percent(share: float) -> str:
    """Without decimals, but some is not none, and nearly all is not all.

    Example:
        >>> [format_whole_percent(share) for share in (0.0, 0.001, 0.126, 0.999, 1.0)]
        ['0', '1', '13', '99', '100']
    """
    return f"{min(max(round(100 * share), 1), 99) if 0 < share < 1 else 100 * share:.0f}"
