"""The layouts of recordings, by name: a new one is a class and a line here."""

import os
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from torchcover.files import RECORDING, allow_links, find_changed
from torchcover.recordings.corrections import correct_recording
from torchcover.recordings.formats import argoverse2, nuscenes
from torchcover.recordings.formats.argoverse2 import Argoverse2
from torchcover.recordings.formats.carla import Carla
from torchcover.recordings.formats.folder import FolderRecording
from torchcover.recordings.formats.kitti import KittiObject
from torchcover.recordings.formats.kitti_raw import KittiRaw
from torchcover.recordings.formats.nuscenes import NuScenes
from torchcover.recordings.formats.ros import RosBag
from torchcover.recordings.formats.tracks import read_box_tracks, read_commonroad
from torchcover.recordings.objects import RecordedObjects, extract_objects
from torchcover.recordings.recording import Recording, read_complete_manifest
from torchcover.recordings.settings import RecordingSettings, merge_recording_settings
from torchcover.recordings.unsupported_formats import find_remedy


class RecordingFormat(Protocol):
    """A class of recordings."""

    @property
    def layout(self) -> str:
        """What such a recording looks like, for messages."""

    def can_read(self, path: Path, /) -> bool:
        """Whether what is at a path that exists is meant to be such a recording."""

    def __call__(self, path: Path, /) -> Recording:
        """Open it."""


# So many recordings in a folder are named, or in folders of it.
BELOW, DEEP = 6, 3
# The first that recognises a path reads it.
FORMATS: dict[str, RecordingFormat] = {
    "nuscenes": NuScenes,
    "argoverse2": Argoverse2,
    "kitti_raw": KittiRaw,
    "kitti_object": KittiObject,
    "carla": Carla,
    "ros": RosBag,
    "folder": FolderRecording,
}


