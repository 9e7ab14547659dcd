"""A log of Argoverse 2's sensor data set (Wilson et al., NeurIPS 2021): both LiDARs, poses and cuboids."""

import os
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from torchcover.cameras.calibration import Calibration
from torchcover.detection.boxes import Boxes
from torchcover.files import load_road_user_classes, report_bad_file
from torchcover.geometry import BoundingBox, build_transform, convert_quaternion_to_rotation, invert
from torchcover.geometry.rigid import Matrix
from torchcover.geometry.trajectory import Trajectory
from torchcover.recordings.isolated_readers import read_feather
from torchcover.recordings.objects import (
    Ego,
    ObjectInterpolator,
    ObjectState,
    RecordedObjects,
    build_track,
    group_by_name,
)
from torchcover.recordings.recording import (
    RecordingBase,
    Scan,
    SensorCalibrations,
    check_times,
    warn_about_missing_poses,
)

# The ego frame lies in the rear axle, 0.30 m above the ground; the centre of a Ford Fusion is 1.339 m before it, as in
# the rig `argoverse2`, where the source is.
vehicle_T_ego = build_transform(np.eye(3), [-1.339, 0.0, 0.30])
# As in the body `ford_fusion`, where its source is.
SIZE_M = (4.869, 1.852, 1.476)
POSE = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
CUBOIDS = ("timestamp_ns", "track_uuid", "category", "length_m", "width_m", "height_m", *POSE)
# Its outline is 4.87 x 1.85 m, and the LiDARs are up to 1.94 m high.
BODY = BoundingBox((-2.436, -0.926, 0.05), (2.436, 0.926, 2.14))
# Each has 32 lasers; `laser_number` counts on from the upper one.
LASERS = {"up_lidar": (0, 32), "down_lidar": (32, 64)}
SWEEPS = ("sensors", "lidar")
POSES = "city_SE3_egovehicle.feather"
ANNOTATIONS = ("annotations.feather", "annotations_with_ego.feather")
# Poses and sweeps have their times from one clock.
MAX_CLOCK_GAP_NS = 10_000_000
EGO_CATEGORY = "ego_vehicle"
# An annotation belongs to a sweep, and the poses are those of the sweeps and others.
MAX_ANNOTATION_GAP_S = 0.1


