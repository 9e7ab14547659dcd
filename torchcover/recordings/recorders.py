"""Writers of recordings; to support another format, add a class and an entry in `RECORDERS`."""

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
from torchcover.recordings.formats.folder import POSES_FILE, REFERENCE, SETTINGS_FILE
from torchcover.recordings.formats.frame_files import BOX_FOLDER, POSITION_COLUMNS, QUATERNION_COLUMNS, write_boxes
from torchcover.recordings.formats.kitti import vehicle_T_velodyne
from torchcover.recordings.recording import GROUND_CLEARANCE_M

# Adds a file to the output: path within the folder, and function that writes to a given path; see `AtomicOutput.add`.
AddFile = Callable[[str, Callable[[Path], object]], None]


class RecordingSetup(NamedTuple):
    """Properties of a recording that are the same in all frames.

    Args:
        rig_name: Name of the sensor rig.
        mounts: Name of each sensor and its (4, 4) `vehicle_T_sensor`.
        lidar_names: Names of the sensors that are LiDARs.
        ego_box: Bounding box of the ego vehicle in the vehicle frame.
        has_area_weights: True if reference points have area weights.
        has_boxes: True if frames have labeled objects.
    """

    rig_name: str
    mounts: Mapping[str, Matrix]
    lidar_names: Collection[str]
    ego_box: BoundingBox
    has_area_weights: bool
    has_boxes: bool


class FrameRecord(NamedTuple):
    """One frame of a recording.

    Args:
        name: Name of the frame, used for its files.
        time_s: Time of the frame.
        world_T_vehicle: (4, 4) pose of the vehicle.
        clouds: Name of each sensor and its (N, 3) float32 measured points in the vehicle frame.
        frame: Points of all sensors, reference points and boxes.
    """

    name: str
    time_s: float
    world_T_vehicle: Matrix
    clouds: Mapping[str, Points]
    frame: Frame


class Recorder(Protocol):
    """Writer of a recording, frame by frame; another process may continue an interrupted recording.

    Args:
        add_file: Function that adds a file to the output.
        setup: Properties of all frames.

    Raises:
        ValueError: The format cannot store this rig.
    """

    def __init__(self, add_file: AddFile, setup: RecordingSetup, /) -> None: ...

    def write(self, record: FrameRecord, /) -> Sequence[Any]:
        """Write the files of a frame and return its entry for `finish`, which must be serializable as JSON."""

    def finish(self, frame_entries: Sequence[Sequence[Any]], /) -> None:
        """Write the files about all frames from the entries that `write` returned."""


class FolderRecorder:
    """Writer of the plain folder format: `sensors/NAME/FRAME.npy` with poses, boxes, reference and settings.

    Clouds are float64 in the sensor frame, so that transforming them back into the vehicle frame is exact.

    Args:
        add_file: Function that adds a file to the output.
        setup: Properties of all frames.

    Raises:
        ValueError: The name of a sensor is not a valid folder name.
    """

    def __init__(self, add_file: AddFile, setup: RecordingSetup) -> None:
        self._add_file = add_file
        self._setup = setup
        for name in setup.mounts:
            if not name or Path(name).name != name or name.startswith(".") or name == REFERENCE:
                raise ValueError(f"sensor {name!r}: a recording has a folder of this name; rename it in the rig")

    def write(self, record: FrameRecord) -> Sequence[Any]:
        """Write the files of a frame.

        Args:
            record: Frame to write.

        Returns:
            The row of the frame in `poses.csv`.
        """
        for sensor, points_m in record.clouds.items():
            cloud = transform_points(invert(self._setup.mounts[sensor]), points_m)
            self._add_file(f"sensors/{sensor}/{record.name}.npy", partial(np.save, arr=cloud))
        frame = record.frame
        arrays = {"points": frame.reference.numpy()}
        if frame.reference_weights is not None:
            arrays["weights"] = frame.reference_weights.numpy()
        if frame.reference_heights_m is not None:
            arrays["heights_m"] = frame.reference_heights_m.numpy()
        self._add_file(f"{REFERENCE}/{record.name}.npz", partial(write_npz, arrays=arrays))
        if frame.boxes is not None:
            self._add_file(f"{BOX_FOLDER}/{record.name}.csv", partial(write_boxes, boxes=frame.boxes))
        pose = record.world_T_vehicle
        wxyz = convert_rotation_to_quaternion(pose[:3, :3])
        return [record.name, record.time_s, *pose[:3, 3].tolist(), *wxyz.tolist(), frame.block_index]

    def finish(self, frame_entries: Sequence[Sequence[Any]]) -> None:
        """Write `poses.csv` and `frames.yaml`.

        Args:
            frame_entries: Rows of all frames in `poses.csv`.
        """
        header = ["frame", "time_s", *POSITION_COLUMNS, *QUATERNION_COLUMNS, "block_index"]
        texts = {POSES_FILE: format_csv([header, *frame_entries]), SETTINGS_FILE: self._format_settings()}
        for name, text in texts.items():
            self._add_file(name, partial(Path.write_text, data=text, encoding="utf-8"))

    def _format_settings(self) -> str:
        """Format `frames.yaml`; values are JSON, which is valid YAML."""
        lines = ["sensors:"]
        for name, mount in self._setup.mounts.items():
            lines.append(f"  {json.dumps(name)}: {json.dumps({'vehicle_T_sensor': mount.tolist()})}")
        if self._setup.has_area_weights:
            lines.append("reference: {area_weights: true}")
        ego_box = self._setup.ego_box
        raised_box = BoundingBox((*ego_box.lower_m[:2], ego_box.lower_m[2] + GROUND_CLEARANCE_M), ego_box.upper_m)
        lines.append(f"vehicle: {json.dumps({'lower_m': raised_box.lower_m, 'upper_m': raised_box.upper_m})}")
        return "\n".join(lines) + "\n"


