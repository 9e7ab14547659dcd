"""What `torchcover search` does and prints."""

import math
from pathlib import Path
from typing import Any

import typer

from torchcover.cli.printing import print_files
from torchcover.evaluation.cpu_cores import compute_num_workers
from torchcover.files import SUMMARY, lock_folder
from torchcover.placement import (
    PlacementSearch,
    SearchPlan,
    SearchResult,
    SearchSpace,
    SelectionResult,
    SelectionSpace,
    run_search,
    run_selection,
)
from torchcover.placement.plan import make_common_frames
from torchcover.placement.running import JOURNAL
from torchcover.report import Terminal, print_page_tables
from torchcover.simulation.documents import read_mapping

CHOICE_KEY = "candidates"
# Of a search, if nothing is given.
BUDGET_S = 30 * 60.0
FRAMES = 1000  # approximate number of frames that a search scores


def run_search_command(
    space_file: Path,
    out: Path,
    *,
    resume: bool,
    file_kinds: str,
    **settings: Any,  # noqa: ANN401  (those of `SearchPlan`)
) -> None:
    """Search, write and print what was found: better values of what is free, or a choice of candidates.

    Raises:
        ValueError: A space, an option or a budget that cannot be used.
        FileNotFoundError: An unknown name or file.
    """
    find = _chosen if CHOICE_KEY in read_mapping(space_file) else _searched
    settings = {
        "num_workers": compute_num_workers(
            FRAMES, settings.get("num_scenes", SearchPlan.num_scenes), sends_frames=False
        ),
        **settings,
    }
    with lock_folder(out):
        report = find(space_file, out, resume=resume, **settings).report
        written = report.save(out, files=file_kinds)
    print_page_tables(report.tables[:2])
    console = Terminal()
    print_files(written, out, console)
    console.print(report.summary, markup=False, soft_wrap=True)


def _searched(path: Path, out: Path, *, resume: bool, **settings: Any) -> SearchResult:  # noqa: ANN401
    if settings["budget_s"] is None and settings["num_evaluations"] is None:
        settings["budget_s"] = BUDGET_S
    search = PlacementSearch(SearchSpace.load(path), SearchPlan(**settings))
    journal = out / JOURNAL
    if resume and not journal.exists():
        typer.echo(f"torchcover: {journal} is not there: the search starts with its first candidate", err=True)
    elif not resume and journal.exists() and not (out / SUMMARY).exists():
        typer.echo(f"torchcover: {journal} will be replaced; to go on from it, stop now and add --resume", err=True)
    return run_search(search, out, resume=resume, progress=True)


def _chosen(path: Path, out: Path, *, resume: bool, **settings: Any) -> SelectionResult:  # noqa: ANN401
    asked = {
        "--budget": settings["budget_s"] is not None,
        "--num-evaluations": settings["num_evaluations"] is not None,
        "--resume": resume,
    }
    if useless := [option for option, given in asked.items() if given]:
        raise ValueError(f"{', '.join(useless)}: the {CHOICE_KEY} of this file are all looked at; leave it out")
    space, plan = SelectionSpace.load(path), SearchPlan(**settings | {"budget_s": math.inf})
    with make_common_frames(space, plan, plan.seed, plan.num_scenes) as frames:
        return run_selection(
            space, frames, test_seed=plan.test_seed, num_held_out_scenes=plan.num_held_out_scenes, progress=True
        )
