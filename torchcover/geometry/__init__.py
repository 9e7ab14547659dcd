"""Rigid transforms and boxes. Knows no other part of the house."""

from torchcover.geometry.bounding_box import BoundingBox, overlap
from torchcover.geometry.rigid import (
    check_rigid,
    euler_from_rotation,
    invert,
    quaternion_from_rotation,
    rigid,
    rotation_from_euler,
    rotation_from_quaternion,
    transform,
)
from torchcover.geometry.tensors import transform_tensor

__all__ = [
    "BoundingBox",
    "check_rigid",
    "euler_from_rotation",
    "invert",
    "overlap",
    "quaternion_from_rotation",
    "rigid",
    "rotation_from_euler",
    "rotation_from_quaternion",
    "transform",
    "transform_tensor",
]
