"""nuScenes (Caesar et al., CVPR 2020): the LiDAR on the roof, its sweeps and key frames, and the annotations."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from operator import itemgetter
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from torchcover.cameras.calibration import read_nuscenes
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
from torchcover.recordings.recording import Scan, SensorCalibrations, check_times

# The ego frame lies under the rear axle, on the ground; the centre of a Renault Zoe's box is 1.385 m before it, as in
# the rig `nuscenes`, where the source is.
vehicle_T_ego = build_transform(np.eye(3), [-1.385, 0.0, 0.0])
# As in the body `renault_zoe`, where its source is.
SIZE_M = (4.084, 1.730, 1.562)
CHANNEL = "LIDAR_TOP"
# The middle of each level of visibility, by its token.
SHARES = {"1": 0.2, "2": 0.5, "3": 0.7, "4": 0.9}
# Nothing but the car and what is mounted on it can be in its outline of 4.08 x 1.73 m up to a little above the LiDAR.
BODY = BoundingBox((-2.042, -0.865, 0.05), (2.042, 0.865, 2.04))


class NuScenes:
    """A folder with `v1.0-*/` tables, `samples/` and `sweeps/`. Key frames are looked at, sweeps serve the reference.

    Args:
        path: The data set, or its folder of tables.
        scenes: Names of scenes, such as `scene-0061`; all if not given.

    Raises:
        FileNotFoundError: A table is missing.
        ValueError: A table that is none, a token that leads nowhere, a path out of the data set, an unknown scene, no
            key frame.
    """

    layout: ClassVar[str] = "v1.0-*/*.json, samples/LIDAR_TOP, sweeps/LIDAR_TOP"
    sensors = (CHANNEL,)
    reference_sensors = ()
    has_area_weights = False
    block_indices = None
    ego_box: BoundingBox | None = BODY

    def __init__(self, path: str | os.PathLike[str], scenes: Sequence[str] | None = None) -> None:
        tables = _tables(Path(path))
        self.path = tables.parent
        self.rigs = {"nuscenes": self.sensors}
        with report_bad_file(tables, "tables of nuScenes"):  # rows without a column, numbers that are none
            self._read(tables, scenes)

    @classmethod
    def can_read(cls, path: Path) -> bool:
        """Whether there are tables of samples."""
        return path.is_dir() and bool(_tables_with("sample_data", path))

    def read_scan(self, sensor: str, index: int) -> Scan:
        """Read a sweep."""
        path = self.path / self._files[index]
        points_m, rows = read_cloud_with_rings(path)
        return Scan(points_m, vehicle_T_ego @ self._mounts[index], str(path), rings=rows)

    def get_world_T_vehicle(self, index: int) -> Matrix:
        """The pose of the ego when the sweep was made."""
        world_T_ego = build_transform(convert_quaternion_to_rotation(self._rotations[index]), self._places_m[index])
        return world_T_ego @ invert(vehicle_T_ego)

    def read_boxes(self, index: int) -> Boxes:
        """The annotations; between two key frames, what lies between theirs."""
        return self._tracks.interpolate_boxes(float(self.times_s[index]), invert(self.get_world_T_vehicle(index)))

    def read_calibrations(self) -> SensorCalibrations:
        """The LiDAR's mount, and the cameras of its first key frame."""
        with report_bad_file(self._tables, "tables of nuScenes"):
            first = self._sample_tokens[self.key_frames[0]]
            rows = [
                row
                for row in read_json_table(self._tables / "sample_data.json").rows
                if row["sample_token"] == first and row["is_key_frame"] and "/CAM_" in str(row["filename"])
            ]
            cameras = [
                read_nuscenes(
                    self._tables,
                    Path(row["filename"]).parent.name,
                    token=row["calibrated_sensor_token"],
                    width=row["width"],
                    height=row["height"],
                )
                for row in sorted(rows, key=lambda row: str(row["filename"]))
            ]
        placed = [replace(one, vehicle_T_camera=vehicle_T_ego @ np.asarray(one.vehicle_T_camera)) for one in cameras]
        source = f"calibrated_sensor.json for {self.frame_names[self.key_frames[0]]}"
        return SensorCalibrations(source, {CHANNEL: vehicle_T_ego @ self._mounts[self.key_frames[0]]}, tuple(placed))

    def _read(self, tables: Path, scenes: Sequence[str] | None) -> None:
        samples = self._samples(tables, scenes)
        poses, calibrations = (
            read_json_table(tables / "ego_pose.json"),
            read_json_table(tables / "calibrated_sensor.json"),
        )
        data = [
            row
            for row in read_json_table(tables / "sample_data.json").rows
            if f"/{CHANNEL}/" in str(row["filename"]) and row["sample_token"] in samples
        ]
        data.sort(key=lambda row: row["timestamp"])
        self.frame_names = tuple(row["filename"].rpartition("/")[2].removesuffix(".pcd.bin") for row in data)
        self.key_frames = [number for number, row in enumerate(data) if row["is_key_frame"]]
        if not self.key_frames:
            raise ValueError(f"no key frame of {CHANNEL}")
        self.times_s = check_times(np.array([row["timestamp"] for row in data]) * 1e-6, len(data), CHANNEL)
        self._files = [check_path_within(self.path, row["filename"]) for row in data]
        driven = [poses.get_row(row["ego_pose_token"]) for row in data]
        self._rotations = np.array([row["rotation"] for row in driven], dtype=np.float64)
        self._places_m = np.array([row["translation"] for row in driven], dtype=np.float64)
        _check_poses(self._rotations, self._places_m)
        mounts = {
            token: parse_pose(calibrations.get_row(token)) for token in {row["calibrated_sensor_token"] for row in data}
        }
        self._mounts = [mounts[row["calibrated_sensor_token"]] for row in data]
        self._sample_tokens = [row["sample_token"] for row in data]
        self._tables, self._sample_times = tables, samples

    @cached_property
    def _tracks(self) -> ObjectInterpolator:
        with report_bad_file(self._tables, "annotations of nuScenes"):
            return ObjectInterpolator(_seen(self._tables, self._sample_times))

    def _samples(self, tables: Path, scenes: Sequence[str] | None) -> dict[str, float]:
        """Token -> time in seconds of the key frames of the wanted scenes."""
        by_name = {row["name"]: row["token"] for row in read_json_table(tables / "scene.json").rows}
        unknown = set(scenes or ()) - by_name.keys()
        if unknown:
            raise ValueError(f"no scene {', '.join(sorted(unknown))}; there are {', '.join(sorted(by_name))}")
        wanted = {token for name, token in by_name.items() if scenes is None or name in scenes}
        rows = read_json_table(tables / "sample.json").rows
        return {row["token"]: row["timestamp"] * 1e-6 for row in rows if row["scene_token"] in wanted}