class Argoverse2(RecordingBase):
    """A folder with `sensors/lidar/TIME.feather`, `city_SE3_egovehicle.feather` and `annotations.feather`.

    The clouds are in the frame of the ego and corrected for its motion within a turn. Needs `torchcover[av2]`.

    Raises:
        FileNotFoundError: No sweeps, or no poses.
        ValueError: A table with other columns, or no sweep has a pose within 10 ms.
        ImportError: pyarrow is not installed.

    Warns:
        UserWarning: Sweeps without a pose within 10 ms are left out.
    """

    layout: ClassVar[str] = "sensors/lidar/TIME.feather, city_SE3_egovehicle.feather"
    sensors = tuple(LASERS)
    ego_box: BoundingBox | None = BODY

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._files = sorted(self.path.joinpath(*SWEEPS).glob("*.feather"), key=_time_ns)
        if not self._files:
            raise FileNotFoundError(f"{self.path.joinpath(*SWEEPS)}: no sweeps TIME.feather in it")
        self.rigs = {"argoverse2": self.sensors}
        self._poses, has_pose = self._read_poses(np.array([_time_ns(file) for file in self._files]))
        missing = [file.stem for file, posed in zip(self._files, has_pose, strict=True) if not posed]
        warn_about_missing_poses(self.path / POSES, missing, len(self._files))
        self._files = [file for file, posed in zip(self._files, has_pose, strict=True) if posed]
        self._times_ns = np.array([_time_ns(file) for file in self._files])
        self.frame_names = tuple(file.stem for file in self._files)
        self.times_s = check_times(self._times_ns * 1e-9, len(self.frame_names), str(self.path.joinpath(*SWEEPS)))

    @property
    def vehicle_classes(self) -> Mapping[str, str]:
        """By the words of the data set."""
        return load_road_user_classes()["argoverse2"]

    @classmethod
    def can_read(cls, path: Path) -> bool:
        """Whether it has sweeps and poses."""
        return path.joinpath(*SWEEPS).is_dir() and (path / POSES).exists()

    def read_scan(self, sensor: str, index: int) -> Scan:
        """The points of one LiDAR in a sweep."""
        columns = read_feather(self._files[index], ("x", "y", "z", "laser_number", "offset_ns"))
        low, high = LASERS[sensor]
        laser = columns["laser_number"]
        own = (laser >= low) & (laser < high)
        points_m = np.column_stack([columns[axis][own].astype(np.float32) for axis in "xyz"])
        offsets_s = columns["offset_ns"][own] * 1e-9
        return Scan(points_m, vehicle_T_ego, str(self._files[index]), rings=laser[own], offsets_s=offsets_s)

    def get_world_T_vehicle(self, index: int) -> Matrix:
        """The pose of the ego in the city."""
        return np.asarray(self._poses[index] @ invert(vehicle_T_ego))

    def read_boxes(self, index: int) -> Boxes | None:
        """The cuboids of that sweep; None without the file."""
        if self._tracks is None:
            return None
        return self._tracks.interpolate_boxes(float(self._times_ns[index] - self._times_ns[0]) * 1e-9, vehicle_T_ego)

    def read_calibrations(self) -> SensorCalibrations:
        """Read the mounts of both LiDARs, and the cameras: pinholes, for released images are undistorted."""
        mounts, cameras = self._calibrations()
        return SensorCalibrations("calibration/", mounts, tuple(replace(one, **_PINHOLE) for one in cameras))

    def read_raw_cameras(self) -> tuple[Calibration, ...]:
        """Read the cameras with the distortion of their lenses, which the released images no longer have."""
        return self._calibrations()[1]

    def _calibrations(self) -> tuple[dict[str, Matrix], tuple[Calibration, ...]]:
        """Return the mounts of the LiDARs, and the cameras with distortion."""
        folder = self.path / "calibration"
        poses = read_feather(folder / "egovehicle_SE3_sensor.feather", ("sensor_name", *POSE))
        lenses = read_feather(folder / "intrinsics.feather", ("sensor_name", *_LENS))
        with report_bad_file(folder, "calibrations of Argoverse 2"):
            ego_T = {str(name): pose for name, pose in zip(poses["sensor_name"], build_poses(poses), strict=True)}
            missing = ({*LASERS} | {str(name) for name in lenses["sensor_name"]}) - ego_T.keys()
            if missing:
                raise ValueError(f"egovehicle_SE3_sensor.feather has no {', '.join(sorted(missing))}")
            rows = [dict(zip(lenses, row, strict=True)) for row in zip(*lenses.values(), strict=True)]
            cameras = tuple(_camera(row, vehicle_T_ego @ ego_T[str(row["sensor_name"])]) for row in rows)
        return {name: vehicle_T_ego @ ego_T[name] for name in LASERS}, cameras

    @cached_property
    def _tracks(self) -> ObjectInterpolator | None:
        """The cuboids of each sweep, in the frame of the ego at that time."""
        path = self.path / ANNOTATIONS[0]
        if not path.exists():
            return None
        return ObjectInterpolator(_seen(read_feather(path, CUBOIDS), int(self._times_ns[0])), max_gap_s=0.0)

    def _read_poses(self, sweeps_ns: NDArray[np.int64]) -> tuple[Matrix, NDArray[np.bool_]]:
        """Return (M, 4, 4) poses of the sweeps that have one near their (N,) times, and the (N,) mask of these."""
        columns = read_feather(self.path / POSES, ("timestamp_ns", *POSE))
        times_ns = columns["timestamp_ns"].astype(np.int64)
        order = np.argsort(times_ns, kind="stable")
        after = np.searchsorted(times_ns[order], sweeps_ns).clip(1, len(order) - 1)
        before_is_nearer = sweeps_ns - times_ns[order[after - 1]] < times_ns[order[after]] - sweeps_ns
        nearest = order[after - before_is_nearer]
        has_pose = np.abs(times_ns[nearest] - sweeps_ns) <= MAX_CLOCK_GAP_NS
        return build_poses({name: column[nearest[has_pose]] for name, column in columns.items()}), has_pose


