"""nuScenes data set (Caesar et al., CVPR 2020): sweeps and key frames of the roof LiDAR, and annotations."""

import os
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from operator import itemgetter
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from torchcover.cameras.calibration import read_nuscenes
from torchcover.cameras.calibration_values import describe_value
from torchcover.detection.boxes import Boxes
from torchcover.files import load_road_user_classes, read_json_table, report_bad_file
from torchcover.geometry import BoundingBox, build_transform, convert_quaternion_to_rotation, invert
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.clouds.arrays import read_cloud_with_rings
from torchcover.recordings.objects import (
    Ego,
    ObjectInterpolator,
    ObjectState,
    RecordedObjects,
    build_track,
    group_by_name,
)
from torchcover.recordings.recording import Recording, Scan, SensorCalibrations, check_times

# The ego frame is on the ground below the rear axle; the center of a Renault Zoe is 1.385 m in front of it. The rig
# `nuscenes` names the source.
vehicle_T_ego = build_transform(np.eye(3), [-1.385, 0.0, 0.0])
# Sensor channel of the only LiDAR.
CHANNEL = "LIDAR_TOP"


class NuScenes(Recording):
    """Data set with `v1.0-*/` tables, `samples/` and `sweeps/`; other sweeps only contribute to the reference.

    Args:
        path: Data set, or its folder of tables.

    Raises:
        FileNotFoundError: A table is missing.
        ValueError: A table is invalid, a token is unknown, a path leaves the data set, or no key frame exists.
    """

    layout: ClassVar[str] = "v1.0-*/*.json, samples/LIDAR_TOP, sweeps/LIDAR_TOP"
    times_s: NDArray[np.float64]
    sensors = (CHANNEL,)
    # Outline of 4.08 x 1.73 m, up to a little above the LiDAR.
    ego_box: BoundingBox | None = BoundingBox((-2.042, -0.865, 0.05), (2.042, 0.865, 2.04))

    def __init__(self, path: str | os.PathLike[str]) -> None:
        tables = _find_tables(Path(path))
        self.path = tables.parent
        self.rigs = {"nuscenes": self.sensors}
        with report_bad_file(tables, "tables of nuScenes"):  # rows may lack a column or have invalid numbers
            self._read_tables(tables)

    @classmethod
    def can_read(cls, path: Path) -> bool:
        """Test whether a path is a folder with tables of samples.

        Args:
            path: Existing path.
        """
        return path.is_dir() and bool(_find_folders_with_table("sample_data", path))

    def read_scan(self, sensor: str, index: int) -> Scan:
        """Read a sweep of the LiDAR.

        Args:
            sensor: Name of the LiDAR.
            index: Index of the frame.

        Returns:
            The scan with rings.
        """
        path = self.path / self._files[index]
        points_m, rings = read_cloud_with_rings(path)
        return Scan(points_m, vehicle_T_ego @ self._mounts[index], str(path), rings=rings)

    def get_world_T_vehicle(self, index: int) -> Matrix:
        """Return the (4, 4) pose of the vehicle at the time of a sweep."""
        world_T_ego = build_transform(convert_quaternion_to_rotation(self._rotations[index]), self._positions_m[index])
        return world_T_ego @ invert(vehicle_T_ego)

    def read_boxes(self, index: int) -> Boxes:
        """Read the annotations of a key frame, or interpolate them between two key frames."""
        return self._interpolator.interpolate_boxes(float(self.times_s[index]), invert(self.get_world_T_vehicle(index)))

    def read_calibrations(self) -> SensorCalibrations:
        """Read the extrinsics of the LiDAR and the cameras of its first key frame."""
        with report_bad_file(self._tables, "tables of nuScenes"):
            rows = {}
            for row in read_json_table(self._tables / "sample_data.json").rows:
                is_in_frame = row["sample_token"] == self._sample_token and row["is_key_frame"]
                if is_in_frame and "/CAM_" in str(row["filename"]):
                    rows[str(row["filename"])] = row
            cameras = []
            for _, row in sorted(rows.items()):
                camera = read_nuscenes(
                    self._tables,
                    Path(row["filename"]).parent.name,
                    token=row["calibrated_sensor_token"],
                    width=row["width"],
                    height=row["height"],
                )
                vehicle_T_camera = vehicle_T_ego @ np.asarray(camera.vehicle_T_camera)
                cameras.append(replace(camera, vehicle_T_camera=vehicle_T_camera))
        source = f"calibrated_sensor.json for {self.frame_names[self.key_frames[0]]}"
        return SensorCalibrations(source, {CHANNEL: vehicle_T_ego @ self._mounts[self.key_frames[0]]}, tuple(cameras))

    def _read_tables(self, tables: Path) -> None:
        """Read names, times, poses and extrinsics of all sweeps."""
        scene_tokens = {row["token"] for row in read_json_table(tables / "scene.json").rows}
        samples = {}
        for row in read_json_table(tables / "sample.json").rows:
            if row["scene_token"] in scene_tokens:
                samples[row["token"]] = row["timestamp"] * 1e-6
        poses = read_json_table(tables / "ego_pose.json")
        calibrations = read_json_table(tables / "calibrated_sensor.json")
        data = []
        for row in read_json_table(tables / "sample_data.json").rows:
            if f"/{CHANNEL}/" in str(row["filename"]) and row["sample_token"] in samples:
                data.append(row)
        data.sort(key=itemgetter("timestamp"))
        self.key_frames = [index for index, row in enumerate(data) if row["is_key_frame"]]
        if not self.key_frames:
            raise ValueError(f"no key frame of {CHANNEL}")
        self.times_s = check_times(np.array([row["timestamp"] for row in data]) * 1e-6, len(data), CHANNEL)
        self._files, self._mounts, names, rotations, positions_m = list[str](), list[Matrix](), [], [], []
        mounts: dict[str, Matrix] = {}
        for row in data:
            names.append(row["filename"].rpartition("/")[2].removesuffix(".pcd.bin"))
            self._files.append(check_path_within(self.path, row["filename"]))
            pose, token = poses.get_row(row["ego_pose_token"]), row["calibrated_sensor_token"]
            rotations.append(pose["rotation"])
            positions_m.append(pose["translation"])
            if token not in mounts:
                mounts[token] = parse_pose(calibrations.get_row(token))
            self._mounts.append(mounts[token])
        self.frame_names = tuple(names)
        self._rotations = np.array(rotations, dtype=np.float64)
        self._positions_m = np.array(positions_m, dtype=np.float64)
        _check_poses(self._rotations, self._positions_m)
        self._sample_token = data[self.key_frames[0]]["sample_token"]
        self._tables, self._sample_times = tables, samples

    @cached_property
    def _interpolator(self) -> ObjectInterpolator:
        """Annotations of all key frames, read on first use."""
        with report_bad_file(self._tables, "annotations of nuScenes"):
            return ObjectInterpolator(_read_states(self._tables, self._sample_times))


