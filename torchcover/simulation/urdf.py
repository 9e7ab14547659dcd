"""Robots in URDF files: their bodies, and the sensors that Gazebo would simulate on them."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
from torchcover.simulation.mounted_sensor import count_self_hits, describe_self_hits
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.rig import Rig
from torchcover.simulation.scene_snapshot import is_enclosed
from torchcover.simulation.sensor import Sensor
from torchcover.simulation.shapes import Box, Cylinder, Ellipsoid, Mesh, MeshFile


@dataclass(frozen=True)
class HousingParams:
    """Parameters of the search for the housings of sensors.

    Args:
        max_length_m: Larger bodies carry a sensor, but are not its housing.
        min_hit_share: A housing with openings is hit by at least this share of the rays of a sensor inside it; a
            guard of posts is hit by fewer.
    """

    max_length_m: float = 0.5
    min_hit_share: float = 0.99


class Robot(NamedTuple):
    """Robot of a URDF file.

    Args:
        name: Its name.
        body: Its body in the vehicle frame, whose origin is on the ground below the center of the bounding box.
        sensors: Keys of each sensor in a rig.
        notes: Notes about exclusions and assumptions.
    """

    name: str
    body: Mesh
    sensors: list[dict[str, Any]]
    notes: list[str]

    def save(self, folder: str | Path) -> list[Path]:
        """Write `body.ply`, `vehicle.yaml` and, if there are sensors, `rig.yaml` on that vehicle.

        Args:
            folder: Output folder; created if it does not exist.

        Returns:
            Paths of the files.
        """
        length_m, width_m, height_m = np.ptp(self.body.vertices_m, axis=0)
        size = f"{length_m:.2f} x {width_m:.2f} x {height_m:.2f} m, of a URDF."
        names = {"name": self.name, "description": " ".join([size, *self.notes])}
        part = {"name": "body", "shape": {"type": "mesh", "path": "body.ply"}}
        with AtomicOutput(Path(folder)) as files:
            files.add("body.ply", partial(_write_ply, mesh=self.body))
            files.add_text("vehicle.yaml", to_yaml({**names, "parts": [part]}))
            if self.sensors:
                files.add_text("rig.yaml", to_yaml({**names, "vehicle": "vehicle.yaml", "sensors": self.sensors}))
            files.publish({"robot": self.name, "notes": self.notes})
        return files.paths


def _write_ply(path: Path, mesh: Mesh) -> None:
    """Write a mesh as a binary PLY file."""
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(mesh.vertices_m)}\nproperty float x\n"
        f"property float y\nproperty float z\nelement face {len(mesh.faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("indices", "<i4", 3)])
    faces["count"], faces["indices"] = 3, mesh.faces
    path.write_bytes(header.encode() + mesh.vertices_m.astype("<f4").tobytes() + faces.tobytes())


@guard_reader("a URDF")
def read_robot(path: Path, packages: Mapping[str, str | Path] | None = None) -> Robot:
    """Read a robot from a URDF file, with every joint at 0 except joints that mimic another one with an offset.

    The body consists of the `visual` geometry of links, or of the `collision` geometry of links without any. Sensors
    are the LiDARs, cameras and depth cameras in Gazebo tags. The housings of sensors are excluded: small bodies that
    enclose a sensor or are hit by nearly all of its rays.

    Args:
        path: The file; xacro must be expanded before.
        packages: Folder of each ROS package, by its name. Other packages are searched around the file: a folder of this
            name, or one that contains the rest of the path.

    Returns:
        The robot: its body in the vehicle frame, in meters, and the keys of its sensors as in YAML.

    Raises:
        BadFileError: The file is no URDF, the links form no tree, meshes are missing, a sensor lacks a setting, a
            number is invalid, or an attribute that changes values is not supported.

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
        raise ValueError(f"xacro must be expanded before it is read: xacro {path.name} > {path.stem}_expanded.urdf")
    if root.tag != "robot" or root.find("link") is None:
        remedy = f"; {find_remedy('robot.sdf')}" * (root.tag == "sdf")
        raise ValueError(f"a <robot> with links is needed; got <{root.tag}>{remedy}")
    links, joints = _index_by_name(root, "link"), _index_by_name(root, "joint")
    positions = _compute_joint_positions(joints)
    base_T_link = _compute_link_poses(links, joints, positions)
    meshes = _read_meshes(links, path, packages or {})
    pieces = []
    with np.errstate(over="ignore", invalid="ignore"):  # lengths of 1e308 m are refused below
        for name, link in links.items():
            pieces += [mesh.transform(base_T_link[name]) for mesh in _build_link_meshes(link, meshes)]
    if not pieces:
        raise ValueError("no link has a visual or collision geometry, so there is no body")
    vertices_m = merge_meshes(pieces).vertices_m
    if not np.abs(vertices_m).max() <= FARTHEST_M:  # also refuses NaN
        raise ValueError(f"the body reaches beyond {FARTHEST_M:g} m; check the units of its sizes, origins and meshes")
    # The origin of the vehicle frame is on the ground below the center of the body.
    box = BoundingBox.from_points(vertices_m)
    center_m = np.add(box.lower_m, box.upper_m) / 2
    vehicle_T_base = build_transform(np.eye(3), (-center_m[0], -center_m[1], -box.lower_m[2]))
    pieces = [piece.transform(vehicle_T_base) for piece in pieces]
    vehicle_T_frame = {"__model__": vehicle_T_base}
    for name, joint in joints.items():
        vehicle_T_frame[name] = vehicle_T_base @ base_T_link[_get_joint_link(joint, "child")]
    vehicle_T_frame |= {name: vehicle_T_base @ pose for name, pose in base_T_link.items()}
    sensors, notes = read_sensors(root, vehicle_T_frame)
    body_pieces = _exclude_housings(pieces, sensors)
    if num_housings := len(pieces) - len(body_pieces):
        notes.append(f"Excluded: housings of sensors, {num_housings} of {len(pieces)} bodies.")
    notes += _check_joint_limits(joints, positions)
    body = merge_meshes(body_pieces)
    if sensors and (self_hits := describe_self_hits(_build_sensors(sensors), body)):
        notes.append(self_hits)
    return Robot(root.get("name", path.stem), body, [sensor.sensor_keys for sensor in sensors], notes)