def has_objects(path: Path) -> bool:
    """Whether it is a log with annotations, be there sweeps or not."""
    return any((path / name).exists() for name in ANNOTATIONS)


def read_objects(path: Path) -> RecordedObjects:
    """Read the cuboids of a log and the drive of its ego, at times after the first pose.

    Raises:
        BadFileError: Tables of another content.
        FileNotFoundError: No poses.
        ImportError: pyarrow is not installed.
    """
    annotations = next(path / name for name in ANNOTATIONS if (path / name).exists())
    cuboids, poses = read_feather(annotations, CUBOIDS), read_feather(path / POSES, ("timestamp_ns", *POSE))
    with report_bad_file(path / POSES, "poses of Argoverse 2"):
        origin_ns = int(poses["timestamp_ns"].min())
        ego_s = _seconds(poses, origin_ns)
        order = np.argsort(ego_s, kind="stable")
        world_T_driven = build_poses(poses)[order]
        drive = Trajectory.from_poses(ego_s[order], world_T_driven)
    with report_bad_file(annotations, "cuboids of Argoverse 2"):
        times_s = _seconds(cuboids, origin_ns)
        if (
            times_s.min() < drive.times_s[0] - MAX_ANNOTATION_GAP_S
            or times_s.max() > drive.times_s[-1] + MAX_ANNOTATION_GAP_S
        ):
            raise ValueError(
                f"its times lie {times_s.min():g} to {times_s.max():g} s after the first pose of {POSES}, and the last "
                f"pose is at {drive.times_s[-1]:g} s: are both of one log?"
            )
        world_T_ego = {time_s: drive.interpolate(time_s) for time_s in np.unique(times_s).tolist()}
        classes = load_road_user_classes()["argoverse2"]
        tracks = tuple(
            build_track(seen, classes.get(seen[0].category), np.stack([world_T_ego[one.time_s] for one in seen]))
            for seen in group_by_name(_seen(cuboids, origin_ns)).values()
            if seen[0].category != EGO_CATEGORY
        )
    return RecordedObjects(tracks, (Ego("ego", drive.times_s, world_T_driven, invert(vehicle_T_ego), SIZE_M),))


def _seen(columns: Mapping[str, NDArray[Any]], origin_ns: int) -> list[ObjectState]:
    """The cuboids, in the frame of the ego at their times, which are after an origin."""
    sizes_m = zip(*(columns[name].tolist() for name in CUBOIDS[3:6]), strict=True)
    times_s, poses = _seconds(columns, origin_ns).tolist(), build_poses(columns)
    rows = zip(columns["track_uuid"], columns["category"], times_s, poses, sizes_m, strict=True)
    return [
        ObjectState(str(name), time_s, pose, size_m, str(what).lower()) for name, what, time_s, pose, size_m in rows
    ]


def _seconds(columns: Mapping[str, NDArray[Any]], origin_ns: int) -> Matrix:
    return np.asarray((columns["timestamp_ns"].astype(np.int64) - origin_ns) * 1e-9, dtype=np.float64)


def build_poses(columns: Mapping[str, NDArray[Any]]) -> Matrix:
    """(N, 4, 4) of the rows of a table with the columns `POSE`."""
    rotations = np.column_stack([columns[name] for name in POSE[:4]])
    places = np.column_stack([columns[name] for name in POSE[4:]])
    return build_transform(convert_quaternion_to_rotation(rotations), places)


_PINHOLE: dict[str, Any] = {"model": "pinhole", "coefficients": ()}
_LENS = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "height_px", "width_px")


def _camera(row: Mapping[str, Any], vehicle_T_camera: Matrix) -> Calibration:
    fx, fy, cx, cy, k1, k2, k3 = (float(row[name]) for name in _LENS[:7])
    return Calibration(
        int(row["width_px"]),
        int(row["height_px"]),
        *(fx, fy, cx, cy),
        model="brown_conrady",
        coefficients=(k1, k2, 0.0, 0.0, k3),
        vehicle_T_camera=vehicle_T_camera,
        name=str(row["sensor_name"]),
    )


def _time_ns(path: Path) -> int:
    if not path.stem.isdecimal():
        raise ValueError(f"{path}: the name of a sweep is its time in nanoseconds")
    return int(path.stem)
