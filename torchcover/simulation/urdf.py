"""Robots described in URDF: their bodies, and the sensors that Gazebo would simulate on them."""

import math
import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from torchcover.files import Publication, as_yaml, parse_xml, reads
from torchcover.geometry import BoundingBox, euler_from_rotation, rigid, rotation_from_euler
from torchcover.geometry.arrays import Float64
from torchcover.simulation.bodies import merge
from torchcover.simulation.rig import Rig
from torchcover.simulation.shapes import Box, Cylinder, Ellipsoid, Mesh, MeshFile

LIDARS = ("ray", "gpu_ray", "lidar", "gpu_lidar")
CAMERAS = ("camera", "depth", "depth_camera", "rgbd", "rgbd_camera", "multicamera")
# Larger bodies hold a sensor, but are not its housing.
LARGEST_HOUSING_M = 0.5
# As in the built-in rigs of cameras.
STRIDE = 4
BODY, VEHICLE, RIG = "body.ply", "vehicle.yaml", "rig.yaml"


class Robot(NamedTuple):
    """What a URDF says of a robot.

    Args:
        name: Its name.
        body: In the vehicle frame: the origin is on the ground, below the middle of its box.
        sensors: The keys of each sensor of a rig.
        notes: What was left out, or assumed.
    """

    name: str
    body: Mesh
    sensors: list[dict[str, Any]]
    notes: list[str]

    def save(self, folder: str | Path) -> list[Path]:
        """Write `body.ply`, `vehicle.yaml` and, if there are sensors, `rig.yaml` on that vehicle.

        Args:
            folder: Where to write; made if it does not exist.

        Raises:
            ValueError: A sensor that no rig can have, such as one with a range of 0.
        """
        size = " x ".join(f"{length:.2f}" for length in np.ptp(self.body.vertices_m, axis=0))
        told = " ".join([f"{size} m, of a URDF.", *self.notes])
        part = {"name": "body", "shape": {"type": "mesh", "path": BODY}}
        with Publication(Path(folder)) as written:
            written.add(BODY, partial(_write_ply, mesh=self.body))
            written.add_text(VEHICLE, as_yaml({"name": self.name, "description": told, "parts": [part]}))
            if self.sensors:
                Rig.model_validate({"name": self.name, "sensors": self.sensors})
                keys = {"name": self.name, "description": told, "vehicle": VEHICLE, "sensors": self.sensors}
                written.add_text(RIG, as_yaml(keys))
            written.publish({"robot": self.name, "notes": self.notes})
        return written.paths


def _write_ply(path: Path, mesh: Mesh) -> None:
    """Binary, as every program reads it."""
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(mesh.vertices_m)}\nproperty float x\n"
        f"property float y\nproperty float z\nelement face {len(mesh.faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(mesh.faces), dtype=[("corners", "u1"), ("at", "<i4", 3)])
    faces["corners"], faces["at"] = 3, mesh.faces
    path.write_bytes(header.encode() + mesh.vertices_m.astype("<f4").tobytes() + faces.tobytes())


@reads("a URDF")
def read_robot(path: Path, packages: Mapping[str, str | Path] | None = None) -> Robot:
    """Read a robot from a URDF file, with every joint at 0.

    Its body is what links show (`visual`), or where they show nothing, what they collide with. Sensors are those of
    Gazebo's tags: LiDARs, cameras and depth cameras. A small body around a sensor, which it is built into, is left out.

    Args:
        path: The file; one of xacro has to be expanded first.
        packages: Name of a ROS package -> its folder. Others are looked for around the file: a folder of this name, or
            one that has the rest of the path.

    Returns:
        The robot: its body in the vehicle frame, in metres, and the keys of its sensors as in YAML.

    Raises:
        BadFileError: Not a URDF; links that are no tree; meshes that are missing, all of them named; a sensor without
            what it needs; numbers that are none.

    Example:
        >>> import tempfile
        >>> box = "<visual><geometry><box size='0.6 0.4 0.2'/></geometry></visual>"
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(folder, "a.urdf").write_text(f"<robot name='a'><link name='base'>{box}</link></robot>")
        ...     robot = read_robot(Path(folder, "a.urdf"))
        >>> robot.body.vertices_m.max(axis=0)
        array([0.3, 0.2, 0.2])
    """
    root = parse_xml(path)
    if any("xacro" in element.tag for element in root.iter()):
        raise ValueError(f"it is xacro, which has to be expanded first: xacro {path.name} > {path.stem}_expanded.urdf")
    if root.tag != "robot" or root.find("link") is None:
        raise ValueError(f"a <robot> with links is needed; got <{root.tag}>")
    base_T_link = _places(root)
    _check_meshes(root, path, packages or {})
    links = _by_name(root, "link")
    pieces = [
        mesh.moved(base_T_link[name]) for name, link in links.items() for mesh in _meshes(link, path, packages or {})
    ]
    if not pieces:
        raise ValueError("no link has a visual or collision geometry, so there is no body")
    box = BoundingBox.around(merge(pieces).vertices_m)
    middle_m = np.add(box.lower_m, box.upper_m) / 2
    vehicle_T_base = rigid(np.eye(3), (-middle_m[0], -middle_m[1], -box.lower_m[2]))
    pieces = [piece.moved(vehicle_T_base) for piece in pieces]
    sensors, notes = _sensors(root, {name: vehicle_T_base @ place for name, place in base_T_link.items()})
    body = _without_housings(pieces, [pose[:3, 3] for _, pose in sensors])
    if left_out := len(pieces) - len(body):
        notes.append(f"Left out: what sensors are built into, {left_out} of {len(pieces)} bodies.")
    return Robot(root.get("name", path.stem), merge(body), [keys for keys, _ in sensors], notes)


