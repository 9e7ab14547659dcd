"""Detection of road users in encounters: scans start at whole milliseconds; only scans that decide are simulated."""

import math
import warnings
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from torchcover.encounters.criterion import Criterion
from torchcover.encounters.encounter import Encounter
from torchcover.encounters.staging import FRAME_INTERVAL_S, StagedEncounter
from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation.camera_sensor import CameraSensor
from torchcover.simulation.lidar import Lidar
from torchcover.simulation.mounted_rigs import mount_sensors
from torchcover.simulation.mounted_sensor import MountedSensor, RayEnds, compute_visibility
from torchcover.simulation.moving_bodies import BodyGeometry, BodyGeometryCache, MovingBodies
from torchcover.simulation.radar import Radar
from torchcover.simulation.rig import Rig
from torchcover.simulation.scenario import Scenario
from torchcover.simulation.scene_geometry import SceneGeometry
from torchcover.simulation.sensor import Sensor, SensorNoise
from torchcover.targets.counting import SensorBeams, TargetHits, find_measured_hits, find_target_hits
from torchcover.targets.target_frames import SensorFrame

if TYPE_CHECKING:
    from torchcover.encounters.traffic import Approach

# Tests for (N,) frames whether a group of sensors has enough points.
DetectionTest = Callable[[Int64], Bools]

# Frame of a detection that does not happen: later than any frame.
NEVER = np.iinfo(np.int64).max


class EncounterDetection(NamedTuple):
    """Detection of one encounter by a rig, for P start offsets of the scans and S sensors.

    Times to collision are 0 if the road user is not detected before the collision.

    Args:
        encounter: The encounter.
        rig: Name of the rig.
        braking_time_s: Time to collision at which braking still helps; in traffic the maximum over the approach.
        ttc_s: (P,) time to collision at detection.
        in_time: (P,) 1 if the detection is in time, 0 if not, NaN if undecided.
        sensor_ttc_s: (S, P) time to collision at the detection by each sensor alone.
        ttc_without_sensor_s: (S, P) time to collision at the detection without each sensor.
        censoring_ttc_s: From this time to collision on, the road user was detected as soon as the encounter began, and
            may have been visible before: the time to collision is a lower limit. inf if the road user appeared then.
        scene_id: Name of the scene, in traffic.
    """

    encounter: "Encounter | Approach"
    rig: str
    braking_time_s: float
    ttc_s: Float64
    in_time: Float64
    sensor_ttc_s: Float64
    ttc_without_sensor_s: Float64
    censoring_ttc_s: float
    scene_id: str = ""


class MountedRig:
    """Rig on its vehicle, for any number of encounters.

    Args:
        rig: The sensors; each scan is simulated at one time, whatever its duration.
        scenario: Scenario whose ego vehicle carries the rig; see `set_ego`.
    """

    def __init__(self, rig: Rig, scenario: Scenario) -> None:
        self.rig, self._scenario = rig, scenario
        self.ego_solid, self.solids = BodyGeometry(scenario.build_ego_mesh()), BodyGeometryCache()
        self._sensors_by_weather: dict[str, Sequence[MountedSensor]] = {}
        self._slow_sensors = set[str]()

    def get_mounted_sensors(self, encounter: Encounter, scene: SceneGeometry) -> Sequence[MountedSensor]:
        """Get the sensors in the weather of an encounter.

        Args:
            encounter: The encounter; the weather of the rig has priority.
            scene: Scene with the ego vehicle.

        Returns:
            The sensors.

        Raises:
            ValueError: A sensor is inside the body of the ego vehicle.
        """
        weather = self.rig.weather or encounter.weather
        key = weather.model_dump_json()
        if key not in self._sensors_by_weather:
            sensors = []
            for sensor in self.rig.sensors:
                # Without the durations of scans, all rays of a scan are cast at the same time.
                has_scan = getattr(sensor, "scan", None) is not None
                sensors.append(sensor.model_copy(update={"scan": None}) if has_scan else sensor)  # type: ignore[attr-defined]
            rig = self.rig.model_copy(update={"sensors": sensors, "weather": weather})
            self._sensors_by_weather[key] = mount_sensors(scene, self._scenario, self.rig.name, rig)
        return self._sensors_by_weather[key]

    def check_rates(self, consecutive_scans: int, staged: StagedEncounter) -> None:
        """Warn, once for each sensor, if its scans take longer than an encounter.

        Args:
            consecutive_scans: Scans that a detection needs.
            staged: The encounter.
        """
        for sensor in self.rig.sensors:
            duration_s = consecutive_scans / sensor.rate_hz
            if duration_s > staged.contact_time_s and sensor.name not in self._slow_sensors:
                self._slow_sensors.add(sensor.name)
                warnings.warn(
                    f"rig {self.rig.name!r}: {consecutive_scans} scans of sensor {sensor.name!r} take "
                    f"{duration_s:.3g} s, and {staged.encounter.description} ends after "
                    f"{staged.contact_time_s:.3g} s: this sensor is always too late",
                    stacklevel=3,
                )

    @cached_property
    def beams(self) -> Sequence[SensorBeams | None]:
        """Beams of each sensor; the sensors must be mounted."""
        return [SensorBeams.from_sensor(sensor) for sensor in next(iter(self._sensors_by_weather.values()))]


