"""What a sensor of a rig is: a third kind is a class with these members and a line in `kinds.py`."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from torchcover.simulation.documents import Pose


class Sensor(Protocol):
    """A device on the vehicle that measures how far it is to where its rays end.

    A value, made from its keys in a rig's file, `type` among them: a `Document`, which can be compared and pickled.
    """

    @property
    def name(self) -> str:
        """What maps and messages call it; another one for each sensor of a rig."""
        ...

    @property
    def mount(self) -> Pose:
        """`vehicle_T_sensor`; the sensor's frame is x forward, y left, z up."""
        ...

    @property
    def horizontal_fov_deg(self) -> float:
        """Angle that its rays span, seen from above; 360 for a full turn."""
        ...

    @property
    def min_range_m(self) -> float:
        """Closer hits give no point."""
        ...

    @property
    def max_range_m(self) -> float:
        """Farther hits give no point."""
        ...

    @property
    def range_noise_m(self) -> float:
        """Standard deviation of the measured range, along the ray."""
        ...

    @property
    def dropout(self) -> float:
        """Probability that a ray gives no point, from 0 to 1."""
        ...

    @property
    def rays(self) -> int:
        """How many rays `directions` has, NaN ones included: asked before it is called."""
        ...

    def directions(self) -> NDArray[np.float64]:
        """(3, rows, columns) unit directions in the sensor's frame; NaN where there is no ray."""
        ...


def vertical_fov_deg(sensor: Sensor) -> tuple[float, float]:
    """Lowest and highest elevation of a sensor's rays, in its middle column.

    Example:
        >>> from torchcover.simulation import Lidar
        >>> lidar = Lidar(name="a", model="velodyne_vlp16", max_range_m=50)
        >>> [round(elevation, 9) for elevation in vertical_fov_deg(lidar)]
        [-15.0, 15.0]
    """
    x, y, z = sensor.directions()
    elevation_deg = np.rad2deg(np.arctan2(z, np.hypot(x, y)))[:, x.shape[1] // 2]
    return float(np.nanmin(elevation_deg)), float(np.nanmax(elevation_deg))
