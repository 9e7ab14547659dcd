"""Tracks of the moving objects of a drive, from labels or from the points that rays contradict."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from torchcover.geometry import (
    BoundingBox,
    HeightField,
    build_transform,
    convert_euler_to_rotation,
    convert_rotation_to_euler,
    invert,
    transform_points,
)
from torchcover.geometry.arrays import Bools, Float64
from torchcover.geometry.rigid import Matrix
from torchcover.geometry.trajectory import Trajectory
from torchcover.recordings.accumulated_reference import AccumulationParams
from torchcover.recordings.free_space import RangeImage
from torchcover.recordings.moving_clusters import MovingCluster, find_moving_clusters
from torchcover.recordings.objects import extract_objects
from torchcover.recordings.recording import Recording
from torchcover.recordings.vehicle_cloud import find_points_in_box
from torchcover.simulation.height_field import GroundHeightField
from torchcover.simulation.recorded.excerpt import split_at_gaps

TableRow = tuple[float | str, ...]


@dataclass(frozen=True)
class TrackingParams:
    """Parameters of the tracking of moving objects without labels.

    Args:
        interval_s: Interval of the detections of one object.
        max_gap_s: Longest time without detection within a track; half of it from one detection to the next.
        association_radius_m: Gate around the predicted position.
        min_detections: Tracks with fewer detections are dropped.
        min_displacement_m: Tracks that get less far are dropped.
        min_free_share: Tracks are dropped if rays contradict a smaller share of the points in their boxes; a wall that
            comes into sight seems to move, and no ray contradicts it.
        size_quantile: The size of an object is this quantile of the sizes of its detections.
        min_size_m: Smallest length, width and height.
        max_size_m: Largest length, width and height.
        car_width_m: Objects wider than this are at least as long as a car, even if only their end is visible,
        car_length_m: which is this length.
        edge_quantile: Share of the points of a cluster that lie beyond each side of its box, as they may be noise.
        categories: Largest length and width of each category, in ascending order.
        margin_m: Points this close to an object belong to it.
    """

    interval_s: float = 0.2
    max_gap_s: float = 1.0
    association_radius_m: float = 2.0
    min_detections: int = 3
    min_displacement_m: float = 2.0
    min_free_share: float = 0.3
    size_quantile: float = 0.9
    min_size_m: float = 0.3
    max_size_m: tuple[float, float, float] = (25.0, 4.0, 5.0)
    car_width_m: float = 1.4
    car_length_m: float = 4.5
    edge_quantile: float = 0.02
    categories: tuple[tuple[float, float, str], ...] = (
        (1.3, 1.3, "pedestrian"),
        (2.6, 1.3, "bicycle"),
        (6.5, np.inf, "car"),
        (np.inf, np.inf, "truck"),
    )
    margin_m: float = 0.4

    def find_category(self, length_m: float, width_m: float) -> str:
        """Find the first category that is large enough.

        Args:
            length_m: Length of an object.
            width_m: Its width.

        Returns:
            The category.
        """
        fits = (length_m <= max_m and width_m <= max_width_m for max_m, max_width_m, _ in self.categories)
        return self.categories[list(fits).index(True)][2]


class DynamicScan(NamedTuple):
    """Points of one scan that are not static.

    Args:
        time_s: Time of the scan.
        points_m: (N, 3) points in the frame of the scene.
        is_in_free_space: (N,) True for points that rays of other scans contradict.
    """

    time_s: float
    points_m: Float64
    is_in_free_space: Bools


class MappedDrive(NamedTuple):
    """Contents of all scans of a drive, in a frame with the axes of the world and its origin at the first pose.

    Args:
        ground: Observed ground.
        static_points_m: (N, 3) one point in each cell with static points.
        dynamic_scans: Points that are not static, in the order of time.
        range_images: Range images of some scans.
    """

    ground: GroundHeightField
    static_points_m: Float64
    dynamic_scans: list[DynamicScan]
    range_images: list[RangeImage]


class TrackedCluster(NamedTuple):
    """Detection of a moving object.

    Args:
        time_s: Time of the detection.
        center_m: (2,) mean of its points in x and y.
        cluster: The points and their velocity.
    """

    time_s: float
    center_m: Float64
    cluster: MovingCluster


def build_row_box(row: TableRow, margin_m: float) -> tuple[Matrix, BoundingBox]:
    """Build the pose and the box, in its own frame, of a row of tracks.

    Args:
        row: Time, name, category, x, y, z of the bottom, length, width, height in meters, and yaw in degrees.
        margin_m: Enlargement at the sides and the bottom; the box is enlarged by its height at the top.

    Returns:
        (4, 4) pose, and the box.
    """
    x, y, z, *size_m, yaw_deg = (float(number) for number in row[3:])
    length, width, height = np.array(size_m) / 2 + margin_m
    box = BoundingBox((-length, -width, -height), (length, width, 2 * height))
    return build_transform(convert_euler_to_rotation(yaw_deg, 0.0, 0.0), [x, y, z]), box


def list_labeled_tracks(
    recording: Recording, end_s: float, time_step_s: float, params: TrackingParams = TrackingParams()
) -> Iterator[TableRow]:
    """List the rows of the tracks of labeled objects.

    Args:
        recording: Recording with poses and labels.
        end_s: Time after which rows are omitted.
        time_step_s: Interval of the rows.
        params: Longest gap within a track.

    Yields:
        Rows as in `build_row_box`.

    Raises:
        ValueError: The recording has no poses.
    """
    first_pose = recording.get_world_T_vehicle(0)
    if first_pose is None:
        raise ValueError(f"{recording.path}: no poses; a scene needs them")
    for track in extract_objects(recording).tracks:
        for number, piece in enumerate(split_at_gaps(track.trajectory, params.max_gap_s), 1):
            name = track.name if number == 1 else f"{track.name} #{number}"
            last_s = piece.times_s[-1]
            # Regular rows, and the last time exactly.
            times_s = np.append(np.arange(piece.times_s[0], last_s - 1e-6, time_step_s), last_s)
            times_s = times_s[times_s <= end_s]
            poses = piece.interpolate_many(times_s)
            yaw_deg = convert_rotation_to_euler(poses[:, :3, :3])[:, :1]
            for row in np.column_stack([times_s, poses[:, :3, 3] - first_pose[:3, 3], yaw_deg]).tolist():
                yield (row[0], name, track.category, *row[1:4], *track.size_m, row[4])


class ObjectTracker:
    """Tracker of the moving objects of a drive without labels.

    Args:
        mapped: The drive.
        ego_trajectory: Trajectory of the vehicle.
        accumulation: Parameters of the clusters.
        params: Parameters of the tracking.
    """

    def __init__(
        self,
        mapped: MappedDrive,
        ego_trajectory: Trajectory,
        accumulation: AccumulationParams,
        params: TrackingParams = TrackingParams(),
    ) -> None:
        self._mapped, self._ego_trajectory = mapped, ego_trajectory
        self._accumulation, self._params = accumulation, params
        self._scan_times_s = np.array([scan.time_s for scan in mapped.dynamic_scans])

    def list_rows(self) -> Iterator[TableRow]:
        """List the rows of all tracks.

        Yields:
            Rows as in `build_row_box`.
        """
        num_objects = 0
        for track in self._track_clusters():
            displacement_m = np.linalg.norm(track[-1].center_m - track[0].center_m)
            # Short tracks and small clusters are noise, such as vegetation that moves.
            if len(track) < self._params.min_detections or displacement_m < self._params.min_displacement_m:
                continue
            max_points = max(len(detection.cluster.points_m) for detection in track)
            if max_points < self._accumulation.min_cluster_points:
                continue
            boxes = self._fit_boxes(track)
            if self._compute_free_share(track, boxes) < self._params.min_free_share:
                continue
            num_objects += 1
            category = self._params.find_category(*boxes[0, 3:5])
            for detection, box in zip(track, boxes, strict=True):
                yield (detection.time_s, f"object_{num_objects}", category, *box.tolist())

    def _track_clusters(self) -> list[list[TrackedCluster]]:
        """Detect moving clusters at regular times and associate them to tracks, in the order of time."""
        tracks: list[list[TrackedCluster]] = []
        max_range_m = self._accumulation.clusters.max_range_m
        last_time_s = -np.inf
        for time_s in np.unique(self._scan_times_s):
            if time_s - last_time_s < self._params.interval_s - 1e-6:
                continue
            last_time_s = time_s
            ego_m = self._ego_trajectory.interpolate_positions_m(np.array([time_s]))[0]
            offsets_s = self._scan_times_s - time_s
            compared_scans = np.flatnonzero(np.abs(offsets_s) <= self._accumulation.clusters.max_compared_s)
            scans_m = []
            for scan in compared_scans:
                points_m = self._mapped.dynamic_scans[scan].points_m
                distance_m = np.linalg.norm(points_m[:, :2] - ego_m[:2], axis=1)
                scans_m.append(points_m[distance_m < max_range_m])
            self._extend_tracks(tracks, time_s, find_moving_clusters(scans_m, offsets_s[compared_scans]))
        return tracks

    def _extend_tracks(
        self, tracks: list[list[TrackedCluster]], time_s: float, clusters: Sequence[MovingCluster]
    ) -> None:
        """Append clusters to the tracks whose predictions are nearest, nearest pairs first, or begin new tracks."""
        detections = []
        for cluster in clusters:
            detections.append(TrackedCluster(time_s, cluster.points_m[:, :2].mean(axis=0), cluster))
        open_tracks = [track for track in tracks if time_s - track[-1].time_s <= self._params.max_gap_s / 2]
        pairs = []
        for track_index, track in enumerate(open_tracks):
            last = track[-1]
            predicted_m = last.center_m + (time_s - last.time_s) * last.cluster.velocity_mps
            for detection_index, detection in enumerate(detections):
                distance_m = float(np.linalg.norm(predicted_m - detection.center_m))
                pairs.append((distance_m, track_index, detection_index))
        # Greedy association: each track and each detection is used once.
        free_tracks, free_detections = set(range(len(open_tracks))), set(range(len(detections)))
        for distance_m, track_index, detection_index in sorted(pairs):
            is_free = track_index in free_tracks and detection_index in free_detections
            if distance_m <= self._params.association_radius_m and is_free:
                open_tracks[track_index].append(detections[detection_index])
                free_tracks.remove(track_index)
                free_detections.remove(detection_index)
        tracks += [[detections[index]] for index in sorted(free_detections)]

    def _compute_free_share(self, track: Sequence[TrackedCluster], boxes: Float64) -> float:
        """Compute the share of the points in (K, 7) boxes of a track that rays of other scans contradict."""
        num_inside = num_free = 0
        for detection, box_values in zip(track, boxes, strict=True):
            pose, box = build_row_box(("", "", "", *box_values.tolist()), self._params.margin_m)
            for scan_index in np.flatnonzero(self._scan_times_s == detection.time_s):
                scan = self._mapped.dynamic_scans[scan_index]
                inside = find_points_in_box(transform_points(invert(pose), scan.points_m), box)
                num_inside += len(inside)
                num_free += int(scan.is_in_free_space[inside].sum())
        return num_free / max(num_inside, 1)

    def _fit_boxes(self, track: Sequence[TrackedCluster]) -> Float64:
        """Fit boxes of one size to the K detections of a track.

        Only the sides that face the vehicle are visible; a box ends there and extends beyond the visible points.

        Returns:
            (K, 7) x, y, z of the bottom, length, width, height in meters, and yaw in degrees.
        """
        times_s = np.array([detection.time_s for detection in track])
        centers_m = np.array([detection.center_m for detection in track])
        # Velocities of single detections are noisy.
        velocities_mps = smooth_values(np.array([detection.cluster.velocity_mps for detection in track]))
        is_moving = np.linalg.norm(velocities_mps, axis=1) > self._accumulation.sweeps.min_object_speed_mps
        if not is_moving.any():
            velocities_mps[:], is_moving[:] = centers_m[-1] - centers_m[0], True
        # An object at rest keeps the heading of its last, or of its first, motion.
        moving_indices = np.maximum.accumulate(np.where(is_moving, np.arange(len(track)), is_moving.argmax()))
        velocities_mps = velocities_mps[moving_indices]
        yaw_rad = np.arctan2(velocities_mps[:, 1], velocities_mps[:, 0])
        forward = np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], 1)
        left = np.stack([-np.sin(yaw_rad), np.cos(yaw_rad)], 1)
        axes = np.stack([forward, left], axis=1)
        # Single points beyond the sides may be noise.
        quantiles = (self._params.edge_quantile, 1 - self._params.edge_quantile)
        bounds_m = np.empty((len(track), 2, 2))  # lower and upper bound along both axes
        heights_m = np.empty((len(track), 2))
        for index, (detection, detection_axes) in enumerate(zip(track, axes, strict=True)):
            points_m = detection.cluster.points_m
            bounds_m[index] = np.quantile(points_m[:, :2] @ detection_axes.T, quantiles, axis=0)
            heights_m[index] = np.quantile(points_m[:, 2], quantiles)
        ground = self._mapped.ground
        # Boxes stand on the ground, because the lower part of an object is often occluded.
        height_field = HeightField(ground.origin_m, ground.corner_heights_m, ground.cell_m)
        ground_m = height_field.compute_heights_m(centers_m)
        ground_m = np.where(np.isfinite(ground_m), ground_m, heights_m[:, 0])
        visible_sizes_m = np.column_stack([bounds_m[:, 1] - bounds_m[:, 0], heights_m[:, 1] - ground_m])
        size_m = np.clip(
            np.quantile(visible_sizes_m, self._params.size_quantile, axis=0),
            self._params.min_size_m,
            self._params.max_size_m,
        )
        if size_m[1] > self._params.car_width_m:
            size_m[0] = max(size_m[0], self._params.car_length_m)
        # Along each axis: 1 if the object is ahead of the vehicle, -1 behind, 0 if the vehicle is between its sides.
        ego_m = np.einsum("kij,kj->ki", axes, self._ego_trajectory.interpolate_positions_m(times_s)[:, :2])
        away = np.where(ego_m < bounds_m[:, 0], 1, np.where(ego_m > bounds_m[:, 1], -1, 0))
        nearest_m = np.where(away > 0, bounds_m[:, 0], bounds_m[:, 1])
        box_centers_m = np.where(away == 0, bounds_m.mean(axis=1), nearest_m + away * size_m[:2] / 2)
        positions_m = smooth_values(np.einsum("kij,ki->kj", axes, box_centers_m))
        return np.column_stack([positions_m, ground_m, np.tile(size_m, (len(track), 1)), np.rad2deg(yaw_rad)])


def smooth_values(values: Float64, max_neighbors: int = 2) -> Float64:
    """Smooth values by the mean over the same number of neighbors on both sides.

    Args:
        values: (K, 2) values at equal intervals.
        max_neighbors: Largest number of neighbors on one side; fewer near the ends.

    Returns:
        (K, 2) means.
    """
    means = []
    for index in range(len(values)):
        num_neighbors = min(max_neighbors, index, len(values) - 1 - index)
        means.append(values[index - num_neighbors : index + num_neighbors + 1].mean(axis=0))
    return np.array(means)
