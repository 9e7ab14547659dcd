"""Check the poses of a recording: frozen ones, wrong conventions, time offsets and jumps.

Two scans match once the right poses move one of them; if other conventions match better, they are named. To match
them, one becomes a map of Gaussians, one for each voxel, as in the normal distributions transform (Biber and Strasser,
IROS 2003): points of the other match where surfaces are. The ground, which any motion matches, is left out.
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
        max_normal_z: A surface with a normal more upright than this, and thin, is ground.
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

    def __init__(self, points_m: NDArray[np.floating], params: MatchingParams | None = None) -> None:
        self._params = params = params or MatchingParams()
        near_m: Matrix = points_m[np.linalg.norm(points_m, axis=1) < params.max_range_m].astype(np.float64)
        numbers, voxel_of_point = np.unique(compute_voxel_indices(near_m, params.voxel_m), return_inverse=True)
        counts = np.bincount(voxel_of_point)
        sums = [np.bincount(voxel_of_point, coordinate_m, len(counts)) for coordinate_m in near_m.T]
        mean_m = np.stack(sums, axis=1) / counts[:, None]
        offset_m = near_m - mean_m[voxel_of_point]
        covariance = np.empty((len(counts), 3, 3))
        for a, b in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
            product = np.bincount(voxel_of_point, offset_m[:, a] * offset_m[:, b], len(counts)) / counts
            covariance[:, a, b] = covariance[:, b, a] = product
        is_surface = counts >= params.min_points
        variances, axes = np.linalg.eigh(covariance[is_surface])
        self._numbers, self._mean_m = numbers[is_surface], mean_m[is_surface]
        inverse_variances = 1.0 / np.maximum(variances, params.min_thickness_m**2)
        self._inverse = (axes * inverse_variances[:, None]) @ axes.swapaxes(1, 2)
        is_upright = np.abs(axes[:, 2, 0]) <= params.max_normal_z
        is_surface[is_surface] = is_upright | (variances[:, 0] >= params.thin_ratio * variances[:, 1])
        above_ground_m = near_m[is_surface[voxel_of_point]]
        self.points_m = np.random.default_rng(0).permutation(above_ground_m)[: params.max_queries]
        self._own_match = 1.0
        self._own_match = self.match(self.points_m) if len(self.points_m) else 1.0

    @property
    def has_enough_points(self) -> bool:
        """Whether enough points above the ground are left to be matched."""
        return len(self.points_m) >= self._params.max_queries // 10

    def match(self, points_m: Matrix) -> float:
        """Return how well (N, 3) points match: 0 not at all, 1 as well as the points of the map.

        It is the mean of exp(-d^2 / 2), d the Mahalanobis distance to the Gaussian in the voxel of a point.
        """
        numbers = compute_voxel_indices(points_m, self._params.voxel_m)
        position = np.searchsorted(self._numbers, numbers).clip(max=len(self._numbers) - 1)
        inside = np.flatnonzero(self._numbers[position] == numbers)
        offset_m = points_m[inside] - self._mean_m[position[inside]]
        squared = np.einsum("ni,nij,nj->n", offset_m, self._inverse[position[inside]], offset_m)
        return float(np.exp(-squared / 2).sum() / len(points_m)) / self._own_match


@dataclass(frozen=True)
class PoseCheckParams:
    """Parameters of the checks of poses.

    Args:
        num_segments: Stretches of consecutive instants whose poses are looked at.
        frames_per_segment: Instants of a stretch.
        pair_distance_m: Two scans form a pair if the vehicle moved this far between them,
        pair_rotation_deg: or turned this much,
        pair_interval_s: or if they are this far apart in time;
        max_pair_interval_s: never farther.
        num_pairs: Pairs that are matched, of each kind.
        min_match_gain: A correction is right if the match rises by this much
        min_match_gain_ratio: and by this factor.
        min_time_offset_gain: The same for a time offset, whose match has to reach
        min_time_offset_match: at least this value,
        max_time_offset_ripple: and may rise again on the way from the best offset by this much; noise of poses rises more.
        min_repeated_share: Poses are frozen if this share repeats the previous one
        max_repeats: for at most this many instants in a row.
        max_discontinuity_share: Where more poses jump, the poses are wrong in another way.
        min_motion_m: A vehicle that moves less between two scans stands still.
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
    min_time_offset_gain: float = 0.06
    min_time_offset_match: float = 0.6
    max_time_offset_ripple: float = 0.03
    min_repeated_share: float = 0.2
    max_repeats: int = 3
    max_discontinuity_share: float = 0.1
    min_motion_m: float = 0.1


