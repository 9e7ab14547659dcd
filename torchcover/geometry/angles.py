"""Angles in degrees that look like radians."""

import math
import warnings
from collections.abc import Iterable, Mapping

# Steps of round angles in degrees -> decimals from which a number that equals them in radians is no chance.
ROUND_DEG = {90: 2, 15: 3, 5: 4}


def warn_of_radians(angles_deg: Mapping[str, float | Iterable[float]]) -> None:
    """Warn of angles in degrees that are round angles in radians, such as 1.5708 or 3.14.

    Angles of one document have one unit: nothing is said if any of them is more than a full turn in radians.

    Args:
        angles_deg: Name of each angle, or of several -> what was given for degrees.

    Warns:
        UserWarning: One looks like radians.

    Example:
        >>> import pytest
        >>> with pytest.warns(UserWarning, match="yaw_deg: 1.5708 looks like 90 degrees in radians"):
        ...     warn_of_radians({"yaw_deg": 1.5708})
    """
    named = []
    for name, value in angles_deg.items():
        named += [(name, float(angle)) for angle in ([value] if isinstance(value, int | float) else value)]
    if any(abs(angle) > 2 * math.pi + 0.01 for _, angle in named):
        return
    for name, angle in named:
        round_deg = find_round_degrees(angle)
        if round_deg is not None:
            warnings.warn(
                f"{name}: {angle:g} looks like {round_deg:g} degrees in radians; angles are in degrees here",
                stacklevel=2,
            )


def find_round_degrees(angle: float) -> float | None:
    """Return the round angle in degrees that a number is in radians, to all of its decimals; None if it is none.

    Example:
        >>> find_round_degrees(-0.7854), find_round_degrees(1.57), find_round_degrees(0.2)
        (-45, 90, None)
    """
    decimals = len(repr(angle).partition(".")[2])
    for step_deg, least in ROUND_DEG.items():
        degrees = step_deg * round(math.degrees(angle) / step_deg)
        if degrees and decimals >= least and abs(math.radians(degrees) - angle) <= 10.0**-decimals + 1e-15:
            return degrees
    return None