def detect_encounter(
    mounted_rig: MountedRig,
    staged: StagedEncounter,
    criterion: Criterion,
    *,
    num_start_offsets: int = 10,
    seed: int = 0,
) -> EncounterDetection:
    """Find out when a rig detects the road user of an encounter.

    The scans of all sensors start together, at `num_start_offsets` offsets within their period. The result of each
    offset equals that of a simulation of all scans.

    Args:
        mounted_rig: The rig.
        staged: The encounter with the ego vehicle of the rig.
        criterion: Criterion of detection and braking.
        num_start_offsets: Number of start offsets.
        seed: Seed of noise and drop-out.

    Returns:
        Times to collision at detection.

    Raises:
        ValueError: A sensor is inside the body of the ego vehicle.
    """
    encounter, sensors = staged.encounter, mounted_rig.rig.sensors
    counter = EncounterPointCounter(mounted_rig, staged, seed)
    mounted_rig.check_rates(criterion.consecutive_scans, staged)

    def find_first(is_detected: DetectionTest, sensor_index: int) -> Int64:
        scan_frames = compute_scan_frames(sensors[sensor_index].rate_hz, num_start_offsets, staged.contact_time_s)
        return find_first_run(is_detected, scan_frames, criterion.consecutive_scans)

    detection_frames = find_detection_frames(
        [1 / sensor.rate_hz if isinstance(sensor, Lidar) else None for sensor in sensors],
        [get_min_points(criterion, sensor) for sensor in sensors],
        counter.count_points,
        find_first,
    )
    ttc_s, sensor_ttc_s, ttc_without_sensor_s = (
        np.where(frames < NEVER, staged.contact_time_s - FRAME_INTERVAL_S * frames, 0.0) for frames in detection_frames
    )
    censoring_ttc_s = math.inf
    if encounter.lead_time_s == encounter.max_lead_time_s:  # the road user does not appear later
        longest_run_s = max((criterion.consecutive_scans / sensor.rate_hz for sensor in sensors), default=0.0)
        censoring_ttc_s = max(staged.contact_time_s - longest_run_s, 0.0) + FRAME_INTERVAL_S / 2
    braking_time_s = criterion.compute_braking_time_s(abs(encounter.ego.speed_mps), encounter.approach_speed_mps)
    in_time = (ttc_s >= braking_time_s).astype(np.float64)
    return EncounterDetection(
        encounter, mounted_rig.rig.name, braking_time_s, ttc_s, in_time, sensor_ttc_s, ttc_without_sensor_s,
        censoring_ttc_s,
    )  # fmt: skip


def find_detection_frames(
    scan_periods: Sequence[float | None],
    min_points: Sequence[int],
    count_points: Callable[[Sequence[int], Int64], Int64],
    find_first: Callable[[DetectionTest, int], Int64],
) -> tuple[Int64, Int64, Int64]:
    """Find the frames in which S sensors detect a road user.

    Args:
        scan_periods: Scan period of each sensor as in `group_sensors`.
        min_points: Number of points of each sensor that is enough.
        count_points: Counts the points of some sensors together in (N,) frames.
        find_first: Finds the (P,) frames in which a run of scans is first detected, given a test and the sensor whose
            scans it concerns.

    Returns:
        (P,) frame of the detection by all sensors together, (S, P) by each alone, and (S, P) without each; `NEVER`
        without detection.
    """
    sensor_indices = range(len(scan_periods))
    group_frames: dict[tuple[int, ...], Int64] = {}

    def find_group_frames(group: tuple[int, ...]) -> Int64:
        def is_detected(frame_indices: Int64) -> Bools:
            return np.asarray(count_points(group, frame_indices) >= min_points[group[0]])

        if group not in group_frames:
            group_frames[group] = find_first(is_detected, group[0])
        return group_frames[group]

    def find_frames(sensors: Sequence[int]) -> Int64:
        frames = [find_group_frames(group) for group in group_sensors(scan_periods, sensors)]
        return np.min(frames, axis=0) if frames else np.full_like(all_frames, NEVER)

    all_frames = find_frames(sensor_indices)
    frames_without = []
    for failed in sensor_indices:
        frames_without.append(find_frames([index for index in sensor_indices if index != failed]))
    sensor_frames = [find_frames([index]) for index in sensor_indices]
    return all_frames, np.stack(sensor_frames), np.stack(frames_without)


