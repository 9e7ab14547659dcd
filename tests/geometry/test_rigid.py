"""Rigid transforms: `destination_T_source`, 4x4 float64, acting on column vectors."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchcover.geometry import (
    build_transform,
    check_rigid,
    convert_euler_to_rotation,
    convert_quaternion_to_rotation,
    convert_rotation_to_euler,
    interpolate_quaternions,
    invert,
    transform_points,
)

angles = st.tuples(*[st.floats(-360, 360)] * 3)
positions = st.tuples(*[st.floats(-1e3, 1e3)] * 3)


def a_transform():
    return build_transform(convert_euler_to_rotation(30.0, -20.0, 10.0), [1.0, -2.0, 3.0])


@pytest.mark.parametrize(
    ("angles_deg", "point", "expected"),
    [
        ((90, 0, 0), [1, 0, 0], [0, 1, 0]),  # a positive yaw turns left
        ((0, 90, 0), [1, 0, 0], [0, 0, -1]),  # a positive pitch turns the nose down
        ((0, 0, 90), [0, 1, 0], [0, 0, 1]),  # a positive roll lifts the left side
        ((90, 90, 0), [0, 0, 1], [0, 1, 0]),  # pitch first: z -> x, then yaw: x -> y
        ((0, 90, 90), [0, 1, 0], [1, 0, 0]),  # roll first: y -> z, then pitch: z -> x
    ],
)
def test_euler_angles_by_hand(angles_deg, point, expected):
    np.testing.assert_allclose(convert_euler_to_rotation(*angles_deg) @ point, expected, atol=1e-15)


@settings(max_examples=50, deadline=None)
@given(angles)
def test_a_rotation_is_orthonormal_and_right_handed(angles_deg):
    rotation = convert_euler_to_rotation(*angles_deg)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


@settings(max_examples=50, deadline=None)
@given(angles, positions, positions)
def test_the_inverse_brings_points_back(angles_deg, translation, point):
    world_T_vehicle = build_transform(convert_euler_to_rotation(*angles_deg), translation)
    there = transform_points(world_T_vehicle, np.array([point]))
    np.testing.assert_allclose(transform_points(invert(world_T_vehicle), there)[0], point, atol=1e-10)
    np.testing.assert_allclose(invert(world_T_vehicle) @ world_T_vehicle, np.eye(4), atol=1e-10)


@settings(max_examples=50, deadline=None)
@given(angles, positions, positions)
def test_transforms_act_on_column_vectors(angles_deg, translation, point):
    matrix = build_transform(convert_euler_to_rotation(*angles_deg), translation)
    np.testing.assert_allclose(transform_points(matrix, np.array([point]))[0], (matrix @ [*point, 1.0])[:3], atol=1e-9)


def test_transform_accepts_any_dtype_and_keeps_its_input():
    points = np.arange(6, dtype=np.float32).reshape(2, 3)
    before = points.copy()
    moved = transform_points(a_transform(), points)
    assert moved.dtype == np.float64
    np.testing.assert_array_equal(points, before)
    assert transform_points(a_transform(), np.zeros((0, 3))).shape == (0, 3)


@settings(max_examples=50, deadline=None)
@given(st.tuples(*[st.floats(-10, 10)] * 3), st.floats(0.1, 10), st.floats(-180, 180))
def test_a_quaternion_turns_about_its_axis(axis, norm, angle_deg):
    axis = np.array([0.0, 0.0, 20.0]) + axis
    axis /= np.linalg.norm(axis)
    half = np.deg2rad(angle_deg) / 2
    rotation = convert_quaternion_to_rotation(norm * np.array([np.cos(half), *(np.sin(half) * axis)]))
    np.testing.assert_allclose(rotation @ axis, axis, atol=1e-12)
    across = np.cross(axis, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    turned = np.cos(2 * half) * across + np.sin(2 * half) * np.cross(axis, across)
    np.testing.assert_allclose(rotation @ across, turned, atol=1e-12)


@pytest.mark.parametrize("bad", [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0, np.nan], [[1.0, 0.0, 0.0]], np.inf])
def test_a_quaternion_of_the_wrong_kind_is_refused(bad):
    with pytest.raises(ValueError, match="four finite numbers w, x, y, z"):
        convert_quaternion_to_rotation(bad)


def test_quaternions_convert_in_batches_as_individually():
    many = np.random.default_rng(0).normal(size=(2, 3, 4))
    each = [[convert_quaternion_to_rotation(one) for one in row] for row in many]
    np.testing.assert_allclose(convert_quaternion_to_rotation(many), each, rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.int8])
def test_rounded_quaternions_convert_in_double_precision(dtype):
    few = np.array([[3, 1, -2, 5], [0, 1, 1, 1]], dtype=dtype)
    np.testing.assert_array_equal(
        convert_quaternion_to_rotation(few), convert_quaternion_to_rotation(few.astype(np.float64))
    )


def test_quaternions_are_interpolated_along_the_shorter_arc():
    random = np.random.default_rng(0)
    first, second = (of / np.linalg.norm(of, axis=1, keepdims=True) for of in random.normal(size=(2, 50, 4)))
    share = random.random((50, 1))
    between = convert_quaternion_to_rotation(interpolate_quaternions(first, second, share))
    for other in (
        interpolate_quaternions(-first, second, share),
        interpolate_quaternions(first, -second, share),
        interpolate_quaternions(second, first, 1 - share),
    ):
        np.testing.assert_allclose(convert_quaternion_to_rotation(other), between, rtol=0, atol=1e-12)
    turned = [
        np.linalg.norm(of - convert_quaternion_to_rotation(first), axis=(1, 2))
        for of in (between, convert_quaternion_to_rotation(second))
    ]
    assert (turned[0] <= turned[1] + 1e-12).all()


def test_a_quaternion_of_norm_zero_is_refused():
    with pytest.raises(ValueError, match="norm 0 is no rotation"):
        convert_quaternion_to_rotation([0.0, 0.0, 0.0, 0.0])


def test_check_rigid_repairs_printed_matrices():
    printed = a_transform().round(4)
    before = printed.copy()
    checked = check_rigid(printed.tolist(), "lidar.vehicle_T_lidar")
    rotation = checked[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(checked, a_transform(), atol=1e-4)
    np.testing.assert_array_equal(check_rigid(printed, "a")[:3, 3], printed[:3, 3])
    np.testing.assert_array_equal(printed, before)


def changed(row, column, value):
    matrix = np.eye(4)
    matrix[row, column] = value
    return matrix


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ("front", "T: a 4x4 matrix of numbers is needed; got 'front'"),
        ([[1, 2], [3]], "T: a 4x4 matrix of numbers is needed"),
        (np.eye(3), r"T: a 4x4 matrix is needed; got shape \(3, 3\)"),
        (changed(0, 3, np.nan), "T: 1 of its 16 entries are NaN or infinite"),
        (changed(3, 0, 1e-9), "T: the last row of a rigid transform is 0 0 0 1; got"),
        (changed(0, 0, 1.01), "T: not a rigid transform: R R.T deviates from the identity by 0.0201"),
        (changed(0, 1, 0.01), "T: not a rigid transform"),
        (changed(1, 1, -1.0), "T: a mirror, not a rotation .determinant -1"),
    ],
)
def test_check_rigid_says_what_is_wrong(bad, message):
    with pytest.raises(ValueError, match=message):
        check_rigid(bad, "T")


@pytest.mark.parametrize("pitch", [-90.0, -89.999, 0.0, 45.0, 90.0])
def test_euler_angles_describe_the_rotation_they_came_from(pitch):
    for yaw, roll in ((0, 0), (30, 20), (-170, 100)):
        rotation = convert_euler_to_rotation(yaw, pitch, roll)
        np.testing.assert_allclose(convert_euler_to_rotation(*convert_rotation_to_euler(rotation)), rotation, atol=1e-8)
