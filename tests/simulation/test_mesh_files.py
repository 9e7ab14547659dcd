"""Mesh files: polygons keep their area, and rays pass transparent objects and materials."""

import json
import struct
import warnings
from contextlib import nullcontext

import numpy as np
import pytest

from torchcover.files import BadFileError
from torchcover.simulation import CameraSensor, Pose, Rig, Scenario, SimulatedFrames
from torchcover.simulation.shapes import Box, MeshFile
from torchcover.simulation.triangulation import triangulate

# An L of 5 m² and a dart: for both, a fan from the first corner is wrong.
L_SHAPE = [(1.5, -0.5), (-0.5, -0.5), (-0.5, 1.5), (-1.5, 1.5), (-1.5, -1.5), (1.5, -1.5)]
DART = [(0.0, 0.0), (2.0, 1.0), (0.5, 1.0), (1.0, 2.0)]


def compute_polygon_area(points):
    x, y = np.array(points).T
    return abs((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()) / 2


def format_obj(points):
    """Format two copies as OBJ; the second has negative indices, and another vertex follows it."""
    low, high = ("".join(f"v {x} {y} {z}\n" for x, y in points) for z in (0, 1))
    back = " ".join(f"{k}//-1" for k in range(-len(points), 0))
    ahead = " ".join(f"{k + 1}" for k in range(len(points)))
    return f"{low}f {ahead}\nvn 0 0 1\n{high}f {back} # a comment\nv 9 9 9\n".encode(), 2


def format_ply(points, ending):
    header = (
        f"ply\nformat {ending} 1.0\nelement vertex {len(points)}\nproperty float x\nproperty float y\n"
        "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    if ending == "ascii":
        rows = [f"{x} {y} 0" for x, y in points] + [" ".join(map(str, [len(points), *range(len(points))]))]
        return header + "\n".join(rows).encode() + b"\n", 1
    data = b"".join(struct.pack("<3f", x, y, 0) for x, y in points)
    return header + data + struct.pack(f"<B{len(points)}i", len(points), *range(len(points))), 1


def format_off(points):
    rows = [f"{x} {y} 0" for x, y in points] + [" ".join(map(str, [len(points), *range(len(points))]))]
    return (f"OFF # a comment\n{len(points)} 1 0\n" + "\n".join(rows)).encode(), 1


def format_dae(points):
    numbers = " ".join(f"{x} {y} 0" for x, y in points)
    order = " ".join(map(str, range(len(points))))
    accessor = "".join(f"<param name='{axis}' type='float'/>" for axis in "XYZ")
    return (
        "<COLLADA xmlns='http://www.collada.org/2005/11/COLLADASchema' version='1.4.1'><library_geometries>"
        "<geometry id='g'><mesh><source id='p'>"
        f"<float_array id='a' count='{3 * len(points)}'>{numbers}</float_array>"
        f"<technique_common><accessor source='#a' count='{len(points)}' stride='3'>{accessor}</accessor>"
        "</technique_common></source><vertices id='v'><input semantic='POSITION' source='#p'/></vertices>"
        f"<polylist count='1'><input semantic='VERTEX' source='#v' offset='0'/><vcount>{len(points)}</vcount>"
        f"<p>{order}</p></polylist></mesh></geometry></library_geometries><library_visual_scenes>"
        "<visual_scene id='s'><node><instance_geometry url='#g'/></node></visual_scene></library_visual_scenes>"
        "<scene><instance_visual_scene url='#s'/></scene></COLLADA>"
    ).encode(), 1


def compute_areas(mesh):
    a, b, c = (mesh.vertices_m[mesh.faces[:, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


@pytest.mark.parametrize("points", [L_SHAPE, DART], ids=["L", "dart"])
@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("a.obj", format_obj),
        ("ascii.ply", lambda points: format_ply(points, "ascii")),
        ("binary.ply", lambda points: format_ply(points, "binary_little_endian")),
        ("a.off", format_off),
        ("a.dae", format_dae),
    ],
)
def test_concave_polygons_keep_their_area(tmp_path, name, write, points):
    content, copies = write(points)
    (tmp_path / name).write_bytes(content)
    mesh = MeshFile(type="mesh", path=tmp_path / name).build_mesh()
    assert compute_areas(mesh).sum() == pytest.approx(copies * compute_polygon_area(points), rel=1e-6)
    assert len(mesh.faces) == copies * (len(points) - 2)


def test_polygons_keep_their_area_in_any_plane():
    """Star-shaped polygons, and a square with a hole that a cut joins to its outline."""
    random = np.random.default_rng(0)
    hole = [(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)]
    shapes = [np.array(hole, dtype=np.float64)]
    for corners in (4, 5, 8, 20) * 10:
        angle = (np.arange(corners) + random.uniform(0, 0.9, corners)) * 2 * np.pi / corners
        shapes.append(random.uniform(0.1, 1.0, (corners, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
    ends = np.cumsum([0, *map(len, shapes)])
    vertices = np.insert(np.concatenate(shapes), 2, 0.0, axis=1) @ rotation.T + [1e3, 0.0, 5.0]
    triangles = triangulate(vertices, [np.arange(*ends[k : k + 2]) for k in range(len(shapes))])
    a, b, c = vertices[triangles].swapaxes(0, 1)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    of_shape = np.searchsorted(ends, triangles[:, 0], side="right") - 1
    np.testing.assert_allclose(
        np.bincount(of_shape, area), [compute_polygon_area(shape) for shape in shapes], rtol=1e-9
    )


def build_glb(meshes):
    """Build a GLB of triangles: name -> (three corners, material number); material 1 is called glass and blends."""
    data, document = b"", {"asset": {"version": "2.0"}, "scene": 0, "nodes": [], "meshes": [], "accessors": []}
    document["materials"] = [{"name": "paint"}, {"name": "glass", "alphaMode": "BLEND"}]
    document["bufferViews"] = []
    for number, (name, (corners, material)) in enumerate(meshes.items()):
        bounds = {"min": np.min(corners, axis=0).tolist(), "max": np.max(corners, axis=0).tolist()}
        document["bufferViews"].append({"buffer": 0, "byteOffset": len(data), "byteLength": 36})
        document["accessors"].append(
            {"bufferView": number, "componentType": 5126, "count": 3, "type": "VEC3", **bounds}
        )
        primitive = {"attributes": {"POSITION": number}, "material": material}
        document["meshes"].append({"name": name, "primitives": [primitive]})
        document["nodes"].append({"name": name, "mesh": number})
        data += np.asarray(corners, dtype="<f4").tobytes()
    document |= {"scenes": [{"nodes": list(range(len(meshes)))}], "buffers": [{"byteLength": len(data)}]}
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def test_rays_pass_transparent_objects_and_materials(tmp_path):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    parts = {"body": (corners, 0), "door": (2 * corners, 0), "windscreen": (4 * corners, 1), "rear": (8 * corners, 1)}
    (tmp_path / "car.glb").write_bytes(build_glb(parts))

    def read(*names):
        return MeshFile(type="mesh", path=tmp_path / "car.glb", transparent=names)

    assert sorted(compute_areas(read().build_mesh())) == [0.5, 2.0, 8.0, 32.0]
    assert sorted(compute_areas(read("glass").build_mesh())) == [0.5, 2.0]
    assert sorted(compute_areas(read("rear", "body").build_mesh())) == [2.0, 8.0]
    assert np.ptp(read("glass").build_mesh().vertices_m, axis=0)[0] == 8.0  # the frame remains
    assert (read().list_transparent_materials(), read("glass").list_transparent_materials()) == (["glass"], [])
    with pytest.raises(ValueError, match="no object or material is called 'window'; it has 'body', 'door', 'glass'"):
        read("window").build_mesh()
    with pytest.raises(ValueError, match="all 4 faces are; name the windows only"):
        read("glass", "paint").build_mesh()


@pytest.mark.parametrize("opacity", ["d 0.3", "Tr 0.7"])
def test_mtl_materials_have_names_and_opacity(tmp_path, opacity):
    (tmp_path / "a.mtl").write_text(f"newmtl paint\nKd 1 0 0\nd 1\nnewmtl glass\nKd 0 0 1\n{opacity}\n")
    vertices = "".join(f"v {x} {y} 0\n" for x, y in [(0, 0), (1, 0), (1, 1), (0, 1)])
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{vertices}usemtl paint\nf 1 2 3\nusemtl glass\nf 1 3 4\n")
    mesh = MeshFile(type="mesh", path=tmp_path / "a.obj")
    assert (len(mesh.build_mesh().faces), mesh.list_transparent_materials()) == (2, ["glass"])
    assert len(mesh.model_copy(update={"transparent": ("glass",)}).build_mesh().faces) == 1


def test_blocked_cameras_are_told_about_transparent_windows(tmp_path):
    """In a closed car with glass sides the message names material and key; with the key the camera sees through."""
    box = Box(type="box", size_m=(4.0, 2.0, 1.5)).build_mesh()
    sides = {f"side {k}": (box.vertices_m[face], 0 if k < 2 else 1) for k, face in enumerate(box.faces)}
    (tmp_path / "car.glb").write_bytes(build_glb(sides))
    camera = CameraSensor(name="cam", mount=Pose(z_m=1.0), width=64, height=48, fov_deg=90.0, max_range_m=50.0)
    rig, courtyard = Rig(name="inside", sensors=(camera,)), Scenario.load("courtyard")
    for key, message in (
        ("", "glass.* look transparent .* give its shape `transparent: .glass.`"),
        (", transparent: [glass]", ""),
    ):
        shape = f"{{type: mesh, path: car.glb{key}}}"
        (tmp_path / "car.yaml").write_text(f"name: car\nparts: [{{name: body, shape: {shape}}}]\n")
        frames = SimulatedFrames(courtyard, rig, num_frames=1, vehicle=tmp_path / "car.yaml")
        with warnings.catch_warnings(), pytest.raises(ValueError, match=message) if message else nullcontext():
            warnings.simplefilter("ignore")  # windows become holes
            assert len(frames[0].sensor) > 100


@pytest.mark.parametrize(("name", "message"), [("a.fbx", "export it as GLB"), ("a.urdf", "`torchcover robot` reads")])
def test_unsupported_formats_name_the_conversion(tmp_path, name, message):
    (tmp_path / name).write_bytes(b"Kaydara FBX Binary")
    with pytest.raises(BadFileError, match=f"is no mesh that can be read; {message}"):
        MeshFile(type="mesh", path=tmp_path / name).build_mesh()


def test_faces_with_invalid_indices_are_refused(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 5\n")
    with pytest.raises(BadFileError, match="cannot read it as a mesh"):
        MeshFile(type="mesh", path=tmp_path / "a.obj").build_mesh()


def test_latin_1_text_equals_utf_8_text(tmp_path):
    text = "# caf\u00e9\nmtllib caf\u00e9.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl caf\u00e9\nf 1 2 3\n"
    (tmp_path / "a.obj").write_bytes(text.encode("latin-1"))
    ascii_stl = "solid \u00e9\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
    (tmp_path / "a.stl").write_bytes(f"{ascii_stl}endloop\nendfacet\nendsolid\n".encode("latin-1"))
    for name in ("a.obj", "a.stl"):
        mesh = MeshFile(type="mesh", path=tmp_path / name).build_mesh()
        np.testing.assert_array_equal(mesh.vertices_m[mesh.faces[0]], [[0, 0, 0], [1, 0, 0], [0, 1, 0]])


@pytest.mark.parametrize(
    ("name", "content", "error", "message"),
    [
        ("a.step", "ISO-10303-21;", ImportError, r"\.step needs cascadio: pip install cascadio"),
        ("a.gltf", "KHR_draco_mesh_compression", ImportError, r"\.gltf needs DracoPy: pip install DracoPy"),
        ("a.gltf", "EXT_meshopt_compression", BadFileError, "compressed by EXT_meshopt_compression; export it without"),
    ],
)
def test_missing_packages_are_not_reported_as_damage(tmp_path, name, content, error, message):
    """trimesh would read compressed glTF as points at the origin."""
    text = f'{{"asset": {{}}, "extensionsRequired": ["{content}"]}}' if name == "a.gltf" else content
    (tmp_path / name).write_text(text)
    with pytest.raises(error, match=rf"{name}: .*{message}"):
        MeshFile(type="mesh", path=tmp_path / name).build_mesh()


@pytest.mark.parametrize(("stated", "side_m"), [("", 2.0), ("<unit name='centimeter' meter='0.01'/>", 0.02)])
def test_the_unit_of_a_collada_file_is_applied(tmp_path, stated, side_m):
    text, _ = format_dae([(0, 0), (2, 0), (2, 2), (0, 2)])
    text = text if isinstance(text, str) else text.decode()
    path = tmp_path / "m.dae"
    path.write_text(text.replace("<library_geometries>", f"<asset>{stated}</asset><library_geometries>", 1))
    size_m = np.ptp(MeshFile(type="mesh", path=path).build_mesh().vertices_m, axis=0)
    np.testing.assert_allclose(size_m, [side_m, side_m, 0.0], atol=1e-12)