def _index_by_name(root: Element, tag: str) -> dict[str, Element]:
    """Index the children of a tag by their names, which must be different."""
    elements = root.findall(tag)
    counts = Counter(element.get("name", "") for element in elements)
    if repeated := sorted(name for name, count in counts.items() if count > 1):
        raise ValueError(f"several of <{tag}> are named {', '.join(map(repr, repeated))}")
    return {element.get("name", ""): element for element in elements}


def _get_joint_link(joint: Element, tag: str) -> str:
    """Get the name of the `parent` or `child` link of a joint."""
    element = joint.find(tag)
    return "" if element is None else element.get("link", "")


def _compute_joint_positions(joints: Mapping[str, Element]) -> dict[str, float]:
    """Compute the position of each joint in radians or meters: 0, or the scaled position of the joint it mimics."""
    positions: dict[str, float] = {}
    for name in joints:
        followers: dict[str, Element] = {}
        # Follow the chain of joints that mimic each other up to a known position.
        while name not in positions and (mimic := joints[name].find("mimic")) is not None:
            followers[name] = mimic
            name = mimic.get("joint", "")  # noqa: PLW2901  (along the chain of joints that mimic each other)
            if name not in joints:
                raise ValueError(f"joint {next(reversed(followers))!r} mimics {name!r}, which is no joint")
            if name in followers:
                raise ValueError(f"joint {name!r} mimics itself, through others")
        positions.setdefault(name, 0.0)
        for follower, mimic in reversed(followers.items()):
            (multiplier,) = read_numbers(mimic.get("multiplier", "1"), 1, f"joint {follower!r}: mimic multiplier")
            (offset,) = read_numbers(mimic.get("offset", "0"), 1, f"joint {follower!r}: mimic offset")
            positions[follower] = multiplier * positions[name] + offset
            name = follower  # noqa: PLW2901
    return positions


def _compute_joint_motion(joint: Element, position: float) -> Float64:
    """Compute the (4, 4) transform by which a joint moves its child link; `position` is in radians or meters."""
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


