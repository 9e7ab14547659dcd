"""What a rig sees of a target: names and defaults in, a map and its files out."""

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, Literal

import numpy as np

from torchcover import __version__
from torchcover.evaluation.progress import defer_signals
from torchcover.evaluation.result_page import build_sensor_views, format_facts, format_rig_yaml
from torchcover.evaluation.settings import FILES, parse_file_kinds
from torchcover.evaluation.task import AnyRig, AnyScenario, compute_frame_interval_s, load_named_rig
from torchcover.files import AtomicOutput
from torchcover.report import (
    ColorScale,
    MapLine,
    Page,
    PageMap,
    PageRig,
    PageTable,
    TargetVisibilityMap,
    TextCell,
    capitalize,
    format_percent,
    format_square_meters,
    format_target_name,
    format_whole_percent,
    render_page,
    to_json_record,
)
from torchcover.simulation import Rig, Scenario, Sensor, set_ego
from torchcover.simulation.bodies import Body
from torchcover.simulation.scenario import ActorDescription
from torchcover.simulation.shapes import Plane
from torchcover.targets import Target, TargetMap, TargetPosition, measure_target_visibility, write_arrays, write_csv

# Steps of a world in which something moves, or a sensor is noisy; else they are all alike.
DEFAULT_STEPS = 16
GROUND_M = 2000.0
# On the page.
NO_ROOM = "no room for it"
ROBUST_PERCENTILE = 98
# What sentences and plans count.
NEAR_M = 2.0
# Areas that differ by less are those of other cells, too.
ALIKE = 0.9


def map_target_visibility(
    rig: AnyRig,
    target: Target | str | Path = "child",
    scenario: Scenario | str | Path | None = None,
    *,
    vehicle: str | Path | None = None,
    sensor_model: Literal["ideal", "real"] | None = None,
    num_frames: int | None = None,
    frame_interval_s: float | None = None,
    **settings: Any,  # noqa: ANN401  (those of `survey`)
) -> TargetMap:
    """Put a target at every place around a vehicle, and see what its rig gets of it.

    Args:
        rig: The rig, its built-in name, or its YAML file.
        target: "child", "adult", "dog", "cyclist", "pole", a built-in vehicle, the YAML file of one, or a mesh file.
        scenario: The world: a scenario, a built-in name or a YAML file; flat ground with nothing on it if not given.
        vehicle: What carries the rig, as for `evaluate`, or a mesh file.
        sensor_model: What sensors make of their hits; as for `evaluate`.
        num_frames: How many steps are averaged; 1 where all are alike, else 16.
        frame_interval_s: Time between two of them; as for `evaluate` if not given.
        settings: Others of `torchcover.targets.measure_target_visibility`: `raster`, `seed`, `hits`, `threshold_m`, `heading`.

    Returns:
        The map; see `TargetMap`.

    Raises:
        FileNotFoundError: An unknown name or file.
        ValueError: A file that cannot be used, a number out of its bounds.

    Example:
        >>> from torchcover.targets import Raster
        >>> seen = map_target_visibility("front_roof_128", "dog", raster=Raster((3.0, 7.0), (-1.0, 1.0), 1.0))
        >>> seen.target, seen.counts["free"]
        ('dog_57cm', 8)
    """
    rig, world, usual_steps = load_rig_and_scenario(rig, scenario, vehicle, sensor_model)
    return measure_target_visibility(
        rig,
        world,
        target if isinstance(target, Target) else Target.load(target),
        num_frames=usual_steps if num_frames is None else num_frames,
        frame_interval_s=compute_frame_interval_s(world, frame_interval_s),
        **settings,
    )


def load_rig_and_scenario(
    rig: AnyRig, scenario: AnyScenario | None, vehicle: str | Path | None, sensor_model: Literal["ideal", "real"] | None
) -> tuple[Rig, Scenario, int]:
    """The rig, the world whose ego carries it, and how many steps are usual; as `map_target_visibility` is asked."""
    rig = load_named_rig(rig).apply_sensor_model(sensor_model)
    world = build_flat_ground() if scenario is None else scenario
    world = set_ego(world if isinstance(world, Scenario) else Scenario.load(world), {rig.name: rig}, vehicle)
    alike = world.num_distinct_time_steps == 1 and all(sensor.is_exact for sensor in rig.sensors)
    return rig, world, 1 if alike else DEFAULT_STEPS


def build_flat_ground() -> Scenario:
    """Flat ground with nothing on it but what carries the rig.

    Example:
        >>> build_flat_ground().num_distinct_time_steps
        1
    """
    ground = Body(name="ground", shape=Plane(type="plane", size_m=(GROUND_M, GROUND_M)))
    return Scenario(name="free space", ego=ActorDescription(), bodies=(ground,))


