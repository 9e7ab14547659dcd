"""Drawings of a page as SVG and HTML: where a body is seen, what fails with a sensor, how far is seen, the rigs."""

import math
from collections.abc import Sequence
from itertools import groupby

import numpy as np

from torchcover.notebooks import escape_html, escape_html_attribute
from torchcover.report.number_format import UNKNOWN, format_number, format_square_meters
from torchcover.report.overlay import SensorView, get_sensor_color
from torchcover.report.page.content import Array, DetectionShares, TargetVisibilityMap
from torchcover.report.table import CoverageTable
from torchcover.report.table_layout import PageTable, TextCell
from torchcover.report.table_notes import describe_criterion, describe_surface, get_main_quantity

# Of the plan, beyond which nothing is drawn; lines are so far from the vehicle.
REACH_M = 3.4
RINGS_M = 1.0, 2.0, 3.0
# By how many sensors a place is seen; two stands for more. The colours are in `page.css`.
SEEN_BY = "not seen", "by one sensor only", "by two or more"


def render_text_html(text: str) -> str:
    """A sentence in HTML: no break before a per cent sign, and words between backticks as code."""
    return escape_html(text).replace(" %", "&nbsp;%")


def build_detection_shares(table: CoverageTable) -> list[DetectionShares]:
    """What is detected in the regions that begin at the vehicle, for a picture."""
    key = get_main_quantity(table).key
    return [
        DetectionShares(
            f"{describe_surface(table, rows[0])} to {rows[0].region.x_m[1]:g} m: {describe_criterion(table)}",
            {row.rig: row.summary.numbers[key] for row in rows},
        )
        for rows in table.rows_by_region
        if rows[0].region.x_m[0] == 0.0 and not rows[0].region.corners_m and table.thresholds_m
    ]


def render_target_maps(target_maps: Sequence[TargetVisibilityMap]) -> str:
    """Plans beside each other, below a key."""
    if not target_maps:
        return ""
    key = "".join(f'<li><i class="seen{at}"></i>{words}</li>' for at, words in enumerate(SEEN_BY))
    most = max((loss for plan in target_maps for loss in plan.failure_effects_m2.values()), default=0.0)
    return f'<ul class="key">{key}</ul><div class="plans">{"".join(_plan(plan, most) for plan in target_maps)}</div>'


def render_detection_shares(detection_shares: Sequence[DetectionShares]) -> str:
    """A line for each share, with dots for the rigs and bars for their intervals."""
    if not detection_shares:
        return ""
    lines = []
    for one in detection_shares:
        for at, (rig, number) in enumerate(one.shares.items()):
            name = (
                f'<th scope="rowgroup" rowspan="{len(one.shares)}">{render_text_html(one.name)}</th>' if at == 0 else ""
            )
            marks, words = "", UNKNOWN
            if not math.isnan(number.value):
                value, words = 100 * number.value, render_text_html(f"{format_number(number)} %")
                marks = f'<circle cx="{value:.1f}" cy="4" r="1.6" class="rig{at % 2}"/>'
            if not math.isnan(number.low):
                ends = f'x1="{100 * number.low:.1f}" x2="{100 * number.high:.1f}"'
                marks += f'<line {ends} y1="4" y2="4" class="rig{at % 2}"/>'
            drawn = f'<svg viewBox="-3 0 106 8" aria-hidden="true"><path d="M0 8V7H100V8" class="axis"/>{marks}</svg>'
            lines.append(f'<tr>{name}<th scope="row">{render_text_html(rig)}</th><td>{drawn}</td><td>{words}</td></tr>')
    table = f'<table class="ranges"><tbody>{"".join(lines)}</tbody></table>'
    return f'<h2>How far: share that is detected</h2><div class="wide">{table}</div>'


def _plan(plan: TargetVisibilityMap, most_m2: float) -> str:
    rows = []
    for sensor, loss in plan.failure_effects_m2.items():
        width = 100 * loss / most_m2 if most_m2 else 0.0
        bar = f'<svg viewBox="0 0 100 8" preserveAspectRatio="none"><rect width="{width:.1f}" height="8"/></svg>'
        lost = f"+{format_square_meters(loss)} m²"
        rows.append(
            f'<tr><th scope="row">{render_text_html(sensor)}</th><td class="bar">{bar}</td><td>{lost}</td></tr>'
        )
    title = f"If one sensor fails, more is not seen within {plan.max_distance_m:g} m"
    losses = f'<table class="losses"><caption>{title}</caption><tbody>{"".join(rows)}</tbody></table>' if rows else ""
    words = f"<h2>{render_text_html(plan.rig)}</h2><p>{render_text_html(plan.title)}</p>"
    return f'<section class="plan">{words}{_plan_drawing(plan)}{losses}</section>'


