"""Numbers of a run next to those of the paper, in the units of its tables.

Results are a dict: (name of the LiDARs, average "cells" or "area", number of frames) -> `TableKey` -> `Number`.
"""

import math
from itertools import product

from examples.paper.published import BANDS, LIDARS, QUANTITIES, REGIONS, TableKey, compute_score, read_published

AVERAGE_TITLES = {"cells": "by cells", "area": "by area"}


def extract_numbers(coverages, regions):
    """Extract numbers in the units of the tables.

    Args:
        coverages: Name of the LiDAR in the tables -> `Coverage` with one threshold.
        regions: Regions in the order of the tables.

    Returns:
        `TableKey` -> `Number`.
    """
    numbers = {}
    for lidar, coverage in coverages.items():
        for region, band in product(regions, coverage.grid.heights):
            radius, share = coverage.estimate(region, band).to_numbers().values()
            in_percent = {part: 100 * getattr(share, part) for part in ("value", "error", "low", "high")}
            numbers[TableKey("detection_percent", lidar, region.name, band)] = share._replace(**in_percent)
            numbers[TableKey("radius_m", lidar, region.name, band)] = radius
    return numbers


def compute_scores(results):
    """Compute the score of each result.

    Args:
        results: See the module.
    """
    scores = {}
    for key, run in results.items():
        values = {table_key: number.value for table_key, number in run.items()}
        scores[key] = compute_score(values, read_published())
    return scores


def format_markdown(results):
    """Format a table of numbers for each set of LiDARs, then all scores.

    Args:
        results: See the module.
    """
    scores = compute_scores(results)
    last = max(num_frames for _, _, num_frames in results)
    lines = []
    for lidars in dict.fromkeys(lidars for lidars, _, _ in results):
        lines += [f"### {lidars}, {last} frames", ""]
        lines += _format_numbers(results[lidars, "cells", last], results[lidars, "area", last])
        lines += [f"{title}: {scores[lidars, average, last]}.\n" for average, title in AVERAGE_TITLES.items()]
    lines += [
        "### Scores",
        "",
        "| LiDARs | average | frames | detection (points) | radius (factor) | same order in rows | same order of all | "
        "Spearman, detection | Spearman, radius |",
        f"|{' --- |' * 2}{' ---: |' * 7}",
    ]
    for (lidars, average, num_frames), score in scores.items():
        lines.append(
            f"| {lidars} | {AVERAGE_TITLES[average]} | {num_frames} | {score.rms_points:.1f} | "
            f"{score.radius_factor:.2f} | {score.agreeing_rows} of {score.row_pairs} | "
            f"{score.agreeing_pairs} of {score.pairs} | {score.spearman_detection:.3f} | {score.spearman_radius:.3f} |"
        )
    return "\n".join([*lines, "", "### Radii at obstacle height", "", *_format_obstacle_radii(results, last), ""])


def build_records(results):
    """Build the records of the results for JSON.

    Args:
        results: See the module.
    """
    scores, paper, records = compute_scores(results), read_published(), []
    for (lidars, average, num_frames), run in results.items():
        numbers = []
        for key, number in run.items():
            numbers.append({**key._asdict(), "value": number.value, "error": number.error, "paper": paper[key]})
        score = scores[lidars, average, num_frames]._asdict()
        records.append({"lidars": lidars, "average": average, "num_frames": num_frames, **score, "numbers": numbers})
    return records


def _format_numbers(by_cells, by_area):
    """Format 24 rows: average over cells, number of the paper, ratio of both, and average over area."""
    paper = read_published()
    headings = "detection (%) | paper | ratio | by area | radius (m) | paper | ratio | by area"
    lines = [f"| region | band | LiDAR | {headings} |", f"|{' --- |' * 3}{' ---: |' * 8}"]
    for region, band, lidar in product(REGIONS, BANDS, LIDARS):
        cells = [region, band, lidar]
        for quantity in QUANTITIES:
            key = TableKey(quantity, lidar, region, band)
            number = by_cells[key]
            ratio = number._replace(value=number.value / paper[key], low=math.nan)
            cells += [_format_number(number), f"{paper[key]:.2f}", _format_number(ratio), _format_number(by_area[key])]
        lines.append(f"| {' | '.join(cells)} |")
    return [*lines, ""]


def _format_obstacle_radii(results, last):
    """Format the number of rows with larger radii at obstacle height than on the ground, as in all of the paper."""
    lines = [
        "| LiDARs | average | larger at obstacle height | ground within 20 m: grille and roof, 128 rows (m) |",
        f"|{' --- |' * 2}{' ---: |' * 2}",
    ]
    for (lidars, average, num_frames), run in results.items():
        if num_frames != last:
            continue
        larger_count = 0
        for lidar, region in product(LIDARS, REGIONS):
            ground, obstacle = (run[TableKey("radius_m", lidar, region, band)].value for band in BANDS)
            larger_count += obstacle > ground
        near_radii = []
        for lidar in ("grille_128", "roof_128"):
            near_radii.append(f"{run[TableKey('radius_m', lidar, REGIONS[0], 'ground')].value:.2f}")
        row_count = len(LIDARS) * len(REGIONS)
        lines.append(
            f"| {lidars} | {AVERAGE_TITLES[average]} | {larger_count} of {row_count} | {' and '.join(near_radii)} |"
        )
    return lines


def _format_number(number):
    """Format a number with two decimals, as in the paper, and its interval."""
    if math.isnan(number.value):
        return "unknown"
    interval = "" if math.isnan(number.low) else f" [{number.low:.2f}, {number.high:.2f}]"
    return f"{number.value:.2f}{interval}"
