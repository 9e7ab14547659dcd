"""Encounters in traffic: road users that come within a time to collision."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np

from torchcover.encounters.criterion import Criterion
from torchcover.geometry import BoundingBox, compute_contact_time_s, invert, transform_outline
from torchcover.geometry.arrays import Bools, Float64
from torchcover.recordings.objects import Track, extract_objects, find_vehicle_class
from torchcover.recordings.recording import Recording
from torchcover.simulation.scene import Scene
from torchcover.simulation.traffic.fleet import REAR_OF

# Groups of road users in the order of tables, and the SUMO vehicle classes of each.
ROAD_USER_GROUPS = {
    "on foot": ("pedestrian", "child"),
    "on bicycles": ("bicycle",),
    "on motorcycles": ("motorcycle",),
    "cars and vans": ("passenger", "delivery", "emergency"),
    "trucks and buses": ("truck", "bus"),
    "others": (None,),
    "from behind": (),
}


def get_road_user_group(track: Track) -> str:
    """Get the group of a road user; riders with a box of their own, as in Argoverse 2, are grouped by their vehicle.

    Args:
        track: Track of the road user.

    Returns:
        A key of `ROAD_USER_GROUPS`.
    """
    category = track.category.lower().split(".")[-1]
    ridden_classes = {"bicyclist": "bicycle", "motorcyclist": "motorcycle", "trailer": "truck"}
    vehicle_class = ridden_classes.get(category, track.vehicle_class)
    for group, vehicle_classes in ROAD_USER_GROUPS.items():
        if vehicle_class in vehicle_classes:
            return group
    return "others"


class Drive(NamedTuple):
    """Trajectories of the ego vehicle and of other road users in a scene or a recording.

    Args:
        name: Name of the scene or recording.
        times_s: (T,) times of the frames.
        world_T_ego: (T, 4, 4) poses of the ego vehicle.
        ego_box: Bounding box of the ego vehicle in the vehicle frame.
        tracks: Other road users.
    """

    name: str
    times_s: Float64
    world_T_ego: Float64
    ego_box: BoundingBox
    tracks: Sequence[Track]

    @classmethod
    def from_scene(cls, name: str, scene: Scene) -> Self:
        """Create the drive of a simulated scene; its road users are all actors, which do not include parked vehicles.

        Args:
            name: Name of the scene.
            scene: The scene.

        Returns:
            The drive.
        """
        times_s = scene.time_step_s * np.arange(scene.num_time_steps, dtype=np.float64)
        tracks = []
        for actor in scene.actors:
            size_m = BoundingBox.from_points(actor.mesh.vertices_m).size_m
            vehicle_class = find_vehicle_class(actor.category)
            tracks.append(Track(actor.name, actor.category, vehicle_class, size_m, actor.trajectory))
        ego_box = BoundingBox.from_points(scene.ego.mesh.vertices_m)
        return cls(name, times_s, scene.ego.trajectory.interpolate_many(times_s), ego_box, tracks)

    @classmethod
    def from_recording(cls, recording: Recording) -> Self:
        """Create the drive of a recording; parked vehicles are excluded.

        Args:
            recording: Recording with poses, times and labeled objects.

        Returns:
            The drive.

        Raises:
            ValueError: One of these is missing, the size of the vehicle is unknown, or no object is a road user.
        """
        parked_extent_m = 2.0  # labels of a parked vehicle scatter less than this
        recorded = extract_objects(recording)
        if recording.ego_box is None:
            raise ValueError(f"{recording.path}: the size of the vehicle is unknown, so no collision can be predicted")
        road_users = [track for track in recorded.tracks if track.vehicle_class is not None]
        if not road_users:
            count = len(recorded.tracks)
            raise ValueError(f"{recording.path}: none of its {count} objects is a road user, by their categories")
        tracks = []
        for track in road_users:
            extent_m = np.linalg.norm(np.ptp(track.trajectory.positions_m[:, :2], axis=0))
            if extent_m >= parked_extent_m or get_road_user_group(track) in ("on foot", "on bicycles"):
                tracks.append(track)
        ego = recorded.egos[0]
        return cls(recording.path.name, ego.times_s, ego.world_T_ego, recording.ego_box, tracks)


class Approach(NamedTuple):
    """Road user within a time to collision, from the first such frame to the last.

    Args:
        track: Track of the road user.
        frame_index: First frame.
        ttc_s: (K,) time to collision in each frame from the first on, at constant velocities of both outlines.
        braking_times_s: (K,) braking time in these frames; 0 where braking does not help.
        name: Group of the road user.
        speed_kmh: Speed of the ego vehicle in the first frame.
        is_speed_swept: As in `Encounter`.
    """

    track: Track
    frame_index: int
    ttc_s: Float64
    braking_times_s: Float64
    name: str
    speed_kmh: float
    is_speed_swept: bool = False


class RelativeMotion(NamedTuple):
    """Motion of a road user relative to the ego vehicle.

    Args:
        ttc_s: (T,) time to collision in each frame; inf without a collision.
        velocity_mps: (T, 2) velocity of the road user in the world frame.
        is_behind: (T,) True where its center is behind the ego vehicle, in frames with a finite `ttc_s`.
    """

    ttc_s: Float64
    velocity_mps: Float64
    is_behind: Bools

    @classmethod
    def from_track(cls, drive: Drive, track: Track, ego_velocity_mps: Float64, max_ttc_s: float) -> Self:
        """Compute the motion of one road user.

        Args:
            drive: The drive.
            track: Track of the road user.
            ego_velocity_mps: (T, 2) velocity of the ego vehicle in the world frame.
            max_ttc_s: Largest time to collision of interest; frames in which the distance rules it out are skipped.

        Returns:
            The relative motion.
        """
        positions_m = track.trajectory.interpolate_positions_m(drive.times_s)
        velocity_mps = compute_velocities_mps(drive.times_s, positions_m[:, :2])
        relative_mps = velocity_mps - ego_velocity_mps
        radius_m = np.linalg.norm(drive.ego_box.outline_m, axis=1).max() + np.linalg.norm(track.size_m[:2]) / 2
        distance_m = np.linalg.norm(positions_m[:, :2] - drive.world_T_ego[:, :2, 3], axis=1) - radius_m
        nearby = np.flatnonzero(distance_m <= max_ttc_s * np.linalg.norm(relative_mps, axis=1))
        world_T_ego = drive.world_T_ego[nearby]
        ego_T_track = invert(world_T_ego) @ track.trajectory.interpolate_many(drive.times_s[nearby])
        outline_m = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * track.size_m[:2] / 2
        velocity_in_ego_mps = np.einsum("tji,tj->ti", world_T_ego[:, :2, :2], relative_mps[nearby])
        ttc_s = np.full(len(drive.times_s), np.inf)
        ttc_s[nearby] = compute_contact_time_s(
            drive.ego_box.outline_m, transform_outline(outline_m, ego_T_track), velocity_in_ego_mps
        )
        is_behind = np.zeros(len(drive.times_s), dtype=bool)
        is_behind[nearby] = ego_T_track[:, 0, 3] < drive.ego_box.lower_m[0]
        return cls(ttc_s, velocity_mps, is_behind)


def find_approaches(drive: Drive, criterion: Criterion) -> list[Approach]:
    """Find all encounters in a drive.

    Of a vehicle in two parts, such as a truck with a trailer, the part counts that comes within the time first.
    Approaches that began before there were enough scans for a detection are excluded, because nobody knows how late
    their detection was.

    Args:
        drive: The drive.
        criterion: Time to collision, number of scans, and brakes.

    Returns:
        The approaches, one for each road user.
    """
    min_ego_speed_mps = 0.1  # poses of a vehicle at rest may still move this fast
    approaches: dict[str, Approach] = {}
    ego_velocity_mps = compute_velocities_mps(drive.times_s, drive.world_T_ego[:, :2, 3])
    ego_speed_mps = np.linalg.norm(ego_velocity_mps, axis=1)
    ego_direction = ego_velocity_mps / np.where(ego_speed_mps > 0, ego_speed_mps, 1.0)[:, None]
    for track in drive.tracks:
        motion = RelativeMotion.from_track(drive, track, ego_velocity_mps, criterion.max_ttc_s)
        # Encounters begin when the time to collision falls below the limit.
        close_frames = np.flatnonzero(motion.ttc_s <= criterion.max_ttc_s)
        if len(close_frames) == 0 or close_frames[0] < criterion.consecutive_scans - 1:
            continue
        first_frame = int(close_frames[0])
        frames = slice(first_frame, close_frames[-1] + 1)
        approach_mps = -(motion.velocity_mps[frames] * ego_direction[frames]).sum(axis=1)
        is_behind = motion.is_behind[first_frame]
        speed_mps = ego_speed_mps[frames]
        can_brake = ~is_behind & (speed_mps > min_ego_speed_mps) & (speed_mps + approach_mps > 0)
        braking_times_s = np.zeros(len(speed_mps))
        for index in np.flatnonzero(can_brake).tolist():
            braking_times_s[index] = criterion.compute_braking_time_s(speed_mps[index], approach_mps[index])
        # Road users from behind are a group of their own, because braking does not help.
        group = "from behind" if is_behind else get_road_user_group(track)
        vehicle_name = track.name.removeprefix(REAR_OF)
        if vehicle_name not in approaches or first_frame < approaches[vehicle_name].frame_index:
            speed_kmh = 3.6 * float(ego_speed_mps[first_frame])
            approaches[vehicle_name] = Approach(
                track, first_frame, motion.ttc_s[frames], braking_times_s, group, speed_kmh
            )
    return list(approaches.values())


def compute_velocities_mps(times_s: Float64, positions_m: Float64) -> Float64:
    """Compute velocities as the mean of the difference quotients before and after each time.

    Args:
        times_s: (T,) times.
        positions_m: (T, 2) positions; NaN where there is none.

    Returns:
        (T, 2) velocities; NaN where there is no neighboring position.
    """
    quotients_mps = np.diff(positions_m, axis=0) / np.diff(times_s)[:, None]
    undefined = np.full((1, 2), np.nan)
    before, after = np.concatenate([undefined, quotients_mps]), np.concatenate([quotients_mps, undefined])
    before, after = np.where(np.isnan(before), after, before), np.where(np.isnan(after), before, after)
    return np.asarray((before + after) / 2)
