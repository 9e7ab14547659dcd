"""When a rig detects whom it meets: looks at whole milliseconds, of which only those are taken that decide."""

import math
import warnings
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from torchcover.encounters.criterion import Criterion
from torchcover.encounters.encounter import Encounter
from torchcover.encounters.staging import STEP_S, StagedEncounter
from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation.camera_sensor import CameraSensor
from torchcover.simulation.lidar import Lidar
from torchcover.simulation.moving import BodyGeometry, BodyGeometryCache, MovingBodies
from torchcover.simulation.radar import Radar
from torchcover.simulation.rig import Rig
from torchcover.simulation.scenario import Scenario
from torchcover.simulation.scene import SceneGeometry
from torchcover.simulation.sensor import Sensor, SensorNoise
from torchcover.simulation.sight import MountedSensor, RayEnds, compute_visibility
from torchcover.simulation.stage import mount_sensors
from torchcover.targets.counting import SensorBeams, TargetHits, find_measured_hits, find_target_hits
from torchcover.targets.target_frames import SensorFrame

if TYPE_CHECKING:
    from torchcover.encounters.traffic import Approach

DetectionTest = Callable[[Int64], Bools]

# A point that is measured farther from where it is than this is none on the other.
WITHIN_M = 0.4
# A radar has few points on anybody: a cell of its range holds a child.
RADAR_POINTS = 1
# Later than any step.
NEVER = np.iinfo(np.int64).max


class EncounterDetection(NamedTuple):
    """What a rig had of an encounter, for P phases of its looks and S sensors; 0 is not before the collision.

    `braking_time_s` is what braking needs, in traffic the most of all the while; `ttc_s` (P,) time to collision at detection,
    `in_time` (P,) 1 if that was in time, 0 if not, NaN if nobody knows; `sensor_ttc_s` (S, P) of each sensor alone,
    `ttc_without_sensor_s` (S, P) of all others. From `censoring_ttc_s` on it was seen as soon as the encounter began, and the other may
    have been there before: a time to collision is that, or more. It is inf if the other came then.
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
    """A rig on its vehicle, for any number of encounters.

    `rig`: the sensors; what takes time to scan is looked at as if it took none; `scenario`: whose ego carries it; see
    `set_ego`.
    """

    def __init__(self, rig: Rig, scenario: Scenario) -> None:
        self.rig, self._scenario = rig, scenario
        self.ego_solid, self.solids = BodyGeometry(scenario.build_ego_mesh()), BodyGeometryCache()
        self._mounted: dict[str, Sequence[MountedSensor]] = {}
        self._told = set[str]()

    def get_mounted_sensors(self, encounter: Encounter, scene: SceneGeometry) -> Sequence[MountedSensor]:
        """The sensors, in the weather of an encounter. ValueError: a sensor inside the ego's body."""
        weather = self.rig.weather or encounter.weather
        key = weather.model_dump_json()
        if key not in self._mounted:
            at_once = [_at_once(sensor) for sensor in self.rig.sensors]
            here = self.rig.model_copy(update={"sensors": at_once, "weather": weather})
            self._mounted[key] = mount_sensors(scene, self._scenario, self.rig.name, here)
        return self._mounted[key]

    def check_rates(self, consecutive_scans: int, staged: StagedEncounter) -> None:
        """Warn, once, of a sensor of which so many looks take longer than an encounter."""
        for sensor in self.rig.sensors:
            takes_s = consecutive_scans / sensor.rate_hz
            if takes_s > staged.contact_time_s and sensor.name not in self._told:
                self._told.add(sensor.name)
                warnings.warn(
                    f"rig {self.rig.name!r}: {consecutive_scans} looks of sensor {sensor.name!r} take {takes_s:.3g} s, and "
                    f"{staged.encounter.description} ends after {staged.contact_time_s:.3g} s: too late, whatever it sees",
                    stacklevel=3,
                )

    @cached_property
    def beams(self) -> Sequence[SensorBeams | None]:
        """Of each sensor, once it is mounted."""
        return [SensorBeams.from_sensor(one) for one in next(iter(self._mounted.values()))]


def _at_once(sensor: Sensor) -> Sensor:
    scan = getattr(sensor, "scan", None)
    return sensor if scan is None else sensor.model_copy(update={"scan": None})  # type: ignore[attr-defined]


