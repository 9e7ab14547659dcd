"""What `torchcover search` does and prints."""

from pathlib import Path
from typing import Any

import typer
from rich.console import Console

from torchcover.evaluation import claimed
from torchcover.evaluation.result_files import SUMMARY
from torchcover.placement import PlacementSearch, SearchPlan, SearchSpace
from torchcover.placement.journal import NAME
from torchcover.placement.result_page import HEADINGS, gain_rows
from torchcover.report import narrowest_width, text_table


def run(path: Path, out: Path, *, resume: bool, **settings: Any) -> None:  # noqa: ANN401  (those of `SearchPlan`)
    """Search, write and print what was found.

    Raises:
        ValueError: A space, an option or a budget that cannot be used.
        FileNotFoundError: An unknown name or file.
    """
    search = PlacementSearch(SearchSpace.load(path), SearchPlan(**settings))
    if resume and not (out / NAME).exists():
        typer.echo(f"torchcover: {out / NAME} is not there: the search starts with its first candidate", err=True)
    elif not resume and (out / NAME).exists() and not (out / SUMMARY).exists():
        typer.echo(f"torchcover: {out / NAME} will be replaced; to go on from it, stop now and add --resume", err=True)
    with claimed(out):
        result = search.run(out, resume=resume, progress=True)
        files = result.save(out)
    table = text_table(HEADINGS, [gain_rows(result)], title=f"{search.space.name}: against {search.space.start.name}")
    console = Console()
    Console(width=max(console.width, narrowest_width([table]))).print(table)
    console.print(f"Wrote {', '.join(file.name for file in files)} to {out}", markup=False, soft_wrap=True)
    console.print(result.sentence, markup=False, soft_wrap=True)
