"""Targets stand on the ground: on slopes and curbs, and nowhere without ground."""

import math

import numpy as np
import pytest

from torchcover.simulation import Rig, Scenario
from torchcover.simulation.scene_geometry import SceneGeometry
from torchcover.targets.placing import Raster, compute_ground_heights_m
from torchcover.targets.result import FREE, OUTSIDE
from torchcover.targets.surface import Target
from torchcover.targets.visibility import measure_target_visibility

EGO = {"shape": {"type": "box", "size_m": [4, 2, 1.5]}}
FLOOR = {"name": "floor", "shape": {"type": "plane", "size_m": [60, 60]}, "ground": True}


def build_scenario(*bodies, **pose):
    return Scenario.model_validate({"name": "s", "ego": {**EGO, "pose": pose}, "bodies": bodies})


def build_snapshot(made):
    return SceneGeometry(made.build_scene()).get_snapshot(0)


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(0, 0), (4, 0), (-4, 3), (0, -3)])
def test_ground_heights_follow_a_tilted_plane(pitch_deg, roll_deg):
    tilted = {**FLOOR, "poses": [{"pitch_deg": pitch_deg, "roll_deg": roll_deg}]}
    places = np.random.default_rng(1).uniform(-20, 20, (200, 2))
    normal = SceneGeometry(build_scenario(tilted).build_scene()).scene.static_meshes[0].vertices_m
    across = np.cross(normal[1] - normal[0], normal[2] - normal[0])
    np.testing.assert_allclose(
        compute_ground_heights_m(build_snapshot(build_scenario(tilted)), places),
        -(places @ across[:2]) / across[2],
        atol=1e-3,
    )
    # The same for a tilted vehicle on a level plane.
    leaning = build_snapshot(build_scenario(FLOOR, pitch_deg=pitch_deg, roll_deg=roll_deg))
    on_plane = np.column_stack([places, compute_ground_heights_m(leaning, places)])
    in_world = on_plane @ leaning.world_T_vehicle[:3, :3].T
    np.testing.assert_allclose(in_world[:, 2], 0, atol=2e-3)


def test_targets_stand_on_curbs_not_on_bridges():
    deck = {"name": "deck", "shape": {"type": "box", "size_m": [8, 8, 0.5]}, "poses": [{"x_m": 10, "z_m": 4}]}
    kerb = {"name": "kerb", "shape": {"type": "box", "size_m": [8, 8, 0.15]}, "poses": [{"x_m": -10}]}
    made = build_snapshot(build_scenario(FLOOR, {**deck, "ground": True}, {**kerb, "ground": True}))
    found = compute_ground_heights_m(made, np.array([[10.0, 0], [-10, 0], [0, 20], [50, 0]]))
    np.testing.assert_allclose(found, [0, 0.15, 0, np.nan], atol=1e-4)


def test_slopes_below_the_vehicle_change_nothing():
    rig, pole, raster = Rig.load("front_roof_32"), Target.load("pole"), Raster((4.0, 12.0), (-2.0, 2.0), 1.0)
    flat = measure_target_visibility(rig, build_scenario(FLOOR), pole, raster, num_frames=2)
    tilted = {**FLOOR, "poses": [{"pitch_deg": 5.0}]}
    along = measure_target_visibility(rig, build_scenario(tilted, pitch_deg=5.0), pole, raster, num_frames=2)
    np.testing.assert_allclose(along.points, flat.points, atol=1.0)
    assert (flat.points > 10).any()
    # A level vehicle above a sloping floor: the pole is lower, and other rays hit it.
    below = measure_target_visibility(rig, build_scenario(tilted), pole, raster, num_frames=2)
    assert np.abs(below.points - flat.points).max() > 3


def test_positions_without_ground_are_outside():
    rig, pole = Rig.load("front_roof_32"), Target.load("pole")
    found = measure_target_visibility(rig, build_scenario(FLOOR), pole, Raster((26.0, 34.0), (-2.0, 2.0), 1.0))
    beyond = found.raster.positions_m[:, 0].reshape(found.raster.shape) > 30
    assert (found.state[beyond] == OUTSIDE).all()
    assert (found.state[~beyond] == FREE).all()
    assert np.isnan(found.points[beyond]).all()
    assert math.isfinite(found.points[~beyond].sum())