def get_min_points(criterion: Criterion, sensor: Sensor) -> int:
    """Get the number of points that a sensor, and the sensors that are counted with it, need for a detection.

    Args:
        criterion: The criterion.
        sensor: The sensor.

    Returns:
        Number of points; 1 for a radar, whose range cell is larger than a child.
    """
    if isinstance(sensor, CameraSensor):
        return criterion.pixels
    return 1 if isinstance(sensor, Radar) else criterion.points


def group_sensors(scan_periods: Sequence[float | None], sensor_indices: Sequence[int]) -> list[tuple[int, ...]]:
    """Group sensors whose points are counted together in the scans of the first sensor of the group.

    For each LiDAR, the points of all LiDARs are counted that scan at least as often: a faster LiDAR adds scans of its
    own and keeps those that it shares with slower ones.

    Args:
        scan_periods: Scan period of each sensor; None for a sensor that is counted alone.
        sensor_indices: Sensors that are considered.

    Returns:
        Indices of the sensors of each group, the slowest first.
    """
    groups: list[tuple[int, ...]] = []
    lidar_periods: dict[int, float] = {}
    for index in sensor_indices:
        period = scan_periods[index]
        if period is None:
            groups.append((index,))
        else:
            lidar_periods[index] = period
    slowest_first = sorted(lidar_periods, key=lambda index: -lidar_periods[index])
    for max_period in dict.fromkeys(lidar_periods.values()):
        groups.append(tuple(index for index in slowest_first if lidar_periods[index] <= max_period))
    return groups


def compute_scan_frames(rate_hz: float, num_start_offsets: int, contact_s: float) -> Int64:
    """Compute the frames in which a sensor scans before the contact.

    Args:
        rate_hz: Scans per second.
        num_start_offsets: Number P of start offsets within the period.
        contact_s: Time of the contact.

    Returns:
        (P, J) frames in ascending order; `NEVER` after the contact.
    """
    num_scans = math.ceil(contact_s * rate_hz)
    start_offsets = np.arange(num_start_offsets)[:, None] / num_start_offsets
    frames = np.round((np.arange(num_scans) + start_offsets) / rate_hz / FRAME_INTERVAL_S).astype(np.int64)
    return np.where(frames * FRAME_INTERVAL_S < contact_s, frames, NEVER)


def find_first_run(is_detected: DetectionTest, frame_indices: Int64, consecutive_scans: int) -> Int64:
    """Find the first run of consecutive scans in which a road user is detected.

    A scan without detection excludes all runs that contain it. The last scan of a run is therefore tested first:
    before the first detection, only one of `consecutive_scans` scans is tested.

    Args:
        is_detected: Tests (N,) frames.
        frame_indices: (P, J) frames of the scans for each start offset; `NEVER` at the end.
        consecutive_scans: Length of the run.

    Returns:
        (P,) frame of the last scan of the run, or `NEVER`.
    """
    num_offsets, num_scans = frame_indices.shape
    results = np.zeros(frame_indices.shape, dtype=np.int8)  # 1 detected, -1 not detected, 0 not tested
    run_begins = np.zeros(num_offsets, dtype=np.int64)
    detection_frames = np.full(num_offsets, NEVER)
    is_searching = np.ones(num_offsets, dtype=bool)
    while True:
        is_searching &= run_begins + consecutive_scans <= num_scans
        run_ends = run_begins[is_searching] + consecutive_scans - 1
        is_searching[is_searching] &= frame_indices[is_searching, run_ends] < NEVER
        tested_scans = np.full(num_offsets, -1)
        for offset in np.flatnonzero(is_searching).tolist():
            begin = run_begins[offset]
            untested = np.flatnonzero(results[offset, begin : begin + consecutive_scans] == 0)
            if len(untested) == 0:
                detection_frames[offset] = frame_indices[offset, begin + consecutive_scans - 1]
                is_searching[offset] = False
            else:
                tested_scans[offset] = begin + untested[-1]
        offsets = np.flatnonzero(is_searching)
        if len(offsets) == 0:
            return detection_frames
        scans = tested_scans[offsets]
        is_enough = is_detected(frame_indices[offsets, scans])
        results[offsets, scans] = np.where(is_enough, 1, -1)
        run_begins[offsets[~is_enough]] = scans[~is_enough] + 1


