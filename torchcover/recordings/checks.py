"""Checks of a recording before it is measured: known errors that would otherwise give plausible but wrong numbers.

Each check reads a few frames and names the remedy. Nothing is corrected unless the user asks for it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
import torch
from numpy.typing import NDArray

from torchcover.detection import Boxes, find_points_in_boxes
from torchcover.neighbors import nearest
from torchcover.recordings.accumulated_reference import AccumulatedReference
from torchcover.recordings.ground_model import GroundModel, extract_low_surfaces
from torchcover.recordings.pose_checks import (
    check_frozen_poses,
    check_pose_conventions,
    check_pose_discontinuities,
    read_pose_segments,
)
from torchcover.recordings.recording import Recording, read_complete_manifest
from torchcover.recordings.reference import RecordedReference, Reference
from torchcover.recordings.vehicle_cloud import transform_to_vehicle

Cloud = NDArray[np.float32]


@dataclass(frozen=True)
class CheckParams:
    """Parameters of the checks.

    Args:
        num_frames: Frames whose clouds are checked, evenly spread.
        num_label_frames: Frames whose labels are counted, evenly spread.
        max_median_range_m: Half of the points of a LiDAR are nearer; otherwise the unit is not meters.
        max_median_range_cm: Above this median range the unit is millimeters rather than centimeters.
        ground_radius_m: Ground is searched around the vehicle within this distance.
        max_ground_offset_m: Half of the lowest height band; ground beyond is in another band.
        max_identical_distance_m: Points nearer than this are the same point.
        min_cloud_points: Smaller clouds may be equal by chance.
        num_identical_queries: Points that are compared, sampled at random.
        max_box_range_m: Boxes of nearer objects have points.
        box_bottom_margin_m: Height at the bottom of a box that may be ground.
        min_box_points: Points that a box needs to decide about mirrored axes.
        min_point_count_ratio: A box decides if it has this many times the points of the other side.
        min_mirrored_boxes: Boxes that must have more points if mirrored.
        min_mirrored_ratio: Mirrored boxes must be this many times the others.
        min_mirrored_share: Share of all boxes that must have more points if mirrored.
    """

    num_frames: int = 5
    num_label_frames: int = 64
    max_median_range_m: float = 300.0
    max_median_range_cm: float = 4000.0
    ground_radius_m: float = 30.0
    max_ground_offset_m: float = 0.5
    max_identical_distance_m: float = 1e-3
    min_cloud_points: int = 100
    num_identical_queries: int = 1000
    max_box_range_m: float = 40.0
    box_bottom_margin_m: float = 0.3
    min_box_points: int = 5
    min_point_count_ratio: int = 5
    min_mirrored_boxes: int = 5
    min_mirrored_ratio: int = 4
    min_mirrored_share: float = 0.6


PARAMS = CheckParams()


def check_recording(
    recording: Recording,
    reference: Reference,
    rigs: Mapping[str, Sequence[str]],
    num_frames: int,
) -> list[str]:
    """Check a recording for known errors; a frame that cannot be read is skipped, and reported when it is measured.

    Args:
        recording: The recording.
        reference: Source of its reference clouds.
        rigs: Name of each rig -> its sensors.
        num_frames: Number of frames that will be measured, from the first on.

    Returns:
        A message with a remedy for each error.
    """
    sensors = tuple(dict.fromkeys(chain.from_iterable(rigs.values())))
    if num_frames and (message := check_units(recording, sensors[0])) is not None:
        return [f"{recording.path}: {message}"]
    reference_sensors = recording.reference_sensors if isinstance(reference, RecordedReference) else ()
    checked_sensors = tuple(dict.fromkeys((*sensors, *reference_sensors)))
    frames = list(_read_frames(recording, checked_sensors, num_frames))
    clouds: dict[str, list[Cloud]] = {}
    point_counts: dict[str, int] = {}
    for sensor in checked_sensors:
        clouds[sensor] = [frame.clouds[sensor] for frame in frames]
        point_counts[sensor] = sum(len(cloud) for cloud in clouds[sensor])
    densest_sensor = max(sensors, key=point_counts.__getitem__)
    messages = [
        check_ground_offset(clouds),
        *(check_mirrored_axis(sensor, frames) for sensor in clouds),
        *(check_identical_clouds(rig, rigs[rig], reference_sensors, frames) for rig in rigs),
        check_empty_clouds(clouds),
        check_missing_labels(recording, num_frames),
    ]
    segments = list(read_pose_segments(recording, num_frames))
    pose_message = check_frozen_poses(segments) or check_pose_conventions(recording, segments, densest_sensor)
    messages.append(pose_message or check_pose_discontinuities(recording, segments))
    if isinstance(reference, AccumulatedReference):
        messages.append(check_stationary_vehicle(recording, reference, sensors, num_frames))
    return [f"{recording.path}: {message}" for message in messages if message is not None]


def check_units(recording: Recording, sensor: str) -> str | None:
    """Check whether coordinates are too large for meters.

    Args:
        recording: The recording.
        sensor: Sensor whose first cloud is checked.

    Returns:
        A message with the remedy; None if the unit is right or the cloud cannot be read.
    """
    try:
        range_m = np.linalg.norm(recording.read_scan(sensor, recording.key_frames[0]).points_m, axis=1)
    except (OSError, ValueError, IndexError):
        return None
    median_m = float(np.median(np.append(range_m[np.isfinite(range_m)], 0.0)))
    if median_m < PARAMS.max_median_range_m:
        return None
    unit = "mm" if median_m > PARAMS.max_median_range_cm else "cm"
    return f"half of the points of {sensor} are beyond {median_m:,.0f} m: is it {unit}? (--set recording.units={unit})"


def check_ground_offset(clouds: Mapping[str, Sequence[Cloud]]) -> str | None:
    """Check whether the ground that sensors measure is far from z = 0.

    Args:
        clouds: Sensor -> (N, 3) points in the vehicle frame of each frame.

    Returns:
        A message with the remedy; None if the ground is near 0 or unknown.
    """
    offsets = []
    for sensor, sensor_clouds in clouds.items():
        heights_m = [estimate_ground_height(cloud) for cloud in sensor_clouds]
        measured_m = [height_m for height_m in heights_m if height_m is not None]
        height_m = float(np.median(measured_m)) if measured_m else 0.0
        if abs(height_m) > PARAMS.max_ground_offset_m:
            offsets.append(f"{height_m:+.1f} m ({sensor})")
    if not offsets:
        return None
    return (
        f"the ground lies at z = {', '.join(offsets)}, not near 0: give the pose of the sensor in the vehicle frame, "
        "whose origin is on the ground (vehicle_T_sensor)"
    )


def estimate_ground_height(points_m: NDArray[np.floating]) -> float | None:
    """Estimate the height of the ground below the origin.

    Args:
        points_m: (N, 3) points in the vehicle frame.

    Returns:
        z in meters; None where no ground is measured near the origin.
    """
    near_m = points_m[(np.abs(points_m) < PARAMS.ground_radius_m).all(axis=1)].astype(np.float64)
    origin_m = np.zeros((1, 3))
    ground = GroundModel.from_surfaces([extract_low_surfaces(near_m, origin_m[0])], origin_m[0])
    origin_height_m = np.nan if ground is None else float(ground.compute_heights_m(origin_m)[0])
    return None if np.isnan(origin_height_m) else -origin_height_m


def check_mirrored_axis(sensor: str, frames: Sequence["CheckedFrame"]) -> str | None:
    """Check whether labeled boxes contain points only if left and right are exchanged.

    Args:
        sensor: Name of the sensor.
        frames: Frames with its clouds and with boxes.

    Returns:
        A message with the remedy; None if the axis is right or few boxes decide.
    """
    box_count = right_count = mirrored_count = 0
    for frame in frames:
        if frame.boxes is None:
            continue
        is_near = torch.linalg.vector_norm(frame.boxes.center_m[:, :2], dim=1) < PARAMS.max_box_range_m
        rows = frame.boxes.rows[is_near].clone()
        rows[:, 2] += PARAMS.box_bottom_margin_m / 2
        rows[:, 5] -= PARAMS.box_bottom_margin_m
        boxes = Boxes.from_rows(rows[rows[:, 5] > 0])
        box_count += len(boxes)
        points_m = frame.clouds[sensor]
        counts = _count_points_in_boxes(points_m, boxes)
        mirrored_counts = _count_points_in_boxes(points_m * np.array([1, -1, 1], np.float32), boxes)
        min_counts = (PARAMS.min_point_count_ratio * mirrored_counts).clamp(min=PARAMS.min_box_points)
        min_mirrored_counts = (PARAMS.min_point_count_ratio * counts).clamp(min=PARAMS.min_box_points)
        right_count += int((counts >= min_counts).sum())
        mirrored_count += int((mirrored_counts >= min_mirrored_counts).sum())
    if (
        mirrored_count < PARAMS.min_mirrored_boxes
        or mirrored_count < PARAMS.min_mirrored_ratio * right_count
        or mirrored_count < PARAMS.min_mirrored_share * box_count
    ):
        return None
    return (
        f"{mirrored_count} of {box_count} labeled boxes contain points of {sensor} only if its left and right are "
        f"exchanged, and {right_count} as it is: mirror its y axis (flip_y), as for a left-handed simulator"
    )


def check_identical_clouds(
    rig_name: str,
    sensors: Sequence[str],
    reference_sensors: Sequence[str],
    frames: Sequence["CheckedFrame"],
) -> str | None:
    """Check whether all reference points are points of the rig, so that every radius is 0 m.

    Args:
        rig_name: Name of the rig.
        sensors: Its sensors.
        reference_sensors: Sensors of the reference.
        frames: Frames with the clouds of all of them.

    Returns:
        A message with the remedy; None if the clouds differ.
    """
    compared_count = 0
    for frame in frames:
        sensor_m, reference_m = frame.join_clouds(sensors), frame.join_clouds(reference_sensors)
        if len(reference_m) < PARAMS.min_cloud_points:
            continue
        # Sampled at random: every n-th point may be of the same laser.
        chosen = np.random.default_rng(0).integers(len(reference_m), size=PARAMS.num_identical_queries)
        query, points = torch.from_numpy(reference_m[chosen]), torch.from_numpy(sensor_m)
        distance_m = nearest(query, points, max_distance=PARAMS.max_identical_distance_m).distance
        if not bool(distance_m.isfinite().all()):
            return None
        compared_count += 1
    if not compared_count:
        return None
    return (
        f"the reference points are those of the rig {rig_name} itself, so that its coverage is perfect: give another "
        "sensor as the reference, or accumulate one (--reference accumulated)"
    )


def check_empty_clouds(clouds: Mapping[str, Sequence[Cloud]]) -> str | None:
    """Check whether sensors have no point in some frames.

    Args:
        clouds: Sensor -> (N, 3) points of each frame.

    Returns:
        A message with the remedy; None if every cloud has points.
    """
    empty_sensors = []
    for sensor, sensor_clouds in clouds.items():
        empty_count = sum(not len(cloud) for cloud in sensor_clouds)
        if empty_count:
            empty_sensors.append(f"{sensor} has no point in {empty_count} of {len(sensor_clouds)}")
    if not empty_sensors:
        return None
    return (
        f"{', '.join(empty_sensors)} frames that were checked: it counts as blind there; if it was off, measure frames "
        "in which it was on, or exclude it (--sensors)"
    )


def check_missing_labels(recording: Recording, num_frames: int) -> str | None:
    """Check whether a recording with labels has none in any frame; a complete one of torchcover may have none.

    Args:
        recording: The recording.
        num_frames: Number of frames that will be measured.

    Returns:
        A message with the remedy; None if there are labels, or the recording is not labeled.
    """
    try:
        positions = _spread_indices(num_frames, PARAMS.num_label_frames)
        labels = [recording.read_boxes(recording.key_frames[position]) for position in positions]
    except (OSError, ValueError):
        return None
    is_complete = recording.path.is_dir() and read_complete_manifest(recording.path) is not None
    if not labels or is_complete or any(boxes is None or len(boxes) for boxes in labels):
        return None
    return f"it has labels, and none in {len(labels)} frames: do their names and times match those of its clouds?"


def check_stationary_vehicle(
    recording: Recording, reference: AccumulatedReference, evaluated_sensors: Sequence[str], num_frames: int
) -> str | None:
    """Check whether accumulation windows contain too few frames, or too little motion.

    Args:
        recording: The recording.
        reference: Its accumulated reference.
        evaluated_sensors: Names of the evaluated sensors.
        num_frames: Number of frames that will be measured.

    Returns:
        A message with the remedy; None if the windows are large enough.
    """
    times_s = recording.times_s
    if times_s is None or not len(times_s) or not reference.window_s:
        return None
    duration_s = float(times_s[-1] - times_s[0])
    interval_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0
    if interval_s > reference.window_s / 2:
        return (
            f"its frames are {interval_s:g} s apart, and a window of {reference.window_s:g} s contains only one: are "
            "the times in seconds? If so, take a longer window (--set recording.window_s=SECONDS)"
        )
    frames = list(recording.key_frames)[:num_frames]
    stationary_count = sum(reference.is_stationary(recording, frame, evaluated_sensors) for frame in frames)
    effect = "so there is no coverage" if stationary_count == len(frames) else "which do not count"
    stationary = (
        f"the vehicle moves less than {reference.min_motion_m:g} m within {reference.window_s:g} s in "
        f"{stationary_count} of {len(frames)} frames, {effect}"
    )
    if duration_s < reference.window_s / 2:
        return (
            f"it lasts {duration_s:.3g} s, {len(times_s)} frames, and its reference is accumulated over "
            f"{reference.window_s:g} s: {stationary if stationary_count else 'numbers are far too good'}; give a "
            "longer recording"
        )
    if not stationary_count:
        return None
    return (
        f"{stationary}: its own scans add little to that of the frame itself; measure frames in which it moves, use "
        "another sensor as the reference, or a longer window (--set recording.window_s=SECONDS)"
    )


@dataclass(frozen=True)
class CheckedFrame:
    """Frame whose clouds are checked.

    Args:
        clouds: Name of each sensor -> its (N, 3) points in the vehicle frame.
        boxes: Labeled boxes; None if the frame is not labeled.
    """

    clouds: dict[str, Cloud]
    boxes: Boxes | None

    def join_clouds(self, sensors: Sequence[str]) -> Cloud:
        """Join the clouds of sensors to (N, 3) points.

        Args:
            sensors: Names of the sensors.
        """
        return np.concatenate([np.empty((0, 3), np.float32), *(self.clouds[sensor] for sensor in sensors)])


def _read_frames(recording: Recording, sensors: Sequence[str], num_frames: int) -> Iterator[CheckedFrame]:
    for position in _spread_indices(num_frames, PARAMS.num_frames):
        frame = recording.key_frames[position]
        clouds: dict[str, Cloud] = {}
        try:
            for sensor in sensors:
                scan = recording.read_scan(sensor, frame)
                clouds[sensor] = transform_to_vehicle(scan, recording.ego_box).points_m
            yield CheckedFrame(clouds, recording.read_boxes(frame))
        except (OSError, ValueError):
            continue


def _count_points_in_boxes(points_m: Cloud, boxes: Boxes) -> torch.Tensor:
    return torch.bincount(find_points_in_boxes(torch.from_numpy(points_m), boxes).box_indices, minlength=len(boxes))


def _spread_indices(count: int, max_indices: int) -> list[int]:
    """Spread at most `max_indices` indices below `count`, from the first to the last."""
    if not count:
        return []
    indices: list[int] = np.unique(np.linspace(0, count - 1, min(count, max_indices)).round().astype(int)).tolist()
    return indices
