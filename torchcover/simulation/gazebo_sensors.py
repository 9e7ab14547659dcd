"""Sensors in the Gazebo tags of a URDF, as keys of a rig."""

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

LIDARS = ("ray", "gpu_ray", "lidar", "gpu_lidar")
CAMERAS = ("camera", "multicamera")
DEPTH_CAMERAS = ("depth", "depth_camera", "rgbd", "rgbd_camera")
# As in the built-in rigs of cameras.
STRIDE = 4
# Settings of ROS plugins that change ranges, noise, rates or lenses of a sensor.
PLUGIN_SETTINGS = re.compile(
    r"(min|max)range|gaussiannoise|updaterate|pointcloudcutoff(max)?|hackbaseline|focallength|c[xy]|distortion[kt]\d"
)


class PlacedSensor(NamedTuple):
    """A sensor of a robot: its `sensor_keys` in a rig, and its (4, 4) pose in the vehicle frame."""

    sensor_keys: dict[str, Any]
    vehicle_T_sensor: Float64


def read_numbers(text: str | None, count: int, description: str) -> list[float]:
    """Read a fixed number of finite numbers.

    Raises:
        ValueError: Other text, with `description` in the message.
    """
    try:
        numbers = [float(word) for word in (text or "").split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{description}: {count} number{'s' * (count > 1)} needed; got {text!r}")
    return numbers


def read_pose(element: Element | None) -> Float64:
    """Read the (4, 4) transform of a URDF `<origin>` or an SDF `<pose>`; the identity if there is none.

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
        vehicle_T_frame: Name of each link and joint -> its (4, 4) pose in the vehicle frame.

    Returns:
        The sensors, and notes about everything that is not applied.

    Raises:
        ValueError: A frame, a block or a number is missing or cannot be used.
    """
    sensors: list[PlacedSensor] = []
    notes: list[str] = []
    names: set[str] = set()
    for gazebo in root.iterfind("gazebo"):
        for sensor in gazebo.iterfind("sensor"):
            name, kind = sensor.get("name", "sensor"), sensor.get("type", "")
            if kind not in (*LIDARS, *CAMERAS, *DEPTH_CAMERAS):
                notes.append(f"Left out: {name}, of type {kind or 'none'}.")
                continue
            vehicle_T_sensor = _find_pose(sensor, name, vehicle_T_frame, gazebo.get("reference", ""))
            frames = ChainMap({"": vehicle_T_sensor}, vehicle_T_frame)
            rate_hz = _read_number(sensor, "update_rate", f"sensor {name!r}", 0.0)
            notes += _note_plugin_settings(sensor, name, rate_hz)
            is_lidar = kind in LIDARS
            read = _read_lidar(sensor, name, frames, notes) if is_lidar else _read_cameras(sensor, name, frames, notes)
            for keys, pose in read:
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
    angles = dict(
        zip(("yaw_deg", "pitch_deg", "roll_deg"), convert_rotation_to_euler(pose[:3, :3]).round(2), strict=True)
    )
    values = dict(zip(("x_m", "y_m", "z_m"), pose[:3, 3].round(4), strict=True)) | angles
    mount = {key: float(value) for key, value in values.items() if value}
    first = {key: keys.pop(key) for key in ("type", "name")}
    return {**first, "mount": mount, **keys}


def _read_number(parent: Element, path: str, what: str, default: float | None = None) -> float:
    text = parent.findtext(path)
    if text is None and default is not None:
        return default
    return read_numbers(text, 1, f"{what}: {path}")[0]


def _read_lidar(
    sensor: Element, name: str, frames: Mapping[str, Float64], notes: list[str]
) -> Iterator[tuple[dict[str, Any], Float64]]:
    """Read a LiDAR: its columns are those that Gazebo samples, ends included; the mount looks to their middle."""
    what = f"sensor {name!r}"
    block = next((block for tag in ("lidar", "ray") if (block := sensor.find(tag)) is not None), None)
    if block is None:
        raise ValueError(f"{what}: <lidar> or <ray> is missing")
    columns = _read_samples(block, "horizontal", what, notes)
    rows = _read_samples(block, "vertical", what, notes, usual=1.0)
    left, right = (_read_number(block, f"scan/horizontal/{end}_angle", what) for end in ("min", "max"))
    low, high = (_read_number(block, f"scan/vertical/{end}_angle", what, 0.0) for end in ("min", "max"))
    spread_deg = math.degrees(right - left) * columns / max(columns - 1, 1)
    keys: dict[str, Any] = {
        "type": "lidar",
        "name": name,
        "channels": rows,
        "vertical_fov_deg": [round(math.degrees(low), 4), round(math.degrees(high), 4)],
        "horizontal_fov_deg": round(min(spread_deg, 360.0), 4) or 1.0,  # of a single column
        "columns": columns,
        "min_range_m": _read_number(block, "range/min", what, 0.0),
        "max_range_m": _read_number(block, "range/max", what),
        **_read_noise(block, name, notes),
    }
    _note_visibility_mask(block, name, notes)
    sensor_T_middle = build_transform(
        convert_euler_to_rotation(math.degrees((left + right) / 2), 0.0, 0.0), np.zeros(3)
    )
    yield keys, frames[""] @ sensor_T_middle


def _read_samples(block: Element, axis: str, what: str, notes: list[str], usual: float | None = None) -> int:
    """Read the number of rays along an axis: its samples times its resolution, as in Gazebo Classic, one at least."""
    samples = _read_number(block, f"scan/{axis}/samples", what, usual)
    resolution = _read_number(block, f"scan/{axis}/resolution", what, 1.0)
    rays = max(round(samples * resolution), int(samples * resolution > 0))
    if resolution != 1.0:
        otherwise = f"Gazebo (gz-sim) ignores <resolution> and has {samples:g}"
        notes.append(f"{what}: {rays} {axis} rays, samples times <resolution>, as in Gazebo Classic; {otherwise}.")
    return rays


def _read_cameras(
    sensor: Element, name: str, frames: Mapping[str, Float64], notes: list[str]
) -> Iterator[tuple[dict[str, Any], Float64]]:
    cameras, measures_depth = sensor.findall("camera"), sensor.get("type") in DEPTH_CAMERAS
    if not cameras:
        raise ValueError(f"sensor {name!r}: <camera> is missing")
    if not measures_depth:
        notes.append(f"{name}: a camera, which counts as if it measured depth.")
    for number, camera in enumerate(cameras):
        suffix = camera.get("name", str(number)) if len(cameras) > 1 else ""
        full_name = f"{name}_{suffix}" if suffix else name
        what = f"sensor {full_name!r}"
        near_m, far_m = (_read_clip(camera, end, what) for end in ("near", "far"))
        keys: dict[str, Any] = {
            "type": "camera",
            "name": full_name,
            "width": round(_read_number(camera, "image/width", what)),
            "height": round(_read_number(camera, "image/height", what)),
        }
        keys |= _read_lens(camera, keys["width"], keys["height"], what)
        keys |= {"stride": STRIDE, "min_range_m": near_m, "max_range_m": far_m}
        if keys.get("cy", 0.0) not in (0.0, keys["height"] / 2 - 0.5):
            notes.append(f"{full_name}: cy is counted from the top of the image; Gazebo Classic 10 counts from below.")
        if measures_depth:
            keys |= _read_noise(camera, full_name, notes)
        lens_type = camera.findtext("lens/type", "").strip()
        if lens_type not in ("", "gnomonical"):
            notes.append(
                f"{full_name}: <lens><type> {lens_type} is not applied, a pinhole is taken: Gazebo applies it to "
                "sensors of type wideanglecamera only; give `lens` and fx, fy, cx, cy in rig.yaml for a fisheye."
            )
        _note_visibility_mask(camera, full_name, notes)
        yield keys, _find_pose(camera, full_name, frames, "")


def _read_clip(camera: Element, end: str, what: str) -> float:
    """Read the near or far clipping distance; that of the depth image precedes that of the color image."""
    of_depth = f"depth_camera/clip/{end}"
    path = of_depth if camera.find(of_depth) is not None else f"clip/{end}"
    return _read_number(camera, path, what, 0.0 if end == "near" else None)


def _read_lens(camera: Element, width: int, height: int, what: str) -> dict[str, Any]:
    """Read intrinsics: those of `<lens><intrinsics>`, which count from the image corner, else the field of view."""
    coefficients = [_read_number(camera, f"distortion/{key}", what, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")]
    is_distorted = any(coefficients)
    center = camera.findtext("distortion/center", "0.5 0.5")
    if is_distorted and read_numbers(center, 2, f"{what}: distortion/center") != [0.5, 0.5]:
        raise ValueError(f"{what}: distortion/center {center} cannot be applied, only 0.5 0.5; use lens/intrinsics")
    intrinsics = camera.find("lens/intrinsics")
    if intrinsics is None:
        fov_rad = _read_number(camera, "horizontal_fov", what)
        if not is_distorted:
            return {"fov_deg": round(math.degrees(fov_rad), 4)}
        fx = fy = width / 2 / math.tan(fov_rad / 2)
        cx, cy = width / 2, height / 2
    else:
        where = f"{what}: lens/intrinsics"
        fx, fy = (_read_number(intrinsics, key, where) for key in ("fx", "fy"))
        cx = _read_number(intrinsics, "cx", where, width / 2)
        cy = _read_number(intrinsics, "cy", where, height / 2)
        if skew := _read_number(intrinsics, "s", where, 0.0):
            raise ValueError(f"{where}/s {skew:g} cannot be applied: a camera without skew is needed")
        if not is_distorted and fx == fy and (cx, cy) == (width / 2, height / 2):
            return {"fov_deg": round(math.degrees(2 * math.atan(width / 2 / fx)), 4)}
    keys: dict[str, Any] = {"fx": fx, "fy": fy, "cx": cx - 0.5, "cy": cy - 0.5}
    return keys | ({"lens": "brown_conrady", "coefficients": coefficients} if is_distorted else {})


def _read_noise(block: Element, name: str, notes: list[str]) -> dict[str, float]:
    """Read the standard deviation of ranges in meters; a bias has no counterpart, and is noted."""
    if block.findtext("noise/type", "gaussian").strip() == "none":
        return {}
    for key in ("mean", "bias_mean", "bias_stddev"):
        if value := _read_number(block, f"noise/{key}", f"sensor {name!r}", 0.0):
            notes.append(f"{name}: <noise><{key}> {value:g} is not applied; noise has a mean of 0.")
    stddev_m = _read_number(block, "noise/stddev", f"sensor {name!r}", 0.0)
    return {"range_noise_m": stddev_m} if stddev_m else {}


def _note_visibility_mask(block: Element, name: str, notes: list[str]) -> None:
    if (mask := block.findtext("visibility_mask")) is not None:
        notes.append(f"{name}: <visibility_mask> {mask.strip()} is not applied; it sees all bodies.")


def _note_plugin_settings(sensor: Element, name: str, rate_hz: float) -> list[str]:
    """Name the settings of plugins that would change what the sensor measures."""
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