class EncounterPointCounter:
    """Count points of each sensor on the road user of an encounter, at any millisecond and each only once.

    Args:
        mounted_rig: The rig.
        staged: The encounter.
        seed: Seed of noise and drop-out.
    """

    def __init__(self, mounted_rig: MountedRig, staged: StagedEncounter, seed: int) -> None:
        self._staged, self._seed, self._rig = staged, seed, mounted_rig
        self._scene = staged.build_scene(mounted_rig.solids)
        self._mounted_sensors = mounted_rig.get_mounted_sensors(staged.encounter, self._scene)
        self._points_by_frame: list[dict[int, int]] = [{} for _ in self._mounted_sensors]

    def count_points(self, sensor_indices: Sequence[int], frame_indices: Int64) -> Int64:
        """Count the points, or pixels, of some sensors together.

        Args:
            sensor_indices: The sensors.
            frame_indices: (N,) frames.

        Returns:
            (N,) number of points.
        """
        points = [self._count_sensor_points(index, frame_indices) for index in sensor_indices]
        return np.asarray(np.sum(points, axis=0, dtype=np.int64))

    def _count_sensor_points(self, sensor_index: int, frame_indices: Int64) -> Int64:
        """Count the (N,) points of one sensor."""
        points_by_frame = self._points_by_frame[sensor_index]
        new_frames = np.array(sorted(set(frame_indices.tolist()) - points_by_frame.keys()), dtype=np.int64)
        if len(new_frames):
            points = self._measure_points(sensor_index, new_frames)
            points_by_frame.update(zip(new_frames.tolist(), points.tolist(), strict=True))
        return np.array([points_by_frame[frame] for frame in frame_indices.tolist()])

    def _measure_points(self, sensor_index: int, frame_indices: Int64) -> Int64:
        """Simulate the (N,) points of one sensor."""
        max_error_m = 0.4  # as the threshold of detection: a point farther off is not on the road user
        mounted_sensor, beams = self._mounted_sensors[sensor_index], self._rig.beams[sensor_index]
        poses = self._staged.compute_vehicle_T_road_user(FRAME_INTERVAL_S * frame_indices.astype(np.float64))
        geometries = [self._staged.road_user_solid] * len(poses)
        bodies = MovingBodies.from_geometries(geometries, poses, np.full(len(poses), -1))
        max_ranges_m = np.concatenate(mounted_sensor.ego_hit_range_m).clip(max=np.float32(mounted_sensor.max_range_m))
        all_hits = find_target_hits(bodies, mounted_sensor, max_ranges_m)
        first_hits = np.searchsorted(all_hits.position_indices, np.arange(len(poses) + 1)).tolist()
        points = np.zeros(len(poses), dtype=np.int64)
        for position, frame_index in enumerate(frame_indices.tolist()):
            frame_hits = slice(first_hits[position], first_hits[position + 1])
            if frame_hits.start == frame_hits.stop:
                continue
            hits = TargetHits._make(column[frame_hits] for column in all_hits)
            ray_ends = self._compute_ray_ends(sensor_index, frame_index, hits, len(max_ranges_m))
            rng = np.random.default_rng([self._seed, frame_index, sensor_index])
            sensor_frame = SensorFrame(ray_ends, SensorNoise(rng, num_rays=len(max_ranges_m)))
            measured = find_measured_hits(mounted_sensor, beams, hits, sensor_frame, bodies, max_error_m)
            points[position] = mounted_sensor.sensor.pixels_per_sample * len(measured)
        return points

    def _compute_ray_ends(self, sensor_index: int, frame_index: int, hits: TargetHits, num_rays: int) -> RayEnds:
        """Compute the ray ends without the road user: all rays of a sensor with beams, else only those with hits."""
        mounted_sensor = self._mounted_sensors[sensor_index]
        # Moving bodies are not needed: the maximum ranges consider the ego vehicle.
        snapshot = self._scene.get_snapshot(frame_index, max_distance_m=-math.inf)
        if self._rig.beams[sensor_index] is not None:
            return mounted_sensor.compute_ray_ends(snapshot)
        origin_m = mounted_sensor.vehicle_T_sensor[:3, 3]
        points_m = (origin_m + hits.directions * hits.ranges_m[:, None]).astype(np.float32)
        is_visible = compute_visibility(snapshot, origin_m, points_m).is_visible
        range_m = np.full(num_rays, np.inf, dtype=np.float32)
        range_m[hits.ray_indices[~is_visible]] = 0.0
        return RayEnds(range_m, np.zeros(num_rays, dtype=bool))
