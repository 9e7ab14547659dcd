"""Robots described in URDF: their bodies, and the sensors that Gazebo would simulate on them."""

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
from pydantic import ValidationError
from scipy.spatial import cKDTree

from torchcover.files import AtomicOutput, guard_reader, parse_xml, to_yaml
from torchcover.geometry import BoundingBox, build_transform, convert_quaternion_to_rotation
from torchcover.geometry.arrays import Float64
from torchcover.recordings.unsupported_formats import find_remedy
from torchcover.simulation.bodies import merge_meshes
from torchcover.simulation.documents import FARTHEST_M, explain_document_error
from torchcover.simulation.gazebo_sensors import PlacedSensor, read_numbers, read_pose, read_sensors
from torchcover.simulation.instant import is_enclosed
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.rig import Rig
from torchcover.simulation.sensor import Sensor
from torchcover.simulation.shapes import Box, Cylinder, Ellipsoid, Mesh, MeshFile
from torchcover.simulation.sight import count_self_hits, describe_self_hits

# Larger bodies hold a sensor, but are not its housing.
LARGEST_HOUSING_M = 0.5
# A housing that is not closed takes at least this share of the rays of a sensor inside of it; a guard of posts less.
HOUSING_SHARE = 0.99
# Joints and meshes that a message names.
MAX_NAMED = 3
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

        """
        size = " x ".join(f"{length:.2f}" for length in np.ptp(self.body.vertices_m, axis=0))
        told = " ".join([f"{size} m, of a URDF.", *self.notes])
        part = {"name": "body", "shape": {"type": "mesh", "path": BODY}}
        with AtomicOutput(Path(folder)) as written:
            written.add(BODY, partial(_write_ply, mesh=self.body))
            written.add_text(VEHICLE, to_yaml({"name": self.name, "description": told, "parts": [part]}))
            if self.sensors:
                keys = {"name": self.name, "description": told, "vehicle": VEHICLE, "sensors": self.sensors}
                written.add_text(RIG, to_yaml(keys))
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


@guard_reader("a URDF")
def read_robot(path: Path, packages: Mapping[str, str | Path] | None = None) -> Robot:
    """Read a robot from a URDF file, with every joint at 0 except those that mimic another one with an offset.

    Its body is what links show (`visual`), or where they show nothing, what they collide with. Sensors are those of
    Gazebo's tags: LiDARs, cameras and depth cameras. A small body that a sensor is built into is left out: one that
    encloses the sensor, or that ends nearly all of its rays.

    Args:
        path: The file; one of xacro has to be expanded first.
        packages: Name of a ROS package -> its folder. Others are looked for around the file: a folder of this name, or
            one that has the rest of the path.

    Returns:
        The robot: its body in the vehicle frame, in meters, and the keys of its sensors as in YAML.

    Raises:
        BadFileError: Not a URDF; links that are no tree; meshes that are missing, all of them named; a sensor without
            what it needs; numbers that are none; an attribute that changes values and cannot be applied.

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
        remedy = f"; {find_remedy('robot.sdf')}" * (root.tag == "sdf")
        raise ValueError(f"a <robot> with links is needed; got <{root.tag}>{remedy}")
    links, joints = _by_name(root, "link"), _by_name(root, "joint")
    positions = _joint_positions(joints)
    base_T_link = _link_poses(links, joints, positions)
    meshes = _read_meshes(links, path, packages or {})
    with np.errstate(over="ignore", invalid="ignore"):  # lengths of 1e308 m: refused below
        pieces = [
            mesh.transform(base_T_link[name]) for name, link in links.items() for mesh in _link_meshes(link, meshes)
        ]
    if not pieces:
        raise ValueError("no link has a visual or collision geometry, so there is no body")
    vertices_m = merge_meshes(pieces).vertices_m
    if not np.abs(vertices_m).max() <= FARTHEST_M:  # also refuses NaN
        raise ValueError(f"the body reaches beyond {FARTHEST_M:g} m; check the units of its sizes, origins and meshes")
    box = BoundingBox.from_points(vertices_m)
    middle_m = np.add(box.lower_m, box.upper_m) / 2
    vehicle_T_base = build_transform(np.eye(3), (-middle_m[0], -middle_m[1], -box.lower_m[2]))
    pieces = [piece.transform(vehicle_T_base) for piece in pieces]
    vehicle_T_frame = {"__model__": vehicle_T_base}
    for name, joint in joints.items():
        vehicle_T_frame[name] = vehicle_T_base @ base_T_link[_end(joint, "child")]
    vehicle_T_frame |= {name: vehicle_T_base @ pose for name, pose in base_T_link.items()}
    sensors, notes = read_sensors(root, vehicle_T_frame)
    kept = _without_housings(pieces, sensors)
    if left_out := len(pieces) - len(kept):
        notes.append(f"Left out: what sensors are built into, {left_out} of {len(pieces)} bodies.")
    notes += _note_limits(joints, positions)
    body = merge_meshes(kept)
    if sensors:
        notes += filter(None, [describe_self_hits(_mounted(sensors), body)])
    return Robot(root.get("name", path.stem), body, [sensor.sensor_keys for sensor in sensors], notes)


