"""Sensors in the Gazebo tags of a URDF, converted to keys of a rig."""

import math
import re
from collections import ChainMap
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from torchcover.geometry import (
    build_transform,
    convert_euler_to_rotation,
    convert_quaternion_to_rotation,
    convert_rotation_to_euler,
)
from torchcover.geometry.arrays import Float64

# Kind of sensor for each `type` of Gazebo.
SENSOR_KINDS = {
    **dict.fromkeys(("ray", "gpu_ray", "lidar", "gpu_lidar"), "lidar"),
    **dict.fromkeys(("camera", "multicamera"), "camera"),
    **dict.fromkeys(("depth", "depth_camera", "rgbd", "rgbd_camera"), "depth camera"),
}
# Settings of ROS plugins that change ranges, noise, rates or lenses of a sensor.
PLUGIN_SETTINGS = re.compile(
    r"(min|max)range|gaussiannoise|updaterate|pointcloudcutoff(max)?|hackbaseline|focallength|c[xy]|distortion[kt]\d"
)


class PlacedSensor(NamedTuple):
    """Sensor of a robot.

    Args:
        sensor_keys: Keys of the sensor in a rig.
        vehicle_T_sensor: (4, 4) extrinsics.
    """

    sensor_keys: dict[str, Any]
    vehicle_T_sensor: Float64


