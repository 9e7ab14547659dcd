"""What a page shows first: plans of where a body is seen, what fails with a sensor, and how far is seen; as HTML."""

import math
from collections.abc import Sequence
from html import escape
from itertools import groupby

from torchcover.report.failures import decisive
from torchcover.report.page.content import PagePlan, PageRange
from torchcover.report.table import CoverageTable
from torchcover.report.verdict import BANDS
from torchcover.report.wording import UNKNOWN, capitalised, number_words, square_metres

# Of the plan, beyond which nothing is drawn; lines are so far from the vehicle.
REACH_M = 3.4
RINGS_M = 1.0, 2.0, 3.0
# By how many sensors a place is seen; two stands for more. The colours are in `page.css`.
SEEN_BY = "not seen", "by one sensor only", "by two or more"


def words_html(words: str) -> str:
    """A sentence, in which no number is parted from its per cent sign."""
    return escape(words).replace(" %", "&nbsp;%")


def ranges_of(table: CoverageTable) -> list[PageRange]:
    """What is detected in the regions that begin at the vehicle, for a picture."""
    key = decisive(table).key
    return [
        PageRange(
            f"{capitalised(BANDS.get(rows[0].summary.height, rows[0].summary.height))}, to {rows[0].region.x[1]:g} m",
            {row.rig: row.summary.numbers[key] for row in rows},
        )
        for rows in table.places
        if rows[0].region.x[0] == 0.0 and not rows[0].region.corners_m and table.thresholds
    ]


def plans_html(plans: Sequence[PagePlan]) -> str:
    """Plans beside each other, below a key."""
    if not plans:
        return ""
    key = "".join(f'<li><i class="seen{at}"></i>{words}</li>' for at, words in enumerate(SEEN_BY))
    most = max((loss for plan in plans for loss in plan.losses_m2.values()), default=0.0)
    return f'<ul class="key">{key}</ul><div class="plans">{"".join(_plan(plan, most) for plan in plans)}</div>'


def ranges_html(ranges: Sequence[PageRange]) -> str:
    """A line for each share, with dots for the rigs and bars for their intervals."""
    if not ranges:
        return ""
    lines = []
    for one in ranges:
        for at, (rig, number) in enumerate(one.of_rigs.items()):
            name = f'<th scope="rowgroup" rowspan="{len(one.of_rigs)}">{escape(one.name)}</th>' if at == 0 else ""
            marks, words = "", UNKNOWN
            if not math.isnan(number.value):
                value, words = 100 * number.value, words_html(f"{number_words(number)} %")
                marks = f'<circle cx="{value:.1f}" cy="4" r="1.6" class="rig{at % 2}"/>'
            if not math.isnan(number.low):
                ends = f'x1="{100 * number.low:.1f}" x2="{100 * number.high:.1f}"'
                marks += f'<line {ends} y1="4" y2="4" class="rig{at % 2}"/>'
            drawn = f'<svg viewBox="-3 0 106 8" aria-hidden="true"><path d="M0 8V7H100V8" class="axis"/>{marks}</svg>'
            lines.append(f'<tr>{name}<th scope="row">{escape(rig)}</th><td>{drawn}</td><td>{words}</td></tr>')
    table = f'<table class="ranges"><tbody>{"".join(lines)}</tbody></table>'
    return f'<h2>How far: share that is detected</h2><div class="wide">{table}</div>'


def _plan(plan: PagePlan, most_m2: float) -> str:
    rows = []
    for sensor, loss in plan.losses_m2.items():
        width = 100 * loss / most_m2 if most_m2 else 0.0
        bar = f'<svg viewBox="0 0 100 8" preserveAspectRatio="none"><rect width="{width:.1f}" height="8"/></svg>'
        lost = f"+{square_metres(loss)} m²"
        rows.append(f'<tr><th scope="row">{escape(sensor)}</th><td class="bar">{bar}</td><td>{lost}</td></tr>')
    title = f"If one sensor fails, more is not seen within {plan.within_m:g} m"
    losses = f'<table class="losses"><caption>{title}</caption><tbody>{"".join(rows)}</tbody></table>' if rows else ""
    words = f"<h2>{escape(plan.rig)}</h2><p>{words_html(plan.words)}</p>"
    return f'<section class="plan">{words}{_drawing(plan)}{losses}</section>'


def _drawing(plan: PagePlan) -> str:
    """SVG in metres: x forward to the right, y down."""
    (left, low), (right, high) = plan.vehicle_box_m.min(axis=0), plan.vehicle_box_m.max(axis=0)
    box = f"{left - REACH_M:.2f} {-high - REACH_M:.2f} {right - left + 2 * REACH_M:.2f} {high - low + 2 * REACH_M:.2f}"
    parts = [f'<path class="seen{at}" d="{_cells(plan, at)}"/>' for at in range(len(SEEN_BY))]
    for ring_m in RINGS_M:
        place = f'x="{left - ring_m:.2f}" y="{-high - ring_m:.2f}" rx="{ring_m:g}"'
        size = f'width="{right - left + 2 * ring_m:.2f}" height="{high - low + 2 * ring_m:.2f}"'
        parts.append(f'<rect class="{"ring counted" if ring_m == plan.within_m else "ring"}" {place} {size}/>')
        parts.append(f'<text x="{left - ring_m + 0.06:.2f}" y="0.1">{ring_m:g} m</text>')
    corners = " ".join(f"{x:.2f},{-y:.2f}" for x, y in plan.vehicle_outline_m)
    parts.append(f'<polygon points="{corners}"/><text x="{right - 0.25:.2f}" y="0.1" text-anchor="end">front →</text>')
    title = escape(f"Where {plan.rig} sees it, from above, forward to the right")
    return f'<svg viewBox="{box}" role="img" aria-label="{title}">{"".join(parts)}</svg>'


def _cells(plan: PagePlan, kind: int) -> str:
    """The cells of one colour, those beside each other in a row as one rectangle."""
    path = []
    for row, seen_by in enumerate(plan.seen_by.clip(max=len(SEEN_BY) - 1).tolist()):
        column = 0
        for one, run in groupby(seen_by):
            width = len(list(run))
            if one == kind:
                x, y = plan.x[0] + column * plan.cell_m, -plan.y[0] - (row + 1) * plan.cell_m
                wide, high = width * plan.cell_m, plan.cell_m
                path.append(f"M{x:.2f} {y:.2f}h{wide:.2f}v{high:.2f}h{-wide:.2f}z")
            column += width
    return "".join(path)
