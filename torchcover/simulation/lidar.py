"""LiDAR: a sensor at its place on the vehicle, and the models on the market that it may start from."""

from pathlib import Path
from typing import Any, Literal, Self

from pydantic import ValidationInfo, model_validator

from torchcover.simulation.documents import Pose, beside, is_file_name, load_document
from torchcover.simulation.scan_pattern import ScanPattern

# Two ways to write rows: a sensor that chooses one of them takes nothing of the other from its model.
SPACED_ROWS = ("channels", "vertical_fov_deg")
ROW_TABLE = ("elevations_deg", "azimuth_offsets_deg")


class LidarModel(ScanPattern):
    """What is known of a LiDAR on the market: the scan pattern that a sensor starts from.

    Args:
        name: What a sensor's `model` calls it.
        description: What it is, and where its numbers come from.
    """

    name: str
    description: str = ""

    @classmethod
    def load(cls, path_or_name: str | Path) -> Self:
        """Read a model from a YAML file, or a built-in one by its name.

        Raises:
            FileNotFoundError: No such file or name; the message lists the names.
            ValueError: The file is not a model; the message names the file and the key.

        Example:
            >>> len(LidarModel.load("velodyne_vlp16").rows_deg())
            16
        """
        return load_document(cls, "lidars", path_or_name)

    def completing(self, given: dict[str, Any]) -> dict[str, Any]:
        """The keys of a sensor, and those of the model that it does not give.

        Args:
            given: The sensor's keys. One with evenly spaced rows takes no table from the model; one with a table of its
                own takes neither spacing nor offsets.
        """
        pattern = self.model_dump(exclude={"name", "description"}, exclude_unset=True)
        left_out: tuple[str, ...] = ()
        if any(given.get(key) is not None for key in SPACED_ROWS):
            left_out = ROW_TABLE
        elif given.get("elevations_deg") is not None:
            left_out = SPACED_ROWS + ROW_TABLE
        return {key: value for key, value in pattern.items() if key not in left_out} | given


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
        name: str | Path = content["model"]
        if is_file_name(name):
            name = beside(Path(name), info)
        try:
            return LidarModel.load(name).completing(content)
        except FileNotFoundError as error:
            raise ValueError(f"model: {error}") from error