PARAMS = PoseCheckParams()
# Time offsets that are tried, within what poses can be extrapolated.
LAGS_S = tuple(step * 0.025 for step in range(-12, 13))
UNCORRECTED = RecordingSettings()
CONVENTIONS = (
    RecordingSettings(quaternion_order="xyzw"),
    RecordingSettings(pose_convention="vehicle_T_world"),
    RecordingSettings(pose_convention="swapped_xy"),
    RecordingSettings(axis_order="yxz"),
)


class PoseSegment:
    """Consecutive instants of a recording: (N,) times, (N, 4, 4) `world_T_vehicle`, and the number of the first."""

    def __init__(self, times_s: NDArray[np.float64], world_T_vehicle: Matrix, first_frame: int) -> None:
        self.times_s, self.world_T_vehicle, self.first_frame = times_s, world_T_vehicle, first_frame
        jumps = find_pose_discontinuities(times_s, world_T_vehicle)
        # Where most poses jump, they are wrong in another way, which other checks find.
        self.discontinuities = (
            jumps[:0] if len(jumps) > max(2, PARAMS.max_discontinuity_share * len(times_s)) else jumps
        )


class ScanPair:
    """Two scans of a sensor between which the vehicle moves, at places `first` and `second` of a stretch."""

    def __init__(self, segment: PoseSegment, first: int, second: int) -> None:
        self.segment, self.first, self.second = segment, first, second
        self.interval_s = float(segment.times_s[second] - segment.times_s[first])
        motion = self.compute_motion()
        self.distance_m = float(np.linalg.norm(motion[:3, 3]))
        self.rotation_deg = float(np.rad2deg(np.arccos(np.clip((np.trace(motion[:3, :3]) - 1) / 2, -1, 1))))

    def compute_motion(self, settings: RecordingSettings = UNCORRECTED) -> Matrix:
        """(4, 4) transform from the vehicle frame of the other scan to that of the one."""
        poses = self.segment.world_T_vehicle
        if settings is not UNCORRECTED:
            poses = correct_poses(poses, self.segment.times_s, settings)
        return np.asarray(invert(poses[self.first]) @ poses[self.second])

    @property
    def time_offset_effect_m(self) -> float:
        """How far a time offset of 0.1 s moves points at half of the range of a map."""
        early, late = (self.compute_motion(RecordingSettings(time_offset_s=lag_s)) for lag_s in (-0.1, 0.1))
        change = late - early
        return float(np.linalg.norm(change[:3, 3]) + 20.0 * np.linalg.norm(change[:3, :3]))

    def read_scans(self, recording: Recording, sensor: str) -> bool:
        """Read both scans; return whether enough surfaces above the ground are in them."""
        try:
            instants = [self.segment.first_frame + place for place in (self.first, self.second)]
            self.scans = [recording.read_scan(sensor, instant) for instant in instants]
            self._maps = [SurfaceMap(transform_to_vehicle(scan, recording.ego_box).points_m) for scan in self.scans]
        except (OSError, ValueError):
            return False
        return all(surfaces.has_enough_points for surfaces in self._maps)

    def match(self, settings: RecordingSettings) -> float:
        """Return how well the scans match (0 to 1) if they are read with these settings."""
        motion = self.compute_motion(settings)
        if settings.axis_order == "yxz":  # both clouds are mirrored, each in the frame of its sensor
            swap = np.eye(4)[[1, 0, 2, 3]]
            mount = self.scans[0].vehicle_T_sensor
            mirror = swap if mount is None else mount @ swap @ invert(mount)
            motion = mirror @ motion @ mirror
        return self._maps[0].match(transform_points(motion, self._maps[1].points_m))


def check_frozen_poses(segments: Sequence[PoseSegment]) -> str | None:
    """Check whether poses repeat the previous one while the vehicle drives."""
    repeated = steps = 0
    for stretch in segments:
        is_same = (np.diff(stretch.world_T_vehicle, axis=0) == 0).all(axis=(1, 2))
        changes = np.concatenate([[-1], np.flatnonzero(~is_same), [len(is_same)]])
        run_lengths = np.diff(changes) - 1
        if run_lengths[1:-1].any():
            repeated += int(run_lengths[run_lengths <= PARAMS.max_repeats].sum())
            steps += len(is_same)
    if repeated < max(2, PARAMS.min_repeated_share * steps):
        return None
    return (
        f"{repeated} of {steps} poses repeat the previous one while the vehicle drives: give a pose for each instant, "
        "or have them interpolated (--set recording.interpolate_poses=true)"
    )


