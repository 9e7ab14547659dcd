"""`torchcover list`."""

import re

from rich.console import Console
from rich.table import Table

from torchcover.simulation import builtin_descriptions


def run() -> None:
    """Print the built-in rigs, scenarios and LiDAR models, with the first sentence of their descriptions."""
    console = Console()
    for kind in ("rigs", "scenarios", "lidars"):
        table = Table("name", "description", title=kind, title_justify="left", box=None, padding=(0, 2, 0, 0))
        for name, description in builtin_descriptions(kind).items():
            table.add_row(name, _first_sentence(description))
        console.print(table)
        console.print()


def _first_sentence(text: str) -> str:
    # A full stop inside a number or an abbreviation is not followed by a blank and a capital.
    return re.split(r"(?<=[.:;]) (?=[A-Z])", text, maxsplit=1)[0]