def _plan_drawing(plan: TargetVisibilityMap) -> str:
    """SVG in metres: x forward to the right, y down."""
    (left, low), (right, high) = plan.vehicle_box_m.min(axis=0), plan.vehicle_box_m.max(axis=0)
    box = f"{left - REACH_M:.2f} {-high - REACH_M:.2f} {right - left + 2 * REACH_M:.2f} {high - low + 2 * REACH_M:.2f}"
    parts = [f'<path class="seen{at}" d="{_cells(plan, at)}"/>' for at in range(len(SEEN_BY))]
    for ring_m in RINGS_M:
        place = f'x="{left - ring_m:.2f}" y="{-high - ring_m:.2f}" rx="{ring_m:g}"'
        size = f'width="{right - left + 2 * ring_m:.2f}" height="{high - low + 2 * ring_m:.2f}"'
        parts.append(f'<rect class="{"ring counted" if ring_m == plan.max_distance_m else "ring"}" {place} {size}/>')
        parts.append(f'<text x="{left - ring_m + 0.06:.2f}" y="0.1">{ring_m:g} m</text>')
    corners = " ".join(f"{x:.2f},{-y:.2f}" for x, y in plan.vehicle_outline_m)
    parts.append(f'<polygon points="{corners}"/><text x="{right - 0.25:.2f}" y="0.1" text-anchor="end">front →</text>')
    title = escape_html_attribute(f"Where {plan.rig} sees it, from above, forward to the right")
    return f'<svg viewBox="{box}" role="img" aria-label="{title}">{"".join(parts)}</svg>'


def _cells(plan: TargetVisibilityMap, kind: int) -> str:
    """The cells of one colour, those beside each other in a row as one rectangle."""
    path = []
    for row, seen_by in enumerate(plan.sensor_counts.clip(max=len(SEEN_BY) - 1).tolist()):
        column = 0
        for one, run in groupby(seen_by):
            width = len(list(run))
            if one == kind:
                x, y = plan.x[0] + column * plan.cell_m, -plan.y[0] - (row + 1) * plan.cell_m
                wide, high = width * plan.cell_m, plan.cell_m
                path.append(f"M{x:.2f} {y:.2f}h{wide:.2f}v{high:.2f}h{-wide:.2f}z")
            column += width
    return "".join(path)


MARGIN_M = 3.0
NUMBER_M = 0.34
# Of the drawing's diagonal: fields of view fade away, for nobody's range ends here.
FADE = 0.42
DASHED = 'stroke-width="0.03" stroke-dasharray="0.15 0.1"'
TITLE = "The rig from above, forward to the right. Fields of view fade out; how far they reach is in the table."


def render_rig(sensors: Sequence[SensorView], ego_outline_m: Array | None, number: int) -> str:
    """An SVG element with x forward to the right; fields of view fade out, for they are longer than the paper.

    `sensors`: what to draw; `ego_outline_m`: (K, 2) corners x, y of the ego in metres, if it is known; `number`: of the
    rig on its page: no two drawings share a name.
    """
    places = np.array([[view.x_m, view.y_m] for view in sensors])
    every = places if ego_outline_m is None else np.vstack([places, ego_outline_m])
    (left, right), (top, bottom) = _span(every[:, 0]), _span(every[:, 1])
    size = right - left, bottom - top
    reach = FADE * math.hypot(*size)
    parts = []
    if ego_outline_m is not None:
        corners = " ".join(f"{x:.3f},{-y:.3f}" for x, y in ego_outline_m)
        parts.append(f'<polygon points="{corners}" fill="none" stroke="currentColor" stroke-width="0.05"/>')
    parts += [_field(f"fade-{number}-{at}", get_sensor_color(at), view, reach) for at, view in enumerate(sensors)]
    parts += [_disc(at, x, y) for at, (x, y) in enumerate(_apart(places))]
    parts.append(_scale_bar(left, -top))
    box = f"{left:.3f} {-bottom:.3f} {size[0]:.3f} {size[1]:.3f}"
    return f'<svg viewBox="{box}" role="img" aria-label="{TITLE}">{"".join(parts)}</svg><p class="note">{TITLE}</p>'


