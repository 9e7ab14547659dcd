"""Messages about mistakes that pydantic finds in files and settings, in the words of this package."""

import re
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from reprlib import Repr
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pydantic import ValidationError
    from pydantic_core import ErrorDetails

# Largest number of characters that a message quotes from a file.
MAX_QUOTED = 60

# Expected value by type of error of pydantic; names in braces are numbers of the error.
_NEEDED = {
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float"), "an integer"),
    **dict.fromkeys(("float_type", "float_parsing"), "a number"),
    **dict.fromkeys(("bool_type", "bool_parsing"), "true or false"),
    **dict.fromkeys(("list_type", "tuple_type"), "a list"),
    **dict.fromkeys(
        ("dict_type", "mapping_type", "model_type", "model_attributes_type", "dataclass_type"), "a mapping"
    ),
    "finite_number": "a finite number",
    "string_type": "a text",
    "string_too_short": "a text of at least {min_length} characters",
    "string_too_long": "a text of at most {max_length} characters",
    "string_pattern_mismatch": "a text of the pattern {pattern}",
    "greater_than": "a number above {gt}",
    "greater_than_equal": "a number of at least {ge}",
    "less_than": "a number below {lt}",
    "less_than_equal": "a number of at most {le}",
    "literal_error": "{expected}",
    "union_tag_invalid": "one of {expected_tags}",
    "union_tag_not_found": "a mapping with the key {discriminator}",
    "too_short": "a list of at least {min_length} items",
    "too_long": "a list of at most {max_length} items",
}

# Keys and list indices from the document to a value.
KeyPath = tuple[int | str, ...]


def explain_validation_error(
    error: "ValidationError", suggest_key: Callable[[str], str] | None = None, max_mistakes: int = 5
) -> list[str]:
    """Explain each mistake that pydantic found in one phrase: the key, the expected value, and the value that arrived.

    Args:
        error: Error of a file or of settings.
        suggest_key: Returns a known key for an unknown one, or an empty text.
        max_mistakes: Number of mistakes to explain; further ones are only counted.

    Returns:
        The phrases.

    Example:
        >>> from pydantic import BaseModel, ValidationError
        >>> class Mount(BaseModel):
        ...     x_m: float
        >>> try:
        ...     Mount.model_validate({"x_m": "wide"})
        ... except ValidationError as error:
        ...     explain_validation_error(error)
        ["x_m: a number is needed; got 'wide'"]
    """
    details = [detail for detail in error.errors(include_url=False) if not _is_consequence(detail)]
    intended_keys = _match_misspelled_keys(details)
    details = [detail for detail in details if detail["loc"] not in intended_keys.values()]
    mistakes = []
    for detail in details[:max_mistakes]:
        # The path is empty if the whole document is wrong; parts in brackets name the tried variant of a type.
        key = ".".join(str(part)[:MAX_QUOTED] for part in detail["loc"] if str(part)[:1] != "(")
        intended_key = intended_keys.get(detail["loc"])
        if intended_key is not None:
            explanation = f"unknown key; {intended_key[-1]} is meant, which is missing"
        else:
            explanation = _explain_mistake(detail, suggest_key)
        mistakes.append(f"{key}: {explanation}" if key else explanation)
    if len(details) > max_mistakes:
        mistakes.append(f"and {len(details) - max_mistakes} more mistakes")
    return mistakes


def _match_misspelled_keys(details: "Sequence[ErrorDetails]") -> dict[KeyPath, KeyPath]:
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


def _explain_mistake(detail: "ErrorDetails", suggest_key: Callable[[str], str] | None) -> str:
    """Explain one mistake without its key."""
    if detail["type"] == "value_error":
        return detail["msg"].removeprefix("Value error, ")
    if detail["type"] == "missing":
        return "a value is needed; the key is missing"
    if detail["type"] == "extra_forbidden":
        similar_key = suggest_key(str(detail["loc"][-1])[:MAX_QUOTED]) if suggest_key else ""
        return f"unknown key; is {similar_key} meant?" if similar_key else "unknown key"
    if detail["type"] in _NEEDED:
        needed = _NEEDED[detail["type"]].format_map(detail.get("ctx", {}))
        needed = re.sub(r"\.0$", "", needed)
    else:  # YAML knows lists and mappings, not tuples and classes
        needed = re.sub("^Input should be | after validation| or instance of .*", "", detail["msg"])
        needed = needed.replace("Tuple", "list").replace("tuple", "list")
    return f"{needed} is needed; got {_shorten(detail['input'])}"


def _is_consequence(detail: "ErrorDetails") -> bool:
    """Return True if a list is too short only because its items were invalid, which other mistakes report."""
    if detail["type"] != "too_short" or not isinstance(detail["input"], Sequence):
        return False
    return len(detail["input"]) >= int(detail["ctx"]["min_length"])


def _shorten(value: Any) -> str:  # noqa: ANN401  (raw content of a file)
    # Reads no more of a value than it prints: YAML aliases can make nested lists of exponential size.
    short_repr = Repr()
    short_repr.maxlevel = 2
    short_repr.maxstring = short_repr.maxlong = short_repr.maxother = MAX_QUOTED
    text = short_repr.repr(value)
    return text if len(text) <= MAX_QUOTED else f"{text[: MAX_QUOTED - 3]}..."
