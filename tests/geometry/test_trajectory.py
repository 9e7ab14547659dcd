"""Trajectories at and between the times of their poses."""

import re

import numpy as np
import pytest

from torchcover.geometry import build_transform, convert_euler_to_rotation
from torchcover.geometry.trajectory import Trajectory, interpolate_poses


def test_poses_are_interpolated_linearly_along_shorter_rotations():
    turn = Trajectory.from_arrays(
        [0.0, 2.0, 3.0], [[0, 0, 0], [4, 0, 0], [4, 2, 0]], [[170, 0, 0], [-170, 10, 0], [-170, 10, -6]]
    )
    np.testing.assert_allclose(turn.interpolate(1.0)[:3, 3], [2, 0, 0])
    np.testing.assert_allclose(turn.interpolate(1.0)[:3, :3], convert_euler_to_rotation(180, 5, 0), atol=1e-12)
    np.testing.assert_allclose(turn.interpolate(2.5)[:3, :3], convert_euler_to_rotation(-170, 10, -3), atol=1e-12)
    np.testing.assert_allclose(turn.interpolate(2.0)[:3, 3], [4, 0, 0])


def test_bodies_rest_or_vanish_outside_their_times():
    resting = Trajectory.from_arrays([1.0, 2.0], [[0, 0, 0], [1, 0, 0]], [[0, 0, 0]] * 2)
    np.testing.assert_array_equal(resting.interpolate(-5.0), resting.interpolate(1.0))
    np.testing.assert_array_equal(resting.interpolate(9.0), resting.interpolate(2.0))
    transient = Trajectory(resting.times_s, resting.positions_m, resting.angles_deg, is_transient=True)
    times = np.array([0.9, 1.0, 1.5, 2.0, 2.1])
    np.testing.assert_allclose(transient.interpolate_positions_m(times)[:, 0], [np.nan, 0, 0.5, 1, np.nan])
    np.testing.assert_allclose(resting.interpolate_positions_m(times)[:, 0], [0, 0, 0.5, 1, 1])


def test_poses_at_many_times_are_those_at_each():
    generator = np.random.default_rng(0)
    track = Trajectory.from_arrays(
        np.sort(generator.uniform(0, 9, 20)), generator.normal(size=(20, 3)), generator.uniform(-180, 180, (20, 3))
    )
    times = np.append(track.times_s, generator.uniform(-1, 10, 50))
    poses = np.stack([track.interpolate(time) for time in times])
    np.testing.assert_allclose(track.interpolate_positions_m(times), poses[:, :3, 3], atol=1e-12)
    np.testing.assert_allclose(track.interpolate_many(times), poses, atol=1e-12)
    resting = Trajectory.create_static((1, 2, 3), (4, 5, 6))
    np.testing.assert_allclose(
        resting.interpolate_many(times), np.stack([resting.interpolate(0)] * len(times)), atol=1e-12
    )


def test_poses_of_many_bodies_are_those_of_each():
    generator, common = np.random.default_rng(2), np.array([0.0, 1.0, 2.5])
    tracks = [
        Trajectory.from_arrays(common[:k] + late, generator.normal(size=(k, 3)), generator.uniform(-400, 400, (k, 3)))
        for k in (1, 2, 3)
        for late in (0.0, 0.0, 0.7)
    ]
    for time_s in (-1.0, 0.0, 0.3, 1.0, 2.4, 9.0):
        np.testing.assert_array_equal(
            interpolate_poses(tracks, time_s), [track.interpolate(time_s) for track in tracks]
        )
    assert interpolate_poses([], 0.0).shape == (0, 4, 4)


@pytest.mark.parametrize("pitch_deg", [(85.0, 95.0), (60.5, 80.0), (-90.0, -70.0), (89.0, 90.0)])
@pytest.mark.parametrize("others_deg", [(0.0, 0.0), (170.0, -30.0)])
def test_steep_poses_are_interpolated_about_one_axis(pitch_deg, others_deg):
    yaw_deg, roll_deg = others_deg
    ends = np.stack(
        [build_transform(convert_euler_to_rotation(yaw_deg, pitch, roll_deg), np.zeros(3)) for pitch in pitch_deg]
    )
    body = Trajectory.from_poses([0.0, 1.0], ends)
    for share in (0.0, 0.25, 0.5, 1.0):
        between = convert_euler_to_rotation(yaw_deg, pitch_deg[0] + share * (pitch_deg[1] - pitch_deg[0]), roll_deg)
        assert body.interpolate(share)[:3, :3] == pytest.approx(between, abs=1e-9)
        assert interpolate_poses([body, body], share)[1, :3, :3] == pytest.approx(between, abs=1e-9)
        assert body.interpolate_many(np.array([0.1, share]))[1, :3, :3] == pytest.approx(between, abs=1e-9)


