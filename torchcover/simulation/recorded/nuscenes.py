"""Tables of nuScenes (Caesar et al., CVPR 2020), or of whoever writes the same: annotations, and poses of the ego."""

from pathlib import Path
from typing import Any

import numpy as np

from torchcover.files import naming, read_json_table
from torchcover.geometry import rigid, rotation_from_quaternion
from torchcover.geometry.rigid import Matrix, invert
from torchcover.recordings.formats.nuscenes import vehicle_T_ego
from torchcover.simulation.recorded.track import Ego, Recording, Track, rows_by_name, track_of

# As in the body `renault_zoe`, where its source is.
SIZE_M = (4.084, 1.730, 1.562)
TABLES = ("sample", "ego_pose", "sample_annotation", "instance", "category")
# By the beginning of a category; the first that fits counts.
CLASSES = (
    ("vehicle.car", "passenger"),
    ("vehicle.emergency.police", "passenger"),
    ("vehicle.emergency", "emergency"),
    ("vehicle.truck", "truck"),
    ("vehicle.bus", "bus"),
    ("vehicle.motorcycle", "motorcycle"),
    ("vehicle.bicycle", "bicycle"),
    ("human.pedestrian.child", "child"),
    ("human.pedestrian.wheelchair", None),
    ("human.pedestrian.stroller", None),
    ("human.pedestrian.personal_mobility", None),
    ("human.pedestrian", "pedestrian"),
)


def files(path: Path) -> list[Path] | None:
    """The tables of a folder, or of the only `v1.0-*` in it; None if there are none."""
    if not path.is_dir():
        return None
    folders = [path, *sorted(path.glob("v1.0-*"))]
    found = [folder for folder in folders if (folder / "sample_annotation.json").exists()]
    if len(found) != 1:
        return None
    scenes = found[0] / "scene.json"
    return [*(found[0] / f"{name}.json" for name in TABLES), *([scenes] if scenes.exists() else [])]


def read(path: Path, scene: str | None) -> Recording:
    """Read one scene.

    Args:
        path: Its folder.
        scene: Its name, or its token; the only one if None.

    Raises:
        BadFileError: Tables of another content, several scenes.
        FileNotFoundError: A table is missing.
    """
    named = files(path) or [path / f"{name}.json" for name in TABLES]
    folder = named[0].parent
    samples, poses, annotations, instances, categories = (read_json_table(file) for file in named[: len(TABLES)])
    with naming(folder, "tables of nuScenes"):
        token = _scene(samples.rows, named[len(TABLES) :], scene)
        taken = {row["token"]: row["timestamp"] for row in samples.rows if row["scene_token"] == token}
        first_us, last_us = min(taken.values()), max(taken.values())
        driven = sorted(
            (row for row in poses.rows if first_us <= row["timestamp"] <= last_us), key=lambda row: row["timestamp"]
        )
        if not driven:
            raise ValueError("no ego_pose from the first sample of the scene to the last")
        ego_s = np.array([(row["timestamp"] - first_us) * 1e-6 for row in driven])
        world_T_ego = np.stack([_pose(row) for row in driven])
        rows = [row for row in annotations.rows if row["sample_token"] in taken]
        times_s = np.array([(taken[row["sample_token"]] - first_us) * 1e-6 for row in rows])
        tracks: list[Track] = []
        for name, own in rows_by_name([row["instance_token"] for row in rows], times_s):
            seen = [rows[number] for number in own.tolist()]
            category = str(categories.row(instances.row(name)["category_token"])["name"]).lower()
            sizes_m = np.array([row["size"] for row in seen], dtype=np.float64)[:, [1, 0, 2]]  # from width, length
            boxes = np.stack([_pose(row) for row in seen])
            tracks.append(track_of(name, category, _class(category), sizes_m, times_s[own], boxes))
    return Recording(tuple(tracks), (Ego("ego", ego_s, world_T_ego, invert(vehicle_T_ego), SIZE_M),))


def _scene(samples: list[dict[str, Any]], named: list[Path], scene: str | None) -> str:
    """The token of the scene that is meant.

    Raises:
        ValueError: There is none of this name, or none is named of several.
    """
    tokens = dict.fromkeys(str(row["scene_token"]) for row in samples)
    names = {
        row["name"]: row["token"] for path in named for row in read_json_table(path).rows if row["token"] in tokens
    }
    called = names or {token: token for token in tokens}
    if scene is None and len(tokens) == 1:
        return next(iter(tokens))
    if scene is not None and (scene in called or scene in tokens):
        return str(called.get(scene, scene))
    told = ", ".join(list(called)[:8]) + (f" and {len(called) - 8} more" if len(called) > 8 else "")
    raise ValueError(f"scene: one of {told or 'none'} is needed; got {'none' if scene is None else repr(scene)}")


def _class(category: str) -> str | None:
    return next((found for beginning, found in CLASSES if category.startswith(beginning)), None)


def _pose(row: dict[str, Any]) -> Matrix:
    return rigid(rotation_from_quaternion(row["rotation"]), row["translation"])