def check_pose_conventions(recording: Recording, segments: Sequence[PoseSegment], sensor: str) -> str | None:
    """Check whether scans match better with other conventions of rotations, poses or axes, or with a time offset."""
    pairs = [pair for pair in select_pairs(segments) if pair.read_scans(recording, sensor)]
    moving = [pair.scans for pair in pairs if pair.distance_m > PARAMS.min_motion_m]
    if moving and all(np.array_equal(one.points_m, other.points_m, equal_nan=True) for one, other in moving):
        return f"{sensor} repeats the same scan while the vehicle moves by its poses: leave it out (--sensors)"
    if not pairs:
        return None
    given = _mean_match(pairs, UNCORRECTED)
    best = max(CONVENTIONS, key=lambda settings: _mean_match(pairs, settings))
    match = _mean_match(pairs, best)
    remedy = best.command_line_options
    if match < max(given + PARAMS.min_match_gain, PARAMS.min_match_gain_ratio * given):
        lag_s, match = find_time_offset(pairs)
        remedy = f"--set recording.time_offset_s={lag_s:.2f}"
        if match < max(given + PARAMS.min_time_offset_gain, PARAMS.min_time_offset_match):
            return None
    return (
        f"two scans of {sensor} match to {given:.0%} once its poses move them, and to {match:.0%} with {remedy}: use "
        "that, or correct the recording"
    )


def find_time_offset(pairs: Sequence[ScanPair]) -> tuple[float, float]:
    """Find the time offset in s with which pairs match best, and how well; zeros where noise has many offsets."""
    matches = np.array([_mean_match(pairs, RecordingSettings(time_offset_s=lag_s)) for lag_s in LAGS_S])
    best = int(matches.argmax())
    sides = (matches[best::-1], matches[best:])
    ripple = max((side - np.minimum.accumulate(side)).max() for side in sides)
    return (0.0, 0.0) if ripple > PARAMS.max_time_offset_ripple else (LAGS_S[best], float(matches[best]))


def check_pose_discontinuities(recording: Recording, segments: Sequence[PoseSegment]) -> str | None:
    """Check whether a few poses jump."""
    names = [
        recording.frame_names[stretch.first_frame + step + 1]
        for stretch in segments
        for step in stretch.discontinuities.tolist()
    ]
    if not names:
        return None
    looked_at = sum(len(stretch.times_s) for stretch in segments)
    return (
        f"poses jump {len(names)} times in {looked_at} instants that were looked at, first at {names[0]}: no window "
        "extends over a jump, so that frames around it have fewer sweeps; give poses without jumps"
    )


def select_pairs(segments: Sequence[PoseSegment]) -> list[ScanPair]:
    """Select pairs of scans that are spread over the recording, and those that a time offset would change most."""
    pairs = []
    for stretch in segments:
        last = len(stretch.times_s) - 1
        for one in range(last):
            end = min(stretch.discontinuities[stretch.discontinuities >= one] + 1, default=last + 1)
            for other in range(one + 1, end):
                pair = ScanPair(stretch, one, other)
                is_far = (
                    pair.distance_m > PARAMS.pair_distance_m
                    or pair.rotation_deg > PARAMS.pair_rotation_deg
                    or pair.interval_s > PARAMS.pair_interval_s - 1e-6
                )
                if pair.interval_s <= PARAMS.max_pair_interval_s and (is_far or other == last):
                    pairs.append(pair)
                if is_far:
                    break
    if not pairs:
        return []
    spread = [pairs[place] for place in np.linspace(0, len(pairs) - 1, PARAMS.num_pairs).astype(int)]
    sensitive = sorted(pairs, key=attrgetter("time_offset_effect_m"), reverse=True)[: PARAMS.num_pairs]
    return list(dict.fromkeys((*spread, *sensitive)))


def read_pose_segments(recording: Recording, num_frames: int) -> Iterator[PoseSegment]:
    """Read the poses of stretches that are spread over the first `num_frames` frames."""
    times_s = recording.times_s
    if times_s is None or not num_frames:
        return
    # The window of the last frame extends beyond it.
    start = recording.key_frames[0]
    stop = min(recording.key_frames[num_frames - 1] + PARAMS.frames_per_segment, len(recording.frame_names))
    firsts, length = [start], stop - start
    if length > PARAMS.num_segments * PARAMS.frames_per_segment:
        length = PARAMS.frames_per_segment
        firsts = np.linspace(start, stop - length, PARAMS.num_segments).astype(int).tolist()
    for first in firsts if length > 1 else ():
        poses = [recording.get_world_T_vehicle(instant) for instant in range(first, first + length)]
        if all(pose is not None for pose in poses):
            yield PoseSegment(times_s[first : first + length], np.array(poses), first)


def _mean_match(pairs: Sequence[ScanPair], settings: RecordingSettings) -> float:
    return float(np.mean([pair.match(settings) for pair in pairs]))
