"""What recordings know of their sensors beside what these saw."""

from collections.abc import Mapping
from typing import NamedTuple, Protocol, runtime_checkable

from torchcover.cameras.calibration import Calibration
from torchcover.geometry.rigid import Matrix


class SensorCalibrations(NamedTuple):
    """Mounts of LiDARs, and cameras.

    Args:
        source: Where it is from, for people.
        mounts: Name of a LiDAR -> (4, 4) `vehicle_T_lidar`, where its scans do not say it.
        cameras: With their places in the vehicle frame.
    """

    source: str
    mounts: Mapping[str, Matrix]
    cameras: tuple[Calibration, ...] = ()


@runtime_checkable
class CalibratedRecording(Protocol):
    """A recording that knows more of its sensors."""

    def calibrations(self) -> SensorCalibrations:
        """Read them.

        Raises:
            OSError: They are not there.
            ValueError: They are not what they are meant to be.
        """
        ...
