"""Argoverse 2 sensor data set (Wilson et al., NeurIPS 2021): logs with two LiDARs, poses and cuboids."""

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
from torchcover.recordings.formats.frame_files import stack_columns
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
    Recording,
    Scan,
    SensorCalibrations,
    check_times,
    warn_about_missing_poses,
)

# The ego frame is at the rear axle, 0.30 m above the ground; the center of a Ford Fusion is 1.339 m in front of it. The
# rig `argoverse2` names the source.
vehicle_T_ego = build_transform(np.eye(3), [-1.339, 0.0, 0.30])
# Columns of tables with poses and with cuboids.
POSE_COLUMNS = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
SIZE_COLUMNS = ("length_m", "width_m", "height_m")
CUBOID_COLUMNS = ("timestamp_ns", "track_uuid", "category", *SIZE_COLUMNS, *POSE_COLUMNS)
# Each LiDAR has 32 lasers; `laser_number` counts through both of them.
LASERS = {"up_lidar": (0, 32), "down_lidar": (32, 64)}
# Tables of a log; the second kind of annotations also holds the ego vehicle.
POSES_FILE = "city_SE3_egovehicle.feather"
ANNOTATION_FILES = ("annotations.feather", "annotations_with_ego.feather")


class Argoverse2(Recording):
    """Log with `sensors/lidar/TIME.feather`, `city_SE3_egovehicle.feather` and optional `annotations.feather`.

    Clouds are motion-compensated and in the ego frame. Needs `torchcover[av2]`.

    Args:
        path: Folder of the log.

    Raises:
        FileNotFoundError: Sweeps or poses are missing.
        ValueError: A table has other columns, or no sweep has a pose within 10 ms.
        ImportError: pyarrow is not installed.

    Warns:
        UserWarning: Sweeps without a pose within 10 ms are excluded.
    """

    layout: ClassVar[str] = "sensors/lidar/TIME.feather, city_SE3_egovehicle.feather"
    sensors = tuple(LASERS)
    # Outline of 4.87 x 1.85 m, up to above the LiDARs, which are 1.94 m high.
    ego_box: BoundingBox | None = BoundingBox((-2.436, -0.926, 0.05), (2.436, 0.926, 2.14))

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        sweeps = self.path / "sensors" / "lidar"
        files = sorted(sweeps.glob("*.feather"), key=_parse_time_ns)
        if not files:
            raise FileNotFoundError(f"{sweeps}: no sweeps TIME.feather in it")
        self.rigs = {"argoverse2": self.sensors}
        times_ns = np.array([_parse_time_ns(file) for file in files])
        self._poses, has_pose = self._read_poses(times_ns)
        names = np.array([file.stem for file in files])
        warn_about_missing_poses(self.path / POSES_FILE, names[~has_pose].tolist(), len(files))
        self._files, self._times_ns = np.array(files)[has_pose].tolist(), times_ns[has_pose]
        self.frame_names = tuple(names[has_pose].tolist())
        self.times_s = check_times(self._times_ns * 1e-9, len(self.frame_names), str(sweeps))

    @property
    def vehicle_classes(self) -> Mapping[str, str]:
        """SUMO's vehicle class of each category of the data set."""
        return load_road_user_classes()["argoverse2"]

    @classmethod
    def can_read(cls, path: Path) -> bool:
        """Test whether a path is a folder with sweeps and poses.

        Args:
            path: Existing path.
        """
        return (path / "sensors" / "lidar").is_dir() and (path / POSES_FILE).exists()

    def read_scan(self, sensor: str, index: int) -> Scan:
        """Read the points of one LiDAR from a sweep.

        Args:
            sensor: Name of the LiDAR.
            index: Index of the frame.

        Returns:
            The scan with rings and time offsets.
        """
        columns = read_feather(self._files[index], ("x", "y", "z", "laser_number", "offset_ns"))
        low, high = LASERS[sensor]
        laser = columns["laser_number"]
        mask = (laser >= low) & (laser < high)
        points_m = np.column_stack([columns[axis][mask].astype(np.float32) for axis in "xyz"])
        offsets_s = columns["offset_ns"][mask] * 1e-9
        return Scan(points_m, vehicle_T_ego, str(self._files[index]), rings=laser[mask], offsets_s=offsets_s)

    def get_world_T_vehicle(self, index: int) -> Matrix:
        """Return the (4, 4) pose of the vehicle in the city frame."""
        return np.asarray(self._poses[index] @ invert(vehicle_T_ego))

    def read_boxes(self, index: int) -> Boxes | None:
        """Read the cuboids of a sweep; None without annotations."""
        if self._interpolator is None:
            return None
        return self._interpolator.interpolate_boxes(
            float(self._times_ns[index] - self._times_ns[0]) * 1e-9, vehicle_T_ego
        )

    def read_calibrations(self) -> SensorCalibrations:
        """Read the extrinsics of both LiDARs and the cameras, which are pinholes as the released images."""
        mounts, cameras = self._read_sensor_tables()
        pinholes = [replace(camera, model="pinhole", coefficients=()) for camera in cameras]
        return SensorCalibrations("calibration/", mounts, tuple(pinholes))

    def read_raw_cameras(self) -> tuple[Calibration, ...]:
        """Read the cameras with their distortion, which the released images do not have."""
        return self._read_sensor_tables()[1]

    def _read_sensor_tables(self) -> tuple[dict[str, Matrix], tuple[Calibration, ...]]:
        """Read the extrinsics of the LiDARs and the cameras with distortion."""
        folder = self.path / "calibration"
        poses = read_feather(folder / "egovehicle_SE3_sensor.feather", ("sensor_name", *POSE_COLUMNS))
        lens_columns = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "height_px", "width_px")
        lenses = read_feather(folder / "intrinsics.feather", ("sensor_name", *lens_columns))
        with report_bad_file(folder, "calibrations of Argoverse 2"):
            ego_T = {str(name): pose for name, pose in zip(poses["sensor_name"], build_poses(poses), strict=True)}
            missing = ({*LASERS} | {str(name) for name in lenses["sensor_name"]}) - ego_T.keys()
            if missing:
                raise ValueError(f"egovehicle_SE3_sensor.feather has no {', '.join(sorted(missing))}")
            cameras = []
            for values in zip(*lenses.values(), strict=True):
                row = dict(zip(lenses, values, strict=True))
                fx, fy, cx, cy, k1, k2, k3 = (float(row[name]) for name in lens_columns[:7])
                cameras.append(
                    Calibration(
                        int(row["width_px"]),
                        int(row["height_px"]),
                        *(fx, fy, cx, cy),
                        model="brown_conrady",
                        coefficients=(k1, k2, 0.0, 0.0, k3),
                        vehicle_T_camera=vehicle_T_ego @ ego_T[str(row["sensor_name"])],
                        name=str(row["sensor_name"]),
                    )
                )
        return {name: vehicle_T_ego @ ego_T[name] for name in LASERS}, tuple(cameras)

    @cached_property
    def _interpolator(self) -> ObjectInterpolator | None:
        """Cuboids of each sweep, in the ego frame at that time; None without annotations."""
        path = self.path / ANNOTATION_FILES[0]
        if not path.exists():
            return None
        states = _build_states(read_feather(path, CUBOID_COLUMNS), int(self._times_ns[0]))
        return ObjectInterpolator(states, max_gap_s=0.0)

    def _read_poses(self, sweeps_ns: NDArray[np.int64]) -> tuple[Matrix, NDArray[np.bool_]]:
        """Read (M, 4, 4) poses of the sweeps that have one near their (N,) times, and the (N,) mask of these sweeps."""
        max_gap_ns = 10_000_000  # times of poses and sweeps are from one clock
        columns = read_feather(self.path / POSES_FILE, ("timestamp_ns", *POSE_COLUMNS))
        times_ns = columns["timestamp_ns"].astype(np.int64)
        order = np.argsort(times_ns, kind="stable")
        after = np.searchsorted(times_ns[order], sweeps_ns).clip(1, len(order) - 1)
        is_before_nearer = sweeps_ns - times_ns[order[after - 1]] < times_ns[order[after]] - sweeps_ns
        nearest = order[after - is_before_nearer]
        has_pose = np.abs(times_ns[nearest] - sweeps_ns) <= max_gap_ns
        return build_poses({name: column[nearest[has_pose]] for name, column in columns.items()}), has_pose


