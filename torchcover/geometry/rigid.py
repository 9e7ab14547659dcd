"""Rigid transforms: 4x4 float64 matrices named `destination_T_source` that act on column vectors."""

import math
import warnings
from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

Matrix = NDArray[np.float64]

# Accepts calibrations that were printed with four decimals, and rejects scaled, sheared and mirrored matrices.
RIGID_TOLERANCE = 1e-3


def build_transform(rotation: ArrayLike, translation_m: ArrayLike) -> Matrix:
    """Build transforms from rotations and translations.

    Args:
        rotation: (..., 3, 3) rotation matrices.
        translation_m: (..., 3) origin of the source frame in the destination frame, in meters.

    Returns:
        (..., 4, 4) float64 matrices.

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
    """Invert rigid transforms by transposing their rotation.

    Args:
        destination_T_source: (..., 4, 4) rigid transforms.

    Returns:
        (..., 4, 4) `source_T_destination`.

    Example:
        >>> world_T_vehicle = build_transform(convert_euler_to_rotation(90.0, 0.0, 0.0), [5.0, 0.0, 0.0])
        >>> bool(np.allclose(invert(world_T_vehicle) @ world_T_vehicle, np.eye(4)))
        True
    """
    transposed = destination_T_source[..., :3, :3].swapaxes(-1, -2)
    return build_transform(transposed, (-transposed @ destination_T_source[..., :3, 3:])[..., 0])


def convert_euler_to_rotation(yaw_deg: ArrayLike, pitch_deg: ArrayLike, roll_deg: ArrayLike) -> Matrix:
    """Convert yaw, pitch and roll to rotation matrices: R = Rz(yaw) Ry(pitch) Rx(roll), about fixed axes.

    In a frame with x forward, y left, z up, a positive yaw turns left, a positive pitch turns the nose DOWN
    (right-handed about y), and a positive roll lowers the right side.

    Args:
        yaw_deg: (...) rotation about z in degrees.
        pitch_deg: (...) rotation about y in degrees.
        roll_deg: (...) rotation about x in degrees, applied first.

    Returns:
        (..., 3, 3) rotation matrices.

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
    """Convert rotation matrices to yaw, pitch and roll; the inverse of `convert_euler_to_rotation`.

    Args:
        rotation: (..., 3, 3) rotation matrices.

    Returns:
        (..., 3) yaw, pitch, roll in degrees; the roll is 0 at a pitch of +-90 degrees.

    Example:
        >>> convert_rotation_to_euler(convert_euler_to_rotation(30.0, -20.0, 10.0)).round(9)
        array([ 30., -20.,  10.])
    """
    r = rotation
    cos_pitch = np.hypot(r[..., 0, 0], r[..., 1, 0])
    is_vertical = cos_pitch < 1e-9
    yaw = np.where(is_vertical, np.arctan2(-r[..., 0, 1], r[..., 1, 1]), np.arctan2(r[..., 1, 0], r[..., 0, 0]))
    # Near the vertical, yaw and roll are each uncertain. Computed from the rotation without this yaw, the roll has an
    # error that cancels with the error of the yaw.
    cos_yaw, sin_yaw = np.cos(yaw), np.sin(yaw)
    sin_roll = sin_yaw * r[..., 0, 2] - cos_yaw * r[..., 1, 2]
    cos_roll = cos_yaw * r[..., 1, 1] - sin_yaw * r[..., 0, 1]
    roll = np.where(is_vertical, 0.0, np.arctan2(sin_roll, cos_roll))
    pitch = np.arctan2(-r[..., 2, 0], cos_pitch)
    return np.asarray(np.rad2deg(np.stack([yaw, pitch, roll], axis=-1)))


def convert_quaternion_to_rotation(wxyz: ArrayLike) -> Matrix:
    """Convert quaternions to rotation matrices.

    Args:
        wxyz: (..., 4) quaternions w, x, y, z of any norm above 0.

    Returns:
        (..., 3, 3) rotation matrices.

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
    scaled = quaternion / largest  # so that squares neither overflow nor underflow
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
    """Convert a rotation matrix to a quaternion; the inverse of `convert_quaternion_to_rotation`.

    The quaternion is the eigenvector with the largest eigenvalue of a symmetric matrix (Bar-Itzhack 2000), which is
    exact for all rotations.

    Args:
        rotation: (3, 3) rotation matrix.

    Returns:
        (4,) unit quaternion w, x, y, z with w >= 0.

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
    """Interpolate between unit quaternions along the shorter arc at constant angular velocity (slerp).

    Args:
        first_wxyz: (N, 4) unit quaternions at fraction 0.
        second_wxyz: (N, 4) unit quaternions at fraction 1.
        fraction: (N, 1) fractions in [0, 1].

    Returns:
        (N, 4) unit quaternions.
    """
    cosine = (first_wxyz * second_wxyz).sum(axis=1, keepdims=True)
    second_wxyz, cosine = np.where(cosine < 0, -second_wxyz, second_wxyz), np.abs(cosine).clip(max=1.0)
    angle = np.arccos(cosine)
    is_linear = angle < 1e-6
    sine = np.where(is_linear, 1.0, np.sin(angle))
    first_weight = np.where(is_linear, 1 - fraction, np.sin((1 - fraction) * angle) / sine)
    second_weight = np.where(is_linear, fraction, np.sin(fraction * angle) / sine)
    return np.asarray(first_weight * first_wxyz + second_weight * second_wxyz)


