"""Mesh checks: flipped sheets, repeated faces, decals, bodies with holes."""

import warnings

import numpy as np
import pytest
import trimesh

from torchcover.geometry import build_transform
from torchcover.simulation import SurfaceReference, shapes
from torchcover.simulation.ground_faces import find_level_faces
from torchcover.simulation.local_ground import GroundHeightPyramid
from torchcover.simulation.mesh_checks import check_mesh, find_coincident_faces
from torchcover.simulation.patches import Patches, UprightBoxes, find_outward_faces
from torchcover.simulation.scene_geometry import SceneGeometry
from torchcover.simulation.shapes import Box, Ellipsoid, Mesh, Plane

from .small_scenarios import AHEAD, ALL_HEIGHTS, FLOOR, assert_agrees, box, scenario, sum_weights

CUBE = Box(type="box", size_m=(2, 2, 2)).build_mesh()


def write_body_file(folder, mesh, name="body"):
    path = folder / f"{name}.ply"
    trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False).export(path)
    return {"name": name, "shape": {"type": "mesh", "path": str(path)}}


def grid(n=8, half=40.0):
    side = np.linspace(-half, half, n + 1)
    x, y = np.meshgrid(side, side, indexing="ij")
    number = np.arange(x.size).reshape(x.shape)
    corner, right, above, across = number[:-1, :-1], number[1:, :-1], number[:-1, 1:], number[1:, 1:]
    faces = np.concatenate([np.stack(f, -1).reshape(-1, 3) for f in ((corner, right, across), (corner, across, above))])
    return Mesh(np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1), faces)


def turned(mesh, which):
    faces = mesh.faces.copy()
    faces[which] = faces[which, ::-1]
    return Mesh(mesh.vertices_m, faces)


@pytest.mark.parametrize(
    "mesh",
    [
        CUBE,
        Ellipsoid(type="ellipsoid", size_m=(2, 1, 1)).build_mesh(),
        Plane(type="plane", size_m=(3, 3)).build_mesh(),
        grid(),
    ],
)
@pytest.mark.parametrize("inside_out", [False, True])
def test_meshes_without_defects_cause_no_warning(mesh, inside_out):
    mesh = turned(mesh, slice(None)) if inside_out else mesh
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert check_mesh("it", mesh).faces is mesh.faces


def test_defects_are_reported_with_name_and_share():
    with pytest.warns(UserWarning, match=r"body 'a': 3 of 15 of its faces are there more than once"):
        once = check_mesh("body 'a'", Mesh(CUBE.vertices_m, np.concatenate([CUBE.faces, CUBE.faces[[0, 5, 5], ::1]])))
    assert len(once.faces) == 12
    with pytest.warns(UserWarning, match=r"body 'b': the normals of neighbors disagree at 3 of 18 of its inner edges"):
        check_mesh("body 'b'", turned(CUBE, [4]))
    with pytest.warns(UserWarning, match=r"body 'c': 6 of 18 of its edges have a face on one side only"):
        check_mesh("body 'c'", Mesh(CUBE.vertices_m, CUBE.faces[2:]))


def test_coincident_faces_have_the_same_visible_side():
    plane, cube = Plane(type="plane", size_m=(30, 30)).build_mesh(), CUBE
    decal = Plane(type="plane", size_m=(0.5, 0.5)).build_mesh().transform(build_transform(np.eye(3), [9, 9, 5e-4]))
    far_decal = decal.transform(build_transform(np.eye(3), [0, 0, 2e-3]))

    def counts(*meshes):
        return [int(mask.sum()) for mask in find_coincident_faces(meshes, [False] * len(meshes))]

    assert counts(plane, cube) == [0, 0]  # its bottom on the plane is invisible
    assert counts(plane, decal)[1] == 2
    assert counts(plane, decal)[0] >= 1
    assert counts(plane, far_decal) == [0, 0]
    assert counts(plane, plane) == [2, 2]
    assert counts(cube, cube) == [12, 12]
    # The top of a sidewalk is in the plane of a sheet, for either orientation of the sheet.
    sunk = Mesh(cube.vertices_m - [0, 0, 2], cube.faces)
    assert counts(turned(plane, slice(None)), sunk)[1] == counts(plane, sunk)[1] == 2


