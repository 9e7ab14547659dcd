"""SVG and HTML of a page: maps of test targets, effects of failures, detection shares, and rigs."""

import math
from collections.abc import Sequence
from itertools import groupby

import numpy as np

from torchcover.notebooks import escape_html, escape_html_attribute
from torchcover.report.findings import describe_criterion, describe_surface
from torchcover.report.number_format import UNKNOWN, format_number, format_square_meters
from torchcover.report.overlay import SensorView, get_sensor_color
from torchcover.report.page.content import Array, DetectionShares, TargetVisibilityMap
from torchcover.report.sensor_failures import get_main_quantity
from torchcover.report.table import CoverageTable
from torchcover.report.table_layout import PageTable, build_text_cells

MAP_MARGIN_M = 3.4  # width of the map of test targets around the vehicle
# Labels of 0, 1 and 2 or more detecting sensors; their colors are in `page.css`.
SENSOR_COUNT_LABELS = ("not detected", "by one sensor", "by two or more")


def render_text_html(text: str) -> str:
    """Render a sentence as HTML without line breaks before percent signs, and with code between backticks.

    Args:
        text: The sentence.
    """
    return escape_html(text).replace(" %", "&nbsp;%")


def build_detection_shares(table: CoverageTable) -> list[DetectionShares]:
    """Build the detection shares of the rectangles that begin at the vehicle.

    Args:
        table: The table.
    """
    key, detection_shares = get_main_quantity(table).key, []
    for rows in table.rows_by_region:
        region = rows[0].region
        if region.x_m[0] == 0.0 and not region.corners_m and table.thresholds_m:
            name = f"{describe_surface(table, rows[0])} to {region.x_m[1]:g} m: {describe_criterion(table)}"
            shares = {row.rig: row.summary.numbers[key] for row in rows}
            detection_shares.append(DetectionShares(name, shares))
    return detection_shares


def render_target_maps(target_maps: Sequence[TargetVisibilityMap]) -> str:
    """Render maps of test targets side by side, below a legend.

    Args:
        target_maps: The maps.
    """
    if not target_maps:
        return ""
    legend = "".join(f'<li><i class="seen{count}"></i>{label}</li>' for count, label in enumerate(SENSOR_COUNT_LABELS))
    effects_m2: list[float] = []
    for target_map in target_maps:
        effects_m2 += target_map.failure_effects_m2.values()
    max_effect_m2 = max(effects_m2, default=0.0)
    maps = "".join(_render_target_map(target_map, max_effect_m2) for target_map in target_maps)
    return f'<ul class="key">{legend}</ul><div class="plans">{maps}</div>'


def render_detection_shares(detection_shares: Sequence[DetectionShares]) -> str:
    """Render a row for each share, with dots for the rigs and bars for their intervals.

    Args:
        detection_shares: The shares.
    """
    if not detection_shares:
        return ""
    lines = []
    for region_shares in detection_shares:
        for index, (rig, number) in enumerate(region_shares.shares.items()):
            heading, num_rows = render_text_html(region_shares.name), len(region_shares.shares)
            name = f'<th scope="rowgroup" rowspan="{num_rows}">{heading}</th>' if index == 0 else ""
            marks, words = "", UNKNOWN
            if not math.isnan(number.value):
                value, words = 100 * number.value, render_text_html(f"{format_number(number)} %")
                marks = f'<circle cx="{value:.1f}" cy="4" r="1.6" class="rig{index % 2}"/>'
            if not math.isnan(number.low):
                ends = f'x1="{100 * number.low:.1f}" x2="{100 * number.high:.1f}"'
                marks += f'<line {ends} y1="4" y2="4" class="rig{index % 2}"/>'
            drawn = f'<svg viewBox="-3 0 106 8" aria-hidden="true"><path d="M0 8V7H100V8" class="axis"/>{marks}</svg>'
            lines.append(f'<tr>{name}<th scope="row">{render_text_html(rig)}</th><td>{drawn}</td><td>{words}</td></tr>')
    table = f'<table class="ranges"><tbody>{"".join(lines)}</tbody></table>'
    return f'<h2>Detection by range</h2><div class="wide">{table}</div>'


def _render_target_map(target_map: TargetVisibilityMap, max_effect_m2: float) -> str:
    """Render the map of a test target and a bar for the loss without each sensor."""
    rows = []
    for sensor, loss in target_map.failure_effects_m2.items():
        width = 100 * loss / max_effect_m2 if max_effect_m2 else 0.0
        bar = f'<svg viewBox="0 0 100 8" preserveAspectRatio="none"><rect width="{width:.1f}" height="8"/></svg>'
        lost = f"+{format_square_meters(loss)} m²"
        rows.append(
            f'<tr><th scope="row">{render_text_html(sensor)}</th><td class="bar">{bar}</td><td>{lost}</td></tr>'
        )
    title = f"Additional undetected area within {target_map.max_distance_m:g} m if one sensor fails"
    losses = f'<table class="losses"><caption>{title}</caption><tbody>{"".join(rows)}</tbody></table>' if rows else ""
    words = f"<h2>{render_text_html(target_map.rig)}</h2><p>{render_text_html(target_map.title)}</p>"
    return f'<section class="plan">{words}{_render_target_svg(target_map)}{losses}</section>'