def has_objects(path: Path) -> bool:
    """Test whether a path holds one folder of tables with annotations, with or without scans.

    Args:
        path: Existing path.
    """
    return path.is_dir() and len(_find_folders_with_table("sample_annotation", path)) == 1


def read_objects(path: Path, scene: str | None = None) -> RecordedObjects:
    """Read the annotations of one scene and the drive of its ego vehicle.

    Args:
        path: Data set, or its folder of tables.
        scene: Name or token of the scene; None if there is only one.

    Returns:
        Tracks and the ego vehicle, with times relative to the first sample.

    Raises:
        BadFileError: A table has another content, or the scene is ambiguous or unknown.
        FileNotFoundError: A table is missing.
    """
    (tables,) = _find_folders_with_table("sample_annotation", path)
    samples = read_json_table(tables / "sample.json").rows
    poses = read_json_table(tables / "ego_pose.json").rows
    with report_bad_file(tables, "tables of nuScenes"):
        scene_token = _find_scene_token(samples, tables / "scene.json", scene)
        times_us = {row["token"]: row["timestamp"] for row in samples if row["scene_token"] == scene_token}
        first_us, last_us = min(times_us.values()), max(times_us.values())
        times_s = {token: (time_us - first_us) * 1e-6 for token, time_us in times_us.items()}
        states_by_name = group_by_name(_read_states(tables, times_s))
        ego_rows = [row for row in poses if first_us <= row["timestamp"] <= last_us]
        ego_rows.sort(key=itemgetter("timestamp"))
        if not ego_rows:
            raise ValueError("no ego_pose from the first sample of the scene to the last")
        ego_s = np.array([(row["timestamp"] - first_us) * 1e-6 for row in ego_rows])
        world_T_ego = np.stack([parse_pose(row) for row in ego_rows])
        tracks = tuple(build_track(states, _find_class(states[0].category)) for states in states_by_name.values())
    size_m = (4.084, 1.730, 1.562)  # as in the body `renault_zoe`, which names the source
    return RecordedObjects(tracks, (Ego("ego", ego_s, world_T_ego, invert(vehicle_T_ego), size_m),))


def _read_states(tables: Path, times_s: Mapping[str, float]) -> list[ObjectState]:
    """Read the annotations of samples with known times, in the world frame."""
    categories, instances = read_json_table(tables / "category.json"), read_json_table(tables / "instance.json")
    visible_shares = {"1": 0.2, "2": 0.5, "3": 0.7, "4": 0.9}  # center of each visibility level, by its token
    states = []
    for row in read_json_table(tables / "sample_annotation.json").rows:
        if row["sample_token"] in times_s:
            width, length, height = _parse_size(row).tolist()
            name = row["instance_token"]
            category = str(categories.get_row(instances.get_row(name)["category_token"])["name"])
            world_T_box = build_transform(convert_quaternion_to_rotation(row["rotation"]), row["translation"])
            visibility = visible_shares.get(str(row.get("visibility_token")), np.nan)
            size_m = (length, width, height)
            states.append(ObjectState(name, times_s[row["sample_token"]], world_T_box, size_m, category, visibility))
    return states


