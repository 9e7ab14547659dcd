"""`torchcover list`."""

from rich.console import Console
from rich.table import Table

from torchcover.simulation import Rig, Scenario, builtin_names


def run() -> None:
    """Print the built-in rigs and scenarios with their descriptions."""
    console = Console()
    for kind, model in (("rigs", Rig), ("scenarios", Scenario)):
        table = Table("name", "description", title=kind, title_justify="left", box=None, padding=(0, 2, 0, 0))
        for name in builtin_names(kind):
            table.add_row(name, model.load(name).description)
        console.print(table)
        console.print()
