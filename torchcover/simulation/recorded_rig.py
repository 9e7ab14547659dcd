"""The rig of a recording, as a document that can be drawn and simulated."""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchcover.cameras.calibration import Calibration
from torchcover.geometry import (
    BoundingBox,
    build_transform,
    convert_euler_to_rotation,
    convert_rotation_to_euler,
    invert,
)
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.formats.ros import RosBag
from torchcover.recordings.recording import (
    GROUND_CLEARANCE_M,
    CalibratedRecording,
    Recording,
    SensorCalibrations,
    UndistortedRecording,
)
from torchcover.simulation.bodies import build_actor_mesh, create_body_shape
from torchcover.simulation.camera_sensor import MOUNT_T_CAMERA
from torchcover.simulation.lidar import LidarModel
from torchcover.simulation.rig import Rig
from torchcover.simulation.scan_estimate import estimate_scan, undo_motion_compensation

# What is on a roof reaches so far above the highest LiDAR.
ABOVE_SENSOR_M = 0.2
# Scans that are looked at, evenly spread.
SCANS = 5
# As in the built-in rigs of cameras; no data set tells the depth that a camera gives.
CAMERA = {"stride": 4, "min_range_m": 0.1, "max_range_m": 200.0}
ASSUMED = "assumed: depth from 0.1 to 200 m in every fourth pixel"


def build_rig_document(
    recording: Recording,
    *,
    sensor_names: Sequence[str] | None = None,
    lidar_models: Mapping[str, str] | None = None,
    raw_images: bool = False,
) -> dict[str, Any]:
    """Make a rig of what a recording knows of its sensors, and of what these saw.

    Mounts and cameras are those of its calibrations. A LiDAR scans as its model does, or as its scans look.

    Args:
        recording: The recording.
        sensor_names: LiDARs that are wanted; all if not given.
        lidar_models: Name of a LiDAR -> a built-in `LidarModel`, or the path of one.
        raw_images: Whether cameras have the distortion of their lenses where the data set ships undistorted images;
            by default they are the cameras of the released images.

    Returns:
        The keys of a valid rig; its description says where each number is from.

    Raises:
        OSError: A file is missing.
        ValueError: An unknown sensor or model, a LiDAR whose place is not known or whose points do not lie in rows, or
            raw images of a recording that knows no other lenses than those of its images.
    """
    lidar_models = lidar_models or {}
    wanted = tuple(recording.sensors) if sensor_names is None else tuple(sensor_names)
    unknown = [name for name in (*wanted, *lidar_models) if name not in recording.sensors]
    if unknown:
        raise ValueError(
            f"{recording.path}: no LiDAR {', '.join(unknown)}; the recording has {', '.join(recording.sensors)}"
        )
    known = recording.read_calibrations() if isinstance(recording, CalibratedRecording) else SensorCalibrations("", {})
    cameras = _raw_cameras(recording) if raw_images else known.cameras
    told, documents = [], []
    for name in wanted:
        document, said = _lidar(recording, name, known, lidar_models.get(name))
        documents.append(document)
        told.append(f"{name}: {said}.")
    documents += [_camera(camera) for camera in cameras]
    if cameras:
        images = "raw" if raw_images else "released"
        names = ", ".join(camera.name for camera in cameras)
        told.append(f"{names}: lenses and mounts as calibrated, of the {images} images; {ASSUMED}.")
    source = f" Calibrations: {known.source}." if known.source else ""
    rig = {
        "name": re.sub(r"\W+", "_", recording.path.resolve().stem).strip("_") or "recording",
        "description": f"The sensors of the recording {recording.path}.{source} {' '.join(told)}",
        "sensors": documents,
    }
    Rig.model_validate(rig)
    return rig


def _raw_cameras(recording: Recording) -> tuple[Calibration, ...]:
    if not isinstance(recording, UndistortedRecording):
        raise ValueError(
            f"{recording.path}: this recording knows one model of each lens, that of its images; leave out --raw-images"
        )
    return recording.read_raw_cameras()


