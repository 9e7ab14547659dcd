"""YAML documents: typed values without unknown keys, loaded by path or by built-in name."""

from collections.abc import Sequence
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self, TypeGuard, TypeVar

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    ValidationError,
    ValidationInfo,
    model_validator,
)

from torchcover.files import BadFileError, explain_validation_error, guard_reader, parse_yaml, read_short_text
from torchcover.geometry import build_transform, convert_euler_to_rotation, convert_quaternion_to_rotation
from torchcover.geometry.arrays import Float64
from torchcover.geometry.rigid import warn_about_radians
from torchcover.recordings.unsupported_formats import find_remedy
from torchcover.simulation.builtin import get_builtin_folder, hash_file, list_builtin_names
from torchcover.simulation.document_keys import find_other_kind, suggest_key


class Document(BaseModel):
    """Base of all YAML documents: immutable; unknown keys, NaN and infinity are errors.

    Types are strict: true is not a number, 8.0 is not an integer, "60" is neither. Integers are valid numbers, lists
    are valid tuples, and NumPy scalars are valid Python numbers.
    """

    kind: ClassVar[str] = ""
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)

    def __init__(self, **values: Any) -> None:  # noqa: ANN401  (raw content)
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise ValueError(f"{type(self).__name__}: {explain_document_error(error)}") from None

    # The marker of pydantic's own constructor: nested documents are validated without calling this one.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    @model_validator(mode="before")
    @classmethod
    def _convert_values(cls, content: Any) -> Any:  # noqa: ANN401  (raw content of a file)
        if not isinstance(content, dict):
            return content
        converted = {key: _to_python_value(value) for key, value in content.items()}
        # These angles are often given in radians by mistake.
        angle_keys = ["yaw_deg", "pitch_deg", "roll_deg", "fov_deg", "horizontal_fov_deg", "vertical_fov_deg"]
        angle_keys.append("facing_deg")
        warn_about_radians({key: converted[key] for key in angle_keys if has_only_numbers(converted.get(key))})
        return converted

    def collect_content(self) -> dict[str, Any]:
        """Collect all that influences a simulation, for JSON: keys, and hashes of the files that they name.

        Raises:
            FileNotFoundError: A file is missing.

        Example:
            >>> Pose(x_m=1.5).collect_content()["x_m"]
            1.5
        """
        keys = [key for key in type(self).model_fields if key != "description"]
        return {key: _collect_value(getattr(self, key)) for key in keys}


# Rays lose their origin in rounding errors farther away.
FARTHEST_M = 1e9
Coordinate = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M)]


def _check_ascending(bounds: tuple[float, float]) -> tuple[float, float]:
    if not bounds[0] < bounds[1]:
        raise ValueError(f"the lower bound must be below the upper one; got {bounds[0]:g} to {bounds[1]:g} m")
    return bounds


Bounds = Annotated[tuple[Coordinate, Coordinate], AfterValidator(_check_ascending)]


class Pose(Document):
    """Pose of a frame in another: `destination_T_source` in the form that people write.

    Args:
        x_m: Position forward.
        y_m: Position to the left.
        z_m: Position up.
        yaw_deg: Rotation about z; positive turns left.
        pitch_deg: Rotation about y; positive lowers the nose.
        roll_deg: Rotation about x; positive lowers the right side.
        quaternion_wxyz: Rotation as a unit quaternion, in place of the three angles.

    Example:
        >>> Pose(x_m=1.5, z_m=1.7, yaw_deg=180.0).to_matrix().round(3)[0]
        array([-1. , -0. ,  0. ,  1.5])
    """

    x_m: Coordinate = 0.0
    y_m: Coordinate = 0.0
    z_m: Coordinate = 0.0
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    quaternion_wxyz: tuple[float, float, float, float] | None = None

    @model_validator(mode="after")
    def _check_rotation(self) -> Self:
        if self.quaternion_wxyz is not None:
            if self.yaw_deg or self.pitch_deg or self.roll_deg:
                raise ValueError("give the rotation as a quaternion or as yaw, pitch and roll, not both")
            convert_quaternion_to_rotation(self.quaternion_wxyz)
        return self

    def to_matrix(self) -> Float64:
        """Convert the pose to a (4, 4) transform."""
        if self.quaternion_wxyz is not None:
            rotation = convert_quaternion_to_rotation(self.quaternion_wxyz)
        else:
            rotation = convert_euler_to_rotation(self.yaw_deg, self.pitch_deg, self.roll_deg)
        return build_transform(rotation, (self.x_m, self.y_m, self.z_m))