def _render_target_svg(target_map: TargetVisibilityMap) -> str:
    """Render an SVG in meters: x forward to the right, y down."""
    (left, low), (right, high) = target_map.vehicle_box_m.min(axis=0), target_map.vehicle_box_m.max(axis=0)
    width, height = right - left + 2 * MAP_MARGIN_M, high - low + 2 * MAP_MARGIN_M
    box = f"{left - MAP_MARGIN_M:.2f} {-high - MAP_MARGIN_M:.2f} {width:.2f} {height:.2f}"
    parts = [
        f'<path class="seen{count}" d="{_render_cells(target_map, count)}"/>'
        for count in range(len(SENSOR_COUNT_LABELS))
    ]
    for ring_m in (1.0, 2.0, 3.0):
        place = f'x="{left - ring_m:.2f}" y="{-high - ring_m:.2f}" rx="{ring_m:g}"'
        size = f'width="{right - left + 2 * ring_m:.2f}" height="{high - low + 2 * ring_m:.2f}"'
        parts.append(
            f'<rect class="{"ring counted" if ring_m == target_map.max_distance_m else "ring"}" {place} {size}/>'
        )
        parts.append(f'<text x="{left - ring_m + 0.06:.2f}" y="0.1">{ring_m:g} m</text>')
    corners = " ".join(f"{x:.2f},{-y:.2f}" for x, y in target_map.vehicle_outline_m)
    parts.append(f'<polygon points="{corners}"/><text x="{right - 0.25:.2f}" y="0.1" text-anchor="end">front →</text>')
    title = escape_html_attribute(
        f"Positions at which {target_map.rig} detects the target, from above, forward to the right"
    )
    return f'<svg viewBox="{box}" role="img" aria-label="{title}">{"".join(parts)}</svg>'


def _render_cells(target_map: TargetVisibilityMap, count: int) -> str:
    """Render the cells with a number of detecting sensors; adjacent cells of a row form one rectangle."""
    path = []
    for row, sensor_counts in enumerate(target_map.sensor_counts.clip(max=len(SENSOR_COUNT_LABELS) - 1).tolist()):
        column = 0
        for sensor_count, run in groupby(sensor_counts):
            width = len(list(run))
            if sensor_count == count:
                x, y = target_map.x[0] + column * target_map.cell_m, -target_map.y[0] - (row + 1) * target_map.cell_m
                wide, high = width * target_map.cell_m, target_map.cell_m
                path.append(f"M{x:.2f} {y:.2f}h{wide:.2f}v{high:.2f}h{-wide:.2f}z")
            column += width
    return "".join(path)


NUMBER_M = 0.34  # diameter of the number of a sensor
DASHED = 'stroke-width="0.03" stroke-dasharray="0.15 0.1"'
TITLE = "The rig from above, forward to the right. Fields of view fade out; ranges are in the table."


def render_rig(sensors: Sequence[SensorView], ego_outline_m: Array | None, number: int) -> str:
    """Render a rig as SVG with x forward to the right; fields of view fade out, since they are larger than the image.

    Args:
        sensors: Sensors of the rig.
        ego_outline_m: (K, 2) corners x, y of the ego vehicle in meters; None if unknown.
        number: Number of the rig on its page, for distinct identifiers.
    """
    positions = np.array([[view.x_m, view.y_m] for view in sensors])
    corners_m = positions if ego_outline_m is None else np.vstack([positions, ego_outline_m])
    (left, right), (top, bottom) = _find_bounds(corners_m[:, 0]), _find_bounds(corners_m[:, 1])
    size = right - left, bottom - top
    fade_m = 0.42 * math.hypot(*size)
    parts = []
    if ego_outline_m is not None:
        corners = " ".join(f"{x:.3f},{-y:.3f}" for x, y in ego_outline_m)
        parts.append(f'<polygon points="{corners}" fill="none" stroke="currentColor" stroke-width="0.05"/>')
    for index, view in enumerate(sensors):
        parts.append(_render_field_of_view(f"fade-{number}-{index}", get_sensor_color(index), view, fade_m))
    parts += [_render_number(index, x, y) for index, (x, y) in enumerate(_separate_numbers(positions))]
    parts.append(_render_scale_bar(left, -top))
    box = f"{left:.3f} {-bottom:.3f} {size[0]:.3f} {size[1]:.3f}"
    return f'<svg viewBox="{box}" role="img" aria-label="{TITLE}">{"".join(parts)}</svg><p class="note">{TITLE}</p>'


