"""Reference sensors: the protocol, the context of one frame, and the reference sensor of the paper.

A new reference sensor is a class with the members of `ReferenceSensor` and an entry in `kinds.py`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, NamedTuple, Protocol, Self

import numpy as np

from torchcover.coverage.grid import BandFrame
from torchcover.geometry import BoundingBox, build_transform, convert_euler_to_rotation
from torchcover.geometry.arrays import Float32, Float64, Int64
from torchcover.simulation.rays import Tile, compute_unit_directions, split_into_tiles
from torchcover.simulation.regions_of_interest import QueryPlan
from torchcover.simulation.scene_geometry import SceneGeometry
from torchcover.simulation.scene_snapshot import SceneSnapshot

# (bounding box of the ego vehicle, random numbers) -> (4, 4) pose in the vehicle frame.
PoseSampler = Callable[[BoundingBox, np.random.Generator], Float64]


@dataclass(frozen=True, eq=False)
class ReferenceContext:
    """Input of a reference sensor for one frame.

    Args:
        scene_geometry: Geometry of the scene.
        snapshot: Scene at the time of the frame.
        rng: Source of all random numbers of the sensor.
        frame_name: Name of the frame in messages.
        num_threads: Threads that may cast rays; the result does not depend on it.
    """

    scene_geometry: SceneGeometry
    snapshot: SceneSnapshot
    rng: np.random.Generator
    frame_name: str
    num_threads: int = 1

    def sample_free_pose(self, sample_pose: PoseSampler, max_attempts: int = 100) -> tuple[Float64, int]:
        """Sample poses until one is neither inside a body nor below the ground.

        Args:
            sample_pose: Samples a (4, 4) pose in the vehicle frame.
            max_attempts: Number of poses after which the search fails.

        Returns:
            The pose, and the number of rejected poses.

        Raises:
            ValueError: All poses are inside bodies or below the ground.
        """
        for num_rejected in range(max_attempts):
            vehicle_T_reference = sample_pose(self.scene_geometry.ego_box, self.rng)
            if not self.snapshot.is_occupied(vehicle_T_reference[:3, 3]):
                return vehicle_T_reference, num_rejected
        raise ValueError(
            f"{self.frame_name}: {max_attempts} positions next to and above the ego vehicle are inside other bodies or "
            "below the ground; does the ego vehicle stand on the ground, and do faces point outwards?"
        )


class ReferenceScan(NamedTuple):
    """Reference points of one frame.

    Args:
        points: (M, 3) float32 points in the vehicle frame, without points on the ego vehicle.
        weights: (M,) float32 area weights in m², positive and finite; None if all points count the same.
        num_rays: Number of cast rays.
        self_hits: Number of rays that hit the ego vehicle.
        num_body_casts: Number of tested pairs of a ray and a moving body; other pairs cannot hit.
        num_resampled_poses: Number of poses that were rejected because they were inside a body or below the ground.
        sampled_point_counts: (objects,) int64 number of points sampled on each of `Scene.objects`, visible or not; None
            if the sensor samples none.
        heights_m: (M,) heights above the local ground; None if the sensor does not compute them.
        num_poses: Number of poses from which rays were cast.
    """

    points: Float32
    weights: Float32 | None
    num_rays: int
    self_hits: int
    num_body_casts: int
    num_resampled_poses: int
    sampled_point_counts: Int64 | None = None
    heights_m: Float32 | None = None
    num_poses: int = 1


class ReferenceSensor(Protocol):
    """Best-case sensor that rigs are compared with: it observes the scene from new random poses in each frame.

    A reference sensor is a value: equal sensors with equal random generators give equal points. It uses no other random
    numbers and can be pickled, since it is sent to DataLoader workers.
    """

    name: ClassVar[str]
    """Name in the registry, for `--reference` and in `summary.json`."""
    has_area_weights: ClassVar[bool]
    """True if all scans have area weights in m², False if none has."""

    @property
    def band_frame(self) -> BandFrame:
        """Frame of the height bands: "ground" if all scans have heights, "vehicle" if none has."""

    @classmethod
    def from_query_plan(cls, query_plan: QueryPlan, num_rays: int | None) -> Self:
        """Create the sensor for a query plan.

        Args:
            query_plan: Areas, height bands and their frame.
            num_rays: Approximate number of rays per frame; None for the default of the sensor.

        Raises:
            ValueError: The sensor cannot cover the areas, or the number of rays is too small.
        """

    @property
    def num_rays(self) -> int:
        """Approximate number of rays per frame, known before the first scan."""

    @property
    def shell_m(self) -> float:
        """Largest distance of the sensor positions from the bounding box of the ego vehicle."""

    @property
    def max_range_m(self) -> float:
        """Largest distance of a point from the sensor position."""

    def scan(self, context: ReferenceContext) -> ReferenceScan:
        """Observe the scene in one frame.

        Args:
            context: Vehicle, scene and random numbers.

        Returns:
            Points and their weights; a scan may be empty.

        Raises:
            ValueError: No position for the sensor outside of bodies was found.
        """


def check_ranges(shell_m: float, max_range_m: float) -> None:
    """Check that the shell and the range are positive.

    Args:
        shell_m: Thickness of the shell around the ego vehicle.
        max_range_m: Maximum range.

    Raises:
        ValueError: One of them is not positive.
    """
    if not shell_m > 0:
        raise ValueError(f"shell_m: a positive thickness in meters is needed; got {shell_m}")
    if not max_range_m > 0:
        raise ValueError(f"max_range_m: a positive distance in meters is needed; got {max_range_m}")


def sample_position_in_shell(ego_box: BoundingBox, shell_m: float, rng: np.random.Generator) -> Float64:
    """Sample a position uniformly between a bounding box and that box extended sideways and upwards.

    Args:
        ego_box: Bounding box of the ego vehicle in the vehicle frame.
        shell_m: Length of the extension.
        rng: Source of the random numbers.

    Returns:
        (3,) position in meters.
    """
    lower_m, upper_m = np.array(ego_box.lower_m), np.array(ego_box.upper_m)
    outer_lower_m, outer_upper_m = lower_m - [shell_m, shell_m, 0.0], upper_m + shell_m
    while True:
        position_m = rng.uniform(outer_lower_m, outer_upper_m)
        if ((position_m < lower_m) | (position_m > upper_m)).any():
            return position_m


@dataclass(frozen=True)
class PaperReference:
    """Reference sensor of the paper: rays over the lower hemisphere, from one new pose per frame.

    The position is uniform in the shell between the bounding box of the ego vehicle and that box extended sideways and
    upwards, yaw is uniform in +-180 degrees, pitch and roll in +-`max_tilt_deg`. Rows are evenly spaced over elevations
    0 to -90 degrees, both ends included (Uecker & Zöllner 2024, section III).

    Args:
        rows: Number of elevations.
        columns: Number of azimuths over 360 degrees.
        shell_m: Thickness of the shell.
        max_tilt_deg: Largest absolute pitch and roll.
        max_range_m: Farther hits give no point. The default reaches every corner of the regions of the paper.
        keep_ego_points: True if hits on the ego vehicle give points; the paper does not specify it.

    Raises:
        ValueError: A number of rows or columns below 1, a shell without thickness, a tilt outside 0 to 90 degrees,
            a range that is not positive.

    Example:
        >>> sensor = PaperReference(rows=4, columns=8)
        >>> ego_box = BoundingBox((-2.4, -1.0, 0.0), (2.4, 1.0, 1.6))
        >>> sensor.sample_pose(ego_box, np.random.default_rng(0)).shape
        (4, 4)
    """

    name: ClassVar[str] = "paper"
    band_frame: ClassVar[BandFrame] = "vehicle"
    has_area_weights: ClassVar[bool] = False

    rows: int = 1024
    columns: int = 1024
    shell_m: float = 0.5
    max_tilt_deg: float = 45.0
    max_range_m: float = 250.0
    keep_ego_points: bool = False

    def __post_init__(self) -> None:
        if self.rows < 1 or self.columns < 1:
            raise ValueError(f"the reference sensor needs rows and columns; got {self.rows} x {self.columns}")
        if not 0 <= self.max_tilt_deg <= 90:
            raise ValueError(f"max_tilt_deg: an angle from 0 to 90 is needed; got {self.max_tilt_deg}")
        check_ranges(self.shell_m, self.max_range_m)

    @classmethod
    def from_query_plan(cls, query_plan: QueryPlan, num_rays: int | None) -> Self:
        """Create the sensor; it observes all directions, so the query plan is ignored.

        Args:
            query_plan: Ignored.
            num_rays: Approximate number of rays, rounded to a square; None for the 1024 x 1024 rays of the paper.

        Raises:
            ValueError: A number of rays below 1.
        """
        if num_rays is None:
            return cls()
        if num_rays < 1:
            raise ValueError(f"num_rays: at least 1 is needed; got {num_rays}")
        side = round(math.sqrt(num_rays))
        return cls(rows=side, columns=side)

    @property
    def num_rays(self) -> int:
        """Number of rays: rows times columns."""
        return self.rows * self.columns

    def scan(self, context: ReferenceContext) -> ReferenceScan:
        """Cast the rays in one frame.

        Args:
            context: Vehicle, scene and random numbers.

        Returns:
            Hits of the rays, without weights.

        Raises:
            ValueError: No position for the sensor outside of bodies was found.
        """
        pose, num_rejected = context.sample_free_pose(self.sample_pose)
        scan = context.snapshot.scan(
            pose,
            _get_tiles(self),
            max_range_m=self.max_range_m,
            keep_ego_points=self.keep_ego_points,
            num_threads=context.num_threads,
        )
        return ReferenceScan(
            points=scan.points,
            weights=None,
            num_rays=scan.num_rays,
            self_hits=scan.self_hits,
            num_body_casts=scan.num_body_casts,
            num_resampled_poses=num_rejected,
        )

    def compute_directions(self) -> Float64:
        """Compute (3, rows, columns) unit directions in the sensor frame."""
        elevations_deg = np.linspace(0.0, -90.0, self.rows)
        azimuths_deg = 360.0 * np.arange(self.columns) / self.columns
        return compute_unit_directions(elevations_deg[:, None], azimuths_deg[None, :])

    def sample_pose(self, ego_box: BoundingBox, rng: np.random.Generator) -> Float64:
        """Sample the pose of one frame.

        Args:
            ego_box: Bounding box of the ego vehicle in the vehicle frame.
            rng: Source of the random numbers.

        Returns:
            (4, 4) pose in the vehicle frame.
        """
        yaw_deg = rng.uniform(-180.0, 180.0)
        pitch_deg, roll_deg = rng.uniform(-self.max_tilt_deg, self.max_tilt_deg, size=2)
        rotation = convert_euler_to_rotation(yaw_deg, pitch_deg, roll_deg)
        return build_transform(rotation, sample_position_in_shell(ego_box, self.shell_m, rng))


# Cached per process, not in the sensor, which is pickled for DataLoader workers.
@lru_cache(maxsize=2)
def _get_tiles(sensor: PaperReference) -> tuple[Tile, ...]:
    return split_into_tiles(sensor.compute_directions())
