"""A sensor as pictures show it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import euler_from_rotation


@dataclass(frozen=True, eq=False)
class SensorView:
    """A sensor over a map, or on a drawing of its rig.

    Args:
        name: What the legend calls it.
        vehicle_T_sensor: (4, 4) pose; its frame is x forward, y left, z up.
        horizontal_fov_deg: Horizontal field of view about its x axis, in (0, 360].
        vertical_fov_deg: Its lowest and its highest elevation.
        range_m: Maximum range in metres, infinity if there is none.

    Raises:
        ValueError: A pose of another shape or that is not finite, a horizontal field of view outside (0, 360], a
            vertical one that is not lowest first, a range that is not positive.

    Example:
        >>> view = SensorView("front", np.eye(4), 90.0, (-10.0, 10.0), 50.0)
        >>> view.x_m, view.yaw_deg, view.sees(np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]))
        (0.0, 0.0, array([ True, False]))
    """

    name: str
    vehicle_T_sensor: NDArray[np.float64]
    horizontal_fov_deg: float
    vertical_fov_deg: tuple[float, float]
    range_m: float

    def __post_init__(self) -> None:
        pose, (low, high) = self.vehicle_T_sensor, self.vertical_fov_deg
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise ValueError(f"sensor {self.name!r}: vehicle_T_sensor must be (4, 4) and finite; got {pose}")
        if not 0 < self.horizontal_fov_deg <= 360:
            raise ValueError(f"sensor {self.name!r}: horizontal_fov_deg in (0, 360]; got {self.horizontal_fov_deg}")
        if not -90 <= low <= high <= 90:
            raise ValueError(f"sensor {self.name!r}: vertical_fov_deg in [-90, 90], lowest first; got {(low, high)}")
        if not self.range_m > 0:
            raise ValueError(f"sensor {self.name!r}: range_m must be positive; got {self.range_m}")

    @property
    def position_m(self) -> NDArray[np.float64]:
        """(3,) its place in the vehicle frame."""
        return self.vehicle_T_sensor[:3, 3]

    @property
    def x_m(self) -> float:
        """Its place forward."""
        return float(self.vehicle_T_sensor[0, 3])

    @property
    def y_m(self) -> float:
        """Its place to the left."""
        return float(self.vehicle_T_sensor[1, 3])

    @property
    def yaw_deg(self) -> float:
        """Its direction: 0 is forward, positive turns left."""
        return float(euler_from_rotation(self.vehicle_T_sensor[:3, :3])[0])

    def sees(self, directions: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which of (N, 3) directions in the vehicle frame lie in the field of view."""
        x, y, z = (directions @ self.vehicle_T_sensor[:3, :3]).T
        azimuth_deg = np.rad2deg(np.arctan2(y, x))
        elevation_deg = np.rad2deg(np.arctan2(z, np.hypot(x, y)))
        low, high = self.vertical_fov_deg
        inside: NDArray[np.bool_] = np.logical_and(low <= elevation_deg, elevation_deg <= high)
        inside &= abs(azimuth_deg) <= self.horizontal_fov_deg / 2
        return inside
