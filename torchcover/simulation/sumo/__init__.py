"""Traffic and road networks of SUMO."""

from torchcover.simulation.sumo.traffic import Sumo

__all__ = ["Sumo"]
