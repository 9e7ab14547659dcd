"""Messages about mistakes in YAML documents: pydantic's errors in one line, with suggestions for misspelled keys."""

import re
from collections.abc import Sequence
from difflib import get_close_matches
from itertools import islice
from reprlib import Repr
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

# Keys of other formats -> keys of this package.
FOREIGN_KEYS = {
    **dict.fromkeys(("xyz", "position", "translation", "location"), "x_m, y_m, z_m"),
    **dict.fromkeys(("rpy", "euler"), "roll_deg, pitch_deg, yaw_deg"),
    **dict.fromkeys(("rotation", "orientation", "quaternion"), "quaternion_wxyz, or roll_deg, pitch_deg, yaw_deg,"),
    **dict.fromkeys(("rows", "beams", "lines", "layers"), "channels"),
    **dict.fromkeys(("lidars", "cameras", "radars"), "sensors"),
    "fov": "horizontal_fov_deg, vertical_fov_deg or, of a camera, fov_deg",
    "resolution": "width, height",
    "range": "max_range_m",
}
# Suffixes of keys that are units.
UNITS = ("rad", "deg", "mm", "cm", "m", "km", "ft", "in", "s", "ms", "hz", "mps", "kmh")
# Largest number of characters that a message quotes from a file.
MAX_QUOTED = 60
# Reads no more of a value than it prints: YAML aliases can make nested lists of exponential size.
_SHORT_REPR = Repr()
_SHORT_REPR.maxlevel = 2
_SHORT_REPR.maxstring = _SHORT_REPR.maxlong = _SHORT_REPR.maxother = MAX_QUOTED

# Keys and list indices from the document to a value.
KeyPath = tuple[int | str, ...]


def format_validation_error(error: ValidationError, max_mistakes: int = 5) -> str:
    """Format an error of pydantic in one line: for each mistake the key, the reason, and the value that arrived.

    Args:
        error: Error of a document.
        max_mistakes: Number of mistakes to list; further ones are only counted.
    """
    details = [detail for detail in error.errors(include_url=False) if not _is_consequence(detail)]
    intended_keys = _match_misspelled_keys(details)
    details = [detail for detail in details if detail["loc"] not in intended_keys.values()]
    messages = [_format_mistake(detail, intended_keys.get(detail["loc"])) for detail in islice(details, max_mistakes)]
    if len(details) > len(messages):
        messages.append(f"and {len(details) - len(messages)} more mistakes")
    return "; ".join(messages)


def _match_misspelled_keys(details: Sequence[ErrorDetails]) -> dict[KeyPath, KeyPath]:
    """Match unknown keys with similar missing keys of the same mapping."""
    missing_keys = [detail["loc"] for detail in details if detail["type"] == "missing"]
    intended_keys: dict[KeyPath, KeyPath] = {}
    for detail in details:
        if detail["type"] != "extra_forbidden":
            continue
        *parent, key = detail["loc"]
        candidates = {str(path[-1]): path for path in missing_keys if list(path[:-1]) == parent}
        matches = get_close_matches(str(key)[:MAX_QUOTED], candidates, n=1)
        if matches and candidates[matches[0]] not in intended_keys.values():
            intended_keys[detail["loc"]] = candidates[matches[0]]
    return intended_keys


def _format_mistake(detail: ErrorDetails, intended_key: KeyPath | None = None) -> str:
    if intended_key:
        return f"{'.'.join(map(str, detail['loc']))}: unknown key; {intended_key[-1]} is meant, which is missing"
    # The path is empty if the mistake concerns the whole document; parts in brackets name the tried variant of a type.
    key = "".join(f"{str(part)[:MAX_QUOTED]}." for part in detail["loc"] if str(part)[:1] != "(")
    value = "" if detail["type"] in ("missing", "value_error") else f" (got {_shorten(detail['input'])})"
    reason = detail["msg"].removeprefix("Value error, ")
    suggestion = ""
    if detail["type"] == "extra_forbidden":
        reason = "unknown key"
        similar_key = _suggest_key(str(detail["loc"][-1])[:MAX_QUOTED])
        suggestion = f"; is {similar_key} meant?" if similar_key else ""
    elif detail["type"] != "value_error":  # YAML knows lists and mappings, not tuples and classes
        reason = re.sub(" after validation| or instance of .*", "", reason)
        reason = reason.replace("Tuple", "List").replace("tuple", "list")
    return f"{key[:-1]}{': ' * bool(key)}{reason}{value}{suggestion}"


def _suggest_key(key: str) -> str:
    """Suggest a key for an unknown one: a translation, the key with another unit, or a similar key; empty if none."""
    from torchcover.simulation.documents import Document  # imports this module

    if key in FOREIGN_KEYS:
        return FOREIGN_KEYS[key]
    known_keys = sorted(_collect_keys(Document))
    stem, _, unit = key.rpartition("_")
    quantity = stem if unit in UNITS else key
    same_quantity = [name for name in known_keys if name.rpartition("_")[0] == quantity]
    return next(iter(same_quantity or get_close_matches(key, known_keys, n=1, cutoff=0.8)), "")


def _collect_keys(document_type: type[BaseModel]) -> set[str]:
    """Collect the keys of a type and all its subclasses."""
    keys = set(document_type.model_fields)
    for subclass in document_type.__subclasses__():
        keys |= _collect_keys(subclass)
    return keys


def _is_consequence(detail: ErrorDetails) -> bool:
    """Return True if a list is too short only because its items were invalid, which other mistakes report."""
    if detail["type"] != "too_short" or not isinstance(detail["input"], Sequence):
        return False
    return len(detail["input"]) >= int(detail["ctx"]["min_length"])


def _shorten(value: Any) -> str:  # noqa: ANN401  (raw content of a file)
    text = _SHORT_REPR.repr(value)
    return text if len(text) <= MAX_QUOTED else f"{text[: MAX_QUOTED - 3]}..."
