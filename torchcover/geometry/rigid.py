"""Rigid transforms: 4x4 float64 matrices named `destination_T_source` that act on column vectors."""

import math
import warnings
from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

Matrix = NDArray[np.float64]

# A calibration printed with four decimals passes; a scaled, sheared or mirrored matrix does not.
RIGID_TOLERANCE = 1e-3
# So many points stay in the cache from one step of a calculation to the next.
POINTS_AT_ONCE = 4096


def build_transform(rotation: ArrayLike, translation_m: ArrayLike) -> Matrix:
    """Assemble a transform from a rotation and a translation, or many of them.

    Args:
        rotation: (..., 3, 3) rotation matrix.
        translation_m: (..., 3) position of the source frame's origin in the destination frame, in metres.

    Returns:
        (..., 4, 4) float64 matrix.

    Example:
        >>> build_transform(np.eye(3), [1.0, 2.0, 3.0])[:3, 3]
        array([1., 2., 3.])
    """
    matrix = np.zeros((*np.shape(translation_m)[:-1], 4, 4))
    matrix[..., :3, :3] = rotation
    matrix[..., :3, 3] = translation_m
    matrix[..., 3, 3] = 1.0
    return matrix


def invert(destination_T_source: Matrix) -> Matrix:
    """Invert a rigid transform, or each of (..., 4, 4): `source_T_destination`, by transposing the rotation.

    Example:
        >>> world_T_vehicle = build_transform(convert_euler_to_rotation(90.0, 0.0, 0.0), [5.0, 0.0, 0.0])
        >>> bool(np.allclose(invert(world_T_vehicle) @ world_T_vehicle, np.eye(4)))
        True
    """
    transposed = destination_T_source[..., :3, :3].swapaxes(-1, -2)
    return build_transform(transposed, (-transposed @ destination_T_source[..., :3, 3:])[..., 0])


def convert_euler_to_rotation(yaw_deg: ArrayLike, pitch_deg: ArrayLike, roll_deg: ArrayLike) -> Matrix:
    """Rotation by roll about x, then pitch about y, then yaw about z (all axes fixed): R = Rz(yaw) Ry(pitch) Rx(roll).

    In a frame with x forward, y left, z up a positive yaw turns left, a positive pitch turns the nose DOWN
    (right-handed about y) and a positive roll lowers the right side. Of (...) angles the rotations are (..., 3, 3).

    Example:
        >>> convert_euler_to_rotation(90.0, 0.0, 0.0).round(6) @ [1.0, 0.0, 0.0]
        array([0., 1., 0.])
    """
    yaw, pitch, roll = np.deg2rad(np.array([yaw_deg, pitch_deg, roll_deg]))
    (cy, cp, cr), (sy, sp, sr) = np.cos([yaw, pitch, roll]), np.sin([yaw, pitch, roll])
    rotation = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    return rotation.transpose(*range(2, rotation.ndim), 0, 1)


def convert_rotation_to_euler(rotation: Matrix) -> Matrix:
    """Yaw, pitch and roll in degrees: the inverse of `convert_euler_to_rotation`. Straight up or down, the roll is 0.

    Args:
        rotation: (..., 3, 3) rotation matrices.

    Returns:
        (..., 3) yaw, pitch, roll.

    Example:
        >>> convert_rotation_to_euler(convert_euler_to_rotation(30.0, -20.0, 10.0)).round(9)
        array([ 30., -20.,  10.])
    """
    r = rotation
    horizontal = np.hypot(r[..., 0, 0], r[..., 1, 0])
    upright = horizontal < 1e-9
    yaw = np.where(upright, np.arctan2(-r[..., 0, 1], r[..., 1, 1]), np.arctan2(r[..., 1, 0], r[..., 0, 0]))
    # Near the vertical yaw and roll are each uncertain. With the roll taken from what this very yaw leaves of the
    # rotation, their errors cancel.
    cosine, sine = np.cos(yaw), np.sin(yaw)
    left = sine * r[..., 0, 2] - cosine * r[..., 1, 2], cosine * r[..., 1, 1] - sine * r[..., 0, 1]
    roll = np.where(upright, 0.0, np.arctan2(*left))
    pitch = np.arctan2(-r[..., 2, 0], horizontal)
    return np.asarray(np.rad2deg(np.stack([yaw, pitch, roll], axis=-1)))


