"""Encounters that happen in traffic: who comes within a time to collision, and when sensors first had enough of him."""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from torchcover.coverage.quantities import MEASURED_WITHIN_M
from torchcover.detection.inside import SKIN_M
from torchcover.encounters.criterion import Criterion
from torchcover.encounters.sighting import (
    NEVER,
    DetectionTest,
    EncounterDetection,
    find_detection_frames,
    find_first_run,
    get_min_points,
)
from torchcover.geometry import BoundingBox, compute_contact_time_s, invert, transform_outline
from torchcover.geometry.arrays import Float64, Int64
from torchcover.recordings.objects import Track, extract_objects, find_vehicle_class
from torchcover.recordings.recording import Recording
from torchcover.recordings.vehicle_cloud import transform_to_vehicle
from torchcover.simulation.lidar import Lidar
from torchcover.simulation.rays import SearchSpheres
from torchcover.simulation.simulator import Simulator
from torchcover.simulation.traffic.fleet import REAR_OF
from torchcover.simulation.world import Scene

Clouds = Sequence[NDArray[np.floating]]

# What tables call road users, in their order; by SUMO's names of classes.
WHO = {
    "on foot": ("pedestrian", "child"),
    "on bicycles": ("bicycle",),
    "on motorcycles": ("motorcycle",),
    "cars and vans": ("passenger", "delivery", "emergency"),
    "lorries and buses": ("truck", "bus"),
    "others": (None,),
    "from behind": (),
}
# A vehicle of which all labels lie so near to each other was parked.
PARKED_M = 2.0
# Poses of an ego that stands may still move so fast.
STANDS_MPS = 0.1
# Scans that are kept: of those who are met at the same time.
SCANS = 8


def get_road_user_group(track: Track) -> str:
    """What tables call a road user; a rider who has a box of his own by what he rides, as in Argoverse 2."""
    word = track.category.lower().split(".")[-1]
    kind = {"bicyclist": "bicycle", "motorcyclist": "motorcycle", "trailer": "truck"}.get(word, track.vehicle_class)
    return next((name for name, kinds in WHO.items() if kind in kinds), "others")


class Drive(NamedTuple):
    """Who is where at (T,) times, in a world or a recording: (T, 4, 4) vehicle frames, its box, other road users."""

    name: str
    times_s: Float64
    world_T_ego: Float64
    ego_box: BoundingBox
    tracks: Sequence[Track]

    @classmethod
    def from_scene(cls, name: str, scene: Scene) -> Self:
        """That of a world: all of its actors, who are no parked vehicles."""
        times_s = scene.time_step_s * np.arange(scene.num_time_steps, dtype=np.float64)
        tracks = []
        for actor in scene.actors:
            size_m = BoundingBox.from_points(actor.mesh.vertices_m).size_m
            tracks.append(
                Track(actor.name, actor.category, find_vehicle_class(actor.category), size_m, actor.trajectory)
            )
        ego = BoundingBox.from_points(scene.ego.mesh.vertices_m)
        return cls(name, times_s, scene.ego.trajectory.interpolate_many(times_s), ego, tracks)

    @classmethod
    def from_recording(cls, recording: Recording) -> Self:
        """That of a recording with poses, times and labelled objects.

        ValueError: one of these is missing, the size of the vehicle, or road users among the objects.
        """
        recorded = extract_objects(recording)
        if recording.ego_box is None:
            raise ValueError(f"{recording.path}: it does not say how large its vehicle is, so nobody can touch it")
        users = [track for track in recorded.tracks if track.vehicle_class is not None]
        if not users:
            count = len(recorded.tracks)
            raise ValueError(f"{recording.path}: none of its {count} objects is a road user, by their categories")
        ways_m = [np.linalg.norm(np.ptp(track.trajectory.positions_m[:, :2], axis=0)) for track in users]
        users = [
            track
            for track, way_m in zip(users, ways_m, strict=True)
            if way_m >= PARKED_M or get_road_user_group(track) in ("on foot", "on bicycles")
        ]
        return cls(
            recording.path.name, recorded.egos[0].times_s, recorded.egos[0].world_T_ego, recording.ego_box, users
        )


class Approach(NamedTuple):
    """A road user who comes within a time to collision, from the first such step to the last.

    `ttc_s` and `braking_times_s` (K,) are those of each of these steps, which begin with `frame_index`: both outlines go straight on
    as they do, and nobody brakes; and what the brakes need then, 0 where they would not help. The rest as an
    `Encounter` has it.
    """

    track: Track
    frame_index: int
    ttc_s: Float64
    braking_times_s: Float64
    name: str
    speed_kmh: float
    is_speed_swept: bool = False


