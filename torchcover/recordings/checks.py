"""Check a recording before it is measured: ten faults that would otherwise give an ordinary table.

Each check looks at a few frames, and names the remedy. Nothing is corrected unless a user asks for it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

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
        num_frames: Frames whose clouds are looked at, evenly spread.
        num_label_frames: Frames whose labels are counted, evenly spread.
        max_median_range_m: Half of the points of a LiDAR are nearer; else the unit is not meters.
        max_median_range_cm: Above this median range the unit is millimeters rather than centimeters.
        ground_radius_m: Ground is searched around the vehicle within this distance.
        max_ground_offset_m: Half of the lowest height band; ground beyond is in another band.
        max_identical_distance_m: Points nearer than this are the same point.
        min_cloud_points: Smaller clouds may be alike by chance.
        num_identical_queries: Points that are compared, sampled at random.
        max_box_range_m: Boxes of nearer objects have points.
        box_bottom_margin_m: Height at the foot of a box that may be ground.
        min_box_points: Points that a box needs to decide about mirrored axes.
        min_point_count_ratio: A box is fuller one way if it has this many times the points of the other way.
        min_mirrored_boxes: Boxes that have to be fuller mirrored.
        min_mirrored_ratio: Mirrored boxes have to be this many times those that are right.
        min_mirrored_share: Share of all boxes that have to be fuller mirrored.
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
    recording: Recording, reference: Reference, rigs: Mapping[str, Sequence[str]], num_frames: int
) -> list[str]:
    """Return a sentence with the remedy for each fault of a recording.

    A frame that cannot be read is skipped; measuring it reports it.

    Args:
        recording: The recording.
        reference: The source of its reference clouds.
        rigs: Name of each rig -> its sensors.
        num_frames: How many of its frames will be measured, from the first on.
    """
    judged = tuple(dict.fromkeys(sensor for sensors in rigs.values() for sensor in sensors))
    if num_frames and (fault := check_units(recording, judged[0])) is not None:
        return [f"{recording.path}: {fault}"]
    recorded = recording.reference_sensors if isinstance(reference, RecordedReference) else ()
    frames = list(_read_frames(recording, tuple(dict.fromkeys((*judged, *recorded))), num_frames))
    clouds = {sensor: [frame.clouds[sensor] for frame in frames] for sensor in (*judged, *recorded)}
    widest = max(judged, key=lambda sensor: sum(map(len, clouds[sensor])))
    faults = [
        check_ground_offset(clouds),
        *(check_mirrored_axis(sensor, frames) for sensor in clouds),
        *(check_identical_clouds(rig, sensors, recorded, frames) for rig, sensors in rigs.items()),
        check_empty_clouds(clouds),
        check_missing_labels(recording, num_frames),
    ]
    stretches = list(read_pose_segments(recording, num_frames))
    pose_fault = check_frozen_poses(stretches) or check_pose_conventions(recording, stretches, widest)
    faults.append(pose_fault or check_pose_discontinuities(recording, stretches))
    if isinstance(reference, AccumulatedReference):
        faults.append(check_stationary_vehicle(recording, reference, judged, num_frames))
    return [f"{recording.path}: {fault}" for fault in faults if fault is not None]


def check_units(recording: Recording, sensor: str) -> str | None:
    """Check whether coordinates are too large for meters."""
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
    """Check whether the ground that sensors measure is far from z = 0."""
    offsets = []
    for sensor, sensor_clouds in clouds.items():
        heights_m = [estimate_ground_height(cloud) for cloud in sensor_clouds]
        known_m = [height_m for height_m in heights_m if height_m is not None]
        height_m = float(np.median(known_m)) if known_m else 0.0
        if abs(height_m) > PARAMS.max_ground_offset_m:
            offsets.append(f"{height_m:+.1f} m ({sensor})")
    if not offsets:
        return None
    return (
        f"the ground lies at z = {', '.join(offsets)}, not near 0: give the pose of the sensor in the vehicle frame, "
        "whose origin is on the ground (vehicle_T_sensor)"
    )


def estimate_ground_height(points_m: NDArray[np.floating]) -> float | None:
    """Estimate the height in m of the ground below the origin; None where no ground is measured near it."""
    near_m = points_m[(np.abs(points_m) < PARAMS.ground_radius_m).all(axis=1)].astype(np.float64)
    origin_m = np.zeros((1, 3))
    ground = GroundModel.from_surfaces([extract_low_surfaces(near_m, origin_m[0])], origin_m[0])
    above_m = np.nan if ground is None else float(ground.compute_heights_m(origin_m)[0])
    return None if np.isnan(above_m) else -above_m


def check_mirrored_axis(sensor: str, frames: Sequence["CheckedFrame"]) -> str | None:
    """Check whether labeled boxes contain points only if left and right are exchanged."""
    num_boxes = fuller = fuller_mirrored = 0
    for frame in frames:
        if frame.boxes is None:
            continue
        is_near = torch.linalg.vector_norm(frame.boxes.center_m[:, :2], dim=1) < PARAMS.max_box_range_m
        rows = frame.boxes.rows[is_near].clone()
        rows[:, 2] += PARAMS.box_bottom_margin_m / 2
        rows[:, 5] -= PARAMS.box_bottom_margin_m
        boxes = Boxes.from_rows(rows[rows[:, 5] > 0])
        num_boxes += len(boxes)
        points_m = frame.clouds[sensor]
        counts = _count_in_boxes(points_m, boxes)
        mirrored = _count_in_boxes(points_m * np.array([1, -1, 1], np.float32), boxes)
        fuller += int((counts >= (PARAMS.min_point_count_ratio * mirrored).clamp(min=PARAMS.min_box_points)).sum())
        fuller_mirrored += int(
            (mirrored >= (PARAMS.min_point_count_ratio * counts).clamp(min=PARAMS.min_box_points)).sum()
        )
    needed = (PARAMS.min_mirrored_boxes, PARAMS.min_mirrored_ratio * fuller, PARAMS.min_mirrored_share * num_boxes)
    if fuller_mirrored < max(needed):
        return None
    return (
        f"{fuller_mirrored} of {num_boxes} labeled boxes contain points of {sensor} only if its left and right are "
        f"exchanged, and {fuller} as it is: mirror its y axis (flip_y), as for a left-handed simulator"
    )


def check_identical_clouds(
    rig_name: str, sensors: Sequence[str], reference_sensors: Sequence[str], frames: Sequence["CheckedFrame"]
) -> str | None:
    """Check whether all reference points are points of the rig: then every radius is 0 m."""
    compared = 0
    for frame in frames:
        reference_m, cloud_m = frame.join_clouds(reference_sensors), frame.join_clouds(sensors)
        if len(reference_m) < PARAMS.min_cloud_points:
            continue
        # Sampled at random: every n-th point may be one of the same laser.
        chosen = np.random.default_rng(0).integers(len(reference_m), size=PARAMS.num_identical_queries)
        query, points = torch.from_numpy(reference_m[chosen]), torch.from_numpy(cloud_m)
        if not bool(nearest(query, points, max_distance=PARAMS.max_identical_distance_m).distance.isfinite().all()):
            return None
        compared += 1
    if not compared:
        return None
    return (
        f"the reference points are those of the rig {rig_name} itself, so that it must look perfect: give another "
        "sensor as the reference, or accumulate one (--reference accumulated)"
    )


def check_empty_clouds(clouds: Mapping[str, Sequence[Cloud]]) -> str | None:
    """Check whether sensors have no point in some frames."""
    empty = {sensor: sum(not len(cloud) for cloud in frames) for sensor, frames in clouds.items()}
    silent = [f"{sensor} has no point in {count} of {len(clouds[sensor])}" for sensor, count in empty.items() if count]
    if not silent:
        return None
    return (
        f"{', '.join(silent)} frames that were looked at: it counts as blind there; if it was off, measure where it "
        "was on, or leave it out (--sensors)"
    )


def check_missing_labels(recording: Recording, num_frames: int) -> str | None:
    """Check whether a recording with labels has none in any frame; a complete one of torchcover may have none."""
    try:
        positions = _spread(num_frames, PARAMS.num_label_frames)
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
    """Check whether accumulation windows hold too little time, or too little motion of a rig's own reference."""
    times_s = recording.times_s
    if times_s is None or not len(times_s) or not reference.window_s:
        return None
    duration_s = float(times_s[-1] - times_s[0])
    interval_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0
    if interval_s > reference.window_s / 2:
        return (
            f"its instants are {interval_s:g} s apart, and a window of {reference.window_s:g} s holds one only: are "
            "the times in seconds? Else take a longer window (--set recording.window_s=SECONDS)"
        )
    frames = list(recording.key_frames)[:num_frames]
    standing = sum(reference.is_stationary(recording, frame, evaluated_sensors) for frame in frames)
    absent = "so there is no coverage" if standing == len(frames) else "which count nowhere"
    still = (
        f"the vehicle moves less than {reference.min_motion_m:g} m within {reference.window_s:g} s in {standing} of "
        f"{len(frames)} frames, {absent}"
    )
    if duration_s < reference.window_s / 2:
        return (
            f"it lasts {duration_s:.3g} s, {len(times_s)} instants, and its reference is accumulated over "
            f"{reference.window_s:g} s: {still if standing else 'numbers are far too good'}; give a longer drive"
        )
    if not standing:
        return None
    return (
        f"{still}: its own scans show little more than the frame itself; measure where it drives, against another "
        "sensor, or over a longer window (--set recording.window_s=SECONDS)"
    )


