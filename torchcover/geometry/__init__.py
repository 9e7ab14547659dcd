"""Rigid transforms and boxes. Knows no other part of the house."""

from torchcover.geometry.boxes import Box, overlap
from torchcover.geometry.rigid import (
    check_rigid,
    euler_from_rotation,
    invert,
    rigid,
    rotation_from_euler,
    rotation_from_quaternion,
    transform,
)

__all__ = [
    "Box",
    "check_rigid",
    "euler_from_rotation",
    "invert",
    "overlap",
    "rigid",
    "rotation_from_euler",
    "rotation_from_quaternion",
    "transform",
]
