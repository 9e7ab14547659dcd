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


def check_drawable(sensors: Sequence[Sensor]) -> None:
    """Find out before a run, not after it, whether its maps can show the sensors.

    Raises:
        ValueError: A sensor none of whose rays in the middle row is one, so that nobody knows how wide it sees.
    """
    for sensor in sensors:
        if not 0 < sensor.horizontal_fov_deg <= 360:
            raise ValueError(
                f"sensor {sensor.name!r}: its rays span {sensor.horizontal_fov_deg:g} degrees in the middle row; above "
                "0 are needed, so check its lens and its principal point"
            )