def read_numbers(text: str | None, count: int, description: str) -> list[float]:
    """Read a fixed number of finite numbers.

    Args:
        text: Numbers, separated by spaces.
        count: Required number of them.
        description: Name of the value in messages.

    Returns:
        The numbers.

    Raises:
        ValueError: The text is anything else.
    """
    try:
        numbers = [float(word) for word in (text or "").split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ValueError(f"{description}: {count} number{'s' * (count > 1)} needed; got {text!r}")
    return numbers


def read_pose(element: Element | None) -> Float64:
    """Read the transform of a URDF `<origin>` or an SDF `<pose>`.

    Args:
        element: The element; None for the identity.

    Returns:
        (4, 4) transform.

    Raises:
        ValueError: Numbers are missing, or the rotation format is unknown.
    """
    if element is None:
        return np.eye(4)
    tag, unit = element.tag, 1.0
    if tag == "pose":
        rotation_format = element.get("rotation_format", "euler_rpy")
        counts = {"euler_rpy": 6, "quat_xyzw": 7}
        if rotation_format not in counts:
            raise ValueError(f"pose: rotation_format {rotation_format!r} is unknown; use {' or '.join(counts)}")
        count = counts[rotation_format]
        numbers = read_numbers(element.text, count, tag) if (element.text or "").strip() else [0.0] * 6
        position_m, angles = numbers[:3], numbers[3:]
        unit = math.radians(1.0) if element.get("degrees", "false").strip() in ("true", "1") else 1.0
    else:
        position_m = read_numbers(element.get("xyz", "0 0 0"), 3, "origin xyz")
        key, count = ("quat_xyzw", 4) if "quat_xyzw" in element.attrib else ("rpy", 3)
        angles = read_numbers(element.get(key, "0 0 0"), count, f"origin {key}")
    if len(angles) == 4:
        x, y, z, w = angles
        return build_transform(convert_quaternion_to_rotation([w, x, y, z]), position_m)
    roll, pitch, yaw = np.rad2deg(np.multiply(angles, unit))
    return build_transform(convert_euler_to_rotation(yaw, pitch, roll), position_m)


def read_sensors(root: Element, vehicle_T_frame: dict[str, Float64]) -> tuple[list[PlacedSensor], list[str]]:
    """Read all sensors in `<gazebo>` tags.

    Args:
        root: The `<robot>`.
        vehicle_T_frame: (4, 4) pose of each link and joint in the vehicle frame, by name.

    Returns:
        The sensors, and notes about settings that are not applied.

    Raises:
        ValueError: A frame, a block or a number is missing or cannot be used.
    """
    sensors: list[PlacedSensor] = []
    notes: list[str] = []
    names: set[str] = set()
    for gazebo in root.iterfind("gazebo"):
        for sensor in gazebo.iterfind("sensor"):
            name, gazebo_type = sensor.get("name", "sensor"), sensor.get("type", "")
            kind = SENSOR_KINDS.get(gazebo_type)
            if kind is None:
                notes.append(f"Excluded: {name}, of type {gazebo_type or 'none'}.")
                continue
            vehicle_T_sensor = _find_pose(sensor, name, vehicle_T_frame, gazebo.get("reference", ""))
            frames = ChainMap({"": vehicle_T_sensor}, vehicle_T_frame)
            rate_hz = _read_number(sensor, "update_rate", f"sensor {name!r}", 0.0)
            notes += _list_ignored_settings(sensor, name, rate_hz)
            read_kind = _read_lidar if kind == "lidar" else _read_cameras
            for keys, pose in read_kind(sensor, name, frames, notes):
                if keys["name"] in names:
                    keys["name"] += f"_{len(sensors)}"
                names.add(keys["name"])
                if rate_hz:
                    keys["rate_hz"] = rate_hz
                sensors.append(PlacedSensor(_add_mount(keys, pose), pose))
    return sensors, notes


def _find_pose(owner: Element, name: str, vehicle_T_frame: Mapping[str, Float64], parent: str) -> Float64:
    """Compute the pose of a sensor or camera in the vehicle frame, from its `<pose>` and the frame that it names."""
    pose = owner.find("pose")
    frame = parent if pose is None else pose.get("relative_to") or pose.get("frame") or parent
    if frame not in vehicle_T_frame:
        raise ValueError(f"sensor {name!r} is on {frame!r}, which is no link or joint")
    return vehicle_T_frame[frame] @ read_pose(pose)


def _add_mount(keys: dict[str, Any], pose: Float64) -> dict[str, Any]:
    """Add the mount, to the tenth of a millimeter and the hundredth of a degree, after type and name."""
    names = ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")
    values = (*pose[:3, 3].round(4), *convert_rotation_to_euler(pose[:3, :3]).round(2))
    mount = {name: float(value) for name, value in zip(names, values, strict=True) if value}
    return {"type": keys.pop("type"), "name": keys.pop("name"), "mount": mount, **keys}


def _read_number(parent: Element, path: str, source: str, default: float | None = None) -> float:
    """Read the number of a descendant; `source` names the parent in messages."""
    text = parent.findtext(path)
    if text is None and default is not None:
        return default
    return read_numbers(text, 1, f"{source}: {path}")[0]


def _read_lidar(
    sensor: Element, name: str, frames: Mapping[str, Float64], notes: list[str]
) -> Iterator[tuple[dict[str, Any], Float64]]:
    """Read a LiDAR with the columns that Gazebo samples, ends included; the mount faces their center."""
    source = f"sensor {name!r}"
    block = sensor.find("lidar") if sensor.find("lidar") is not None else sensor.find("ray")
    if block is None:
        raise ValueError(f"{source}: <lidar> or <ray> is missing")
    columns = _read_samples(block, "horizontal", source, notes)
    rows = _read_samples(block, "vertical", source, notes, default=1.0)
    min_azimuth_rad = _read_number(block, "scan/horizontal/min_angle", source)
    max_azimuth_rad = _read_number(block, "scan/horizontal/max_angle", source)
    min_elevation_rad = _read_number(block, "scan/vertical/min_angle", source, 0.0)
    max_elevation_rad = _read_number(block, "scan/vertical/max_angle", source, 0.0)
    fov_deg = math.degrees(max_azimuth_rad - min_azimuth_rad) * columns / max(columns - 1, 1)
    keys: dict[str, Any] = {
        "type": "lidar",
        "name": name,
        "channels": rows,
        "vertical_fov_deg": [round(math.degrees(min_elevation_rad), 4), round(math.degrees(max_elevation_rad), 4)],
        "horizontal_fov_deg": round(min(fov_deg, 360.0), 4) or 1.0,  # 1 degree for a single column
        "columns": columns,
        "min_range_m": _read_number(block, "range/min", source, 0.0),
        "max_range_m": _read_number(block, "range/max", source),
        **_read_noise(block, name, notes),
    }
    _add_visibility_note(block, name, notes)
    center_deg = math.degrees((min_azimuth_rad + max_azimuth_rad) / 2)
    yield keys, frames[""] @ build_transform(convert_euler_to_rotation(center_deg, 0.0, 0.0), np.zeros(3))


def _read_samples(block: Element, axis: str, source: str, notes: list[str], default: float | None = None) -> int:
    """Read the number of rays along an axis: samples times resolution, as in Gazebo Classic, but at least 1."""
    samples = _read_number(block, f"scan/{axis}/samples", source, default)
    resolution = _read_number(block, f"scan/{axis}/resolution", source, 1.0)
    rays = max(round(samples * resolution), int(samples * resolution > 0))
    if resolution != 1.0:
        notes.append(
            f"{source}: {rays} {axis} rays, samples times <resolution>, as in Gazebo Classic; Gazebo (gz-sim) ignores "
            f"<resolution> and has {samples:g}."
        )
    return rays


def _read_cameras(
    sensor: Element, name: str, frames: Mapping[str, Float64], notes: list[str]
) -> Iterator[tuple[dict[str, Any], Float64]]:
    """Read the cameras of a sensor; a camera without depth is read as a depth camera, and noted."""
    cameras, measures_depth = sensor.findall("camera"), SENSOR_KINDS[sensor.get("type", "")] == "depth camera"
    if not cameras:
        raise ValueError(f"sensor {name!r}: <camera> is missing")
    if not measures_depth:
        notes.append(f"{name}: a camera, which is simulated as a depth camera.")
    for number, camera in enumerate(cameras):
        suffix = camera.get("name", str(number)) if len(cameras) > 1 else ""
        full_name = f"{name}_{suffix}" if suffix else name
        source = f"sensor {full_name!r}"
        near_m, far_m = _read_clip(camera, "near", source), _read_clip(camera, "far", source)
        keys: dict[str, Any] = {
            "type": "camera",
            "name": full_name,
            "width": round(_read_number(camera, "image/width", source)),
            "height": round(_read_number(camera, "image/height", source)),
        }
        keys |= _read_lens(camera, keys["width"], keys["height"], source)
        # Every fourth pixel, as in the built-in rigs with cameras.
        keys |= {"stride": 4, "min_range_m": near_m, "max_range_m": far_m}
        if keys.get("cy", 0.0) not in (0.0, keys["height"] / 2 - 0.5):
            notes.append(f"{full_name}: cy is counted from the top of the image; Gazebo Classic 10 counts from below.")
        if measures_depth:
            keys |= _read_noise(camera, full_name, notes)
        lens_type = camera.findtext("lens/type", "").strip()
        if lens_type not in ("", "gnomonical"):
            notes.append(
                f"{full_name}: <lens><type> {lens_type} is not applied, a pinhole is assumed: Gazebo applies it to "
                "sensors of type wideanglecamera only; give `lens` and fx, fy, cx, cy in rig.yaml for a fisheye."
            )
        _add_visibility_note(camera, full_name, notes)
        yield keys, _find_pose(camera, full_name, frames, "")


def _read_clip(camera: Element, end: str, source: str) -> float:
    """Read the near or far clipping distance; the depth image has priority over the color image."""
    depth_path = f"depth_camera/clip/{end}"
    path = depth_path if camera.find(depth_path) is not None else f"clip/{end}"
    return _read_number(camera, path, source, 0.0 if end == "near" else None)


def _read_lens(camera: Element, width: int, height: int, source: str) -> dict[str, Any]:
    """Read intrinsics from `<lens><intrinsics>`, which count from the image corner, else from the field of view."""
    coefficients = [_read_number(camera, f"distortion/{key}", source, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")]
    is_distorted = any(coefficients)
    center = camera.findtext("distortion/center", "0.5 0.5")
    if is_distorted and read_numbers(center, 2, f"{source}: distortion/center") != [0.5, 0.5]:
        raise ValueError(f"{source}: distortion/center {center} cannot be applied, only 0.5 0.5; use lens/intrinsics")
    intrinsics = camera.find("lens/intrinsics")
    if intrinsics is None:
        fov_rad = _read_number(camera, "horizontal_fov", source)
        if not is_distorted:
            return {"fov_deg": round(math.degrees(fov_rad), 4)}
        fx = fy = width / 2 / math.tan(fov_rad / 2)
        cx, cy = width / 2, height / 2
    else:
        path = f"{source}: lens/intrinsics"
        fx, fy = _read_number(intrinsics, "fx", path), _read_number(intrinsics, "fy", path)
        cx = _read_number(intrinsics, "cx", path, width / 2)
        cy = _read_number(intrinsics, "cy", path, height / 2)
        if skew := _read_number(intrinsics, "s", path, 0.0):
            raise ValueError(f"{path}/s {skew:g} cannot be applied: a camera without skew is needed")
        if not is_distorted and fx == fy and (cx, cy) == (width / 2, height / 2):
            return {"fov_deg": round(math.degrees(2 * math.atan(width / 2 / fx)), 4)}
    # From the corner of the first pixel to its center.
    keys: dict[str, Any] = {"fx": fx, "fy": fy, "cx": cx - 0.5, "cy": cy - 0.5}
    return keys | ({"lens": "brown_conrady", "coefficients": coefficients} if is_distorted else {})


def _read_noise(block: Element, name: str, notes: list[str]) -> dict[str, float]:
    """Read the standard deviation of ranges in meters; a bias is not supported, and is noted."""
    if block.findtext("noise/type", "gaussian").strip() == "none":
        return {}
    for key in ("mean", "bias_mean", "bias_stddev"):
        if value := _read_number(block, f"noise/{key}", f"sensor {name!r}", 0.0):
            notes.append(f"{name}: <noise><{key}> {value:g} is not applied; noise has a mean of 0.")
    stddev_m = _read_number(block, "noise/stddev", f"sensor {name!r}", 0.0)
    return {"range_noise_m": stddev_m} if stddev_m else {}


def _add_visibility_note(block: Element, name: str, notes: list[str]) -> None:
    """Add a note about a visibility mask, which is not applied."""
    if (mask := block.findtext("visibility_mask")) is not None:
        notes.append(f"{name}: <visibility_mask> {mask.strip()} is not applied; the sensor sees all bodies.")


def _list_ignored_settings(sensor: Element, name: str, rate_hz: float) -> list[str]:
    """List a note about the settings of plugins that would change the measurements; empty without any."""
    ignored = []
    for child in sensor.iterfind("plugin/*"):
        text = (child.text or "").strip()
        with suppress(ValueError):
            if float(text) in (0.0, rate_hz):
                continue
        if PLUGIN_SETTINGS.fullmatch(child.tag.replace("_", "").lower()):
            ignored.append(f"<{child.tag}> {text}")
    if not ignored:
        return []
    return [f"{name}: settings of its plugin are not applied: {', '.join(ignored)}; set them in rig.yaml."]
