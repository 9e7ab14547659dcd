"""Cameras: lens models with a checked inverse, depth images to points, calibrations from files."""

from torchcover.cameras.calibration import Calibration, carla_pose
from torchcover.cameras.camera import Camera
from torchcover.cameras.depth import decode_carla, read_depth

__all__ = ["Calibration", "Camera", "carla_pose", "decode_carla", "read_depth"]