def _by_name(root: Element, tag: str) -> dict[str, Element]:
    elements = root.findall(tag)
    counts = Counter(element.get("name", "") for element in elements)
    if repeated := sorted(name for name, count in counts.items() if count > 1):
        raise ValueError(f"several of <{tag}> are called {', '.join(map(repr, repeated))}")
    return {element.get("name", ""): element for element in elements}


def _end(joint: Element, tag: str) -> str:
    """Name of the link at the end of a joint, its `parent` or `child`."""
    end = joint.find(tag)
    return "" if end is None else end.get("link", "")


def _joint_positions(joints: Mapping[str, Element]) -> dict[str, float]:
    """Position of each joint in radians or meters: 0, or of one that mimics another, `multiplier * other + offset`."""
    positions: dict[str, float] = {}
    for name in joints:
        followers: dict[str, Element] = {}
        while name not in positions and (mimic := joints[name].find("mimic")) is not None:
            followers[name] = mimic
            name = mimic.get("joint", "")  # noqa: PLW2901  (along the chain of joints that mimic each other)
            if name not in joints:
                raise ValueError(f"joint {next(reversed(followers))!r} mimics {name!r}, which is no joint")
            if name in followers:
                raise ValueError(f"joint {name!r} mimics itself, through others")
        positions.setdefault(name, 0.0)
        for follower, mimic in reversed(followers.items()):
            what = f"joint {follower!r}: mimic"
            (multiplier,), (offset,) = (
                read_numbers(mimic.get(key, usual), 1, f"{what} {key}")
                for key, usual in (("multiplier", "1"), ("offset", "0"))
            )
            positions[follower] = multiplier * positions[name] + offset
            name = follower  # noqa: PLW2901
    return positions


def _joint_motion(joint: Element, position: float) -> Float64:
    """(4, 4) transform by which a joint moves its child link; `position` is in radians or meters."""
    kind = joint.get("type", "")
    if position == 0.0 or kind not in ("revolute", "continuous", "prismatic"):
        return np.eye(4)
    axis = joint.find("axis")
    direction = np.array(read_numbers("1 0 0" if axis is None else axis.get("xyz", "1 0 0"), 3, "axis xyz"))
    direction /= np.linalg.norm(direction) or 1.0
    if kind == "prismatic":
        return build_transform(np.eye(3), position * direction)
    quaternion = [np.cos(position / 2), *np.sin(position / 2) * direction]
    return build_transform(convert_quaternion_to_rotation(quaternion), np.zeros(3))


