"""Worlds with traffic, made from a few parameters and a seed."""

from torchcover.simulation.traffic.highway import Highway
from torchcover.simulation.traffic.parking import Parking
from torchcover.simulation.traffic.urban import Urban

__all__ = ["Highway", "Parking", "Urban"]
