"""Reference accumulated from all scans of a recording in a time window around each frame."""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.detection.boxes import Boxes
from torchcover.geometry import BoundingBox, invert, transform_points
from torchcover.geometry.arrays import Bools, Float64
from torchcover.recordings.free_space import ScanKey, Votes
from torchcover.recordings.moving_clusters import MovingCluster, MovingClusterParams, find_moving_clusters
from torchcover.recordings.recording import Recording
from torchcover.recordings.sweep_window import (
    SweepParams,
    SweepWindow,
    ThinnedScan,
    compute_voxel_indices,
    find_first_occurrences,
    get_vehicle_T_box,
)
from torchcover.recordings.vehicle_cloud import VehicleCloud, find_points_in_box
from torchcover.recordings.visibility import VisibilityParams, estimate_surface_areas_m2, estimate_visible_share

# Size of a mid-size car, for recordings that do not say how large their vehicle is.
DEFAULT_EGO_BOX = BoundingBox((-2.4, -0.95, 0.0), (2.4, 0.95, 1.7))

# Error of numbers against accumulated references in simulated drives, with boxes or without, by window in seconds:
# points of the detection rate and percent of the radius (root mean square over regions and height bands, the largest
# of several rigs, rounded up). From docs/measured/recordings.md.
SIMULATED_ERROR = {2.0: {"towns": (11, 52), "highways": (6, 20)}, 5.0: {"towns": (10, 41), "highways": (6, 17)}}


@dataclass(frozen=True)
class AccumulationParams:
    """Parameters of accumulated references.

    Args:
        min_votes: Points that this many scans contradict are dynamic.
        min_static_s: Static surfaces are observed for at least this long, or for half of the time of the scans.
        min_observed_share: Static surfaces are observed in at least this share of the frames between first and last.
        max_ground_height_m: Points this near to the ground belong to it,
        max_tilt: plus this much per meter of distance, for errors of the pitch and roll of poses.
        sort_block_m: Points are sorted by blocks of this size, because the search of neighbors takes two thirds of the
            time if near points are near in memory.
        min_cluster_points: A velocity estimated from fewer points is not counted as a moving object.
        sweeps: Parameters of the scans in the window.
        clusters: Parameters of the search for moving objects.
        visibility: Parameters of the visibility test.
    """

    min_votes: int = 2
    min_static_s: float = 1.0
    min_observed_share: float = 0.2
    max_ground_height_m: float = 0.3
    max_tilt: float = 0.005
    sort_block_m: float = 1.6
    min_cluster_points: int = 50
    sweeps: SweepParams = SweepParams()
    clusters: MovingClusterParams = MovingClusterParams()
    visibility: VisibilityParams = VisibilityParams()


class _MovingObject(NamedTuple):
    """Points of a labeled moving object, (M, 3) in the vehicle frame, and the largest area visible from one side."""

    points_m: Float64
    max_area_m2: float


