"""The random reference sensor: a best case to compare a rig with."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import BoundingBox, rigid, rotation_from_euler
from torchcover.simulation.rays import Tile, into_tiles, unit_directions

# Pitch and roll of the paper's sensor are uniform between minus this and this.
MAX_TILT_DEG = 45.0


@dataclass(frozen=True)
class PaperReference:
    """The paper's reference sensor: rays over the lower hemisphere, from a new pose at every step.

    The position is uniform in the shell between the ego's bounding box and that box grown sideways and upwards, yaw
    is uniform in +-180 degrees, pitch and roll in +-`max_tilt_deg`. Rows are evenly spaced over elevations 0 to -90
    degrees, both ends included (Uecker & Zöllner 2024, section III).

    Args:
        rows: Number of elevations.
        columns: Number of azimuths over 360 degrees.
        shell_m: Thickness of the shell.
        max_tilt_deg: Bound of pitch and roll.
        max_range_m: Farther hits give no point. The default reaches every corner of the paper's regions.

    Raises:
        ValueError: A number of rows or columns below 1, a shell without thickness, a tilt outside 0 to 90 degrees,
            a range that is not positive.

    Example:
        >>> sensor = PaperReference(rows=4, columns=8)
        >>> ego = BoundingBox((-2.4, -1.0, 0.0), (2.4, 1.0, 1.6))
        >>> sensor.vehicle_T_reference(ego, np.random.default_rng(0)).shape
        (4, 4)
    """

    rows: int = 1024
    columns: int = 1024
    shell_m: float = 0.5
    max_tilt_deg: float = MAX_TILT_DEG
    max_range_m: float = 250.0

    def __post_init__(self) -> None:
        if self.rows < 1 or self.columns < 1:
            raise ValueError(f"the reference sensor needs rows and columns; got {self.rows} x {self.columns}")
        if not self.shell_m > 0:
            raise ValueError(f"shell_m: a positive thickness in metres is needed; got {self.shell_m}")
        if not 0 <= self.max_tilt_deg <= 90:
            raise ValueError(f"max_tilt_deg: an angle from 0 to 90 is needed; got {self.max_tilt_deg}")
        if not self.max_range_m > 0:
            raise ValueError(f"max_range_m: a positive distance in metres is needed; got {self.max_range_m}")

    def directions(self) -> NDArray[np.float64]:
        """(3, rows, columns) unit directions in the sensor's frame."""
        elevation = np.linspace(0.0, -90.0, self.rows)
        azimuth = 360.0 * np.arange(self.columns) / self.columns
        return unit_directions(elevation[:, None], azimuth[None, :])

    def tiles(self, vehicle_T_reference: NDArray[np.float64], generator: np.random.Generator) -> tuple[Tile, ...]:
        """The rays of one step in the sensor's frame: the same at every step."""
        return _tiles_of(self)

    def weights(
        self, vehicle_T_reference: NDArray[np.float64], tiles: tuple[Tile, ...], ray: NDArray[np.int64]
    ) -> None:
        """None: the points of this sensor weigh the same."""

    def vehicle_T_reference(self, ego: BoundingBox, generator: np.random.Generator) -> NDArray[np.float64]:
        """Draw the pose of one step.

        Args:
            ego: Bounding box of the ego in the vehicle frame.
            generator: Source of the random numbers.

        Returns:
            (4, 4) transform.
        """
        yaw = generator.uniform(-180.0, 180.0)
        pitch, roll = generator.uniform(-self.max_tilt_deg, self.max_tilt_deg, size=2)
        return rigid(rotation_from_euler(yaw, pitch, roll), position_in_shell(ego, self.shell_m, generator))


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


# Kept for the process, not with the sensor, which travels to DataLoader workers.
@lru_cache(maxsize=2)
def _tiles_of(sensor: PaperReference) -> tuple[Tile, ...]:
    return into_tiles(sensor.directions())
