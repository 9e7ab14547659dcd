"""Evaluation of encounters: time to collision at which rigs detect road users, in sets, traffic and recordings."""

from collections.abc import Iterable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Literal

import numpy as np

from torchcover import __version__
from torchcover.encounters import (
    Criterion,
    EncounterResults,
    EncounterRow,
    EncounterSet,
    StagedEncounter,
    detect_encounter,
)
from torchcover.encounters.detection import MountedRig
from torchcover.encounters.result import TOTAL_ROW
from torchcover.encounters.traffic import Drive, find_approaches
from torchcover.encounters.traffic_detection import DriveSensors, detect_approach
from torchcover.evaluation.progress import Progress, defer_signals
from torchcover.evaluation.result_page import format_facts
from torchcover.evaluation.rig_names import AnyRig, load_named_rig
from torchcover.evaluation.settings import FILES, parse_file_kinds
from torchcover.evaluation.target_visibility import build_flat_ground
from torchcover.files import AtomicOutput
from torchcover.recordings import Recording, open_recording
from torchcover.report import Page, PagePicture, render_page
from torchcover.simulation import PaperReference, Rig, Scenario, Simulator, set_ego


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
    """Evaluate when rigs detect a road user on a collision course, and whether that is in time to brake.

    Args:
        rigs: One or several rigs, as objects, built-in names or YAML files.
        encounters: A set of encounters, a built-in name or a YAML file.
        criterion: Criterion of detection and braking.
        vehicle: Vehicle that carries the rigs, as in `evaluate`; by default each rig is on its own vehicle.
        sensor_model: Sensor model, as in `evaluate`.
        num_start_offsets: Number of start times of the scans, evenly spaced over one scan period.
        seed: Seed of noise and drop-out.
        progress: Whether to show a progress bar.

    Returns:
        Times to collision at detection.

    Raises:
        FileNotFoundError: Unknown file or built-in name.
        ValueError: Invalid file, number out of its bounds, or an encounter without a collision.

    Example:
        >>> adult = {"body": "adult", "speed_kmh": 5, "approach_distance_m": 2}
        >>> crossing = {"name": "a", "ego": {"speed_kmh": 30}, "road_user": adult}
        >>> encounters = EncounterSet.model_validate({"name": "crossings", "encounters": [crossing]})
        >>> result = evaluate_encounters("front_roof_32", encounters, num_start_offsets=2)
        >>> [(row.encounter, row.in_time_share) for row in result.rows]
        [('a', 1.0)]
    """
    if num_start_offsets < 1:
        raise ValueError(f"num_start_offsets: a number >= 1 is needed; got {num_start_offsets}")
    if seed < 0:
        raise ValueError(f"seed: a number >= 0 is needed; got {seed}")
    criterion = Criterion() if criterion is None else criterion
    loaded_rigs = load_rigs(rigs, sensor_model)
    encounter_set = encounters if isinstance(encounters, EncounterSet) else EncounterSet.load(encounters)
    staged, num_encounters = [], len(loaded_rigs) * len(encounter_set.encounters)
    min_encounters = 100  # staging takes about 0.05 s each
    with Progress(num_encounters, "preparing", is_shown=progress and num_encounters >= min_encounters) as bar:
        for name, rig in loaded_rigs.items():
            mounted = MountedRig(rig, set_ego(build_flat_ground(), {name: rig}, vehicle))
            # Encounters are staged before the first scan, so that mistakes are reported at once.
            for encounter in encounter_set.encounters:
                staged.append((mounted, StagedEncounter(encounter, mounted.ego_solid)))
                bar.advance(num_encounters)
    detections = []
    with Progress(len(staged), "encounters", is_shown=progress) as bar:
        for mounted, staged_encounter in staged:
            detections.append(
                detect_encounter(mounted, staged_encounter, criterion, num_start_offsets=num_start_offsets, seed=seed)
            )
            bar.advance(len(staged))
    sensor_names = {name: rig.sensor_names for name, rig in loaded_rigs.items()}
    return EncounterResults(encounter_set.name, criterion, num_start_offsets, seed, sensor_names, detections)


