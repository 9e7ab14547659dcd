"""Built-in vehicles: closed, on the ground, with the size and silhouette of real vehicles."""

import numpy as np
import pytest
import trimesh

from torchcover.simulation import list_builtin_names
from torchcover.simulation.bodies import Vehicle

SIZES_M = {
    "adult": (0.305, 0.52, 1.75),
    "bus": (12.0, 2.55, 3.10),
    "child_110cm": (0.1917, 0.33, 1.10),
    "child_120cm": (0.209, 0.36, 1.20),
    "chrysler_pacifica": (5.176, 2.022, 1.777),
    "cyclist": (1.80, 0.60, 1.75),
    "cylinder_80cm": (0.30, 0.30, 0.80),
    "dog_57cm": (0.98, 0.22, 0.69),
    "ford_fusion": (4.869, 1.852, 1.476),
    "hatchback": (4.28, 1.79, 1.46),
    "lorry": (8.60, 2.50, 3.45),
    "motorcycle": (2.10, 0.80, 1.50),
    "pickup": (5.37, 1.92, 1.88),
    "pole_100cm": (0.075, 0.075, 1.00),
    "renault_zoe": (4.084, 1.730, 1.562),
    "sedan": (4.77, 1.83, 1.46),
    "suv": (4.90, 1.94, 1.63),
    "truck": (16.50, 2.55, 4.00),
    "van": (5.93, 2.02, 2.64),
    "volkswagen_multivan": (4.973, 1.941, 1.903),
    "volkswagen_passat_estate": (4.775, 1.820, 1.516),
}
# Rear axle behind the center as in the rig of the same car, and wheelbase.
AXLES_M = {
    "chrysler_pacifica": (1.461, 3.089),
    "ford_fusion": (1.339, 2.850),
    "renault_zoe": (1.385, 2.588),
    "volkswagen_multivan": (1.592, 3.124),
    "volkswagen_passat_estate": (1.337, 2.709),
}
CARS = ("hatchback", "pickup", "sedan", "suv", "van", *AXLES_M)
WITH_WHEELS = tuple(
    sorted(set(SIZES_M) - {"adult", "child_110cm", "child_120cm", "cylinder_80cm", "dog_57cm", "pole_100cm"})
)


def load(name):
    return Vehicle.load(name)


def compute_height(mesh, x_m, y_m):
    """Compute the height of the highest surface over a ground position; -inf without surface."""
    a, b, c = (mesh.vertices_m[mesh.faces[:, corner]] for corner in range(3))

    def area(p, q, r):
        return (q[:, 0] - p[:, 0]) * (r[:, 1] - p[:, 1]) - (q[:, 1] - p[:, 1]) * (r[:, 0] - p[:, 0])

    point = np.broadcast_to([x_m, y_m, 0.0], a.shape)
    weights = np.stack([area(b, c, point), area(c, a, point), area(a, b, point)])
    total = area(a, b, c)
    over = (np.abs(total) > 1e-12) & ((weights * np.sign(total)) >= 0).all(axis=0)
    heights = (weights[:, over] * np.stack([a, b, c])[:, over, 2]).sum(0) / total[over]
    return max(heights, default=-np.inf)


def compute_profile(mesh, x_m):
    """Compute the height profile of a vehicle along its center line."""
    return np.array([compute_height(mesh, x, 0.013) for x in x_m])


def test_all_built_in_vehicles_are_tested():
    assert list_builtin_names("vehicles") == sorted(SIZES_M)


@pytest.mark.parametrize("name", SIZES_M)
def test_vehicles_stand_on_the_ground_and_are_centered(name):
    vertices = load(name).build_mesh().vertices_m
    length, width, height = SIZES_M[name]
    np.testing.assert_allclose(vertices.min(0), [-length / 2, -width / 2, 0], atol=1e-3)
    np.testing.assert_allclose(vertices.max(0), [length / 2, width / 2, height], atol=1e-3)


