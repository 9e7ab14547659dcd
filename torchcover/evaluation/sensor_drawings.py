"""The sensors of a rig as pictures show them."""

from collections.abc import Sequence

import numpy as np

from torchcover.geometry import euler_from_rotation
from torchcover.report import SensorMark, SensorView
from torchcover.simulation import Sensor


def sensor_views(sensors: Sequence[Sensor]) -> list[SensorView]:
    """Where sensors are and what they see, for drawings of the rig."""
    return [
        SensorView(
            name=sensor.name,
            vehicle_T_sensor=sensor.mount.matrix(),
            horizontal_fov_deg=sensor.horizontal_fov_deg,
            vertical_fov_deg=vertical_fov_deg(sensor),
            range_m=sensor.max_range_m,
        )
        for sensor in sensors
    ]


def sensor_marks(sensors: Sequence[Sensor]) -> list[SensorMark]:
    """The same for maps."""
    return [
        SensorMark(
            name=sensor.name,
            x_m=sensor.mount.x_m,
            y_m=sensor.mount.y_m,
            yaw_deg=float(euler_from_rotation(sensor.mount.matrix()[:3, :3])[0]),
            horizontal_fov_deg=sensor.horizontal_fov_deg,
            range_m=sensor.max_range_m,
        )
        for sensor in sensors
    ]


def vertical_fov_deg(sensor: Sensor) -> tuple[float, float]:
    """The lowest and the highest elevation of the rays in its middle column."""
    x, y, z = sensor.directions()
    elevation_deg = np.rad2deg(np.arctan2(z, np.hypot(x, y)))[:, x.shape[1] // 2]
    return float(np.nanmin(elevation_deg)), float(np.nanmax(elevation_deg))