def _compute_link_poses(
    links: Mapping[str, Element], joints: Mapping[str, Element], positions: Mapping[str, float]
) -> dict[str, Float64]:
    """Compute the (4, 4) pose of each link in the frame of the root link."""
    parent_and_joint: dict[str, tuple[str, str]] = {}
    children: dict[str, list[str]] = {name: [] for name in links}
    for name, joint in joints.items():
        parent, child = _get_joint_link(joint, "parent"), _get_joint_link(joint, "child")
        for link in (parent, child):
            if link not in links:
                raise ValueError(f"joint {name!r} refers to {link!r}, which is no link")
        if child in parent_and_joint:
            first_parent, _ = parent_and_joint[child]
            raise ValueError(f"link {child!r} is the child of {first_parent!r} and of {parent!r}: a tree is needed")
        parent_and_joint[child] = parent, name
        children[parent].append(child)
    roots = [name for name in links if name not in parent_and_joint]
    if len(roots) > 1:
        raise ValueError(
            f"links {_list_names([repr(name) for name in roots])} have no parent: a tree with one root is needed"
        )
    poses: dict[str, Float64] = {}
    open_links = roots
    while open_links:
        name = open_links.pop()
        poses[name] = np.eye(4)
        if name in parent_and_joint:
            parent, joint_name = parent_and_joint[name]
            joint = joints[joint_name]
            motion = _compute_joint_motion(joint, positions[joint_name])
            poses[name] = poses[parent] @ read_pose(joint.find("origin")) @ motion
        open_links += children[name]
    if unreached := [name for name in links if name not in poses]:
        raise ValueError(f"links {_list_names([repr(name) for name in unreached])} form a ring: a tree is needed")
    return poses


def _list_names(names: Sequence[str], max_names: int = 3) -> str:
    """List the first few names, and the number of the others."""
    text = ", ".join(names[:max_names])
    return text if len(names) <= max_names else f"{text} and {len(names) - max_names} more"


def _check_joint_limits(joints: Mapping[str, Element], positions: Mapping[str, float]) -> list[str]:
    """Check the positions of joints: a list with a note about joints outside of their limits, empty without any."""
    outside = []
    for name, joint in joints.items():
        limit = joint.find("limit")
        if limit is None or joint.get("type") not in ("revolute", "prismatic"):
            continue
        (lower,) = read_numbers(limit.get("lower", "0"), 1, f"joint {name!r}: limit lower")
        (upper,) = read_numbers(limit.get("upper", "0"), 1, f"joint {name!r}: limit upper")
        if not lower <= positions[name] <= upper:
            unit = "m" if joint.get("type") == "prismatic" else "rad"
            outside.append(f"{name!r} at {positions[name]:g} {unit} ({lower:g} to {upper:g})")
    if not outside:
        return []
    return [f"Joints outside of their limits: {_list_names(outside)}; the body is built with these positions."]


def _find_geometry(link: Element) -> list[Element]:
    """Find the visual elements of a link, or its collision elements without any."""
    return link.findall("visual") or link.findall("collision")


def _read_meshes(links: Mapping[str, Element], path: Path, packages: Mapping[str, str | Path]) -> dict[str, Mesh]:
    """Read all mesh files of a robot, by their names. ValueError: files are missing."""
    files: dict[str, Path] = {}
    missing = list[str]()
    for link in links.values():
        for geometry in _find_geometry(link):
            for element in geometry.iterfind("geometry/mesh"):
                name = element.get("filename", "")
                if name in files or name in missing:
                    continue
                file = _find_mesh(name, path, packages)
                if file is None:
                    missing.append(name)
                else:
                    files[name] = file
    if missing:
        names = f"{len(missing)} of {len(files) + len(missing)} meshes are missing: {_list_names(missing)}"
        raise ValueError(f"{names}. Name the folder of a ROS package: --package NAME=FOLDER")
    return {name: MeshFile(type="mesh", path=file).build_mesh() for name, file in files.items()}


def _find_mesh(name: str, path: Path, packages: Mapping[str, str | Path]) -> Path | None:
    """Find the file of a mesh; None if there is none."""
    scheme, _, uri_path = name.rpartition("://")
    package, _, package_path = uri_path.partition("/")
    candidates = []
    if scheme not in ("package", "model"):
        candidates.append(path.parent / uri_path)
    elif package in packages:
        candidates.append(Path(packages[package], package_path))
    else:  # ROS would find the package by its name: look for its folder around the file
        for parent in path.resolve().parents:
            candidates += [parent / uri_path, parent / package_path]
    for candidate in candidates:
        if uri_path and candidate.is_file():
            return candidate
    return None


def _build_link_meshes(link: Element, meshes: Mapping[str, Mesh]) -> list[Mesh]:
    """Build the meshes of a link in its frame. ValueError: an invalid shape, such as one of negative size."""
    name, link_meshes = link.get("name", ""), []
    for geometry in _find_geometry(link):
        for shape in geometry.iterfind("geometry/*"):
            try:
                mesh = _build_shape_mesh(shape, name, meshes)
            except ValidationError as error:
                raise ValueError(f"link {name!r}: <{shape.tag}>: {explain_document_error(error)}") from error
            link_meshes.append(mesh.transform(read_pose(geometry.find("origin"))))
    return link_meshes