def load_rigs(rigs: AnyRig | Sequence[AnyRig], sensor_model: Literal["ideal", "real"] | None) -> dict[str, Rig]:
    """Load rigs and set their sensor model.

    Args:
        rigs: One or several rigs, as objects, built-in names or YAML files.
        sensor_model: Sensor model; None for the default of each rig.

    Returns:
        Name -> rig.

    Raises:
        FileNotFoundError: Unknown file or built-in name.
        ValueError: Invalid file, no rig, or two rigs with the same name.
    """
    loaded = [load_named_rig(rig) for rig in ([rigs] if isinstance(rigs, str | Path | Rig) else rigs)]
    rig_by_name = {rig.name: rig.apply_sensor_model(sensor_model) for rig in loaded}
    if not loaded or len(rig_by_name) < len(loaded):
        raise ValueError(f"rigs with different names are needed; got {', '.join(rig.name for rig in loaded) or 'none'}")
    return rig_by_name


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
    """Evaluate when rigs detect the road users whom they meet in simulated traffic.

    A road user is met if the time to collision falls to `Criterion.max_ttc_s`.

    Args:
        rigs: One or several rigs, as objects, built-in names or YAML files.
        scenario: Scenario of the traffic, a built-in name or a YAML file.
        criterion: Criterion of encounters, detection and braking.
        num_scenes: Number of scenes of the scenario; 1 is used if all of its scenes are equal.
        vehicle: Vehicle that carries the rigs, as in `evaluate`.
        sensor_model: Sensor model, as in `evaluate`.
        seed: Seed of the traffic, noise and drop-out.
        progress: Whether to show a progress bar.

    Returns:
        Times to collision at detection.

    Raises:
        FileNotFoundError: Unknown file or built-in name.
        ValueError: Invalid file, number out of its bounds, or a scenario in which nothing moves.
    """
    if num_scenes < 1:
        raise ValueError(f"num_scenes: a number >= 1 is needed; got {num_scenes}")
    criterion = Criterion() if criterion is None else criterion
    loaded_rigs = load_rigs(rigs, sensor_model)
    scenario = set_ego(scenario if isinstance(scenario, Scenario) else Scenario.load(scenario), loaded_rigs, vehicle)
    if scenario.num_distinct_time_steps == 1:
        raise ValueError(f"scenario {scenario.name!r}: nothing moves in it, so there are no encounters")
    # Every further scene of a repeating scenario would be equal to the first one.
    num_scenes = 1 if scenario.is_repeating else num_scenes
    # This simulator only builds the scenes, which all rigs share; its reference points are never used.
    scene_simulator = Simulator(scenario, {}, PaperReference(rows=2, columns=2), seed=seed)
    simulators = {name: scene_simulator.replace_rigs({name: rig}) for name, rig in loaded_rigs.items()}
    detections = []
    durations_h = {}
    with Progress(num_scenes, "scenes", is_shown=progress) as bar:
        for scene_index in range(num_scenes):
            first_frame = scene_index * scenario.num_time_steps
            scene = scene_simulator.get_scene_geometry(first_frame)[0].scene
            drive = Drive.from_scene(f"{scenario.name} {scene_index}", scene)
            durations_h[drive.name] = scenario.num_time_steps * scenario.effective_time_step_s / 3600
            approaches = find_approaches(drive, criterion)
            # All rigs meet the same road users, so that their results are paired.
            for name, simulator in simulators.items():
                drive_sensors = DriveSensors.from_simulator(simulator, first_frame, criterion)
                for approach in approaches:
                    detections.append(detect_approach(name, drive, approach, drive_sensors, criterion))
            bar.advance(num_scenes)
    sensor_names = {name: rig.sensor_names for name, rig in loaded_rigs.items()}
    return EncounterResults(scenario.name, criterion, 1, seed, sensor_names, detections, durations_h)


def evaluate_recorded_encounters(
    recording: Recording | str | Path, criterion: Criterion | None = None
) -> EncounterResults:
    """Evaluate when the rigs of a recording detected the road users whom they met.

    Args:
        recording: Recording with poses, times and labeled objects, or its path.
        criterion: Criterion of encounters, detection and braking.

    Returns:
        Times to collision at detection.

    Raises:
        FileNotFoundError: The recording or a part of it does not exist.
        ValueError: The recording lacks poses, times, labels of road users, or the size of its vehicle.
    """
    criterion = Criterion() if criterion is None else criterion
    opened = open_recording(recording) if isinstance(recording, str | Path) else recording
    drive = Drive.from_recording(opened)
    detections = []
    for name, sensors in opened.rigs.items():
        drive_sensors = DriveSensors.from_recording(opened, sensors, criterion)
        for approach in find_approaches(drive, criterion):
            detections.append(detect_approach(name, drive, approach, drive_sensors, criterion))
    durations_h = {drive.name: float(np.ptp(drive.times_s)) / 3600}
    sensor_names = {name: tuple(sensors) for name, sensors in opened.rigs.items()}
    return EncounterResults(drive.name, criterion, 1, 0, sensor_names, detections, durations_h)


