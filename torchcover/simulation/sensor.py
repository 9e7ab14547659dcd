"""What a sensor of a rig is: the rays that it casts, and what it makes of their hits.

Another kind is a class with the members of `Sensor` and a line in `kinds.py`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from threading import Lock
from typing import Annotated, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from torchcover.geometry.arrays import Float64, Int64
from torchcover.simulation.bodies import Body
from torchcover.simulation.documents import Document, Pose
from torchcover.simulation.raycaster import HitAttributes
from torchcover.simulation.returns import CLEAR, Weather

Elevation = Annotated[float, Field(ge=-90.0, le=90.0)]


@dataclass(frozen=True, eq=False)
class RayHits:
    """N rays of a sensor that ended on something which is not the vehicle that carries it.

    Args:
        ray_indices: (N,) which ray, counted over the sensor's tiles. The rays of one beam ascend.
        range_m: (N,) how far it went, up to the sensor's range.
        ray_pixel_indices: (rays,) where each ray stands in `Sensor.directions`, row by row.
        position_indices: (N,) in which of several worlds, of which a sensor sees each alone; None if there is one.
        find_attributes: Finds out what they ended on.
        weather: What they went through.
    """

    ray_indices: Int64
    range_m: NDArray[np.floating]
    ray_pixel_indices: Int64
    position_indices: Int64 | None = None
    find_attributes: Callable[[], HitAttributes] | None = None
    weather: Weather = CLEAR

    @property
    def pixel_indices(self) -> Int64:
        """(N,) row * columns + column of each ray in `Sensor.directions`."""
        return np.asarray(self.ray_pixel_indices[self.ray_indices])

    @cached_property
    def attributes(self) -> HitAttributes:
        """What they ended on: bodies, faces, angles of incidence, materials. A sensor that does not ask does not pay.

        Raises:
            ValueError: Hits of which that is unknown.
        """
        if self.find_attributes is None:
            raise ValueError("the hits know where they are, and not on what; give RayHits its `find`")
        return self.find_attributes()


class Returns(NamedTuple):
    """The points that a sensor makes of hits: `hit_indices` (K,) of which, ascending; `range_error_m` (K,) along their rays.

    None for `hit_indices`: of each, in order. None for `range_error_m`: they are exact.
    """

    hit_indices: Int64 | None
    range_error_m: Float64 | None


class SensorNoise:
    """The random numbers of one sensor at one step.

    A sensor asks for the same kinds in the same order, whatever its rays hit.

    Args:
        generator: Their source; None for a measurement without errors, in which nothing drops out.
        rays: How many rays the sensor has, if each is to have its own numbers, however many hits there are: what is
            placed in front of some rays then changes nothing about the others. Else there is a number for each hit.

    Example:
        >>> draws = Draws(np.random.default_rng(0), rays=100)
        >>> bool((draws.normal(np.array([7, 8])) == draws.normal(np.arange(100))[7:9]).all())
        True
        >>> Draws(None).uniform(np.arange(2)).tolist()
        [1.0, 1.0]
    """

    def __init__(self, rng: np.random.Generator | None, num_rays: int | None = None) -> None:
        self._generator, self._rays = rng, num_rays
        self._of_rays: dict[str, Float64] = {}
        self._lock = Lock()

    def sample_normal(self, ray_indices: Int64) -> Float64:
        """(N,) of a normal distribution with standard deviation 1, for hits of these rays."""
        return (
            np.zeros(len(ray_indices))
            if self._generator is None
            else self._drawn("error", "standard_normal", ray_indices)
        )

    def sample_dropout_uniform(self, ray_indices: Int64) -> Float64:
        """(N,) evenly from [0, 1), for hits of these rays; 1 where there is no source."""
        return np.ones(len(ray_indices)) if self._generator is None else self._drawn("dropout", "random", ray_indices)

    def sample_return_uniform(self, ray_indices: Int64) -> Float64:
        """(N,) evenly from [0, 1), others than `uniform`, for hits of these rays; 1/2 where there is no source."""
        return (
            np.full(len(ray_indices), 0.5) if self._generator is None else self._drawn("return", "random", ray_indices)
        )

    def _drawn(self, purpose: str, kind: str, ray: Int64) -> Float64:
        draw = getattr(self._generator, kind)
        if self._rays is None:
            return np.asarray(draw(len(ray)))
        with self._lock:  # whichever thread asks first draws for all
            if purpose not in self._of_rays:
                self._of_rays[purpose] = draw(self._rays)
            return self._of_rays[purpose][ray]


class Sensor(Protocol):
    """A device on the vehicle that measures how far it is to where its rays end.

    A value, made from its keys in a rig's file, `type` among them: a `Document`, which can be compared and pickled.
    """

    @property
    def name(self) -> str:
        """What maps and messages call it; another one for each sensor of a rig."""

    @property
    def mount(self) -> Pose:
        """`vehicle_T_sensor`; the sensor's frame is x forward, y left, z up."""

    @property
    def horizontal_fov_deg(self) -> float:
        """Angle that its rays span, seen from above; 360 for a full turn."""

    @property
    def min_range_m(self) -> float:
        """Closer hits give no point."""

    @property
    def max_range_m(self) -> float:
        """Farther hits give no point; so far its rays are cast."""

    @property
    def rate_hz(self) -> float:
        """How often it looks in a second."""

    @property
    def housing(self) -> Sequence[Body]:
        """What it is built into, in its own frame: the other sensors of its rig see that, and it looks out of it."""

    @property
    def is_exact(self) -> bool:
        """Whether it measures the same thing alike at any time: its measuring draws no random numbers."""

    @property
    def num_rays(self) -> int:
        """How many rays `directions` has, NaN ones included: asked before it is called."""

    def compute_directions(self) -> Float64:
        """(3, rows, columns) unit directions in the sensor's frame; NaN where there is no ray."""

    @property
    def pixels_per_sample(self) -> int:
        """How many points each of its points is counted as on a body: of a camera, pixels of the full image."""

    def compute_ray_times_s(self) -> Float64 | None:
        """(rows, columns) when each ray is cast, after the time of the frame; None if all are at that time."""

    def compute_beam_indices(self) -> Int64 | None:
        """(rows, columns) the number of the beam that each ray is part of; None if each is a beam of its own.

        What the rays of one beam hit is measured together; what those of others hit changes nothing about it.
        """

    def measure(self, hits: RayHits, noise: SensorNoise) -> Returns:
        """What it makes of the hits of its rays.

        Args:
            hits: All hits of each beam that has one.
            noise: Source of all random numbers.
        """


