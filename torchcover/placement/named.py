"""Rigs and scenarios as spaces name them."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, PlainValidator, ValidationInfo

from torchcover.simulation import Rig
from torchcover.simulation.documents import NameOrFile, beside, is_file_name


def _rig(given: Any, info: ValidationInfo) -> Rig:  # noqa: ANN401  (whatever stood in the file)
    """A rig, or one by its name or its file."""
    if isinstance(given, Rig):
        return given
    if not isinstance(given, str):
        raise ValueError(f"the name of a rig, or the path of its file, is needed; got {type(given).__name__}")
    try:
        return Rig.load(beside(Path(given), info) if is_file_name(given) else given)
    except FileNotFoundError as error:
        raise ValueError(str(error)) from error


def _vehicle(given: str) -> str:
    if Path(given).suffix and not is_file_name(given):
        raise ValueError(f"the name of a vehicle, or the path of its YAML file, is needed; got {given!r}")
    return given


def _listed(given: Any) -> Any:  # noqa: ANN401  (whatever stood in the file)
    return (given,) if isinstance(given, str) else given


# A rig, or the name or the file of one.
NamedRig = Annotated[Rig, PlainValidator(_rig)]
# One name or file, or several.
Names = Annotated[tuple[NameOrFile, ...], BeforeValidator(_listed), Field(min_length=1)]
# A vehicle's.
NamedVehicle = Annotated[NameOrFile, AfterValidator(_vehicle)]
