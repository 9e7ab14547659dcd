"""A recording as a plain folder, which `FolderRecording` reads."""

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from torchcover.files import csv_text, write_npz
from torchcover.geometry import BoundingBox, invert, quaternion_from_rotation, transform
from torchcover.recordings.formats.folder import BOXES, POSES_FILE, REFERENCE, SETTINGS_FILE
from torchcover.recordings.formats.folder_tables import PLACE, ROTATION, write_boxes
from torchcover.recordings.recorders.recorder import Add, RecordedStep, RecordingSetup

# What is so near to the ground is the ground that the vehicle stands on.
CLEARANCE_M = 0.05


class FolderRecorder:
    """Writes `sensors/NAME/FRAME.npy` in the frame of each sensor, and all that a plain folder can say beside it.

    Clouds are float64, so that moved back into the vehicle frame they are the same.

    ValueError: a sensor whose name is none of a folder.
    """

    def __init__(self, add: Add, setup: RecordingSetup) -> None:
        self._add = add
        self._setup = setup
        for name in setup.mounts:
            if not name or Path(name).name != name or name.startswith(".") or name == REFERENCE:
                raise ValueError(f"sensor {name!r}: a recording has a folder of this name; rename it in the rig")

    def write(self, step: RecordedStep) -> Sequence[Any]:
        """Write a step; returns its line in `poses.csv`."""
        for sensor, points in step.clouds.items():
            cloud = transform(invert(self._setup.mounts[sensor]), points)
            self._add(f"sensors/{sensor}/{step.name}.npy", partial(np.save, arr=cloud))
        frame = step.frame
        arrays = {"points": frame.reference.numpy()}
        if frame.reference_weights is not None:
            arrays["weights"] = frame.reference_weights.numpy()
        if frame.reference_heights_m is not None:
            arrays["heights_m"] = frame.reference_heights_m.numpy()
        self._add(f"{REFERENCE}/{step.name}.npz", partial(write_npz, arrays=arrays))
        if frame.boxes is not None:
            self._add(f"{BOXES}/{step.name}.csv", partial(write_boxes, boxes=frame.boxes))
        pose = step.world_T_vehicle
        wxyz = quaternion_from_rotation(pose[:3, :3])
        return [step.name, step.time_s, *pose[:3, 3].tolist(), *wxyz.tolist(), frame.place_in_time]

    def finish(self, steps: Sequence[Sequence[Any]]) -> None:
        """Write `poses.csv` and `frames.yaml`."""
        poses = csv_text([["frame", "time_s", *PLACE, *ROTATION, "instant"], *steps])
        for name, text in ((POSES_FILE, poses), (SETTINGS_FILE, self._settings(self._setup))):
            self._add(name, partial(Path.write_text, data=text, encoding="utf-8"))

    def _settings(self, setup: RecordingSetup) -> str:
        """The text of `frames.yaml`; values as JSON, which YAML reads."""
        own = setup.body
        body = BoundingBox((*own.lower_m[:2], own.lower_m[2] + CLEARANCE_M), own.upper_m)
        mounts = {name: {"vehicle_T_sensor": mount.tolist()} for name, mount in setup.mounts.items()}
        lines = ["sensors:", *(f"  {json.dumps(name)}: {json.dumps(mount)}" for name, mount in mounts.items())]
        if setup.square_metres:
            lines.append("reference: {square_metres: true}")
        lines.append(f"vehicle: {json.dumps({'lower_m': body.lower_m, 'upper_m': body.upper_m})}")
        return "\n".join(lines) + "\n"