def convert_quaternion_to_rotation(wxyz: ArrayLike) -> Matrix:
    """(..., 3, 3) rotation matrices of quaternions (..., 4), each w, x, y, z, which are normalised first.

    Raises:
        ValueError: A quaternion is not four finite numbers, or its norm is 0.

    Example:
        >>> convert_quaternion_to_rotation([1.0, 0.0, 0.0, 0.0]).tolist()
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    quaternion = np.asarray(wxyz, dtype=np.float64)
    if quaternion.shape[-1:] != (4,) or not np.isfinite(quaternion).all():
        raise ValueError(f"a quaternion needs four finite numbers w, x, y, z; got {wxyz!r}")
    largest = np.abs(quaternion).max(axis=-1, keepdims=True)
    if not largest.all():
        raise ValueError("a quaternion of norm 0 is no rotation; the identity is [1, 0, 0, 0] (w, x, y, z)")
    scaled = quaternion / largest  # whose square neither overflows nor vanishes
    w, x, y, z = np.moveaxis(scaled / np.linalg.norm(scaled, axis=-1, keepdims=True), -1, 0)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    return rotation.transpose(*range(2, rotation.ndim), 0, 1)


def convert_rotation_to_quaternion(rotation: Matrix) -> Matrix:
    """(w, x, y, z) of a rotation matrix, w not negative; the inverse of `convert_quaternion_to_rotation`.

    Of the symmetric matrix that a rotation makes of its quaternion it is the eigenvector with the largest eigenvalue
    (Bar-Itzhack 2000), which no rotation makes inexact.

    Example:
        >>> convert_rotation_to_quaternion(convert_euler_to_rotation(90.0, 0.0, 0.0)).round(6)
        array([0.707107, 0.      , 0.      , 0.707107])
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    matrix = np.array(
        [
            [xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, xx - yy - zz, xy + yx, xz + zx],
            [xz - zx, xy + yx, yy - xx - zz, yz + zy],
            [yx - xy, xz + zx, yz + zy, zz - xx - yy],
        ]
    )
    wxyz = np.linalg.eigh(matrix)[1][:, -1]
    return np.asarray(np.copysign(1.0, wxyz[0]) * wxyz + 0.0)  # no -0


def interpolate_quaternions(first_wxyz: Matrix, second_wxyz: Matrix, fraction: Matrix) -> Matrix:
    """(N, 4) unit quaternions at (N, 1) shares of the shorter way between two of (N, 4) each, at an even rate."""
    cosine = (first_wxyz * second_wxyz).sum(axis=1, keepdims=True)
    second_wxyz, cosine = np.where(cosine < 0, -second_wxyz, second_wxyz), np.abs(cosine).clip(max=1.0)
    angle = np.arccos(cosine)
    straight = angle < 1e-6
    sine = np.where(straight, 1.0, np.sin(angle))
    of_first = np.where(straight, 1 - fraction, np.sin((1 - fraction) * angle) / sine)
    of_second = np.where(straight, fraction, np.sin(fraction * angle) / sine)
    return np.asarray(of_first * first_wxyz + of_second * second_wxyz)


def check_rigid(matrix: ArrayLike, name: str) -> Matrix:
    """Return `matrix` as float64 if it is a rigid transform, else say by how much it is not.

    Args:
        matrix: (4, 4) transform as it came from outside.
        name: What the user calls it, for the message.

    Returns:
        (4, 4) float64 copy whose rotation is orthonormal to the last bits (the nearest rotation to a matrix that
        was printed with a few decimals).

    Raises:
        ValueError: Not 4x4, not finite, last row not 0 0 0 1, or the 3x3 part deviates from a rotation by more
            than 1e-3 (scaled, sheared or mirrored).
    """
    try:
        array = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: a 4x4 matrix of numbers is needed; got {matrix!r}") from error
    if array.shape != (4, 4):
        raise ValueError(f"{name}: a 4x4 matrix is needed; got shape {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: {int((~np.isfinite(array)).sum())} of its 16 entries are NaN or infinite")
    if not np.array_equal(array[3], [0.0, 0.0, 0.0, 1.0]):
        raise ValueError(f"{name}: the last row of a rigid transform is 0 0 0 1; got {array[3].tolist()}")
    rotation = array[:3, :3]
    deviation = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    determinant = float(np.linalg.det(rotation))
    if deviation > RIGID_TOLERANCE:
        raise ValueError(
            f"{name}: not a rigid transform: R R^T deviates from the identity by {deviation:.3g} "
            f"(allowed {RIGID_TOLERANCE:g}), determinant {determinant:.6g}; remove scale and shear"
        )
    if determinant < 0:
        raise ValueError(
            f"{name}: a mirror, not a rotation (determinant {determinant:.6g}); flip one axis of the source frame"
        )
    u, _, vt = np.linalg.svd(rotation)
    return build_transform(u @ vt, array[:3, 3])


