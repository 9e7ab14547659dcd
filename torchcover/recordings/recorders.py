"""Writers of recordings: another layout is a class like these and a line in `RECORDERS`."""

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from torchcover.detection.boxes import Boxes
from torchcover.detection.visibility import measure_box_visibility
from torchcover.files import format_csv, write_npz
from torchcover.frames.frame import Frame
from torchcover.geometry import BoundingBox, convert_rotation_to_quaternion, invert, transform_points
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.clouds.arrays import Points
from torchcover.recordings.formats.folder import BOXES, POSES_FILE, REFERENCE, SETTINGS_FILE
from torchcover.recordings.formats.frame_files import PLACE, ROTATION, write_boxes
from torchcover.recordings.formats.kitti import vehicle_T_velodyne


class RecordingSetup(NamedTuple):
    """What is the same at every step: the mounts of the rig's sensors, which of these are LiDARs, the vehicle.

    `has_area_weights` and `has_boxes` say whether the frames have those.
    """

    rig_name: str
    mounts: Mapping[str, Matrix]
    lidar_names: Collection[str]
    ego_box: BoundingBox
    has_area_weights: bool
    has_boxes: bool


class FrameRecord(NamedTuple):
    """A step of a recording, by the name of its files.

    `clouds` are (N, 3) float32 points of each sensor in the vehicle frame, as they landed; the frame is everything
    together.
    """

    name: str
    time_s: float
    world_T_vehicle: Matrix
    clouds: Mapping[str, Points]
    frame: Frame


# Writes a file: its path within the folder, and what writes it to the path that it is given; see `AtomicOutput.add`.
AddFile = Callable[[str, Callable[[Path], object]], None]


class Recorder(Protocol):
    """Writes a recording step by step; another process may go on where one has ended."""

    def __init__(self, add_file: AddFile, setup: RecordingSetup, /) -> None:
        """Begin one. ValueError: a rig that the layout cannot hold."""

    def write(self, record: FrameRecord, /) -> Sequence[Any]:
        """Write the files of a step; returns what `finish` has to know of it, as JSON takes it."""

    def finish(self, frame_entries: Sequence[Sequence[Any]], /) -> None:
        """Write the files that are about all steps, of each of which `write` said this."""


# What is so near to the ground is the ground that the vehicle stands on.
CLEARANCE_M = 0.05


class FolderRecorder:
    """Writes `sensors/NAME/FRAME.npy` in the frame of each sensor, and all that a plain folder can say beside it.

    Clouds are float64, so that moved back into the vehicle frame they are the same.

    ValueError: a sensor whose name is none of a folder.
    """

    def __init__(self, add_file: AddFile, setup: RecordingSetup) -> None:
        self._add = add_file
        self._setup = setup
        for name in setup.mounts:
            if not name or Path(name).name != name or name.startswith(".") or name == REFERENCE:
                raise ValueError(f"sensor {name!r}: a recording has a folder of this name; rename it in the rig")

    def write(self, record: FrameRecord) -> Sequence[Any]:
        """Write a step; returns its line in `poses.csv`."""
        for sensor, points in record.clouds.items():
            cloud = transform_points(invert(self._setup.mounts[sensor]), points)
            self._add(f"sensors/{sensor}/{record.name}.npy", partial(np.save, arr=cloud))
        frame = record.frame
        arrays = {"points": frame.reference.numpy()}
        if frame.reference_weights is not None:
            arrays["weights"] = frame.reference_weights.numpy()
        if frame.reference_heights_m is not None:
            arrays["heights_m"] = frame.reference_heights_m.numpy()
        self._add(f"{REFERENCE}/{record.name}.npz", partial(write_npz, arrays=arrays))
        if frame.boxes is not None:
            self._add(f"{BOXES}/{record.name}.csv", partial(write_boxes, boxes=frame.boxes))
        pose = record.world_T_vehicle
        wxyz = convert_rotation_to_quaternion(pose[:3, :3])
        return [record.name, record.time_s, *pose[:3, 3].tolist(), *wxyz.tolist(), frame.block_index]

    def finish(self, frame_entries: Sequence[Sequence[Any]]) -> None:
        """Write `poses.csv` and `frames.yaml`."""
        poses = format_csv([["frame", "time_s", *PLACE, *ROTATION, "instant"], *frame_entries])
        for name, text in ((POSES_FILE, poses), (SETTINGS_FILE, self._settings(self._setup))):
            self._add(name, partial(Path.write_text, data=text, encoding="utf-8"))

    def _settings(self, setup: RecordingSetup) -> str:
        """The text of `frames.yaml`; values as JSON, which YAML reads."""
        own = setup.ego_box
        body = BoundingBox((*own.lower_m[:2], own.lower_m[2] + CLEARANCE_M), own.upper_m)
        mounts = {name: {"vehicle_T_sensor": mount.tolist()} for name, mount in setup.mounts.items()}
        lines = ["sensors:", *(f"  {json.dumps(name)}: {json.dumps(mount)}" for name, mount in mounts.items())]
        if setup.has_area_weights:
            lines.append("reference: {square_metres: true}")
        lines.append(f"vehicle: {json.dumps({'lower_m': body.lower_m, 'upper_m': body.upper_m})}")
        return "\n".join(lines) + "\n"


