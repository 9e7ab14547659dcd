"""Inversion of the motion compensation of LiDAR scans: points in the sensor frame at the time of each ray."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import convert_rotation_to_quaternion, invert, transform_points
from torchcover.geometry.arrays import Bools, Float64
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.formats.ros_poses import PoseSeries
from torchcover.recordings.recording import NO_RETURN_M, Recording
from torchcover.recordings.vehicle_cloud import find_points_in_box
from torchcover.simulation.scan_estimate import LaserIndices, compute_row_spread_deg, infer_laser_indices

RowSpread = Callable[["Revolution | None"], float]


@dataclass(frozen=True)
class MotionCompensationParams:
    """Parameters of the search for the motion compensation of a data set.

    Args:
        tick_ns: Points measured within this time are transformed together.
        max_tested_points: Points that are tested during the search.
        min_displacement_m: Smallest motion between two frames that the search needs.
        max_spread_ratio: The spread of rows must fall below this share of that of the recorded points.
        seam_share: Share of a revolution at its begin, and at its end, that is excluded: an error of a degree decides
            there to which of the two a point belongs.
        max_interval_s: Longest interval of frames at which the duration of a revolution is known; no LiDAR rotates more
            slowly.
        num_refinements: Number of times that the steps of azimuth and time are halved.
    """

    tick_ns: int = 100_000
    max_tested_points: int = 8_000
    min_displacement_m: float = 0.05
    max_spread_ratio: float = 0.8
    seam_share: float = 0.035
    max_interval_s: float = 0.25
    num_refinements: int = 6


class Revolution(NamedTuple):
    """Timing of one revolution of a LiDAR.

    Args:
        reference_azimuth_deg: Azimuth that is measured at the time of the frame.
        direction: 1 counterclockwise, -1 clockwise.
        share_before: Share of the revolution before the time of the frame.
    """

    reference_azimuth_deg: float
    direction: int
    share_before: float

    @property
    def start_azimuth_deg(self) -> float:
        """Azimuth that is measured first, from -180 to 180 degrees."""
        return (self.reference_azimuth_deg - self.direction * 360.0 * self.share_before + 180.0) % 360.0 - 180.0

    def compute_revolutions(self, points_m: Matrix) -> Float64:
        """Compute the time of each point.

        Args:
            points_m: (N, 3) points in the sensor frame.

        Returns:
            (N,) time after that of the frame, in revolutions.
        """
        azimuth_deg = np.rad2deg(np.arctan2(points_m[:, 1], points_m[:, 0]))
        return np.mod(self.direction * (azimuth_deg - self.start_azimuth_deg), 360.0) / 360.0 - self.share_before

    def mask_off_seam(self, points_m: Matrix, seam_share: float) -> Bools:
        """Mask the points that are far from the begin and the end of the revolution.

        Args:
            points_m: (N, 3) points in the sensor frame.
            seam_share: Share of the revolution at each end that is excluded.

        Returns:
            (N,) True for points that are not excluded.
        """
        share = self.compute_revolutions(points_m) + self.share_before
        return (share > seam_share) & (share < 1 - seam_share)


class CompensatedScan(NamedTuple):
    """Scan with the motion compensation of its data set.

    Args:
        points_m: (N, 3) points in the sensor frame at the time of the frame.
        lasers: (N,) laser of each point; None if unknown.
        offsets_s: (N,) time of each point after that of the frame; None if unknown.
        poses: Poses of the sensor around the time of the frame, whose times are relative to it; None if unknown.
        revolution_s: Duration of a revolution, assumed to be the interval of frames.
    """

    points_m: Matrix
    lasers: NDArray[np.integer] | None
    offsets_s: Float64 | None
    poses: PoseSeries | None
    revolution_s: float

    def transform_to_ray_times(self, offsets_s: Float64, points_m: Matrix, tick_ns: int) -> Matrix:
        """Transform points to the sensor frame at the time of each point.

        Args:
            offsets_s: (N,) time of each point after that of the frame.
            points_m: (N, 3) points in the sensor frame at the time of the frame.
            tick_ns: Points within this time are transformed together.

        Returns:
            (N, 3) points.

        Raises:
            ValueError: The poses are unknown, or too far apart in time.
        """
        if self.poses is None:
            raise ValueError("the poses of the scan are unknown; only scans with poses can be transformed")
        ticks, point_ticks = np.unique(np.rint(offsets_s * (1e9 / tick_ns)).astype(np.int64), return_inverse=True)
        world_T_ray = self.poses.interpolate(ticks * tick_ns, "the LiDAR")
        world_T_frame = self.poses.interpolate(np.zeros(1, np.int64), "the LiDAR")
        ray_T_frame = (np.linalg.inv(world_T_ray) @ world_T_frame)[point_ticks]
        return np.asarray(np.einsum("nij,nj->ni", ray_T_frame[:, :3, :3], points_m) + ray_T_frame[:, :3, 3])

    def invert_compensation(self, revolution: Revolution, points_m: Matrix, tick_ns: int) -> Matrix:
        """Transform points to the sensor frame at the times that a revolution assigns to their directions.

        Args:
            revolution: The revolution.
            points_m: (N, 3) points in the sensor frame at the time of the frame.
            tick_ns: Points within this time are transformed together.

        Returns:
            (N, 3) points.
        """
        ray_points_m = points_m
        for _ in range(2):  # the direction, and with it the time, changes with the transformation
            offsets_s = revolution.compute_revolutions(ray_points_m) * self.revolution_s
            ray_points_m = self.transform_to_ray_times(offsets_s, points_m, tick_ns)
        return ray_points_m


def undo_motion_compensation(
    recording: Recording,
    sensor_name: str,
    frame_indices: Sequence[int],
    vehicle_T_sensor: Matrix,
    params: MotionCompensationParams = MotionCompensationParams(),
) -> tuple[list[Matrix], LaserIndices, str]:
    """Read scans and undo their motion compensation.

    If the times of the points are unknown and the vehicle moves, the revolution is searched for which the points lie
    closest to rows. If the recorded points lie about as close, nothing is undone.

    Args:
        recording: The recording.
        sensor_name: Name of the LiDAR.
        frame_indices: Frames to read.
        vehicle_T_sensor: (4, 4) extrinsics of the LiDAR.
        params: Parameters of the search.

    Returns:
        Points of each scan in the sensor frame at the time of each ray, their lasers, and a description of the
        compensation that was undone, empty for none.
    """
    scans = [read_scan(recording, sensor_name, index, vehicle_T_sensor) for index in frame_indices]
    points_m = [scan.points_m for scan in scans]
    lasers = collect_lasers(scans)
    if all(scan.offsets_s is not None for scan in scans):
        for index, scan in enumerate(scans):
            if scan.poses is not None and scan.offsets_s is not None:
                points_m[index] = scan.transform_to_ray_times(scan.offsets_s, scan.points_m, params.tick_ns)
        return points_m, lasers, "each ray at its own time"
    if not scans or not all(has_moved(scan, params) for scan in scans):
        return points_m, lasers, ""
    if (interval_s := max(scan.revolution_s for scan in scans)) > params.max_interval_s:
        remedy = f"at most {params.max_interval_s:g} s are needed, or times of the points, or a vehicle at rest"
        return points_m, lasers, f"motion within a revolution not undone, frames are {interval_s:g} s apart ({remedy})"
    revolution = find_revolution(scans, lasers, params)
    if revolution is None:
        return points_m, lasers, ""
    ray_points_m, ray_lasers = [], []
    for index, scan in enumerate(scans):
        scan_m = scan.invert_compensation(revolution, scan.points_m, params.tick_ns)
        is_off_seam = revolution.mask_off_seam(scan.points_m, params.seam_share)
        is_off_seam &= revolution.mask_off_seam(scan_m, params.seam_share)
        ray_points_m.append(scan_m[is_off_seam])
        if lasers is not None:
            ray_lasers.append(lasers[index][is_off_seam])
    direction = "counterclockwise" if revolution.direction > 0 else "clockwise"
    description = f"motion undone (rotates {direction} from {revolution.start_azimuth_deg:.0f} degrees)"
    return ray_points_m, ray_lasers if lasers is not None else None, description


def collect_lasers(scans: Sequence[CompensatedScan]) -> LaserIndices:
    """Collect the lasers of all points, inferred where unknown; None if they are unknown in any scan."""
    lasers = []
    for scan in scans:
        indices = infer_laser_indices(scan.points_m) if scan.lasers is None else scan.lasers
        if indices is None:
            return None
        lasers.append(indices)
    return lasers


def has_moved(scan: CompensatedScan, params: MotionCompensationParams) -> bool:
    """Test whether the sensor moved far enough between all frames around a scan."""
    if scan.poses is None:
        return False
    distances_m = np.linalg.norm(np.diff(scan.poses.positions_m, axis=0), axis=1)
    return float(distances_m.min()) > params.min_displacement_m


def find_revolution(
    scans: Sequence[CompensatedScan], lasers: LaserIndices, params: MotionCompensationParams
) -> Revolution | None:
    """Find the revolution for which the points of scans lie closest to rows.

    Args:
        scans: Scans with poses.
        lasers: Laser of each point; None if unknown.
        params: Parameters of the search.

    Returns:
        The revolution; None if the points do not lie clearly closer to rows than the recorded points.
    """
    strides = [max(1, len(scan.points_m) * len(scans) // params.max_tested_points) for scan in scans]
    tested_points_m = [scan.points_m[::stride] for scan, stride in zip(scans, strides, strict=True)]
    tested_lasers = lasers and [indices[::stride] for indices, stride in zip(lasers, strides, strict=True)]

    def compute_spread_deg(revolution: Revolution | None) -> float:
        scans_m = tested_points_m
        if revolution is not None:
            scans_m = []
            for scan, scan_m in zip(scans, tested_points_m, strict=True):
                scans_m.append(scan.invert_compensation(revolution, scan_m, params.tick_ns))
        return compute_row_spread_deg(scans_m, tested_lasers)

    revolution, spread_deg = find_best_revolution(compute_spread_deg, params)
    if spread_deg > params.max_spread_ratio * compute_spread_deg(None):
        return None
    return revolution


def find_best_revolution(compute_spread_deg: RowSpread, params: MotionCompensationParams) -> tuple[Revolution, float]:
    """Find the revolution with the smallest spread of rows, on a grid that is refined around the best.

    Args:
        compute_spread_deg: Computes the spread for a revolution.
        params: Number of refinements.

    Returns:
        The revolution and its spread in degrees.
    """
    spreads_deg: dict[Revolution, float] = {}
    for azimuth_deg in np.arange(-180.0, 180.0, 45.0).tolist():
        for direction in (-1, 1):
            for share_before in (0.0, 0.25, 0.5, 0.75, 1.0):
                revolution = Revolution(azimuth_deg, direction, share_before)
                spreads_deg[revolution] = compute_spread_deg(revolution)
    best = min(spreads_deg, key=spreads_deg.__getitem__)
    for scale in 0.5 ** np.arange(1, params.num_refinements + 1):
        for azimuth_step_deg, share_step in ((45.0, 0.0), (-45.0, 0.0), (0.0, 0.25), (0.0, -0.25)):
            azimuth_deg = best.reference_azimuth_deg + scale * azimuth_step_deg
            revolution = Revolution(azimuth_deg, best.direction, best.share_before + scale * share_step)
            if revolution not in spreads_deg:
                spreads_deg[revolution] = compute_spread_deg(revolution)
            if spreads_deg[revolution] < spreads_deg[best]:
                best = revolution
    return best, spreads_deg[best]


def read_scan(recording: Recording, sensor: str, index: int, vehicle_T_sensor: Matrix) -> CompensatedScan:
    """Read the returns of a scan that are not on the vehicle.

    Args:
        recording: The recording.
        sensor: Name of the LiDAR.
        index: The frame.
        vehicle_T_sensor: (4, 4) extrinsics of the LiDAR.

    Returns:
        The scan.
    """
    scan = recording.read_scan(sensor, index)
    points_m = scan.points_m.astype(np.float64)
    has_coordinates = np.isfinite(points_m).all(axis=1)
    is_return: Bools = np.asarray(has_coordinates & (np.abs(points_m) > NO_RETURN_M).any(axis=1))
    vehicle_points_m = points_m if scan.vehicle_T_sensor is None else transform_points(scan.vehicle_T_sensor, points_m)
    if recording.ego_box is not None:
        is_return[find_points_in_box(vehicle_points_m, recording.ego_box)] = False
    lasers = None if scan.rings is None else scan.rings[is_return]
    offsets_s = None if scan.offsets_s is None else scan.offsets_s[is_return]
    sensor_poses, revolution_s = None, 0.0
    frames = range(max(index - 1, 0), min(index + 2, len(recording.frame_names)))
    vehicle_poses = [recording.get_world_T_vehicle(frame) for frame in frames]
    known_poses = [pose for pose in vehicle_poses if pose is not None]
    if recording.times_s is not None and len(known_poses) == len(frames) > 1:
        world_T_sensor = np.stack(known_poses) @ vehicle_T_sensor
        times_s = recording.times_s[frames.start : frames.stop] - recording.times_s[index]
        times_ns = np.rint(times_s * 1e9).astype(np.int64)
        wxyz = np.array([convert_rotation_to_quaternion(pose[:3, :3]) for pose in world_T_sensor])
        sensor_poses = PoseSeries(times_ns, world_T_sensor[:, :3, 3], wxyz)
        revolution_s = float(np.diff(times_ns).min() * 1e-9)
    sensor_points_m = transform_points(invert(vehicle_T_sensor), vehicle_points_m[is_return])
    return CompensatedScan(sensor_points_m, lasers, offsets_s, sensor_poses, revolution_s)
