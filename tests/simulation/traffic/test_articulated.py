"""Tractors with trailers: the trailer follows, and both form one vehicle."""

import numpy as np
import pytest

from torchcover.geometry import build_transform, convert_euler_to_rotation
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation.bodies import Vehicle
from torchcover.simulation.scene import Actor
from torchcover.simulation.traffic.fleet import REAR_OF, Fleet, load_bodies
from torchcover.simulation.traffic.trailers import HITCHES, compute_tractrix_yaw_rad, compute_trailer_poses

from .test_separation import Solids, find_overlaps_among

KINDS = sorted(HITCHES)


def test_trailer_follows_a_smaller_circle():
    radius_m, length_m = 10.0, 3.0
    angle = np.linspace(0.0, 4 * np.pi, 2000)
    lead_m = radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    (yaw,) = compute_tractrix_yaw_rad(lead_m[:, None], np.array([length_m]), np.array([np.pi / 2])).T
    rear_m = lead_m - length_m * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    assert np.linalg.norm(rear_m[-1]) == pytest.approx(np.sqrt(radius_m**2 - length_m**2), abs=1e-4)
    assert np.abs(np.diff(yaw)).max() < 0.02


def test_tractrix_matches_closed_form_along_a_line():
    ways_m = np.array([0.0, 0.1, 3.0, 3.5, 9.0])
    lead_m = np.stack([ways_m, np.zeros(5)], axis=1)[:, None]
    (yaw,) = compute_tractrix_yaw_rad(lead_m, np.array([4.0]), np.array([2.5])).T
    np.testing.assert_allclose(np.tan(yaw / 2), np.tan(1.25) * np.exp(-ways_m / 4.0), rtol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_tractor_and_trailer_form_the_whole_vehicle(kind):
    hitch, bodies, whole = HITCHES[kind], load_bodies(), Vehicle.load(kind).build_mesh()
    front = np.array([[hitch.center_offset_m, 0.0, 0.0]])
    (rear,) = compute_trailer_poses([kind], [front])
    parts = [
        bodies[part].transform(build_pose_matrix(pose[0])) for part, pose in ((kind, front), (hitch.trailer_kind, rear))
    ]
    vertices_m = np.concatenate([mesh.vertices_m for mesh in parts])
    assert sorted(vertices_m.round(6).tolist()) == sorted(whole.vertices_m.round(6).tolist())
    assert Fleet(bodies, None, np.random.default_rng()).get_length_m(kind) == pytest.approx(np.ptp(vertices_m[:, 0]))
    # The axles are at those of the built-in vehicle, and the hitch is ahead of them.
    wheels_m = [
        mesh for part in Vehicle.load(kind).parts if part.name == "trailer wheels" for mesh in part.build_meshes()
    ]
    middle_m = np.mean([mesh.vertices_m[:, 0].mean() for mesh in wheels_m])
    assert hitch.center_offset_m + hitch.hitch_offset_m - hitch.hitch_to_axle_m == pytest.approx(middle_m, abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("turned_deg", [-70.0, -25.0, 5.0, 50.0])
def test_tractor_and_trailer_never_overlap(kind, turned_deg):
    bodies = load_bodies()
    (rear,) = compute_trailer_poses([kind], [np.zeros((1, 3))], [np.deg2rad(turned_deg)])
    meshes = bodies[kind], bodies[HITCHES[kind].trailer_kind].transform(build_pose_matrix(rear[0]))
    pieces = [Solids.from_meshes([mesh]) for mesh in meshes]
    both = Solids.from_meshes(meshes)
    part = np.repeat([0, 1], [len(solids.low) for solids in pieces])
    assert not [(i, j, d) for i, j, d in find_overlaps_among(both) if part[i] != part[j]]


@pytest.mark.parametrize("kind", ["highway", "urban"])
def test_trailer_axles_do_not_slip_in_traffic(kind, world):
    w = world(kind, 0)
    fronts = {actor.name: actor for actor in w.actors}
    rears = [actor for actor in w.actors if actor.name.startswith(REAR_OF)]
    assert len(rears) > 3
    for rear in rears:
        front = fronts[rear.name.removeprefix(REAR_OF)]
        both = HITCHES[front.name.split()[0]]
        assert (front.category, rear.category) == ("truck", "trailer")
        drawn, own = get_poses(rear), get_poses(front)
        back = np.stack([np.cos(drawn[:, 2]), np.sin(drawn[:, 2])], axis=1)
        np.testing.assert_allclose(
            drawn[:, :2] + both.hitch_to_center_m * back, both.compute_hitch_positions_m(own), atol=1e-9
        )
        axles_m = both.compute_hitch_positions_m(own) - both.hitch_to_axle_m * back
        way_m, middle = np.diff(axles_m, axis=0), (back[1:] + back[:-1]) / 2
        assert np.abs(way_m[:, 0] * middle[:, 1] - way_m[:, 1] * middle[:, 0]).max() < 2e-3
        assert np.abs(np.diff(np.unwrap(drawn[:, 2]))).max() < np.deg2rad(1.0)


def get_poses(actor: Actor):
    own: Trajectory = actor.trajectory
    return np.column_stack([own.positions_m[:, :2], np.deg2rad(own.angles_deg[:, 0])])


def build_pose_matrix(pose):
    return build_transform(convert_euler_to_rotation(np.rad2deg(pose[2]), 0.0, 0.0), [*pose[:2], 0.0])