def _parse_size(row: dict[str, Any]) -> NDArray[np.float64]:
    """Parse the width, length and height of an annotation; ValueError for anything but three finite numbers."""
    size_m = np.asarray(row["size"], dtype=np.float64)
    if size_m.shape != (3,) or not np.isfinite(size_m).all():
        raise ValueError(f"sample_annotation: size: three finite numbers are needed; got {describe_value(row['size'])}")
    return size_m


def _find_scene_token(samples: list[dict[str, Any]], path: Path, scene: str | None) -> str:
    """Find the token of a scene by its name or token; `path` is the table of scenes, which may be missing."""
    tokens = dict.fromkeys(str(row["scene_token"]) for row in samples)
    rows = read_json_table(path).rows if path.exists() else []
    token_by_name = {row["name"]: row["token"] for row in rows if row["token"] in tokens}
    token_by_name = token_by_name or {token: token for token in tokens}
    if scene is None and len(tokens) == 1:
        return next(iter(tokens))
    if scene is not None and (scene in token_by_name or scene in tokens):
        return str(token_by_name.get(scene, scene))
    names = ", ".join(list(token_by_name)[:8])
    if len(token_by_name) > 8:
        names += f" and {len(token_by_name) - 8} more"
    raise ValueError(f"scene: one of {names or 'none'} is needed; got {'none' if scene is None else repr(scene)}")


def _find_class(category: str) -> str | None:
    """Find SUMO's vehicle class by the first matching prefix of a category."""
    classes: Mapping[str, str] = load_road_user_classes()["nuscenes"]
    for prefix, vehicle_class in classes.items():
        if category.lower().startswith(prefix):
            return vehicle_class
    return None


def parse_pose(row: dict[str, Any]) -> Matrix:
    """Parse the pose of a row with `rotation` (w, x, y, z) and `translation`.

    Args:
        row: Row of a table.

    Returns:
        (4, 4) transform.

    Raises:
        ValueError: The quaternion is 0, or numbers are missing or not finite.
    """
    matrix = build_transform(convert_quaternion_to_rotation(row["rotation"]), row["translation"])
    if not np.isfinite(matrix).all():
        raise ValueError(f"translation: three finite numbers are needed; got {row['translation']}")
    return matrix


def _check_poses(rotations: NDArray[np.float64], positions_m: NDArray[np.float64]) -> None:
    """Check that (F, 4) quaternions and (F, 3) positions are valid poses."""
    if rotations.shape[1:] != (4,) or positions_m.shape[1:] != (3,):
        raise ValueError("every pose needs a rotation of 4 numbers and a translation of 3")
    if not (np.isfinite(rotations).all() and np.isfinite(positions_m).all()):
        bad = ~np.isfinite(np.column_stack([rotations, positions_m])).all(axis=1)
        raise ValueError(f"{np.count_nonzero(bad)} of {len(rotations)} poses have numbers that are not finite")
    if not rotations.any(axis=1).all():
        raise ValueError("a quaternion of norm 0 is no rotation; the identity is [1, 0, 0, 0] (w, x, y, z)")


def _find_tables(path: Path) -> Path:
    """Find the only folder of tables with sample data."""
    folders = _find_folders_with_table("sample_data", path)
    if len(folders) != 1:
        names = ", ".join(folder.name for folder in folders) or "none"
        raise ValueError(f"{path}: one folder of tables v1.0-*/ is needed; got {names}; name it in the path")
    return folders[0]


def _find_folders_with_table(table: str, path: Path) -> list[Path]:
    """Find the folder itself if it has the table, else its folders of versions that have it."""
    if (path / f"{table}.json").exists():
        return [path]
    return sorted(file.parent for file in path.glob(f"v1.0-*/{table}.json"))


def check_path_within(folder: Path, name: str) -> str:
    """Check that a path of a table lies within the data set.

    Args:
        folder: Data set.
        name: Path relative to it.

    Returns:
        `name`.

    Raises:
        ValueError: The path is absolute, empty or leaves the folder.

    Example:
        >>> check_path_within(Path("drive"), "samples/a.bin")
        'samples/a.bin'
    """
    # Splitting a hundred thousand names is slow, and few of them need it.
    if ".." in name or ":" in name or "\\" in name or not name.strip("./") or name.startswith("/"):
        parts = Path(name).parts
        if Path(name).is_absolute() or ".." in parts or not parts:
            raise ValueError(f"{folder}: a table names the file {name!r}, which is not within it")
    return name
