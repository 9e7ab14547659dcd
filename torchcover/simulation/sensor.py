"""Sensors of a rig: the rays that they cast, and the points that they measure at the hits of these rays.

A new kind of sensor is a class with the members of `Sensor` and an entry in `kinds.py`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from threading import Lock
from typing import Annotated, Literal, NamedTuple, Protocol, Self

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
    """Hits of N rays of one sensor; hits on the vehicle that carries the sensor are not among them.

    Args:
        ray_indices: (N,) index of the ray, counted over the ray tiles of the sensor; rays of one beam ascend.
        range_m: (N,) range of the hit, at most the maximum range of the sensor.
        ray_pixel_indices: (rays,) position of each ray in the row-major order of `Sensor.compute_directions`.
        position_indices: (N,) index of the scene that the ray belongs to if several scenes are measured at once; each
            scene is measured independently. None for one scene.
        find_attributes: Computes bodies, triangles, incidence angles and materials of the hits on demand.
        weather: Weather along the rays.
    """

    ray_indices: Int64
    range_m: NDArray[np.floating]
    ray_pixel_indices: Int64
    position_indices: Int64 | None = None
    find_attributes: Callable[[], HitAttributes] | None = None
    weather: Weather = CLEAR

    @property
    def pixel_indices(self) -> Int64:
        """(N,) row * columns + column of each ray in `Sensor.compute_directions`."""
        return np.asarray(self.ray_pixel_indices[self.ray_indices])

    @cached_property
    def attributes(self) -> HitAttributes:
        """Bodies, triangles, incidence angles and materials of the hits, computed at the first access.

        Raises:
            ValueError: `find_attributes` is missing.
        """
        if self.find_attributes is None:
            raise ValueError("these RayHits have no attributes (body, material, angle); pass them `find_attributes`")
        return self.find_attributes()


class Returns(NamedTuple):
    """Points that a sensor measures at N hits.

    Args:
        hit_indices: (K,) ascending indices of the hits that return; None if all N hits return.
        range_error_m: (K,) error of the measured range; None if the ranges are exact.
    """

    hit_indices: Int64 | None
    range_error_m: Float64 | None


class SensorNoise:
    """Random numbers of one sensor in one frame.

    A sensor requests the same kinds of numbers in the same order, regardless of its hits.

    Args:
        rng: Source of the numbers; None for a measurement without errors and without drop-out.
        num_rays: Number of rays of the sensor if each ray has its own numbers. An object in front of some rays then
            changes nothing about the other rays. None samples one number for each hit.

    Example:
        >>> noise = SensorNoise(np.random.default_rng(0), num_rays=100)
        >>> bool((noise.sample_normal(np.array([7, 8])) == noise.sample_normal(np.arange(100))[7:9]).all())
        True
        >>> SensorNoise(None).sample_dropout_uniform(np.arange(2)).tolist()
        [1.0, 1.0]
    """

    def __init__(self, rng: np.random.Generator | None, num_rays: int | None = None) -> None:
        self._rng, self._num_rays = rng, num_rays
        self._values_per_ray: dict[str, Float64] = {}
        self._lock = Lock()

    def sample_normal(self, ray_indices: Int64) -> Float64:
        """Sample from the standard normal distribution.

        Args:
            ray_indices: (N,) ray of each hit.

        Returns:
            (N,) values; 0 without a source of random numbers.
        """
        return self._sample("error", "standard_normal", ray_indices, exact_value=0.0)

    def sample_dropout_uniform(self, ray_indices: Int64) -> Float64:
        """Sample from the uniform distribution over [0, 1) that decides about drop-out.

        Args:
            ray_indices: (N,) ray of each hit.

        Returns:
            (N,) values; 1 without a source of random numbers.
        """
        return self._sample("dropout", "random", ray_indices, exact_value=1.0)

    def sample_return_uniform(self, ray_indices: Int64) -> Float64:
        """Sample from the uniform distribution over [0, 1) that is compared with P(return).

        Args:
            ray_indices: (N,) ray of each hit.

        Returns:
            (N,) values, independent of those for drop-out; 1/2 without a source of random numbers.
        """
        return self._sample("return", "random", ray_indices, exact_value=0.5)

    def _sample(
        self, purpose: str, method: Literal["standard_normal", "random"], ray_indices: Int64, exact_value: float
    ) -> Float64:
        if self._rng is None:
            return np.full(len(ray_indices), exact_value)
        sample = getattr(self._rng, method)
        if self._num_rays is None:
            return np.asarray(sample(len(ray_indices)))
        with self._lock:  # the first thread samples the numbers of all rays
            if purpose not in self._values_per_ray:
                self._values_per_ray[purpose] = sample(self._num_rays)
            return self._values_per_ray[purpose][ray_indices]


class Sensor(Protocol):
    """Device on a vehicle that measures the range of surfaces along its rays.

    A sensor is a value: a `Document` made from the keys of a rig file, `type` among them, that can be compared and
    pickled.
    """

    @property
    def name(self) -> str:
        """Name in maps and messages, unique within a rig."""

    @property
    def mount(self) -> Pose:
        """Extrinsics `vehicle_T_sensor`; the sensor frame is x forward, y left, z up."""

    @property
    def horizontal_fov_deg(self) -> float:
        """Azimuth range that the rays span; 360 for a full turn."""

    @property
    def min_range_m(self) -> float:
        """Smallest range of a return; closer hits give no point."""

    @property
    def max_range_m(self) -> float:
        """Largest range of a return; rays end here."""

    @property
    def rate_hz(self) -> float:
        """Number of scans or images per second."""

    @property
    def housing(self) -> Sequence[Body]:
        """Bodies around the sensor, in its frame: they occlude the other sensors of the rig, not the sensor itself."""

    @property
    def is_exact(self) -> bool:
        """True if the measurement uses no random numbers."""

    @property
    def num_rays(self) -> int:
        """Number of rays of `compute_directions`, NaN directions included."""

    def compute_directions(self) -> Float64:
        """Compute (3, rows, columns) unit directions in the sensor frame; NaN where there is no ray."""

    @property
    def pixels_per_sample(self) -> int:
        """Number of measurements that each point represents in point counts: pixels of the full image for a camera."""

    def compute_ray_times_s(self) -> Float64 | None:
        """Compute (rows, columns) times of the rays relative to the frame; None if all rays are cast at that time."""

    def compute_beam_indices(self) -> Int64 | None:
        """Compute (rows, columns) beam index of each ray; None if each ray is its own beam.

        Hits of one beam are measured together and do not influence other beams.
        """

    def measure(self, hits: RayHits, noise: SensorNoise) -> Returns:
        """Measure points at ray hits.

        Args:
            hits: Hits of the rays; for each beam either all of its hits or none.
            noise: Source of all random numbers.

        Returns:
            Hits that give a point, and their range errors.
        """


class ScanTimes(Document):
    """Times at which a sensor casts its rays: column by column for a LiDAR, row by row from the top for a camera.

    Args:
        period_s: Time between the first and the last column or row.
        start_s: Time of the first one relative to the frame; None for `-period_s`: the scan ends at the frame time.
        deskewed: True if points are given as of the frame time. False leaves each point in the vehicle frame at the
            time of its ray, as in the raw point cloud of a driver; no coverage number depends on it.
    """

    period_s: PositiveFloat
    start_s: float | None = None
    deskewed: bool = True

    def compute_times_s(self, num_times: int) -> Float64:
        """Compute the times of all columns or rows.

        Args:
            num_times: Number of columns or rows.

        Returns:
            (num_times,) times in seconds relative to the frame.
        """
        start_s = -self.period_s if self.start_s is None else self.start_s
        return np.asarray(start_s + self.period_s * (np.arange(num_times) + 0.5) / num_times)


class RangeSensor(Document):
    """Common part of all built-in sensors: each hit within the range limits gives a point, with noise and drop-out.

    Args:
        min_range_m: Closer hits give no point.
        max_range_m: Farther hits give no point.
        range_noise_m: Standard deviation of the measured range, along the ray.
        dropout: Probability that a point is missing, 0 to 1.
        rate_hz: Scans or images per second, for encounters.
        housing: Bodies that contain or carry the sensor, in its frame; they occlude the other sensors of the rig.
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
        """Compute the standard deviation of measured ranges.

        Args:
            range_m: (N,) true ranges.

        Returns:
            (N,) standard deviations in meters, or one number for all ranges; 0 if ranges are exact.
        """
        return self.range_noise_m

    @property
    def is_exact(self) -> bool:
        """True without noise and drop-out."""
        return not self._has_errors

    @property
    def _has_errors(self) -> bool:
        return bool(self.dropout or np.any(self.compute_noise_std_m(np.ones(1))))

    @property
    def pixels_per_sample(self) -> int:
        """1: each point is one measurement."""
        return 1

    def compute_ray_times_s(self) -> Float64 | None:
        """Return None: all rays are cast at the time of the frame."""
        return None

    def compute_beam_indices(self) -> Int64 | None:
        """Return None: each ray is its own beam."""
        return None

    def measure(self, hits: RayHits, noise: SensorNoise) -> Returns:
        """Measure a point with range noise at each hit beyond the minimum range, unless it drops out.

        Args:
            hits: Hits of the rays.
            noise: Source of all random numbers.

        Returns:
            Hits that give a point, and their range errors.
        """
        if not self.min_range_m:
            return self.sample_returns(hits, None, noise)
        is_in_range = hits.range_m >= self.min_range_m
        return self.sample_returns(hits, None if is_in_range.all() else np.flatnonzero(is_in_range), noise)

    def sample_returns(self, hits: RayHits, hit_indices: Int64 | None, noise: SensorNoise) -> Returns:
        """Apply range noise and drop-out to selected hits.

        Args:
            hits: All N hits.
            hit_indices: (K,) ascending indices of the selected hits; None for all.
            noise: Source of all random numbers.

        Returns:
            Selected hits that do not drop out, and their range errors.
        """
        if not self._has_errors:
            return Returns(hit_indices, None)
        ray_indices, range_m = hits.ray_indices, hits.range_m
        if hit_indices is not None:
            ray_indices, range_m = ray_indices[hit_indices], range_m[hit_indices]
        noise_std_m = self.compute_noise_std_m(range_m)
        error_m = None
        if np.any(noise_std_m):
            error_m = np.maximum(noise_std_m * noise.sample_normal(ray_indices), -range_m)  # measured range >= 0
        if self.dropout:
            remaining = np.flatnonzero(noise.sample_dropout_uniform(ray_indices) >= self.dropout)
            hit_indices = remaining if hit_indices is None else hit_indices[remaining]
            error_m = None if error_m is None else error_m[remaining]
        return Returns(hit_indices, error_m)


def compute_vertical_fov_deg(sensor: Sensor) -> tuple[float, float]:
    """Compute the lowest and the highest elevation of the rays in the middle column of a sensor.

    Args:
        sensor: Sensor with at least one ray in its middle column.

    Returns:
        Lowest and highest elevation in degrees.

    Example:
        >>> from torchcover.simulation import Lidar
        >>> lidar = Lidar(name="a", model="velodyne_vlp16", max_range_m=50)
        >>> [round(elevation, 9) for elevation in compute_vertical_fov_deg(lidar)]
        [-15.0, 15.0]
    """
    x, y, z = sensor.compute_directions()
    elevation_deg = np.rad2deg(np.arctan2(z, np.hypot(x, y)))[:, x.shape[1] // 2]
    return float(np.nanmin(elevation_deg)), float(np.nanmax(elevation_deg))
