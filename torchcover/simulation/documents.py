"""YAML documents: typed, without unknown keys, found by path or by built-in name."""

from importlib.resources import files
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError, ValidationInfo, model_validator

from torchcover.geometry import rigid, rotation_from_euler, rotation_from_quaternion

# That of libyaml is ten times as fast; not every build of PyYAML has it.
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class Document(BaseModel):
    """Base of everything that is written in YAML: unknown keys, NaN and infinity are errors; values do not change."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Pose(Document):
    """Where a frame lies in another: `destination_T_source` as people write it.

    Args:
        x_m: Forward.
        y_m: To the left.
        z_m: Up.
        yaw_deg: About z; positive turns left.
        pitch_deg: About y; positive turns the nose down.
        roll_deg: About x; positive lowers the right side.
        quaternion_wxyz: The rotation as a quaternion instead of the three angles.

    Example:
        >>> Pose(x_m=1.5, z_m=1.7, yaw_deg=180.0).matrix().round(3)[0]
        array([-1. , -0. ,  0. ,  1.5])
    """

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    quaternion_wxyz: tuple[float, float, float, float] | None = None

    @model_validator(mode="after")
    def _check_rotation(self) -> Self:
        if self.quaternion_wxyz is not None:
            if self.yaw_deg or self.pitch_deg or self.roll_deg:
                raise ValueError("give the rotation as a quaternion or as yaw, pitch and roll, not both")
            rotation_from_quaternion(self.quaternion_wxyz)
        return self

    def matrix(self) -> NDArray[np.float64]:
        """The (4, 4) transform."""
        if self.quaternion_wxyz is not None:
            rotation = rotation_from_quaternion(self.quaternion_wxyz)
        else:
            rotation = rotation_from_euler(self.yaw_deg, self.pitch_deg, self.roll_deg)
        return rigid(rotation, (self.x_m, self.y_m, self.z_m))


DocumentT = TypeVar("DocumentT", bound=Document)


def load_document(model: type[DocumentT], kind: str, path_or_name: str | Path) -> DocumentT:
    """Read a YAML file into a model.

    Args:
        model: What it must hold.
        kind: Folder of the built-in ones: "rigs", "scenarios", "vehicles" or "lidars".
        path_or_name: A path that ends in .yaml or .yml, or the name of a built-in document.

    Returns:
        The validated document.

    Raises:
        FileNotFoundError: No such file, or no built-in document of this name; the message lists the names.
        ValueError: Not YAML, or a key is unknown, missing or has a wrong value; the message names the file and key.
    """
    path = _find(kind, path_or_name)
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), Loader=LOADER)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not a YAML file: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: a YAML mapping of keys is needed; got {type(content).__name__}")
    try:
        return model.model_validate(content, context={"folder": path.parent})
    except ValidationError as error:
        raise ValueError(f"{path}: {explain(error)}") from error


def builtin_names(kind: str) -> list[str]:
    """Names of the built-in documents of a kind, in alphabetical order."""
    return sorted(path.stem for path in _builtin_folder(kind).glob("*.yaml"))


def explain(error: ValidationError) -> str:
    """What pydantic found, in one line: the key, what is wrong, what arrived."""
    found = []
    for detail in error.errors(include_url=False):
        key = ".".join(str(part) for part in detail["loc"]) or "document"
        arrived = "" if detail["type"] in ("missing", "value_error") else f" (got {_shorten(detail['input'])})"
        found.append(f"{key}: {detail['msg'].removeprefix('Value error, ')}{arrived}")
    return "; ".join(found)


def beside(path: Path, info: ValidationInfo) -> Path:
    """Validator: a relative path is meant from the folder of the document that holds it."""
    folder = (info.context or {}).get("folder")
    return folder / path if folder and not path.is_absolute() else path


def _find(kind: str, path_or_name: str | Path) -> Path:
    path = Path(path_or_name)
    if path.suffix in (".yaml", ".yml"):
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file")
        return path
    builtin = _builtin_folder(kind) / f"{path_or_name}.yaml"
    if path.name != str(path_or_name) or not builtin.is_file():
        raise FileNotFoundError(
            f"{str(path_or_name)!r} is neither a .yaml file nor one of the built-in {kind}: "
            f"{', '.join(builtin_names(kind))}"
        )
    return builtin


def _builtin_folder(kind: str) -> Path:
    package = Path(str(files("torchcover")))
    # In a wheel the folder lies inside the package; in a checkout beside it.
    installed = package / "_datasets"
    return (installed if installed.is_dir() else package.parent / "datasets") / kind


def _shorten(value: Any) -> str:  # noqa: ANN401  (whatever stood in the file)
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
