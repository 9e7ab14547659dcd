"""A comparison of metrics in words: for a terminal, a page, JSON and CSV."""

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

from rich.table import Table

from torchcover.estimation import Number
from torchcover.published.comparison import COLUMNS, MetricComparison, Tau
from torchcover.published.ranks import Ranking
from torchcover.report import PageTable, Words, number_words, shown_unit, text_table

TITLE, TAU_TITLE = "Metrics of others (rank)", "Kendall's tau-b with torchcover's numbers, 95 % over worlds"


def page_tables(comparison: MetricComparison) -> list[PageTable]:
    """All numbers, those of parts too; and the taus, if there are any."""
    several = len(comparison.rigs) > 1
    headings = ["metric", "unit", "better", *comparison.rigs]
    rows = [[Words(word) for word in _row(one, several)] for one in comparison.rankings]
    tables = [PageTable(TITLE if several else "Metrics of others", headings, rows, 3, comparison.notes)]
    if taus := _tau_rows(comparison):
        tau_rows = [[Words(word) for word in row] for row in taus]
        tables.append(PageTable(TAU_TITLE, ["metric", *(own.name for own in _shown(comparison))], tau_rows))
    return tables


def text_tables(comparison: MetricComparison) -> list[Table]:
    """The main numbers, and the taus, for `rich.console.Console.print`."""
    several = len(comparison.rigs) > 1
    headings = ["metric", "unit", "better", *comparison.rigs]
    by_metric: dict[str, list[list[str]]] = {}
    for one in comparison.main:
        by_metric.setdefault(one.metric, []).append(_row(one, several))
    title = TITLE if several else "Metrics of others"
    tables = [text_table(headings, by_metric.values(), title=title, caption="\n".join(comparison.notes))]
    if taus := _tau_rows(comparison):
        tables.append(text_table(["metric", *(own.name for own in _shown(comparison))], [taus], title=TAU_TITLE))
    return tables


def record(comparison: MetricComparison) -> dict[str, Any]:
    """As `summary.json` has it: what is unknown is None."""
    return {
        "numbers": [_plain(row) for row in comparison.rows()],
        "tau": [_plain(tau._asdict()) for tau in comparison.taus()],
        "notes": comparison.notes,
    }


def numbers_csv(comparison: MetricComparison) -> str:
    """A line for each rig and number; an unknown one is an empty field, parameters are JSON."""
    rows = [{**row, "parameters": json.dumps(_plain(row["parameters"]), sort_keys=True)} for row in comparison.rows()]
    return _csv(rows, COLUMNS)


def tau_csv(comparison: MetricComparison) -> str:
    """A line for each pair of numbers."""
    return _csv([tau._asdict() for tau in comparison.taus()], Tau._fields)


def _row(one: Ranking, several: bool) -> list[str]:
    better = "less" if one.quantity.lower_is_better else "more"
    ranks = one.ranks.tolist() if several else [math.nan] * len(one.numbers)
    return [one.name, shown_unit(one.quantity.unit).name, better, *map(_words, one.numbers, ranks)]


def _words(number: Number, rank: float) -> str:
    """A number and its rank; an unknown one is a dash."""
    if not number.known:
        return "–"
    return number_words(number) if math.isnan(rank) else f"{number_words(number)} ({rank:g})"


def _shown(comparison: MetricComparison) -> list[Ranking]:
    """Numbers of torchcover that the table has room for: the detections."""
    return [own for own in comparison.own if not own.quantity.lower_is_better]


def _tau_rows(comparison: MetricComparison) -> list[list[str]]:
    found = {(tau.first, tau.second): tau for tau in comparison.taus()}
    if not found:
        return []
    return [
        [one.name, *(_tau_words(found[one.name, own.name]) for own in _shown(comparison))] for one in comparison.main
    ]


def _tau_words(tau: Tau) -> str:
    if math.isnan(tau.tau):
        return "–"
    interval = "" if math.isnan(tau.low) else f" [{tau.low:+.2f}, {tau.high:+.2f}]"
    return f"{tau.tau:+.2f}{interval}"


def _plain(value: Any) -> Any:  # noqa: ANN401  (whatever a record holds)
    """Without NaN, which JSON does not know."""
    if isinstance(value, Mapping):
        return {name: _plain(each) for name, each in value.items()}
    return None if isinstance(value, float) and math.isnan(value) else value


def _csv(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: "" if value is None else value for name, value in _plain(row).items()} for row in rows)
    return text.getvalue()