def has_objects(path: Path) -> bool:
    """Whether it is one folder of tables with annotations, be there scans or not."""
    return path.is_dir() and len(_tables_with("sample_annotation", path)) == 1


def read_objects(path: Path, scene: str | None = None) -> RecordedObjects:
    """Read the annotations of one scene and the drive of its ego, at times after its first sample.

    Args:
        path: The data set, or its folder of tables.
        scene: Its name, or its token; the only one if None.

    Raises:
        BadFileError: Tables of another content, several scenes.
        FileNotFoundError: A table is missing.
    """
    (tables,) = _tables_with("sample_annotation", path)
    samples, poses = (read_json_table(tables / f"{name}.json").rows for name in ("sample", "ego_pose"))
    with report_bad_file(tables, "tables of nuScenes"):
        token = _scene(samples, tables / "scene.json", scene)
        taken = {row["token"]: row["timestamp"] for row in samples if row["scene_token"] == token}
        first_us, last_us = min(taken.values()), max(taken.values())
        seen = group_by_name(_seen(tables, {token: (time_us - first_us) * 1e-6 for token, time_us in taken.items()}))
        driven = sorted((row for row in poses if first_us <= row["timestamp"] <= last_us), key=itemgetter("timestamp"))
        if not driven:
            raise ValueError("no ego_pose from the first sample of the scene to the last")
        ego_s = np.array([(row["timestamp"] - first_us) * 1e-6 for row in driven])
        world_T_ego = np.stack([parse_pose(row) for row in driven])
        tracks = tuple(build_track(one, _class(one[0].category)) for one in seen.values())
    return RecordedObjects(tracks, (Ego("ego", ego_s, world_T_ego, invert(vehicle_T_ego), SIZE_M),))


