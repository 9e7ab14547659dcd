"""The sensors of a rig as pictures show them."""

from collections.abc import Sequence

from torchcover.report import SensorView
from torchcover.simulation import Sensor, vertical_fov_deg


def sensor_views(sensors: Sequence[Sensor]) -> list[SensorView]:
    """Where sensors are and what they see."""
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