def build_ego_box(recording: Recording, vehicle: str | Path) -> BoundingBox:
    """The body of the vehicle that recorded something, and what is mounted on it.

    `vehicle` is a built-in one, the YAML file of one or a mesh file; or `x0,x1,y0,y1,z0,z1`, the sides of the body in
    metres of the vehicle frame.
    """
    sides = str(vehicle).split(",")
    if len(sides) > 1:
        try:
            x0, x1, y0, y1, z0, z1 = map(float, sides)
            return BoundingBox((x0, y0, z0), (x1, y1, z1))
        except ValueError as error:
            raise ValueError(f"vehicle {vehicle}: x0,x1,y0,y1,z0,z1 in metres are needed, x0 < x1: {error}") from error
    ego = BoundingBox.from_points(build_actor_mesh("vehicle", create_body_shape(vehicle)).vertices_m)
    mounts = recording.read_calibrations().mounts if isinstance(recording, RosBag) else {}
    top_m = max([ego.upper_m[2], *(float(mount[2, 3]) + ABOVE_SENSOR_M for mount in mounts.values())])
    return BoundingBox((*ego.lower_m[:2], GROUND_CLEARANCE_M), (*ego.upper_m[:2], top_m))


def _lidar(recording: Recording, name: str, known: SensorCalibrations, model: str | None) -> tuple[dict[str, Any], str]:
    """The keys of a LiDAR, and where they are from."""
    count = min(SCANS, len(recording.key_frames))
    chosen = [
        recording.key_frames[position] for position in np.linspace(0, len(recording.key_frames) - 1, count, dtype=int)
    ]
    mount = known.mounts.get(name)
    mounted = "mount as calibrated"
    if mount is None:
        mount, mounted = recording.read_scan(name, chosen[0]).vehicle_T_sensor, "mount as recorded"
    if mount is None:
        raise ValueError(
            f"{recording.path}: where {name} is mounted is not known, for its clouds are in the vehicle frame; a plain "
            "folder says it in frames.yaml (vehicle_T_sensor)"
        )
    if model is not None:
        LidarModel.load(model)
        return {"type": "lidar", "name": name, "mount": _pose(mount), "model": model}, f"{mounted}; scans as {model}"
    clouds, lasers, undone = undo_motion_compensation(recording, name, chosen, mount)
    found = estimate_scan(clouds, lasers)
    if found is None:
        raise ValueError(
            f"{recording.path}: the points of {name} do not lie in rows that can be told apart; name its model (see "
            f"`torchcover list`): --lidar {name}=MODEL"
        )
    mount = mount @ build_transform(
        convert_euler_to_rotation(found.center_azimuth_deg, 0.0, 0.0), [0.0, 0.0, found.origin_height_m]
    )
    mounted += f", its rays' origin {found.origin_height_m:+.2f} m higher" if found.origin_height_m else ""
    pattern = {
        "elevations_deg": [round(float(elevation), 3) + 0.0 for elevation in found.elevations_deg],
        "horizontal_fov_deg": round(found.horizontal_fov_deg, 3),
        "columns": found.num_columns,
        "max_range_m": math.ceil(found.max_range_m * 10) / 10,
    }
    return {"type": "lidar", "name": name, "mount": _pose(mount), **pattern}, (
        f"{mounted}; estimated from {count} scan{'s' * (count > 1)}: {len(found.elevations_deg)} rows (those that "
        f"returned anything), {found.num_columns:,} columns, the range of the farthest return"
        + (undone and f"; {undone}")
    )


def _camera(camera: Calibration) -> dict[str, Any]:
    assert camera.vehicle_T_camera is not None  # recordings give it
    lens = {} if camera.model == "pinhole" else {"lens": camera.model, "coefficients": list(camera.coefficients)}
    return {
        "type": "camera",
        "name": camera.name,
        "mount": _pose(np.asarray(camera.vehicle_T_camera) @ invert(MOUNT_T_CAMERA)),
        **{key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")},
        **lens,
        **CAMERA,
    }


def _pose(vehicle_T_sensor: Matrix) -> dict[str, float]:
    yaw, pitch, roll = convert_rotation_to_euler(vehicle_T_sensor[:3, :3])
    x, y, z = vehicle_T_sensor[:3, 3]
    keys = ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")
    return {key: round(float(value), 6) + 0.0 for key, value in zip(keys, (x, y, z, yaw, pitch, roll), strict=True)}
