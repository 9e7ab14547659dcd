"""What the commands print."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from rich.markup import escape

from torchcover.evaluation import MixedResult, Result, Study
from torchcover.evaluation.mixed_result import MIXTURE
from torchcover.evaluation.omissions import build_omissions_table
from torchcover.evaluation.study import WANTED
from torchcover.report import Terminal, print_page_tables, print_table


def print_result(result: Result, files: Sequence[Path], out: Path, *, explain: bool) -> None:
    """The tables, of several kinds of world one after the other, and where the files are."""
    console = Terminal()
    if isinstance(result, MixedResult):
        for name, world in result.scenario_results.items():
            console.rule(escape(name))
            _print_world(world, console, explain=explain)
        console.rule(MIXTURE)
        print_table(result.table, console)
    else:
        _print_world(result, console, explain=explain)
    print_files(files, out, console)
    print_verdict(result.verdict, console)


def print_verdict(sentences: Sequence[str], console: Terminal) -> None:
    """The answer, which is the last thing that is read."""
    for words in sentences:
        console.print(words, markup=False, soft_wrap=True)


def _print_world(result: Result, console: Terminal, *, explain: bool) -> None:
    print_table(result.table, console)
    if result.metrics:
        print_page_tables(result.metrics.build_page_tables(include_parts=False))
    if explain and result.omissions:
        print_page_tables([build_omissions_table(result.omissions)])
    if explain and result.run:
        frames_s = result.run.duration_s - result.run.measurement_s
        console.print(
            f"{frames_s:.1f} s for worlds and rays, {result.run.measurement_s:.1f} s for the search and the sums."
        )
    for line in result.run.skipped_frames if result.run else ():
        console.print(f"skipped: {line}", style="yellow", markup=False)
    for line in result.target_error_lines:
        console.print(line, markup=False, soft_wrap=True)


def print_files(files: Sequence[Path], out: Path, console: Terminal) -> None:
    """Which files were written: in folders, how many."""
    inside = Counter(path.parent.name for path in files if path.parent != out)
    words = [
        *(f"{count} files in {name}/" for name, count in inside.items()),
        *(path.name for path in files if path.parent == out),
    ]
    console.print(f"Wrote {', '.join(words)} to {out}", markup=False, soft_wrap=True)


def print_study(study: Study, files: Sequence[Path], out: Path) -> None:
    """The tables, and the settings that are recommended."""
    console = Terminal()
    print_page_tables(study.tables)
    for wanted in WANTED:
        console.print(study.format_recommendation(wanted), markup=False, soft_wrap=True)
    print_files(files, out, console)
