"""Implementation of `torchcover search`."""

import math
from pathlib import Path
from typing import Any

import typer

from torchcover.cli.printing import print_files, print_verdict
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

# Key that only a file of sensor candidates has.
SELECTION_KEY = "candidates"


def run_search_command(
    space_file: Path,
    out: Path,
    *,
    resume: bool,
    file_kinds: str,
    **settings: Any,  # noqa: ANN401  (those of `SearchPlan`)
) -> None:
    """Run a search or a sensor selection, save the result and print it.

    Args:
        space_file: YAML file of the search space or of the candidates.
        out: Folder of the results.
        resume: Continue the search whose journal is in the folder.
        file_kinds: Files in addition to `summary.json`.
        settings: Arguments of `SearchPlan`.

    Raises:
        ValueError: Invalid file, option or budget.
        FileNotFoundError: Unknown name or file.
    """
    run = _select if SELECTION_KEY in read_mapping(space_file) else _search
    if "num_workers" not in settings:
        num_scenes = settings.get("num_scenes", SearchPlan.num_scenes)
        # A search scores about 1,000 frames.
        settings["num_workers"] = compute_num_workers(1000, num_scenes, sends_frames=False)
    with lock_folder(out):
        report = run(space_file, out, resume=resume, **settings).report
        written = report.save(out, files=file_kinds)
    # The page has further tables.
    print_page_tables(report.tables[:2])
    console = Terminal()
    print_files(written, out, console)
    print_verdict([report.summary], console)


def _search(path: Path, out: Path, *, resume: bool, **settings: Any) -> SearchResult:  # noqa: ANN401
    """Search a space, for 30 minutes by default."""
    if settings["budget_s"] is None and settings["num_evaluations"] is None:
        settings["budget_s"] = 30 * 60.0
    search = PlacementSearch(SearchSpace.load(path), SearchPlan(**settings))
    journal = out / JOURNAL
    if resume and not journal.exists():
        typer.echo(f"torchcover: {journal} does not exist: the search starts with its first candidate", err=True)
    elif not resume and journal.exists() and not (out / SUMMARY).exists():
        typer.echo(f"torchcover: {journal} will be replaced; to continue from it, stop now and add --resume", err=True)
    return run_search(search, out, resume=resume, progress=True)


def _select(path: Path, out: Path, *, resume: bool, **settings: Any) -> SelectionResult:  # noqa: ANN401
    """Select sensors from candidates."""
    unused = {
        "--budget": settings["budget_s"] is not None,
        "--num-evaluations": settings["num_evaluations"] is not None,
        "--resume": resume,
    }
    useless = [option for option, has_value in unused.items() if has_value]
    if useless:
        raise ValueError(
            f"{', '.join(useless)}: has no effect, because all {SELECTION_KEY} of this file are evaluated; omit it"
        )
    # A selection ends by itself, but every plan has a budget.
    space, plan = SelectionSpace.load(path), SearchPlan(**settings | {"budget_s": math.inf})
    with make_common_frames(space, plan, plan.seed, plan.num_scenes) as frames:
        return run_selection(
            space, frames, test_seed=plan.test_seed, num_held_out_scenes=plan.num_held_out_scenes, progress=True
        )
