"""Check of requirements: measure all numbers that they name, judge them, and write the verdicts."""

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from torchcover.coverage import AGGREGATIONS, Coverage
from torchcover.coverage.number import estimate_number
from torchcover.encounters import StagedEncounter
from torchcover.evaluation.check_result import CheckResult
from torchcover.evaluation.encounter_evaluation import evaluate_encounters
from torchcover.evaluation.measurement import measure_coverage
from torchcover.evaluation.requirements import EncounterRequirement, RegionRequirement, Requirements, TargetRequirement
from torchcover.evaluation.result_notes import describe_perfect_depth
from torchcover.evaluation.rig_names import AnyRig, load_rig, make_rig_names
from torchcover.evaluation.settings import DEFAULT_SCENARIO, Settings
from torchcover.evaluation.target_positions import TargetPositions
from torchcover.evaluation.target_visibility import build_flat_ground, load_rig_and_scenario
from torchcover.evaluation.task import AnyScenario, build_task, compute_frame_interval_s
from torchcover.evaluation.verdicts import Readings, Verdict, judge_bound
from torchcover.geometry.arrays import Float64
from torchcover.simulation import Rig, Scenario, Sensor, set_ego
from torchcover.simulation.camera_sensor import CameraSensor
from torchcover.simulation.moving_bodies import BodyGeometry
from torchcover.targets import Target, measure_visibility_at_positions
from torchcover.targets.result import PositionVisibility
from torchcover.targets.visibility import THRESHOLD_M

SensorModel: TypeAlias = Literal["ideal", "real"] | None


def check(
    rigs: AnyRig | Sequence[AnyRig],
    requirements: Requirements | str | Path,
    scenario: AnyScenario | None = None,
    *,
    vehicle: str | Path | None = None,
    sensor_model: SensorModel = None,
    num_frames: int | None = None,
    seed: int = 0,
    num_workers: int | None = None,
    progress: bool = False,
) -> CheckResult:
    """Check whether rigs meet requirements.

    Args:
        rigs: One rig or several: a `Rig`, a built-in name, or a YAML file each.
        requirements: Requirements, the name of a built-in set, or a YAML file.
        scenario: Scenario that replaces the scenario of the requirements.
        vehicle: Ego vehicle, as in `evaluate`; if not given, each rig is on its own vehicle.
        sensor_model: Sensor model, as in `evaluate`.
        num_frames: Number of frames, as in `evaluate` and `map_target_visibility`.
        seed: Seed of the simulation.
        num_workers: Worker processes, as in `evaluate`.
        progress: Whether to show progress bars.

    Returns:
        Verdicts for each rig.

    Raises:
        FileNotFoundError: Unknown name or file.
        ValueError: Invalid file, or a requirement on a sensor, region or number that does not exist.

    Example:
        >>> child = {"target": "child", "positions": {"points_m": [[5.0, 0.0]]}, "points": 5}
        >>> result = check("front_roof_128", Requirements.model_validate({"requirements": [child]}))
        >>> [verdict.state for verdict in result.verdicts["front_roof_128"]], result.is_met
        (['met'], True)
    """
    if not isinstance(requirements, Requirements):
        requirements = Requirements.load(requirements)
    named_rigs = _load_rigs(rigs)
    targets = _load_targets(requirements)
    _check_rigs(named_rigs, requirements, vehicle)  # before the work, not after it
    simulation: dict[str, Any] = {"vehicle": vehicle, "sensor_model": sensor_model, "seed": seed}
    scenario = scenario or requirements.scenario
    verdicts: dict[str, list[Verdict]] = {}
    for rig in named_rigs:
        coverage = _measure_regions(
            requirements, rig, scenario, num_frames=num_frames, num_workers=num_workers, progress=progress, **simulation
        )
        verdicts[rig.name] = []
        for requirement in requirements.requirements:
            readings: Mapping[str, Readings]
            if isinstance(requirement, RegionRequirement):
                assert coverage is not None  # it exists as soon as there is such a requirement
                readings = {requirement.number: _read_region(requirement, coverage, rig)}
            elif isinstance(requirement, EncounterRequirement):
                readings = _measure_encounters(requirement, rig, progress=progress, **simulation)
            else:
                positions = requirement.positions
                if isinstance(positions, str):
                    positions = requirements.position_sets[positions]
                target = targets[requirement.target]
                readings = _measure_target(
                    requirement, positions, target, rig, scenario, num_frames=num_frames, **simulation
                )
            for bound in requirement.bounds:
                verdicts[rig.name].append(judge_bound(requirement.text, bound, readings[bound.key]))
    settings = _record_settings(requirements, named_rigs, scenario, {"num_frames": num_frames, **simulation})
    return CheckResult(requirements, verdicts, settings)


