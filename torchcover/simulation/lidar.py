"""LiDAR sensors: scan patterns, and models on the market that a sensor may start from."""

from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat, ValidationInfo, model_validator

from torchcover.geometry.arrays import Float32, Float64
from torchcover.simulation.documents import BuiltInDocument, Pose, resolve_name_or_file
from torchcover.simulation.rays import compute_unit_directions
from torchcover.simulation.returns import (
    compute_brightness_offsets,
    compute_log_excess,
    compute_return_probability,
    get_material_index,
    load_materials,
)
from torchcover.simulation.sensor import Elevation, RangeSensor, RayHits, Returns, ScanTimes, SensorNoise


class ScanPattern(RangeSensor):
    """Ray directions of a LiDAR and the model of its returns.

    The ray of row i in column j has the elevation `E[i]` and the azimuth `A[j] + D[i]`: elevations E are a table or
    evenly spaced over the vertical field of view, both ends included; azimuths A are the centers of `columns` equal
    sectors of the horizontal field of view; D are offsets of the rows.

    Args:
        channels: Number of rows with evenly spaced elevations.
        vertical_fov_deg: Lowest and highest elevation of evenly spaced rows.
        elevations_deg: Elevation of each row, in any order, in place of `channels` and `vertical_fov_deg`.
        azimuth_offsets_deg: Azimuth offset of each row, positive to the left; None for no offsets.
        horizontal_fov_deg: Azimuth range, centered at the x axis; 360 for a full turn.
        columns: Number of azimuths.
        range_at_10_percent_m: Range at which half of the rays return from a surface of 10 % reflectivity at normal
            incidence, see `compute_log_excess`. None: every hit within `max_range_m` returns.
        log_range_std: Standard deviation of ln of that range between rays.
        range_factors: Factor on `range_at_10_percent_m` for each row; None for 1.
        scan: Times of the columns; None if all rays are cast at once.
        min_range_m, max_range_m, range_noise_m, dropout: See `RangeSensor`.
    """

    # Limits are 100 times the values of products on the market.
    channels: Annotated[int, Field(gt=0, le=100_000)] | None = None
    vertical_fov_deg: tuple[Elevation, Elevation] | None = None
    elevations_deg: tuple[Elevation, ...] | None = Field(default=None, min_length=1)
    azimuth_offsets_deg: tuple[float, ...] | None = None
    horizontal_fov_deg: Annotated[float, Field(gt=0.0, le=360.0)]
    columns: Annotated[int, Field(gt=0, le=1_000_000)]
    range_at_10_percent_m: PositiveFloat | None = None
    log_range_std: PositiveFloat = 0.3
    range_factors: tuple[PositiveFloat, ...] | None = None
    scan: ScanTimes | None = None

    @model_validator(mode="after")
    def _check_rows(self) -> Self:
        is_spaced = (self.channels is not None, self.vertical_fov_deg is not None)
        if self.elevations_deg is not None and any(is_spaced):
            raise ValueError("give the rows as elevations_deg, or as channels and vertical_fov_deg, not both")
        if self.elevations_deg is None and not all(is_spaced):
            raise ValueError("the rows are missing: give channels and vertical_fov_deg, or elevations_deg")
        if self.vertical_fov_deg is not None and self.vertical_fov_deg[0] > self.vertical_fov_deg[1]:
            raise ValueError(f"vertical_fov_deg: the lower elevation comes first; got {self.vertical_fov_deg}")
        num_rows = len(self.compute_elevations_deg())
        for key in ("azimuth_offsets_deg", "range_factors"):
            values = getattr(self, key)
            if values is not None and len(values) != num_rows:
                raise ValueError(f"{key}: one for each of the {num_rows} rows is needed; got {len(values)}")
        return self

    @property
    def is_exact(self) -> bool:
        """True if there is neither noise nor drop-out, and every hit returns."""
        return self.range_at_10_percent_m is None and super().is_exact

    def measure(self, hits: RayHits, noise: SensorNoise) -> Returns:
        """Measure a point at each hit that returns enough light and is not too close.

        Args:
            hits: Hits of the rays.
            noise: Source of all random numbers.

        Returns:
            Hits that give a point, and their range errors, see `RangeSensor.measure`.
        """
        if self.range_at_10_percent_m is None:
            return super().measure(hits, noise)
        probability = self._compute_return_probability(hits, self.range_at_10_percent_m)
        is_returned = noise.sample_return_uniform(hits.ray_indices) < probability
        return self.sample_returns(hits, np.flatnonzero(is_returned & (hits.range_m >= self.min_range_m)), noise)

    def _compute_return_probability(self, hits: RayHits, range_at_10_percent_m: float) -> NDArray[np.floating]:
        material, weather = hits.attributes.material_indices, hits.weather
        if weather.road == "wet":
            material = np.where(material == get_material_index("road"), get_material_index("wet_road"), material)
        materials = load_materials()
        row_range_m: float | Float32 = range_at_10_percent_m
        if self.range_factors is not None:
            range_per_row_m = range_at_10_percent_m * np.array(self.range_factors, dtype=np.float32)
            row_range_m = range_per_row_m[hits.pixel_indices // self.columns]
        log_excess = compute_log_excess(
            hits.range_m,
            hits.attributes.cos_incidence,
            materials.reflectivity[material],
            materials.incidence_exponent[material],
            row_range_m,
            weather.extinction_per_m,
        )
        log_excess += materials.body_log_std[material] * compute_brightness_offsets(hits.attributes.body_indices)
        return compute_return_probability(log_excess, self.log_range_std, materials.point_log_std[material])

    @property
    def num_rays(self) -> int:
        """Number of rays: rows times columns."""
        return (self.channels or len(self.elevations_deg or ())) * self.columns

    def compute_elevations_deg(self) -> Float64:
        """Compute the (rows,) elevations of the rows."""
        if self.elevations_deg is not None:
            return np.array(self.elevations_deg)
        assert self.channels is not None  # checked in _check_rows
        assert self.vertical_fov_deg is not None
        return np.linspace(*self.vertical_fov_deg, self.channels)

    def compute_ray_times_s(self) -> Float64 | None:
        """Compute (rows, columns) times of the rays relative to the frame; None if all rays are cast at that time."""
        num_rows = len(self.compute_elevations_deg())
        return None if self.scan is None else np.tile(self.scan.compute_times_s(self.columns), (num_rows, 1))

    def compute_directions(self) -> Float64:
        """Compute (3, rows, columns) unit directions in the LiDAR frame."""
        elevations_deg = self.compute_elevations_deg()
        column_shares = (np.arange(self.columns) + 0.5) / self.columns - 0.5
        offsets_deg = np.zeros(len(elevations_deg)) if self.azimuth_offsets_deg is None else self.azimuth_offsets_deg
        azimuths_deg = np.add.outer(offsets_deg, self.horizontal_fov_deg * column_shares)
        return compute_unit_directions(elevations_deg[:, None], azimuths_deg)


class LidarModel(ScanPattern, BuiltInDocument):
    """LiDAR on the market: scan pattern and defaults that a `Lidar` starts from.

    Args:
        name: Name that `model` of a sensor refers to.
        description: Product and source of the numbers.

    Example:
        >>> len(LidarModel.load("velodyne_vlp16").compute_elevations_deg())
        16
    """

    folder: ClassVar[str] = "lidars"

    name: str
    description: str = ""

    def complete_keys(self, sensor_keys: dict[str, Any]) -> dict[str, Any]:
        """Complete the keys of a sensor with keys of the model.

        Args:
            sensor_keys: Keys of the sensor, which take precedence. A sensor with evenly spaced rows takes no row table
                from the model; a sensor with its own elevations takes neither spacing nor row table.

        Returns:
            Keys of the sensor and of the model.
        """
        spacing_keys = {"channels", "vertical_fov_deg"}
        table_keys = {"elevations_deg", "azimuth_offsets_deg", "range_factors"}
        model_keys = self.model_dump(exclude={"name", "description"}, exclude_unset=True)
        excluded_keys: set[str] = set()
        if any(sensor_keys.get(key) is not None for key in spacing_keys):
            excluded_keys = table_keys
        elif sensor_keys.get("elevations_deg") is not None:
            excluded_keys = spacing_keys | table_keys
        return {key: value for key, value in model_keys.items() if key not in excluded_keys} | sensor_keys


class Lidar(ScanPattern):
    """Scanning LiDAR at its mounting pose on the vehicle. The sensor frame is x forward, y left, z up.

    Args:
        name: Name in maps and messages.
        mount: Extrinsics `vehicle_T_lidar`.
        model: Name of a built-in `LidarModel` or path of a YAML file; it supplies all keys of the scan pattern that are
            not given here.

    Example:
        >>> lidar = Lidar(
        ...     name="a", channels=3, vertical_fov_deg=(-10, 10), columns=360, horizontal_fov_deg=360, max_range_m=99
        ... )
        >>> lidar.compute_directions().shape
        (3, 3, 360)
        >>> Lidar.model_validate({"name": "b", "model": "velodyne_vlp16", "max_range_m": 50}).columns
        1800
    """

    type: Literal["lidar"] = "lidar"
    name: str
    mount: Pose = Pose()
    model: str | None = None

    @model_validator(mode="before")
    @classmethod
    def _complete_from_model(cls, content: Any, info: ValidationInfo) -> Any:  # noqa: ANN401  (raw content of a file)
        if not isinstance(content, dict) or not isinstance(content.get("model"), str):
            return content
        try:
            return LidarModel.load(resolve_name_or_file(content["model"], info)).complete_keys(content)
        except FileNotFoundError as error:
            raise ValueError(f"model: {error}") from error