def _link_poses(
    links: Mapping[str, Element], joints: Mapping[str, Element], positions: Mapping[str, float]
) -> dict[str, Float64]:
    """Name of each link -> its (4, 4) pose in the frame of the root."""
    above: dict[str, tuple[str, str]] = {}
    children: dict[str, list[str]] = {name: [] for name in links}
    for name, joint in joints.items():
        parent, child = _end(joint, "parent"), _end(joint, "child")
        if unknown := [end for end in (parent, child) if end not in links]:
            raise ValueError(f"joint {name!r} is about {unknown[0]!r}, which is no link")
        if child in above:
            raise ValueError(f"link {child!r} hangs on {above[child][0]!r} and on {parent!r}: a tree is needed")
        above[child] = parent, name
        children[parent].append(child)
    roots = [name for name in links if name not in above]
    if len(roots) > 1:
        raise ValueError(
            f"links {_list_first([*map(repr, roots)])} hang on no other: one is needed that all others hang on"
        )
    poses: dict[str, Float64] = {}
    waiting = roots
    while waiting:
        name = waiting.pop()
        if name in above:
            parent, joint_name = above[name]
            joint = joints[joint_name]
            poses[name] = poses[parent] @ read_pose(joint.find("origin")) @ _joint_motion(joint, positions[joint_name])
        else:
            poses[name] = np.eye(4)
        waiting += children[name]
    if ring := [name for name in links if name not in poses]:
        raise ValueError(f"links {_list_first([*map(repr, ring)])} hang on each other in a ring: a tree is needed")
    return poses


def _list_first(words: Sequence[str]) -> str:
    """Join the first few words, and say how many more there are."""
    return ", ".join(words[:MAX_NAMED]) + f" and {len(words) - MAX_NAMED} more" * (len(words) > MAX_NAMED)


def _note_limits(joints: Mapping[str, Element], positions: Mapping[str, float]) -> list[str]:
    """Note the joints whose position lies outside of their limits."""
    outside = []
    for name, joint in joints.items():
        limit = joint.find("limit")
        if limit is None or joint.get("type") not in ("revolute", "prismatic"):
            continue
        lower, upper = (
            read_numbers(limit.get(key, "0"), 1, f"joint {name!r}: limit {key}")[0] for key in ("lower", "upper")
        )
        if not lower <= positions[name] <= upper:
            unit = "m" if joint.get("type") == "prismatic" else "rad"
            outside.append(f"{name!r} at {positions[name]:g} {unit} ({lower:g} to {upper:g})")
    if not outside:
        return []
    return [f"Joints outside of their limits: {_list_first(outside)}; the body is drawn as if they could."]


def _visuals(link: Element) -> list[Element]:
    return link.findall("visual") or link.findall("collision")


def _read_meshes(links: Mapping[str, Element], path: Path, packages: Mapping[str, str | Path]) -> dict[str, Mesh]:
    """Name of each mesh file -> the mesh.

    Raises:
        ValueError: Files are missing.
    """
    elements = [mesh for link in links.values() for body in _visuals(link) for mesh in body.iterfind("geometry/mesh")]
    files = {name: _find_mesh(name, path, packages) for name in {mesh.get("filename", ""): None for mesh in elements}}
    if missing := [name for name, file in files.items() if file is None]:
        raise ValueError(
            f"{len(missing)} of {len(files)} meshes are missing: {_list_first(missing)}. Name the folder of a ROS "
            "package: --package NAME=FOLDER"
        )
    return {name: MeshFile(type="mesh", path=file).build_mesh() for name, file in files.items() if file is not None}


def _find_mesh(name: str, path: Path, packages: Mapping[str, str | Path]) -> Path | None:
    """Find the file of a mesh; None if there is none."""
    scheme, _, rest = name.rpartition("://")
    package, _, within = rest.partition("/")
    if scheme in ("package", "model"):
        around = [parent / part for parent in path.resolve().parents for part in (rest, within)]
        candidates = [Path(packages[package], within)] if package in packages else around
    else:
        candidates = [path.parent / rest]
    return next((candidate for candidate in candidates if within + rest and candidate.is_file()), None)


def _link_meshes(link: Element, meshes: Mapping[str, Mesh]) -> list[Mesh]:
    """The meshes that a link shows, in its frame. ValueError: a shape that cannot be, such as one of negative size."""
    name, shown = link.get("name", ""), []
    for body in _visuals(link):
        for shape in body.iterfind("geometry/*"):
            try:
                mesh = _shape_mesh(shape, name, meshes)
            except ValidationError as error:
                raise ValueError(f"link {name!r}: <{shape.tag}>: {explain_document_error(error)}") from error
            shown.append(mesh.transform(read_pose(body.find("origin"))))
    return shown


