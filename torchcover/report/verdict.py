"""The answer in plain words. Each sentence comes from a rule, and no rule tells what may be chance."""

import math
from collections.abc import Callable, Sequence

from torchcover.coverage import Region
from torchcover.estimation import MIN_BLOCKS, blocks_needed
from torchcover.report.failures import decisive, sensors_of, single_point_of_failure
from torchcover.report.table import CoverageTable, Row

# The range that is told is that of the region ahead that reaches farthest, but no farther than this.
RANGE_M = 80.0
BANDS = {"ground": "the ground", "obstacle": "obstacles"}
# Of so many places that all say the same, at least nine in ten say it anywhere, with 95 % confidence: 0.9**30 < 0.05.
LEAST_AGREED = 30
SIDES = {"front_3m": "in front", "rear_3m": "behind", "left_3m": "on the left", "right_3m": "on the right"}


def verdict(table: CoverageTable) -> tuple[str, ...]:
    """What a meeting is told of a table; the first sentence says most.

    Args:
        table: Of one rig, or of several that are compared.

    Returns:
        Sentences: on bodies beside the vehicle, on the range, on the failure of a sensor; those that there are numbers
        for, or that steps are too few.
    """
    told = tuple(filter(None, (rule(table) for rule in RULES)))
    return tuple(filter(None, (*told, too_few(table, "ranges" if told else "an answer"))))


def too_few(table: CoverageTable, what: str) -> str:
    """Say that frames are too few for intervals, where these were asked for, and how many would give them.

    Args:
        table: Of one rig or several.
        what: What intervals are needed for: "an answer".

    Returns:
        A sentence; empty where some number has an interval, or where none was asked for.
    """
    steps, blocks = table.first.counts["steps"], table.first.blocks
    if blocks is None or table.has_intervals:
        return ""
    needed, ends = blocks_needed(blocks, table.first.effective[0]), table.block_ends
    begin = f"Not enough frames for {what}: {steps:,} form {blocks} block{'s' * (blocks != 1)} of time, "
    if ends and len(ends) < needed:
        return f"{begin}intervals need about {needed}, and this source has {len(ends)} in all."
    frames = ends[needed - 1] if ends else needed * (table.first.steps_per_block or 1)
    return f"{begin}intervals need about {needed}, which are {frames:,} frames (`--steps`)."


def on_near_field(table: CoverageTable) -> str:
    """At what share of the free places beside the vehicle the first body is seen, side by side."""
    rows = list(zip(*table.bodies.values(), strict=True))
    if not rows:
        return ""
    body, key = rows[0][0].summary.height, table.body_quantities[0].key
    near = [of for of in rows if of[0].summary.height == body and of[0].region.name in SIDES]
    of_sides = {SIDES[of[0].region.name]: of for of in near}
    enough = (table.first.blocks or 0) >= MIN_BLOCKS
    told = {
        side: _told(of, key, enough=enough and of[0].summary.numbers[key].count >= LEAST_AGREED)
        for side, of in of_sides.items()
    }
    known = [f"{side} {words}" for side, words in told.items() if words]
    seen = f"{body_words(body)} is seen"
    if known:
        return f"Free places within 3 m where {seen}: {'; '.join(known)}."
    unknown = all(math.isnan(row.summary.numbers[key].error) for of in of_sides.values() for row in of)
    several = len(table.rigs) > 1 and not unknown
    return f"Of the places within 3 m where {seen}, no rig has more than the others beyond chance." * several


def on_range(table: CoverageTable) -> str:
    """What is detected ahead: of one rig with intervals, of several who leads by more than chance."""
    region = ahead(table)
    if region is None or not table.thresholds or not table.has_intervals:
        return ""
    key, where = decisive(table).key, f"to {region.x[1]:g} m ahead"
    bands = [of for of in table.places if of[0].region is region]
    told = {BANDS.get(of[0].summary.height, of[0].summary.height): _told(of, key, enough=True) for of in bands}
    known = [f"of {band} {words}" for band, words in told.items() if words]
    if known:
        return f"Detected {where}: {'; '.join(known)}."
    return f"No rig detects more than the others {where} beyond chance." * (len(table.rigs) > 1)


def ahead(table: CoverageTable) -> Region | None:
    """The region that the range is told of: of those that begin at the vehicle the farthest to `RANGE_M`; else none."""
    regions = dict.fromkeys(of[0].region for of in table.places)
    reached = [one for one in regions if one.x[0] == 0.0 and one.x[1] <= RANGE_M and not one.corners_m]
    return max(reached, key=lambda one: one.x[1], default=None)


def on_failure(table: CoverageTable) -> str:
    """The sensor that most hangs on, of each rig."""
    asked = [rig for rig in table.rigs if sensors_of(table.rows[rig])]
    several = len(table.rigs) > 1
    return " ".join(f"{rig}: " * several + single_point_of_failure(table, rig) for rig in asked)


RULES: tuple[Callable[[CoverageTable], str], ...] = (on_near_field, on_range, on_failure)


def _told(rows: Sequence[Row], key: str, *, enough: bool) -> str:
    """A share of one rig with its interval; of several who leads by more than chance; no words if nobody knows."""
    if len(rows) == 1:
        number = rows[0].summary.numbers[key]
        # Where all blocks say the same there is no interval, and nothing is left to chance.
        agreed = math.isnan(number.low) and number.value in (0.0, 1.0) and enough
        interval = "" if agreed else f" [{whole_percent(number.low)}, {whole_percent(number.high)}]"
        return f"{whole_percent(number.value)} %{interval}" if agreed or not math.isnan(number.low) else ""
    leader = next((row for row in rows if key in row.best), None)
    if leader is None:
        return ""
    second = max((row for row in rows if row is not leader), key=lambda row: row.summary.numbers[key].value)
    return ", ".join(f"{row.rig} {whole_percent(row.summary.numbers[key].value)} %" for row in (leader, second))


def body_words(name: str) -> str:
    """What a body is called in a sentence.

    Example:
        >>> body_words("child_110cm"), body_words("adult")
        ('a child', 'an adult')
    """
    plain = name.partition("_")[0]
    return f"{'an' if plain[:1] in 'aeiou' else 'a'} {plain}"


def whole_percent(share: float) -> str:
    """Without decimals, but some is not none, and nearly all is not all.

    Example:
        >>> [whole_percent(share) for share in (0.0, 0.001, 0.126, 0.999, 1.0)]
        ['0', '1', '13', '99', '100']
    """
    return f"{min(max(round(100 * share), 1), 99) if 0 < share < 1 else 100 * share:.0f}"
