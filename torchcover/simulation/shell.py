"""Where reference sensors are: beside and above the ego."""

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import BoundingBox


def position_in_shell(ego: BoundingBox, shell_m: float, generator: np.random.Generator) -> NDArray[np.float64]:
    """(3,) place in metres, uniform between the ego's bounding box and that box grown sideways and upwards.

    Args:
        ego: Bounding box of the ego in the vehicle frame.
        shell_m: How far it is grown.
        generator: Source of the random numbers.
    """
    lower, upper = np.array(ego.lower_m), np.array(ego.upper_m)
    outer_lower, outer_upper = lower - [shell_m, shell_m, 0.0], upper + shell_m
    while True:
        position = generator.uniform(outer_lower, outer_upper)
        if ((position < lower) | (position > upper)).any():
            return position
