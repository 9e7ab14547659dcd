"""What the reader of a table has to know about the numbers of a rig, as data; `notes` has the words."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from torchcover.coverage import Coverage, RegionSummary
from torchcover.coverage.blocks import MIN_BLOCKS

RemarkName = Literal[
    "no_region",
    "unknown_cells",
    "too_few_blocks",
    "standard_errors",
    "one_block_regions",
    "empty_sensor_steps",
    "empty_reference_steps",
    "saturated_points",
    "outside_points",
]


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


def remarks_on(coverage: Coverage, blocks: int | None, rows: Sequence[RegionSummary]) -> tuple[Remark, ...]:
    """What is to be known about a coverage and its rows, of that which did happen.

    Args:
        coverage: What `CoverageMetric.compute` returned.
        blocks: How many blocks of steps are in use; None without errors.
        rows: Its summary.
    """
    counts, inside = coverage.counts, int(coverage.points.sum())
    cells, known = sum(row.cells for row in rows), sum(row.known_cells for row in rows)
    found = [
        Remark("no_region", int(not rows), 1),
        Remark("unknown_cells", cells - known, cells),
        *_on_errors(blocks, rows),
        Remark("empty_sensor_steps", counts["empty_sensor_steps"], counts["steps"]),
        Remark("empty_reference_steps", counts["empty_reference_steps"], counts["steps"]),
        Remark("saturated_points", counts["saturated_points"], inside),
        Remark("outside_points", counts["outside_points"], inside + counts["outside_points"]),
    ]
    return tuple(remark for remark in found if remark.count)


def _on_errors(blocks: int | None, rows: Sequence[RegionSummary]) -> list[Remark]:
    if blocks is None:
        return []
    if blocks < MIN_BLOCKS:
        return [Remark("too_few_blocks", blocks, MIN_BLOCKS)]
    without = sum(
        any(math.isfinite(number.value) and math.isnan(number.error) for number in row.numbers.values()) for row in rows
    )
    return [Remark("standard_errors", blocks, blocks), Remark("one_block_regions", without, len(rows))]