class AccumulatedReference:
    """Reference made of the points that all sensors of a recording measured around a frame.

    Static points are moved with the poses of the vehicle. Points in labeled moving boxes, or within 0.1 m of their
    sides, are moved with their boxes; they are excluded if the object has no box in the frame. Unlabeled points are
    dynamic if rays of two scans pass through them, or if nothing above the ground is observed there for long; they are
    clustered and moved with their estimated velocities. One point per voxel remains, if it is visible from around the
    vehicle, with the area that it represents as its weight.

    Points of an evaluated sensor in the frame itself are not used, since their radius would be 0 m. In other frames
    they are: surfaces that it never observes are missing from this reference.

    Args:
        window_s: Time between the first scan and the last, half of it before the frame. 0: only the sensors that are
            not evaluated, in that frame.
        voxel_m: Side of a voxel in meters.
        sensors: Names of the sensors that are used; all if not given. Without the evaluated ones, results do not
            depend on them.
        min_motion_m: The vehicle is stationary if it moves less within a window: an evaluated sensor then adds little
            more than its scan of the frame, so that such a frame has no reference points, and is counted. In a
            simulated yard, the detection rate on the ground up to 80 m ahead was 49 points too high without motion,
            38 with 1 m, 25 with 2 m, 14 with 4 m and 0 with 10 m.
        params: Parameters of the method.

    Raises:
        ValueError: The window is negative, or the voxel size not positive.

    Example:
        >>> AccumulatedReference(5.0, sensors=["top"]).window_s
        5.0
    """

    def __init__(
        self,
        window_s: float = 2.0,
        *,
        voxel_m: float = 0.1,
        sensors: Collection[str] | None = None,
        min_motion_m: float = 2.0,
        params: AccumulationParams = AccumulationParams(),
    ) -> None:
        if not 0 <= window_s < np.inf:
            raise ValueError(f"window_s: got {window_s}; give seconds, 0 or more")
        if not 0 < voxel_m < np.inf:
            raise ValueError(f"voxel_m: got {voxel_m}; give a positive length in meters")
        self.window_s = window_s
        self.voxel_m = voxel_m
        self.sensors = None if sensors is None else tuple(sensors)
        self.min_motion_m = min_motion_m
        self.params = params
        self._sweeps = SweepWindow(window_s, voxel_m, params.sweeps)

    @property
    def sweep_window(self) -> SweepWindow:
        """Scans around the last frame."""
        return self._sweeps

    def check(self, recording: Recording, evaluated_sensors: Collection[str]) -> None:
        """Check that the recording has the sensors, times and poses that accumulation needs.

        Args:
            recording: The recording.
            evaluated_sensors: Names of the evaluated sensors.

        Raises:
            ValueError: A sensor, the times or the poses are missing, or no sensor is left for a window of 0 s.
        """
        unknown = set(self.sensors or ()) - {*recording.sensors, *recording.reference_sensors}
        if unknown:
            raise ValueError(
                f"reference: {recording.path} has no sensor {', '.join(sorted(unknown))}; it has "
                f"{', '.join(recording.sensors)}"
            )
        if self.window_s == 0:
            if not set(self._get_sensors(recording)) - set(evaluated_sensors):
                raise ValueError(
                    f"{recording.path}: the reference of a single frame (window 0 s) needs a sensor that is not "
                    f"evaluated; all are ({', '.join(evaluated_sensors)}): choose some with --sensors, or a longer "
                    "window"
                )
            return
        if recording.times_s is None or recording.get_world_T_vehicle(0) is None:
            missing = "times of its scans" if recording.times_s is None else "poses of the vehicle"
            raise ValueError(
                f"{recording.path}: no reference can be accumulated because the recording has no {missing}; add them, "
                "or a recorded reference"
            )

    def is_stationary(self, recording: Recording, index: int, evaluated_sensors: Collection[str]) -> bool:
        """Test whether the vehicle is stationary in the window of a frame and an evaluated sensor is used.

        Args:
            recording: The recording.
            index: Index of the frame.
            evaluated_sensors: Names of the evaluated sensors.
        """
        if set(evaluated_sensors).isdisjoint(self._get_sensors(recording)):
            return False
        positions_m = []
        for frame in self._sweeps.find_frames_in_window(recording, index):
            pose = recording.get_world_T_vehicle(frame)
            if pose is not None:
                positions_m.append(pose[:3, 3])
        return len(positions_m) > 1 and float(np.linalg.norm(np.ptp(positions_m, axis=0))) < self.min_motion_m

    def build_cloud(self, recording: Recording, index: int, evaluated_sensors: Collection[str]) -> VehicleCloud:
        """Build the reference cloud of a frame; it has no points if the vehicle is stationary.

        Args:
            recording: The recording.
            index: Index of the frame.
            evaluated_sensors: Names of the evaluated sensors.

        Returns:
            The cloud in the vehicle frame of that frame, with areas in square meters as weights.

        Raises:
            OSError: A scan cannot be read.
            ValueError: A scan cannot be read, or no point remains.
        """
        if self.is_stationary(recording, index, evaluated_sensors):
            return VehicleCloud(np.empty((0, 3), np.float32), Counter(stationary=1), np.empty(0, np.float32))
        sweeps, sensors = self._sweeps, self._get_sensors(recording)
        votes = sweeps.count_free_space_votes(recording, sensors, index)
        scans: dict[ScanKey, ThinnedScan] = {}
        for sensor, frame in votes:
            if frame != index or sensor not in evaluated_sensors:
                scans[sensor, frame] = sweeps.get_thinned_scan(recording, sensor, frame)
        window = set(sweeps.find_frames_in_window(recording, index))
        used: dict[ScanKey, ThinnedScan] = {}
        counts = Counter[str](sweeps_skipped=len(sensors) * sweeps.count_skipped_frames(recording, index))
        for key, scan in scans.items():
            if key[1] in window:
                used[key] = scan
                counts["sweeps"] += not scan.excluded_counts["sweeps_skipped"]
                counts += scan.excluded_counts
                counts["unlabeled"] += scan.unnamed_object_point_count
        objects = self._place_labeled_objects(recording.read_boxes(index), used.values(), counts)
        local_m = self._collect_unlabeled_points(recording, index, scans, used, votes, counts)
        # Noise and pose errors make the ground a thick layer that would count for more area and occlude what is behind.
        level_m = self._flatten_ground(recording, index, local_m)
        first = find_first_occurrences(compute_voxel_indices(level_m, self.voxel_m))
        block = compute_voxel_indices(level_m[first], self.params.sort_block_m)
        first = first[np.argsort(block, kind="stable")]
        vehicle_T_local = invert(sweeps.compute_local_T_vehicle(recording, index))
        object_points_m = [moving_object.points_m for moving_object in objects]
        points_m = np.concatenate([transform_points(vehicle_T_local, local_m[first]), *object_points_m])
        level_m = np.concatenate([transform_points(vehicle_T_local, level_m[first]), *object_points_m])
        # Index of the object of each point; 0 for points of no labeled object.
        part = np.repeat(np.arange(1 + len(objects)), [len(first), *(len(points) for points in object_points_m)])
        ego_box = recording.ego_box or DEFAULT_EGO_BOX
        if recording.ego_box is not None:
            # No other sensor could observe points in or below the vehicle in the frame.
            in_ego = find_points_in_box(points_m, BoundingBox((*ego_box.lower_m[:2], -np.inf), ego_box.upper_m))
            counts["ego_vehicle"] += len(in_ego)
            points_m, level_m = np.delete(points_m, in_ego, axis=0), np.delete(level_m, in_ego, axis=0)
            part = np.delete(part, in_ego)
        share = estimate_visible_share(level_m, ego_box, self.voxel_m, index, self.params.visibility)
        is_visible = share > 0
        counts["occluded"] = int((~is_visible).sum())
        points_m, level_m, part, share = points_m[is_visible], level_m[is_visible], part[is_visible], share[is_visible]
        if not len(points_m):
            raise ValueError(
                f"no reference point remains of the scans within {self.window_s / 2:g} s of this frame: "
                f"{counts['sweeps']} scans were used and {counts['sweeps_skipped']} skipped, for example where poses "
                "jump; --set skip_bad_frames=true skips such frames"
            )
        areas_m2 = estimate_surface_areas_m2(level_m)
        # The circles of few points in a box extend beyond its sides.
        max_areas_m2 = np.array([np.inf, *(moving_object.max_area_m2 for moving_object in objects)])
        areas_m2 *= np.minimum(1.0, max_areas_m2[part] / np.bincount(part, areas_m2)[part])
        return VehicleCloud(points_m.astype(np.float32), counts, (areas_m2 * share).astype(np.float32))

    def _place_labeled_objects(
        self, boxes: Boxes | None, scans: Iterable[ThinnedScan], counts: Counter[str]
    ) -> list[_MovingObject]:
        """Move the points of labeled moving objects with their boxes to where these are in the frame."""
        parts_m: dict[str, list[Float64]] = {}
        for scan in scans:
            for name, points_m in scan.object_points_m.items():
                parts_m.setdefault(name, []).append(points_m)
        box_indices = {} if boxes is None else {name: box_index for box_index, name in enumerate(boxes.ids)}
        objects = []
        for name, parts in parts_m.items():
            points_m = np.concatenate(parts)
            if boxes is None or name not in box_indices:
                counts["unlabeled"] += len(points_m)
                continue
            first = find_first_occurrences(compute_voxel_indices(points_m, self.voxel_m))
            placed_m = transform_points(get_vehicle_T_box(boxes, box_indices[name]), points_m[first])
            length_m, width_m, height_m = boxes.size_m[box_indices[name]].tolist()
            # Two sides and the top are visible from one point.
            visible_area_m2 = (length_m + width_m) * height_m + length_m * width_m
            objects.append(_MovingObject(placed_m, visible_area_m2))
        return objects

    def _collect_unlabeled_points(
        self,
        recording: Recording,
        index: int,
        scans: Mapping[ScanKey, ThinnedScan],
        used: Mapping[ScanKey, ThinnedScan],
        votes: Mapping[ScanKey, Votes],
        counts: Counter[str],
    ) -> Float64:
        """Collect (N, 3) static points, and moving ones where they are in the frame, one per voxel."""
        is_transient = self._mark_transient_points(recording, index, scans)
        counts["rays"] = counts["free_space"] = counts["transient"] = 0
        dynamic_points_m: dict[ScanKey, Float64] = {}
        parts_m, voxel_parts = [], []
        for key, scan in scans.items():
            in_free_space = votes[key] >= self.params.min_votes
            is_dynamic = in_free_space | is_transient[key]
            dynamic_points_m[key] = scan.static_points_m[is_dynamic]
            counts["rays"] += 0 if scan.range_image is None else len(scan.static_points_m)
            if key in used:
                counts["free_space"] += int(in_free_space.sum())
                counts["transient"] += int((is_transient[key] & ~in_free_space).sum())
                parts_m.append(scan.static_points_m[~is_dynamic])
                voxel_parts.append(scan.voxel_indices[~is_dynamic])
        clusters = self._find_moving_clusters(recording, index, dynamic_points_m)
        counts["moving_objects"] = 0
        for cluster in clusters:
            is_fast = np.linalg.norm(cluster.velocity_mps) > self.params.sweeps.min_object_speed_mps
            counts["moving_objects"] += len(cluster.points_m) >= self.params.min_cluster_points and bool(is_fast)
        cluster_points_m = np.concatenate([np.empty((0, 3)), *(cluster.points_m for cluster in clusters)])
        local_m = np.concatenate([*parts_m, cluster_points_m])
        voxel_indices = np.concatenate([*voxel_parts, compute_voxel_indices(cluster_points_m, self.voxel_m)])
        # Sorted rows keep the scans that are nearest in time first.
        return np.asarray(local_m[np.sort(find_first_occurrences(voxel_indices))])

    def classify_points(self, recording: Recording, index: int) -> dict[ScanKey, tuple[Float64, NDArray[np.int8]]]:
        """Classify the points of all scans in the window of a frame.

        Args:
            recording: The recording.
            index: Index of the frame.

        Returns:
            `ThinnedScan.static_points_m` of each scan, and (N,) 0 for static points, 1 for transient ones and 2 for
            points in free space.
        """
        votes = self._sweeps.count_free_space_votes(recording, self._get_sensors(recording), index)
        scans = {key: self._sweeps.get_thinned_scan(recording, *key) for key in votes}
        is_transient = self._mark_transient_points(recording, index, scans)
        window = set(self._sweeps.find_frames_in_window(recording, index))
        classified: dict[ScanKey, tuple[Float64, NDArray[np.int8]]] = {}
        for key, scan in scans.items():
            if key[1] in window:
                point_class = np.where(votes[key] >= self.params.min_votes, 2, is_transient[key])
                classified[key] = (scan.static_points_m, point_class.astype(np.int8))
        return classified

    def _flatten_ground(self, recording: Recording, index: int, points_m: Float64) -> Float64:
        """Move the points near the ground of (N, 3) points in the local frame onto it."""
        ground = self._sweeps.get_ground_model(recording, index)
        if ground is None:
            return points_m
        heights_m = ground.compute_heights_m(points_m)
        position_m = self._sweeps.compute_local_T_vehicle(recording, index)[:2, 3]
        distance_m = np.linalg.norm(points_m[:, :2] - position_m, axis=1)
        is_ground = np.abs(heights_m) <= self.params.max_ground_height_m + self.params.max_tilt * distance_m
        return np.asarray(points_m - np.where(is_ground, heights_m, 0.0)[:, None] * np.array([0.0, 0.0, 1.0]))

    def _mark_transient_points(
        self, recording: Recording, index: int, scans: Mapping[ScanKey, ThinnedScan]
    ) -> dict[ScanKey, Bools]:
        """Mark the points of each scan that lie above the ground in cells that are observed for a short time only."""
        times_s = np.zeros(len(recording.frame_names)) if recording.times_s is None else recording.times_s
        keys = sorted(scans, key=itemgetter(1))
        lengths = [len(scans[key].occupied_cells[0]) for key in keys]
        cells = np.concatenate([np.empty(0, np.int64), *(scans[key].occupied_cells[0] for key in keys)])
        frames, rank_of_scan = np.unique(np.array([frame for _, frame in keys], np.int64), return_inverse=True)
        # Entries sorted by cell, then by frame; `rank` is the position of the frame in the window.
        order = np.argsort(cells, kind="stable")
        rank, is_new_cell = np.repeat(rank_of_scan, lengths)[order], np.diff(cells[order], prepend=-1) != 0
        start = np.flatnonzero(is_new_cell)
        length = np.diff(np.append(start, len(rank)))
        end = start + length - 1
        first, last = rank[start], rank[end]
        frame_changes = np.cumsum(is_new_cell | (np.diff(rank, prepend=0) != 0))
        frame_count = frame_changes[end] - frame_changes[start] + 1
        min_static_s = min(self.params.min_static_s, np.ptp(times_s[frames]) / 2) if len(frames) else 0.0
        is_short = times_s[frames[last]] - times_s[frames[first]] < min_static_s - 1e-6
        is_short |= frame_count < self.params.min_observed_share * (last - first + 1)
        is_transient_cell = np.empty(len(cells), np.bool_)
        is_transient_cell[order] = np.repeat(is_short, length)
        ground = self._sweeps.get_ground_model(recording, index)
        is_transient: dict[ScanKey, Bools] = {}
        for key, cells_of_scan in zip(keys, np.split(is_transient_cell, np.cumsum(lengths)), strict=False):
            scan = scans[key]
            marks = cells_of_scan[scan.occupied_cells[1]]
            if ground is not None:
                rows = np.flatnonzero(marks)
                heights_m = ground.compute_heights_m(scan.static_points_m[rows])
                marks[rows] = ~(heights_m <= self.params.max_ground_height_m)
            is_transient[key] = marks
        return is_transient

    def _find_moving_clusters(
        self, recording: Recording, index: int, dynamic_points_m: Mapping[ScanKey, Float64]
    ) -> list[MovingCluster]:
        """Find the moving objects around a frame in the dynamic points of its window."""
        if recording.times_s is None:
            return []
        params = self.params.clusters
        position_m = self._sweeps.compute_local_T_vehicle(recording, index)[:2, 3]
        scans_m, offsets_s = [], []
        for (_, frame), points_m in dynamic_points_m.items():
            offset_s = recording.times_s[frame] - recording.times_s[index]
            if abs(offset_s) <= params.max_compared_s:
                distance_m = np.linalg.norm(points_m[:, :2] - position_m, axis=1)
                scans_m.append(points_m[distance_m < params.max_range_m])
                offsets_s.append(offset_s)
        return find_moving_clusters(scans_m, np.array(offsets_s), params)

    def has_area_weights(self, recording: Recording) -> bool:
        """Return True: each point has the area up to its neighbors as its weight.

        Args:
            recording: The recording.
        """
        return True

    def describe(self, recording: Recording, evaluated_sensors: Collection[str]) -> Mapping[str, object]:
        """Describe settings and limits of the reference for `summary.json`.

        Args:
            recording: The recording.
            evaluated_sensors: Names of the evaluated sensors.

        Returns:
            `sensor`, settings and `notes`.
        """
        sensors = self._get_sensors(recording)
        evaluated = [sensor for sensor in sensors if sensor in evaluated_sensors] if self.window_s else []
        simulated_s = min(SIMULATED_ERROR, key=lambda window_s: abs(window_s - self.window_s))
        errors = SIMULATED_ERROR[simulated_s]
        error_texts = []
        for place, (points, percent) in errors.items():
            error_texts.append(f"{points} points of detection rate and {percent} % of radius in {place}")
        notes = [
            f"Reference: points of {', '.join(sensors)}, accumulated over {self.window_s:g} s, one per voxel of "
            f"{self.voxel_m:g} m; points in free space of other scans are dynamic.",
            "Surfaces that no sensor observed within this time are in no number.",
            f"Error of such numbers in simulated drives (windows of {simulated_s:g} s, with or without boxes, root "
            f"mean square): {', '.join(error_texts)}; 4 points of detection rate for differences between two rigs.",
        ]
        if evaluated:
            notes.append(
                f"Frames in whose window the vehicle moves less than {self.min_motion_m:g} m have no reference points."
            )
            notes.append(
                f"{', '.join(evaluated)} also built the reference: surfaces that they never observe are missing, so "
                "the true detection rate is lower."
            )
        return {
            "sensor": "accumulated",
            "sensors": list(sensors),
            "evaluated_sensors": evaluated,
            "window_s": self.window_s,
            "voxel_m": self.voxel_m,
            "simulated_error": {"window_s": simulated_s, "rms_points_and_percent": errors},
            "notes": notes,
        }

    def _get_sensors(self, recording: Recording) -> tuple[str, ...]:
        return tuple(recording.sensors) if self.sensors is None else self.sensors
