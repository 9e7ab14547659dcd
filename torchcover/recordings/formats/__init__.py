"""Formats of recordings by name; to support another one, add a class and an entry in `FORMATS`."""

import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

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
    """Class that reads recordings of one format."""

    @property
    def layout(self) -> str:
        """Files of such a recording, for messages."""

    def can_read(self, path: Path, /) -> bool:
        """Test whether an existing path looks like such a recording."""

    def __call__(self, path: Path, /) -> Recording:
        """Open a recording."""


# The first format that can read a path reads it.
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
    """Open a recording; `RecordedFrames` converts it into frames.

    Args:
        path: Folder or file of the recording.
        settings: Settings that take precedence over `recording.yaml` in its folder.
        link_roots: Other folders to which links in the recording may lead.

    Returns:
        The recording, with the corrections of its settings.

    Raises:
        FileNotFoundError: The path does not exist.
        ValueError: The format is unknown, or the recording is invalid.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such recording")
    roots = [Path(root) for root in link_roots]
    allow_links(path, roots)
    recording = _open_with_settings(path, merge_recording_settings(path, settings))
    allow_links(recording.path, [path, *roots])
    return recording


def _open_with_settings(path: Path, settings: RecordingSettings) -> Recording:
    """Open a recording in the format of its settings, or the first one that can read it."""
    if settings.format is not None and settings.format not in FORMATS:
        raise ValueError(f"format {settings.format!r}: no such format of recordings; there are {', '.join(FORMATS)}")
    manifest = _find_manifest(path)
    for name, recording_format in FORMATS.items():
        is_chosen = name == settings.format if settings.format is not None else recording_format.can_read(path)
        if not is_chosen:
            continue
        if recording_format is RosBag:
            mounts = {sensor: mount.to_matrix() for sensor, mount in settings.mounts.items()}
            return correct_recording(RosBag(path, settings.vehicle_frame, mounts, settings.point_time_unit), settings)
        if settings.vehicle_frame is not None or settings.mounts or settings.point_time_unit is not None:
            raise ValueError(
                f"{path}: vehicle_frame, mounts and point_time_unit are settings of bags; {name} stores extrinsics "
                "itself (a plain folder in frames.yaml)"
            )
        return correct_recording(_check_manifest(recording_format(path), manifest), settings)
    formats = "; ".join(f"{name}: {recording_format.layout}" for name, recording_format in FORMATS.items())
    raise ValueError(f"{path}: a recording of no known format{_suggest_subfolders(path)}; known are {formats}")


def _suggest_subfolders(folder: Path) -> str:
    """Suggest recordings in a folder and up to three levels below, for a message."""
    paths = [folder]
    for _ in range(3):
        children: list[Path] = []
        for path in paths:
            children.extend(sorted(path.iterdir()) if path.is_dir() else ())
        recordings = [str(path) for path in children if _has_known_format(path)]
        if recordings:
            return f"; name one of those in it: {_format_list(recordings)}"
        paths = children
    return ""


def _has_known_format(path: Path) -> bool:
    """Test whether any format can read a path."""
    return any(recording_format.can_read(path) for recording_format in FORMATS.values())


def _format_list(names: Sequence[str]) -> str:
    """Format the first six names of a list and the number of others."""
    text = ", ".join(names[:6])
    return f"{text} and {len(names) - 6:,} more" if len(names) > 6 else text


def _find_manifest(path: Path) -> tuple[Path, dict[str, Any]] | None:
    """Find the folder and manifest of a recording that torchcover wrote; None for other recordings."""
    if not path.is_dir():  # a bag may be one file
        return None
    for folder in (path, path / "training"):  # KITTI's layout has the folder training
        manifest = read_complete_manifest(folder)
        if manifest is not None:
            return folder, manifest
    return None


def _check_manifest(recording: Recording, folder_and_manifest: tuple[Path, dict[str, Any]] | None) -> Recording:
    """Check a recording against its manifest: other frames are an error, edited files cause a warning."""
    if folder_and_manifest is None:
        return recording
    folder, manifest = folder_and_manifest
    expected, existing = set(manifest["frames"]), set(recording.frame_names)
    if expected == existing:
        changed = find_changed(folder, manifest["files"])
        if changed:
            warnings.warn(
                f"{folder}: edited since it was recorded: {_format_list(changed)} (missing, or of another size)",
                stacklevel=4,
            )
        return recording
    missing, additional = expected - existing, existing - expected
    fault = f"{len(missing):,} are missing" if missing else f"{len(additional):,} more are there"
    raise ValueError(
        f"{recording.path}: a recording of {len(expected):,} frames ({RECORDING}), and {fault}, such as "
        f"{min(missing or additional)}; copy or record it again"
    )


def read_objects(path: str | os.PathLike[str], scene: str | None = None) -> RecordedObjects:
    """Read the objects of a recording over time, and the drive of its ego vehicle.

    Args:
        path: Log of Argoverse 2, tables of nuScenes, scenario of CommonRoad, table of boxes, or any recording with
            poses, times and boxes.
        scene: Name or token of a scene, if the tables of nuScenes hold several.

    Returns:
        Tracks and ego vehicles.

    Raises:
        FileNotFoundError: The path, or a file of the recording, does not exist.
        ValueError: The format is unknown, or the recording is invalid.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder; recorded tracks are needed")
    if nuscenes.has_objects(path):
        return nuscenes.read_objects(path, scene)
    if scene is not None:
        raise ValueError(f"{path}: scene: applies to tables of nuScenes only; leave it out")
    if argoverse2.has_objects(path):
        return argoverse2.read_objects(path)
    if path.suffix == ".xml":
        return read_commonroad(path)
    if path.suffix == ".csv":
        return RecordedObjects(read_box_tracks(path))  # without an ego vehicle
    if _has_known_format(path):
        return extract_objects(open_recording(path))
    remedy = f"{find_remedy(path)}; " if find_remedy(path) else ""
    raise ValueError(
        f"{path}: {remedy}recorded tracks are tables of nuScenes (a folder with sample_annotation.json); a log of "
        "Argoverse 2 (a folder with annotations.feather); a scenario of CommonRoad (.xml); a table of boxes (.csv); or "
        f"a recording with poses and boxes ({', '.join(FORMATS)})"
    )