def _load_rigs(rigs: AnyRig | Sequence[AnyRig]) -> list[Rig]:
    """Load the rigs under the names that tables and files use."""
    sources = [rigs] if isinstance(rigs, str | Path | Rig) else rigs
    if not sources:
        raise ValueError("check: at least one rig is needed; got none")
    names = make_rig_names(sources)
    return [load_rig(source).model_copy(update={"name": name}) for source, name in zip(sources, names, strict=True)]


def _load_targets(requirements: Requirements) -> dict[str, Target]:
    """Load the test target of each requirement that has one."""
    names = [item.target for item in requirements.requirements if isinstance(item, TargetRequirement)]
    return {name: Target.load(name) for name in names}


def _check_rigs(rigs: Sequence[Rig], requirements: Requirements, vehicle: str | Path | None) -> None:
    """Raise ValueError if a rig lacks a sensor, or an encounter is shorter than a required time to collision."""
    for rig, requirement in product(rigs, requirements.requirements):
        requirement.find_failing_sensors(rig.sensor_names)
        if isinstance(requirement, TargetRequirement):
            requirement.group_sensors(rig.sensors)
        if isinstance(requirement, EncounterRequirement):
            _check_durations(requirement, set_ego(build_flat_ground(), {rig.name: rig}, vehicle))


def _check_durations(requirement: EncounterRequirement, scenario: Scenario) -> None:
    """Raise ValueError if an encounter is shorter than its required time to collision."""
    if requirement.ttc_s is None:
        return
    ego = BodyGeometry(scenario.build_ego_mesh())
    for encounter in requirement.encounters.encounters:
        duration_s = StagedEncounter(encounter, ego).contact_time_s
        if requirement.ttc_s > duration_s:
            raise ValueError(
                f"ttc_s: {requirement.ttc_s:g} s are required, and {encounter.description} of "
                f"{requirement.encounters.name!r} lasts {duration_s:.2f} s; require less, or start the encounter "
                "earlier (max_lead_time_s, road_user.approach_distance_m)"
            )


def _record_settings(
    requirements: Requirements, rigs: Sequence[Rig], scenario: AnyScenario | None, settings: Mapping[str, Any]
) -> dict[str, Any]:
    """Build the settings of `summary.json`: the scenario of each kind of requirement, frames, vehicle, notes."""
    # Encounters are always staged on flat ground; test targets only without a scenario.
    flat_ground = build_flat_ground().name
    name = scenario.name if isinstance(scenario, Scenario) else str(scenario or "")
    scenarios = {"region": name or DEFAULT_SCENARIO, "target": name or flat_ground, "encounters": flat_ground}
    used_scenarios = {}
    for kind, scenario_name in scenarios.items():
        if any(hasattr(requirement, kind) for requirement in requirements.requirements):
            used_scenarios[kind] = scenario_name
    texts = {key: str(value) if isinstance(value, Path) else value for key, value in settings.items()}
    has_regions = "region" in used_scenarios
    notes = describe_perfect_depth({rig.name: rig.sensors for rig in rigs}) if has_regions else []
    return {"scenarios": used_scenarios, **texts, "notes": notes}


