"""LiDAR: a table of rows, turned through its columns, and the models on the market that it may start from."""

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

# Two ways to write rows: a sensor that chooses one of them takes nothing of the other from its model.
SPACED_ROWS = ("channels", "vertical_fov_deg")
ROW_TABLE = ("elevations_deg", "azimuth_offsets_deg", "range_factors")
# A hundred times what there is on the market.
MAX_ROWS, MAX_COLUMNS = 100_000, 1_000_000


class ScanPattern(RangeSensor):
    """Where the rays of a LiDAR point, and which of their hits become points.

    The ray of row i in column j points to elevation `E[i]` and azimuth `A[j] + D[i]`, where the rows' elevations E are
    a table or evenly spaced over the field of view, both ends included; the columns' azimuths A are evenly spaced over
    the field of view, in the middle of `columns` equal sectors; and D are offsets of the rows.

    Args:
        channels: Number of rows, when they are evenly spaced.
        vertical_fov_deg: Lowest and highest elevation of evenly spaced rows.
        elevations_deg: Elevation of each row instead, in any order.
        azimuth_offsets_deg: Offset of each row; positive is left. None if not given.
        horizontal_fov_deg: Field of view about the x axis, 360 for a full turn.
        columns: Number of columns.
        range_at_10_percent_m: Range at which a surface of reflectivity 10 %, met head-on, returns every other ray; see
            `log_excess`. None: every hit within `max_range_m` returns.
        log_range_std: Standard deviation of ln of that range between one ray and the next.
        range_factors: Of each row, what its range at 10 % is multiplied with; 1 if not given.
        scan: When its columns are cast; all at once if not given.
        min_range_m, max_range_m, range_noise_m, dropout: As in `Ranging`.
    """

    channels: Annotated[int, Field(gt=0, le=MAX_ROWS)] | None = None
    vertical_fov_deg: tuple[Elevation, Elevation] | None = None
    elevations_deg: tuple[Elevation, ...] | None = Field(default=None, min_length=1)
    azimuth_offsets_deg: tuple[float, ...] | None = None
    horizontal_fov_deg: Annotated[float, Field(gt=0.0, le=360.0)]
    columns: Annotated[int, Field(gt=0, le=MAX_COLUMNS)]
    range_at_10_percent_m: PositiveFloat | None = None
    log_range_std: PositiveFloat = 0.3
    range_factors: tuple[PositiveFloat, ...] | None = None
    scan: ScanTimes | None = None

    @model_validator(mode="after")
    def _check_rows(self) -> Self:
        spaced = (self.channels is not None, self.vertical_fov_deg is not None)
        if self.elevations_deg is not None and any(spaced):
            raise ValueError("give the rows as elevations_deg, or as channels and vertical_fov_deg, not both")
        if self.elevations_deg is None and not all(spaced):
            raise ValueError("the rows are missing: give channels and vertical_fov_deg, or elevations_deg")
        if self.vertical_fov_deg is not None and self.vertical_fov_deg[0] > self.vertical_fov_deg[1]:
            raise ValueError(f"vertical_fov_deg: the lower elevation comes first; got {self.vertical_fov_deg}")
        rows = len(self.compute_elevations_deg())
        for key in ("azimuth_offsets_deg", "range_factors"):
            given = getattr(self, key)
            if given is not None and len(given) != rows:
                raise ValueError(f"{key}: one for each of the {rows} rows is needed; got {len(given)}")
        return self

    @property
    def is_exact(self) -> bool:
        """Whether it has neither noise nor drop-out, and every hit returns."""
        return self.range_at_10_percent_m is None and super().is_exact

    def measure(self, hits: RayHits, noise: SensorNoise) -> Returns:
        """A point for each hit that returns enough light and is not too close; see `Ranging.measure`."""
        if self.range_at_10_percent_m is None:
            return super().measure(hits, noise)
        returned = noise.sample_return_uniform(hits.ray_indices) < self._return_probability(
            hits, self.range_at_10_percent_m
        )
        return self.sample_returns(hits, np.flatnonzero(returned & (hits.range_m >= self.min_range_m)), noise)

    def _return_probability(self, hits: RayHits, range_at_10_percent_m: float) -> NDArray[np.floating]:
        material, weather = hits.attributes.material_indices, hits.weather
        if weather.road == "wet":
            material = np.where(material == get_material_index("road"), get_material_index("wet_road"), material)
        known = load_materials()
        reach_m: float | Float32 = range_at_10_percent_m
        if self.range_factors is not None:
            of_rows_m = range_at_10_percent_m * np.array(self.range_factors, dtype=np.float32)
            reach_m = of_rows_m[hits.pixel_indices // self.columns]
        excess = compute_log_excess(
            hits.range_m,
            hits.attributes.cos_incidence,
            known.reflectivity[material],
            known.incidence_exponent[material],
            reach_m,
            weather.extinction_per_m,
        )
        excess += known.body_log_std[material] * compute_brightness_offsets(hits.attributes.body_indices)
        return compute_return_probability(excess, self.log_range_std, known.point_log_std[material])

    @property
    def num_rays(self) -> int:
        """How many rays there are: rows times columns."""
        return (self.channels or len(self.elevations_deg or ())) * self.columns

    def compute_elevations_deg(self) -> Float64:
        """(rows,) elevation of each row."""
        if self.elevations_deg is not None:
            return np.array(self.elevations_deg)
        assert self.channels is not None  # checked in _check_rows
        assert self.vertical_fov_deg is not None
        return np.linspace(*self.vertical_fov_deg, self.channels)

    def compute_ray_times_s(self) -> Float64 | None:
        """(rows, columns) when each ray is cast, after the time of the frame; None if all are at that time."""
        rows = len(self.compute_elevations_deg())
        return None if self.scan is None else np.tile(self.scan.compute_times_s(self.columns), (rows, 1))

    def compute_directions(self) -> Float64:
        """(3, rows, columns) unit directions in the LiDAR's frame."""
        middle = (np.arange(self.columns) + 0.5) / self.columns - 0.5
        offsets = (
            np.zeros(len(self.compute_elevations_deg()))
            if self.azimuth_offsets_deg is None
            else self.azimuth_offsets_deg
        )
        azimuths_deg = np.add.outer(offsets, self.horizontal_fov_deg * middle)
        return compute_unit_directions(self.compute_elevations_deg()[:, None], azimuths_deg)


class LidarModel(ScanPattern, BuiltInDocument):
    """What is known of a LiDAR on the market: the scan pattern that a sensor starts from.

    Args:
        name: What a sensor's `model` calls it.
        description: What it is, and where its numbers come from.

    Example:
        >>> len(LidarModel.load("velodyne_vlp16").rows_deg())
        16
    """

    folder: ClassVar[str] = "lidars"

    name: str
    description: str = ""

    def complete_keys(self, sensor_keys: dict[str, Any]) -> dict[str, Any]:
        """The keys of a sensor, and those of the model that it does not give.

        Args:
            sensor_keys: The sensor's keys. One with evenly spaced rows takes no table from the model; one with a table of its
                own takes neither spacing nor offsets.
        """
        pattern = self.model_dump(exclude={"name", "description"}, exclude_unset=True)
        left_out: tuple[str, ...] = ()
        if any(sensor_keys.get(key) is not None for key in SPACED_ROWS):
            left_out = ROW_TABLE
        elif sensor_keys.get("elevations_deg") is not None:
            left_out = SPACED_ROWS + ROW_TABLE
        return {key: value for key, value in pattern.items() if key not in left_out} | sensor_keys


class Lidar(ScanPattern):
    """A scanning LiDAR at its place on the vehicle. Its frame is x forward, y left, z up.

    Args:
        name: What maps and messages call it.
        mount: `vehicle_T_lidar`.
        model: Name of a built-in `LidarModel`, or path of a YAML file. It stands for every key of the scan pattern that
            is not given here.

    Example:
        >>> lidar = Lidar(
        ...     name="a", channels=3, vertical_fov_deg=(-10, 10), columns=360, horizontal_fov_deg=360, max_range_m=99
        ... )
        >>> lidar.directions().shape
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
    def _complete_from_model(cls, content: Any, info: ValidationInfo) -> Any:  # noqa: ANN401  (what stood in the file)
        if not isinstance(content, dict) or not isinstance(content.get("model"), str):
            return content
        try:
            return LidarModel.load(resolve_name_or_file(content["model"], info)).complete_keys(content)
        except FileNotFoundError as error:
            raise ValueError(f"model: {error}") from error
