"""Notes on the numbers of a coverage table."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from torchcover.estimation import estimate_blocks_needed
from torchcover.report.number_format import format_height_band, format_resolution
from torchcover.report.sensor_failures import describe_single_point_of_failure, get_failure_sensors
from torchcover.report.table import CoverageTable


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