def has_objects(path: Path) -> bool:
    """Test whether a path is a log with annotations, with or without sweeps.

    Args:
        path: Existing path.
    """
    return any((path / name).exists() for name in ANNOTATION_FILES)


def read_objects(path: Path) -> RecordedObjects:
    """Read the cuboids of a log and the drive of its ego vehicle.

    Args:
        path: Folder of the log.

    Returns:
        Tracks and the ego vehicle, with times relative to the first pose.

    Raises:
        BadFileError: A table has another content.
        FileNotFoundError: Poses are missing.
        ImportError: pyarrow is not installed.
    """
    max_gap_s = 0.1  # annotations belong to sweeps, and poses cover all sweeps
    annotations = next(path / name for name in ANNOTATION_FILES if (path / name).exists())
    cuboids = read_feather(annotations, CUBOID_COLUMNS)
    poses = read_feather(path / POSES_FILE, ("timestamp_ns", *POSE_COLUMNS))
    with report_bad_file(path / POSES_FILE, "poses of Argoverse 2"):
        origin_ns = int(poses["timestamp_ns"].min())
        ego_s = _to_seconds(poses, origin_ns)
        order = np.argsort(ego_s, kind="stable")
        world_T_ego = build_poses(poses)[order]
        drive = Trajectory.from_poses(ego_s[order], world_T_ego)
    with report_bad_file(annotations, "cuboids of Argoverse 2"):
        times_s = _to_seconds(cuboids, origin_ns)
        if times_s.min() < drive.times_s[0] - max_gap_s or times_s.max() > drive.times_s[-1] + max_gap_s:
            raise ValueError(
                f"its times lie {times_s.min():g} to {times_s.max():g} s after the first pose of {POSES_FILE}, and the "
                f"last pose is at {drive.times_s[-1]:g} s: are both of one log?"
            )
        pose_by_time = {time_s: drive.interpolate(time_s) for time_s in np.unique(times_s).tolist()}
        classes = load_road_user_classes()["argoverse2"]
        tracks = []
        for states in group_by_name(_build_states(cuboids, origin_ns)).values():
            category = states[0].category
            if category != "ego_vehicle":
                world_T_source = np.stack([pose_by_time[state.time_s] for state in states])
                tracks.append(build_track(states, classes.get(category), world_T_source))
    size_m = (4.869, 1.852, 1.476)  # as in the body `ford_fusion`, which names the source
    return RecordedObjects(tuple(tracks), (Ego("ego", drive.times_s, world_T_ego, invert(vehicle_T_ego), size_m),))