def save_target_map(
    target_map: TargetMap,
    folder: str | Path,
    sensors: Sequence[Sensor] = (),
    *,
    file_kinds: str | Iterable[str] = FILES,
) -> list[Path]:
    """Write the files of the command line: the numbers first, then the page and the picture.

    Args:
        target_map: From `map_target_visibility`.
        folder: Where to write `targets.csv`, `targets.npz`, `report.html`, `targets.png` and `summary.json`. Made if it
            does not exist; files of an earlier run that its `summary.json` lists are deleted.
        sensors: Those of the rig, for the page.
        file_kinds: What to write beside `summary.json`, as in `Result.save`; "maps" is the picture.
    """
    wanted = parse_file_kinds(file_kinds)
    record = build_target_record(target_map)
    with AtomicOutput(Path(folder)) as written:
        with defer_signals():  # the numbers are safe before anything ends this
            if "numbers" in wanted:
                written.add("targets.csv", lambda path: write_csv(target_map, path))
                written.add("targets.npz", lambda path: write_arrays(target_map, path))
            written.publish(record)
        if "page" in wanted:
            written.add_text("report.html", render_page(build_target_page(target_map, sensors)))
        if "maps" in wanted:
            written.add_figure("targets.png", target_map.plot())
        written.publish(record)
    return written.paths


def build_target_record(target_map: TargetMap) -> dict[str, Any]:
    """Settings, counts, shares of the sides and worst places, for JSON; None for what is unknown."""
    return {
        **target_map.get_settings(),
        "cells": target_map.counts,
        "sides": [to_json_record(side._asdict()) for side in target_map.summarize_sides()],
        "max_undetected_ranges_m": to_json_record(target_map.find_max_undetected_ranges_m()),
        "worst_positions": [to_json_record(place._asdict()) for place in target_map.find_worst_positions()],
    }


def build_target_page(target_map: TargetMap, sensors: Sequence[Sensor] = ()) -> Page:
    """All that is known of a target, on one page. `target_map`: from `map_target_visibility`; `sensors`: those of the rig."""
    return Page(
        title=f"{target_map.rig}: would it see {target_map.target}?",
        lead=f"In {target_map.scenario}, sensor model {target_map.sensor_model}, measured by torchcover.",
        findings=summarize_target_maps({target_map.rig: target_map}),
        target_maps=[build_target_plan(target_map)],
        tables=[
            build_sides_table(target_map),
            build_positions_table(target_map.find_worst_positions(), "The worst places"),
        ],
        maps=_maps(target_map),
        rigs=[PageRig(target_map.rig, build_sensor_views(sensors), format_rig_yaml(target_map.rig, sensors))],
        ego_outline_m=target_map.vehicle_outline_m,
        facts={"Settings": format_facts(target_map.get_settings()), "Run": {"torchcover": __version__}},
    )


def build_target_plan(target_map: TargetMap) -> TargetVisibilityMap:
    """Where it is seen, and what is lost with each sensor, as a page shows it."""
    by = np.where(target_map.detected_mask, np.maximum(np.nan_to_num(target_map.min_sensors), 1), 0).astype(np.int64)
    near = target_map.free_mask & (target_map.distance_m <= NEAR_M)
    count, unseen = int(near.sum()), int((near & ~target_map.detected_mask).sum())
    m2 = format_square_meters(unseen * target_map.raster.cell_m**2)
    return TargetVisibilityMap(
        rig=target_map.rig,
        title=f"Not seen at {unseen:,} of {count:,} places within {NEAR_M:g} m, {m2} m².",
        x=target_map.raster.x_bounds_m,
        y=target_map.raster.y_bounds_m,
        cell_m=target_map.raster.cell_m,
        sensor_counts=np.where(target_map.free_mask, by, -1),
        vehicle_box_m=target_map.vehicle_box.outline_m,
        vehicle_outline_m=target_map.vehicle_outline_m,
        max_distance_m=NEAR_M,
        failure_effects_m2=target_map.compute_failure_effects_m2(NEAR_M) if len(target_map.sensor_names) > 1 else {},
    )


