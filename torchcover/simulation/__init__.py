"""Simulated worlds: what a rig and a reference sensor see of a scenario."""

from torchcover.simulation.camera_sensor import CameraSensor
from torchcover.simulation.documents import Document, Pose, builtin_names
from torchcover.simulation.even_reference import EvenReference
from torchcover.simulation.kinds import REFERENCE_SENSORS, SENSORS
from torchcover.simulation.labels import Label
from torchcover.simulation.lidar import Lidar, LidarModel
from torchcover.simulation.observation import Observation
from torchcover.simulation.paper_reference import PaperReference
from torchcover.simulation.rays import Tile, into_tiles
from torchcover.simulation.reference_sensor import Areas, ReferenceScan, ReferenceSensor, WeightKind
from torchcover.simulation.rig import Rig
from torchcover.simulation.scenario import Scenario
from torchcover.simulation.sensor import Sensor, vertical_fov_deg
from torchcover.simulation.shell import position_in_shell
from torchcover.simulation.simulator import Simulator
from torchcover.simulation.surface_reference import SurfaceReference
from torchcover.simulation.surroundings import Surroundings

__all__ = [
    "REFERENCE_SENSORS",
    "SENSORS",
    "Areas",
    "CameraSensor",
    "Document",
    "EvenReference",
    "Label",
    "Lidar",
    "LidarModel",
    "Observation",
    "PaperReference",
    "Pose",
    "ReferenceScan",
    "ReferenceSensor",
    "Rig",
    "Scenario",
    "Sensor",
    "Simulator",
    "SurfaceReference",
    "Surroundings",
    "Tile",
    "WeightKind",
    "builtin_names",
    "into_tiles",
    "position_in_shell",
    "vertical_fov_deg",
]
