"""`torchcover list`."""

import re
import shutil
import sys
import textwrap
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import typer

from torchcover.simulation import load_builtin_documents


def print_builtin(search_text: str | None) -> None:
    """Print what is built in: the names of each kind.

    Args:
        search_text: A kind: what each of it consists of, and its first sentence. Or only those with it in a column, and all
            that is said of them.

    Raises:
        ValueError: There is none with that word.
    """
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
    kinds = {
        "rigs": _sensors,
        "scenarios": _traffic,
        "lidars": _rows,
        "vehicles": None,
        "materials": lambda material: str(material["reflectivity"]),
        "weather": None,
        "encounters": None,
        "requirements": None,
    }
    found = False
    for kind, what_of in kinds.items():
        if search_text in kinds and search_text != kind:
            continue
        documents = load_builtin_documents(kind)
        if search_text is None:
            names = textwrap.fill(", ".join(documents), width or 80, initial_indent="  ", subsequent_indent="  ")
            typer.echo(f"{kind} ({len(documents)})\n{names}\n")
            continue
        rows = []
        for name, document in documents.items():
            cells = [name, what_of(document)] if what_of else [name]
            description = " ".join(document["description"].split())
            if search_text == kind or search_text.lower() in " ".join((*cells, description)).lower():
                rows.append((*cells, _first_sentence(description) if search_text == kind else description))
        if rows:
            typer.echo("\n".join((kind, *_lines(rows, width, one_line_each=search_text == kind))) + "\n")
            found = True
    if search_text is None:
        typer.echo("What each of a kind is: torchcover list rigs; all that is said of one: torchcover list NAME")
    elif not found:
        raise ValueError(f"nothing built in with {search_text!r}; torchcover list prints all there is")


def _lines(rows: list[tuple[str, ...]], width: int | None, *, one_line_each: bool) -> Iterator[str]:
    """The rows under each other; what does not fit is cut off, or goes on in the last column."""
    *short, _ = zip(*rows, strict=True)
    widths = [max(map(len, cells)) for cells in short]
    for *cells, description in rows:
        before = "  ".join(("", *(f"{cell:{most}}" for cell, most in zip(cells, widths, strict=True)), ""))
        room = max(20, width - len(before)) if width else max(1, len(description))
        shown = f"{description[: room - 1]}…" if one_line_each and len(description) > room else description
        yield textwrap.fill(shown, len(before) + room, initial_indent=before, subsequent_indent=" " * len(before))


def _sensors(rig: Mapping[str, Any]) -> str:
    types = Counter(sensor["type"] for sensor in rig["sensors"])
    words = {"lidar": "LiDAR", "camera": "camera"}
    return ", ".join(f"{count} {words.get(kind, kind)}{'s' * (count > 1)}" for kind, count in types.items())


def _traffic(scenario: Mapping[str, Any]) -> str:
    return f"{scenario['traffic']['type']} traffic" if "traffic" in scenario else "static"


def _rows(lidar: Mapping[str, Any]) -> str:
    rows = lidar["channels"] if "channels" in lidar else len(lidar["elevations_deg"])
    return f"{rows} rows, {lidar['max_range_m']:g} m"


def _first_sentence(text: str) -> str:
    # A full stop inside a number or an abbreviation is not followed by a blank and a capital.
    return re.split(r"(?<=[.:;]) (?=[A-Z])", text, maxsplit=1)[0]
