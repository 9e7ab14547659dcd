"""Write what a simulated rig saw as a recording, for any tool that reads its layout."""

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

# Between the last step of a city and the first of the next, or of the same world again: no reference of a recording is
# accumulated over so long a time.
APART_S = 1000.0


def write_recording(
    frames: SimulatedFrames,
    folder: str | os.PathLike[str],
    layout: str = "folder",
    *,
    resume: bool = False,
    progress: Callable[[range], Iterable[int]] = iter,
) -> None:
    """Write what a simulated rig saw: clouds, the reference, boxes where the frames have them, mounts and poses.

    `recording.json` lists its files; until all of them are there, it says so, and the part is not read.

    Args:
        frames: A simulation of one rig.
        folder: Where to; made if it does not exist.
        layout: A name in `RECORDERS`: "folder" (`FolderRecording` reads it, with the numbers of the simulation), or
            "kitti" (KITTI's object layout, of one LiDAR).
        resume: Whether to go on after the last step that is there, whatever ended the process that wrote it.
        progress: Is given the numbers of the steps and passes them on, as `tqdm.tqdm` does.

    Raises:
        ValueError: An unknown layout, a folder that is not empty, several rigs, or sensors that the layout cannot hold;
            a part of another recording.

    Example:
        >>> import tempfile
        >>> from torchcover.data import RecordedFrames, SimulatedFrames
        >>> frames = SimulatedFrames("courtyard", "front_roof_32", num_frames=1)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_recording(frames, folder)
        ...     again = RecordedFrames(folder)[0]
        >>> len(again.sensor) == len(frames[0].sensor), again.reference_weights is None
        (True, False)
    """
    folder = Path(folder)
    if layout not in RECORDERS:
        raise ValueError(f"format {layout!r}: recordings are written as {' or '.join(RECORDERS)}")
    if len(frames.rigs) != 1:
        raise ValueError(f"a recording is of one rig; got {', '.join(frames.rigs)}")
    manifest = read_recording_manifest(folder / RECORDING) if (folder / RECORDING).exists() else {}
    files = AtomicOutput(folder, RECORDING, manifest.get("files"))
    recorder = RECORDERS[layout](files.add, _setup(frames))
    content = {"layout": layout, **_hashes(frames.content)}
    names = [_name(index) for index in range(len(frames))]
    if resume and manifest and not manifest.get(WRITING):
        _check_same(folder, manifest["content"], content, manifest["frames"], names)
        return
    if manifest.get(WRITING) and not resume:
        raise ValueError(
            f"{folder}: holds a part of a recording, {len(manifest['steps']):,} frames; go on with it (--resume), or "
            "choose another folder"
        )
    if not manifest.get(WRITING) and folder.exists() and (not folder.is_dir() or any(folder.glob("[!.]*"))):
        raise ValueError(f"{folder}: {'not empty' if folder.is_dir() else 'a file'}; a new or empty folder is needed")
    steps = list(manifest.get("steps", ()))
    _check_same(folder, manifest.get("content") or content, content, steps, names[: len(steps)])
    with files:
        files.publish({WRITING: True, "content": content, "steps": steps})
        for index in progress(range(len(steps), len(frames))):
            steps.append(recorder.write(_step(frames, index)))
            files.publish({WRITING: True, "content": content, "steps": steps})
        recorder.finish(steps)
        files.publish({"content": content, "frames": names})


def _check_same(
    folder: Path, there: Mapping[str, str], here: Mapping[str, str], frames: Sequence[object], wanted: Sequence[str]
) -> None:
    """Find out whether what is there is a part, or the whole, of what is to be written."""
    if other := [name for name in here if there.get(name) != here[name]]:
        raise ValueError(f"{folder}: of another recording, with another {', '.join(other)}; choose another folder")
    if len(frames) != len(wanted):
        raise ValueError(
            f"{folder}: {len(frames):,} frames are there; got {len(wanted):,} steps; choose another folder"
        )


def _hashes(content: Mapping[str, object]) -> dict[str, str]:
    texts = {name: json.dumps(value, sort_keys=True, default=repr) for name, value in content.items()}
    return {name: hashlib.sha256(text.encode()).hexdigest() for name, text in texts.items()}


def _setup(frames: SimulatedFrames) -> RecordingSetup:
    (rig,) = frames.rigs.values()
    return RecordingSetup(
        rig.name,
        {sensor.name: sensor.mount.to_matrix() for sensor in rig.sensors},
        [sensor.name for sensor in rig.sensors if isinstance(sensor, Lidar)],
        frames.scenario.compute_ego_box(),
        frames.has_area_weights,
        frames.boxes,
    )


def _step(frames: SimulatedFrames, index: int) -> FrameRecord:
    ((name, rig),) = frames.rigs.items()
    seen = frames.simulator.simulate_frame(index)
    landed = [scan.points if scan.measured_points is None else scan.measured_points for scan in seen.scans[name]]
    scene, step = frames.simulator.get_scene_geometry(index)
    world = scene.scene
    played = (
        round(index * frames.frame_interval_s / world.time_step_s) // world.num_time_steps
        if world.num_time_steps > 1
        else 0
    )
    return FrameRecord(
        _name(index),
        index * frames.frame_interval_s + played * APART_S,
        world.ego.trajectory.interpolate(step * world.time_step_s),
        {sensor.name: cloud for sensor, cloud in zip(rig.sensors, landed, strict=True)},
        frames.build_frame(seen, index),
    )


def _name(index: int) -> str:
    return f"{index:06d}"