def summarize_target_maps(target_maps: Mapping[str, TargetMap]) -> tuple[str, ...]:
    """Where rigs, by name, see the same body on the same places, and on which sensor most hangs, in sentences."""
    shares = {rig: one.compute_detected_share(NEAR_M) for rig, one in target_maps.items()}
    known = sorted((rig for rig in shares if not math.isnan(shares[rig])), key=lambda rig: -shares[rig])
    if not known:
        return (f"No place within {NEAR_M:g} m is free: what is seen there is unknown.",)
    alike = [(share, ", ".join(rigs)) for share, rigs in groupby(known, lambda rig: format_whole_percent(shares[rig]))]
    (most, best), *others = alike
    first = target_maps[known[0]]
    height = f", {first.target_bottom_m:.2f} m above the ground," if first.target_bottom_m else ""
    body = f"{format_target_name(first.target)} of {first.target_size_m[2]:.2f} m{height}"
    seen_words = f"is seen ({first.detection_points} points or more)"
    told = [f"{capitalize(body)} {seen_words} at {most} % of the places within {NEAR_M:g} m by {best}"]
    told += [f"at {share} % by {rigs}" for share, rigs in others]
    return (f"{', '.join(told)}.", *(_on_loss(rig, target_maps[rig]) for rig in known))


def _on_loss(rig: str, seen: TargetMap) -> str:
    """Of one rig, the sensor with which most places are lost; several where the cells are too coarse to tell."""
    losses = seen.compute_failure_effects_m2(NEAR_M)
    most_m2 = max(losses.values())
    if len(losses) == 1:
        return f"{rig} has one sensor: without it, it sees nothing."
    if not most_m2:
        return f"{rig} loses no place within {NEAR_M:g} m, whichever sensor fails."
    worst = [sensor for sensor, m2 in losses.items() if m2 >= ALIKE * most_m2]
    lost = f"{'up to ' * (len(worst) > 1)}{format_square_meters(most_m2)} m² more are not seen within {NEAR_M:g} m"
    return f"{rig} most needs its {' and '.join(worst)}: without {'one' if len(worst) > 1 else 'it'}, {lost}."


def _maps(seen: TargetMap) -> list[PageMap]:
    some = seen.points[seen.points > 0]
    most = max(float(np.percentile(some, ROBUST_PERCENTILE)), 10.0) if len(some) else 10.0
    of_sensors = (
        f"sensors with {seen.detection_points} points or more",
        "sensors",
        "viridis",
        0.0,
        float(len(seen.sensor_names)),
    )
    near = f"visible surface within {seen.threshold_m:g} m of a point"
    each = [
        (seen.points, ColorScale("points on it", "points", "viridis", 1.0, most, logarithmic=True)),
        (
            100 * seen.detected_share,
            ColorScale(f"steps with {seen.detection_points} points or more", "%", "viridis", 0.0, 100.0),
        ),
        (100 * seen.surface_share, ColorScale(near, "%", "viridis", 0.0, 100.0)),
        (seen.detecting_sensors, ColorScale(*of_sensors)),
    ]
    line = MapLine(f"border of what is seen, with {seen.detection_points} points", seen.compute_detection_border_m())
    return [
        PageMap(
            quantity=scale.quantity,
            band=seen.target,
            rig=seen.rig,
            x=seen.raster.x_bounds_m,
            y=seen.raster.y_bounds_m,
            cell_m=seen.raster.cell_m,
            values=values,
            scale=scale,
            unobserved_label=NO_ROOM,
            lines=[line],
        )
        for values, scale in each
    ]


def build_sides_table(target_map: TargetMap) -> PageTable:
    """The share of the places on each side that have enough points, and how far out one has not."""
    sides, unseen_to_m = target_map.summarize_sides(), target_map.find_max_undetected_ranges_m()
    within = list(dict.fromkeys(side.max_distance_m for side in sides))
    rows = []
    for name in dict.fromkeys(side.side for side in sides):
        shares = [
            "-" if one.free_cells == 0 else format_percent(one.detected_share) for one in sides if one.side == name
        ]
        to_m = unseen_to_m[name]
        unseen = "-" if np.isnan(to_m) else f"{to_m:.2f}" if to_m else "nowhere"
        rows.append(tuple(map(TextCell, (name, *shares, unseen))))
    of_steps = ", mean over the steps" if target_map.num_frames > 1 else ""
    headings = ("side", *(f"within {limit_m:g} m\n(%)" for limit_m in within), "unseen to\n(m)")
    return PageTable(f"Free places with {target_map.detection_points} points or more{of_steps}", headings, rows)


def build_positions_table(positions: Sequence[TargetPosition], title: str) -> PageTable:
    """Where places are, and how much of a target is seen there."""
    headings = ("side", "x\n(m)", "y\n(m)", "distance\n(m)", "points", "sensors", "surface\n(%)")
    rows = [tuple(map(TextCell, _place(place))) for place in positions]
    return PageTable(title, headings, rows)


def _place(place: TargetPosition) -> tuple[str, ...]:
    lengths = (f"{value:.2f}" for value in (place.x_m, place.y_m, place.distance_m))
    return (
        place.side,
        *lengths,
        f"{place.points:.4g}",
        f"{place.detecting_sensors:.3g}",
        format_percent(place.surface_share),
    )