def _shape_mesh(shape: Element, link: str, meshes: Mapping[str, Mesh]) -> Mesh:
    """The mesh of a geometry, with its origin in its middle."""
    if shape.tag == "mesh":
        mesh = meshes[shape.get("filename", "")]
        scale = np.array(read_numbers(shape.get("scale", "1 1 1"), 3, "mesh scale"))
        faces = mesh.faces[:, ::-1] if np.prod(scale) < 0 else mesh.faces  # mirrored, they would face inwards
        return mesh._replace(vertices_m=mesh.vertices_m * scale, faces=faces)
    if shape.tag == "box":
        x, y, height_m = read_numbers(shape.get("size"), 3, "box size")
        return _centered(Box.model_validate({"type": "box", "size_m": (x, y, height_m)}).build_mesh(), height_m)
    if shape.tag not in ("cylinder", "capsule", "sphere"):
        raise ValueError(
            f"link {link!r}: geometry <{shape.tag}> cannot be applied; use box, cylinder, capsule, sphere or mesh"
        )
    (radius_m,) = read_numbers(shape.get("radius"), 1, f"{shape.tag} radius")
    ellipsoid = Ellipsoid.model_validate({"type": "ellipsoid", "size_m": (2 * radius_m,) * 3})
    ball = _centered(ellipsoid.build_mesh(), 2 * radius_m)
    if shape.tag == "sphere":
        return ball
    (length_m,) = read_numbers(shape.get("length"), 1, f"{shape.tag} length")
    cylinder = Cylinder.model_validate({"type": "cylinder", "radius_m": radius_m, "height_m": length_m})
    tube = _centered(cylinder.build_mesh(), length_m)
    if shape.tag == "cylinder":
        return tube
    ends_m = (-length_m / 2, length_m / 2)
    return merge_meshes([tube, *(ball.transform(build_transform(np.eye(3), (0.0, 0.0, end_m))) for end_m in ends_m)])


def _centered(mesh: Mesh, height_m: float) -> Mesh:
    return mesh.transform(build_transform(np.eye(3), (0.0, 0.0, -height_m / 2)))


def _mounted(sensors: Sequence[PlacedSensor]) -> Sequence[Sensor]:
    """The sensors as those of a rig. ValueError: one that no rig can have, such as one with a range of 0."""
    try:
        return Rig.model_validate({"name": "robot", "sensors": [sensor.sensor_keys for sensor in sensors]}).sensors
    except ValidationError as error:
        raise ValueError(explain_document_error(error)) from error


def _without_housings(pieces: Sequence[Mesh], sensors: Sequence[PlacedSensor]) -> list[Mesh]:
    """All pieces of the body except the housings of sensors; the largest piece stays in any case."""
    if not sensors:
        return list(pieces)
    tree = cKDTree([sensor.vehicle_T_sensor[:3, 3] for sensor in sensors])
    longest_m = [float(np.linalg.norm(np.ptp(piece.vertices_m, axis=0))) for piece in pieces]
    kept = []
    for piece, length_m in zip(pieces, longest_m, strict=True):
        middle_m = (piece.vertices_m.min(axis=0) + piece.vertices_m.max(axis=0)) / 2
        is_small = length_m < min(LARGEST_HOUSING_M, max(longest_m))
        near = tree.query_ball_point(middle_m, length_m / 2) if is_small else []
        if not any(_is_housing(piece, sensors[k]) for k in near):
            kept.append(piece)
    return kept


def _is_housing(piece: Mesh, sensor: PlacedSensor) -> bool:
    """Whether a sensor is inside a piece of the body: closed around it, or across nearly all of its rays."""
    position_m = sensor.vehicle_T_sensor[:3, 3]
    lower_m, upper_m = piece.vertices_m.min(axis=0), piece.vertices_m.max(axis=0)
    if not ((lower_m <= position_m) & (position_m <= upper_m)).all():
        return False
    if is_enclosed(RayCaster([piece]), position_m):
        return True
    self_hits, rays = count_self_hits(_mounted([sensor])[0], piece)
    return self_hits >= HOUSING_SHARE * rays