def build_sensor_table(sensors: Sequence[SensorView]) -> PageTable:
    """Build the table of extrinsics, fields of view and ranges.

    Args:
        sensors: Sensors of the rig.
    """
    headings = ("sensor", "x, y, z (m)", "yaw, pitch, roll (°)", "horizontal FOV (°)", "vertical FOV (°)", "range (m)")
    rows = []
    for index, view in enumerate(sensors):
        position = ", ".join(f"{value:.2f}" for value in view.position_m)
        low, high = view.vertical_fov_deg
        angles = ", ".join(f"{round(angle, 1) + 0.0:.1f}" for angle in (view.yaw_deg, *view.tilt_deg))
        extents = f"{view.horizontal_fov_deg:.1f}", f"{low:.1f} to {high:.1f}", f"{view.range_m:g}"
        rows.append(build_text_cells(f"{index + 1}  {view.name}", position, angles, *extents))
    return PageTable("", headings, rows)


def _find_bounds(values: Array) -> tuple[float, float]:
    """Find the range of values with a margin of 3 m."""
    margin_m = 3.0
    return float(values.min()) - margin_m, float(values.max()) + margin_m


def _render_field_of_view(name: str, color: str, view: SensorView, fade_m: float) -> str:
    """Render a field of view that fades out, in bird's-eye view; y is down in SVG."""
    x, y = view.x_m, -view.y_m
    stops = "".join(f'<stop offset="{at}" stop-color="{color}" stop-opacity="{0.5 - 0.5 * at}"/>' for at in (0, 1))
    circle = f'cx="{x:.3f}" cy="{y:.3f}" r="{fade_m:.3f}"'
    fade = f'<radialGradient id="{name}" gradientUnits="userSpaceOnUse" {circle}>{stops}</radialGradient>'
    if view.is_tilted:
        corners = " ".join(f"{x:.3f},{-y:.3f}" for x, y in view.compute_outline_m(fade_m))
        return f'{fade}<polygon points="{corners}" fill="url(#{name})" stroke="{color}" {DASHED}/>'
    range_m = view.compute_level_range_m(fade_m)
    circle = f'cx="{x:.3f}" cy="{y:.3f}" r="{range_m:.3f}"'
    if view.horizontal_fov_deg >= 360:
        return f'{fade}<circle {circle} fill="url(#{name})"/>'
    yaw, half = math.radians(view.yaw_deg), math.radians(view.horizontal_fov_deg / 2)
    ends = [f"{x + range_m * math.cos(a):.3f} {y - range_m * math.sin(a):.3f}" for a in (yaw - half, yaw + half)]
    corner, large = f"{x:.3f} {y:.3f}", int(view.horizontal_fov_deg > 180)
    sector = f"M{corner}L{ends[0]}A{range_m:.3f} {range_m:.3f} 0 {large} 0 {ends[1]}Z"
    edges = f'<path d="M{ends[0]}L{corner}L{ends[1]}" fill="none" stroke="{color}" {DASHED}/>'
    return f'{fade}<path d="{sector}" fill="url(#{name})"/>{edges}'


def _separate_numbers(positions: Array) -> Array:
    """Move the numbers of sensors so that they do not overlap."""
    separated: list[Array] = []
    for position in positions:
        candidate = position.copy()
        while any(np.hypot(*(candidate - previous)) < NUMBER_M for previous in separated):
            candidate[0] += NUMBER_M
        separated.append(candidate)
    return np.array(separated)


def _render_number(index: int, x: float, y: float) -> str:
    """Render the number of a sensor in a disc of its color."""
    return (
        f'<circle cx="{x:.3f}" cy="{-y:.3f}" r="{NUMBER_M / 2}" fill="{get_sensor_color(index)}" stroke="white" '
        f'stroke-width="0.03"/><text x="{x:.3f}" y="{-y + 0.075:.3f}" font-size="0.22" text-anchor="middle" '
        f'fill="white" font-family="sans-serif">{index + 1}</text>'
    )


def _render_scale_bar(left: float, bottom: float) -> str:
    """Render a bar of 1 m in the lower left corner."""
    x, y = left + 0.3, bottom - 0.3
    line = f"M{x:.3f} {y - 0.1:.3f}V{y:.3f}H{x + 1:.3f}V{y - 0.1:.3f}"
    font = 'font-size="0.32" font-family="sans-serif" fill="currentColor"'
    words = f'<text x="{x + 1.15:.3f}" y="{y:.3f}" {font}>1 m</text>'
    return f'<path d="{line}" fill="none" stroke="currentColor" stroke-width="0.04"/>{words}'
