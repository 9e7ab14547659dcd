"""Coverage table in sentences: findings, notes on its numbers, and the effects of sensor failures."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from textwrap import fill

from torchcover.coverage import Region, RegionRedundancy
from torchcover.coverage.quantities import RADIUS, make_redundancy_quantity, make_sensor_count_quantity
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

MAX_HEADING_CHARS = 16  # headings of columns are wrapped at this width


def get_main_quantity(table: CoverageTable) -> Quantity:
    """Return the quantity by which sensors are compared: detection at the first threshold, or the radius without one.

    Args:
        table: The table.
    """
    return table.mean_quantities[min(1, len(table.thresholds_m))]


def get_failure_sensors(rows: Sequence[Row]) -> tuple[str, ...]:
    """Return the sensors whose failure was evaluated.

    Args:
        rows: Rows of one rig.

    Returns:
        Names of the sensors; empty without redundancy.
    """
    for row in rows:
        if row.summary.redundancy:
            return tuple(row.summary.redundancy.failure_numbers)
    return ()


def format_failure_title(table: CoverageTable, rig: str) -> str:
    """Format the title of the table of sensor failures.

    Args:
        table: The table.
        rig: Name of the rig.
    """
    prefix = f"{rig}: change" if len(table.rigs) > 1 else "Change"
    return f"{prefix} of {format_difference_heading(get_main_quantity(table))} when one sensor fails"


def format_failure_headings(table: CoverageTable, rig: str) -> list[str]:
    """Format the headings of the table of sensor failures, without region and band.

    Args:
        table: The table.
        rig: Name of the rig.
    """
    redundancy = [fill(heading, MAX_HEADING_CHARS) for heading in ("detecting sensors", "by two or more (%)")]
    return [
        *(redundancy if table.thresholds_m else ()),
        *get_failure_sensors(table.rows[rig]),
        fill("largest effect", MAX_HEADING_CHARS),
    ]


def format_failure_cells(table: CoverageTable, row: Row) -> list[tuple[str, bool]]:
    """Format a row of the table of sensor failures.

    Args:
        table: The table.
        row: One row of a rig.

    Returns:
        Text of each cell, and whether it is a significant change.
    """
    redundancy, key = row.summary.redundancy, get_main_quantity(table).key
    sensors = get_failure_sensors(table.rows[row.rig])
    if redundancy is None:
        return [(UNKNOWN, False)] * len(format_failure_headings(table, row.rig))
    cells = []
    for threshold_m in table.thresholds_m[:1]:
        for quantity in (make_sensor_count_quantity(threshold_m), make_redundancy_quantity(threshold_m)):
            cells.append((format_number(redundancy.detecting_sensors[quantity.key]), False))
    for sensor in sensors:
        change = redundancy.failure_effects[sensor][key]
        cells.append((format_difference(change), bool(change.is_significant)))
    no_sensor = UNKNOWN if math.isnan(row.summary.numbers[key].value) else "none"
    return [*cells, (redundancy.most_critical_sensor or no_sensor, False)]


@dataclass(frozen=True)
class FailureParams:
    """Parameters of the test for a single point of failure.

    Args:
        min_share: Minimum share of the detection rate that is lost, or by which the radius grows. The default of a
            tenth exceeds the influence of settings on a number, see docs/accuracy.md.
    """

    min_share: float = 0.1


def describe_single_point_of_failure(table: CoverageTable, rig: str, params: FailureParams = FailureParams()) -> str:
    """Describe the failure of a sensor with the largest loss, if the loss is large and significant.

    Args:
        table: The table.
        rig: Name of the rig.
        params: Criterion of a single point of failure.

    Returns:
        A sentence; empty without redundancy.
    """
    quantity, rows = get_main_quantity(table), table.rows[rig]
    sensors = get_failure_sensors(rows)
    if not sensors:
        return ""
    values = [row.summary.numbers[quantity.key].value for row in rows]
    if all(math.isnan(value) for value in values):
        return "Single point of failure unknown: no surface in the regions was observed."
    if quantity.key != RADIUS.key and not any(value > 0.0 for value in values):
        return "Single point of failure unknown: nothing in the regions is detected with all sensors."
    if len(sensors) == 1:
        return f"Single point of failure: {sensors[0]} is the only sensor."
    worst, is_significant = _find_worst_failure(rows, quantity, params.min_share)
    if worst is None or (redundancy := worst.summary.redundancy) is None or redundancy.most_critical_sensor is None:
        min_share = f"{100 * params.min_share:g} %"
        return (
            f"No single point of failure: no failure of a sensor changes a number significantly by {min_share} or more."
        )
    sensor = redundancy.most_critical_sensor
    before = format_value(worst.summary.numbers[quantity.key].value, quantity.unit)
    after = format_value(redundancy.failure_numbers[sensor][quantity.key].value, quantity.unit)
    unit = "m" if quantity.unit == "m" else "%"
    region = f"{worst.summary.region} {worst.summary.band}"
    change = f"{quantity.title} in {region} changes from {before} to {after} {unit}"
    if is_significant:
        return f"Single point of failure: {sensor}; without it, {change}."
    return f"Largest effect of a failure: without {sensor}, {change}; its significance is unknown."


def _find_worst_failure(rows: Sequence[Row], quantity: Quantity, min_share: float) -> tuple[Row | None, bool]:
    """Find the row with the largest loss, and whether it is significant; significant losses come first."""
    candidates = []
    for row in rows:
        if _compute_lost_share(row, quantity) >= min_share and _is_significant(row, quantity) is not False:
            candidates.append(row)
    significant = [row for row in candidates if _is_significant(row, quantity)]
    worst: Row | None = None
    for row in significant or candidates:
        if worst is None or _get_loss(row.summary.redundancy, quantity) > _get_loss(worst.summary.redundancy, quantity):
            worst = row
    return worst, bool(significant)


def _compute_lost_share(row: Row, quantity: Quantity) -> float:
    """Compute the loss without the most critical sensor, as a share of the number with all sensors."""
    loss, value = _get_loss(row.summary.redundancy, quantity), row.summary.numbers[quantity.key].value
    return loss / value if loss > 0 and value > 0 else 0.0


def _is_significant(row: Row, quantity: Quantity) -> bool | None:
    """Return whether the loss without the most critical sensor is significant; None if unknown."""
    redundancy = row.summary.redundancy
    if redundancy is None or redundancy.most_critical_sensor is None:
        return None
    return redundancy.failure_effects[redundancy.most_critical_sensor][quantity.key].is_significant


def _get_loss(redundancy: RegionRedundancy | None, quantity: Quantity) -> float:
    """Return the loss without the most critical sensor; 0 without redundancy or effect."""
    if redundancy is None or redundancy.most_critical_sensor is None:
        return 0.0
    return -redundancy.failure_effects[redundancy.most_critical_sensor][quantity.key].improvement


@dataclass(frozen=True)
class TableNote:
    """Note on the numbers of a rig.

    Args:
        name: Key of the note.
        count: Number of cases, such as frames without sensor points.
        total: Number of all frames, points, cells or rows.
        sentence: The note in words.
    """

    name: str
    count: int
    total: int
    sentence: str


def collect_table_notes(table: CoverageTable, rig: str) -> tuple[TableNote, ...]:
    """Collect the notes on the numbers of a rig whose count is not 0.

    Args:
        table: The table.
        rig: Name of the rig.
    """
    return tuple(note for note in _build_notes(table, rig) if note.count)


def _build_notes(table: CoverageTable, rig: str) -> Iterator[TableNote]:
    """Yield all notes on the numbers of a rig, also those whose count is 0."""
    summaries = [row.summary for row in table.rows[rig]]
    yield TableNote("no_region", int(not summaries), 1, "No regions, so no numbers; the maps cover the whole grid.")
    if table.average == "area":
        sentence = "Numbers are means over the surface area that the reference observes."
        yield TableNote("visible_surface", len(summaries), len(summaries), sentence)
    else:
        cell_count = sum(summary.num_cells for summary in summaries)
        observed_count = sum(summary.observed_cells for summary in summaries)
        sentence = "Numbers are means over observed cells only; a small observed share biases them in favor of the rig."
        yield TableNote("unobserved_cells", cell_count - observed_count, cell_count, sentence)
    yield from _build_interval_notes(table, rig)
    counts, point_count = table.conditions[rig].counts, table.conditions[rig].point_count
    all_points = point_count + counts["outside_points"]
    outside_points = counts["outside_points"] - counts["no_ground_points"]
    limit = "infinity" if math.isinf(table.max_radius_m) else f"the maximum of {table.max_radius_m:.4g} m"
    # Buildings and trees lie above all bands; a share above 80 % suggests another coordinate frame.
    hint = " Check that z = 0 is the ground and x points forward." if outside_points > 0.8 * all_points else ""
    num_frames = counts["num_frames"]
    for name, count, total, predicate in (
        (
            "empty_sensor_frames",
            counts["empty_sensor_frames"],
            num_frames,
            "frames had no sensor points; they count as not covered.",
        ),
        (
            "empty_reference_frames",
            counts["empty_reference_frames"],
            num_frames,
            "frames had no reference points; they do not contribute.",
        ),
        (
            "saturated_points",
            counts["saturated_points"],
            point_count,
            f"reference points have no sensor point nearby; their radius is set to {limit}.",
        ),
        ("outside_points", outside_points, all_points, f"reference points outside the grid are excluded.{hint}"),
        (
            "no_ground_points",
            counts["no_ground_points"],
            all_points,
            "reference points have no ground below them; they are in no band.",
        ),
    ):
        yield TableNote(name, count, total, f"{count:,} of {total:,} {predicate}")


def _build_interval_notes(table: CoverageTable, rig: str) -> Iterator[TableNote]:
    """Yield the notes on confidence intervals."""
    conditions = table.conditions[rig]
    blocks, frames_per_block = conditions.blocks, conditions.frames_per_block or 0
    if blocks is None:
        return
    if not table.has_intervals:
        scenario = f" in {conditions.smallest_scene_kind}" * bool(conditions.smallest_scene_kind)
        needed = estimate_blocks_needed(blocks, table.first_conditions.effective_blocks[0])
        got = f"{blocks} block{'s' * (blocks != 1)}"
        sentence = f"Not enough frames for confidence intervals{scenario}: got {got}, about {needed} are needed."
        yield TableNote("too_few_blocks", blocks, needed, sentence)
        return
    keys = [quantity.key for quantity in table.mean_quantities]  # a maximum never has a standard error
    rows_without_interval = 0
    has_interval = False
    for row in table.rows[rig]:
        numbers = [row.summary.numbers[key] for key in keys]
        has_interval |= any(math.isfinite(number.low) for number in numbers)
        rows_without_interval += any(math.isfinite(number.value) and math.isnan(number.low) for number in numbers)
    length = f"up to {frames_per_block:,} consecutive frames" if frames_per_block > 1 else "one frame"
    sentence = f"Brackets: 95 % confidence intervals from {blocks} blocks of {length}."
    yield TableNote("intervals", blocks * has_interval, blocks, sentence)
    sentence = "Numbers without interval: too few blocks observe the region, or all blocks agree."
    yield TableNote("no_intervals", rows_without_interval, len(table.rows[rig]), sentence)


def list_notes(table: CoverageTable) -> list[str]:
    """List the notes on all numbers as sentences; a note on one rig begins with its name.

    Args:
        table: The table.
    """
    notes = merge_notes({rig: _format_rig_notes(table, rig) for rig in table.rigs})
    shared = {"cells": "the same cells are observed", "area": "the visible surface is the same"}[table.average]
    paired = [f"All rigs were measured against the same reference points, so that {shared}."]
    return [*(paired if len(table.rigs) > 1 else []), *notes, *table.notes]


def merge_notes(notes: Mapping[str, Sequence[str]]) -> list[str]:
    """Merge notes of several rigs: common notes first, then the others with the name of their rig.

    Args:
        notes: Name of the rig -> its notes.

    Example:
        >>> merge_notes({"roof": ["8 frames.", "Blind."], "grille": ["8 frames."]})
        ['8 frames.', 'roof: Blind.']
    """
    first_notes = next(iter(notes.values()))
    common = list(first_notes)
    for rig_notes in notes.values():
        common = [note for note in common if note in rig_notes]
    merged = list(common)
    for name, rig_notes in notes.items():
        merged += [f"{name}: {note}" for note in rig_notes if note not in common]
    return merged


def explain_marks(table: CoverageTable) -> dict[str, str]:
    """Explain the marks "best" and "significant" of numbers.

    Args:
        table: The table.

    Returns:
        Mark -> meaning; empty if nothing is marked.
    """
    has_rigs = len(table.rigs) > 1
    has_failures = any(get_failure_sensors(rows) for rows in table.rows.values())
    if not (has_rigs or has_failures) or not table.has_intervals:
        return {}
    best = {"best": "best of its row, with a significant lead over the next."} if has_rigs else {}
    significant = "significant by Student's t at 95 %; of 20 rows without a difference, one is marked on average."
    return {**best, "significant": significant}


def _format_rig_notes(table: CoverageTable, rig: str) -> list[str]:
    """Format the resolution, all notes and the single point of failure of a rig."""
    bands = ", ".join(f"{name} {format_height_band(table.grid, name)}" for name in table.grid.heights)
    resolution = f"{format_resolution(table.conditions[rig].counts['num_frames'], table.grid)}; {bands}."
    sentences = [note.sentence for note in collect_table_notes(table, rig)]
    failure = describe_single_point_of_failure(table, rig)
    return [resolution, *sentences, *([failure] if failure else [])]


@dataclass(frozen=True)
class FindingsParams:
    """Parameters of the sentences that summarize a table.

    Args:
        max_range_m: Regions ahead that reach farther are not summarized.
        min_agreeing_positions: Number of positions that must agree for a share of 0 or 100 % without interval: if 30
            agree, at least nine in ten agree anywhere with 95 % confidence, since 0.9 ** 30 < 0.05.
    """

    max_range_m: float = 80.0
    min_agreeing_positions: int = 30


def summarize_findings(table: CoverageTable) -> tuple[str, ...]:
    """Summarize a table in sentences, the most important first.

    Args:
        table: The table.

    Returns:
        Sentences about test targets, detection ahead, sensor failures, and missing confidence intervals, as far as the
        table has the numbers.
    """
    findings = [describe_near_field(table), describe_range(table), describe_failures(table)]
    findings = [finding for finding in findings if finding]
    missing = explain_missing_intervals(table, "confidence intervals" if findings else "an answer")
    return tuple([*findings, missing] if missing else findings)


def explain_missing_intervals(table: CoverageTable, subject: str) -> str:
    """Explain that there are too few frames for confidence intervals, and how many are needed.

    Args:
        table: The table.
        subject: Purpose of the intervals, such as "an answer".

    Returns:
        A sentence; empty if some number has an interval, or if no intervals were requested.
    """
    num_frames, blocks = table.first_conditions.counts["num_frames"], table.first_conditions.blocks
    if blocks is None or table.has_intervals:
        return ""
    needed = estimate_blocks_needed(blocks, table.first_conditions.effective_blocks[0])
    got = f"{num_frames:,} frames form {blocks} block{'s' * (blocks != 1)}"
    if table.block_ends and len(table.block_ends) < needed:
        return (
            f"Not enough frames for {subject}: {got}, {needed} are needed, and the source has {len(table.block_ends)}."
        )
    frames_per_block = table.first_conditions.frames_per_block or 1
    needed_frames = table.block_ends[needed - 1] if table.block_ends else needed * frames_per_block
    return (
        f"Not enough frames for {subject}: {got}, {needed} are needed (about {needed_frames:,} frames; `--num-frames`)."
    )


def describe_near_field(table: CoverageTable, params: FindingsParams = FindingsParams()) -> str:
    """Describe the share of free positions near the vehicle at which the first test target is detected, by side.

    Args:
        table: The table.
        params: Parameters of the sentence.

    Returns:
        A sentence; empty without test targets.
    """
    target_rows = list(zip(*table.target_rows.values(), strict=True))
    if not target_rows:
        return ""
    target, quantity = target_rows[0][0].summary.band, table.target_quantities[0]
    sides = {"front_3m": "in front", "rear_3m": "behind", "left_3m": "on the left", "right_3m": "on the right"}
    has_enough_blocks = (table.first_conditions.blocks or 0) >= MIN_BLOCKS
    texts: list[str] = []
    errors: list[float] = []
    for rows in target_rows:
        if rows[0].summary.band != target or rows[0].region.name not in sides:
            continue
        errors += [row.summary.numbers[quantity.key].error for row in rows]
        has_enough_positions = rows[0].summary.numbers[quantity.key].count >= params.min_agreeing_positions
        text = _describe_share(rows, quantity.key, is_sufficient=has_enough_blocks and has_enough_positions)
        if text:
            texts.append(f"{sides[rows[0].region.name]} {text}")
    criterion = quantity.title.removeprefix("free places with ").removeprefix("free positions with ")
    detected = f"{format_target_name(target)} is detected ({criterion})"
    if texts:
        return f"Free positions within 3 m where {detected}: {'; '.join(texts)}."
    if len(table.rigs) > 1 and not all(math.isnan(error) for error in errors):
        return f"Free positions within 3 m where {detected}: no rig has significantly more than the others."
    return ""


def describe_range(table: CoverageTable) -> str:
    """Describe detection ahead: of one rig with its interval, of several the one that leads significantly.

    Args:
        table: The table.

    Returns:
        A sentence; empty without a region ahead, thresholds or intervals.
    """
    region = find_forward_region(table)
    if region is None or not table.thresholds_m or not table.has_intervals:
        return ""
    key = get_main_quantity(table).key
    distance = f"to {region.x_m[1]:g} m ahead ({describe_criterion(table)})"
    texts = []
    for rows in table.rows_by_region:
        if rows[0].region is region and (text := _describe_share(rows, key, is_sufficient=True)):
            texts.append(f"of {describe_surface(table, rows[0])} {text}")
    if texts:
        return f"Detected {distance}: {'; '.join(texts)}."
    return f"No rig detects significantly more than the others {distance}." * (len(table.rigs) > 1)


def describe_criterion(table: CoverageTable) -> str:
    """Describe the criterion of detection: the maximum distance to a sensor point.

    Args:
        table: The table.
    """
    return f"a point within {table.thresholds_m[0]:g} m"


def describe_surface(table: CoverageTable, row: Row) -> str:
    """Describe the surface to which the numbers of a row refer: visible square meters, or observed cells.

    Args:
        table: Table of the row.
        row: One region and height band.

    Returns:
        Words such as "512.3 m² of visible ground".
    """
    surface = {"obstacle": "obstacles"}.get(row.summary.band, row.summary.band)
    if table.average == "area":
        return f"{format_square_meters(row.summary.visible_m2)} m² of visible {surface}"
    return f"{row.summary.observed_cells:,} observed cells of {surface}"


def find_forward_region(table: CoverageTable, params: FindingsParams = FindingsParams()) -> Region | None:
    """Find the rectangle that begins at the vehicle and reaches farthest ahead within the maximum range.

    Args:
        table: The table.
        params: Maximum range.

    Returns:
        The region; None if there is none.
    """
    farthest: Region | None = None
    for rows in table.rows_by_region:
        region = rows[0].region
        if region.x_m[0] != 0.0 or region.x_m[1] > params.max_range_m or region.corners_m:
            continue
        if farthest is None or region.x_m[1] > farthest.x_m[1]:
            farthest = region
    return farthest


def describe_failures(table: CoverageTable) -> str:
    """Describe the single point of failure of each rig.

    Args:
        table: The table.

    Returns:
        Sentences; empty without redundancy.
    """
    sentences = []
    for rig in table.rigs:
        if get_failure_sensors(table.rows[rig]):
            prefix = f"{rig}: " * (len(table.rigs) > 1)
            sentences.append(prefix + describe_single_point_of_failure(table, rig))
    return " ".join(sentences)


def _describe_share(rows: Sequence[Row], key: str, *, is_sufficient: bool) -> str:
    """Describe a share of one rig with its interval, or of several the leader; empty if it is not significant."""
    if len(rows) == 1:
        number = rows[0].summary.numbers[key]
        value = f"{format_whole_percent(number.value)} %"
        if not math.isnan(number.low):
            return f"{value} [{format_whole_percent(number.low)}, {format_whole_percent(number.high)}]"
        # If all blocks agree, there is no interval, and enough of them need none.
        return value if number.value in (0.0, 1.0) and is_sufficient else ""
    leader: Row | None = None
    second: Row | None = None
    for row in rows:
        if key in row.leading_keys:
            leader = row
        elif second is None or row.summary.numbers[key].value > second.summary.numbers[key].value:
            second = row
    if leader is None or second is None:
        return ""
    return ", ".join(f"{row.rig} {format_whole_percent(row.summary.numbers[key].value)} %" for row in (leader, second))


def format_target_name(name: str) -> str:
    """Format the name of a test target with its article.

    Args:
        name: Name of the target.

    Example:
        >>> format_target_name("child_110cm"), format_target_name("adult")
        ('a child', 'an adult')
    """
    noun = name.partition("_")[0]
    return f"{'an' if noun[:1] in 'aeiou' else 'a'} {noun}"


def format_whole_percent(share: float) -> str:
    """Format a share in percent without decimals, never rounded to 0 or 100.

    Args:
        share: Share in [0, 1].

    Example:
        >>> [format_whole_percent(share) for share in (0.0, 0.001, 0.126, 0.999, 1.0)]
        ['0', '1', '13', '99', '100']
    """
    return f"{min(max(round(100 * share), 1), 99) if 0 < share < 1 else 100 * share:.0f}"
