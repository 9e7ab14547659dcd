"""What a reference sensor is, what it finds at one step (vehicle, scene, random numbers), and that of the paper.

Another pattern is a class with the members of `ReferenceSensor` and a line in `kinds.py`.
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
from torchcover.simulation.instant import SceneSnapshot
from torchcover.simulation.rays import Tile, compute_unit_directions, split_into_tiles
from torchcover.simulation.regions_of_interest import QueryPlan
from torchcover.simulation.scene import SceneGeometry

# From the ego's bounding box and the random numbers to a (4, 4) pose in the vehicle frame.
PoseSampler = Callable[[BoundingBox, np.random.Generator], Float64]

# A place inside a body is drawn again, at most this often.
MAX_DRAWS = 100


@dataclass(frozen=True, eq=False)
class ReferenceContext:
    """One step, as the simulator offers it to a reference sensor.

    Args:
        scene_geometry: The geometry of the world.
        snapshot: It at the time of the step.
        rng: Source of all random numbers of the sensor.
        frame_name: What messages call the step.
        num_threads: On how many threads rays may be cast; no result depends on it.
    """

    scene_geometry: SceneGeometry
    snapshot: SceneSnapshot
    rng: np.random.Generator
    frame_name: str
    num_threads: int = 1

    def sample_free_pose(self, sample_pose: PoseSampler) -> tuple[Float64, int]:
        """Draw a pose until it lies inside no body.

        Args:
            sample_pose: From the ego's bounding box and the random numbers to a (4, 4) pose in the vehicle frame.

        Returns:
            The pose, and how many were thrown away.

        Raises:
            ValueError: 100 poses in a row lie inside bodies or below the ground.
        """
        for redrawn in range(MAX_DRAWS):
            vehicle_T_reference = sample_pose(self.scene_geometry.ego_box, self.rng)
            if not self.snapshot.is_occupied(vehicle_T_reference[:3, 3]):
                return vehicle_T_reference, redrawn
        raise ValueError(
            f"{self.frame_name}: {MAX_DRAWS} places beside and above the ego lie inside other bodies or below the ground; "
            "does the ego stand on the ground, and do faces point outwards?"
        )


class ReferenceScan(NamedTuple):
    """What a reference sensor saw at one step.

    Args:
        points: (M, 3) float32 in the vehicle frame, without those on the ego.
        weights: (M,) float32, positive and finite: the visible square metres that each point stands for; None if all
            count the same.
        num_rays: How many rays were cast.
        self_hits: How many of them the ego took.
        num_body_casts: At how many pairs of a ray and a moving body; the other pairs could not meet.
        num_resampled_poses: How often its place was drawn again, because it lay inside a body or below the ground.
        sampled_point_counts: (objects,) int64 how many points were drawn on each of `World.objects`, be they seen or not; None from a
            sensor that draws none.
        heights_m: (M,) heights of the points above the local ground, from a sensor that has asked for them.
        num_poses: From how many places it has looked.
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
    """A sensor that no rig is measured to be better than: at every step it looks from other places at the ego.

    A value: equal ones see the same, with random numbers of the generator that they are given and no others. It can be
    pickled, for it travels to the workers of a DataLoader.
    """

    name: ClassVar[str]
    """What it is registered as, and what `--reference` and `summary.json` call it."""
    has_area_weights: ClassVar[bool]
    """Whether its points have weights, the square metres that they stand for. The same in every scan."""

    @property
    def band_frame(self) -> BandFrame:
        """What its height bands are over: "ground" if all of its scans have heights, "vehicle" if none has."""

    @classmethod
    def from_query_plan(cls, query_plan: QueryPlan, num_rays: int | None) -> Self:
        """The sensor for a question.

        Args:
            query_plan: Its areas, heights and what these are measured from.
            num_rays: About how many rays it casts at a step; None for the number that it does best with.

        Raises:
            ValueError: Areas or a number of rays that it cannot do with.
        """

    @property
    def num_rays(self) -> int:
        """About how many rays it casts at a step: asked before it is made to scan."""

    @property
    def shell_m(self) -> float:
        """How far its places lie from the ego's bounding box in metres, at most."""

    @property
    def max_range_m(self) -> float:
        """What is farther from its place, in metres, gives no point."""

    def scan(self, context: ReferenceContext) -> ReferenceScan:
        """What it sees at one step.

        Args:
            context: The vehicle, the scene around it, and the random numbers.

        Returns:
            The points and what they count for; no point at all is an answer too.

        Raises:
            ValueError: There is no place for it that is not inside a body.
        """


