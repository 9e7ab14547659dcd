"""YAML documents: typed, without unknown keys, found by path or by built-in name."""

import hashlib
import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from itertools import islice
from pathlib import Path
from reprlib import Repr
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
from pydantic_core import ErrorDetails

from torchcover.files import BadFileError, guard_reader, parse_yaml, read_short_text
from torchcover.geometry import build_transform, convert_euler_to_rotation, convert_quaternion_to_rotation
from torchcover.geometry.arrays import Float64
from torchcover.geometry.rigid import warn_about_radians
from torchcover.recordings.unsupported_formats import find_remedy
from torchcover.simulation.builtin import get_builtin_folder, list_builtin_names

# Mistakes of one document that a message tells, and characters of what arrived.
MAX_TOLD = 5
# Keys of other formats, and what they are here.
OF_OTHERS = {
    **dict.fromkeys(("xyz", "position", "translation", "location"), "x_m, y_m, z_m"),
    **dict.fromkeys(("rpy", "euler"), "roll_deg, pitch_deg, yaw_deg"),
    **dict.fromkeys(("rotation", "orientation", "quaternion"), "quaternion_wxyz, or roll_deg, pitch_deg, yaw_deg,"),
    **dict.fromkeys(("rows", "beams", "lines", "layers"), "channels"),
    **dict.fromkeys(("lidars", "cameras", "radars"), "sensors"),
    "fov": "horizontal_fov_deg, vertical_fov_deg or, of a camera, fov_deg",
    "resolution": "width, height",
    "range": "max_range_m",
}
SETTINGS_KIND = "a file of settings"
# Top-level keys of the files that commands take: those that a kind needs, then those that it may have.
KINDS = {
    SETTINGS_KIND: (
        "",
        "scenario num_frames seed vehicle sensor_model weather regions test_targets cell_m thresholds_m aggregations "
        "reference num_rays average band_frame frame_interval_s target_error only_detection redundancy metrics device "
        "num_workers no_cache skip_bad_frames rerun recording",
    ),
    "a rig": ("sensors", "vehicle weather bodies"),
    "a vehicle": ("parts", "extends mount_regions"),
    "a scenario": ("", "ego bodies actors boxes time_step_s duration_s weather traffic"),
    "a search space": (
        "scenario objectives",
        "vehicle not_worse requirements start free constraints prices_eur fixed_rig candidates baseline",
    ),
    "a set of requirements": ("requirements", "regions heights grid scenario position_sets"),
    "a set of encounters": ("encounters", "draws seed"),
    "a file of regions": ("", "regions heights grid"),
}
UNITS = ("rad", "deg", "mm", "cm", "m", "km", "ft", "in", "s", "ms", "hz", "mps", "kmh")
MAX_QUOTED = 60
# Keys of angles that people measure in radians, too.
ANGLES = ("yaw_deg", "pitch_deg", "roll_deg", "fov_deg", "horizontal_fov_deg", "vertical_fov_deg", "facing_deg")
# Keys and numbers, from the document on.
KeyPath = tuple[int | str, ...]
# Looks at no more of a value than it writes: a list of lists of lists may be endless.
_QUOTE = Repr()
_QUOTE.maxlevel, _QUOTE.maxstring, _QUOTE.maxlong, _QUOTE.maxother = 2, MAX_QUOTED, MAX_QUOTED, MAX_QUOTED


class Document(BaseModel):
    """Base of everything that is written in YAML: unknown keys, NaN and infinity are errors; values do not change.

    Types are strict: true is no number, 8.0 no whole one, "60" neither. A whole number may stand for any number, a list
    for a tuple, and a number of NumPy's for Python's.
    """

    kind: ClassVar[str] = ""
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)

    @model_validator(mode="before")
    @classmethod
    def _as_python_keeps_them(cls, content: Any) -> Any:  # noqa: ANN401  (whatever stood in the file)
        if not isinstance(content, dict):
            return content
        kept = {key: _kept(value) for key, value in content.items()}
        warn_about_radians({key: kept[key] for key in ANGLES if has_only_numbers(kept.get(key))})
        return kept

    def collect_content(self) -> dict[str, Any]:
        """All that it means to a simulation, for JSON: its keys, and hashes of the files that they name.

        Raises:
            FileNotFoundError: A file is missing.

        Example:
            >>> Pose(x_m=1.5).content()["x_m"]
            1.5
        """
        return {name: _content(getattr(self, name)) for name in type(self).model_fields if name != "description"}