@pytest.mark.parametrize("name", SIZES_M)
def test_every_part_is_closed_and_faces_outwards(name):
    for part in load(name).parts:
        for mesh in part.build_meshes():
            solid = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
            assert solid.is_watertight
            assert solid.is_winding_consistent
            assert solid.volume > 1e-5


@pytest.mark.parametrize("name", SIZES_M)
def test_left_and_right_are_mirror_images(name):
    # For each part, the corners of all copies and of their mirror image are the same points.
    for part in load(name).parts:
        corners = np.concatenate([mesh.vertices_m for mesh in part.build_meshes()])
        rounded = {tuple(corner) for corner in (np.round(corners, 6) + 0.0).tolist()}
        mirrored = {tuple(corner) for corner in (np.round(corners * [1, -1, 1], 6) + 0.0).tolist()}
        assert rounded == mirrored, part.name


@pytest.mark.parametrize("name", WITH_WHEELS)
def test_only_wheels_touch_the_ground(name):
    for part in load(name).parts:
        lowest = min(mesh.vertices_m[:, 2].min() for mesh in part.build_meshes())
        if "wheels" in part.name:
            assert lowest == pytest.approx(0.0, abs=1e-12)
        else:
            assert lowest > 0.1


@pytest.mark.parametrize("name", AXLES_M)
def test_axles_of_published_vehicles_match_their_rigs(name):
    (wheels,) = [part for part in load(name).parts if part.name == "wheels"]
    front_m, rear_m = max(pose.x_m for pose in wheels.poses), min(pose.x_m for pose in wheels.poses)
    assert (-rear_m, front_m - rear_m) == pytest.approx(AXLES_M[name], abs=1e-9)


@pytest.mark.parametrize("name", CARS)
def test_cars_have_hood_windscreen_and_roof(name):
    mesh = load(name).build_mesh()
    x = np.linspace(-0.98, 0.98, 197) * SIZES_M[name][0] / 2
    outline = compute_profile(mesh, x)
    roof = SIZES_M[name][2]
    hood = outline[x > 0.6 * x.max()].max()
    assert 0.4 * roof < hood < 0.72 * roof
    front_of_roof = x[outline > 0.95 * roof].max()
    foot = x[outline > hood + 0.05].max()
    # Windscreen: between its foot and the roof the profile is monotonic, at a rake of 25 to 65 degrees.
    windscreen = outline[(x > front_of_roof) & (x < foot)]
    assert (np.diff(windscreen) < 0).all()
    rake = np.rad2deg(np.arctan2(0.95 * roof - hood - 0.05, foot - front_of_roof))
    assert 25 < rake < 65


@pytest.mark.parametrize("name", CARS)
def test_a_cars_cabin_is_narrower_than_its_body(name):
    vertices = load(name).build_mesh().vertices_m
    height = SIZES_M[name][2]
    roof = vertices[vertices[:, 2] > 0.99 * height]
    assert np.ptp(roof[:, 1]) < 0.8 * SIZES_M[name][1]


@pytest.mark.parametrize("name", [*CARS, "truck", "lorry", "bus"])
def test_mirrors_end_within_the_width(name):
    (mirrors,) = [part for part in load(name).parts if part.name == "mirrors"]
    outermost = max(mesh.vertices_m[:, 1].max() for mesh in mirrors.build_meshes())
    assert outermost <= SIZES_M[name][1] / 2 + 1e-9
    assert len(mirrors.build_meshes()) == 2


def test_riders_and_walkers_have_a_head_on_top():
    for name in ("adult", "child_110cm", "child_120cm", "cyclist", "motorcycle"):
        mesh = load(name).build_mesh()
        top = mesh.vertices_m[mesh.vertices_m[:, 2] > SIZES_M[name][2] - 0.05]
        assert np.ptp(top[:, 1]) < 0.2