def open_recording(
    path: str | os.PathLike[str],
    settings: RecordingSettings | None = None,
    *,
    link_roots: Sequence[str | os.PathLike[str]] = (),
) -> Recording:
    """Open a recording; `RecordedFrames` makes frames of it.

    Args:
        path: Where it is.
        settings: How to read it; they win over `recording.yaml` in its folder.
        link_roots: Other folders that links in the recording may lead to.

    Raises:
        FileNotFoundError: There is nothing at the path.
        ValueError: An unknown format, or no format that recognises it; what the format itself finds wrong.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such recording")
    allow_links(path, map(Path, link_roots))
    recording = _open_checked(path, merge_recording_settings(path, settings))
    allow_links(recording.path, [path, *map(Path, link_roots)])
    return recording


def _open_checked(path: Path, settings: RecordingSettings) -> Recording:
    if settings.format is not None and settings.format not in FORMATS:
        raise ValueError(f"format {settings.format!r}: no such format of recordings; there are {', '.join(FORMATS)}")
    written = _read_manifest(path)
    for name, recording_format in FORMATS.items():
        if name != settings.format and (settings.format is not None or not recording_format.can_read(path)):
            continue
        if recording_format is RosBag:
            mounts = {sensor: mount.to_matrix() for sensor, mount in settings.mounts.items()}
            return correct_recording(RosBag(path, settings.vehicle_frame, mounts, settings.point_time_unit), settings)
        if settings.vehicle_frame is not None or settings.mounts or settings.point_time_unit is not None:
            raise ValueError(
                f"{path}: vehicle_frame, mounts and point_time_unit are for bags; {name} has its own (a plain folder in "
                "frames.yaml)"
            )
        return correct_recording(_checked(recording_format(path), written), settings)
    known = "; ".join(f"{name}: {recording_format.layout}" for name, recording_format in FORMATS.items())
    raise ValueError(f"{path}: a recording of no known format{_below(path)}; known are {known}")


def _below(folder: Path) -> str:
    """The recordings in a folder, and in folders of it, for a message."""
    places, found = [folder], list[Path]()
    for _ in range(DEEP * folder.is_dir()):
        places = [inner for place in places if place.is_dir() for inner in sorted(place.iterdir())]
        if found := [place for place in places if any(one.can_read(place) for one in FORMATS.values())]:
            break
    told = ", ".join(map(str, found[:BELOW])) + (f" and {len(found) - BELOW} more" if len(found) > BELOW else "")
    return f"; name one of those in it: {told}" if found else ""


def _read_manifest(path: Path) -> tuple[Path, dict[str, Any]] | None:
    """Read the manifest of a recording that torchcover has written; None of any other one."""
    if not path.is_dir():  # a bag may be one file
        return None
    manifests = ((folder, read_complete_manifest(folder)) for folder in (path, path / "training"))  # which is KITTI's
    return next(((folder, manifest) for folder, manifest in manifests if manifest is not None), None)


def _checked(recording: Recording, written: tuple[Path, dict[str, Any]] | None) -> Recording:
    """Compare a recording with its manifest: other frames are refused, other files are a warning."""
    if written is None:
        return recording
    folder, manifest = written
    names, there = set(manifest["frames"]), set(recording.frame_names)
    if names == there:
        if changed := find_changed(folder, manifest["files"]):
            more = f" and {len(changed) - BELOW:,} more" if len(changed) > BELOW else ""
            warnings.warn(
                f"{folder}: edited since it was recorded: {', '.join(changed[:BELOW])}{more} (missing, or of another "
                "size)",
                stacklevel=4,
            )
        return recording
    missing, others = names - there, there - names
    what = f"{len(missing):,} are missing" if missing else f"{len(others):,} more are there"
    raise ValueError(
        f"{recording.path}: a recording of {len(names):,} frames ({RECORDING}), and {what}, such as "
        f"{min(missing or others)}; copy or record it again"
    )


class ObjectFormat(NamedTuple):
    """A format whose objects over time can be read without any scan."""

    can_read: Callable[[Path], bool]
    read: Callable[[Path], RecordedObjects]


# By what it consists of, for messages.
OBJECT_FORMATS = {
    "tables of nuScenes (a folder with sample_annotation.json)": ObjectFormat(
        nuscenes.has_objects, nuscenes.read_objects
    ),
    "a log of Argoverse 2 (a folder with annotations.feather)": ObjectFormat(
        argoverse2.has_objects, argoverse2.read_objects
    ),
    "a scenario of CommonRoad (.xml)": ObjectFormat(lambda path: path.suffix == ".xml", read_commonroad),
    "a table of boxes (.csv)": ObjectFormat(
        lambda path: path.suffix == ".csv", lambda path: RecordedObjects(read_box_tracks(path))
    ),
}


def read_objects(path: str | os.PathLike[str], scene: str | None = None) -> RecordedObjects:
    """Read the objects of a recording over time, and the drive of its ego.

    Args:
        path: A log of Argoverse 2, tables of nuScenes, a scenario of CommonRoad, a table of boxes, or any recording
            with poses, times and boxes.
        scene: Which of tables that hold several.

    Raises:
        FileNotFoundError: There is nothing at the path, or a part of it is missing.
        ValueError: No format that recognises it; what the format itself finds wrong.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder; recorded tracks are needed")
    if scene is not None:
        if not nuscenes.has_objects(path):
            raise ValueError(f"{path}: scene: is for tables of nuScenes; leave it out")
        return nuscenes.read_objects(path, scene)
    for one in OBJECT_FORMATS.values():
        if one.can_read(path):
            return one.read(path)
    for recording_format in FORMATS.values():
        if recording_format.can_read(path):
            return extract_objects(open_recording(path))
    remedy = f"{find_remedy(path)}; " * bool(find_remedy(path))
    raise ValueError(
        f"{path}: {remedy}recorded tracks are {'; '.join(OBJECT_FORMATS)}; or a recording with poses and boxes "
        f"({', '.join(FORMATS)})"
    )
