"""The paper's reference sensor: a best case to compare a rig with."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, Self

import numpy as np

from torchcover.coverage.grid import BandFrame
from torchcover.geometry import BoundingBox, rigid, rotation_from_euler
from torchcover.geometry.arrays import Float64
from torchcover.simulation.rays import Tile, into_tiles, unit_directions
from torchcover.simulation.reference_sensor import ReferenceScan, Surroundings, check_reach, position_in_shell
from torchcover.simulation.regions_of_interest import Asked

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
        ego_points: Whether hits on the ego give points; the paper does not say.

    Raises:
        ValueError: A number of rows or columns below 1, a shell without thickness, a tilt outside 0 to 90 degrees,
            a range that is not positive.

    Example:
        >>> sensor = PaperReference(rows=4, columns=8)
        >>> ego = BoundingBox((-2.4, -1.0, 0.0), (2.4, 1.0, 1.6))
        >>> sensor.vehicle_T_reference(ego, np.random.default_rng(0)).shape
        (4, 4)
    """

    name: ClassVar[str] = "paper"
    band_frame: ClassVar[BandFrame] = "vehicle"
    square_metres: ClassVar[bool] = False

    rows: int = 1024
    columns: int = 1024
    shell_m: float = 0.5
    max_tilt_deg: float = MAX_TILT_DEG
    max_range_m: float = 250.0
    ego_points: bool = False

    def __post_init__(self) -> None:
        if self.rows < 1 or self.columns < 1:
            raise ValueError(f"the reference sensor needs rows and columns; got {self.rows} x {self.columns}")
        if not 0 <= self.max_tilt_deg <= 90:
            raise ValueError(f"max_tilt_deg: an angle from 0 to 90 is needed; got {self.max_tilt_deg}")
        check_reach(self.shell_m, self.max_range_m)

    @classmethod
    def from_rays(cls, asked: Asked, rays: int | None) -> Self:
        """The paper's 1024 x 1024 rays, or a square of about as many; it looks everywhere, whatever is asked about."""
        if rays is None:
            return cls()
        if rays < 1:
            raise ValueError(f"rays: at least 1 is needed; got {rays}")
        side = round(math.sqrt(rays))
        return cls(rows=side, columns=side)

    @property
    def rays(self) -> int:
        """Rows times columns."""
        return self.rows * self.columns

    def scan(self, surroundings: Surroundings) -> ReferenceScan:
        """What its rays hit at one step; see `ReferenceSensor.scan`."""
        pose, redrawn = surroundings.free_pose(self.vehicle_T_reference)
        scan = surroundings.instant.scan(
            pose,
            _tiles_of(self),
            max_range_m=self.max_range_m,
            ego_points=self.ego_points,
            threads=surroundings.threads,
        )
        return ReferenceScan(
            points=scan.points,
            weights=None,
            rays=scan.rays,
            self_hits=scan.self_hits,
            body_casts=scan.body_casts,
            redrawn=redrawn,
        )

    def directions(self) -> Float64:
        """(3, rows, columns) unit directions in the sensor's frame."""
        elevation = np.linspace(0.0, -90.0, self.rows)
        azimuth = 360.0 * np.arange(self.columns) / self.columns
        return unit_directions(elevation[:, None], azimuth[None, :])

    def vehicle_T_reference(self, ego: BoundingBox, generator: np.random.Generator) -> Float64:
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


# Kept for the process, not with the sensor, which travels to DataLoader workers.
@lru_cache(maxsize=2)
def _tiles_of(sensor: PaperReference) -> tuple[Tile, ...]:
    return into_tiles(sensor.directions())
