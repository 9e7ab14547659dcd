"""Ray-cast clouds of the courtyard: what a search really gets, unlike random numbers."""

import torch

from torchcover.data import SimulatedFrames
from torchcover.simulation import PaperReference

STEPS = 2


def courtyard_clouds(queries, points):
    """A reference cloud and a sensor cloud of these sizes, float32, cut from the courtyard's first frames."""
    frames = SimulatedFrames("courtyard", "front_roof_128", steps=STEPS, seed=0, reference_sensor=PaperReference())
    reference = torch.cat([frames[index].reference for index in range(STEPS)])
    sensor = torch.cat([frames[0].sensor, frames[0].sensor + 0.01])
    stride = len(reference) // queries
    return reference[::stride][:queries].contiguous(), sensor[:points].contiguous()
