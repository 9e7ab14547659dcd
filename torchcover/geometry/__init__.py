"""Rigid transforms, boxes, height fields, and rays through voxels. Knows no other part of the house."""

from torchcover.geometry.bounding_box import BoundingBox, overlapping
from torchcover.geometry.contact import contact_s, outlines_at
from torchcover.geometry.height_field import HeightField, fitted, spread
from torchcover.geometry.rigid import (
    check_rigid,
    euler_from_rotation,
    invert,
    quaternion_from_rotation,
    rigid,
    rotation_from_euler,
    rotation_from_quaternion,
    slerp,
    transform,
)
from torchcover.geometry.tensors import transform_tensor
from torchcover.geometry.voxel_walk import VoxelGrid, crossed_voxels

__all__ = [
    "BoundingBox",
    "HeightField",
    "VoxelGrid",
    "check_rigid",
    "contact_s",
    "crossed_voxels",
    "euler_from_rotation",
    "fitted",
    "invert",
    "outlines_at",
    "overlapping",
    "quaternion_from_rotation",
    "rigid",
    "rotation_from_euler",
    "rotation_from_quaternion",
    "slerp",
    "spread",
    "transform",
    "transform_tensor",
]