def _by_name(root: Element, tag: str) -> dict[str, Element]:
    named = [(element.get("name", ""), element) for element in root.findall(tag)]
    twice = {name for name, _ in named if [other for other, _ in named].count(name) > 1}
    if twice:
        raise ValueError(f"several of <{tag}> are called {', '.join(map(repr, sorted(twice)))}")
    return dict(named)


def _places(root: Element) -> dict[str, Float64]:
    """Name of each link -> its pose in the frame of the root, with every joint at 0."""
    links, above = _by_name(root, "link"), dict[str, tuple[str, Element]]()
    for joint in root.findall("joint"):
        ends = [end.get("link", "") if (end := joint.find(tag)) is not None else "" for tag in ("parent", "child")]
        name = joint.get("name", "")
        if unknown := [end for end in ends if end not in links]:
            raise ValueError(f"joint {name!r} is about {unknown[0]!r}, which is no link")
        if ends[1] in above:
            raise ValueError(f"link {ends[1]!r} hangs on {above[ends[1]][0]!r} and on {ends[0]!r}: a tree is needed")
        above[ends[1]] = ends[0], joint
    roots = [name for name in links if name not in above]
    if len(roots) > 1:
        raise ValueError(f"links {', '.join(map(repr, roots))} hang on no other: one is needed that all others hang on")
    places: dict[str, Float64] = {}
    waiting = roots
    while waiting:
        name = waiting.pop()
        at = _pose(above[name][1].find("origin")) if name in above else np.eye(4)
        places[name] = places[above[name][0]] @ at if name in above else at
        waiting += [child for child, (parent, _) in above.items() if parent == name]
    if ring := [name for name in links if name not in places]:
        raise ValueError(f"links {', '.join(map(repr, ring))} hang on each other in a ring: a tree is needed")
    return places


def _numbers(text: str | None, count: int, what: str) -> list[float]:
    words = (text or "").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{what}: {count} number{'s' * (count > 1)} needed; got {text!r}")
    return numbers


def _pose(origin: Element | None) -> Float64:
    """Of `<origin xyz rpy>`, or of Gazebo's `<pose>`, which is the same in one row."""
    if origin is None:
        return np.eye(4)
    if origin.tag == "pose":
        *place_m, roll, pitch, yaw = _numbers(origin.text, 6, "pose")
    else:
        place_m = _numbers(origin.get("xyz", "0 0 0"), 3, "origin xyz")
        roll, pitch, yaw = _numbers(origin.get("rpy", "0 0 0"), 3, "origin rpy")
    return rigid(rotation_from_euler(*np.rad2deg([yaw, pitch, roll])), place_m)


def _shown(link: Element) -> list[Element]:
    return link.findall("visual") or link.findall("collision")


def _check_meshes(root: Element, path: Path, packages: Mapping[str, str | Path]) -> None:
    shown = [mesh for link in root.findall("link") for body in _shown(link) for mesh in body.iterfind("geometry/mesh")]
    files = dict.fromkeys(mesh.get("filename", "") for mesh in shown)
    if missing := [name for name in files if _found(name, path, packages) is None]:
        told = ", ".join(missing[:3]) + f" and {len(missing) - 3} more" * (len(missing) > 3)
        raise ValueError(
            f"{len(missing)} of {len(files)} meshes are missing: {told}. Name the folder of a ROS package: "
            "--package NAME=FOLDER"
        )