# About KITTI's own camera, 0.27 m before the LiDAR and 0.08 m below it: x right, y down, z ahead. There are no images.
camera_T_velodyne = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, -0.08], [1.0, 0.0, 0.0, -0.27], [0, 0, 0, 1]])
PROJECTION = "721.5377 0 609.5593 0 0 721.5377 172.854 0 0 0 1 0"  # of 2011_09_26, which tools ask for
# What a file says in which there is no object: it must not be empty.
NOTHING = "DontCare -1 -1 -10 -1 -1 -1 -1 -1 -1 -1 -1000 -1000 -1000 -10"
UNKNOWN = "-1 -1 -1 -1"
# `occluded` by the level of visibility: 3 is unknown, 2 largely, 1 partly, 0 not.
OCCLUDED = (3, 2, 1, 1, 0)


class KittiRecorder:
    """Writes `velodyne/FRAME.bin`, `calib/FRAME.txt`, `label_2/FRAME.txt` and `reference/FRAME.npz`.

    The layout has no mount: the frame of its clouds is that of KITTI's LiDAR, 1.73 m above the ground and 0.58 m behind
    the vehicle's middle, wherever the rig has its own. Clouds are float32, intensities 0.

    ValueError: another rig than of one LiDAR.
    """

    def __init__(self, add_file: AddFile, setup: RecordingSetup) -> None:
        if len(setup.mounts) != 1 or not setup.lidar_names:
            names = ", ".join(setup.mounts)
            raise ValueError(
                f"format kitti: a rig of one LiDAR is needed; {setup.rig_name} has {names}; use the format folder"
            )
        self._add = add_file
        rows = {f"P{camera}": PROJECTION for camera in range(4)}
        rows["R0_rect"] = "1 0 0 0 1 0 0 0 1"
        rows["Tr_velo_to_cam"] = " ".join(f"{number:g}" for number in camera_T_velodyne[:3].ravel())
        rows["Tr_imu_to_velo"] = "1 0 0 0 0 1 0 0 0 0 1 0"
        self._calibration = "".join(f"{key}: {numbers}\n" for key, numbers in rows.items())

    def write(self, record: FrameRecord) -> Sequence[Any]:
        """Write a step."""
        frame, velodyne_T_vehicle = record.frame, invert(vehicle_T_velodyne)
        self._add_text(f"calib/{record.name}.txt", self._calibration)
        if frame.boxes is not None:
            seen = measure_box_visibility(
                frame.sensor, frame.reference, frame.boxes, reference_weights=frame.reference_weights
            )
            self._add_text(f"label_2/{record.name}.txt", _labels(frame.boxes, seen.levels.tolist()))
        arrays = {"points": transform_points(velodyne_T_vehicle, frame.reference.numpy())}
        if frame.reference_weights is not None:
            arrays["weights"] = frame.reference_weights.numpy()
        self._add(f"reference/{record.name}.npz", partial(write_npz, arrays=arrays))
        (cloud,) = record.clouds.values()
        records = np.zeros((len(cloud), 4), dtype="<f4")
        records[:, :3] = transform_points(velodyne_T_vehicle, cloud)
        self._add(f"velodyne/{record.name}.bin", lambda path: path.write_bytes(records.tobytes()))
        return ()

    def finish(self, frame_entries: Sequence[Sequence[Any]]) -> None:
        """Nothing: the layout has no file about all steps."""

    def _add_text(self, name: str, text: str) -> None:
        self._add(name, lambda path: path.write_text(text, encoding="utf-8"))


def _labels(boxes: Boxes, levels: Sequence[int]) -> str:
    """A line an object, by its level of visibility: what is not known of an image is -1."""
    rows = boxes.rows.double().numpy()
    camera_T_vehicle = camera_T_velodyne @ invert(vehicle_T_velodyne)
    centre_m = transform_points(camera_T_vehicle, rows[:, :3])
    lines = []
    for (x, y, z), (_, _, _, length, width, height, yaw), category, level in zip(
        centre_m, rows, boxes.categories, levels, strict=True
    ):
        turn = np.arctan2(-np.cos(yaw), -np.sin(yaw))  # about the camera's y
        seen = np.angle(np.exp(1j * (turn - np.arctan2(x, z))))
        numbers = [height, width, length, x, y + height / 2, z, turn]
        name = "_".join(category.split()).capitalize() or "Misc"
        lines.append(
            f"{name} -1 {OCCLUDED[level]} {seen:.6f} {UNKNOWN} {' '.join(f'{number:.6f}' for number in numbers)}"
        )
    return "\n".join(lines or [NOTHING]) + "\n"


RECORDERS: dict[str, type[Recorder]] = {"folder": FolderRecorder, "kitti": KittiRecorder}