DocumentT = TypeVar("DocumentT", bound=Document)


def read_document(document_type: type[DocumentT], path: Path) -> DocumentT:
    """Read a YAML file.

    Args:
        document_type: Type of the document.
        path: YAML file; relative paths in it start at its folder.

    Raises:
        FileNotFoundError: No such file.
        BadFileError: Not YAML, another kind of document, or a wrong key or value; the message names file and key.
    """
    content = read_mapping(path)
    try:
        return document_type.model_validate(content, context={"folder": path.parent})
    except ValidationError as error:
        kind = find_other_kind(document_type.kind, content)
        message = f"this is {kind}; {document_type.kind} is needed" if kind else explain_document_error(error)
        raise BadFileError(f"{path}: {message}") from error


def explain_document_error(error: ValidationError) -> str:
    """Explain the mistakes of a document in one line, with suggestions for unknown keys.

    Args:
        error: Error of a document.
    """
    known_keys = sorted(_collect_keys(Document))
    return "; ".join(explain_validation_error(error, partial(suggest_key, known_keys=known_keys)))


def _collect_keys(document_type: type[BaseModel]) -> set[str]:
    """Collect the keys of a type and all its subclasses."""
    keys = set(document_type.model_fields)
    for subclass in document_type.__subclasses__():
        keys |= _collect_keys(subclass)
    return keys


