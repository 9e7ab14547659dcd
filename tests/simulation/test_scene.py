"""The ego occludes and is not seen; the result knows no absolute place in the world."""

import numpy as np
import pytest

from torchcover.simulation import Pose, Scenario
from torchcover.simulation.lidar import unit_directions
from torchcover.simulation.scene import Scene


def scenario(pose=None, wall_x=10.0):
    pose = pose or {}
    turn = np.deg2rad(pose.get("yaw_deg", 0.0))
    wall = {
        "x_m": pose.get("x_m", 0.0) + wall_x * np.cos(turn),
        "y_m": pose.get("y_m", 0.0) + wall_x * np.sin(turn),
        "z_m": pose.get("z_m", 0.0),
        "yaw_deg": pose.get("yaw_deg", 0.0),
    }
    return Scenario.model_validate(
        {
            "name": "s",
            "ego": {"shape": {"type": "box", "size_m": [4, 2, 1]}, "pose": pose},
            "bodies": [
                {"name": "wall", "shape": {"type": "box", "size_m": [1, 20, 4]}, "poses": [wall]},
                {"name": "ground", "shape": {"type": "plane", "size_m": [200, 200]}, "poses": [{**wall}]},
            ],
        }
    )


SPHERE = unit_directions(np.linspace(-89, 89, 90)[:, None], np.linspace(-179, 179, 180)[None])


def test_the_ego_occludes_and_its_points_are_left_out():
    scan = Scene(scenario()).scan(Pose(z_m=1.5).matrix(), SPHERE)
    x, y, z = scan.points.T
    on_body = (np.abs(x) < 1.999) & (np.abs(y) < 0.999) & (z < 1.001)
    assert not on_body.any()
    # From 0.5 m above the roof's centre, its edge at x = 2 hides the ground up to x = 2 * 1.5 / 0.5 = 6.
    ground_ahead = (np.abs(z) < 1e-3) & (np.abs(y) < 0.3)
    assert x[ground_ahead & (x > 0)].min() > 5.99
    assert scan.rays == SPHERE.shape[1]
    below_roof_edge = (-SPHERE[2] / np.maximum(np.abs(SPHERE[0]) / 4, np.abs(SPHERE[1]) / 2)) > 1.0
    assert scan.self_hits == pytest.approx(below_roof_edge.sum(), abs=2)


def test_the_same_scene_far_out_in_the_world_gives_the_same_points():
    here = Scene(scenario()).scan(Pose(z_m=1.5).matrix(), SPHERE)
    utm = {"x_m": 513_248.37, "y_m": 5_403_655.81, "z_m": 312.5, "yaw_deg": 37.0}
    there = Scene(scenario(utm)).scan(Pose(z_m=1.5).matrix(), SPHERE)
    assert len(here.points) == len(there.points)
    np.testing.assert_allclose(there.points, here.points, atol=1e-3)


def test_the_vehicle_frame_follows_the_ego():
    points = Scene(scenario({"x_m": 30.0, "yaw_deg": 90.0})).scan(Pose(z_m=1.5).matrix(), SPHERE).points
    wall = points[points[:, 2] > 0.5]
    assert wall[:, 0].min() == pytest.approx(9.5, abs=1e-4)


def test_the_bounding_box_is_that_of_the_ego_in_the_vehicle_frame():
    box = Scene(scenario({"x_m": 30.0, "yaw_deg": 90.0})).ego_box
    assert box.lower_m == (-2.0, -1.0, 0.0)
    assert box.upper_m == (2.0, 1.0, 1.0)
