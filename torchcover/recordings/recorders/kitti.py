"""A recording in the layout of KITTI's 3D object benchmark, which `KittiObject` reads."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from torchcover.detection.boxes import Boxes
from torchcover.detection.visibility import box_visibility
from torchcover.files import write_npz
from torchcover.geometry import invert, transform
from torchcover.recordings.formats.kitti_files import vehicle_T_velodyne
from torchcover.recordings.recorders.recorder import Add, RecordedStep, RecordingSetup

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

    def __init__(self, add: Add, setup: RecordingSetup) -> None:
        if len(setup.mounts) != 1 or not setup.lidars:
            names = ", ".join(setup.mounts)
            raise ValueError(
                f"format kitti: a rig of one LiDAR is needed; {setup.rig} has {names}; use the format folder"
            )
        self._add = add
        rows = {f"P{camera}": PROJECTION for camera in range(4)}
        rows["R0_rect"] = "1 0 0 0 1 0 0 0 1"
        rows["Tr_velo_to_cam"] = " ".join(f"{number:g}" for number in camera_T_velodyne[:3].ravel())
        rows["Tr_imu_to_velo"] = "1 0 0 0 0 1 0 0 0 0 1 0"
        self._calibration = "".join(f"{key}: {numbers}\n" for key, numbers in rows.items())

    def write(self, step: RecordedStep) -> Sequence[Any]:
        """Write a step."""
        frame, velodyne_T_vehicle = step.frame, invert(vehicle_T_velodyne)
        self._add_text(f"calib/{step.name}.txt", self._calibration)
        if frame.boxes is not None:
            seen = box_visibility(frame.sensor, frame.reference, frame.boxes, reference_weights=frame.reference_weights)
            self._add_text(f"label_2/{step.name}.txt", _labels(frame.boxes, seen.level.tolist()))
        arrays = {"points": transform(velodyne_T_vehicle, frame.reference.numpy())}
        if frame.reference_weights is not None:
            arrays["weights"] = frame.reference_weights.numpy()
        self._add(f"reference/{step.name}.npz", partial(write_npz, arrays=arrays))
        (cloud,) = step.clouds.values()
        records = np.zeros((len(cloud), 4), dtype="<f4")
        records[:, :3] = transform(velodyne_T_vehicle, cloud)
        self._add(f"velodyne/{step.name}.bin", lambda path: path.write_bytes(records.tobytes()))
        return ()

    def finish(self, steps: Sequence[Sequence[Any]]) -> None:
        """Nothing: the layout has no file about all steps."""

    def _add_text(self, name: str, text: str) -> None:
        self._add(name, lambda path: path.write_text(text, encoding="utf-8"))


def _labels(boxes: Boxes, levels: Sequence[int]) -> str:
    """A line an object, by its level of visibility: what is not known of an image is -1."""
    rows = boxes.rows.double().numpy()
    camera_T_vehicle = camera_T_velodyne @ invert(vehicle_T_velodyne)
    centre_m = transform(camera_T_vehicle, rows[:, :3])
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