# Farther away rays know no place any more.
FARTHEST_M = 1e9
Coordinate = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M)]


def _ascending(bounds: tuple[float, float]) -> tuple[float, float]:
    if not bounds[0] < bounds[1]:
        raise ValueError(f"the lower bound must be below the upper one; got {bounds[0]:g} to {bounds[1]:g} m")
    return bounds


Bounds = Annotated[tuple[Coordinate, Coordinate], AfterValidator(_ascending)]


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
        """The (4, 4) transform."""
        if self.quaternion_wxyz is not None:
            rotation = convert_quaternion_to_rotation(self.quaternion_wxyz)
        else:
            rotation = convert_euler_to_rotation(self.yaw_deg, self.pitch_deg, self.roll_deg)
        return build_transform(rotation, (self.x_m, self.y_m, self.z_m))


DocumentT = TypeVar("DocumentT", bound=Document)


def read_document(document_type: type[DocumentT], path: Path) -> DocumentT:
    """Read a YAML file into a model of which none is built in."""
    content = read_mapping(path)
    try:
        return document_type.model_validate(content, context={"folder": path.parent})
    except ValidationError as error:
        other = find_other_kind(document_type.kind, content)
        words = f"this is {other}; {document_type.kind} is needed" if other else format_validation_error(error)
        raise BadFileError(f"{path}: {words}") from error


def find_other_kind(kind: str, content: Mapping[str, Any]) -> str:
    """Find the kind of document that a file is, if it fits another kind better than the one that is needed.

    Args:
        kind: The kind that is needed, a key of `KINDS`.
        content: The keys of the file.

    Returns:
        A key of `KINDS`; empty if no other kind has more of the keys.

    Example:
        >>> find_other_kind("a vehicle", {"name": "roof", "sensors": []}), find_other_kind("a rig", {"sensor": []})
        ('a rig', '')
    """
    keys, mistakes, known = set(content) - {"name", "description"}, {}, {}
    for each, (needed, allowed) in KINDS.items():
        known[each] = {*needed.split(), *allowed.split()}
        mistakes[each] = len(keys - known[each]) + len(set(needed.split()) - keys)
    best = min(mistakes, key=mistakes.__getitem__)
    if kind not in KINDS or mistakes[best] >= mistakes[kind]:
        return ""
    has_own_keys = bool(keys & (known[best] - known[kind]))
    return best if has_own_keys or (keys and not mistakes[best]) else ""