def save_encounters(
    encounter_results: EncounterResults, folder: str | Path, *, file_kinds: str | Iterable[str] = FILES
) -> list[Path]:
    """Write the files of the command line.

    Args:
        encounter_results: Results of encounters.
        folder: Folder of `encounters.csv`, `report.html`, `encounters.png` and `summary.json`, created if necessary.
            Files of an earlier run that its `summary.json` lists are deleted.
        file_kinds: Files besides `summary.json`, as in `Result.save`; "maps" is the plot.

    Returns:
        Paths of the files.

    Raises:
        ValueError: A file kind is unknown.
    """
    kinds = parse_file_kinds(file_kinds)
    record = {"verdict": list(summarize_encounters(encounter_results)), **encounter_results.to_record()}
    with AtomicOutput(Path(folder)) as output:
        with defer_signals():  # the numbers are complete before a signal ends the process
            if "numbers" in kinds:
                output.add("encounters.csv", encounter_results.write_csv)
            output.publish(record)
        if "page" in kinds:
            output.add_text("report.html", render_page(build_encounters_page(encounter_results)))
        if "maps" in kinds and not encounter_results.scene_durations_h:
            output.add_figure("encounters.png", encounter_results.plot())
        output.publish(record)
    return output.paths


def summarize_encounters(encounter_results: EncounterResults) -> tuple[str, ...]:
    """Summarize in how many encounters each rig detects the road user in time.

    Args:
        encounter_results: Results of encounters.

    Returns:
        One sentence: for a set the encounters that are always in time, in traffic the late detections.
    """
    rows_by_rig: dict[str, list[EncounterRow]] = {rig: [] for rig in encounter_results.sensor_names}
    for row in encounter_results.rows:
        if row.encounter != TOTAL_ROW and row.braking_count:
            rows_by_rig[row.rig].append(row)
    if not any(rows_by_rig.values()):
        return ("The vehicle had to brake for no road user.",)
    counts, totals = {}, []
    for rig, rows in rows_by_rig.items():
        if encounter_results.scene_durations_h:
            counts[rig] = round(sum((1 - row.in_time_share) * row.braking_count for row in rows))
            totals.append(sum(row.braking_count for row in rows))
        else:
            counts[rig] = sum(row.in_time_share == 1 for row in rows)
            totals.append(len(rows))
    listed = ", ".join(f"{rig} {count}" for rig, count in counts.items())
    if encounter_results.scene_durations_h:
        return (f"Detected too late: {listed}, of {max(totals)} road users for whom the vehicle had to brake.",)
    name = encounter_results.name
    return (f"Always detected in time: {listed}, of {max(totals)} encounters of {name}, counting each speed.",)


def build_encounters_page(encounter_results: EncounterResults) -> Page:
    """Build the page of encounters.

    Args:
        encounter_results: Results of encounters.

    Returns:
        Page with findings and tables, and for a set a plot of time to collision by speed.
    """
    pictures = []
    if not encounter_results.scene_durations_h:
        png = BytesIO()
        encounter_results.plot().savefig(png, format="png")
        pictures = [PagePicture("Time to collision at detection by speed", png.getvalue())]
    return Page(
        title=f"Detection before a collision: {', '.join(encounter_results.sensor_names)}",
        lead=f"Encounters of {encounter_results.name}, measured by torchcover. A detection is in time if braking, with "
        "the assumed latency and deceleration, prevents the collision; the decision is based on geometry alone.",
        findings=summarize_encounters(encounter_results),
        tables=encounter_results.build_tables(),
        pictures=pictures,
        facts={"Settings": format_facts(encounter_results.get_settings()), "Run": {"torchcover": __version__}},
    )