def test_the_chunk_size_changes_no_result(monkeypatch):
    """Large meshes are processed in chunks: hills, a ball, and a repeated patch of the hills."""
    hills, ball = grid(), Ellipsoid(type="ellipsoid", size_m=(9, 9, 9)).build_mesh()
    hills = hills._replace(vertices_m=hills.vertices_m + [0, 0, 1] * np.sin(hills.vertices_m[:, :1]))
    meshes = [hills, ball, hills.select_faces(np.arange(30, 50))]
    box_around = UprightBoxes(np.array([[-20.0, -15.0, -9.0]]), np.array([[30.0, 5.0, 9.0]]))

    def collect_results():
        cut = [Patches.from_mesh(mesh, box_around) for mesh in meshes]
        return [
            *(mask for mesh in meshes for mask in (find_outward_faces(mesh), find_level_faces(mesh))),
            *find_coincident_faces(meshes, [True] * 3),
            *GroundHeightPyramid.from_meshes(meshes, np.zeros(3)).levels,
            *(np.sort(patches.corner_m + patches.first_edge_m, axis=1) for patches in cut),
        ]

    at_once = collect_results()
    assert [int(mask.sum()) for mask in at_once[6:9]] == [20, 0, 20]
    monkeypatch.setattr(shapes, "FACES_PER_CHUNK", 7)
    for expected, actual in zip(at_once, collect_results(), strict=True):
        np.testing.assert_array_equal(expected, actual)


@pytest.mark.filterwarnings("ignore:.*faces lie within 1 mm")
@pytest.mark.parametrize(("rays", "steps"), [(400, 60), (20, 200)])
@pytest.mark.parametrize("raised_m", [5e-4, 0.0, -5e-4])
def test_decals_on_the_road_count_once(fix_position, raised_m, rays, steps):
    fix_position([2.5, 0.3, 1.0])
    decal = {"name": "decal", "shape": {"type": "plane", "size_m": [8, 6]}, "poses": [{"x_m": 12, "z_m": raised_m}]}
    sensor = SurfaceReference((AHEAD,), num_rays=rays, num_poses=1, bands_m=ALL_HEIGHTS)
    assert_agrees(sum_weights(scenario(FLOOR, decal), sensor, num_frames=steps), 200.0)
    assert_agrees(
        sum_weights(scenario(FLOOR, decal), sensor, lambda points: points[:, 0].astype(float), num_frames=steps),
        200.0 * 14,
    )


def test_repeated_faces_count_once(fix_position, tmp_path):
    fix_position([2.5, 3.0, 2.5])
    cube = Mesh(CUBE.vertices_m * [1, 1, 0.75] + [10, 0, 0], CUBE.faces)
    twice = write_body_file(tmp_path, Mesh(cube.vertices_m, np.tile(cube.faces, (2, 1))))
    sensor = SurfaceReference((AHEAD,), num_rays=1000, num_poses=1, bands_m=((0.5, 2.0),))
    with pytest.warns(UserWarning, match=r"body 'body': 12 of 24 of its faces are there more than once"):
        areas_m2 = sum_weights(scenario(twice, FLOOR), sensor)
    assert_agrees(areas_m2, 2.0 + 2.0 + 4.0)


def test_coincident_bodies_count_once_and_are_named(fix_position):
    fix_position([2.5, 3.0, 2.5])
    first_box = box([2, 2, 1.5], x_m=10)
    second_box = {**first_box, "name": "again"}
    sensor = SurfaceReference((AHEAD,), num_rays=1000, num_poses=1, bands_m=((0.5, 2.0),))
    with pytest.warns(
        UserWarning, match=r"'box' \(10 of 12 of the faces\), 'again' \(10 of 12 of the faces\): faces lie"
    ):
        areas_m2 = sum_weights(scenario(first_box, second_box, FLOOR), sensor)
    assert_agrees(areas_m2, 2.0 + 2.0 + 4.0)


@pytest.mark.parametrize("flipped", [slice(0, 0), slice(None, None, 2)])
def test_mesh_warnings_name_the_body(tmp_path, flipped):
    lying = write_body_file(tmp_path, turned(Mesh(CUBE.vertices_m, CUBE.faces[2:]), flipped))
    finding = "normals of neighbors disagree" if flipped.step else "6 of 18 of its edges"
    with pytest.warns(UserWarning, match=f"body 'body': .*{finding}"):
        scenario({**lying, "poses": [{"z_m": 0.5}]}, FLOOR).build_scene()
    with pytest.warns(UserWarning, match=f"ego: .*{finding}"):
        scenario(FLOOR, ego={"shape": lying["shape"]}).build_scene()


@pytest.mark.filterwarnings("ignore:.*normals of neighbors disagree")
@pytest.mark.parametrize("kind", ["up", "down", "mixed"])
def test_terrain_area_is_independent_of_face_orientation(fix_position, tmp_path, kind):
    mesh = grid()
    which = {"up": [], "down": slice(None), "mixed": slice(None, None, 2)}[kind]
    fix_position([2.5, 0.3, 1.0])
    sensor = SurfaceReference((AHEAD,), num_rays=400, num_poses=1, bands_m=ALL_HEIGHTS)
    body = write_body_file(tmp_path, turned(mesh, which))
    assert_agrees(sum_weights(scenario(body), sensor), 200.0)
    snapshot = SceneGeometry(scenario(body).build_scene()).get_snapshot(0)
    assert not snapshot.is_occupied(np.array([3.0, 0.0, 0.4]))
    assert snapshot.is_occupied(np.array([3.0, 0.0, -0.4]))