def _found(name: str, path: Path, packages: Mapping[str, str | Path]) -> Path | None:
    """The file of a mesh; None if there is none."""
    scheme, _, rest = name.rpartition("://")
    package, _, within = rest.partition("/")
    if scheme in ("package", "model"):
        around = [parent / part for parent in path.resolve().parents for part in (rest, within)]
        places = [Path(packages[package], within)] if package in packages else around
    else:
        places = [path.parent / rest]
    return next((place for place in places if within + rest and place.is_file()), None)


def _meshes(link: Element, path: Path, packages: Mapping[str, str | Path]) -> list[Mesh]:
    """What a link shows, in its frame."""
    meshes = []
    for body in _shown(link):
        for shape in body.iterfind("geometry/*"):
            mesh = _mesh(shape, path, packages)
            if mesh is not None:
                meshes.append(mesh.moved(_pose(body.find("origin"))))
    return meshes


def _mesh(shape: Element, path: Path, packages: Mapping[str, str | Path]) -> Mesh | None:
    """A geometry with its origin in its middle; None of a kind that has no surface."""
    if shape.tag == "mesh":
        file = _found(shape.get("filename", ""), path, packages)
        assert file is not None  # as _check_meshes has seen
        scale = np.array(_numbers(shape.get("scale", "1 1 1"), 3, "mesh scale")) * _unit(file)
        mesh = MeshFile(type="mesh", path=file).mesh()
        faces = mesh.faces[:, ::-1] if np.prod(scale) < 0 else mesh.faces  # mirrored, they would face inwards
        return mesh._replace(vertices_m=mesh.vertices_m * scale, faces=faces)
    if shape.tag == "box":
        x, y, height_m = _numbers(shape.get("size"), 3, "box size")
        mesh = Box(type="box", size_m=(x, y, height_m)).mesh()
    elif shape.tag == "cylinder":
        (radius_m,), (height_m,) = (_numbers(shape.get(key), 1, f"cylinder {key}") for key in ("radius", "length"))
        mesh = Cylinder(type="cylinder", radius_m=radius_m, height_m=height_m).mesh()
    elif shape.tag == "sphere":
        height_m = 2 * _numbers(shape.get("radius"), 1, "sphere radius")[0]
        mesh = Ellipsoid(type="ellipsoid", size_m=(height_m, height_m, height_m)).mesh()
    else:
        return None
    return mesh.moved(rigid(np.eye(3), (0.0, 0.0, -height_m / 2)))


def _unit(file: Path) -> float:
    """Metres of a unit of a COLLADA file, which says it; other formats are in metres."""
    if file.suffix.lower() != ".dae":
        return 1.0
    with file.open("rb") as opened:
        said = re.search(rb"<unit\b[^>]*\bmeter\s*=\s*[\"']([^\"']+)", opened.read(100_000))
    return _numbers(said[1].decode(), 1, f"{file.name}: unit")[0] if said else 1.0


Placed = tuple[dict[str, Any], Float64]


def _sensors(root: Element, vehicle_T_link: Mapping[str, Float64]) -> tuple[list[Placed], list[str]]:
    """Keys and pose of each sensor, and what was left out or assumed."""
    found: list[Placed] = []
    notes: list[str] = []
    for gazebo in root.findall("gazebo"):
        for sensor in gazebo.findall("sensor"):
            name, kind = sensor.get("name", "sensor"), sensor.get("type", "")
            if kind not in (*LIDARS, *CAMERAS):
                notes.append(f"Left out: {name}, of type {kind or 'none'}.")
                continue
            link = gazebo.get("reference", "")
            if link not in vehicle_T_link:
                raise ValueError(f"sensor {name!r} is on {link!r}, which is no link")
            vehicle_T_sensor = vehicle_T_link[link] @ _pose(sensor.find("pose"))
            each = [_lidar(sensor, name)] if kind in LIDARS else list(_cameras(sensor, name, kind, notes))
            for keys, sensor_T_own in each:
                taken = [other["name"] for other, _ in found]
                keys["name"] += f"_{len(found)}" * (keys["name"] in taken)
                if rate_hz := _asked(sensor, "update_rate", f"sensor {name!r}", 0.0):
                    keys["rate_hz"] = rate_hz
                found.append(_mounted(keys, vehicle_T_sensor @ sensor_T_own))
    return found, notes


