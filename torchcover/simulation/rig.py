"""A rig: the sensors of a vehicle and where they are mounted."""

from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Field, PlainValidator, TypeAdapter, ValidationInfo, model_validator

from torchcover.simulation.documents import Document, NameOrFile, load_document
from torchcover.simulation.kinds import SENSORS
from torchcover.simulation.sensor import Sensor


def _sensor(content: Any, info: ValidationInfo) -> Sensor:  # noqa: ANN401  (whatever stood in the file, or a sensor)
    """A sensor of the kind that its `type` names."""
    kind = content.get("type", "lidar") if isinstance(content, dict) else getattr(content, "type", type(content))
    if not isinstance(kind, str) or kind not in SENSORS:
        raise ValueError(f"type: a sensor is a {' or a '.join(map(repr, SENSORS))}; got {kind!r}")
    return TypeAdapter(SENSORS[kind]).validate_python(content, context=info.context)


class Rig(Document):
    """The sensors of a vehicle.

    Args:
        name: What tables and maps call it.
        description: What it is, and where its numbers come from.
        vehicle: What carries it, a built-in vehicle or the YAML file of one, where neither the user nor the scenario
            decides that.
        sensors: The sensors, each of a kind in `SENSORS`; their clouds are fused.

    Example:
        >>> [sensor.name for sensor in Rig.load("front_roof_128").sensors]
        ['roof']
    """

    name: str
    description: str = ""
    vehicle: NameOrFile | None = None
    sensors: tuple[Annotated[Sensor, PlainValidator(_sensor)], ...] = Field(min_length=1)

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

    def content(self) -> dict[str, Any]:
        """Its sensors; the vehicle is in the scenario that it is simulated in, if it is the one."""
        return {key: value for key, value in super().content().items() if key != "vehicle"}
