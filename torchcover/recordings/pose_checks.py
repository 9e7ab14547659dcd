"""Checks of the poses of a recording: frozen poses, wrong conventions, time offsets and discontinuities.

Two scans match if the right poses move one of them into the frame of the other; if other conventions match better, the
check reports them. One scan becomes a map of Gaussians, one per voxel, as in the normal distributions transform (Biber
and Strasser, IROS 2003); the points of the other one match where surfaces are. The ground is excluded, because any
horizontal motion matches it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import invert, transform_points
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.corrections import correct_poses
from torchcover.recordings.recording import Recording
from torchcover.recordings.settings import RecordingSettings
from torchcover.recordings.sweep_window import compute_voxel_indices, find_pose_discontinuities
from torchcover.recordings.vehicle_cloud import transform_to_vehicle


@dataclass(frozen=True)
class MatchingParams:
    """Parameters of a map of Gaussians.

    Args:
        max_range_m: Points farther from the origin are ignored.
        voxel_m: Side of a voxel.
        min_points: Points that a voxel needs for a Gaussian.
        min_thickness_m: Standard deviation below which a surface counts as this thick; above range noise.
        max_normal_z: A thin surface whose normal has a larger z is ground.
        thin_ratio: A surface is thin if its smallest variance is below this share of the second one.
        max_queries: Points of a scan that are matched, sampled at random.
    """

    max_range_m: float = 40.0
    voxel_m: float = 1.0
    min_points: int = 6
    min_thickness_m: float = 0.1
    max_normal_z: float = 0.8
    thin_ratio: float = 0.25
    max_queries: int = 1500


class SurfaceMap:
    """Gaussians of the surfaces of a scan.

    Args:
        points_m: (N, 3) points of the scan.
        params: Parameters of the map.

    Example:
        >>> y, z = np.random.default_rng(0).uniform(0, 9, (2, 4000))
        >>> wall = SurfaceMap(np.stack([np.full(4000, 5.1), y, z], axis=1))
        >>> [round(wall.match(wall.points_m + [offset_m, 0.2, 0.1]), 1) for offset_m in (0.0, 0.5)]
        [1.0, 0.0]
    """

    def __init__(self, points_m: NDArray[np.floating], params: MatchingParams = MatchingParams()) -> None:
        self._params = params
        near_m: Matrix = points_m[np.linalg.norm(points_m, axis=1) < params.max_range_m].astype(np.float64)
        voxels, voxel_of_point = np.unique(compute_voxel_indices(near_m, params.voxel_m), return_inverse=True)
        counts = np.bincount(voxel_of_point)
        sums = [np.bincount(voxel_of_point, coordinate_m, len(counts)) for coordinate_m in near_m.T]
        mean_m = np.stack(sums, axis=1) / counts[:, None]
        offset_m = near_m - mean_m[voxel_of_point]
        covariance = np.empty((len(counts), 3, 3))
        for row, column in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
            product = np.bincount(voxel_of_point, offset_m[:, row] * offset_m[:, column], len(counts)) / counts
            covariance[:, row, column] = covariance[:, column, row] = product
        is_surface = counts >= params.min_points
        variances, axes = np.linalg.eigh(covariance[is_surface])
        self._voxels, self._mean_m = voxels[is_surface], mean_m[is_surface]
        inverse_variances = 1.0 / np.maximum(variances, params.min_thickness_m**2)
        self._inverse_covariance = (axes * inverse_variances[:, None]) @ axes.swapaxes(1, 2)
        is_upright = np.abs(axes[:, 2, 0]) <= params.max_normal_z
        is_surface[is_surface] = is_upright | (variances[:, 0] >= params.thin_ratio * variances[:, 1])
        above_ground_m = near_m[is_surface[voxel_of_point]]
        self.points_m = np.random.default_rng(0).permutation(above_ground_m)[: params.max_queries]
        self._max_match = 1.0
        self._max_match = self.match(self.points_m) if len(self.points_m) else 1.0

    @property
    def has_enough_points(self) -> bool:
        """Whether enough points above the ground remain for a match."""
        return len(self.points_m) >= self._params.max_queries // 10

    def match(self, points_m: Matrix) -> float:
        """Compute how well points match: the mean of exp(-d^2 / 2), d the Mahalanobis distance to the voxel's Gaussian.

        Args:
            points_m: (N, 3) points in the frame of the map.

        Returns:
            0 without any match, 1 if they match as well as the points of the map.
        """
        voxels = compute_voxel_indices(points_m, self._params.voxel_m)
        position = np.searchsorted(self._voxels, voxels).clip(max=len(self._voxels) - 1)
        inside = np.flatnonzero(self._voxels[position] == voxels)
        offset_m = points_m[inside] - self._mean_m[position[inside]]
        squared = np.einsum("ni,nij,nj->n", offset_m, self._inverse_covariance[position[inside]], offset_m)
        return float(np.exp(-squared / 2).sum() / len(points_m)) / self._max_match


@dataclass(frozen=True)
class PoseCheckParams:
    """Parameters of the checks of poses.

    Args:
        num_segments: Segments of consecutive frames whose poses are checked.
        frames_per_segment: Frames of a segment.
        pair_distance_m: Two scans form a pair if the vehicle moved this far between them,
        pair_rotation_deg: or turned this much,
        pair_interval_s: or if they are this far apart in time;
        max_pair_interval_s: but never farther.
        num_pairs: Pairs that are matched, of each kind.
        min_match_gain: A correction is right if the match rises by this much
        min_match_gain_ratio: and by this factor.
        time_offsets_s: Time offsets that are tried, within what poses can be extrapolated.
        min_time_offset_gain: A time offset is right if the match rises by this much,
        min_time_offset_match: reaches this value,
        max_time_offset_ripple: and on the way from the best offset never rises again by more; noise of poses does.
        min_repeated_share: Poses are frozen if this share repeats the previous one
        max_repeats: for at most this many frames in a row.
        max_discontinuity_share: Where more poses jump, the poses are wrong in another way.
        min_motion_m: The vehicle is stationary if it moves less between two scans.
    """

    num_segments: int = 8
    frames_per_segment: int = 25
    pair_distance_m: float = 1.5
    pair_rotation_deg: float = 3.0
    pair_interval_s: float = 0.3
    max_pair_interval_s: float = 1.5
    num_pairs: int = 3
    min_match_gain: float = 0.15
    min_match_gain_ratio: float = 1.4
    time_offsets_s: tuple[float, ...] = tuple(step * 0.025 for step in range(-12, 13))
    min_time_offset_gain: float = 0.06
    min_time_offset_match: float = 0.6
    max_time_offset_ripple: float = 0.03
    min_repeated_share: float = 0.2
    max_repeats: int = 3
    max_discontinuity_share: float = 0.1
    min_motion_m: float = 0.1


PARAMS = PoseCheckParams()


class PoseSegment:
    """Consecutive frames of a recording.

    Args:
        times_s: (N,) times.
        world_T_vehicle: (N, 4, 4) poses.
        first_frame: Index of the first frame.
    """

    def __init__(self, times_s: NDArray[np.float64], world_T_vehicle: Matrix, first_frame: int) -> None:
        self.times_s, self.world_T_vehicle, self.first_frame = times_s, world_T_vehicle, first_frame
        jumps = find_pose_discontinuities(times_s, world_T_vehicle)
        # Many jumps are no discontinuities: the poses are wrong in another way, which other checks find.
        max_jumps = max(2, PARAMS.max_discontinuity_share * len(times_s))
        self.discontinuities = jumps[:0] if len(jumps) > max_jumps else jumps


class ScanPair:
    """Two scans of one sensor between which the vehicle moves.

    Args:
        segment: Poses of the vehicle.
        first: Position of the first scan in the segment.
        second: Position of the second scan in the segment.
    """

    def __init__(self, segment: PoseSegment, first: int, second: int) -> None:
        self.segment, self.first, self.second = segment, first, second
        self.interval_s = float(segment.times_s[second] - segment.times_s[first])
        motion = self.compute_motion()
        self.distance_m = float(np.linalg.norm(motion[:3, 3]))
        self.rotation_deg = float(np.rad2deg(np.arccos(np.clip((np.trace(motion[:3, :3]) - 1) / 2, -1, 1))))

    def compute_motion(self, settings: RecordingSettings | None = None) -> Matrix:
        """Compute the (4, 4) transform from the vehicle frame of the second scan to that of the first.

        Args:
            settings: Corrections of the poses; none if not given.
        """
        poses = self.segment.world_T_vehicle
        if settings is not None:
            poses = correct_poses(poses, self.segment.times_s, settings)
        return np.asarray(invert(poses[self.first]) @ poses[self.second])

    @property
    def time_offset_effect_m(self) -> float:
        """Distance by which a time offset of 0.1 s moves points at 20 m, half of the range of a map."""
        early = self.compute_motion(RecordingSettings(time_offset_s=-0.1))
        late = self.compute_motion(RecordingSettings(time_offset_s=0.1))
        change = late - early
        return float(np.linalg.norm(change[:3, 3]) + 20.0 * np.linalg.norm(change[:3, :3]))

    def read_scans(self, recording: Recording, sensor: str) -> bool:
        """Read both scans.

        Args:
            recording: The recording.
            sensor: Name of the sensor.

        Returns:
            Whether they could be read and have enough surfaces above the ground.
        """
        try:
            frames = [self.segment.first_frame + position for position in (self.first, self.second)]
            self.scans = [recording.read_scan(sensor, frame) for frame in frames]
            self._maps = [SurfaceMap(transform_to_vehicle(scan, recording.ego_box).points_m) for scan in self.scans]
        except (OSError, ValueError):
            return False
        return all(surfaces.has_enough_points for surfaces in self._maps)

    def match(self, settings: RecordingSettings | None = None) -> float:
        """Compute how well the scans match, 0 to 1.

        Args:
            settings: Corrections of poses and axes; none if not given.
        """
        motion = self.compute_motion(settings)
        if settings is not None and settings.axis_order == "yxz":  # mirrors both clouds, each in its sensor's frame
            swap = np.eye(4)[[1, 0, 2, 3]]
            vehicle_T_sensor = self.scans[0].vehicle_T_sensor
            mirror = swap if vehicle_T_sensor is None else vehicle_T_sensor @ swap @ invert(vehicle_T_sensor)
            motion = mirror @ motion @ mirror
        return self._maps[0].match(transform_points(motion, self._maps[1].points_m))


def check_frozen_poses(segments: Sequence[PoseSegment]) -> str | None:
    """Check whether poses repeat the previous one while the vehicle moves.

    Args:
        segments: Segments of the recording.

    Returns:
        A message with the remedy; None if the poses are right.
    """
    repeated_count = step_count = 0
    for segment in segments:
        is_same = (np.diff(segment.world_T_vehicle, axis=0) == 0).all(axis=(1, 2))
        changes = np.concatenate([[-1], np.flatnonzero(~is_same), [len(is_same)]])
        run_lengths = np.diff(changes) - 1
        if run_lengths[1:-1].any():
            repeated_count += int(run_lengths[run_lengths <= PARAMS.max_repeats].sum())
            step_count += len(is_same)
    if repeated_count < max(2, PARAMS.min_repeated_share * step_count):
        return None
    return (
        f"{repeated_count} of {step_count} poses repeat the previous one while the vehicle moves: give a pose for each "
        "frame, or let them be interpolated (--set recording.interpolate_poses=true)"
    )


def check_pose_conventions(
    recording: Recording,
    segments: Sequence[PoseSegment],
    sensor: str,
) -> str | None:
    """Check whether scans match better with other conventions of rotations, poses or axes, or with a time offset.

    Args:
        recording: The recording.
        segments: Segments of the recording.
        sensor: Sensor whose scans are matched.

    Returns:
        A message with the remedy; None if nothing matches better.
    """
    pairs = [pair for pair in select_pairs(segments) if pair.read_scans(recording, sensor)]
    is_repeated = []
    for pair in pairs:
        if pair.distance_m > PARAMS.min_motion_m:
            first, second = pair.scans
            is_repeated.append(np.array_equal(first.points_m, second.points_m, equal_nan=True))
    if is_repeated and all(is_repeated):
        return f"{sensor} repeats the same scan while the vehicle moves by its poses: exclude it (--sensors)"
    if not pairs:
        return None
    conventions = (
        RecordingSettings(quaternion_order="xyzw"),
        RecordingSettings(pose_convention="vehicle_T_world"),
        RecordingSettings(pose_convention="swapped_xy"),
        RecordingSettings(axis_order="yxz"),
    )
    uncorrected_match = _compute_mean_match(pairs)
    matches = [_compute_mean_match(pairs, settings) for settings in conventions]
    best = int(np.argmax(matches))
    match, remedy = matches[best], conventions[best].command_line_options
    if match < max(uncorrected_match + PARAMS.min_match_gain, PARAMS.min_match_gain_ratio * uncorrected_match):
        time_offset_s, match = find_time_offset(pairs)
        remedy = f"--set recording.time_offset_s={time_offset_s:.2f}"
        if match < max(uncorrected_match + PARAMS.min_time_offset_gain, PARAMS.min_time_offset_match):
            return None
    return (
        f"two scans of {sensor} match to {uncorrected_match:.0%} with the given poses, and to {match:.0%} with "
        f"{remedy}: use that, or correct the recording"
    )


def find_time_offset(pairs: Sequence[ScanPair]) -> tuple[float, float]:
    """Find the time offset with which pairs match best.

    Args:
        pairs: Pairs whose scans were read.

    Returns:
        The offset in seconds and the mean match, 0 to 1; zeros if many offsets match better, as with noisy poses.
    """
    offsets_s = PARAMS.time_offsets_s
    matches = np.array([_compute_mean_match(pairs, RecordingSettings(time_offset_s=value)) for value in offsets_s])
    best = int(matches.argmax())
    before, after = matches[best::-1], matches[best:]
    ripple = max((before - np.minimum.accumulate(before)).max(), (after - np.minimum.accumulate(after)).max())
    return (0.0, 0.0) if ripple > PARAMS.max_time_offset_ripple else (offsets_s[best], float(matches[best]))


def check_pose_discontinuities(recording: Recording, segments: Sequence[PoseSegment]) -> str | None:
    """Check whether a few poses jump.

    Args:
        recording: The recording.
        segments: Segments of the recording.

    Returns:
        A message with the remedy; None if no pose jumps.
    """
    names = []
    for segment in segments:
        frames = segment.first_frame + segment.discontinuities + 1
        names += [recording.frame_names[frame] for frame in frames.tolist()]
    if not names:
        return None
    checked_count = sum(len(segment.times_s) for segment in segments)
    return (
        f"poses jump {len(names)} times in {checked_count} frames that were checked, first at {names[0]}: no window "
        "extends over a jump, so that frames around it have fewer scans; give poses without jumps"
    )


def select_pairs(segments: Sequence[PoseSegment]) -> list[ScanPair]:
    """Select pairs of scans that are spread over the recording, and those that a time offset would change most.

    Args:
        segments: Segments of the recording.
    """
    pairs = []
    for segment in segments:
        last = len(segment.times_s) - 1
        for first in range(last):
            end = min(segment.discontinuities[segment.discontinuities >= first] + 1, default=last + 1)
            for second in range(first + 1, end):
                pair = ScanPair(segment, first, second)
                is_far = (
                    pair.distance_m > PARAMS.pair_distance_m
                    or pair.rotation_deg > PARAMS.pair_rotation_deg
                    or pair.interval_s > PARAMS.pair_interval_s - 1e-6
                )
                if pair.interval_s <= PARAMS.max_pair_interval_s and (is_far or second == last):
                    pairs.append(pair)
                if is_far:
                    break
    if not pairs:
        return []
    spread = [pairs[position] for position in np.linspace(0, len(pairs) - 1, PARAMS.num_pairs).astype(int)]
    sensitive = sorted(pairs, key=attrgetter("time_offset_effect_m"), reverse=True)[: PARAMS.num_pairs]
    return list(dict.fromkeys((*spread, *sensitive)))


def read_pose_segments(recording: Recording, num_frames: int) -> Iterator[PoseSegment]:
    """Read the poses of segments that are spread over the recording.

    Args:
        recording: The recording.
        num_frames: Number of frames that will be measured, from the first on.

    Yields:
        Segments whose poses are all known.
    """
    times_s = recording.times_s
    if times_s is None or not num_frames:
        return
    start = recording.key_frames[0]
    # The window of the last frame extends beyond it.
    stop = min(recording.key_frames[num_frames - 1] + PARAMS.frames_per_segment, len(recording.frame_names))
    first_frames, length = [start], stop - start
    if length > PARAMS.num_segments * PARAMS.frames_per_segment:
        length = PARAMS.frames_per_segment
        first_frames = np.linspace(start, stop - length, PARAMS.num_segments).astype(int).tolist()
    for first_frame in first_frames if length > 1 else ():
        poses = [recording.get_world_T_vehicle(frame) for frame in range(first_frame, first_frame + length)]
        if all(pose is not None for pose in poses):
            yield PoseSegment(times_s[first_frame : first_frame + length], np.array(poses), first_frame)


def _compute_mean_match(pairs: Sequence[ScanPair], settings: RecordingSettings | None = None) -> float:
    return float(np.mean([pair.match(settings) for pair in pairs]))
