"""What `torchcover search` does and prints."""

import math
from pathlib import Path
from typing import Any

import typer
from rich.console import Console

from torchcover.evaluation import claimed
from torchcover.evaluation.result_files import SUMMARY
from torchcover.placement import ChoiceSpace, CommonInstants, PlacementSearch, SearchPlan, SearchSpace, choose
from torchcover.placement.choice_files import HEADINGS as CHOSEN_HEADINGS
from torchcover.placement.choice_files import chosen_rows, save_choice
from torchcover.placement.choosing import OBJECTIVE
from torchcover.placement.journal import NAME
from torchcover.placement.result_page import HEADINGS, gain_rows
from torchcover.report import narrowest_width, text_table
from torchcover.simulation.documents import read_mapping

CHOICE_KEY = "candidates"
# Of a search, if nothing is given.
BUDGET_S = 30 * 60.0


def run(path: Path, out: Path, *, resume: bool, **settings: Any) -> None:  # noqa: ANN401  (those of `SearchPlan`)
    """Search, write and print what was found: better values of what is free, or a choice of candidates.

    Raises:
        ValueError: A space, an option or a budget that cannot be used.
        FileNotFoundError: An unknown name or file.
    """
    if CHOICE_KEY in read_mapping(path):
        _choose(ChoiceSpace.load(path), out, resume=resume, **settings)
        return
    if settings["budget_s"] is None and settings["evaluations"] is None:
        settings["budget_s"] = BUDGET_S
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


def _choose(space: ChoiceSpace, out: Path, *, resume: bool, **settings: Any) -> None:  # noqa: ANN401
    asked = {
        "--budget": settings["budget_s"] is not None,
        "--evaluations": settings["evaluations"] is not None,
        "--optimiser": settings["optimiser"] != "auto",
        "--resume": resume,
    }
    if useless := [option for option, given in asked.items() if given]:
        raise ValueError(f"{', '.join(useless)}: the {CHOICE_KEY} of this file are all looked at; leave it out")
    plan = SearchPlan(**settings | {"budget_s": math.inf})
    with claimed(out):
        instants = CommonInstants(
            space.scenarios,
            {OBJECTIVE: space.objective},
            worlds=plan.worlds,
            per_world=plan.per_world,
            every_s=plan.every_s,
            seed=plan.seed,
            rays=plan.rays,
            workers=plan.workers,
        )
        with instants:
            found = choose(
                space, instants, test_seed=plan.seed_of_test, fresh_worlds=plan.fresh_worlds, measure=plan.measure
            )
        files = save_choice(found, out)
    table = text_table(CHOSEN_HEADINGS, [chosen_rows(found)], title=f"{space.name}: {len(found.sensors)} candidates")
    console = Console()
    Console(width=max(console.width, narrowest_width([table]))).print(table)
    console.print(f"Wrote {', '.join(file.name for file in files)} to {out}", markup=False, soft_wrap=True)
    console.print(found.sentence, markup=False, soft_wrap=True)
