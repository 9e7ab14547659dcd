"""Ground, sidewalks and bridges."""

import numpy as np
import pytest
import trimesh

from torchcover.simulation.height_field import FlatGround, GroundHeightField
from torchcover.simulation.sumo.ground import Sidewalks, build_bridges, build_ground, compute_tilts_deg
from torchcover.simulation.sumo.network import read_network
from torchcover.simulation.sumo.vicinity import Vicinity

from .towns import DRIVE, WALK, edge, street, write_net

WAY = np.array([[50.0, 0.0], [150.0, 0.0]])


def build_vicinity(folder, *edges, way_m=WAY, origin_m=(0.0, 0.0)):
    return Vicinity(read_network(write_net(folder / "a.net.xml", *edges)), way_m, np.array(origin_m))


def build_random_ground():
    """Build ground with random heights."""
    return GroundHeightField(
        np.array([-10.0, 5.0]), np.random.default_rng(0).normal(size=(9, 7)), np.ones((8, 6), dtype=bool)
    )


def test_level_networks_have_plane_ground(tmp_path):
    ground = build_ground(build_vicinity(tmp_path, street(z=(3.0, 3.0))))
    assert isinstance(ground, FlatGround)
    assert len(ground.build_mesh().faces) == 2
    assert (ground.build_mesh().vertices_m[:, 2] == 3.0).all()
    assert (ground.compute_heights_m(WAY) == 3.0).all()


def test_ground_follows_the_height_of_streets(tmp_path):
    ground = build_ground(build_vicinity(tmp_path, street(z=(0.0, 20.0))))
    along = np.column_stack([np.linspace(20.0, 380.0, 50), np.zeros(50)])
    np.testing.assert_allclose(ground.compute_heights_m(along), 0.05 * along[:, 0], atol=0.02)
    pitch, roll = compute_tilts_deg(ground, along, np.zeros(50), (5.0, 2.0)).T
    np.testing.assert_allclose(pitch, -np.rad2deg(np.arctan(0.05)), atol=0.1)  # the nose is up
    np.testing.assert_allclose(roll, 0.0, atol=0.1)
    _, roll = compute_tilts_deg(ground, along, np.full(50, -90.0), (5.0, 2.0)).T
    np.testing.assert_allclose(roll, np.rad2deg(np.arctan(0.05)), atol=0.1)  # to the south, the left side is up


def test_ground_heights_match_the_mesh():
    ground, generator = build_random_ground(), np.random.default_rng(1)
    places_m = generator.uniform([-10.0, 5.0], [20.0, 45.0], (200, 2))
    corners_m = ground.build_mesh().vertices_m[ground.build_mesh().faces]
    for place_m, height_m in zip(places_m, ground.compute_heights_m(places_m), strict=True):
        a, b, c = corners_m[:, 0], corners_m[:, 1], corners_m[:, 2]
        sides = [
            (q - p)[:, 0] * (place_m[1] - p[:, 1]) - (q - p)[:, 1] * (place_m[0] - p[:, 0])
            for p, q in ((a, b), (b, c), (c, a))
        ]
        first = int(np.argmax(np.min(sides, axis=0)))
        weights = np.array([sides[1][first], sides[2][first], sides[0][first]])
        assert (weights >= 0).all()
        assert height_m == pytest.approx(weights @ corners_m[first, :, 2] / weights.sum())


def test_ground_faces_up_without_holes():
    mesh = trimesh.Trimesh(*build_random_ground().build_mesh(), process=False)
    assert (mesh.face_normals[:, 2] > 0).all()
    assert mesh.area_faces @ mesh.face_normals[:, 2] == pytest.approx(8 * 6 * 25.0)


@pytest.mark.parametrize("z", [(1.0, 1.0), (0.0, 12.0)])
def test_curbs_are_closed_with_the_right_height(z, tmp_path):
    near = build_vicinity(tmp_path, street(z=z))
    ground = build_ground(near)
    pavement = Sidewalks(near, ground)
    (mesh,) = pavement.build_meshes()
    body = trimesh.Trimesh(*mesh, process=False)
    assert body.is_watertight
    assert body.is_winding_consistent
    assert body.volume == pytest.approx(400.0 * 2.0 * (0.15 + 0.3), rel=1e-3)
    above_m = mesh.vertices_m[:, 2] - ground.compute_heights_m(mesh.vertices_m[:, :2])
    np.testing.assert_allclose(np.unique(above_m.round(9)), [-0.3, 0.15])
    on, off = np.array([[50.0, -2.75], [399.0, -3.7]]), np.array([[50.0, -1.7], [50.0, 0.0], [50.0, -3.8]])
    assert pavement.is_inside(on).all()
    assert not pavement.is_inside(off).any()


def test_vehicles_stay_off_curbs(tmp_path):
    crossing = edge(":j_c0", (WALK, 4.0, [(100, -5, 0), (100, 5, 0)]), function="crossing")
    corner = edge(":j_w0", (WALK, 4.0, [(200, -9, 0), (240, -9, 0), (240, 1, 0), (200, 1, 0)]), function="walkingarea")
    near = build_vicinity(tmp_path, street(), crossing, corner)
    pavement = Sidewalks(near, build_ground(near))
    xs = np.linspace(1.0, 399.0, 400)
    assert not pavement.is_inside(np.column_stack([xs, np.full(400, -1.7)])).any()
    assert not pavement.is_inside(np.array([[99.0, -2.75], [101.0, -3.5]])).any()
    assert pavement.is_inside(np.array([[97.0, -2.75], [103.0, -2.75], [220.0, -8.0]])).all()
    assert len(pavement.polygons) == 2
    for mesh in pavement.build_meshes():
        assert trimesh.Trimesh(*mesh, process=False).is_watertight


def test_bridges_have_decks_above_the_ground(tmp_path):
    over = edge("over", (DRIVE, 7.0, [(100, -150, 0), (100, -60, 6), (100, 60, 6), (100, 150, 0)]))
    near = build_vicinity(tmp_path, street(), over)
    ground = build_ground(near)
    np.testing.assert_allclose(
        ground.compute_heights_m(np.array([[80.0, 0.0], [100.0, 0.0], [120.0, 0.0]])), 0.0, atol=0.05
    )
    np.testing.assert_allclose(ground.compute_heights_m(np.array([[100.0, -55.0], [100.0, 55.0]])), 6.0, atol=0.1)
    (deck,) = build_bridges(near)
    body = trimesh.Trimesh(*deck, process=False)
    assert body.is_watertight
    assert body.volume > 0
    np.testing.assert_allclose(np.unique(deck.vertices_m[:, 2]), [5.2, 6.0])
    np.testing.assert_allclose(np.ptp(deck.vertices_m[:, 0]), 7.0)
    assert deck.vertices_m[:, 1].min() < -2.75
    assert deck.vertices_m[:, 1].max() > 1.75


def test_only_streets_near_the_path_are_built(tmp_path):
    near = build_vicinity(tmp_path, street(), street("far", y=400.0), street("beyond", y=270.0))
    assert {lane.edge_id for lane in near.lanes} == {"east", "beyond"}
