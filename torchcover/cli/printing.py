"""What the commands print."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from rich.markup import escape

from torchcover.evaluation import AgreementStudy, MixedResult, Result, Study, relation, verdict
from torchcover.evaluation.agreeing import NOTES
from torchcover.evaluation.mixed import MIXTURE
from torchcover.evaluation.result import sensor_model_words
from torchcover.evaluation.result_page import left_out_table
from torchcover.evaluation.study import WANTED
from torchcover.published.comparison import page_tables
from torchcover.report import PageTable, Terminal, Words, print_table, print_whole


def print_result(result: Result, files: Sequence[Path], out: Path, *, explain: bool) -> None:
    """The tables, of several kinds of world one after the other, and where the files are."""
    console = Terminal()
    if isinstance(result, MixedResult):
        for name, world in result.worlds.items():
            console.rule(escape(name))
            _print_world(world, console, explain=explain)
        console.rule(MIXTURE)
        print_table(result.table, console)
    else:
        _print_world(result, console, explain=explain)
    print_files(files, out, console)


def _print_world(result: Result, console: Terminal, *, explain: bool) -> None:
    print_table(result.table, console)
    if result.metrics:
        print_whole(page_tables(result.metrics, parts=False))
    if explain and result.left_out:
        print_whole([left_out_table(result.left_out)])
    if explain and result.run:
        frames_s = result.run.seconds - result.run.measuring_s
        console.print(
            f"{frames_s:.1f} s for worlds and rays, {result.run.measuring_s:.1f} s for the search and the sums."
        )
    for line in result.run.skipped if result.run else ():
        console.print(f"skipped: {line}", style="yellow", markup=False)
    for line in result.target_lines:
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
    print_whole(study.tables)
    for wanted in WANTED:
        console.print(study.advice(wanted), markup=False, soft_wrap=True)
    print_files(files, out, console)


DETECTORS_ONLY = "* an interval over detectors only: of worlds there are none, or too few"


def print_agreement(study: AgreementStudy, files: Sequence[Path], out: Path) -> None:
    """How metrics rank the placements, for each thing that detectors say of them, and the notes."""
    console = Terminal()
    truths = list(dict.fromkeys(truth for truth, _ in study.found))
    readings = list(dict.fromkeys(reading for _, reading in study.found))
    tables = []
    for reading in readings:
        each = [study.found[truth, reading].ranked for truth in truths]
        rows = [
            [Words(of[0].metric + " *" * (not of[0].over_worlds)), *(Words(relation(row.spearman)) for row in of)]
            for of in zip(*each, strict=True)
        ]
        title = f"Spearman correlation with what detectors reached, rolls in {reading}; 95 % intervals"
        tables.append(PageTable(title, ("metric", *truths), rows, notes=[DETECTORS_ONLY]))
    print_whole(tables)
    for truth in truths:
        console.print(verdict(truth, {one: study.found[truth, one] for one in readings}), markup=False, soft_wrap=True)
    for note in (*sensor_model_words(study.scores.sensor_models), *NOTES):
        console.print(note, markup=False, soft_wrap=True)
    print_files(files, out, console)
