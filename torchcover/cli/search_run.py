"""What `torchcover search` does and prints."""

import math
from pathlib import Path
from typing import Any

import typer

from torchcover.cli.printing import print_files
from torchcover.evaluation.cores import usual_workers
from torchcover.files import SUMMARY, lock_folder
from torchcover.placement import (
    ChoiceSpace,
    PlacementSearch,
    SearchPlan,
    SearchResult,
    SearchSpace,
    SensorChoice,
    choose,
    run_search,
)
from torchcover.placement.common_instants import WORLDS
from torchcover.placement.plan import common_instants
from torchcover.placement.running import CHECKPOINT
from torchcover.report import Terminal, print_whole
from torchcover.simulation.documents import read_mapping

CHOICE_KEY = "candidates"
# Of a search, if nothing is given.
BUDGET_S = 30 * 60.0
# As many as a search looks at, about: each of its instants a hundred times or more.
FRAMES = 1000


def run(
    path: Path,
    out: Path,
    *,
    resume: bool,
    files: str,
    **settings: Any,  # noqa: ANN401  (those of `SearchPlan`)
) -> None:
    """Search, write and print what was found: better values of what is free, or a choice of candidates.

    Raises:
        ValueError: A space, an option or a budget that cannot be used.
        FileNotFoundError: An unknown name or file.
    """
    find = _chosen if CHOICE_KEY in read_mapping(path) else _searched
    settings = {"workers": usual_workers(FRAMES, settings.get("worlds", WORLDS), whole=False), **settings}
    with lock_folder(out):
        report = find(path, out, resume=resume, **settings).report
        written = report.save(out, files=files)
        if not resume:
            (out / CHECKPOINT).unlink(missing_ok=True)  # there is nothing left that would go on from it
    print_whole(report.tables[:2])
    console = Terminal()
    print_files(written, out, console)
    console.print(report.sentence, markup=False, soft_wrap=True)


def _searched(path: Path, out: Path, *, resume: bool, **settings: Any) -> SearchResult:  # noqa: ANN401
    if settings["budget_s"] is None and settings["evaluations"] is None:
        settings["budget_s"] = BUDGET_S
    search = PlacementSearch(SearchSpace.load(path), SearchPlan(**settings))
    if resume and not (out / CHECKPOINT).exists():
        typer.echo(f"torchcover: {out / CHECKPOINT} is not there: the search starts with its first candidate", err=True)
    elif not resume and (out / CHECKPOINT).exists() and not (out / SUMMARY).exists():
        left = f"{out / CHECKPOINT} will be replaced; to go on from it, stop now and add --resume"
        typer.echo(f"torchcover: {left}", err=True)
    return run_search(search, out, resume=resume, progress=True)


def _chosen(path: Path, out: Path, *, resume: bool, **settings: Any) -> SensorChoice:  # noqa: ANN401
    asked = {
        "--budget": settings["budget_s"] is not None,
        "--evaluations": settings["evaluations"] is not None,
        "--optimiser": settings["optimiser"] != "gp",
        "--resume": resume,
    }
    if useless := [option for option, given in asked.items() if given]:
        raise ValueError(f"{', '.join(useless)}: the {CHOICE_KEY} of this file are all looked at; leave it out")
    space, plan = ChoiceSpace.load(path), SearchPlan(**settings | {"budget_s": math.inf})
    with common_instants(space, plan, plan.seed, plan.worlds) as instants:
        return choose(space, instants, test_seed=plan.seed_of_test, fresh_worlds=plan.fresh_worlds, progress=True)
