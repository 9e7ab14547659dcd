"""Small scenarios, and the area in m² that a surface reference observes in them."""

import math

import numpy as np

from torchcover.simulation import Scenario, Simulator

AHEAD = ((4.0, 24.0), (-5.0, 5.0))
ALL_HEIGHTS = ((-3.0, 3.0),)
EGO = {"shape": {"type": "box", "size_m": [4, 2, 1.5]}}
FLOOR = {"name": "floor", "shape": {"type": "plane", "size_m": [400, 400]}}


def box(size_m, **pose):
    return {"name": "box", "shape": {"type": "box", "size_m": size_m}, "poses": [pose]}


def scenario(*bodies, ego=EGO, **keys):
    return Scenario.model_validate({"name": "s", "ego": ego, "bodies": bodies, **keys})


def sums(made, sensor, value=lambda points: np.ones(len(points)), steps=40, first=0):
    """Sum area weight times a value over the reference points of each frame; (steps,)."""
    simulator = Simulator(made, {}, sensor)
    seen = [simulator.simulate_frame(index) for index in range(first, first + steps)]
    return np.array([(step.reference_weights.astype(np.float64) * value(step.reference)).sum() for step in seen])


def agrees(samples, exact, within=0.02):
    """Assert that the mean is exact within 4 standard errors, and that these are small."""
    error = samples.std(ddof=1) / math.sqrt(len(samples))
    assert error <= within * abs(exact)
    assert abs(samples.mean() - exact) <= 4 * error + 1e-5 * abs(exact), (samples.mean(), exact, error)
