"""Animation of an encounter in bird's-eye view, with the points of the rig on the road user."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import numpy as np
from matplotlib.figure import Figure

from torchcover.encounters import Encounter, EncounterDetection, EncounterResults, StagedEncounter
from torchcover.encounters.detection import EncounterPointCounter, MountedRig
from torchcover.encounters.staging import FRAME_INTERVAL_S, get_solid
from torchcover.evaluation.encounter_evaluation import load_rigs
from torchcover.evaluation.rig_names import AnyRig
from torchcover.evaluation.target_visibility import build_flat_ground
from torchcover.geometry import invert, transform_outline
from torchcover.report import ActorMark, StaticFaces, plot_scene
from torchcover.simulation import SensorNoise, set_ego
from torchcover.simulation.bodies import get_shape_name


@dataclass(frozen=True)
class AnimationParams:
    """Parameters of the animation of an encounter.

    Args:
        duration_s: Length of the animation, which ends with the collision.
        frame_stride: Number of time steps of 1 ms between two figures; 100 give ten figures per second.
        margin_m: Space around all bodies.
    """

    duration_s: float = 3.0
    frame_stride: int = 100
    margin_m: float = 3.0


def plot_encounter_animation(
    rig: AnyRig,
    encounter_results: EncounterResults,
    *,
    vehicle: str | Path | None = None,
    sensor_model: Literal["ideal", "real"] | None = None,
    params: AnimationParams = AnimationParams(),
) -> Iterator[Figure]:
    """Plot the last seconds of the encounter in which a rig has the smallest margin for braking.

    Args:
        rig: Rig of the results, as an object, built-in name or YAML file.
        encounter_results: Results for a set of encounters.
        vehicle: Vehicle that carries the rig, as in the evaluation.
        sensor_model: Sensor model, as in the evaluation.
        params: Length, rate and margin of the animation.

    Returns:
        Figures outside pyplot, one after the other.
    """
    ((name, loaded_rig),) = load_rigs(rig, sensor_model).items()
    detections = [detection for detection in encounter_results.detections if detection.rig == name]
    # The smallest margin is the worst case: negative if the rig detects the road user too late.
    margins_s = [detection.ttc_s.min() - detection.braking_time_s for detection in detections]
    detection = detections[int(np.argmin(margins_s))]
    encounter = cast(Encounter, detection.encounter)
    mounted = MountedRig(loaded_rig, set_ego(build_flat_ground(), {name: loaded_rig}, vehicle))
    staged = StagedEncounter(encounter, mounted.ego_solid)
    scene = staged.build_scene(mounted.solids, includes_road_user=True)
    point_counter = EncounterPointCounter(mounted, staged, encounter_results.seed)
    sensors, sensor_names = mounted.get_mounted_sensors(encounter, scene), encounter_results.sensor_names[name]
    subtitle = _describe_detection(detection, encounter, sensor_names, encounter_results.find_max_speeds_kmh())

    # Figures end with the contact; before it, they show the last seconds at a constant rate.
    first_frame = max(int((staged.contact_time_s - params.duration_s) / FRAME_INTERVAL_S), 0)
    frame_indices = np.arange(first_frame, int(staged.contact_time_s / FRAME_INTERVAL_S), params.frame_stride)
    times_s = FRAME_INTERVAL_S * frame_indices.astype(np.float64)
    vehicle_T_world = invert(staged.compute_world_T_ego(times_s))
    bodies = [(obstacle.body, vehicle_T_world @ pose) for obstacle, pose in staged.obstacles]
    bodies.append((encounter.road_user.body, staged.compute_vehicle_T_road_user(times_s)))
    body_names, outlines = [], []
    for body, vehicle_T_body in bodies:
        body_names.append(get_shape_name(body))
        outlines.append(transform_outline(get_solid(body).bounding_box.outline_m, vehicle_T_body))
    # All figures have the same bounds, so that the animation does not jump.
    outlines_m = np.stack(outlines, axis=1)  # (frames, bodies, corners, 2)
    ego_outline_m = mounted.ego_solid.bounding_box.outline_m
    corners_m = np.concatenate([outlines_m.reshape(-1, 2), ego_outline_m])
    x_bounds_m, y_bounds_m = zip(
        (corners_m.min(axis=0) - params.margin_m).tolist(),
        (corners_m.max(axis=0) + params.margin_m).tolist(),
        strict=True,
    )
    for frame_index, frame_outlines_m in zip(frame_indices.tolist(), outlines_m, strict=True):
        snapshot = scene.get_snapshot(frame_index)
        clouds, counts = [], []
        for index, mounted_sensor in enumerate(sensors):
            noise = SensorNoise(np.random.default_rng(frame_index), mounted_sensor.sensor.num_rays)
            clouds.append(mounted_sensor.scan(snapshot, noise).points)
            count = point_counter.count_points([index], np.array([frame_index]))[0]
            counts.append(f"{sensor_names[index]} {count}")
        remaining_s = staged.contact_time_s - FRAME_INTERVAL_S * frame_index
        yield plot_scene(
            x_bounds_m,
            y_bounds_m,
            # Obstacles are plotted as actors, and the flat ground is not plotted.
            static_faces=StaticFaces(np.empty((0, 3, 2)), np.empty(0)),
            ego_outline_m=ego_outline_m,
            actors=[ActorMark(*actor) for actor in zip(body_names, frame_outlines_m, strict=True)],
            sensor_points=np.concatenate(clouds),
            title=f"{remaining_s:.2f} s to the collision; points on the road user: {', '.join(counts)}",
            subtitle=subtitle,
        )


def _describe_detection(
    detection: EncounterDetection,
    encounter: Encounter,
    sensor_names: tuple[str, ...],
    max_speeds_kmh: Mapping[tuple[str, str], float],
) -> str:
    """Describe when the rig detects the road user, and the effect of its sensors."""
    text = f"{encounter.description}: detected {detection.ttc_s.min():.2f} s before the collision, needed "
    text += f"{detection.braking_time_s:.2f} s"
    if len(sensor_names) > 1:
        ttc_without_s = detection.ttc_without_sensor_s.min(axis=1)
        first_sensor = sensor_names[detection.sensor_ttc_s.mean(axis=1).argmax()]
        worst_failure = ttc_without_s.argmin()
        text += (
            f"; first sensor {first_sensor}, without {sensor_names[worst_failure]} {ttc_without_s[worst_failure]:.2f} s"
        )
    if encounter.is_speed_swept:
        speed_kmh = max_speeds_kmh[encounter.name, detection.rig]
        text += "; in time at no speed" if math.isnan(speed_kmh) else f"; in time up to {speed_kmh:g} km/h"
    return text
