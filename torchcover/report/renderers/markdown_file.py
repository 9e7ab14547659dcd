"""A table as Markdown, for documents and web pages."""

import re
from collections.abc import Iterable, Iterator

from torchcover.files import shown
from torchcover.report.remarks import marks_on, notes_on
from torchcover.report.renderers.layout import BOLD_MARKS, PageTable, Words, parts_of
from torchcover.report.table import CoverageTable
from torchcover.report.verdict import verdict

# What Markdown would take for something else: an underscore does so at the end of a word only.
SPECIAL = re.compile(r"[\\`*|\[\]]|<(?=[A-Za-z/!?])|&(?=[\w#]+;)|(?<![^\W_])_|_(?![^\W_])")


def render(table: CoverageTable) -> str:
    """The table as Markdown text; what is marked is bold."""
    marks = [f"{BOLD_MARKS[mark]}: {meaning}" for mark, meaning in marks_on(table).items()]
    notes = [f"* {escaped(note)}" for note in (*marks, *notes_on(table))]
    told = escaped(" ".join(verdict(table)))
    first = [told, ""] if told else []
    return "\n".join([*first, *(line for part in parts_of(table) for line in _lines(part)), *notes, ""])


def _lines(part: PageTable) -> Iterator[str]:
    if part.title:
        yield f"{escaped(part.title)}\n"
    yield _line(map(escaped, part.headings))
    yield _line(["---"] * part.words_first + ["---:"] * (len(part.headings) - part.words_first))
    yield from (_line(map(_cell, row)) for row in part.rows)
    yield ""


def _cell(cell: Words) -> str:
    return f"**{escaped(cell.text)}**" if cell.mark else escaped(cell.text)


def escaped(words: str) -> str:
    """Words that Markdown takes for nothing else."""
    return SPECIAL.sub(r"\\\g<0>", shown(" ".join(words.split())))


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"
