"""Findings of a coverage table in sentences: the near field, detection ahead, and sensor failures."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torchcover.coverage import Region
from torchcover.estimation import MIN_BLOCKS, estimate_blocks_needed
from torchcover.report.number_format import format_square_meters
from torchcover.report.sensor_failures import describe_single_point_of_failure, get_failure_sensors, get_main_quantity
from torchcover.report.table import CoverageTable, Row


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
