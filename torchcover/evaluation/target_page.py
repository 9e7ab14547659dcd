"""Findings, tables and maps on the visibility of a test target, for pages and terminals."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchcover import __version__
from torchcover.evaluation.result_page import build_sensor_views, format_facts, format_rig_yaml
from torchcover.report import (
    ColorScale,
    MapLine,
    Page,
    PageMap,
    PageRig,
    PageTable,
    TargetVisibilityMap,
    build_text_cells,
    capitalize,
    format_percent,
    format_square_meters,
    format_target_name,
    format_whole_percent,
    to_json_record,
)
from torchcover.simulation import Sensor
from torchcover.targets import TargetMap, TargetPosition


@dataclass(frozen=True)
class TargetPageParams:
    """Parameters of the findings and maps on a test target.

    Args:
        max_distance_m: Distance from the vehicle up to which findings count positions.
        min_similar_share: Sensor failures are equally severe if their areas differ by less: the area depends on the
            cells of the raster.
        points_percentile: Percentile of the number of points that has the last color of its map.
    """

    max_distance_m: float = 2.0
    min_similar_share: float = 0.9
    points_percentile: float = 98


PARAMS = TargetPageParams()


def build_target_record(target_map: TargetMap) -> dict[str, Any]:
    """Build the content of `summary.json`: settings, counts, sides and worst positions; None for unknown values.

    Args:
        target_map: Result of `map_target_visibility`.
    """
    return {
        **target_map.get_settings(),
        "cells": target_map.counts,
        "sides": [to_json_record(side._asdict()) for side in target_map.summarize_sides()],
        "max_undetected_ranges_m": to_json_record(target_map.find_max_undetected_ranges_m()),
        "worst_positions": [to_json_record(position._asdict()) for position in target_map.find_worst_positions()],
    }


def build_target_page(target_map: TargetMap, sensors: Sequence[Sensor] = ()) -> Page:
    """Build the page of a test target.

    Args:
        target_map: Result of `map_target_visibility`.
        sensors: Sensors of the rig.

    Returns:
        Page with findings, tables, maps and settings.
    """
    return Page(
        title=f"Detection of {target_map.target} by {target_map.rig}",
        lead=f"In {target_map.scenario}, sensor model {target_map.sensor_model}, measured by torchcover.",
        findings=summarize_target_maps({target_map.rig: target_map}),
        target_maps=[build_target_plan(target_map)],
        tables=[
            build_sides_table(target_map),
            build_positions_table(target_map.find_worst_positions(), "Worst positions"),
        ],
        maps=_build_maps(target_map),
        rigs=[PageRig(target_map.rig, build_sensor_views(sensors), format_rig_yaml(target_map.rig, sensors))],
        ego_outline_m=target_map.vehicle_outline_m,
        facts={"Settings": format_facts(target_map.get_settings()), "Run": {"torchcover": __version__}},
    )


def build_target_plan(target_map: TargetMap) -> TargetVisibilityMap:
    """Build the map of the number of detecting sensors, with the effect of each sensor failure.

    Args:
        target_map: Result of `map_target_visibility`.

    Returns:
        Map for a page.
    """
    # A position may be detected by the points of several sensors together, without any sensor that has enough alone.
    sensor_counts = np.maximum(np.nan_to_num(target_map.min_sensors), 1)
    sensor_counts = np.where(target_map.detected_mask, sensor_counts, 0).astype(np.int64)
    near_mask = target_map.free_mask & (target_map.distance_m <= PARAMS.max_distance_m)
    num_positions, num_undetected = int(near_mask.sum()), int((near_mask & ~target_map.detected_mask).sum())
    area_m2 = format_square_meters(num_undetected * target_map.raster.cell_m**2)
    # The failure of a single sensor leaves nothing to compare.
    failure_effects_m2: dict[str, float] = {}
    if len(target_map.sensor_names) > 1:
        failure_effects_m2 = target_map.compute_failure_effects_m2(PARAMS.max_distance_m)
    return TargetVisibilityMap(
        rig=target_map.rig,
        title=f"Not detected at {num_undetected:,} of {num_positions:,} positions within {PARAMS.max_distance_m:g} m, "
        f"{area_m2} m².",
        x=target_map.raster.x_bounds_m,
        y=target_map.raster.y_bounds_m,
        cell_m=target_map.raster.cell_m,
        sensor_counts=np.where(target_map.free_mask, sensor_counts, -1),
        vehicle_box_m=target_map.vehicle_box.outline_m,
        vehicle_outline_m=target_map.vehicle_outline_m,
        max_distance_m=PARAMS.max_distance_m,
        failure_effects_m2=failure_effects_m2,
    )


def summarize_target_maps(target_maps: Mapping[str, TargetMap]) -> tuple[str, ...]:
    """Summarize the detection of a test target near the vehicle by one or several rigs.

    Args:
        target_maps: Name of each rig -> its map, of the same target and raster.

    Returns:
        A sentence on the share of positions with a detection, best rig first, and one sentence on sensor failures for
        each rig.
    """
    within = f"within {PARAMS.max_distance_m:g} m"
    shares = {}
    for rig, target_map in target_maps.items():
        share = target_map.compute_detected_share(PARAMS.max_distance_m)
        if not math.isnan(share):
            shares[rig] = share
    if not shares:
        return (f"No position {within} is free, so detection there is unknown.",)
    # Rigs whose shares are equal in whole percent are named together.
    best_first = sorted(shares, key=shares.__getitem__, reverse=True)
    rigs_by_percent: dict[str, list[str]] = {}
    for rig in best_first:
        rigs_by_percent.setdefault(format_whole_percent(shares[rig]), []).append(rig)
    texts = [f"at {percent} % by {', '.join(rigs)}" for percent, rigs in rigs_by_percent.items()]
    texts[0] = texts[0].replace(" by ", f" of the positions {within} by ", 1)
    target_map = target_maps[best_first[0]]
    bottom = f", {target_map.target_bottom_m:.2f} m above the ground," if target_map.target_bottom_m else ""
    target = f"{capitalize(format_target_name(target_map.target))} of {target_map.target_size_m[2]:.2f} m{bottom}"
    finding = f"{target} is detected ({target_map.detection_points} points or more) {', '.join(texts)}."
    return (finding, *[_describe_failures(rig, target_maps[rig]) for rig in best_first])


def _describe_failures(rig: str, target_map: TargetMap) -> str:
    """Describe the most severe failure of one sensor; several sensors if the raster cannot distinguish them."""
    lost_m2 = target_map.compute_failure_effects_m2(PARAMS.max_distance_m)
    max_lost_m2 = max(lost_m2.values())
    if len(lost_m2) == 1:
        return f"{rig} has one sensor, so it detects nothing if this sensor fails."
    if not max_lost_m2:
        return f"{rig} loses no position within {PARAMS.max_distance_m:g} m if one sensor fails."
    worst = [sensor for sensor, area_m2 in lost_m2.items() if area_m2 >= PARAMS.min_similar_share * max_lost_m2]
    area = f"{'up to ' * (len(worst) > 1)}{format_square_meters(max_lost_m2)} m²"
    return (
        f"{rig} loses most without {' or '.join(worst)}: {area} more without detection within "
        f"{PARAMS.max_distance_m:g} m."
    )


def _build_maps(target_map: TargetMap) -> list[PageMap]:
    """Build the maps of points, detection, visible surface and detecting sensors."""
    positive_points = target_map.points[target_map.points > 0]
    # A few positions close to a sensor have most points and would hide the differences between all others.
    max_points = 10.0
    if len(positive_points):
        max_points = max(float(np.percentile(positive_points, PARAMS.points_percentile)), 10.0)
    enough_points = f"with {target_map.detection_points} points or more"
    surface = f"visible surface within {target_map.threshold_m:g} m of a point"
    num_sensors = float(len(target_map.sensor_names))
    layers = [
        (target_map.points, ColorScale("points on the target", "points", "viridis", 1.0, max_points, logarithmic=True)),
        (100 * target_map.detected_share, ColorScale(f"frames {enough_points}", "%", "viridis", 0.0, 100.0)),
        (100 * target_map.surface_share, ColorScale(surface, "%", "viridis", 0.0, 100.0)),
        (target_map.detecting_sensors, ColorScale(f"sensors {enough_points}", "sensors", "viridis", 0.0, num_sensors)),
    ]
    border = MapLine(
        f"border of detection with {target_map.detection_points} points", target_map.compute_detection_border_m()
    )
    maps = []
    for values, scale in layers:
        page_map = PageMap(
            quantity=scale.quantity,
            band=target_map.target,
            rig=target_map.rig,
            x=target_map.raster.x_bounds_m,
            y=target_map.raster.y_bounds_m,
            cell_m=target_map.raster.cell_m,
            values=values,
            scale=scale,
            unobserved_label="no free position",
            lines=[border],
        )
        maps.append(page_map)
    return maps


def build_sides_table(target_map: TargetMap) -> PageTable:
    """Build the table of detection on each side of the vehicle.

    Args:
        target_map: Result of `map_target_visibility`.

    Returns:
        Share of the free positions with a detection within some distances, and largest distance without detection.
    """
    sides, max_undetected_m = target_map.summarize_sides(), target_map.find_max_undetected_ranges_m()
    max_distances_m = list(dict.fromkeys(side.max_distance_m for side in sides))
    rows = []
    for name in dict.fromkeys(side.side for side in sides):
        texts = [name]
        for side in sides:
            if side.side == name:
                texts.append(format_percent(side.detected_share) if side.free_cells else "-")
        undetected_m = max_undetected_m[name]
        texts.append("-" if np.isnan(undetected_m) else f"{undetected_m:.2f}" if undetected_m else "nowhere")
        rows.append(build_text_cells(*texts))
    headings = ["side", *[f"within {distance_m:g} m\n(%)" for distance_m in max_distances_m], "undetected up to\n(m)"]
    mean = ", mean over the frames" if target_map.num_frames > 1 else ""
    return PageTable(f"Free positions with {target_map.detection_points} points or more{mean}", headings, rows)


def build_positions_table(positions: Sequence[TargetPosition], title: str) -> PageTable:
    """Build the table of the visibility of a test target at some positions.

    Args:
        positions: The positions.
        title: Title of the table.
    """
    headings = ("side", "x\n(m)", "y\n(m)", "distance\n(m)", "points", "sensors", "surface\n(%)")
    rows = []
    for position in positions:
        lengths = [f"{length_m:.2f}" for length_m in (position.x_m, position.y_m, position.distance_m)]
        points, sensors = f"{position.points:.4g}", f"{position.detecting_sensors:.3g}"
        texts = [position.side, *lengths, points, sensors, format_percent(position.surface_share)]
        rows.append(build_text_cells(*texts))
    return PageTable(title, headings, rows)
