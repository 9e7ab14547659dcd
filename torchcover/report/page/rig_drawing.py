"""A rig from above as SVG: the ego true to scale, where its sensors are and whereto they look; and a table of them."""

import math
from collections.abc import Sequence

import numpy as np

from torchcover.report.maps.overlay import SensorView, sensor_colour
from torchcover.report.page.content import Array
from torchcover.report.renderers.layout import PageTable, Words

MARGIN_M = 3.0
NUMBER_M = 0.34
# Of the drawing's diagonal: fields of view fade away, for nobody's range ends here.
FADE = 0.42
DASHED = 'stroke-width="0.03" stroke-dasharray="0.15 0.1"'
TITLE = "The rig from above, forward to the right. Fields of view fade out; how far they reach is in the table."


def rig_drawing(sensors: Sequence[SensorView], ego_outline_m: Array | None, number: int) -> str:
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
    parts += [_field(f"fade-{number}-{at}", sensor_colour(at), view, reach) for at, view in enumerate(sensors)]
    parts += [_disc(at, x, y) for at, (x, y) in enumerate(_apart(places))]
    parts.append(_scale_bar(left, -top))
    box = f"{left:.3f} {-bottom:.3f} {size[0]:.3f} {size[1]:.3f}"
    return f'<svg viewBox="{box}" role="img" aria-label="{TITLE}">{"".join(parts)}</svg><p class="note">{TITLE}</p>'


def sensor_table(sensors: Sequence[SensorView]) -> PageTable:
    """Where each sensor is, whereto it looks, and how far."""
    headings = ("sensor", "x, y, z (m)", "yaw (°)", "wide (°)", "high (°)", "range (m)")
    rows = []
    for at, view in enumerate(sensors):
        place = ", ".join(f"{value:.2f}" for value in view.position_m)
        low, high = view.vertical_fov_deg
        each = f"{view.yaw_deg:.1f}", f"{view.horizontal_fov_deg:.1f}", f"{low:.1f} to {high:.1f}", f"{view.range_m:g}"
        rows.append(tuple(map(Words, (f"{at + 1}  {view.name}", place, *each))))
    return PageTable("", headings, rows)


def _span(values: Array) -> tuple[float, float]:
    return float(values.min()) - MARGIN_M, float(values.max()) + MARGIN_M


def _field(name: str, colour: str, view: SensorView, reach: float) -> str:
    """A field of view that fades away, from above; y is down in SVG."""
    x, y = view.x_m, -view.y_m
    stops = "".join(f'<stop offset="{at}" stop-color="{colour}" stop-opacity="{0.5 - 0.5 * at}"/>' for at in (0, 1))
    circle = f'cx="{x:.3f}" cy="{y:.3f}" r="{reach:.3f}"'
    fade = f'<radialGradient id="{name}" gradientUnits="userSpaceOnUse" {circle}>{stops}</radialGradient>'
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
        f'<circle cx="{x:.3f}" cy="{-y:.3f}" r="{NUMBER_M / 2}" fill="{sensor_colour(at)}" stroke="white" '
        f'stroke-width="0.03"/><text x="{x:.3f}" y="{-y + 0.075:.3f}" font-size="0.22" text-anchor="middle" '
        f'fill="white" font-family="sans-serif">{at + 1}</text>'
    )


def _scale_bar(left: float, bottom: float) -> str:
    x, y = left + 0.3, bottom - 0.3
    line = f"M{x:.3f} {y - 0.1:.3f}V{y:.3f}H{x + 1:.3f}V{y - 0.1:.3f}"
    font = 'font-size="0.32" font-family="sans-serif" fill="currentColor"'
    words = f'<text x="{x + 1.15:.3f}" y="{y:.3f}" {font}>1 m</text>'
    return f'<path d="{line}" fill="none" stroke="currentColor" stroke-width="0.04"/>{words}'