def _seen(tables: Path, times_s: Mapping[str, float]) -> list[ObjectState]:
    categories, instances = read_json_table(tables / "category.json"), read_json_table(tables / "instance.json")
    seen = []
    for row in read_json_table(tables / "sample_annotation.json").rows:
        if row["sample_token"] in times_s:
            width, length, height = row["size"]
            name = row["instance_token"]
            category = str(categories.get_row(instances.get_row(name)["category_token"])["name"])
            world_T_box = build_transform(convert_quaternion_to_rotation(row["rotation"]), row["translation"])
            visibility = SHARES.get(str(row.get("visibility_token")), np.nan)
            size_m = (length, width, height)
            seen.append(ObjectState(name, times_s[row["sample_token"]], world_T_box, size_m, category, visibility))
    return seen


def _scene(samples: list[dict[str, Any]], path: Path, scene: str | None) -> str:
    tokens = dict.fromkeys(str(row["scene_token"]) for row in samples)
    rows = read_json_table(path).rows if path.exists() else []
    names = {row["name"]: row["token"] for row in rows if row["token"] in tokens}
    called = names or {token: token for token in tokens}
    if scene is None and len(tokens) == 1:
        return next(iter(tokens))
    if scene is not None and (scene in called or scene in tokens):
        return str(called.get(scene, scene))
    told = ", ".join(list(called)[:8]) + (f" and {len(called) - 8} more" if len(called) > 8 else "")
    raise ValueError(f"scene: one of {told or 'none'} is needed; got {'none' if scene is None else repr(scene)}")


def _class(category: str) -> str | None:
    classes = load_road_user_classes()["nuscenes"].items()
    return next((found for beginning, found in classes if category.lower().startswith(beginning)), None)


def parse_pose(row: dict[str, Any]) -> Matrix:
    """(4, 4) the pose of a row with `rotation` (w, x, y, z) and `translation`."""
    matrix = build_transform(convert_quaternion_to_rotation(row["rotation"]), row["translation"])
    if not np.isfinite(matrix).all():
        raise ValueError(f"translation: three finite numbers are needed; got {row['translation']}")
    return matrix


def _check_poses(rotations: NDArray[np.float64], places_m: NDArray[np.float64]) -> None:
    """Whether (F, 4) quaternions and (F, 3) places are those of poses."""
    if rotations.shape[1:] != (4,) or places_m.shape[1:] != (3,):
        raise ValueError("every pose needs a rotation of 4 numbers and a translation of 3")
    if not (np.isfinite(rotations).all() and np.isfinite(places_m).all()):
        bad = ~np.isfinite(np.column_stack([rotations, places_m])).all(axis=1)
        raise ValueError(f"{np.count_nonzero(bad)} of {len(rotations)} poses have numbers that are not finite")
    if not rotations.any(axis=1).all():
        raise ValueError("a quaternion of norm 0 is no rotation; the identity is [1, 0, 0, 0] (w, x, y, z)")


def _tables(path: Path) -> Path:
    found = _tables_with("sample_data", path)
    if len(found) != 1:
        names = ", ".join(version.name for version in found) or "none"
        raise ValueError(f"{path}: one folder of tables v1.0-*/ is needed; got {names}; name it in the path")
    return found[0]


def _tables_with(table: str, path: Path) -> list[Path]:
    """The folder itself if the table is in it, else those of its versions."""
    if (path / f"{table}.json").exists():
        return [path]
    return sorted(found.parent for found in path.glob(f"v1.0-*/{table}.json"))


def check_path_within(folder: Path, name: str) -> str:
    """Return a path that a table names, if it is one within a folder.

    Example:
        >>> check_path_within(Path("drive"), "samples/a.bin")
        'samples/a.bin'
    """
    # Of a hundred thousand names few need to be taken apart.
    if ".." in name or ":" in name or "\\" in name or not name.strip("./") or name.startswith("/"):
        parts = Path(name).parts
        if Path(name).is_absolute() or ".." in parts or not parts:
            raise ValueError(f"{folder}: a table names the file {name!r}, which is not within it")
    return name