def _mounted(keys: dict[str, Any], pose: Float64) -> Placed:
    """With its mount, to the tenth of a millimetre and the hundredth of a degree."""
    angles = dict(zip(("yaw_deg", "pitch_deg", "roll_deg"), euler_from_rotation(pose[:3, :3]).round(2), strict=True))
    values = dict(zip(("x_m", "y_m", "z_m"), pose[:3, 3].round(4), strict=True)) | angles
    mount = {key: float(value) for key, value in values.items() if value}
    first = {key: keys.pop(key) for key in ("type", "name")}
    return {**first, "mount": mount, **keys}, pose


def _asked(parent: Element, place: str, what: str, usual: float | None = None) -> float:
    text = parent.findtext(place)
    if text is None and usual is not None:
        return usual
    return _numbers(text, 1, f"{what}: {place}")[0]


def _lidar(sensor: Element, name: str) -> Placed:
    """Its columns are those that Gazebo samples, ends included; what looks to one side is turned there."""
    what = f"sensor {name!r}"
    block = next((found for tag in ("lidar", "ray") if (found := sensor.find(tag)) is not None), None)
    if block is None:
        raise ValueError(f"{what}: <lidar> or <ray> is missing")
    columns, rows = (
        round(_asked(block, f"scan/{axis}/samples", what, usual) * _asked(block, f"scan/{axis}/resolution", what, 1.0))
        for axis, usual in (("horizontal", None), ("vertical", 1.0))
    )
    left, right = (_asked(block, f"scan/horizontal/{end}_angle", what) for end in ("min", "max"))
    low, high = (_asked(block, f"scan/vertical/{end}_angle", what, 0.0) for end in ("min", "max"))
    spread_deg = math.degrees(right - left) * columns / max(columns - 1, 1)
    keys: dict[str, Any] = {
        "type": "lidar",
        "name": name,
        "channels": rows,
        "vertical_fov_deg": [round(math.degrees(low), 4), round(math.degrees(high), 4)],
        "horizontal_fov_deg": round(min(spread_deg, 360.0), 4) or 1.0,  # of a single column
        "columns": columns,
        **_ranges(block, "range/min", "range/max", what),
    }
    if noise := _asked(block, "noise/stddev", what, 0.0):
        keys["range_noise_m"] = noise
    return keys, rigid(rotation_from_euler(math.degrees((left + right) / 2), 0.0, 0.0), np.zeros(3))


def _cameras(sensor: Element, name: str, kind: str, notes: list[str]) -> Sequence[Placed]:
    cameras = sensor.findall("camera")
    if not cameras:
        raise ValueError(f"sensor {name!r}: <camera> is missing")
    if kind in ("camera", "multicamera"):
        notes.append(f"{name}: a camera, which counts as if it measured depth.")
    found = []
    for number, camera in enumerate(cameras):
        what = f"sensor {name!r}"
        own = camera.get("name", str(number)) if len(cameras) > 1 else ""
        clip = "depth_camera/clip" if camera.find("depth_camera/clip/far") is not None else "clip"
        keys: dict[str, Any] = {
            "type": "camera",
            "name": f"{name}_{own}" if own else name,
            "width": round(_asked(camera, "image/width", what)),
            "height": round(_asked(camera, "image/height", what)),
            "fov_deg": round(math.degrees(_asked(camera, "horizontal_fov", what)), 4),
            "stride": STRIDE,
            **_ranges(camera, f"{clip}/near", f"{clip}/far", what),
        }
        found.append((keys, _pose(camera.find("pose"))))
    return found


def _ranges(parent: Element, least: str, most: str, what: str) -> dict[str, float]:
    return {"min_range_m": _asked(parent, least, what, 0.0), "max_range_m": _asked(parent, most, what)}


def _without_housings(pieces: Sequence[Mesh], places_m: Sequence[Float64]) -> list[Mesh]:
    """Those whose box holds no sensor, those that are no housing, and whatever happens the largest."""
    kept = []
    longest_m = [float(np.linalg.norm(np.ptp(piece.vertices_m, axis=0))) for piece in pieces]
    for piece, length_m in zip(pieces, longest_m, strict=True):
        low_m, high_m = piece.vertices_m.min(axis=0), piece.vertices_m.max(axis=0)
        held = any((low_m <= at_m).all() and (at_m <= high_m).all() for at_m in places_m)
        if not held or length_m >= min(LARGEST_HOUSING_M, max(longest_m)):
            kept.append(piece)
    return kept
