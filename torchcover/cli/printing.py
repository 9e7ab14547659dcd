"""Output of commands on the terminal."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from rich.markup import escape

from torchcover.evaluation import MixedResult, Result, Study
from torchcover.evaluation.mixed_result import MIXTURE
from torchcover.evaluation.omissions import build_omissions_table
from torchcover.report import Terminal, print_page_tables, print_table


def print_result(result: Result, files: Sequence[Path], out: Path, *, explain: bool) -> None:
    """Print the table of a result, or the tables of several scenarios one after another, and the written files.

    Args:
        result: The result.
        files: Written files.
        out: Folder of the files.
        explain: Print omissions and run time.
    """
    console = Terminal()
    if isinstance(result, MixedResult):
        for name, scenario_result in result.scenario_results.items():
            console.rule(escape(name))
            _print_scenario(scenario_result, console, explain=explain)
        console.rule(MIXTURE)
        print_table(result.table, console)
    else:
        _print_scenario(result, console, explain=explain)
    print_files(files, out, console)
    print_verdict(result.verdict, console)


def print_verdict(sentences: Sequence[str], console: Terminal) -> None:
    """Print the findings; they come last because the end of an output is read first.

    Args:
        sentences: The findings.
        console: Terminal.
    """
    for sentence in sentences:
        console.print(sentence, markup=False, soft_wrap=True)


def _print_scenario(result: Result, console: Terminal, *, explain: bool) -> None:
    """Print the result of one scenario or recording."""
    print_table(result.table, console)
    if result.metrics:
        print_page_tables(result.metrics.build_page_tables(include_parts=False))
    if explain and result.omissions:
        print_page_tables([build_omissions_table(result.omissions)])
    if result.run:
        if explain:
            frames_s = result.run.duration_s - result.run.measurement_s
            console.print(
                f"{frames_s:.1f} s for scenes and rays, {result.run.measurement_s:.1f} s for the search and the sums."
            )
        for message in result.run.skipped_frames:
            console.print(f"skipped: {message}", style="yellow", markup=False)
    print_verdict(result.target_error_lines, console)


def print_files(files: Sequence[Path], out: Path, console: Terminal) -> None:
    """Print the names of written files, and the number of files in each subfolder.

    Args:
        files: The files.
        out: Folder of the results.
        console: Terminal.
    """
    folder_counts = Counter(path.parent.name for path in files if path.parent != out)
    items = [f"{count} files in {name}/" for name, count in folder_counts.items()]
    items += [path.name for path in files if path.parent == out]
    console.print(f"Wrote {', '.join(items)} to {out}", markup=False, soft_wrap=True)


def print_study(study: Study, files: Sequence[Path], out: Path) -> None:
    """Print the tables and recommendations of a study, and the written files.

    Args:
        study: The study.
        files: Written files.
        out: Folder of the files.
    """
    console = Terminal()
    print_page_tables(study.tables)
    print_verdict([study.format_recommendation(error) for error in study.plan.params.target_errors], console)
    print_files(files, out, console)