class ScanTimes(Document):
    """How long a sensor takes for its rays: a LiDAR for its columns, in their order, a camera for its rows, from above.

    Args:
        period_s: From the first to the last.
        start_s: When the first is cast, after the time of the frame; `-period_s` if not given, so that it ends then.
        deskewed: Whether points land where they are at the time of the frame. Else each lands as its ray was cast, in
            the vehicle frame of that time, as in the raw cloud of a driver; no number depends on it.
    """

    period_s: PositiveFloat
    start_s: float | None = None
    deskewed: bool = True

    def compute_times_s(self, num_times: int) -> Float64:
        """(count,) when each is cast, after the time of the frame."""
        start_s = -self.period_s if self.start_s is None else self.start_s
        return np.asarray(start_s + self.period_s * (np.arange(num_times) + 0.5) / num_times)


class RangeSensor(Document):
    """A sensor within whose ranges every hit gives a point, with noise and drop-out: the keys that such kinds share.

    Args:
        min_range_m: Closer hits give no point.
        max_range_m: Farther hits give no point.
        range_noise_m: Standard deviation of the measured range, along the ray.
        dropout: Probability that a point is missing, from 0 to 1.
        rate_hz: How often it looks in a second, for encounters.
        housing: Bodies that it is built into or stands on, in its own frame, which are in the way of the rig's others.
    """

    min_range_m: NonNegativeFloat = 0.0
    max_range_m: PositiveFloat
    range_noise_m: NonNegativeFloat = 0.0
    dropout: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    rate_hz: Annotated[float, Field(gt=0.0, le=1000.0)] = 10.0
    housing: tuple[Body, ...] = ()

    @model_validator(mode="after")
    def _check_ranges(self) -> Self:
        if self.min_range_m >= self.max_range_m:
            raise ValueError(f"min_range_m ({self.min_range_m}) must be below max_range_m ({self.max_range_m})")
        if self.range_noise_m >= self.max_range_m:
            raise ValueError(f"range_noise_m ({self.range_noise_m}) must be below max_range_m ({self.max_range_m})")
        return self

    def compute_noise_std_m(self, range_m: NDArray[np.floating]) -> float | NDArray[np.floating]:
        """Standard deviation of measured ranges, of each of (N,) or of all; 0 if they are exact."""
        return self.range_noise_m

    @property
    def is_exact(self) -> bool:
        """Whether it has neither noise nor drop-out."""
        return not self._errs

    @property
    def _errs(self) -> bool:
        return bool(self.dropout or np.any(self.compute_noise_std_m(np.ones(1))))

    @property
    def pixels_per_sample(self) -> int:
        """1: a point is a measurement."""
        return 1

    def compute_ray_times_s(self) -> Float64 | None:
        """None: all rays are cast at the time of the frame."""
        return None

    def compute_beam_indices(self) -> Int64 | None:
        """None: every ray measures alone."""
        return None

    def measure(self, hits: RayHits, noise: SensorNoise) -> Returns:
        """A point for each hit that is not too close, with noise along its ray, unless it drops out."""
        if not self.min_range_m:
            return self.sample_returns(hits, None, noise)
        far_enough = hits.range_m >= self.min_range_m
        return self.sample_returns(hits, None if far_enough.all() else np.flatnonzero(far_enough), noise)

    def sample_returns(self, hits: RayHits, hit_indices: Int64 | None, noise: SensorNoise) -> Returns:
        """Points at some of N hits, (K,) `hit_indices` of them or all, with noise and drop-out."""
        if not self._errs:
            return Returns(hit_indices, None)
        ray, range_m = (
            (hits.ray_indices, hits.range_m)
            if hit_indices is None
            else (hits.ray_indices[hit_indices], hits.range_m[hit_indices])
        )
        noise_m = self.compute_noise_std_m(range_m)
        # No range is less than 0.
        error_m = np.maximum(noise_m * noise.sample_normal(ray), -range_m) if np.any(noise_m) else None
        if self.dropout:
            stays = np.flatnonzero(noise.sample_dropout_uniform(ray) >= self.dropout)
            hit_indices, error_m = (
                stays if hit_indices is None else hit_indices[stays],
                None if error_m is None else error_m[stays],
            )
        return Returns(hit_indices, error_m)


def compute_vertical_fov_deg(sensor: Sensor) -> tuple[float, float]:
    """Lowest and highest elevation of a sensor's rays, in its middle column.

    Example:
        >>> from torchcover.simulation import Lidar
        >>> lidar = Lidar(name="a", model="velodyne_vlp16", max_range_m=50)
        >>> [round(elevation, 9) for elevation in vertical_fov_deg(lidar)]
        [-15.0, 15.0]
    """
    x, y, z = sensor.compute_directions()
    elevation_deg = np.rad2deg(np.arctan2(z, np.hypot(x, y)))[:, x.shape[1] // 2]
    return float(np.nanmin(elevation_deg)), float(np.nanmax(elevation_deg))
