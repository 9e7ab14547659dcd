"""Scene generators for traffic that is sampled from a few parameters and a seed."""

from torchcover.simulation.traffic.highway import HighwayTraffic
from torchcover.simulation.traffic.parking import ParkingTraffic
from torchcover.simulation.traffic.urban import UrbanTraffic

__all__ = ["HighwayTraffic", "ParkingTraffic", "UrbanTraffic"]
