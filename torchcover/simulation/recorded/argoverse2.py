"""Logs of Argoverse 2's sensor data set (Wilson et al., NeurIPS 2021): cuboids, and the poses of the ego."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcover.files import naming, read_feather
from torchcover.geometry.rigid import Matrix, invert
from torchcover.recordings.formats.argoverse2 import CUBOIDS, POSE, poses_of, vehicle_T_ego
from torchcover.simulation.recorded.track import Ego, Recording, only_one_scene, rows_by_name, track_of
from torchcover.simulation.trajectory import Trajectory

# As in the body `ford_fusion`, where its source is.
SIZE_M = (4.869, 1.852, 1.476)
POSES = "city_SE3_egovehicle.feather"
ANNOTATIONS = ("annotations.feather", "annotations_with_ego.feather")
# The cuboids of those who ride are of the riders only; what they ride has one of its own, and is a box without anybody.
CLASSES = {
    "regular_vehicle": "passenger",
    "large_vehicle": "delivery",
    "truck": "truck",
    "box_truck": "truck",
    "truck_cab": "truck",
    "bus": "bus",
    "school_bus": "bus",
    "articulated_bus": "bus",
    "motorcycle": "motorcycle",
    "pedestrian": "pedestrian",
    "official_signaler": "pedestrian",
    "bicyclist": "pedestrian",
    "motorcyclist": "pedestrian",
    "wheeled_rider": "pedestrian",
}
EGO_CATEGORY = "ego_vehicle"
# An annotation belongs to a sweep, and the poses are those of the sweeps and others.
MAX_CLOCK_GAP_S = 0.1


def files(path: Path) -> list[Path] | None:
    """The files of a log; None if it is none."""
    found = [path / name for name in ANNOTATIONS if (path / name).exists()]
    return [found[0], path / POSES] if found else None


def read(path: Path, scene: str | None) -> Recording:
    """Read a log.

    Args:
        path: Its folder.
        scene: None: a log is one.

    Raises:
        BadFileError: Tables of another content.
        FileNotFoundError: No poses.
        ImportError: pyarrow is not installed.
    """
    only_one_scene(scene, "a log of Argoverse 2")
    named = files(path) or [path / ANNOTATIONS[0], path / POSES]
    cuboids, poses = read_feather(named[0], CUBOIDS), read_feather(named[1], ("timestamp_ns", *POSE))
    with naming(named[1], "poses of Argoverse 2"):
        origin_ns = int(poses["timestamp_ns"].min())
        ego_s = _seconds(poses, origin_ns)
        order = np.argsort(ego_s, kind="stable")
        world_T_driven = np.stack(poses_of(poses))[order]
        drive = Trajectory.from_poses(ego_s[order], world_T_driven)
    with naming(named[0], "cuboids of Argoverse 2"):
        times_s = _seconds(cuboids, origin_ns)
        if times_s.min() < drive.times_s[0] - MAX_CLOCK_GAP_S or times_s.max() > drive.times_s[-1] + MAX_CLOCK_GAP_S:
            raise ValueError(
                f"its times lie {times_s.min():g} to {times_s.max():g} s after the first pose of {POSES}, and the last "
                f"pose is at {drive.times_s[-1]:g} s: are both of one log?"
            )
        instants_s, at = np.unique(times_s, return_inverse=True)
        world_T_ego = np.stack([drive.at(time_s) for time_s in instants_s.tolist()])
        world_T_box = world_T_ego[at] @ np.stack(poses_of(cuboids))
        sizes_m = np.column_stack([cuboids[name] for name in CUBOIDS[3:6]]).astype(np.float64)
        tracks = []
        for name, own in rows_by_name(cuboids["track_uuid"].tolist(), times_s):
            category = str(cuboids["category"][own[0]]).lower()
            if category != EGO_CATEGORY:
                where = sizes_m[own], times_s[own], world_T_box[own]
                tracks.append(track_of(name, category, CLASSES.get(category), *where))
    return Recording(tuple(tracks), (Ego("ego", drive.times_s, world_T_driven, invert(vehicle_T_ego), SIZE_M),))


def _seconds(columns: Mapping[str, NDArray[Any]], origin_ns: int) -> Matrix:
    return np.asarray((columns["timestamp_ns"].astype(np.int64) - origin_ns) * 1e-9, dtype=np.float64)