def check_rigid(matrix: ArrayLike, name: str) -> Matrix:
    """Check that a matrix is a rigid transform, and orthonormalize its rotation.

    Args:
        matrix: (4, 4) transform from a file or a user.
        name: Name of the matrix in messages.

    Returns:
        (4, 4) float64 copy with the nearest exact rotation, for matrices that were printed with a few decimals.

    Raises:
        ValueError: The matrix is not 4x4 or not finite, its last row is not 0 0 0 1, or its 3x3 part deviates from a
            rotation by more than 1e-3 (scaled, sheared or mirrored).
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
    """Transform points in float64, so that coordinates of UTM size keep their millimeters.

    Args:
        destination_T_source: (4, 4) rigid transform.
        points_m: (N, 3) points in the source frame in meters, any floating-point dtype.

    Returns:
        (N, 3) float64 points in the destination frame in meters.

    Example:
        >>> transform_points(build_transform(np.eye(3), [0.0, 0.0, 1.7]), np.zeros((1, 3)))
        array([[0. , 0. , 1.7]])
    """
    rotation, translation = destination_T_source[:3, :3], destination_T_source[:3, 3]
    # R (p - R^T (-t)): the large coordinates of a world frame cancel in the subtraction, before the multiplication.
    shift = rotation.T @ translation
    transformed = np.empty(points_m.shape)
    for rows in iterate_blocks(len(points_m)):
        np.matmul(points_m[rows].astype(np.float64, copy=False) + shift, rotation.T, out=transformed[rows])
    return transformed


def iterate_blocks(num_points: int) -> Iterator[slice]:
    """Yield slices of a cloud that fit into the CPU cache.

    Args:
        num_points: Number of points.

    Example:
        >>> [(rows.start, rows.stop) for rows in iterate_blocks(5000)]
        [(0, 4096), (4096, 5000)]
    """
    block_size, start = 4096, 0
    while start < num_points:
        # A single last point joins the block before, since NumPy multiplies single rows with other rounding.
        stop = num_points if num_points - start <= block_size + 1 else start + block_size
        yield slice(start, stop)
        start = stop


# Number of decimals from which the value of a round angle in radians is no coincidence, by step of round angles in
# degrees.
DECIMALS_BY_STEP_DEG = {90: 2, 15: 3, 5: 4}


def warn_about_radians(angles_deg: Mapping[str, float | Iterable[float]]) -> None:
    """Warn about angles in degrees that look like round angles in radians, such as 1.5708 or 3.14.

    All angles of a document have the same unit: there is no warning if any exceeds a full turn in radians.

    Args:
        angles_deg: Angle, or several, in degrees by name.

    Warns:
        UserWarning: An angle looks like radians.

    Example:
        >>> import pytest
        >>> with pytest.warns(UserWarning, match="yaw_deg: 1.5708 looks like 90 degrees in radians"):
        ...     warn_about_radians({"yaw_deg": 1.5708})
    """
    named_angles: list[tuple[str, float]] = []
    for name, value in angles_deg.items():
        for angle in [value] if isinstance(value, int | float) else value:
            named_angles.append((name, float(angle)))
    if any(abs(angle) > 2 * math.pi + 0.01 for _, angle in named_angles):
        return
    for name, angle in named_angles:
        round_deg = find_round_degrees(angle)
        if round_deg is not None:
            warnings.warn(
                f"{name}: {angle:g} looks like {round_deg:g} degrees in radians; angles are in degrees here",
                stacklevel=2,
            )


def find_round_degrees(angle_rad: float) -> float | None:
    """Find the round angle in degrees that equals an angle in radians in all of its decimals.

    Args:
        angle_rad: Angle in radians, as it was written.

    Returns:
        Degrees; None if no round angle matches.

    Example:
        >>> find_round_degrees(-0.7854), find_round_degrees(1.57), find_round_degrees(0.2)
        (-45, 90, None)
    """
    decimals = len(repr(angle_rad).partition(".")[2])
    for step_deg, min_decimals in DECIMALS_BY_STEP_DEG.items():
        degrees = step_deg * round(math.degrees(angle_rad) / step_deg)
        if degrees and decimals >= min_decimals and abs(math.radians(degrees) - angle_rad) <= 10.0**-decimals + 1e-15:
            return degrees
    return None
