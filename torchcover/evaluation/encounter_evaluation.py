"""In time or too late: names and defaults in, what rigs had of encounters and its files out."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Literal, cast

import numpy as np
from matplotlib.figure import Figure

from torchcover import __version__
from torchcover.encounters import (
    Criterion,
    Encounter,
    EncounterResults,
    EncounterSet,
    StagedEncounter,
    detect_encounter,
)
from torchcover.encounters.detection import EncounterPointCounter, MountedRig
from torchcover.encounters.result import TOTAL_ROW
from torchcover.encounters.staging import FRAME_INTERVAL_S, get_solid
from torchcover.encounters.traffic import Drive, find_approaches
from torchcover.encounters.traffic_detection import DriveSensors, detect_approach
from torchcover.evaluation.progress import Progress, defer_signals
from torchcover.evaluation.result_page import format_facts
from torchcover.evaluation.settings import FILES, parse_file_kinds
from torchcover.evaluation.target_visibility import build_flat_ground
from torchcover.evaluation.task import AnyRig, load_named_rig
from torchcover.files import AtomicOutput
from torchcover.geometry import invert, transform_outline
from torchcover.recordings import Recording, open_recording
from torchcover.report import ActorMark, Page, PagePicture, StaticFaces, plot_scene, render_page
from torchcover.simulation import PaperReference, Rig, Scenario, SensorNoise, Simulator, set_ego
from torchcover.simulation.bodies import get_shape_name

# Of a film: seconds, steps between two pictures, and what they show around all bodies.
FILM_S, FILM_STEPS, FILM_AROUND_M = 3.0, 100, 3.0


def evaluate_encounters(
    rigs: AnyRig | Sequence[AnyRig],
    encounters: EncounterSet | str | Path = "crossing_like",
    criterion: Criterion | None = None,
    *,
    vehicle: str | Path | None = None,
    sensor_model: Literal["ideal", "real"] | None = None,
    num_start_offsets: int = 10,
    seed: int = 0,
    progress: bool = False,
) -> EncounterResults:
    """When rigs detect whom their vehicle is about to collide with, and whether that is in time.

    Args:
        rigs: A rig or several: each one itself, its built-in name, or its YAML file.
        encounters: A set, the name of a built-in one, or a YAML file.
        criterion: What is detected, and what is in time.
        vehicle: What carries the rigs, as for `evaluate`; else each is on its own vehicle.
        sensor_model: What sensors make of their hits; as for `evaluate`.
        num_start_offsets: At how many places of their period the looks begin, in turn.
        seed: Of noise and drop-out.
        progress: Whether to show a bar.

    Raises:
        FileNotFoundError: An unknown name or file.
        ValueError: A file that cannot be used, a number out of its bounds, an encounter that is none.

    Example:
        >>> adult = {"body": "adult", "speed_kmh": 5, "approach_distance_m": 2}
        >>> crossing = {"name": "a", "ego": {"speed_kmh": 30}, "road_user": adult}
        >>> encounters = EncounterSet.model_validate({"name": "crossings", "encounters": [crossing]})
        >>> result = evaluate_encounters("front_roof_32", encounters, num_start_offsets=2)
        >>> [(row.encounter, row.in_time_share) for row in result.rows]
        [('a', 1.0)]
    """
    for name, value, least in (("phases", num_start_offsets, 1), ("seed", seed, 0)):
        if value < least:
            raise ValueError(f"{name}: a number >= {least} is needed; got {value}")
    criterion = Criterion() if criterion is None else criterion
    sensing = _sensing(rigs, sensor_model)
    these = encounters if isinstance(encounters, EncounterSet) else EncounterSet.load(encounters)
    mounted = [MountedRig(rig, set_ego(build_flat_ground(), {name: rig}, vehicle)) for name, rig in sensing.items()]
    # Their mistakes are told before the first look.
    staged = [(rig, StagedEncounter(one, rig.ego_solid)) for rig in mounted for one in these.encounters]
    sightings = []
    with Progress(len(staged), "encounters", is_shown=progress) as bar:
        for rig, one in staged:
            sightings.append(detect_encounter(rig, one, criterion, num_start_offsets=num_start_offsets, seed=seed))
            bar.advance(len(staged))
    return EncounterResults(these.name, criterion, num_start_offsets, seed, _sensors(sensing), sightings)


def _sensing(rigs: AnyRig | Sequence[AnyRig], sensor_model: Literal["ideal", "real"] | None) -> dict[str, Rig]:
    called = [load_named_rig(rig) for rig in ([rigs] if isinstance(rigs, str | Path | Rig) else rigs)]
    sensing = {rig.name: rig.apply_sensor_model(sensor_model) for rig in called}
    if not called or len(sensing) < len(called):
        raise ValueError(f"rigs with different names are needed; got {', '.join(rig.name for rig in called) or 'none'}")
    return sensing


def _sensors(rigs: Mapping[str, Rig]) -> dict[str, tuple[str, ...]]:
    return {name: tuple(sensor.name for sensor in rig.sensors) for name, rig in rigs.items()}


def evaluate_traffic_encounters(
    rigs: AnyRig | Sequence[AnyRig],
    scenario: Scenario | str | Path = "urban",
    criterion: Criterion | None = None,
    *,
    num_scenes: int = 16,
    vehicle: str | Path | None = None,
    sensor_model: Literal["ideal", "real"] | None = None,
    seed: int = 0,
    progress: bool = False,
) -> EncounterResults:
    """When rigs detected those whom they met in the traffic of worlds: `Criterion.within_s` before a collision.

    Args:
        rigs: As for `encounter`, like all that is not named here.
        scenario: Its worlds: a scenario, a built-in name or a YAML file.
        criterion: Who is met, what is detected, and what is in time.
        num_scenes: How many of them are driven through; 1 if it is always the same.
        vehicle: What carries the rigs.
        sensor_model: What sensors make of their hits.
        seed: Of the traffic, of noise and drop-out.
        progress: Whether to show a bar.

    Raises:
        FileNotFoundError: An unknown name or file.
        ValueError: What cannot be used, a number out of its bounds, a scenario in which nothing ever moves.
    """
    if num_scenes < 1:
        raise ValueError(f"worlds: a number >= 1 is needed; got {num_scenes}")
    criterion, sensing = Criterion() if criterion is None else criterion, _sensing(rigs, sensor_model)
    world = set_ego(scenario if isinstance(scenario, Scenario) else Scenario.load(scenario), sensing, vehicle)
    if world.num_distinct_time_steps == 1:
        raise ValueError(f"scenario {world.name!r}: nothing ever moves in it, so nobody is met")
    num_scenes = 1 if world.is_repeating else num_scenes
    nobody = Simulator(world, {}, PaperReference(rows=2, columns=2), seed=seed)
    alone = {name: nobody.replace_rigs({name: rig}) for name, rig in sensing.items()}
    sightings, hours = [], {}
    with Progress(num_scenes, "worlds", is_shown=progress) as bar:
        for number in range(num_scenes):
            first = number * world.num_time_steps
            drive = Drive.from_scene(f"{world.name} {number}", nobody.get_scene_geometry(first)[0].scene)
            hours[drive.name] = world.num_time_steps * world.effective_time_step_s / 3600
            met = find_approaches(drive, criterion)
            for name, simulator in alone.items():
                eyes = DriveSensors.from_simulator(simulator, first, criterion)
                sightings += [detect_approach(name, drive, one, eyes, criterion) for one in met]
            bar.advance(num_scenes)
    return EncounterResults(world.name, criterion, 1, seed, _sensors(sensing), sightings, hours)


def evaluate_recorded_encounters(
    recording: Recording | str | Path, criterion: Criterion | None = None
) -> EncounterResults:
    """When the rigs of a recording first had enough points on those whom it met; as `evaluate_traffic_encounters`.

    Args:
        recording: One with poses, times and labelled objects, or its path.
        criterion: Who is met, what is detected, and what is in time.

    Raises:
        FileNotFoundError: There is no such recording, or a part of it is missing.
        ValueError: It lacks one of these, or does not say how large its vehicle is.
    """
    criterion = Criterion() if criterion is None else criterion
    opened = open_recording(recording) if isinstance(recording, str | Path) else recording
    drive, sightings = Drive.from_recording(opened), []
    for name, sensors in opened.rigs.items():
        eyes = DriveSensors.from_recording(opened, sensors, criterion)
        sightings += [detect_approach(name, drive, one, eyes, criterion) for one in find_approaches(drive, criterion)]
    hours = {drive.name: float(np.ptp(drive.times_s)) / 3600}
    return EncounterResults(
        drive.name, criterion, 1, 0, {n: tuple(of) for n, of in opened.rigs.items()}, sightings, hours
    )


def plot_encounter_animation(
    rig: AnyRig,
    encounter_results: EncounterResults,
    *,
    vehicle: str | Path | None = None,
    sensor_model: Literal["ideal", "real"] | None = None,
) -> Iterator[Figure]:
    """The last seconds of that encounter of a set in which a rig is latest, for what is needed: ten pictures a second.

    Args:
        rig: One of those that were asked about.
        encounter_results: What they had, of a set.
        vehicle: What carries the rig, as it was told.
        sensor_model: As it was told.
    """
    ((name, sensing),) = _sensing(rig, sensor_model).items()
    latest = min(
        (one for one in encounter_results.detections if one.rig == name),
        key=lambda one: one.ttc_s.min() - one.braking_time_s,
    )
    case, without_s = cast(Encounter, latest.encounter), latest.ttc_without_sensor_s.min(axis=1)
    mounted = MountedRig(sensing, set_ego(build_flat_ground(), {name: sensing}, vehicle))
    staged = StagedEncounter(case, mounted.ego_solid)
    scene, looks = (
        staged.build_scene(mounted.solids, includes_road_user=True),
        EncounterPointCounter(mounted, staged, encounter_results.seed),
    )
    sensors, names = mounted.get_mounted_sensors(case, scene), encounter_results.sensor_names[name]
    first, worst = latest.sensor_ttc_s.mean(axis=1).argmax(), without_s.argmin()
    told = f"{case.description}: detected {latest.ttc_s.min():.2f} s before, needed {latest.braking_time_s:.2f} s"
    told += f"; first {names[first]}, without {names[worst]} {without_s[worst]:.2f} s" if len(names) > 1 else ""
    if case.is_speed_swept:
        kmh = encounter_results.find_max_speeds_kmh()[case.name, name]
        told += "; in time at none of the speeds" if math.isnan(kmh) else f"; in time up to {kmh:g} km/h"
    steps = np.arange(
        max(int((staged.contact_time_s - FILM_S) / FRAME_INTERVAL_S), 0), int(staged.contact_time_s / FRAME_INTERVAL_S), FILM_STEPS
    )
    times_s = FRAME_INTERVAL_S * steps.astype(np.float64)
    vehicle_T_world = invert(staged.compute_world_T_ego(times_s))
    bodies = [(one.body, vehicle_T_world @ pose) for one, pose in staged.obstacles]
    bodies.append((case.road_user.body, staged.compute_vehicle_T_road_user(times_s)))
    outlines_m = np.stack(
        [transform_outline(get_solid(body).bounding_box.outline_m, there) for body, there in bodies], axis=1
    )
    ego_m = mounted.ego_solid.bounding_box.outline_m
    all_m = np.concatenate([outlines_m.reshape(-1, 2), ego_m])
    low_m, high_m = all_m.min(axis=0) - FILM_AROUND_M, all_m.max(axis=0) + FILM_AROUND_M
    for step, now_m in zip(steps.tolist(), outlines_m, strict=True):
        instant, at = scene.get_snapshot(step), np.array([step])
        scans = [one.scan(instant, SensorNoise(np.random.default_rng(step), one.sensor.num_rays)) for one in sensors]
        seen = ", ".join(f"{sensor} {looks.count_points([k], at)[0]}" for k, sensor in enumerate(names))
        yield plot_scene(
            *zip(low_m.tolist(), high_m.tolist(), strict=True),
            static_faces=StaticFaces(np.empty((0, 3, 2)), np.empty(0)),
            ego_outline_m=ego_m,
            actors=[ActorMark(get_shape_name(body), there) for (body, _), there in zip(bodies, now_m, strict=True)],
            sensor_points=np.concatenate([scan.points for scan in scans]),
            title=f"{staged.contact_time_s - FRAME_INTERVAL_S * step:.2f} s to the collision; points on it: {seen}",
            subtitle=told,
        )


def save_encounters(
    encounter_results: EncounterResults, folder: str | Path, *, file_kinds: str | Iterable[str] = FILES
) -> list[Path]:
    """Write the files of the command line.

    Args:
        encounter_results: From `encounter`.
        folder: Where to write `encounters.csv`, `report.html`, `encounters.png` and `summary.json`; as `save_target_map`.
        file_kinds: What to write beside `summary.json`, as in `Result.save`; "maps" is the picture.
    """
    wanted = parse_file_kinds(file_kinds)
    record = {"verdict": list(summarize_encounters(encounter_results)), **encounter_results.to_record()}
    with AtomicOutput(Path(folder)) as written:
        with defer_signals():
            if "numbers" in wanted:
                written.add("encounters.csv", encounter_results.write_csv)
            written.publish(record)
        if "page" in wanted:
            written.add_text("report.html", render_page(build_encounters_page(encounter_results)))
        if "maps" in wanted and not encounter_results.scene_durations_h:
            written.add_figure("encounters.png", encounter_results.plot())
        written.publish(record)
    return written.paths


def summarize_encounters(encounter_results: EncounterResults) -> tuple[str, ...]:
    """In how many of the encounters each rig is in time, in a sentence; of traffic, who was met when too late."""
    rows = [row for row in encounter_results.rows if row.encounter != TOTAL_ROW and row.braking_count]
    of_rigs = {rig: [row for row in rows if row.rig == rig] for rig in encounter_results.sensor_names}
    if not rows:
        return ("Nobody was met for whom the vehicle had to brake.",)
    if encounter_results.scene_durations_h:
        late = {
            rig: round(sum((1 - row.in_time_share) * row.braking_count for row in of)) for rig, of in of_rigs.items()
        }
        most = max(sum(row.braking_count for row in of) for of in of_rigs.values())
        told = "; ".join(f"{rig} {count}" for rig, count in late.items())
        return (f"Of {most} for whom the vehicle had to brake, detected too late: {told}.",)
    told = "; ".join(f"{rig} {sum(row.in_time_share == 1 for row in of)}" for rig, of in of_rigs.items())
    count = max(map(len, of_rigs.values()))
    return (f"Of {count} encounters of {encounter_results.name}, each speed counted, always in time: {told}.",)


def build_encounters_page(encounter_results: EncounterResults) -> Page:
    """All of it on one page."""
    pictures = []
    if not encounter_results.scene_durations_h:
        png = BytesIO()
        encounter_results.plot().savefig(png, format="png")
        pictures = [PagePicture("Time to collision at detection against the speed", png.getvalue())]
    return Page(
        title=f"In time? {', '.join(encounter_results.sensor_names)}",
        lead=f"The encounters of {encounter_results.name}, measured by torchcover. In time is geometry: what was seen when, with "
        "the brakes and the latency that were assumed.",
        findings=summarize_encounters(encounter_results),
        tables=encounter_results.build_tables(),
        pictures=pictures,
        facts={"Settings": format_facts(encounter_results.get_settings()), "Run": {"torchcover": __version__}},
    )
