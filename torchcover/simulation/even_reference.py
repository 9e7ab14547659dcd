"""A reference sensor that spreads its rays over the places that are asked about."""

import math
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from torchcover.frames.frame import WeightKind
from torchcover.geometry import BoundingBox, rigid
from torchcover.simulation.paper_reference import paper_density_at
from torchcover.simulation.ray_pattern import cast_pattern
from torchcover.simulation.rays import Tile, into_tiles
from torchcover.simulation.reference_sensor import (
    PAPER_BANDS_M,
    Area,
    Areas,
    Bands,
    ReferenceScan,
    check_areas,
    check_reach,
)
from torchcover.simulation.shell import position_in_shell
from torchcover.simulation.surroundings import Surroundings

# Height above the ground up to which half of the rays look for bodies that stand on it.
TOP_M = 2.0
# Enough for the known cells of the paper's regions in runs of up to a minute.
DEFAULT_RAYS = 262_144

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class EvenReference:
    """Rays from the paper's places, aimed at points that lie evenly in given areas.

    Half of the rays aim at points on the ground, half at points between it and 2 m above; of both, every area gets the
    same number. The ground is level and under the vehicle's origin: rays do not pitch and roll with the vehicle, which
    lifts z = 0 of its frame by 2.8 m for a degree at 160 m. Targets are stratified: each area is cut into as many
    nearly square patches as it has rays, and each ray aims at a random point of its patch, another one at every step.
    What stands in the way of a target is hit instead, as ever.

    The paper's sensor asks the same question with another density of rays: nearly all of its million look at the
    ground near the vehicle. `weights` holds the ratio of the two densities, that of the paper's rays as a mean over its
    random pitch and roll. In a single step its rays lie otherwise, and a mean of ratios is not the ratio of the means:
    near the vehicle the means over a cell differ (0.761 against 0.721 m in a cell of 2 m).

    Args:
        areas: Rectangles x, y in the vehicle frame in metres, ((x_low, x_high), (y_low, y_high)) each. They may
            overlap: small ones inside of large ones get more rays.
        rays: About how many rays there are in all; patches are whole.
        shell_m: Thickness of the shell around the ego in which the sensor is.
        max_range_m: Farther hits give no point.

    Raises:
        ValueError: No area, an area with inverted or infinite bounds, fewer than 2 rays an area, a shell or a range
            that is not positive.

    Example:
        >>> sensor = EvenReference(areas=(((0.0, 20.0), (-5.0, 5.0)),), rays=1024)
        >>> pose = sensor.vehicle_T_reference(BoundingBox((-2.4, -1.0, 0.0), (2.4, 1.0, 1.6)), np.random.default_rng(0))
        >>> tiles = sensor.tiles(pose, np.random.default_rng(0))
        >>> sum(tile.directions.shape[1] for tile in tiles)
        1024
    """

    name: ClassVar[str] = "even"
    weight_kind: ClassVar[WeightKind | None] = "density"

    areas: Areas
    rays: int
    shell_m: float = 0.5
    max_range_m: float = 250.0

    def __post_init__(self) -> None:
        check_areas(self.areas)
        if self.rays < 2 * len(self.areas):
            raise ValueError(f"rays: at least 2 for each of {len(self.areas)} areas are needed; got {self.rays}")
        check_reach(self.shell_m, self.max_range_m)

    @classmethod
    def from_rays(cls, areas: Areas, rays: int | None, bands_m: Bands = PAPER_BANDS_M) -> Self:
        """One that asks about some areas.

        Args:
            areas: As above.
            rays: About how many rays; 262,144 if not given.
            bands_m: Not used.

        Raises:
            ValueError: As for the class.
        """
        return cls(areas, DEFAULT_RAYS if rays is None else rays)

    def scan(self, surroundings: Surroundings) -> ReferenceScan:
        """What its rays hit at one step; see `ReferenceSensor.scan`."""
        return cast_pattern(_Level(self, surroundings.instant.vehicle_R_level), surroundings)

    def vehicle_T_reference(self, ego: BoundingBox, generator: np.random.Generator) -> Float64:
        """Draw the pose of one step: its place is the paper's; its axes are those of a vehicle that is level.

        Args:
            ego: Bounding box of the ego in the vehicle frame.
            generator: Source of the random numbers.

        Returns:
            (4, 4) transform.
        """
        return rigid(np.eye(3), position_in_shell(ego, self.shell_m, generator))

    def tiles(self, vehicle_T_reference: Float64, generator: np.random.Generator) -> tuple[Tile, ...]:
        """Aim the rays of one step.

        Args:
            vehicle_T_reference: (4, 4) pose; its axes are level.
            generator: Source of the random numbers.

        Returns:
            The rays in the sensor's frame.
        """
        place_m = _level_place_m(vehicle_T_reference)
        tiles: list[Tile] = []
        for area in self.areas:
            for top_m in (0.0, TOP_M):
                targets_m = _stratified(area, top_m, self._rays_each, generator)
                way_m = targets_m - place_m[:, None, None]
                tiles += into_tiles(way_m / np.linalg.norm(way_m, axis=0))
        return tuple(tiles)

    @property
    def _rays_each(self) -> int:
        """Rays for the ground, and as many for the space above it, of one area."""
        return self.rays // (2 * len(self.areas))

    def weights(
        self, vehicle_T_reference: Float64, tiles: tuple[Tile, ...], ray: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """Density of the paper's sensor over the density of this one, both per solid angle.

        Args:
            vehicle_T_reference: (4, 4) pose, as for `tiles`.
            tiles: The rays of the step, from `tiles`.
            ray: (N,) numbers of the rays, counted over the tiles.

        Returns:
            (N,) positive weights.
        """
        towards = np.concatenate([tile.directions for tile in tiles], axis=1)[:, ray].astype(np.float64)
        place_m = _level_place_m(vehicle_T_reference)
        counts = [math.prod(_patches(area, self._rays_each)) for area in self.areas]
        density = np.average([_density(area, place_m, towards) for area in self.areas], axis=0, weights=counts)
        paper = paper_density_at(np.arcsin(np.clip(vehicle_T_reference[2, :3] @ towards, -1.0, 1.0)))
        # The paper's sensor never looks up steeply, and a ray aimed at the very border of an area may have been rounded
        # out of it: neither may make a weight of 0 or infinity.
        weights: NDArray[np.float32] = (np.maximum(paper, 1e-6) / np.maximum(density, 1e-6)).astype(np.float32)
        return weights


@dataclass(frozen=True)
class _Level:
    """The sensor where the vehicle has pitched and rolled away from level axes: a `RayPattern`."""

    sensor: EvenReference
    vehicle_R_level: Float64

    @property
    def max_range_m(self) -> float:
        return self.sensor.max_range_m

    def vehicle_T_reference(self, ego: BoundingBox, generator: np.random.Generator) -> Float64:
        return rigid(self.vehicle_R_level, self.sensor.vehicle_T_reference(ego, generator)[:3, 3])

    def tiles(self, vehicle_T_reference: Float64, generator: np.random.Generator) -> tuple[Tile, ...]:
        return self.sensor.tiles(vehicle_T_reference, generator)

    def weights(
        self, vehicle_T_reference: Float64, tiles: tuple[Tile, ...], ray: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        return self.sensor.weights(vehicle_T_reference, tiles, ray)


def _level_place_m(vehicle_T_reference: Float64) -> Float64:
    """(3,) place on the sensor's own, level axes, from the vehicle's origin: z is the height above the ground."""
    place_m: Float64 = vehicle_T_reference[:3, :3].T @ vehicle_T_reference[:3, 3]
    return place_m


def _stratified(area: Area, top_m: float, count: int, generator: np.random.Generator) -> Float64:
    """(3, rows, columns) points, one at random in each of about `count` patches; z between 0 and `top_m`."""
    (x_low, x_high), (y_low, y_high) = area
    length_m, width_m = x_high - x_low, y_high - y_low
    rows, columns = _patches(area, count)
    jitter = generator.random((3, rows, columns))
    x = x_low + length_m * (np.arange(columns)[None] + jitter[0]) / columns
    y = y_low + width_m * (np.arange(rows)[:, None] + jitter[1]) / rows
    return np.stack([x, y, top_m * jitter[2]])


def _patches(area: Area, count: int) -> tuple[int, int]:
    """Rows and columns of nearly square patches, together at most `count`."""
    (x_low, x_high), (y_low, y_high) = area
    columns = min(count, max(1, round(math.sqrt(count * (x_high - x_low) / (y_high - y_low)))))
    return count // columns, columns


def _density(area: Area, place_m: Float64, directions: Float64) -> Float64:
    """Rays of one area per solid angle, of each of some directions: half aimed at the ground, half above it."""
    (x_low, x_high), (y_low, y_high) = area
    size_m2 = (x_high - x_low) * (y_high - y_low)
    with np.errstate(divide="ignore", invalid="ignore"):
        ground_m = -place_m[2] / directions[2]
        x, y = (place_m[axis] + ground_m * directions[axis] for axis in range(2))
        meets = (ground_m > 0) & (x >= x_low) & (x <= x_high) & (y >= y_low) & (y <= y_high)
        on_ground = np.where(meets, ground_m**2 / (np.abs(directions[2]) * size_m2), 0.0)
    near_m, far_m = _stretch_within(
        np.array([x_low, y_low, 0.0]), np.array([x_high, y_high, TOP_M]), place_m, directions
    )
    above = (far_m**3 - near_m**3) / (3 * size_m2 * TOP_M)
    return (on_ground + above) / 2


def _stretch_within(
    lower_m: Float64, upper_m: Float64, place_m: Float64, directions: Float64
) -> tuple[Float64, Float64]:
    """Where rays enter and leave a box, as distances from their origin; the same number twice if they miss it."""
    near_m = np.zeros(directions.shape[1])
    far_m = np.full(directions.shape[1], np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis in range(3):
            ends = [(bound_m[axis] - place_m[axis]) / directions[axis] for bound_m in (lower_m, upper_m)]
            near_m, far_m = np.fmax(near_m, np.fmin(*ends)), np.fmin(far_m, np.fmax(*ends))
    return near_m, np.maximum(near_m, far_m)