class FileDocument(Document):
    """A document that fills a file of its own."""

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read it from a YAML file.

        FileNotFoundError: no such file. BadFileError: not YAML, or a wrong key or value; the message names the file and
        the key.
        """
        return read_document(cls, Path(path))


class BuiltInDocument(Document):
    """A document that has a name if it comes with torchcover, in a folder of its kind."""

    folder: ClassVar[str]

    @classmethod
    def load(cls, path_or_name: str | Path) -> Self:
        """Read one from a YAML file, or a built-in one by its name (`torchcover list`).

        Args:
            path_or_name: A path that ends in .yaml or .yml, or the name of a built-in one.

        Raises:
            FileNotFoundError: No such file, or no built-in one of this name; the message lists the names.
            BadFileError: Not YAML, or a key is unknown, missing, doubled or has a wrong value; the message names the
                file and the key.
        """
        return read_document(cls, find_document(cls.folder, path_or_name))


@guard_reader("a YAML document")
def read_mapping(path: Path) -> dict[str, Any]:
    """The keys of a YAML file and what they hold."""
    content = parse_yaml(read_short_text(path))
    if not isinstance(content, dict):
        raise ValueError(f"a YAML mapping of keys is needed; got {type(content).__name__}")
    return content


def format_validation_error(error: ValidationError) -> str:
    """What pydantic found, in one line: the key, what is wrong, what arrived."""
    details = [detail for detail in error.errors(include_url=False) if not _follows_from_another(detail)]
    meant = _misspelt(details)
    details = [detail for detail in details if detail["loc"] not in meant.values()]
    told = [_told(detail, meant.get(detail["loc"])) for detail in islice(details, MAX_TOLD)]
    more = len(details) - len(told)
    return "; ".join([*told, f"and {more} more mistakes"] if more else told)


def _misspelt(details: Sequence[ErrorDetails]) -> dict[KeyPath, KeyPath]:
    """Unknown keys -> those that are missing at the same place and look like them."""
    missing = [detail["loc"] for detail in details if detail["type"] == "missing"]
    meant: dict[KeyPath, KeyPath] = {}
    for detail in details:
        if detail["type"] != "extra_forbidden":
            continue
        *place, key = detail["loc"]
        there = {str(other[-1]): other for other in missing if list(other[:-1]) == place}
        alike = get_close_matches(str(key)[:MAX_QUOTED], there, n=1)
        if alike and there[alike[0]] not in meant.values():
            meant[detail["loc"]] = there[alike[0]]
    return meant


def _told(detail: ErrorDetails, meant: KeyPath | None = None) -> str:
    if meant:
        return f"{'.'.join(map(str, detail['loc']))}: unknown key; {meant[-1]} is meant, which is missing"
    # None of what is about the whole document; which of several forms was tried is in brackets.
    key = "".join(f"{str(part)[:MAX_QUOTED]}." for part in detail["loc"] if str(part)[:1] != "(")
    arrived = "" if detail["type"] in ("missing", "value_error") else f" (got {_shorten(detail['input'])})"
    words = detail["msg"].removeprefix("Value error, ")
    if detail["type"] != "value_error":  # a list is a tuple to us, and keys with values are some class
        words = re.sub(" after validation| or instance of .*", "", words)
        words = words.replace("Tuple", "List").replace("tuple", "list")
    alike = _alike(str(detail["loc"][-1])[:MAX_QUOTED]) if detail["type"] == "extra_forbidden" else ""
    return f"{key[:-1]}{': ' * bool(key)}{words}{arrived}" + f"; is {alike} meant?" * bool(alike)


def _alike(key: str) -> str:
    """What others call like that, or the key of some document that is it but for a unit, or nearly; else empty."""
    if key in OF_OTHERS:
        return OF_OTHERS[key]
    known = sorted(_keys(Document))
    stem, _, unit = key.rpartition("_")
    with_unit = [name for name in known if name.rpartition("_")[0] == (stem if unit in UNITS else key)]
    return next(iter(with_unit or get_close_matches(key, known, n=1, cutoff=0.8)), "")


def _keys(of: type[BaseModel]) -> set[str]:
    return set(of.model_fields).union(*map(_keys, of.__subclasses__()))


def _follows_from_another(detail: ErrorDetails) -> bool:
    """Whether a list is too short only because what is in it was refused, which is told already."""
    if detail["type"] != "too_short" or not isinstance(detail["input"], Sequence):
        return False
    return len(detail["input"]) >= int(detail["ctx"]["min_length"])


def _beside(path: Any, info: ValidationInfo) -> Any:  # noqa: ANN401  (whatever stood in the file)
    return resolve_path(Path(path), info) if isinstance(path, str) else path


def resolve_path(path: Path, info: ValidationInfo) -> Path:
    """A relative path is meant from the folder of the document that holds it."""
    folder = (info.context or {}).get("folder")
    return folder / path if folder and not path.is_absolute() else path


def _from_anywhere(path_or_name: str | Path) -> str:
    is_path = isinstance(path_or_name, Path) or is_file_name(path_or_name)
    return str(Path(path_or_name).resolve() if is_path else path_or_name)


_WRITTEN = PlainSerializer(_from_anywhere, when_used="json")

RelativePath = Annotated[Path, BeforeValidator(_beside), _WRITTEN]
"""A path in a document; a relative one is meant from the document's folder."""


def resolve_name_or_file(path_or_name: Any, info: ValidationInfo) -> Any:  # noqa: ANN401  (whatever stood in the file)
    """The name of a built-in document, or the path of a YAML file, from the folder of the document that has it."""
    return (
        str(resolve_path(Path(path_or_name), info))
        if isinstance(path_or_name, str) and is_file_name(path_or_name)
        else path_or_name
    )


