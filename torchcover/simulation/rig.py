"""A rig: the sensors of a vehicle and where they are mounted."""

from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Discriminator, Field, Tag, model_validator

from torchcover.simulation.camera_sensor import CameraSensor
from torchcover.simulation.documents import Document, load_document
from torchcover.simulation.lidar import Lidar


def _kind(sensor: Any) -> str | None:  # noqa: ANN401  (whatever stood in the file, or a sensor)
    kind = sensor.get("type", "lidar") if isinstance(sensor, dict) else getattr(sensor, "type", None)
    return kind if isinstance(kind, str) else None


Sensor = Annotated[
    Annotated[Lidar, Tag("lidar")] | Annotated[CameraSensor, Tag("camera")],
    Discriminator(
        _kind, custom_error_type="sensor_type", custom_error_message="type: a sensor is a 'lidar' or a 'camera'"
    ),
]


class Rig(Document):
    """The sensors of a vehicle.

    Args:
        name: What tables and maps call it.
        description: What it is, and where its numbers come from.
        sensors: The sensors; their clouds are fused.

    Example:
        >>> [sensor.name for sensor in Rig.load("front_roof_128").sensors]
        ['roof']
    """

    name: str
    description: str = ""
    sensors: tuple[Sensor, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _check_names(self) -> Self:
        names = [sensor.name for sensor in self.sensors]
        if len(set(names)) != len(names):
            raise ValueError(f"sensors need different names; got {', '.join(names)}")
        return self

    @classmethod
    def load(cls, path_or_name: str | Path) -> Self:
        """Read a rig from a YAML file, or a built-in one by its name (`torchcover list`).

        Raises:
            FileNotFoundError: No such file or name.
            ValueError: The file is not a rig; the message names the file and the key.
        """
        return load_document(cls, "rigs", path_or_name)