class FileDocument(Document):
    """Document that is always a file of its own."""

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read the document from a YAML file.

        Args:
            path: YAML file.

        Raises:
            FileNotFoundError: No such file.
            BadFileError: Not YAML, or a wrong key or value; the message names the file and the key.
        """
        return read_document(cls, Path(path))


class BuiltInDocument(Document):
    """Document that is a file of its own or built in under a name, in a folder of its kind."""

    folder: ClassVar[str]

    @classmethod
    def load(cls, path_or_name: str | Path) -> Self:
        """Read the document from a YAML file, or a built-in one by its name (`torchcover list`).

        Args:
            path_or_name: Path that ends in .yaml or .yml, or name of a built-in document.

        Raises:
            FileNotFoundError: No such file, or no built-in document of this name; the message suggests names.
            BadFileError: Not YAML, or a key is unknown, missing, doubled or has a wrong value; the message names the
                file and the key.
        """
        return read_document(cls, find_document(cls.folder, path_or_name))


@guard_reader("a YAML document")
def read_mapping(path: Path) -> dict[str, Any]:
    """Read the keys and values of a YAML file.

    Args:
        path: YAML file.

    Raises:
        BadFileError: Not YAML, or not a mapping.
    """
    content = parse_yaml(read_short_text(path))
    if not isinstance(content, dict):
        raise ValueError(f"a YAML mapping of keys is needed; got {type(content).__name__}")
    return content


def _resolve_path_text(path: Any, info: ValidationInfo) -> Any:  # noqa: ANN401  (raw content of a file)
    return resolve_path(Path(path), info) if isinstance(path, str) else path


def resolve_path(path: Path, info: ValidationInfo) -> Path:
    """Resolve a relative path from the folder of the document that contains it.

    Args:
        path: Path in the document.
        info: Context of the validation, with the folder of the document if it is a file.
    """
    folder = (info.context or {}).get("folder")
    return folder / path if folder and not path.is_absolute() else path


def _make_absolute(path_or_name: str | Path) -> str:
    is_path = isinstance(path_or_name, Path) or is_file_name(path_or_name)
    return str(Path(path_or_name).resolve() if is_path else path_or_name)


# Saved documents contain absolute paths, so that they can be moved.
_AbsoluteWhenSaved = PlainSerializer(_make_absolute, when_used="json")

RelativePath = Annotated[Path, BeforeValidator(_resolve_path_text), _AbsoluteWhenSaved]
"""Path in a document, relative to the folder of the document."""


def resolve_name_or_file(path_or_name: Any, info: ValidationInfo) -> Any:  # noqa: ANN401  (raw content of a file)
    """Resolve a relative path of a YAML file from the folder of the document; names stay as they are.

    Args:
        path_or_name: Path of a YAML file, name of a built-in document, or any other value.
        info: Context of the validation, with the folder of the document if it is a file.
    """
    if isinstance(path_or_name, str) and is_file_name(path_or_name):
        return str(resolve_path(Path(path_or_name), info))
    return path_or_name


NameOrFile = Annotated[str, BeforeValidator(resolve_name_or_file), _AbsoluteWhenSaved]
"""Name of a built-in document, or path of a YAML file relative to the folder of the document."""


def _wrap_string(value: Any) -> Any:  # noqa: ANN401  (raw content of a file)
    return (value,) if isinstance(value, str) else value


# Accepts a single string in place of a list of strings.
SEVERAL = BeforeValidator(_wrap_string)


def build_name_validator(document_type: type[BuiltInDocument]) -> BeforeValidator:
    """Build a validator that accepts a built-in name or a file in place of a nested document.

    Args:
        document_type: Type of the nested document.
    """

    def load(value: Any, info: ValidationInfo) -> Any:  # noqa: ANN401  (raw content of a file)
        try:
            return document_type.load(resolve_name_or_file(value, info)) if isinstance(value, str) else value
        except FileNotFoundError as error:
            raise ValueError(str(error)) from error

    return BeforeValidator(load)


def is_file_name(path_or_name: str | Path) -> bool:
    """Return True for the path of a YAML file, False for the name of a built-in document.

    Args:
        path_or_name: Path or name.
    """
    return Path(path_or_name).suffix in (".yaml", ".yml")


def suggest_names(name: str, known_names: Sequence[str]) -> str:
    """Suggest at most three known names for an unknown one, in words.

    Args:
        name: Unknown name.
        known_names: All known names.

    Example:
        >>> suggest_names("urbn", ["courtyard", "highway", "parking", "urban"])
        "is 'urban' meant? `torchcover list` has all 4"
    """
    matches = get_close_matches(name, known_names, n=3) or get_close_matches(name, known_names, n=3, cutoff=0.0)
    return f"is {' or '.join(map(repr, matches))} meant? `torchcover list` has all {len(known_names)}"


def find_document(kind: str, path_or_name: str | Path) -> Path:
    """Find the file of a document.

    Args:
        kind: Folder of built-in documents, such as "rigs".
        path_or_name: Path that ends in .yaml or .yml, or name of a built-in document.

    Returns:
        Path of the YAML file; the file of a path is not checked.

    Raises:
        FileNotFoundError: No built-in document of this name; the message suggests names.
        BadFileError: A file of another format; the message says how to use it.
    """
    path = Path(path_or_name)
    if is_file_name(path):
        return path
    if remedy := find_remedy(path):
        raise BadFileError(f"{path}: one of the {kind} is a .yaml file; {remedy}")
    builtin_path = get_builtin_folder(kind) / f"{path_or_name}.yaml"
    if path.name == str(path_or_name) and builtin_path.is_file():
        return builtin_path
    for other_kind in ("rigs", "scenarios", "vehicles", "encounters", "requirements"):
        if other_kind != kind and path.name in list_builtin_names(other_kind):
            raise FileNotFoundError(f"{path.name!r} is one of the built-in {other_kind}; one of the {kind} is needed")
    raise FileNotFoundError(
        f"{str(path_or_name)!r} is neither a .yaml file nor one of the built-in {kind}; "
        + suggest_names(str(path_or_name), list_builtin_names(kind))
    )


def _collect_value(value: Any) -> Any:  # noqa: ANN401  (any value of a document)
    if isinstance(value, Document):
        return value.collect_content()
    if isinstance(value, Path):
        return hash_file(value)
    if isinstance(value, dict):
        return {key: _collect_value(item) for key, item in value.items()}
    return [_collect_value(item) for item in value] if isinstance(value, tuple | list) else value


def has_only_numbers(value: object) -> TypeGuard[float | tuple[float, ...]]:
    """Return True for a number or a tuple of numbers.

    Args:
        value: Any value.
    """
    return all(type(item) in (int, float) for item in (value if isinstance(value, tuple) else (value,)))


def _to_python_value(value: Any) -> Any:  # noqa: ANN401  (raw content of a file)
    """Convert lists to tuples and NumPy scalars to Python numbers, recursively."""
    if isinstance(value, list):
        return tuple(_to_python_value(item) for item in value)
    if isinstance(value, dict):
        return {key: _to_python_value(item) for key, item in value.items()}
    return value.item() if isinstance(value, np.generic) else value