def transform_points(destination_T_source: Matrix, points_m: NDArray[np.floating]) -> Matrix:
    """Transform points, in float64 whatever their type, so that UTM-sized coordinates keep their millimetres.

    Args:
        destination_T_source: (4, 4) rigid transform.
        points_m: (N, 3) points in the source frame.

    Returns:
        (N, 3) float64 points in the destination frame.

    Example:
        >>> transform_points(build_transform(np.eye(3), [0.0, 0.0, 1.7]), np.zeros((1, 3)))
        array([[0. , 0. , 1.7]])
    """
    rotation, translation = destination_T_source[:3, :3], destination_T_source[:3, 3]
    # R (p - R^T (-t)): the large numbers of a world frame cancel in the subtraction, before anything is multiplied.
    shift = rotation.T @ translation
    moved = np.empty(points_m.shape)
    for rows in iterate_blocks(len(points_m)):
        np.matmul(points_m[rows].astype(np.float64, copy=False) + shift, rotation.T, out=moved[rows])
    return moved


def iterate_blocks(num_points: int) -> Iterator[slice]:
    """Parts of a cloud, one after the other, for which memory is fast.

    Example:
        >>> [(rows.start, rows.stop) for rows in iterate_blocks(5000)]
        [(0, 4096), (4096, 5000)]
    """
    start = 0
    while start < num_points:
        # A last point alone goes with the others: by itself it would be rounded another way.
        stop = num_points if num_points - start <= POINTS_AT_ONCE + 1 else start + POINTS_AT_ONCE
        yield slice(start, stop)
        start = stop


# Steps of round angles in degrees -> decimals from which a number that equals them in radians is no chance.
ROUND_DEG = {90: 2, 15: 3, 5: 4}


def warn_about_radians(angles_deg: Mapping[str, float | Iterable[float]]) -> None:
    """Warn of angles in degrees that are round angles in radians, such as 1.5708 or 3.14.

    Angles of one document have one unit: nothing is said if any of them is more than a full turn in radians.

    Args:
        angles_deg: Name of each angle, or of several -> what was given for degrees.

    Warns:
        UserWarning: One looks like radians.

    Example:
        >>> import pytest
        >>> with pytest.warns(UserWarning, match="yaw_deg: 1.5708 looks like 90 degrees in radians"):
        ...     warn_about_radians({"yaw_deg": 1.5708})
    """
    named = []
    for name, value in angles_deg.items():
        named += [(name, float(angle)) for angle in ([value] if isinstance(value, int | float) else value)]
    if any(abs(angle) > 2 * math.pi + 0.01 for _, angle in named):
        return
    for name, angle in named:
        round_deg = find_round_degrees(angle)
        if round_deg is not None:
            warnings.warn(
                f"{name}: {angle:g} looks like {round_deg:g} degrees in radians; angles are in degrees here",
                stacklevel=2,
            )


def find_round_degrees(angle_rad: float) -> float | None:
    """Return the round angle in degrees that a number is in radians, to all of its decimals; None if it is none.

    Example:
        >>> find_round_degrees(-0.7854), find_round_degrees(1.57), find_round_degrees(0.2)
        (-45, 90, None)
    """
    decimals = len(repr(angle_rad).partition(".")[2])
    for step_deg, least in ROUND_DEG.items():
        degrees = step_deg * round(math.degrees(angle_rad) / step_deg)
        if degrees and decimals >= least and abs(math.radians(degrees) - angle_rad) <= 10.0**-decimals + 1e-15:
            return degrees
    return None