def build_sensor_table(sensors: Sequence[SensorView]) -> PageTable:
    """Where each sensor is, whereto it looks, and how far."""
    headings = ("sensor", "x, y, z (m)", "yaw, pitch, roll (°)", "wide (°)", "high (°)", "range (m)")
    rows = []
    for at, view in enumerate(sensors):
        place = ", ".join(f"{value:.2f}" for value in view.position_m)
        low, high = view.vertical_fov_deg
        turned = ", ".join(f"{round(angle, 1) + 0.0:.1f}" for angle in (view.yaw_deg, *view.tilt_deg))
        each = turned, f"{view.horizontal_fov_deg:.1f}", f"{low:.1f} to {high:.1f}", f"{view.range_m:g}"
        rows.append(tuple(map(TextCell, (f"{at + 1}  {view.name}", place, *each))))
    return PageTable("", headings, rows)


def _span(values: Array) -> tuple[float, float]:
    return float(values.min()) - MARGIN_M, float(values.max()) + MARGIN_M


def _field(name: str, colour: str, view: SensorView, reach: float) -> str:
    """A field of view that fades away, from above; y is down in SVG."""
    x, y = view.x_m, -view.y_m
    stops = "".join(f'<stop offset="{at}" stop-color="{colour}" stop-opacity="{0.5 - 0.5 * at}"/>' for at in (0, 1))
    circle = f'cx="{x:.3f}" cy="{y:.3f}" r="{reach:.3f}"'
    fade = f'<radialGradient id="{name}" gradientUnits="userSpaceOnUse" {circle}>{stops}</radialGradient>'
    if view.is_tilted:
        corners = " ".join(f"{x:.3f},{-y:.3f}" for x, y in view.compute_outline_m(reach))
        return f'{fade}<polygon points="{corners}" fill="url(#{name})" stroke="{colour}" {DASHED}/>'
    reach = view.compute_level_range_m(reach)
    circle = f'cx="{x:.3f}" cy="{y:.3f}" r="{reach:.3f}"'
    if view.horizontal_fov_deg >= 360:
        return f'{fade}<circle {circle} fill="url(#{name})"/>'
    yaw, half = math.radians(view.yaw_deg), math.radians(view.horizontal_fov_deg / 2)
    ends = [f"{x + reach * math.cos(a):.3f} {y - reach * math.sin(a):.3f}" for a in (yaw - half, yaw + half)]
    corner, large = f"{x:.3f} {y:.3f}", int(view.horizontal_fov_deg > 180)
    sector = f"M{corner}L{ends[0]}A{reach:.3f} {reach:.3f} 0 {large} 0 {ends[1]}Z"
    edges = f'<path d="M{ends[0]}L{corner}L{ends[1]}" fill="none" stroke="{colour}" {DASHED}/>'
    return f'{fade}<path d="{sector}" fill="url(#{name})"/>{edges}'


def _apart(places: Array) -> Array:
    """Where to write the numbers: what would overlap stands beside each other."""
    taken: list[Array] = []
    for place in places:
        spot = place.copy()
        while any(np.hypot(*(spot - other)) < NUMBER_M for other in taken):
            spot[0] += NUMBER_M
        taken.append(spot)
    return np.array(taken)


def _disc(at: int, x: float, y: float) -> str:
    return (
        f'<circle cx="{x:.3f}" cy="{-y:.3f}" r="{NUMBER_M / 2}" fill="{get_sensor_color(at)}" stroke="white" '
        f'stroke-width="0.03"/><text x="{x:.3f}" y="{-y + 0.075:.3f}" font-size="0.22" text-anchor="middle" '
        f'fill="white" font-family="sans-serif">{at + 1}</text>'
    )


def _scale_bar(left: float, bottom: float) -> str:
    x, y = left + 0.3, bottom - 0.3
    line = f"M{x:.3f} {y - 0.1:.3f}V{y:.3f}H{x + 1:.3f}V{y - 0.1:.3f}"
    font = 'font-size="0.32" font-family="sans-serif" fill="currentColor"'
    words = f'<text x="{x + 1.15:.3f}" y="{y:.3f}" {font}>1 m</text>'
    return f'<path d="{line}" fill="none" stroke="currentColor" stroke-width="0.04"/>{words}'
