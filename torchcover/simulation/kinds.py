"""Registries of sensors, reference sensors and traffic, by the names that files and options use."""

from torchcover.simulation.camera_sensor import CameraSensor
from torchcover.simulation.lidar import Lidar
from torchcover.simulation.radar import Radar
from torchcover.simulation.recorded.traffic import RecordedTraffic
from torchcover.simulation.reference_sensor import PaperReference, ReferenceSensor
from torchcover.simulation.sensor import Sensor
from torchcover.simulation.sumo import SumoTraffic
from torchcover.simulation.surface_reference import SurfaceReference
from torchcover.simulation.traffic import HighwayTraffic, ParkingTraffic, UrbanTraffic
from torchcover.simulation.traffic.kind import Traffic

# Keys are values of `type` of a sensor in a rig file.
SENSORS: dict[str, type[Sensor]] = {"lidar": Lidar, "camera": CameraSensor, "radar": Radar}
REFERENCE_SENSORS: dict[str, type[ReferenceSensor]] = {
    sensor.name: sensor for sensor in (PaperReference, SurfaceReference)
}
# Keys are values of `type` of `traffic` in a scenario.
TRAFFIC: dict[str, type[Traffic]] = {
    "urban": UrbanTraffic,
    "highway": HighwayTraffic,
    "parking": ParkingTraffic,
    "sumo": SumoTraffic,
    "tracks": RecordedTraffic,
}
