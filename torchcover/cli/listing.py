"""Command `torchcover list`."""

import re
import shutil
import sys
import textwrap
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import typer

from torchcover.simulation import load_builtin_documents

Document = Mapping[str, Any]


def print_builtin(search_text: str | None) -> None:
    """Print built-in items.

    Args:
        search_text: None: the names of all kinds. A kind: its items with properties and first sentence of their
            descriptions. Another text: items that contain it, with complete descriptions.

    Raises:
        ValueError: No item contains the text.
    """
    # A pipe or file gets complete lines.
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
    # Kind -> function that describes the properties of an item; None for a kind without properties.
    kinds: dict[str, Callable[[Document], str] | None] = {
        "rigs": _describe_sensors,
        "scenarios": _describe_traffic,
        "lidars": _describe_lidar,
        "vehicles": None,
        "materials": _describe_material,
        "weather": None,
        "encounters": None,
        "requirements": None,
    }
    has_match = False
    for kind, describe in kinds.items():
        if search_text in kinds and search_text != kind:
            continue
        documents = load_builtin_documents(kind)
        if search_text is None:
            names = textwrap.fill(", ".join(documents), width or 80, initial_indent="  ", subsequent_indent="  ")
            typer.echo(f"{kind} ({len(documents)})\n{names}\n")
            continue
        rows = []
        for name, document in documents.items():
            cells = [name, describe(document)] if describe else [name]
            description = " ".join(document["description"].split())
            if search_text == kind:
                rows.append((*cells, _get_first_sentence(description)))
            elif search_text.lower() in " ".join((*cells, description)).lower():
                rows.append((*cells, description))
        if rows:
            lines = _format_rows(rows, width, is_shortened=search_text == kind)
            typer.echo("\n".join((kind, *lines)) + "\n")
            has_match = True
    if search_text is None:
        typer.echo("Items of a kind: torchcover list rigs; description of an item: torchcover list NAME")
    elif not has_match:
        raise ValueError(f"nothing built in contains {search_text!r}; `torchcover list` prints all names")


def _format_rows(rows: list[tuple[str, ...]], width: int | None, *, is_shortened: bool) -> Iterator[str]:
    """Format rows in columns; a description that does not fit is shortened to one line, or continues on the next."""
    columns = list(zip(*rows, strict=True))[:-1]
    widths = [max(len(cell) for cell in column) for column in columns]
    for *cells, description in rows:
        padded = [f"{cell:{cell_width}}" for cell, cell_width in zip(cells, widths, strict=True)]
        start = "  ".join(("", *padded, ""))
        room = max(20, width - len(start)) if width else max(1, len(description))
        text = f"{description[: room - 1]}…" if is_shortened and len(description) > room else description
        yield textwrap.fill(text, len(start) + room, initial_indent=start, subsequent_indent=" " * len(start))


def _describe_sensors(rig: Document) -> str:
    """Count the sensors of a rig by type."""
    labels = {"lidar": "LiDAR", "camera": "camera"}
    counts = Counter(sensor["type"] for sensor in rig["sensors"])
    items = []
    for sensor_type, count in counts.items():
        plural = "s" if count > 1 else ""
        items.append(f"{count} {labels.get(sensor_type, sensor_type)}{plural}")
    return ", ".join(items)


def _describe_traffic(scenario: Document) -> str:
    """Name the kind of traffic of a scenario."""
    return f"{scenario['traffic']['type']} traffic" if "traffic" in scenario else "static"


def _describe_lidar(lidar: Document) -> str:
    """State channels and maximum range of a LiDAR model."""
    num_channels = lidar["channels"] if "channels" in lidar else len(lidar["elevations_deg"])
    return f"{num_channels} channels, {lidar['max_range_m']:g} m"


def _describe_material(material: Document) -> str:
    """State the reflectivity of a material."""
    return f"reflectivity {material['reflectivity']}"


def _get_first_sentence(text: str) -> str:
    """Return the first sentence, or its part before a colon or semicolon."""
    # The full stop of a number or an abbreviation is not followed by a blank and a capital.
    return re.split(r"(?<=[.:;]) (?=[A-Z])", text, maxsplit=1)[0]
