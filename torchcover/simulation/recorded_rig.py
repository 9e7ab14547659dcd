"""Rig of a recording, as a document that can be simulated."""

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
from torchcover.recordings.recording import GROUND_CLEARANCE_M, Recording, SensorCalibrations
from torchcover.simulation.bodies import build_actor_mesh, create_body_shape
from torchcover.simulation.camera_sensor import MOUNT_T_CAMERA
from torchcover.simulation.lidar import LidarModel
from torchcover.simulation.motion_compensation import undo_motion_compensation
from torchcover.simulation.rig import Rig
from torchcover.simulation.scan_estimate import estimate_scan


def build_rig_document(
    recording: Recording,
    *,
    sensor_names: Sequence[str] | None = None,
    lidar_models: Mapping[str, str] | None = None,
    raw_images: bool = False,
) -> dict[str, Any]:
    """Build a rig from the calibrations of a recording and from its scans.

    Extrinsics and cameras are from the calibrations. The scan pattern of a LiDAR is that of its model, or is estimated
    from its scans.

    Args:
        recording: The recording.
        sensor_names: LiDARs of the rig; all if None.
        lidar_models: Built-in `LidarModel`, or the path of one, for the name of a LiDAR.
        raw_images: Whether cameras have the lens distortion of the raw images, if the data set provides undistorted
            images; by default, cameras are those of the provided images.

    Returns:
        Content of a valid rig; its description names the source of each number.

    Raises:
        OSError: A file is missing.
        ValueError: An unknown sensor or model, a LiDAR without extrinsics or whose points do not lie in rows, or raw
            images of a recording that has no other lenses than those of its images.
    """
    lidar_models = lidar_models or {}
    lidar_names = tuple(recording.sensors) if sensor_names is None else tuple(sensor_names)
    unknown_names = [name for name in (*lidar_names, *lidar_models) if name not in recording.sensors]
    if unknown_names:
        raise ValueError(
            f"{recording.path}: no LiDAR {', '.join(unknown_names)}; the recording has {', '.join(recording.sensors)}"
        )
    calibrations = recording.read_calibrations()
    cameras = recording.read_raw_cameras() if raw_images else calibrations.cameras
    sentences, sensors = [], []
    for name in lidar_names:
        sensor, source = build_lidar_document(recording, name, calibrations, lidar_models.get(name))
        sensors.append(sensor)
        sentences.append(f"{name}: {source}.")
    sensors += [build_camera_document(camera) for camera in cameras]
    if cameras:
        names = ", ".join(camera.name for camera in cameras)
        sentences.append(
            f"{names}: lenses and mounts as calibrated, of the {'raw' if raw_images else 'released'} images; assumed: "
            "depth from 0.1 to 200 m in every fourth pixel."
        )
    source = f" Calibrations: {calibrations.source}." if calibrations.source else ""
    rig = {
        "name": re.sub(r"\W+", "_", recording.path.resolve().stem).strip("_") or "recording",
        "description": f"Sensors of the recording {recording.path}.{source} {' '.join(sentences)}",
        "sensors": sensors,
    }
    # A recording may contain values that no rig can have.
    Rig.model_validate(rig)
    return rig


def build_ego_box(recording: Recording, vehicle: str | Path) -> BoundingBox:
    """Build the box of a recording's vehicle with its sensors.

    Args:
        recording: The recording; sensors on the roof are included if it has their extrinsics.
        vehicle: A built-in vehicle, the YAML file of one, a mesh file, or `x0,x1,y0,y1,z0,z1`, the sides of the body in
            meters of the vehicle frame.

    Returns:
        The box in the vehicle frame.

    Raises:
        ValueError: Invalid sides.
    """
    sides = str(vehicle).split(",")
    if len(sides) > 1:
        try:
            x0, x1, y0, y1, z0, z1 = (float(side) for side in sides)
            return BoundingBox((x0, y0, z0), (x1, y1, z1))
        except ValueError as error:
            raise ValueError(f"vehicle {vehicle}: x0,x1,y0,y1,z0,z1 in meters are needed, x0 < x1: {error}") from error
    housing_height_m = 0.2  # a LiDAR reaches this far above its origin
    body_box = BoundingBox.from_points(build_actor_mesh("vehicle", create_body_shape(vehicle)).vertices_m)
    top_m = body_box.upper_m[2]
    if isinstance(recording, RosBag):
        for vehicle_T_sensor in recording.read_calibrations().mounts.values():
            top_m = max(top_m, float(vehicle_T_sensor[2, 3]) + housing_height_m)
    return BoundingBox((*body_box.lower_m[:2], GROUND_CLEARANCE_M), (*body_box.upper_m[:2], top_m))


