"""Simulated worlds: what a rig and a reference sensor see of a scenario."""

from torchcover.simulation.camera_sensor import CameraSensor
from torchcover.simulation.documents import Pose, builtin_names
from torchcover.simulation.even_reference import EvenReference
from torchcover.simulation.lidar import Lidar, LidarModel
from torchcover.simulation.reference import PaperReference
from torchcover.simulation.rig import Rig
from torchcover.simulation.scenario import Scenario

__all__ = [
    "CameraSensor",
    "EvenReference",
    "Lidar",
    "LidarModel",
    "PaperReference",
    "Pose",
    "Rig",
    "Scenario",
    "builtin_names",
]
