"""What a run with a target error says in the end: whether it was reached, and what it would take."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import groupby
from typing import Any

from torchcover.coverage import Coverage, Region
from torchcover.evaluation.target_error import Standing, TargetError, standings
from torchcover.report import json_record


def outcome(
    target: TargetError | None, coverages: Mapping[str, Coverage], regions: Sequence[Region], *, confirmed: bool
) -> tuple[dict[str, Any] | None, list[str]]:
    """What was aimed at and what was reached at the end of a run.

    Args:
        target: What is good enough; None if nothing was aimed at.
        coverages: As in `standings`.
        regions: Regions within the grid.
        confirmed: Whether the run has ended because every number was good enough at two looks in a row.

    Returns:
        A record for `summary.json`, with errors in metres or as shares, and lines for the terminal.
    """
    if target is None:
        return None, []
    found, first = standings(target, coverages, regions), next(iter(coverages.values()))
    blank = [f"{row.region} {row.height}" for row in first.summary(regions) if not row.known_cells]
    lines = _lines(found, first.counts["steps"], confirmed=confirmed)
    if blank:
        lines.append(f"Not waited for, as no cell of it is known: {', '.join(blank)}.")
    return {**_record(target, found), "reached": confirmed, "unknown": blank}, lines


def _record(target: TargetError, found: Sequence[Standing]) -> dict[str, Any]:
    needed = [standing.steps_needed for standing in found]
    known = [steps for steps in needed if steps is not None]
    numbers = []
    for standing, steps in zip(found, needed, strict=True):
        record = {name: value for name, value in asdict(standing).items() if name != "steps"}
        numbers.append(json_record({**record, "reached": standing.reached, "steps_needed": steps}))
    return {
        **asdict(target),
        "steps_needed": max(known) if known and len(known) == len(needed) else None,
        "numbers": numbers,
    }


def _lines(found: Sequence[Standing], steps: int, *, confirmed: bool) -> list[str]:
    """That it was reached, or the worst number of each region and band and what it would take."""
    if not found:
        return ["Target error not reached: no region has a known cell."]
    if confirmed:
        return [f"Target error reached after {steps:,} steps."]
    after = f"Target error not reached in {steps:,} step{'s' * (steps != 1)}"
    if all(standing.reached for standing in found):
        return [f"{after}: every error is small enough now, but was not at two looks in a row; take more steps."]
    lines = [f"{after}; the largest of each region:"]
    for (region, height), group in groupby(found, key=lambda standing: (standing.region, standing.height)):
        worst = max(group, key=lambda standing: standing.excess)
        where = f"  {region} {height}, {worst.quantity} of {worst.rig}"
        if worst.steps_needed is None:
            lines.append(f"{where}: not enough steps for an error")
        elif worst.reached:
            lines.append(f"{where}: {worst.words}, reached")
        else:
            needed = f"about {_two_digits(worst.steps_needed):,} different steps are needed"
            lines.append(f"{where}: {worst.words}, {needed}")
    return lines


def _two_digits(steps: int) -> int:
    unit: int = 10 ** max(0, len(str(steps)) - 2)
    return -(-steps // unit) * unit
