"""Words of others, such as names in files and of folders, safe to show."""

import re

# Of terminals: control characters, and marks that turn the direction of what follows. Lines and tabs may stay.
CONTROLS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
# What makes a formula of a cell in spreadsheets.
FORMULA = re.compile(r"[=+\-@\t\r]")
NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?(e[+-]?\d+)?|inf)", re.IGNORECASE)
# What makes text of it again.
QUOTE = "'"


def shown(text: str) -> str:
    r"""Text whose control characters are written out.

    Example:
        >>> print(shown("roof\x1b[2J"))
        roof\x1b[2J
    """
    return CONTROLS.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def as_cell(value: object) -> object:
    """A value as a cell of a spreadsheet: text that begins like a formula begins with a quote, numbers stay.

    Example:
        >>> as_cell("=1+1"), as_cell(-1.5)
        ("'=1+1", -1.5)
    """
    if not isinstance(value, str):
        return value
    return f"{QUOTE * _is_formula(value)}{shown(value)}"


def of_cell(text: str) -> str:
    """The text that `as_cell` made a cell of."""
    return text[1:] if text[:1] == QUOTE and _is_formula(text[1:]) else text


def _is_formula(text: str) -> bool:
    return FORMULA.match(text.lstrip(QUOTE)) is not None and NUMBER.fullmatch(text) is None
