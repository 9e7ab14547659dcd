"""Traffic and road networks of SUMO."""

from torchcover.simulation.sumo.traffic import SumoTraffic

__all__ = ["SumoTraffic"]
