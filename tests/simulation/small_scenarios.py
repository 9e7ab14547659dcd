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


def sum_weights(built_scenario, sensor, value=lambda points: np.ones(len(points)), num_frames=40, first_index=0):
    """Sum area weight times a value over the reference points of each frame; (steps,)."""
    simulator = Simulator(built_scenario, {}, sensor)
    observations = [simulator.simulate_frame(index) for index in range(first_index, first_index + num_frames)]
    sums_m2 = []
    for observation in observations:
        weights = observation.reference_weights.astype(np.float64)
        sums_m2.append((weights * value(observation.reference)).sum())
    return np.array(sums_m2)


def assert_agrees(samples, exact, max_relative_error=0.02):
    """Assert that the mean is exact within 4 standard errors, and that these are small."""
    error = samples.std(ddof=1) / math.sqrt(len(samples))
    assert error <= max_relative_error * abs(exact)
    assert abs(samples.mean() - exact) <= 4 * error + 1e-5 * abs(exact), (samples.mean(), exact, error)
