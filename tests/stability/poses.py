"""Poses and points at the limits of angles, lengths and types."""

from functools import lru_cache, partial
from itertools import product

import numpy as np
import torch

from torchcover.cameras import Camera
from torchcover.geometry import (
    build_transform,
    convert_euler_to_rotation,
    convert_quaternion_to_rotation,
    convert_rotation_to_euler,
    invert,
    transform_points,
)
from torchcover.geometry.trajectory import Trajectory

from .case import Case, most


def as_angle(rotation, other):
    """Compute the angle between rotations in radians from their difference."""
    return float(np.abs(rotation - other).max())


STEEP = (90.0, -90.0, 90.0 - 3e-8, 90.0 - 1e-7, 1e-7 - 90.0, 90.0 - 1e-5)


@lru_cache
def steep_rotations():
    """Rotations pitched by +-90 degrees and nearly so, as products of others: with the rounding of real ones."""
    generator = np.random.default_rng(0)
    turns = [convert_euler_to_rotation(*generator.uniform(-180, 180, 3)) for _ in range(200)]
    yaw_roll = generator.uniform(-180, 180, size=(200, 2))
    return [
        turn @ (turn.T @ convert_euler_to_rotation(yaw, pitch, roll))
        for turn, (yaw, roll) in zip(turns, yaw_roll, strict=True)
        for pitch in STEEP
    ]


def steep(euler):
    return max(as_angle(convert_euler_to_rotation(*euler(rotation)), rotation) for rotation in steep_rotations())


def euler_by_the_book(r):
    """Interpolate each angle separately."""
    angles = np.arctan2(r[1, 0], r[0, 0]), np.arcsin(np.clip(-r[2, 0], -1, 1)), np.arctan2(r[2, 1], r[2, 2])
    return np.rad2deg(angles)


PITCHES = ((85.0, 95.0), (60.5, 120.0), (-90.0, -70.0), (89.999, 90.001), (90.0, 90.0))


def between_steep(between):
    """Create a body that pitches through the vertical between two poses."""
    worst = 0.0
    for (first, last), (yaw, roll) in product(PITCHES, ((0.0, 0.0), (170.0, -30.0), (-90.0, 179.0))):
        ends = [convert_euler_to_rotation(yaw, pitch, roll) for pitch in (first, last)]
        for share in (0.0, 0.1, 0.5, 0.9):
            expected = convert_euler_to_rotation(yaw, first + share * (last - first), roll)
            worst = max(worst, as_angle(between(ends, share), expected))
    return worst


def on_a_trajectory(ends, share):
    return Trajectory.from_poses([0.0, 1.0], np.stack([build_transform(end, np.zeros(3)) for end in ends])).interpolate(
        share
    )[:3, :3]


def angle_by_angle(ends, share):
    first, last = (convert_rotation_to_euler(end) for end in ends)
    return convert_euler_to_rotation(*(first + share * ((last - first + 180.0) % 360.0 - 180.0)))


def quaternions(of):
    """Quaternions of any length are the same rotation; the largest deviation over lengths from 1e-300 to 1e300."""
    unit = np.array([0.5, -0.5, 0.5, 0.5])
    return max(as_angle(of(unit * 10.0**exponent), of(unit)) for exponent in range(-300, 301, 20))


def quaternion_by_norm(wxyz):
    with np.errstate(all="ignore"):
        w, x, y, z = np.nan_to_num(wxyz / np.sqrt((wxyz**2).sum()), nan=0.0, posinf=1.0, neginf=-1.0)
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                     [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                     [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])  # fmt: skip


@lru_cache
def far_pose(offset_m):
    points = np.random.default_rng(1).uniform(-80, 80, size=(500, 3))
    return build_transform(convert_euler_to_rotation(37.0, 2.0, -1.0), [offset_m, -offset_m, 300.0]), points


def there_and_back(offset_m):
    world_T_vehicle, points = far_pose(offset_m)
    return most(transform_points(invert(world_T_vehicle), transform_points(world_T_vehicle, points)) - points)


def there_and_back_in_float32(offset_m):
    pose, points = far_pose(offset_m)
    there, back = pose.astype(np.float32), invert(pose).astype(np.float32)
    world = points.astype(np.float32) @ there[:3, :3].T + there[:3, 3]
    return most(world @ back[:3, :3].T + back[:3, 3] - points)


@lru_cache
def camera_cloud():
    """A camera on a vehicle, points within 100 m of it, float32, and where they are in the vehicle frame."""
    camera = Camera.from_fov(
        10, 10, 90.0, vehicle_T_camera=build_transform(convert_euler_to_rotation(30.0, 20.0, 10.0), [1, 2, 3])
    )
    points = torch.from_numpy(np.random.default_rng(2).uniform(-100, 100, size=(1000, 3))).float()
    return camera, points, transform_points(camera.vehicle_T_camera, points.double().numpy())


def moved_under_autocast(move):
    camera, points, expected = camera_cloud()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        return most(move(camera, points).double().numpy() - expected)


def moved_by_product(camera, points):
    pose = torch.from_numpy(camera.vehicle_T_camera).float()
    return points @ pose[:3, :3].T + pose[:3, 3]


CASES = [
    Case("pitch of +-90 degrees and 3e-8 beside, to angles and back", "the same rotation", "rad", 2e-9,
         partial(steep, convert_rotation_to_euler), "each angle on its own", partial(steep, euler_by_the_book)),
    Case("between poses pitched by 60 to 120 degrees", "closed form", "rad", 1e-9,
         partial(between_steep, on_a_trajectory), "each angle on its own", partial(between_steep, angle_by_angle)),
    Case("quaternions of length 1e-300 to 1e300", "the same rotation", "rad", 1e-15,
         partial(quaternions, convert_quaternion_to_rotation), "divided by its norm",
         partial(quaternions, quaternion_by_norm)),
    Case("there and back, 1e7 m from the origin", "the same points", "m", 1e-8, partial(there_and_back, 1e7),
         "float32", partial(there_and_back_in_float32, 1e7)),
    Case("camera points to the vehicle under autocast", "float64", "m", 1e-5,
         partial(moved_under_autocast, Camera.to_vehicle), "matrix product",
         partial(moved_under_autocast, moved_by_product)),
]  # fmt: skip