def _measure_regions(
    requirements: Requirements,
    rig: Rig,
    scenario: AnyScenario | None,
    **settings: Any,  # noqa: ANN401  (of `Settings`)
) -> Coverage | None:
    """Measure the coverage with all required numbers of regions; None if no region is required."""
    region_requirements = [item for item in requirements.requirements if isinstance(item, RegionRequirement)]
    if not region_requirements:
        return None
    # One run measures the numbers of all requirements, since casting rays takes most of the time.
    keys = {requirement.number for requirement in region_requirements}
    thresholds_m = sorted({item.threshold_m for item in region_requirements if item.threshold_m})
    aggregations = [kind.from_keys(keys) for kind in AGGREGATIONS]
    needs_redundancy = any(
        requirement.failing_sensors or requirement.number.startswith(("sensors", "detected_by"))
        for requirement in region_requirements
    )
    run_settings = Settings(
        [rig],
        scenario,
        regions=requirements,
        thresholds_m=thresholds_m or THRESHOLD_M,
        aggregations=[aggregation for aggregation in aggregations if aggregation],
        redundancy=needs_redundancy,
        test_targets="none",
        **settings,
    )
    result = measure_coverage(build_task(run_settings), run_settings)
    if result.run is not None:
        result.run.raise_failure()
    return result.coverage


def _read_region(requirement: RegionRequirement, coverage: Coverage, rig: Rig) -> Readings:
    """Read the number with all sensors, then without each sensor that may fail."""
    (region,) = (region for region in coverage.regions if region.name == requirement.region)
    failing_sensors = requirement.find_failing_sensors(rig.sensor_names)
    rows, locations = [], []
    for suffix in ("", *(f"_without_{name}" for name in failing_sensors)):
        estimate = estimate_number(coverage, requirement.number + suffix, region, requirement.band)
        (number,) = estimate.to_numbers().values()
        # An error of NaN despite enough blocks means that all blocks have the same value: it is exact.
        is_exact = np.isnan(number.error) and estimate.has_intervals[0]
        rows.append((number.value,) * 3 if is_exact else (number.value, number.low, number.high))
        locations.append(f"{requirement.region} {requirement.band}{suffix.replace('_', ' ')}")
    value, low, high = np.array(rows).T
    return Readings(value, low, high, locations)


def _measure_encounters(
    requirement: EncounterRequirement,
    rig: Rig,
    **settings: Any,  # noqa: ANN401  (of `evaluate_encounters`)
) -> dict[str, Readings]:
    """Measure the latest detection of each encounter over all start offsets, also without each failing sensor.

    The upper end is inf if the road user was already visible at the start of the encounter.
    """
    results = evaluate_encounters(rig, requirement.encounters, requirement.criterion, **settings)
    rows, locations = [], []
    for encounter, detection in zip(requirement.encounters.encounters, results.detections, strict=True):
        ttc_by_suffix_s = {"": detection.ttc_s.min()}
        for name in requirement.find_failing_sensors(rig.sensor_names):
            ttc_by_suffix_s[f", without {name}"] = detection.ttc_without_sensor_s[rig.sensor_names.index(name)].min()
        for suffix, ttc_s in ttc_by_suffix_s.items():
            rows.append((ttc_s, detection.braking_time_s, np.inf if ttc_s >= detection.censoring_ttc_s else ttc_s))
            locations.append(f"{encounter.description}{suffix}")
    ttc_s, needed_s, high_s = np.array(rows).T
    margin_s = ttc_s - needed_s
    return {
        "ttc_s": Readings(ttc_s, ttc_s, high_s, locations),
        "braking_margin_s": Readings(margin_s, margin_s, high_s - needed_s, locations),
    }


