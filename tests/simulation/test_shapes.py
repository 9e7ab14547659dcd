"""Shapes are closed, face outwards, and have the volume of their formula."""

import numpy as np
import pytest

from torchcover.simulation import Rig, SimulatedFrames, list_builtin_names
from torchcover.simulation.bodies import Body, Vehicle, VehicleShape, build_actor_mesh
from torchcover.simulation.body_size import HIGH_REMEDY, WIDE_REMEDY
from torchcover.simulation.documents import Pose
from torchcover.simulation.scenario import ActorDescription
from torchcover.simulation.shapes import Box, Cylinder, Ellipsoid, Frustum, MeshFile

TETRAHEDRON = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
element face 4
property list uchar int vertex_indices
end_header
0 0 0
1000 0 0
0 1000 0
0 0 1000
3 0 2 1
3 0 1 3
3 0 3 2
3 1 2 3
"""


# Bands between rings of radius cos(30 k degrees): frusta over a polygon of twelve sides, whose area is 3 r^2.
RADII, HEIGHTS = np.cos(np.deg2rad(np.arange(-90, 91, 30))), np.sin(np.deg2rad(np.arange(-90, 91, 30)))
BANDED_SPHERE = float((np.diff(HEIGHTS) * (RADII[:-1] ** 2 + RADII[:-1] * RADII[1:] + RADII[1:] ** 2)).sum())


def compute_signed_volume(mesh):
    a, b, c = (mesh.vertices_m[mesh.faces[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def count_edges(mesh):
    """Count directed edges; in a closed mesh with consistent normals each has exactly one opposite."""
    directed = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    forward = {tuple(edge) for edge in directed.tolist()}
    return len(directed), len(forward), forward == {(b, a) for a, b in forward}


@pytest.mark.parametrize(
    ("shape", "volume"),
    [
        (Box(type="box", size_m=(2, 3, 4)), 24.0),
        (Frustum(type="frustum", bottom_m=(2, 3), top_m=(2, 3), height_m=4, top_shift_m=1), 24.0),
        # Integral of (4 - 2t)(2 - t) over the height of 3.
        (Frustum(type="frustum", bottom_m=(4, 2), top_m=(2, 1), height_m=3), 3 * 2 * (4 - 4 / 2 + 1 / 3)),
        (Cylinder(type="cylinder", radius_m=2, height_m=5), 5 * 0.5 * 24 * 4 * np.sin(2 * np.pi / 24)),
        (Cylinder(type="cylinder", radius_m=2, height_m=5, sides=4), 5 * 2 * 4),
        (Ellipsoid(type="ellipsoid", size_m=(2, 4, 6)), 6 * BANDED_SPHERE),
    ],
)
def test_solids_are_closed_outward_and_have_their_volume(shape, volume):
    mesh = shape.build_mesh()
    edges, distinct, paired = count_edges(mesh)
    assert edges == distinct
    assert paired
    assert compute_signed_volume(mesh) == pytest.approx(volume, rel=1e-12)
    assert mesh.vertices_m[:, 2].min() == 0.0


def test_ellipsoid_corners_lie_on_its_surface():
    mesh = Ellipsoid(type="ellipsoid", size_m=(0.2, 0.3, 0.5)).build_mesh()
    np.testing.assert_allclose(mesh.vertices_m.min(0), [-0.1, -0.15, 0.0], atol=1e-15)
    np.testing.assert_allclose(mesh.vertices_m.max(0), [0.1, 0.15, 0.5], atol=1e-15)
    on_sphere = (mesh.vertices_m - [0, 0, 0.25]) / [0.1, 0.15, 0.25]
    np.testing.assert_allclose(np.linalg.norm(on_sphere, axis=1), 1.0, rtol=1e-12)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (TETRAHEDRON.replace("1000 0 0", "nan 0 0"), r"1 of 4 vertices are NaN"),
        (TETRAHEDRON.split("3 0 2 1")[0].replace("face 4", "face 0"), "no face"),
        ("not a mesh at all", "cannot read it"),
        ("", "an empty file"),
    ],
)
def test_invalid_mesh_files_are_named(tmp_path, content, message):
    path = tmp_path / "bad.ply"
    path.write_text(content)
    with pytest.raises(ValueError, match=rf"bad\.ply: .*{message}"):
        MeshFile(type="mesh", path=path).build_mesh()


def format_ply(mesh, faces=slice(None)):
    """Format some faces of a mesh as an ASCII PLY file."""
    corners = [" ".join(f"{value:.9g}" for value in vertex) for vertex in mesh.vertices_m]
    triangles = [f"3 {a} {b} {c}" for a, b, c in mesh.faces[faces].tolist()]
    header = ["ply", "format ascii 1.0", f"element vertex {len(corners)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header"]
    return "\n".join([*header, *corners, *triangles, ""])


def write_mesh_file(folder, text, **options):
    path = folder / "body.ply"
    path.write_text(text)
    return MeshFile(type="mesh", path=path, **options)


CAR = Box(type="box", size_m=(4.9, 1.94, 1.63))


@pytest.mark.parametrize("shape", [CAR, Cylinder(type="cylinder", radius_m=2, height_m=5)])
def test_closed_meshes_cause_no_warning_in_any_format(tmp_path, shape):
    mesh = shape.build_mesh()
    # Warnings are errors in tests: a mesh that is read without a warning is complete.
    assert len(write_mesh_file(tmp_path, format_ply(mesh)).build_mesh().faces) == len(mesh.faces)
    # Each face has separate corners, as in STL; then half of the faces are flipped.
    apart = mesh._replace(
        vertices_m=mesh.vertices_m[mesh.faces.ravel()], faces=np.arange(mesh.faces.size).reshape(-1, 3)
    )
    assert len(write_mesh_file(tmp_path, format_ply(apart)).build_mesh().faces) == len(mesh.faces)
    flipped = mesh.faces.copy()
    flipped[::2] = flipped[::2, ::-1]
    write_mesh_file(tmp_path, format_ply(mesh._replace(faces=flipped))).build_mesh()
    # A face without area does not make a hole.
    write_mesh_file(tmp_path, format_ply(mesh._replace(faces=np.vstack([mesh.faces, [[0, 0, 1]]])))).build_mesh()


def format_in_millimeters(size_m):
    return format_ply(Box(type="box", size_m=tuple(1000 * length for length in size_m)).build_mesh())


@pytest.mark.parametrize("unit", [1000.0, 100.0, 1 / 0.0254, 84 / 4.9])
def test_wrong_units_of_actors_are_reported(tmp_path, unit):
    shape = write_mesh_file(tmp_path, format_ply(CAR.build_mesh()), meters_per_unit=unit)
    with pytest.warns(UserWarning, match=r"ego: its body is .* far too large for .*; .*`meters_per_unit: 0\.001`"):
        ActorDescription(shape=shape).build_actor("ego", "ego")


def test_bodies_in_millimeters_are_reported(tmp_path):
    shape = write_mesh_file(tmp_path, format_in_millimeters((4.9, 1.94, 1.63)))
    with pytest.warns(UserWarning, match=r"body 'parked car': its body is 4,900 x 1,940 x 1,630 m"):
        Body(name="parked car", shape=shape).build_meshes()
    # With the remedy there is no warning, nor for a city of 5 km or a train.
    Body(name="parked car", shape=shape.model_copy(update={"meters_per_unit": 0.001})).build_meshes()
    Body(name="city", shape=Box(type="box", size_m=(5000, 5000, 400))).build_meshes()
    ActorDescription(shape=Box(type="box", size_m=(75, 2.6, 3.6))).build_actor("tram", "tram")


@pytest.mark.parametrize("category", ["ego", "car", "vehicle.truck", "LARGE_VEHICLE"])
@pytest.mark.parametrize(
    ("size_m", "message"),
    [
        ((25.3, 2.55, 4.0), "a: its body is 25.3 x 2.55 x 4 m, far too large for a vehicle on a road"),
        ((1.94, 4.9, 1.63), r"a: .* wider than long; .* x axis points forward .*{yaw_deg: -90}"),
        ((1.94, 1.63, 4.9), r"a: .* higher than long; .* z up: .*{yaw_deg: 90, roll_deg: 90}.*glTF"),
        ((0.049, 0.0194, 0.0163), r"a: its body is 0.049 x 0.0194 x 0.0163 m, too small .*meters_per_unit"),
    ],
)
def test_impossible_vehicle_proportions_are_reported(category, size_m, message):
    with pytest.warns(UserWarning, match=message):
        ActorDescription(shape=Box(type="box", size_m=size_m)).build_actor("a", category)


@pytest.mark.parametrize(
    ("pose", "forward", "up"),
    [
        ({"yaw_deg": 90, "roll_deg": 90}, [0, 0, 1], [0, 1, 0]),  # glTF 2.0: y up, z forward
        ({"roll_deg": 90}, [1, 0, 0], [0, 1, 0]),
        ({"yaw_deg": -90}, [0, 1, 0], [0, 0, 1]),
        ({"yaw_deg": 90}, [0, -1, 0], [0, 0, 1]),
    ],
)
def test_suggested_rotations_give_x_forward_z_up(pose, forward, up):
    assert str(pose).replace("'", "") in WIDE_REMEDY + HIGH_REMEDY
    turned = Pose(**pose).to_matrix()[:3, :3] @ np.array([forward, up]).T
    np.testing.assert_allclose(turned.T, [[1, 0, 0], [0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize(
    ("category", "size_m"),
    [
        ("ego", (25.25, 2.55, 4.0)),
        ("ego", (0.281, 0.306, 0.141)),  # a small robot
        ("ego", (0.68, 0.57, 1.25)),  # a robot with a flag
        ("car", (2.34, 1.48, 1.56)),
        ("pedestrian", (0.3, 0.52, 1.75)),
        ("motorcycle", (2.1, 0.8, 2.2)),
        ("RAILED_VEHICLE", (42.0, 2.4, 3.6)),
        ("barrier", (0.5, 2.5, 1.0)),
    ],
)
def test_real_sizes_cause_no_warning(category, size_m):
    ActorDescription(shape=Box(type="box", size_m=size_m)).build_actor("a", category)


@pytest.mark.parametrize("name", list_builtin_names("vehicles"))
def test_built_in_vehicles_cause_no_warning(name):
    ActorDescription(shape=VehicleShape(type="vehicle", vehicle=name)).build_actor("ego", "ego")


PART = "{{name: {0}, shape: {{type: box, size_m: {1}}}, poses: [{2}]}}"


def write_vehicle(folder, name, *parts, extends=""):
    (folder / f"{name}.yaml").write_text(f"name: {name}\nextends: {extends or 'null'}\nparts: [{', '.join(parts)}]\n")
    return folder / f"{name}.yaml"


def test_vehicles_inherit_parts_and_mount_regions(tmp_path):
    roof_box = PART.format("box", "[1.2, 0.9, 0.4]", "{x_m: -0.5, z_m: 1.7}")
    suv, extended = Vehicle.load("suv"), Vehicle.load(write_vehicle(tmp_path, "suv_box", roof_box, extends="suv"))
    assert extended.parts[:-1] == suv.parts
    assert extended.parts[-1].name == "box"
    assert extended.mount_regions == suv.mount_regions
    assert np.ptp(extended.build_mesh().vertices_m, axis=0)[2] == pytest.approx(2.1)
    cart = write_vehicle(tmp_path, "cart", PART.format("body", "[2, 1, 1]", "{}"))
    pulled = write_vehicle(tmp_path, "pulled", PART.format("bar", "[0.5, 0.1, 0.1]", "{x_m: 1.25}"), extends=cart.name)
    with pytest.warns(UserWarning, match=r"shift the center of its bounding box.* by x \+0.25, y \+0.00 m"):
        assert np.ptp(Vehicle.load(pulled).build_mesh().vertices_m, axis=0)[0] == 2.5
    for name, base, message in (
        ("a", "pulled.yaml", "extends 'cart.yaml' itself"),
        ("b", "b.yaml", "extends 'b.yaml' itself"),
    ):
        with pytest.raises(ValueError, match=message):
            Vehicle.load(write_vehicle(tmp_path, name, PART.format("x", "[1, 1, 1]", "{}"), extends=base))


def test_rig_bodies_occlude_like_vehicle_parts(tmp_path):
    """A box ahead of a LiDAR belongs to the rig or to the vehicle; rigs with and without it share the reference."""
    box = PART.format("box", "[0.1, 1.0, 0.3]", "{x_m: 1.0, z_m: 1.5}")
    plain = Rig.load("front_roof_32").model_dump(mode="json", exclude_unset=True)
    pose, shape = {"x_m": 1.0, "z_m": 1.5}, {"type": "box", "size_m": [0.1, 1.0, 0.3]}
    loaded = Rig.model_validate({**plain, "bodies": [{"name": "box", "shape": shape, "poses": [pose]}]})
    extended = write_vehicle(tmp_path, "suv_box", box, extends="suv")
    frames = SimulatedFrames("courtyard", rigs={"plain": Rig.load("front_roof_32"), "loaded": loaded}, num_frames=1)
    vehicle_frame = SimulatedFrames("courtyard", "front_roof_32", num_frames=1, vehicle=extended)[0]
    np.testing.assert_array_equal(frames[0].clouds["loaded"], vehicle_frame.sensor)
    assert len(frames[0].clouds["plain"]) - len(vehicle_frame.sensor) > 500
    assert frames[0].counts["sensor_self_hits"] > 2 * 3380  # the warning of the vehicle, twice
    assert [note.split(":")[0] for note in frames.describe_reference()["notes"]] == ["plain", "loaded"]


def test_floating_actors_are_lowered_with_a_warning(tmp_path):
    floats = write_vehicle(tmp_path, "floats", PART.format("body", "[2, 1, 1]", "{z_m: 0.2}"))
    with pytest.warns(UserWarning, match=r"all parts of floats.yaml are 0.2 m or more above z = 0"):
        build_actor_mesh("actor", VehicleShape(type="vehicle", vehicle=str(floats)), "cart")
