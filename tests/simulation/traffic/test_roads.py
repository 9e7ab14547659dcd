"""Lines: poses against geometry."""

import numpy as np
import pytest

from torchcover.simulation.traffic.alignment import Polyline, loop


def circle(radius, corners=720):
    angle = np.linspace(0, 2 * np.pi, corners + 1)
    return Polyline(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))


@pytest.mark.parametrize("place", [-30.0, 0.0, 12.5, 100.0, 130.0])
def test_a_straight_line_goes_on_beyond_its_ends(place):
    yaw = np.deg2rad(30.0)
    ends_m = np.array([1.0, 2.0]) + np.array([[0.0], [100.0]]) * [np.cos(yaw), np.sin(yaw)]
    x, y, yaw_deg = Polyline(ends_m).poses(place)
    np.testing.assert_allclose([x, y], [1 + place * np.cos(yaw), 2 + place * np.sin(yaw)])
    assert yaw_deg == pytest.approx(30.0)


def test_poses_on_a_circle():
    place = np.linspace(1.0, 300.0, 57)
    poses = circle(50.0).poses(place)
    angle = place / 50.0
    np.testing.assert_allclose(poses[:, :2], 50 * np.stack([np.cos(angle), np.sin(angle)], axis=1), atol=0.01)
    np.testing.assert_allclose(poses[:, 2], np.rad2deg(angle) + 90, atol=0.05)


def test_a_loop_closes_without_a_jump_and_repeats():
    line = loop(80.0, 20.0, 6.0)
    assert line.length_m == pytest.approx(2 * (80 + 20) - 8 * 6 + 2 * np.pi * 6, rel=1e-3)
    place = np.arange(-30.0, line.length_m + 30.0, 0.1)
    poses = line.poses(place)
    assert np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1).max() < 0.1001
    turn = (np.diff(poses[:, 2]) + 180) % 360 - 180
    assert turn.min() >= -1e-9
    assert turn.max() < 2.0
    np.testing.assert_allclose(line.poses(place + line.length_m)[:, :2], poses[:, :2], atol=1e-9)
    assert np.abs(poses[:, 0]).max() == pytest.approx(40.0)
    assert np.abs(poses[:, 1]).max() == pytest.approx(10.0)


def test_headings_follow_the_movement():
    line = loop(80.0, 20.0, 6.0)
    place = np.arange(0.0, line.length_m, 0.05)
    ahead, here = line.poses(place + 0.02), line.poses(place)
    moved = np.rad2deg(np.arctan2(*(ahead - here)[:, 1::-1].T))
    assert np.abs((moved - here[:, 2] + 180) % 360 - 180).max() < 3.5