def _measure_target(
    requirement: TargetRequirement,
    positions: TargetPositions,
    target: Target,
    rig: Rig,
    scenario: AnyScenario | None,
    *,
    num_frames: int | None,
    vehicle: str | Path | None,
    sensor_model: SensorModel,
    seed: int,
) -> dict[str, Readings]:
    """Measure all required numbers of a test target at every position, for each group of sensors."""
    rig, scenario, usual_num_frames = load_rig_and_scenario(rig, scenario, vehicle, sensor_model)
    positions_m = positions.compute_positions_m(scenario.compute_ego_box())
    groups = requirement.group_sensors(rig.sensors)
    if num_frames is None or usual_num_frames == 1:
        num_frames = usual_num_frames
    frame_interval_s = compute_frame_interval_s(scenario, None)

    def measure(sensor_indices: Sequence[int]) -> PositionVisibility:
        """Measure the visibility at all positions for some sensors."""
        return measure_visibility_at_positions(
            rig,
            scenario,
            target,
            positions_m,
            sensor_indices,
            num_frames=num_frames,
            frame_interval_s=frame_interval_s,
            seed=seed,
            detection_points=requirement.detection_points,
        )

    # Visual angles and pixels depend on single sensors, which need their own measurement.
    has_angles = bool(requirement.pixels or requirement.visual_angle_deg)
    values: dict[str, list[Float64]] = {bound.key: [] for bound in requirement.bounds}
    locations: list[str] = []
    for suffix, group in groups.items():
        target_map = measure(group)
        # Free cells of an area are judged; a listed point is judged even if it is occupied, as not decided.
        is_judged = (target_map.state == 0) | (positions.points_m is not None)
        frame_counts = target_map.free_frames[is_judged].tolist()
        for (x_m, y_m), count in zip(positions_m[is_judged].tolist(), frame_counts, strict=True):
            locations.append(f"x = {x_m:.2f}, y = {y_m:.2f} m{suffix}{_format_occupancy(count, num_frames)}")
        unobserved = np.where(target_map.state == 0, 0.0, np.nan)
        # The mean over frames of points or sensors would hide a frame in which nothing is detected.
        numbers = {
            "points": target_map.min_points,
            "sensors": target_map.min_sensors,
            "share": target_map.surface_share,
            "pixels": unobserved,
            "visual_angle_deg": unobserved,
        }
        for index in group if has_angles else ():
            points, sensor = measure([index]).min_points, rig.sensors[index]
            angle_deg = _compute_visual_angle_deg(sensor, target, positions_m)
            angle_deg = np.where(points >= requirement.detection_points, angle_deg, 0.0)
            numbers["visual_angle_deg"] = np.fmax(numbers["visual_angle_deg"], angle_deg)
            if isinstance(sensor, CameraSensor):
                numbers["pixels"] = np.fmax(numbers["pixels"], points)
        for key, parts in values.items():
            parts.append(numbers[key][is_judged])
    occupied_count = len(positions_m) - len(locations) // len(groups)
    readings = {}
    for key, parts in values.items():
        value = np.concatenate(parts)
        readings[key] = Readings(value, value, value, locations, occupied_count)
    return readings


def _format_occupancy(free_frame_count: int, num_frames: int) -> str:
    """Format in how many frames a position is free; empty if it is free in all."""
    if free_frame_count == num_frames:
        return ""
    return f", free in {free_frame_count} of {num_frames} frames" if free_frame_count else ", occupied"


def _compute_visual_angle_deg(sensor: Sensor, target: Target, positions_m: Float64) -> Float64:
    """Compute the vertical angle from the foot to the top of a target at a sensor, for (P, 2) positions."""
    x_m, y_m, z_m = sensor.mount.to_matrix()[:3, 3]
    distance_m = np.hypot(*(positions_m - (x_m, y_m)).T)
    box = target.solid.bounding_box
    top_rad = np.arctan2(box.upper_m[2] - z_m, distance_m)
    foot_rad = np.arctan2(box.lower_m[2] - z_m, distance_m)
    return np.asarray(np.rad2deg(top_rad - foot_rad))