# A label file must not be empty.
NO_OBJECT_LABEL = "DontCare -1 -1 -10 -1 -1 -1 -1 -1 -1 -1 -1000 -1000 -1000 -10"
# Frame of KITTI's camera (x right, y down, z forward), 0.27 m in front of the LiDAR and 0.08 m below it.
camera_T_velodyne = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, -0.08], [1.0, 0.0, 0.0, -0.27], [0, 0, 0, 1]])


class KittiRecorder:
    """Writer of KITTI's layout: `velodyne/FRAME.bin`, `calib/FRAME.txt`, `label_2/FRAME.txt`, `reference/FRAME.npz`.

    The layout stores no extrinsics: clouds are in the frame of KITTI's LiDAR, 1.73 m above the ground and 0.58 m behind
    the center of the vehicle, wherever the rig carries its LiDAR. Clouds are float32, intensities 0.

    Args:
        add_file: Function that adds a file to the output.
        setup: Properties of all frames.

    Raises:
        ValueError: The rig does not consist of one LiDAR.
    """

    def __init__(self, add_file: AddFile, setup: RecordingSetup) -> None:
        if len(setup.mounts) != 1 or not setup.lidar_names:
            names = ", ".join(setup.mounts)
            raise ValueError(
                f"format kitti: a rig of one LiDAR is needed; {setup.rig_name} has {names}; use the format folder"
            )
        self._add_file = add_file
        projection = "721.5377 0 609.5593 0 0 721.5377 172.854 0 0 0 1 0"  # drive day 2011_09_26; there are no images
        rows = {f"P{camera}": projection for camera in range(4)}
        rows["R0_rect"] = "1 0 0 0 1 0 0 0 1"
        rows["Tr_velo_to_cam"] = " ".join(f"{number:g}" for number in camera_T_velodyne[:3].ravel())
        rows["Tr_imu_to_velo"] = "1 0 0 0 0 1 0 0 0 0 1 0"
        self._calibration = "".join(f"{key}: {numbers}\n" for key, numbers in rows.items())

    def write(self, record: FrameRecord) -> Sequence[Any]:
        """Write the files of a frame.

        Args:
            record: Frame to write.

        Returns:
            An empty entry.
        """
        frame, velodyne_T_vehicle = record.frame, invert(vehicle_T_velodyne)
        self._add_text(f"calib/{record.name}.txt", self._calibration)
        if frame.boxes is not None:
            visibility = measure_box_visibility(
                frame.sensor, frame.reference, frame.boxes, reference_weights=frame.reference_weights
            )
            self._add_text(f"label_2/{record.name}.txt", _format_labels(frame.boxes, visibility.levels.tolist()))
        arrays = {"points": transform_points(velodyne_T_vehicle, frame.reference.numpy())}
        if frame.reference_weights is not None:
            arrays["weights"] = frame.reference_weights.numpy()
        self._add_file(f"reference/{record.name}.npz", partial(write_npz, arrays=arrays))
        (cloud,) = record.clouds.values()
        rows = np.zeros((len(cloud), 4), dtype="<f4")
        rows[:, :3] = transform_points(velodyne_T_vehicle, cloud)
        self._add_file(f"velodyne/{record.name}.bin", partial(Path.write_bytes, data=rows.tobytes()))
        return ()

    def finish(self, frame_entries: Sequence[Sequence[Any]]) -> None:
        """Write nothing, since the layout has no file about all frames."""

    def _add_text(self, name: str, text: str) -> None:
        self._add_file(name, partial(Path.write_text, data=text, encoding="utf-8"))


def _format_labels(boxes: Boxes, levels: Sequence[int]) -> str:
    """Format one line per object; values that need an image are -1."""
    rows = boxes.rows.double().numpy()
    centers_m = transform_points(camera_T_velodyne @ invert(vehicle_T_velodyne), rows[:, :3])
    occluded_by_level = (3, 2, 1, 1, 0)  # visibility levels unknown, 0-40 %, 40-60 %, 60-80 %, 80-100 %
    lines = []
    for (x, y, z), row, category, level in zip(centers_m, rows, boxes.categories, levels, strict=True):
        length, width, height, yaw = row[3:]
        rotation_y = np.arctan2(-np.cos(yaw), -np.sin(yaw))  # about the y axis of the camera
        alpha = np.angle(np.exp(1j * (rotation_y - np.arctan2(x, z))))
        numbers = [height, width, length, x, y + height / 2, z, rotation_y]
        name = "_".join(category.split()).capitalize() or "Misc"
        occluded = occluded_by_level[level]
        lines.append(f"{name} -1 {occluded} {alpha:.6f} -1 -1 -1 -1 {' '.join(f'{number:.6f}' for number in numbers)}")
    return "\n".join(lines or [NO_OBJECT_LABEL]) + "\n"


RECORDERS: dict[str, type[Recorder]] = {"folder": FolderRecorder, "kitti": KittiRecorder}