def test_first_pose_out_of_order_is_named():
    """Times need only ascend; their steps may have any length."""
    for step_s in (1e-9, 0.25, 1e6):
        times_s = step_s * np.arange(4)
        Trajectory.from_arrays(times_s, np.zeros((4, 3)), np.zeros((4, 3)))
        for at in (1, 2, 3):
            disordered = times_s.copy()
            disordered[at] = disordered[at - 1]
            with pytest.raises(ValueError, match=re.escape(f"pose {at} is at {disordered[at]:g} s, after")):
                Trajectory.from_arrays(disordered, np.zeros((4, 3)), np.zeros((4, 3)))
    for column in range(7):
        numbers = np.arange(21.0).reshape(3, 7)
        numbers[1:, column] = np.nan, -np.inf
        with pytest.raises(ValueError, match="NaN or infinite numbers in 2 of 3 poses, first 1"):
            Trajectory.from_arrays(numbers[:, 0], numbers[:, 1:4], numbers[:, 4:])


def test_velocity_at_poses_is_the_mean_of_segments():
    track = Trajectory.from_arrays(
        [1.0, 1.5, 3.5, 4.0], [[0, 0, 0], [1, 0, 0], [1, 6, -2], [1, 6, -2]], np.zeros((4, 3))
    )
    expected = {0.9: [0, 0, 0], 1.0: [2, 0, 0], 1.2: [2, 0, 0], 1.5: [1, 1.5, -0.5], 2.0: [0, 3, -1],
                3.5: [0, 1.5, -0.5], 3.9: [0, 0, 0], 4.0: [0, 0, 0], 4.1: [0, 0, 0]}  # fmt: skip
    for time_s, velocity_mps in expected.items():
        np.testing.assert_allclose(track.compute_velocity_mps(time_s), velocity_mps, atol=1e-12)
    for inner_s in (1.2, 2.0, 3.7):  # the difference of positions at constant velocity
        near = track.interpolate_positions_m(np.array([inner_s - 1e-6, inner_s + 1e-6]))
        np.testing.assert_allclose(track.compute_velocity_mps(inner_s), (near[1] - near[0]) / 2e-6, atol=1e-6)
    assert Trajectory.create_static((1, 2, 3)).compute_velocity_mps(0.0).tolist() == [0, 0, 0]
    moving_last = Trajectory.from_arrays([0.0, 2.0], [[0, 0, 0], [0, -3, 0]], np.zeros((2, 3)))
    assert [moving_last.compute_velocity_mps(time_s)[1] for time_s in (-0.1, 0.0, 1.0, 2.0, 2.1)] == [
        0,
        -1.5,
        -1.5,
        -1.5,
        0,
    ]


def test_what_ever_changes_its_pose_moves():
    def moves(places, angles=None, **how):
        angles = np.zeros((len(places), 3)) if angles is None else angles
        return Trajectory(
            np.arange(len(places)) * 1.0, np.array(places, float), np.array(angles, float), **how
        ).is_moving

    here, aside = [0, 0, 0], np.eye(3)
    rest = [moves([here]), moves([here] * 3), moves([[5, 6, 7]] * 2, [[1, 2, 3]] * 2)]
    assert rest == [False] * 3
    away = [moves([here, [0, 0, 1e-9]]), moves([here, [0, 1, 0], here])]
    turning = [moves([here] * 3, [here, aside[axis], here]) for axis in range(3)]
    turning += [moves([here] * 2, [here, aside[axis]]) for axis in range(3)]
    coming = [moves([here], is_transient=True), moves([here] * 2, is_transient=True)]
    assert [*away, *turning, *coming] == [True] * 10


def test_positions_are_exact_at_the_times_of_poses():
    times_s, places = np.array([0.0, 1.0, 3.0]), np.array([[0.0, 0, 0], [2, 0, 0], [2, 8, 0]])
    for transient in (False, True):
        track = Trajectory(times_s, places, np.zeros((3, 3)), transient)
        assert track.num_bytes == 2 * 3 * 3 * 8
        for request in (times_s, times_s[:2], times_s[1:], np.array([0.0, 2.0]), np.empty(0)):
            expected = [track.interpolate(time_s)[:3, 3] for time_s in request.tolist()]
            np.testing.assert_allclose(
                track.interpolate_positions_m(request), np.reshape(expected, (-1, 3)), atol=1e-12
            )
    for transient, before in ((False, [1, 2, 3]), (True, [np.nan] * 3)):
        alone = Trajectory(np.array([5.0]), np.array([[1.0, 2, 3]]), np.zeros((1, 3)), transient)
        np.testing.assert_array_equal(alone.interpolate_positions_m(np.array([4.0, 5.0])), [before, [1, 2, 3]])