def _build_states(columns: Mapping[str, NDArray[Any]], origin_ns: int) -> list[ObjectState]:
    """Build the states of cuboids in the ego frame at their times, relative to an origin."""
    times_s, poses = _to_seconds(columns, origin_ns).tolist(), build_poses(columns)
    sizes_m = stack_columns(columns, SIZE_COLUMNS).tolist()
    rows = zip(columns["track_uuid"], columns["category"], times_s, poses, sizes_m, strict=True)
    states = []
    for name, category, time_s, pose, size_m in rows:
        states.append(ObjectState(str(name), time_s, pose, tuple(size_m), str(category).lower()))
    return states


def _to_seconds(columns: Mapping[str, NDArray[Any]], origin_ns: int) -> Matrix:
    """Convert time stamps to seconds after an origin."""
    return np.asarray((columns["timestamp_ns"].astype(np.int64) - origin_ns) * 1e-9, dtype=np.float64)


def build_poses(columns: Mapping[str, NDArray[Any]]) -> Matrix:
    """Build the poses of the rows of a table.

    Args:
        columns: Columns by name, among them `POSE_COLUMNS`.

    Returns:
        (N, 4, 4) transforms.
    """
    quaternions, positions_m = stack_columns(columns, POSE_COLUMNS[:4]), stack_columns(columns, POSE_COLUMNS[4:])
    return build_transform(convert_quaternion_to_rotation(quaternions), positions_m)


def _parse_time_ns(path: Path) -> int:
    """Parse the time in the name of a sweep."""
    if not path.stem.isdecimal():
        raise ValueError(f"{path}: the name of a sweep is its time in nanoseconds")
    return int(path.stem)