def detect_encounter(
    mounted_rig: MountedRig,
    staged: StagedEncounter,
    criterion: Criterion,
    *,
    num_start_offsets: int = 10,
    seed: int = 0,
) -> EncounterDetection:
    """When a rig detects whom it meets.

    The looks of all sensors begin together, at `num_start_offsets` places of their period; the result of each is that of looking
    at every millisecond.

    Args:
        mounted_rig: The rig.
        staged: What happens, with its ego.
        criterion: What is detected.
        num_start_offsets: How many phases there are.
        seed: Of noise and drop-out.

    Raises:
        ValueError: What `MountedRig.mounted` refuses.
    """
    encounter, looks = staged.encounter, EncounterPointCounter(mounted_rig, staged, seed)
    sensors = mounted_rig.rig.sensors
    mounted_rig.check_rates(criterion.consecutive_scans, staged)
    found = find_detection_frames(
        [1 / sensor.rate_hz if isinstance(sensor, Lidar) else None for sensor in sensors],
        [get_min_points(criterion, sensor) for sensor in sensors],
        looks.count_points,
        lambda is_enough, k: find_first_run(
            is_enough,
            compute_scan_frames(sensors[k].rate_hz, num_start_offsets, staged.contact_time_s),
            criterion.consecutive_scans,
        ),
    )
    ttc_s, alone_s, without_s = (
        np.where(steps < NEVER, staged.contact_time_s - STEP_S * steps, 0.0) for steps in found
    )
    longest_s = max((criterion.consecutive_scans / sensor.rate_hz for sensor in sensors), default=0.0)
    # Between two whole steps.
    open_s = max(staged.contact_time_s - longest_s, 0.0) + STEP_S / 2
    open_s = open_s if encounter.lead_time_s == encounter.max_lead_time_s else math.inf
    needed_s = criterion.compute_braking_time_s(abs(encounter.ego.speed_mps), encounter.approach_speed_mps)
    in_time = (ttc_s >= needed_s).astype(np.float64)
    return EncounterDetection(encounter, mounted_rig.rig.name, needed_s, ttc_s, in_time, alone_s, without_s, open_s)


def find_detection_frames(
    scan_periods: Sequence[float | None],
    min_points: Sequence[int],
    count_points: Callable[[Sequence[int], Int64], Int64],
    find_first: Callable[[DetectionTest, int], Int64],
) -> tuple[Int64, Int64, Int64]:
    """At which step S sensors detect somebody, or `NEVER`: together (P,), each alone (S, P), and without each (S, P).

    Args:
        scan_periods: Of the looks of each sensor, as `channels` has them.
        min_points: How many points are, of each sensor.
        count_points: What some sensors have together at (N,) steps.
        find_first: (P,) the steps at which looks in a row were enough first, by what is enough and whose looks they are.
    """
    everything, known = range(len(scan_periods)), dict[tuple[int, ...], Int64]()

    def first_of(channel: tuple[int, ...]) -> Int64:
        if channel not in known:
            known[channel] = find_first(
                lambda steps: count_points(channel, steps) >= min_points[channel[0]], channel[0]
            )
        return known[channel]

    def of(sensors: Sequence[int]) -> Int64:
        each = [first_of(channel) for channel in group_sensors(scan_periods, sensors)]
        return np.min(each, axis=0) if each else np.full_like(together, NEVER)

    together = of(everything)
    without = [of([other for other in everything if other != k]) for k in everything]
    return together, np.stack([of([k]) for k in everything]), np.stack(without)


def get_min_points(criterion: Criterion, sensor: Sensor) -> int:
    """How many points of a sensor, and those that count with it."""
    if isinstance(sensor, CameraSensor):
        return criterion.pixels
    return RADAR_POINTS if isinstance(sensor, Radar) else criterion.points


def group_sensors(scan_periods: Sequence[float | None], sensor_indices: Sequence[int]) -> list[tuple[int, ...]]:
    """Those of some sensors that count together at the looks of the first of them.

    LiDARs count at the looks of each of them, of all that look as often at least: a faster one adds looks of its own
    and loses none that it had with others. A sensor whose period is None counts alone.
    """
    lidars = {k: period for k in sensor_indices if (period := scan_periods[k]) is not None}
    alone, slowest_first = [(k,) for k in sensor_indices if k not in lidars], sorted(lidars, key=lambda k: -lidars[k])
    longest = dict.fromkeys(lidars.values())
    return [*alone, *(tuple(k for k in slowest_first if lidars[k] <= period) for period in longest)]


def compute_scan_frames(rate_hz: float, num_start_offsets: int, contact_s: float) -> Int64:
    """(P, J) whole milliseconds of the looks before the contact, for each phase; those after it are `NEVER`."""
    count = math.ceil(contact_s * rate_hz)
    times = (np.arange(count) + np.arange(num_start_offsets)[:, None] / num_start_offsets) / rate_hz / STEP_S
    steps = np.round(times).astype(np.int64)
    return np.where(steps * STEP_S < contact_s, steps, NEVER)