NameOrFile = Annotated[str, BeforeValidator(resolve_name_or_file), _WRITTEN]
"""The name of a built-in document, or the path of a YAML file, which is meant from the folder of the document."""


SEVERAL = BeforeValidator(lambda given: (given,) if isinstance(given, str) else given)
"""Of a list of words: one stands for a list of one."""


def build_name_validator(document_type: type[BuiltInDocument]) -> BeforeValidator:
    """Of a document within another: its name, if it is built in, or its file stand for it."""

    def read(given: Any, info: ValidationInfo) -> Any:  # noqa: ANN401  (whatever stood in the file)
        try:
            return document_type.load(resolve_name_or_file(given, info)) if isinstance(given, str) else given
        except FileNotFoundError as error:
            raise ValueError(str(error)) from error

    return BeforeValidator(read)


def is_file_name(path_or_name: str | Path) -> bool:
    """Whether it is the path of a YAML file, not the name of a built-in document."""
    return Path(path_or_name).suffix in (".yaml", ".yml")


def suggest_names(name: str, known_names: Sequence[str]) -> str:
    """What may be meant by a name that is not known: at most three that are like it, or the nearest three.

    Example:
        >>> nearest("urbn", ["courtyard", "highway", "parking", "urban"])
        "is 'urban' meant? `torchcover list` has all 4"
    """
    alike = get_close_matches(name, known_names, n=3) or get_close_matches(name, known_names, n=3, cutoff=0.0)
    return f"is {' or '.join(map(repr, alike))} meant? `torchcover list` has all {len(known_names)}"


def find_document(kind: str, path_or_name: str | Path) -> Path:
    """Where a document is: a path that ends in .yaml or .yml, or a built-in one of a kind by its name.

    FileNotFoundError: no built-in one of this name; the message says the nearest. BadFileError: a file of another
    format; the message says how to use it.
    """
    path = Path(path_or_name)
    if is_file_name(path):
        return path
    if remedy := find_remedy(path):
        raise BadFileError(f"{path}: one of the {kind} is a .yaml file; {remedy}")
    builtin = get_builtin_folder(kind) / f"{path_or_name}.yaml"
    if path.name != str(path_or_name) or not builtin.is_file():
        kinds = [other for other in ("rigs", "scenarios", "vehicles", "encounters", "requirements") if other != kind]
        if of := [other for other in kinds if path.name in list_builtin_names(other)]:
            raise FileNotFoundError(f"{path.name!r} is one of the built-in {of[0]}; one of the {kind} is needed")
        raise FileNotFoundError(
            f"{str(path_or_name)!r} is neither a .yaml file nor one of the built-in {kind}; "
            + suggest_names(str(path_or_name), list_builtin_names(kind))
        )
    return builtin


def hash_builtin_documents(kind: str) -> dict[str, str]:
    """The hash of every built-in document of a kind, by its name."""
    return {path.stem: hash_file(path) for path in sorted(get_builtin_folder(kind).glob("*.yaml"))}


@guard_reader("a file")
def hash_file(path: Path) -> str:
    """SHA-256 of what is in a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _content(value: Any) -> Any:  # noqa: ANN401  (whatever a document holds)
    if isinstance(value, Document):
        return value.collect_content()
    if isinstance(value, Path):
        return hash_file(value)
    if isinstance(value, dict):
        return {key: _content(each) for key, each in value.items()}
    return list(map(_content, value)) if isinstance(value, tuple | list) else value


def _shorten(value: Any) -> str:  # noqa: ANN401  (whatever stood in the file)
    text = _QUOTE.repr(value)
    return text if len(text) <= MAX_QUOTED else f"{text[: MAX_QUOTED - 3]}..."


def has_only_numbers(value: object) -> TypeGuard[float | tuple[float, ...]]:
    """Return whether it is a number, or a tuple of numbers."""
    return all(type(each) in (int, float) for each in (value if isinstance(value, tuple) else (value,)))


def _kept(value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, list):
        return tuple(map(_kept, value))
    if isinstance(value, dict):
        return {key: _kept(each) for key, each in value.items()}
    return value.item() if isinstance(value, np.generic) else value