@dataclass(frozen=True)
class CheckedFrame:
    """One frame: name of each sensor -> its (N, 3) points in the vehicle frame; and the boxes, if it has labels."""

    clouds: dict[str, Cloud]
    boxes: Boxes | None

    def join_clouds(self, sensors: Sequence[str]) -> Cloud:
        """Join the clouds of some sensors to (N, 3) points."""
        return np.concatenate([np.empty((0, 3), np.float32), *(self.clouds[sensor] for sensor in sensors)])


def _read_frames(recording: Recording, sensors: Sequence[str], num_frames: int) -> Iterator[CheckedFrame]:
    for position in _spread(num_frames, PARAMS.num_frames):
        instant = recording.key_frames[position]
        try:
            clouds = {
                sensor: transform_to_vehicle(recording.read_scan(sensor, instant), recording.ego_box).points_m
                for sensor in sensors
            }
            yield CheckedFrame(clouds, recording.read_boxes(instant))
        except (OSError, ValueError):
            continue


def _count_in_boxes(points_m: Cloud, boxes: Boxes) -> torch.Tensor:
    return torch.bincount(find_points_in_boxes(torch.from_numpy(points_m), boxes).box_indices, minlength=len(boxes))


def _spread(count: int, maximum: int) -> list[int]:
    """At most `maximum` numbers below `count`, from the first to the last."""
    return np.unique(np.linspace(0, count - 1, min(count, maximum)).round().astype(int)).tolist() if count else []