def find_approaches(drive: Drive, criterion: Criterion) -> list[Approach]:
    """All that happen in a drive; of one in two parts, such as a lorry, that of the part which comes near first.

    Not those that began before there were looks enough to detect anybody: nobody knows how late they were.
    """
    found: dict[str, Approach] = {}
    ego_mps = _velocities_mps(drive.times_s, drive.world_T_ego[:, :2, 3])
    speed_mps = np.linalg.norm(ego_mps, axis=1)
    ahead = ego_mps / np.where(speed_mps > 0, speed_mps, 1.0)[:, None]
    for track in drive.tracks:
        places_m = track.trajectory.interpolate_positions_m(drive.times_s)
        own_mps = _velocities_mps(drive.times_s, places_m[:, :2])
        closing_mps = own_mps - ego_mps
        reach_m = np.linalg.norm(drive.ego_box.outline_m, axis=1).max() + np.linalg.norm(track.size_m[:2]) / 2
        away_m = np.linalg.norm(places_m[:, :2] - drive.world_T_ego[:, :2, 3], axis=1) - reach_m
        near = np.flatnonzero(away_m <= criterion.max_ttc_s * np.linalg.norm(closing_mps, axis=1))
        world_T_ego = drive.world_T_ego[near]
        there = invert(world_T_ego) @ track.trajectory.interpolate_many(drive.times_s[near])
        outline_m = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * track.size_m[:2] / 2
        in_ego_mps = np.einsum("tji,tj->ti", world_T_ego[:, :2, :2], closing_mps[near])
        ttc_s = np.full(len(drive.times_s), np.inf)
        ttc_s[near] = compute_contact_time_s(drive.ego_box.outline_m, transform_outline(outline_m, there), in_ego_mps)
        met = np.flatnonzero(ttc_s <= criterion.max_ttc_s)
        if len(met) and met[0] >= criterion.consecutive_scans - 1:
            some, first = slice(met[0], met[-1] + 1), int(met[0])
            towards_mps = -(own_mps[some] * ahead[some]).sum(axis=1)
            behind = there[np.searchsorted(near, first), 0, 3] < drive.ego_box.lower_m[0]
            helps = ~behind & (speed_mps[some] > STANDS_MPS) & (speed_mps[some] + towards_mps > 0)
            needed_s = np.where(helps, list(map(criterion.compute_braking_time_s, speed_mps[some], towards_mps)), 0.0)
            name = "from behind" if behind else get_road_user_group(track)
            kmh, owner = 3.6 * float(speed_mps[first]), track.name.removeprefix(REAR_OF)
            if owner not in found or first < found[owner].frame_index:
                found[owner] = Approach(track, first, ttc_s[some], needed_s, name, kmh)
    return list(found.values())


def _velocities_mps(times_s: Float64, places_m: Float64) -> Float64:
    """(T, 2) velocities, the mean of before and after; NaN where nobody is."""
    pace_mps, unknown = np.diff(places_m, axis=0) / np.diff(times_s)[:, None], np.full((1, 2), np.nan)
    before, after = np.concatenate([unknown, pace_mps]), np.concatenate([pace_mps, unknown])
    before, after = np.where(np.isnan(before), after, before), np.where(np.isnan(after), before, after)
    return np.asarray((before + after) / 2)


class DriveSensors(NamedTuple):
    """The S sensors of a rig in one drive: the `scan_periods` of their looks in steps, as `channels` has them.

    So many points of each are `min_points`, and what each of their points counts for. `read_clouds` has of a step the (N, 3)
    points of each in the vehicle frame that lie in some balls, and maybe others.
    """

    scan_periods: Sequence[float | None]
    min_points: Sequence[int]
    pixels_per_sample: Sequence[int]
    frame_strides: Sequence[int]
    read_clouds: Callable[[int, SearchSpheres], Clouds]

    @classmethod
    def from_simulator(cls, simulator: Simulator, first_frame: int, criterion: Criterion) -> Self:
        """Those of a simulator's only rig, whose frames of a world begin with one; its points are those of frames."""
        (rig,) = simulator.rigs.values()

        def clouds(step: int, balls: SearchSpheres) -> Clouds:
            (scans,) = simulator.simulate_scans(first_frame + step, balls).values()
            return [
                scan.points
                if scan.range_error_m is None
                else scan.points[np.abs(scan.range_error_m) <= MEASURED_WITHIN_M]
                for scan in scans
            ]

        sensors = rig.sensors
        every = [max(1, round(1 / (one.rate_hz * simulator.frame_interval_s))) for one in sensors]
        enough, counts_as = (
            [get_min_points(criterion, one) for one in sensors],
            [one.pixels_per_sample for one in sensors],
        )
        periods = [steps if isinstance(one, Lidar) else None for one, steps in zip(sensors, every, strict=True)]
        return cls(periods, enough, counts_as, every, clouds)

    @classmethod
    def from_recording(cls, recording: Recording, sensors: Sequence[str], criterion: Criterion) -> Self:
        """Those of a recording, which are LiDARs that count together."""

        @lru_cache(maxsize=SCANS)
        def read(step: int) -> Clouds:
            return [
                transform_to_vehicle(recording.read_scan(sensor, step), recording.ego_box).points_m
                for sensor in sensors
            ]

        each = [1] * len(sensors)
        return cls(each, [criterion.points] * len(sensors), each, each, lambda step, _: read(step))