def find_first_run(is_detected: DetectionTest, frame_indices: Int64, consecutive_scans: int) -> Int64:
    """When so many looks in a row were enough for the first time: (P,) the step of the last of them, or `NEVER`.

    A look that is not enough rules out all runs that it is in, so the last look of a run is asked first: before
    anything is seen, one look in `consecutive_scans`.

    `is_detected`: tells it of (N,) steps; `frame_indices`: (P, J) of the looks of each phase, `NEVER` at the end; `consecutive_scans`: how
    many.
    """
    phases, most = frame_indices.shape
    known = np.zeros(frame_indices.shape, dtype=np.int8)  # 1 enough, -1 not
    first = np.zeros(phases, dtype=np.int64)
    found = np.full(phases, NEVER)
    running = np.ones(phases, dtype=bool)
    while True:
        running &= first + consecutive_scans <= most
        running[running] &= frame_indices[running, first[running] + consecutive_scans - 1] < NEVER
        asked = np.full(phases, -1)
        for phase in np.flatnonzero(running).tolist():
            run = known[phase, first[phase] : first[phase] + consecutive_scans]
            unknown = np.flatnonzero(run == 0)
            if len(unknown) == 0:
                found[phase], running[phase] = frame_indices[phase, first[phase] + consecutive_scans - 1], False
            else:
                asked[phase] = first[phase] + unknown[-1]
        some = np.flatnonzero(running)
        if len(some) == 0:
            return found
        enough = is_detected(frame_indices[some, asked[some]])
        known[some, asked[some]] = np.where(enough, 1, -1)
        first[some[~enough]] = asked[some[~enough]] + 1


class EncounterPointCounter:
    """How many points each sensor has on the other, at any millisecond; each is found once.

    `staged`: who is where; `seed`: of noise and drop-out.
    """

    def __init__(self, mounted_rig: MountedRig, staged: StagedEncounter, seed: int) -> None:
        self._staged, self._seed, self._rig = staged, seed, mounted_rig
        self._scene = staged.build_scene(mounted_rig.solids)
        self._mounted = mounted_rig.get_mounted_sensors(staged.encounter, self._scene)
        self._points: list[dict[int, int]] = [{} for _ in self._mounted]

    def count_points(self, sensor_indices: Sequence[int], frame_indices: Int64) -> Int64:
        """(N,) points, or pixels, of some sensors together at (N,) steps."""
        return np.asarray(np.sum([self._of_sensor(k, frame_indices) for k in sensor_indices], axis=0, dtype=np.int64))

    def _of_sensor(self, number: int, steps: Int64) -> Int64:
        known = self._points[number]
        new = np.array(sorted({step for step in steps.tolist() if step not in known}), dtype=np.int64)
        if len(new):
            known.update(zip(new.tolist(), self._look(number, new).tolist(), strict=True))
        return np.array([known[step] for step in steps.tolist()])

    def _look(self, number: int, steps: Int64) -> Int64:
        mounted, other = self._mounted[number], self._staged.road_user_solid
        poses = self._staged.compute_vehicle_T_road_user(STEP_S * steps.astype(np.float64))
        placed = MovingBodies.from_geometries([other] * len(steps), poses, np.full(len(steps), -1))
        reach_m = np.concatenate(mounted.ego_hit_range_m).clip(max=np.float32(mounted.max_range_m))
        met = find_target_hits(placed, mounted, reach_m)
        first = np.searchsorted(met.position_indices, np.arange(len(steps) + 1)).tolist()
        points = np.zeros(len(steps), dtype=np.int64)
        for k, step in enumerate(steps.tolist()):
            there = TargetHits._make(column[first[k] : first[k + 1]] for column in met)
            if len(there.ray_indices):
                ends = self._ends(number, step, there, len(reach_m))
                draws = SensorNoise(np.random.default_rng([self._seed, step, number]), num_rays=len(reach_m))
                seen, beams = SensorFrame(ends, draws), self._rig.beams[number]
                measured = find_measured_hits(mounted, beams, there, seen, placed, WITHIN_M)
                points[k] = mounted.sensor.pixels_per_sample * len(measured)
        return points

    def _ends(self, number: int, step: int, met: TargetHits, rays: int) -> RayEnds:
        """Where the rays end that meet the other; of those that are measured together with others, all."""
        mounted = self._mounted[number]
        # The ego's body ends its rays already.
        instant = self._scene.get_snapshot(step, max_distance_m=-math.inf)
        if self._rig.beams[number] is not None:
            return mounted.compute_ray_ends(instant)
        origin_m = mounted.vehicle_T_sensor[:3, 3]
        at_m = (origin_m + met.directions * met.ranges_m[:, None]).astype(np.float32)
        range_m = np.full(rays, np.inf, dtype=np.float32)
        range_m[met.ray_indices[~compute_visibility(instant, origin_m, at_m).is_visible]] = 0.0
        return RayEnds(range_m, np.zeros(rays, dtype=bool))
