"""Labels: boxes of bodies in the vehicle frame."""

import numpy as np
import pytest

from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation.scene import Actor, Scene, compute_labels
from torchcover.simulation.shapes import Box

CAR = Box(type="box", size_m=(4.0, 2.0, 1.5)).build_mesh()
UTM_M = np.array([5.6e5, 5.9e6, 80.0])


def build_trajectory(speed_mps, yaw_deg, start_m, seconds=10.0):
    heading = np.array([np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg)), 0.0])
    start = np.asarray(start_m, dtype=float)
    return Trajectory.from_arrays([0.0, seconds], [start, start + seconds * speed_mps * heading], [[yaw_deg, 0, 0]] * 2)


def build_scene(ego, actors, parked=()):
    return Scene((CAR,), Actor("ego", "car", CAR, ego), tuple(actors), 0.5, 10.0, tuple(parked))


def test_labels_are_poses_in_the_vehicle_frame():
    """The ego drives north, 10 m/s; the truck drives east, 5 m/s, 20 m ahead of it after a second."""
    ego = build_trajectory(10.0, 90.0, UTM_M)
    truck = Actor("truck 1", "truck", CAR, build_trajectory(5.0, 0.0, UTM_M + np.array([-5.0, 30.0, 0.0])))
    (label,) = compute_labels(build_scene(ego, [truck]), time_step_index=2, max_distance_m=100.0)
    assert (label.name, label.category, label.size_m) == ("truck 1", "truck", (4.0, 2.0, 1.5))
    np.testing.assert_allclose(label.center_m, [20.0, 0.0, 0.75], atol=1e-6)
    assert label.yaw_rad == pytest.approx(-np.pi / 2)
    # Velocity over ground along the axes of the vehicle: the speed of the ego is not subtracted.
    np.testing.assert_allclose(label.velocity_mps, [0.0, -5.0], atol=1e-6)


def test_range_is_horizontal_and_absent_objects_are_unlabeled():
    ego = Trajectory.create_static([0.0, 0.0, 0.0])
    near_actor = Actor("near", "car", CAR, Trajectory.create_static([30.0, 40.0, 9.0]))
    far_actor = Actor("far", "car", CAR, Trajectory.create_static([30.0, 40.1, 0.0]))
    brief = Trajectory(np.array([0.0, 1.0]), np.array([[9.0, 0, 0], [9.0, 1, 0]]), np.zeros((2, 3)), is_transient=True)
    scene = build_scene(ego, [near_actor, far_actor, Actor("brief", "car", CAR, brief)])
    assert [label.name for label in compute_labels(scene, 0, 50.0)] == ["near", "brief"]
    assert [label.name for label in compute_labels(scene, 4, 50.0)] == ["near"]


def test_parked_objects_have_labels_too():
    parked = Actor("parked van 0", "car", CAR, Trajectory.create_static([7.0, 3.0, 0.0], [180.0, 0.0, 0.0]))
    (label,) = compute_labels(build_scene(Trajectory.create_static([0, 0, 0]), [], [parked]), 3, 50.0)
    assert label.name == "parked van 0"
    np.testing.assert_array_equal(label.velocity_mps, 0.0)


def test_velocity_at_a_pose_averages_both_segments():
    track = Trajectory.from_arrays([1.0, 2.0, 4.0], [[0, 0, 0], [10, 0, 0], [10, 8, 0]], np.zeros((3, 3)))
    for time_s, expected in {
        0.5: [0, 0, 0], 1.0: [10, 0, 0], 1.5: [10, 0, 0], 2.0: [5, 2, 0], 3.0: [0, 4, 0], 4.0: [0, 4, 0], 4.5: [0, 0, 0]
    }.items():  # fmt: skip
        np.testing.assert_allclose(track.compute_velocity_mps(time_s), expected, err_msg=f"at {time_s} s")
    np.testing.assert_array_equal(Trajectory.create_static([1, 2, 3]).compute_velocity_mps(0.0), 0.0)


def test_velocity_is_the_slope_of_the_positions():
    generator = np.random.default_rng(0)
    times_s = np.cumsum(generator.uniform(0.1, 0.5, 20))
    track = Trajectory.from_arrays(times_s, generator.normal(size=(20, 3)), np.zeros((20, 3)))
    for time_s in generator.uniform(times_s[0] + 0.01, times_s[-1] - 0.01, 30):
        if np.abs(times_s - time_s).min() > 1e-4:
            slope = (track.interpolate(time_s + 1e-5)[:3, 3] - track.interpolate(time_s - 1e-5)[:3, 3]) / 2e-5
            np.testing.assert_allclose(track.compute_velocity_mps(time_s), slope, atol=1e-6)