class ApproachPointCounter:
    """How many points each sensor has on one road user, at any step; each is found once."""

    def __init__(self, drive: Drive, track: Track, drive_sensors: DriveSensors) -> None:
        self._drive, self._track, self._eyes = drive, track, drive_sensors
        self._known: dict[int, Int64] = {}

    def count_points(self, sensor_indices: Sequence[int], frame_indices: Int64) -> Int64:
        """(N,) points of some sensors together at (N,) steps."""
        new = [step for step in frame_indices.tolist() if step not in self._known]
        self._known.update({step: self._look(step) for step in new})
        return np.array([self._known[step][list(sensor_indices)].sum() for step in frame_indices.tolist()])

    def _look(self, step: int) -> Int64:
        """(S,) the points in his box, which stands as he does; sides and top as `find_points_in_boxes` has them."""
        time_s, way, size_m = self._drive.times_s[step], self._track.trajectory, np.array(self._track.size_m)
        if np.isnan(way.interpolate_positions_m(np.array([time_s]))).any():
            return np.zeros(len(self._eyes.scan_periods), dtype=np.int64)
        pose = invert(self._drive.world_T_ego[step]) @ way.interpolate(time_s)
        middle_m = pose[:3, 3] + size_m[2] / 2 * pose[:3, 2]
        clouds = self._eyes.read_clouds(step, SearchSpheres(middle_m[None], float(np.linalg.norm(size_m / 2 + SKIN_M))))
        counts = []
        for cloud_m, counts_as in zip(clouds, self._eyes.pixels_per_sample, strict=True):
            off_m = (cloud_m - pose[:3, 3]) @ pose[:3, :3]
            inside = (np.abs(off_m[:, :2]) <= size_m[:2] / 2 + SKIN_M).all(axis=1)
            inside &= (off_m[:, 2] > SKIN_M) & (off_m[:, 2] <= size_m[2] + SKIN_M)
            counts.append(counts_as * np.count_nonzero(inside))
        return np.array(counts, dtype=np.int64)


def detect_approach(
    rig_name: str, drive: Drive, approach: Approach, drive_sensors: DriveSensors, criterion: Criterion
) -> EncounterDetection:
    """When a rig had enough of somebody, of looks from as long before as is asked about, or the last few of a slow one.

    The time to collision is the least until he is detected, and that asked about if he is by then. Whether he is, is
    asked first, and more only of those sensors that this leaves open. Nobody knows who is in time if braking never was
    needed, or needed more than was asked about.
    """
    begin, end = approach.frame_index, approach.frame_index + len(approach.ttc_s)
    first = int(np.searchsorted(drive.times_s, drive.times_s[begin] - criterion.max_ttc_s))
    watch = ApproachPointCounter(drive, approach.track, drive_sensors)

    def first_run_of(is_enough: DetectionTest, k: int) -> Int64:
        steps = np.arange(0, end, drive_sensors.frame_strides[k])
        latest = steps[steps <= begin][-criterion.consecutive_scans :]
        if find_first_run(is_enough, latest[None], criterion.consecutive_scans)[0] < NEVER:
            return np.array([begin])
        since = steps[steps >= min(first, latest[0])]
        return np.maximum(find_first_run(is_enough, since[None], criterion.consecutive_scans), begin)

    found = find_detection_frames(
        drive_sensors.scan_periods, drive_sensors.min_points, watch.count_points, first_run_of
    )
    # By the steps of the approach; last for who was never detected.
    least_s = np.append(np.minimum.accumulate(approach.ttc_s), 0.0)
    least_s[0] = criterion.max_ttc_s
    ttc_s, alone_s, without_s = (least_s[np.minimum(steps, end) - begin] for steps in found)
    seen = found[0] - begin
    until = int(min(seen[0], end)) + 1 if seen[0] else 0
    late = approach.ttc_s < approach.braking_times_s
    unknown = not late.any() or (until == 0 and approach.braking_times_s[0] > criterion.max_ttc_s)
    in_time = np.array([np.nan if unknown else float(not late[:until].any())])
    needed_s = float(approach.braking_times_s.max())
    return EncounterDetection(
        approach, rig_name, needed_s, ttc_s, in_time, alone_s, without_s, criterion.max_ttc_s, drive.name
    )
