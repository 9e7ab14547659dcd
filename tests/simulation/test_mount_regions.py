"""Mount regions: their points lie on the surface of the vehicle, and sensors on them face outwards."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh

from torchcover.simulation import list_builtin_names
from torchcover.simulation.bodies import Vehicle, VehicleShape, get_mount_regions
from torchcover.simulation.mount_regions import SIDE_VIEWS, MountRegion, Skin
from torchcover.simulation.shapes import Box, Mesh

ROBOT = Path(__file__).parents[2] / "examples" / "robot" / "robot.yaml"
SMALL = ("adult", "child_110cm", "child_120cm", "cyclist", "cylinder_80cm", "dog_57cm", "motorcycle", "pole_100cm")
VEHICLES = [*(name for name in list_builtin_names("vehicles") if name not in SMALL), str(ROBOT)]
BOX = Skin(Box(type="box", size_m=(4.0, 2.0, 1.5)).build_mesh())


@cache
def load_vehicle(name):
    """Load a vehicle and its skin."""
    vehicle = Vehicle.load(name)
    return vehicle, Skin(vehicle.build_mesh())


def compute_distance_m(mesh, place_m):
    """Compute the distance of a position from the nearest triangle of a mesh."""
    triangles = mesh.vertices_m[mesh.faces]
    nearest = trimesh.triangles.closest_point(triangles, np.broadcast_to(place_m, (len(triangles), 3)))
    return np.linalg.norm(nearest - place_m, axis=1).min()


@pytest.mark.parametrize("name", VEHICLES)
def test_mount_points_lie_on_the_surface(name):
    (vehicle, skin), generator = load_vehicle(name), np.random.default_rng(0)
    assert vehicle.mount_regions
    for region in vehicle.mount_regions.values():
        u, v = generator.random(2)
        point, height_m = region.find_mount_point(skin, u, v), 0.02
        assert compute_distance_m(skin.mesh, point.position_m) < 1e-12
        assert compute_distance_m(skin.mesh, point.position_m + height_m * point.normal) == pytest.approx(
            height_m, abs=1e-9
        )
        assert not skin.is_inside(point.position_m + height_m * point.normal)
        assert skin.is_inside(point.position_m - 1e-3 * point.normal)


@pytest.mark.parametrize("name", VEHICLES)
def test_regions_are_one_patch_facing_their_side(name):
    """Neighboring points lie on the same part of the body."""
    (vehicle, skin), shares = load_vehicle(name), np.linspace(0.0, 1.0, 5)
    for region in vehicle.mount_regions.values():
        axis, sign = SIDE_VIEWS[region.side][:2]
        points = [[region.find_mount_point(skin, u, v) for v in shares] for u in shares]
        places_m = np.array([[point.position_m for point in row] for row in points])
        assert min(sign * point.normal[axis] for row in points for point in row) > 0.5
        for along in (0, 1):
            steps_m = np.diff(places_m, axis=along)
            assert (np.abs(steps_m[..., axis]) < np.linalg.norm(np.delete(steps_m, axis, axis=2), axis=2) + 1e-9).all()


@pytest.mark.parametrize("name", VEHICLES)
def test_left_and_right_are_mirror_images(name):
    vehicle, skin = load_vehicle(name)
    regions = vehicle.mount_regions
    pairs = [(regions[key], regions[key.replace("left", "right")]) for key in regions if "left" in key]
    assert pairs
    for left, right in pairs:
        v = 0.8 if left.y_m is None else 0.4
        one = left.find_mount_point(skin, 0.2, v).position_m
        other = right.find_mount_point(skin, *((0.2, v) if left.y_m is None else (0.8, v))).position_m
        assert other == pytest.approx(one * [1, -1, 1], abs=1e-9)
        assert right.heading_deg == -left.heading_deg


@pytest.mark.parametrize("name", SMALL)
def test_small_bodies_have_no_mount_regions(name):
    assert get_mount_regions(VehicleShape(type="vehicle", vehicle=name)) == {}


def test_mount_regions_do_not_change_simulations():
    suv = Vehicle.load("suv")
    assert suv.collect_content() == suv.model_copy(update={"mount_regions": {}}).collect_content()


@pytest.mark.parametrize("side", SIDE_VIEWS)
def test_normals_point_outwards_for_any_face_orientation(side):
    turned = Skin(Mesh(BOX.mesh.vertices_m, BOX.mesh.faces[:, ::-1]))
    across_m = (0.1, 0.2)
    axis, sign = SIDE_VIEWS[side][:2]
    for skin in (BOX, turned):
        point = skin.find_surface_point(side, across_m)
        assert point.normal == pytest.approx(sign * np.eye(3)[axis])
        assert point.position_m[axis] == {"x": sign * 2.0, "y": sign * 1.0, "z": 1.5}["xyz"[axis]]


def test_lines_through_shared_edges_hit_a_face():
    assert BOX.find_surface_point("above", (0.0, 0.0)).position_m.tolist() == [0.0, 0.0, 1.5]
    assert BOX.find_surface_point("above", (2.0, 1.0)).position_m.tolist() == [2.0, 1.0, 1.5]
    assert BOX.find_surface_point("above", (2.001, 0.0)) is None


@pytest.mark.parametrize(("side", "facing_deg"), [("above", 0), ("front", 0), ("rear", 180), ("left", 90)])
def test_sensors_face_outwards_or_as_the_region_defines(side, facing_deg):
    axis = SIDE_VIEWS[side].axis
    window = {f"{other}_m": (0.1, 0.5) for other in "xyz" if other != "xyz"[axis]}
    assert MountRegion(side=side, **window).heading_deg == facing_deg
    assert MountRegion(side=side, facing_deg=45.0, **window).heading_deg == 45.0


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"side": "above", "x_m": (0.0, 1.0)}, "a window has x_m and y_m; got x_m"),
        ({"side": "left", "x_m": (0.0, 1.0), "y_m": (0.0, 1.0)}, "x_m and z_m; got x_m and y_m"),
        ({"side": "above", "x_m": (1.0, 1.0), "y_m": (0.0, 1.0)}, "the lower bound must be below the upper one"),
        ({"side": "above", "x_m": (0.0, np.nan), "y_m": (0.0, 1.0)}, "finite"),
        ({"side": "below", "x_m": (0.0, 1.0), "y_m": (0.0, 1.0)}, "'above', 'front', 'rear', 'left' or 'right'"),
    ],
)
def test_invalid_regions_are_refused(keys, message):
    with pytest.raises(ValueError, match=message):
        MountRegion(**keys)


def test_positions_off_the_body_are_refused():
    beyond = MountRegion(side="above", x_m=(1.0, 3.0), y_m=(-0.5, 0.5))
    with pytest.raises(ValueError, match=r"x = 3\.000 m, y = 0\.000 m \(u = 1, v = 0\.5\) the body has no surface"):
        beyond.find_mount_point(BOX, 1.0, 0.5)
