"""A recording as a plain folder, which `FolderRecording` reads."""

import csv
import json
from pathlib import Path

import numpy as np

from torchcover.files import write_npz
from torchcover.geometry import BoundingBox, invert, quaternion_from_rotation, transform
from torchcover.recordings.formats.folder import BOXES, POSES_FILE, REFERENCE, SETTINGS_FILE
from torchcover.recordings.formats.folder_tables import PLACE, ROTATION, write_boxes
from torchcover.recordings.recorders.recorder import RecordedStep, RecordingSetup

# What is so near to the ground is the ground that the vehicle stands on.
CLEARANCE_M = 0.05


class FolderRecorder:
    """Writes `sensors/NAME/FRAME.npy` in the frame of each sensor, and all that a plain folder can say beside it.

    Clouds are float64, so that moved back into the vehicle frame they are the same.

    Args:
        folder: An empty or a new folder.
        setup: What is to be written.

    Raises:
        ValueError: A sensor whose name is none of a folder.
    """

    def __init__(self, folder: Path, setup: RecordingSetup) -> None:
        self._folder = folder
        self._mounts = setup.mounts
        for name in self._mounts:
            if not name or Path(name).name != name or name.startswith(".") or name == REFERENCE:
                raise ValueError(f"sensor {name!r}: a recording has a folder of this name; rename it in the rig")
        for name in self._mounts:
            (folder / "sensors" / name).mkdir(parents=True)
        (folder / REFERENCE).mkdir()
        if setup.boxes:
            (folder / BOXES).mkdir()
        (folder / SETTINGS_FILE).write_text(self._settings(setup), encoding="utf-8")
        self._append(["frame", "time_s", *PLACE, *ROTATION, "instant"])

    def write(self, step: RecordedStep) -> None:
        """Write a step; its line in `poses.csv` comes last."""
        for sensor, points in step.clouds.items():
            cloud = transform(invert(self._mounts[sensor]), points)
            np.save(self._folder / "sensors" / sensor / f"{step.name}.npy", cloud)
        frame = step.frame
        arrays = {"points": frame.reference.numpy()}
        if frame.reference_weights is not None:
            arrays["weights"] = frame.reference_weights.numpy()
        if frame.reference_heights_m is not None:
            arrays["heights_m"] = frame.reference_heights_m.numpy()
        write_npz(self._folder / REFERENCE / f"{step.name}.npz", arrays)
        if frame.boxes is not None:
            write_boxes(self._folder / BOXES / f"{step.name}.csv", frame.boxes)
        pose = step.world_T_vehicle
        wxyz = quaternion_from_rotation(pose[:3, :3])
        self._append([step.name, step.time_s, *pose[:3, 3].tolist(), *wxyz.tolist(), frame.place_in_time])

    def _append(self, row: list[object]) -> None:
        with (self._folder / POSES_FILE).open("a", newline="", encoding="utf-8") as file:
            csv.writer(file).writerow(row)

    def _settings(self, setup: RecordingSetup) -> str:
        """The text of `frames.yaml`; values as JSON, which YAML reads."""
        own = setup.body
        body = BoundingBox((*own.lower_m[:2], own.lower_m[2] + CLEARANCE_M), own.upper_m)
        mounts = {name: {"vehicle_T_sensor": mount.tolist()} for name, mount in self._mounts.items()}
        lines = ["sensors:", *(f"  {json.dumps(name)}: {json.dumps(mount)}" for name, mount in mounts.items())]
        if setup.square_metres:
            lines.append("reference: {square_metres: true}")
        lines.append(f"vehicle: {json.dumps({'lower_m': body.lower_m, 'upper_m': body.upper_m})}")
        return "\n".join(lines) + "\n"