def check_ranges(shell_m: float, max_range_m: float) -> None:
    """Refuse a shell or a range that is not positive."""
    if not shell_m > 0:
        raise ValueError(f"shell_m: a positive thickness in metres is needed; got {shell_m}")
    if not max_range_m > 0:
        raise ValueError(f"max_range_m: a positive distance in metres is needed; got {max_range_m}")


def sample_position_in_shell(ego_box: BoundingBox, shell_m: float, rng: np.random.Generator) -> Float64:
    """(3,) place in metres, uniform between the ego's bounding box and that box grown sideways and upwards.

    Args:
        ego_box: Bounding box of the ego in the vehicle frame.
        shell_m: How far it is grown.
        rng: Source of the random numbers.
    """
    lower, upper = np.array(ego_box.lower_m), np.array(ego_box.upper_m)
    outer_lower, outer_upper = lower - [shell_m, shell_m, 0.0], upper + shell_m
    while True:
        position = rng.uniform(outer_lower, outer_upper)
        if ((position < lower) | (position > upper)).any():
            return position


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
        keep_ego_points: Whether hits on the ego give points; the paper does not say.

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
    has_area_weights: ClassVar[bool] = False

    rows: int = 1024
    columns: int = 1024
    shell_m: float = 0.5
    max_tilt_deg: float = MAX_TILT_DEG
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
        """The paper's 1024 x 1024 rays, or a square of about as many; it looks everywhere, whatever is asked about."""
        if num_rays is None:
            return cls()
        if num_rays < 1:
            raise ValueError(f"num_rays: at least 1 is needed; got {num_rays}")
        side = round(math.sqrt(num_rays))
        return cls(rows=side, columns=side)

    @property
    def num_rays(self) -> int:
        """Rows times columns."""
        return self.rows * self.columns

    def scan(self, context: ReferenceContext) -> ReferenceScan:
        """What its rays hit at one step; see `ReferenceSensor.scan`."""
        pose, redrawn = context.sample_free_pose(self.sample_pose)
        scan = context.snapshot.scan(
            pose,
            _tiles_of(self),
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
            num_resampled_poses=redrawn,
        )

    def compute_directions(self) -> Float64:
        """(3, rows, columns) unit directions in the sensor's frame."""
        elevation = np.linspace(0.0, -90.0, self.rows)
        azimuth = 360.0 * np.arange(self.columns) / self.columns
        return compute_unit_directions(elevation[:, None], azimuth[None, :])

    def sample_pose(self, ego_box: BoundingBox, rng: np.random.Generator) -> Float64:
        """Draw the pose of one step.

        Args:
            ego_box: Bounding box of the ego in the vehicle frame.
            rng: Source of the random numbers.

        Returns:
            (4, 4) transform.
        """
        yaw = rng.uniform(-180.0, 180.0)
        pitch, roll = rng.uniform(-self.max_tilt_deg, self.max_tilt_deg, size=2)
        return build_transform(
            convert_euler_to_rotation(yaw, pitch, roll), sample_position_in_shell(ego_box, self.shell_m, rng)
        )


# Kept for the process, not with the sensor, which travels to DataLoader workers.
@lru_cache(maxsize=2)
def _tiles_of(sensor: PaperReference) -> tuple[Tile, ...]:
    return split_into_tiles(sensor.compute_directions())