def build_lidar_document(
    recording: Recording, name: str, calibrations: SensorCalibrations, model: str | None, max_scans: int = 5
) -> tuple[dict[str, Any], str]:
    """Build the content of one LiDAR.

    Args:
        recording: The recording.
        name: Name of the LiDAR.
        calibrations: Calibrations of the recording.
        model: LiDAR model; estimated from scans if None.
        max_scans: Number of scans for the estimate, evenly distributed over the recording.

    Returns:
        Content of the LiDAR, and the sources of its numbers.

    Raises:
        ValueError: The extrinsics are unknown, or the points do not lie in rows.
    """
    num_scans = min(max_scans, len(recording.key_frames))
    positions = np.linspace(0, len(recording.key_frames) - 1, num_scans, dtype=int)
    frames = [recording.key_frames[position] for position in positions]
    # Calibrations have priority over the extrinsics of a scan.
    vehicle_T_sensor, source = calibrations.mounts.get(name), "mount as calibrated"
    if vehicle_T_sensor is None:
        vehicle_T_sensor, source = recording.read_scan(name, frames[0]).vehicle_T_sensor, "mount as recorded"
    if vehicle_T_sensor is None:
        raise ValueError(
            f"{recording.path}: the extrinsics of {name} are unknown, because its clouds are in the vehicle frame; a "
            "plain folder has them in frames.yaml (vehicle_T_sensor)"
        )
    lidar: dict[str, Any] = {"type": "lidar", "name": name}
    if model is not None:
        LidarModel.load(model)
        return {**lidar, "mount": build_pose_document(vehicle_T_sensor), "model": model}, f"{source}; scans as {model}"
    scans, lasers, compensation = undo_motion_compensation(recording, name, frames, vehicle_T_sensor)
    scan = estimate_scan(scans, lasers)
    if scan is None:
        raise ValueError(
            f"{recording.path}: the points of {name} do not lie in rows that can be distinguished; name its model (see "
            f"`torchcover list`): --lidar {name}=MODEL"
        )
    # The LiDAR of a rig looks to the center of its field of view.
    rotation = convert_euler_to_rotation(scan.center_azimuth_deg, 0.0, 0.0)
    vehicle_T_sensor = vehicle_T_sensor @ build_transform(rotation, [0.0, 0.0, scan.origin_height_m])
    if scan.origin_height_m:
        source += f", origin of its rays {scan.origin_height_m:+.2f} m higher"
    source += (
        f"; estimated from {num_scans} scan{'s' * (num_scans > 1)}: {len(scan.elevations_deg)} rows (with returns), "
        f"{scan.num_columns:,} columns, the range of the farthest return"
    )
    if compensation:
        source += f"; {compensation}"
    pattern = {
        # Adding 0.0 turns -0.0 into 0.0.
        "elevations_deg": [round(float(elevation), 3) + 0.0 for elevation in scan.elevations_deg],
        "horizontal_fov_deg": round(scan.horizontal_fov_deg, 3),
        "columns": scan.num_columns,
        "max_range_m": math.ceil(scan.max_range_m * 10) / 10,
    }
    return {**lidar, "mount": build_pose_document(vehicle_T_sensor), **pattern}, source


def build_camera_document(camera: Calibration) -> dict[str, Any]:
    """Build the content of one camera; its depth is assumed as in the built-in rigs.

    Args:
        camera: Calibration with extrinsics.

    Returns:
        Content of the camera.

    Raises:
        ValueError: The extrinsics are missing.
    """
    if camera.vehicle_T_camera is None:
        raise ValueError(f"camera {camera.name!r}: the extrinsics are missing from its calibration")
    lens = {} if camera.model == "pinhole" else {"lens": camera.model, "coefficients": list(camera.coefficients)}
    return {
        "type": "camera",
        "name": camera.name,
        "mount": build_pose_document(np.asarray(camera.vehicle_T_camera) @ invert(MOUNT_T_CAMERA)),
        **{key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")},
        **lens,
        # Data sets do not tell the depth range of cameras: these are the values of the built-in rigs.
        "stride": 4,
        "min_range_m": 0.1,
        "max_range_m": 200.0,
    }


def build_pose_document(vehicle_T_sensor: Matrix) -> dict[str, float]:
    """Build the content of a pose from a (4, 4) matrix."""
    yaw, pitch, roll = convert_rotation_to_euler(vehicle_T_sensor[:3, :3])
    x, y, z = vehicle_T_sensor[:3, 3]
    values = {"x_m": x, "y_m": y, "z_m": z, "yaw_deg": yaw, "pitch_deg": pitch, "roll_deg": roll}
    return {key: round(float(value), 6) + 0.0 for key, value in values.items()}