def _build_shape_mesh(shape: Element, link: str, meshes: Mapping[str, Mesh]) -> Mesh:
    """Build the mesh of a geometry with its origin in the center."""
    if shape.tag == "mesh":
        mesh = meshes[shape.get("filename", "")]
        scale = np.array(read_numbers(shape.get("scale", "1 1 1"), 3, "mesh scale"))
        faces = mesh.faces[:, ::-1] if np.prod(scale) < 0 else mesh.faces  # mirrored faces would face inwards
        return mesh._replace(vertices_m=mesh.vertices_m * scale, faces=faces)
    if shape.tag == "box":
        x, y, height_m = read_numbers(shape.get("size"), 3, "box size")
        return _center_mesh(Box.model_validate({"type": "box", "size_m": (x, y, height_m)}).build_mesh(), height_m)
    if shape.tag not in ("cylinder", "capsule", "sphere"):
        raise ValueError(
            f"link {link!r}: geometry <{shape.tag}> cannot be applied; use box, cylinder, capsule, sphere or mesh"
        )
    (radius_m,) = read_numbers(shape.get("radius"), 1, f"{shape.tag} radius")
    ellipsoid = Ellipsoid.model_validate({"type": "ellipsoid", "size_m": (2 * radius_m,) * 3})
    ball = _center_mesh(ellipsoid.build_mesh(), 2 * radius_m)
    if shape.tag == "sphere":
        return ball
    (length_m,) = read_numbers(shape.get("length"), 1, f"{shape.tag} length")
    cylinder = Cylinder.model_validate({"type": "cylinder", "radius_m": radius_m, "height_m": length_m})
    tube = _center_mesh(cylinder.build_mesh(), length_m)
    if shape.tag == "cylinder":
        return tube
    capsule = [tube]
    for end_m in (-length_m / 2, length_m / 2):
        capsule.append(ball.transform(build_transform(np.eye(3), (0.0, 0.0, end_m))))
    return merge_meshes(capsule)


def _center_mesh(mesh: Mesh, height_m: float) -> Mesh:
    """Center a mesh that stands on its origin."""
    return mesh.transform(build_transform(np.eye(3), (0.0, 0.0, -height_m / 2)))


def _build_sensors(sensors: Sequence[PlacedSensor]) -> Sequence[Sensor]:
    """Build the sensors of a rig. ValueError: an invalid sensor, such as one with a range of 0."""
    try:
        return Rig.model_validate({"name": "robot", "sensors": [sensor.sensor_keys for sensor in sensors]}).sensors
    except ValidationError as error:
        raise ValueError(explain_document_error(error)) from error


def _exclude_housings(
    pieces: Sequence[Mesh], sensors: Sequence[PlacedSensor], params: HousingParams = HousingParams()
) -> list[Mesh]:
    """Exclude the housings of sensors from the pieces of a body; the largest piece is never excluded."""
    if not sensors:
        return list(pieces)
    # Only bodies near a sensor can be its housing: robots may have thousands of links.
    tree = cKDTree([sensor.vehicle_T_sensor[:3, 3] for sensor in sensors])
    lengths_m = [float(np.linalg.norm(np.ptp(piece.vertices_m, axis=0))) for piece in pieces]
    body_pieces = []
    for piece, length_m in zip(pieces, lengths_m, strict=True):
        center_m = (piece.vertices_m.min(axis=0) + piece.vertices_m.max(axis=0)) / 2
        is_small = length_m < min(params.max_length_m, max(lengths_m))
        nearby = tree.query_ball_point(center_m, length_m / 2) if is_small else []
        if not any(_is_housing(piece, sensors[index], params) for index in nearby):
            body_pieces.append(piece)
    return body_pieces


def _is_housing(piece: Mesh, sensor: PlacedSensor, params: HousingParams) -> bool:
    """Test whether a piece encloses a sensor, or is hit by nearly all of its rays."""
    position_m = sensor.vehicle_T_sensor[:3, 3]
    lower_m, upper_m = piece.vertices_m.min(axis=0), piece.vertices_m.max(axis=0)
    if not ((lower_m <= position_m) & (position_m <= upper_m)).all():
        return False
    if is_enclosed(RayCaster([piece]), position_m):
        return True
    num_hits, num_rays = count_self_hits(_build_sensors([sensor])[0], piece)
    return num_hits >= params.min_hit_share * num_rays
