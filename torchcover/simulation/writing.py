"""Recordings of simulated rigs, for any tool that reads their layout."""

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from torchcover.files import RECORDING, WRITING, AtomicOutput
from torchcover.recordings.recorders import RECORDERS, FrameRecord, RecordingSetup
from torchcover.recordings.recording import read_recording_manifest
from torchcover.simulation.lidar import Lidar
from torchcover.simulation.simulated_frames import SimulatedFrames


def write_recording(
    frames: SimulatedFrames,
    folder: str | os.PathLike[str],
    layout: str = "folder",
    *,
    resume: bool = False,
    progress: Callable[[range], Iterable[int]] = iter,
) -> None:
    """Write the clouds of a simulated rig, the reference, boxes if the frames have them, mounts and poses.

    `recording.json` lists the files. Until all of them are written, it marks the recording as incomplete, and
    incomplete recordings are not read.

    Args:
        frames: Simulation of one rig.
        folder: Output folder; created if it does not exist.
        layout: A name in `RECORDERS`: "folder" (`FolderRecording` reads it, with the same numbers as the simulation),
            or "kitti" (KITTI's object layout, of one LiDAR).
        resume: Whether to continue after the last frame that was written before the process ended.
        progress: Iterates over the indices of the frames, as `tqdm.tqdm` does.

    Raises:
        ValueError: An unknown layout, a folder that is not empty, several rigs, sensors that the layout cannot hold,
            or a part of another recording.

    Example:
        >>> import tempfile
        >>> from torchcover.data import RecordedFrames
        >>> frames = SimulatedFrames("courtyard", "front_roof_32", num_frames=1)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_recording(frames, folder)
        ...     recorded = RecordedFrames(folder)[0]
        >>> len(recorded.sensor) == len(frames[0].sensor), recorded.reference_weights is None
        (True, False)
    """
    folder = Path(folder)
    if layout not in RECORDERS:
        raise ValueError(f"format {layout!r}: recordings are written as {' or '.join(RECORDERS)}")
    if len(frames.rigs) != 1:
        raise ValueError(f"a recording is of one rig; got {', '.join(frames.rigs)}")
    manifest = read_recording_manifest(folder / RECORDING) if (folder / RECORDING).exists() else {}
    files = AtomicOutput(folder, RECORDING, manifest.get("files"))
    recorder = RECORDERS[layout](files.add, build_recording_setup(frames))
    content = {"layout": layout, **hash_values(frames.collect_content())}
    names = [format_frame_name(index) for index in range(len(frames))]
    is_incomplete = bool(manifest.get(WRITING))
    # A complete recording has nothing to resume.
    if resume and manifest and not is_incomplete:
        check_same_recording(folder, manifest["content"], content, manifest["frames"], names)
        return
    if is_incomplete and not resume:
        raise ValueError(
            f"{folder}: holds a part of a recording, {len(manifest['steps']):,} frames; continue it (--resume), or "
            "choose another folder"
        )
    if not is_incomplete and folder.exists() and (not folder.is_dir() or any(folder.glob("[!.]*"))):
        raise ValueError(f"{folder}: {'not empty' if folder.is_dir() else 'a file'}; a new or empty folder is needed")
    # Frames that an earlier process wrote are not written again.
    records = list(manifest.get("steps", ()))
    check_same_recording(folder, manifest.get("content") or content, content, records, names[: len(records)])
    with files:
        # The manifest marks the recording as incomplete until all frames are written.
        files.publish({WRITING: True, "content": content, "steps": records})
        for index in progress(range(len(records), len(frames))):
            records.append(recorder.write(build_frame_record(frames, index)))
            files.publish({WRITING: True, "content": content, "steps": records})
        recorder.finish(records)
        files.publish({"content": content, "frames": names})


def check_same_recording(
    folder: Path,
    written_content: Mapping[str, str],
    content: Mapping[str, str],
    written_frames: Sequence[object],
    frame_names: Sequence[str],
) -> None:
    """Check that an existing recording is the one to be written, or a part of it.

    Args:
        folder: Folder of the recording.
        written_content: Hashes of the settings of the existing recording.
        content: Hashes of the settings of the recording to be written.
        written_frames: Existing frames.
        frame_names: Expected frames.

    Raises:
        ValueError: They differ.
    """
    if changed := [name for name in content if written_content.get(name) != content[name]]:
        raise ValueError(f"{folder}: of another recording, with another {', '.join(changed)}; choose another folder")
    if len(written_frames) != len(frame_names):
        raise ValueError(
            f"{folder}: {len(written_frames):,} frames are there; got {len(frame_names):,}; choose another folder"
        )


def hash_values(content: Mapping[str, object]) -> dict[str, str]:
    """Hash each value of a mapping, as its JSON text."""
    hashes = {}
    for name, value in content.items():
        text = json.dumps(value, sort_keys=True, default=repr)
        hashes[name] = hashlib.sha256(text.encode()).hexdigest()
    return hashes


def build_recording_setup(frames: SimulatedFrames) -> RecordingSetup:
    """Build the description of a recording from the rig and the scenario of simulated frames."""
    (rig,) = frames.rigs.values()
    return RecordingSetup(
        rig.name,
        {sensor.name: sensor.mount.to_matrix() for sensor in rig.sensors},
        [sensor.name for sensor in rig.sensors if isinstance(sensor, Lidar)],
        frames.scenario.compute_ego_box(),
        frames.reference_sensor.has_area_weights,
        frames.boxes,
    )


def build_frame_record(frames: SimulatedFrames, index: int) -> FrameRecord:
    """Simulate one frame for a recording.

    Args:
        frames: Simulation of one rig.
        index: Index of the frame.

    Returns:
        Clouds with measured points, pose, time and reference.
    """
    ((name, rig),) = frames.rigs.items()
    simulated = frames.simulator.simulate_frame(index)
    clouds = {}
    for sensor, scan in zip(rig.sensors, simulated.scans[name], strict=True):
        clouds[sensor.name] = scan.points if scan.measured_points is None else scan.measured_points
    geometry, step = frames.simulator.get_scene_geometry(index)
    scene = geometry.scene
    scene_index = 0
    if scene.num_time_steps > 1:
        scene_index = round(index * frames.frame_interval_s / scene.time_step_s) // scene.num_time_steps
    # Scenes, and repetitions of a scene, are far apart in time, so that no reference accumulates scans of two of them.
    scene_gap_s = 1000.0
    return FrameRecord(
        format_frame_name(index),
        index * frames.frame_interval_s + scene_index * scene_gap_s,
        scene.ego.trajectory.interpolate(step * scene.time_step_s),
        clouds,
        frames.build_frame(simulated, index),
    )


def format_frame_name(index: int) -> str:
    """Format the name of a frame, which sorts like its index."""
    return f"{index:06d}"
