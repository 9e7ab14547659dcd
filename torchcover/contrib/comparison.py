"""Metrics side by side: which rig each thinks best, how alike their orders are, and both in tables and files."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from torchcover.contrib.ranks import LEAST, Ranking, compute_bootstrap_interval95, compute_kendall_tau_b
from torchcover.contrib.s_mig import describe_unequal_rays
from torchcover.estimation import Number
from torchcover.files import format_csv
from torchcover.report import PageTable, TextCell, format_number, get_display_unit, to_json_record

TITLE, TAU_TITLE = "Metrics of others", "Kendall's tau-b with torchcover's numbers, 95 % over worlds"

NOT_VALIDATED = "None of these metrics is validated; docs/metrics.md says what each is blind to."
TOO_FEW = "Kendall's tau needs three rigs or more: two are in one order or in the other by chance; there are {}"
# Of a table with a row for each rig and number.
COLUMNS = ("rig", "metric", "name", "value", "error", "low", "high", "unit", "lower_is_better", "count", "counted_items",
           "parameters", "warning", "rank")  # fmt: skip


class KendallTau(NamedTuple):
    """How alike two numbers order the rigs: tau-b of what each holds for better, and its 95 % interval over worlds.

    The interval is NaN where one of the two does not say what it would be over other worlds.
    """

    first: str
    second: str
    tau: float
    low: float
    high: float
    rig_count: int


@dataclass(frozen=True, eq=False)
class MetricComparison:
    """What metrics of others say of the rigs of a run, compared with torchcover's own numbers of regions.

    `omissions` says of a metric that could not be made why.
    """

    rigs: tuple[str, ...]
    rankings: Sequence[Ranking]
    coverage_rankings: Sequence[Ranking] = ()
    omissions: Mapping[str, str] | None = None

    @property
    def main_rankings(self) -> list[Ranking]:
        """The numbers that are about everything, and not about a category or a region only."""
        return [one for one in self.rankings if not one.is_part]

    def compute_taus(self) -> list[KendallTau]:
        """Of all pairs of the main numbers and torchcover's own; none for fewer than three rigs."""
        if len(self.rigs) < LEAST:
            return []
        return [
            compute_tau(first, second)
            for first, second in combinations([*self.main_rankings, *self.coverage_rankings], 2)
        ]

    def iterate_rows(self) -> Iterator[dict[str, Any]]:
        """A row of `COLUMNS` for each rig and number, those of parts too; NaN where unknown."""
        for one in (*self.rankings, *self.coverage_rankings):
            for rig, number, rank in zip(self.rigs, one.numbers, one.ranks.tolist(), strict=True):
                given = {**number.quantity._asdict(), **number._asdict(), "rig": rig, "rank": rank}
                row = {**given, "metric": one.metric, "name": one.name}
                yield {column: row[column] for column in COLUMNS}

    @property
    def notes(self) -> list[str]:
        """What a reader is to know."""
        few = [] if len(self.rigs) >= LEAST else [f"{TOO_FEW.format(len(self.rigs))}."]
        warned: dict[str, dict[str, None]] = {}  # what to say of which metrics
        for one in self.rankings:
            for number in one.numbers:
                if number.warning:
                    warned.setdefault(number.warning, {})[one.metric] = None
        warnings = [f"{', '.join(metrics)}: {warning}" for warning, metrics in warned.items()]
        along_rays = [one for one in self.main_rankings if one.metric.startswith("s_mig")]
        rays = [
            note
            for one in along_rays
            if (note := describe_unequal_rays(dict(zip(self.rigs, one.numbers, strict=True))))
        ]
        missing = [f"Without {name}: {why}" for name, why in (self.omissions or {}).items()]
        return [NOT_VALIDATED, *few, *warnings, *rays, *missing]

    def build_page_tables(self, *, include_parts: bool = True) -> list[PageTable]:
        """Return the table of numbers, and that of Kendall's tau if there are three rigs or more.

        Args:
            include_parts: Whether numbers of a category or a region are rows too.
        """
        rows = [
            [TextCell(cell) for cell in _format_row(ranking)]
            for ranking in (self.rankings if include_parts else self.main_rankings)
        ]
        headings = ["metric", "unit", "better", *self.rigs]
        title = f"{TITLE} (rank)" if len(self.rigs) > 1 else TITLE
        return [PageTable(title, headings, rows, 3, self.notes), *_tau_tables(self)]

    @property
    def record(self) -> dict[str, Any]:
        """The content of `summary.json`; unknown values are None."""
        return {"numbers": self._number_records(), "tau": self._tau_records(), "notes": self.notes}

    @property
    def files(self) -> dict[str, str]:
        """Name and text of the CSV files: a line for each rig and number, and for each pair of numbers."""
        lines: list[Sequence[object]] = [COLUMNS]
        for record in self._number_records():
            record["parameters"] = json.dumps(record["parameters"], sort_keys=True)
            lines.append([record[name] for name in COLUMNS])
        taus = [record.values() for record in self._tau_records()]
        return {
            "metrics.csv": format_csv(lines),
            "metrics_rank_correlation.csv": format_csv([KendallTau._fields, *taus]),
        }

    def _number_records(self) -> list[dict[str, Any]]:
        return [{**to_json_record(row), "parameters": to_json_record(row["parameters"])} for row in self.iterate_rows()]

    def _tau_records(self) -> list[dict[str, Any]]:
        return [to_json_record(tau._asdict()) for tau in self.compute_taus()]


def compute_tau(first: Ranking, second: Ranking) -> KendallTau:
    """Kendall's tau-b of two numbers, each turned so that more is better, and its interval over drawn worlds."""
    value = float(compute_kendall_tau_b(first.scores, second.scores))
    known = int((~np.isnan(first.scores + second.scores)).sum())
    low = high = math.nan
    if first.sampled_scores is not None and second.sampled_scores is not None:
        low, high = compute_bootstrap_interval95(
            value, compute_kendall_tau_b(first.sampled_scores, second.sampled_scores)
        )
    return KendallTau(first.name, second.name, value, low, high, known)


def _format_row(one: Ranking) -> list[str]:
    better = "less" if one.quantity.lower_is_better else "more"
    ranks = one.ranks.tolist() if len(one.numbers) > 1 else [math.nan]
    return [one.name, get_display_unit(one.quantity.unit).name, better, *map(_words, one.numbers, ranks)]


def _words(number: Number, rank: float) -> str:
    if not number.has_value:
        return "–"
    return format_number(number) if math.isnan(rank) else f"{format_number(number)} ({rank:g})"


def _tau_tables(comparison: MetricComparison) -> list[PageTable]:
    """A row for each main number; no table if there are no taus."""
    found = {(tau.first, tau.second): tau for tau in comparison.compute_taus()}
    # Numbers of torchcover that the table has room for: the detections.
    shown = [own.name for own in comparison.coverage_rankings if not own.quantity.lower_is_better]
    mains = [one.name for one in comparison.main_rankings if found]
    rows = [[TextCell(name), *(TextCell(_tau_words(found[name, own])) for own in shown)] for name in mains]
    return [PageTable(TAU_TITLE, ["metric", *shown], rows)] if rows else []


def _tau_words(tau: KendallTau) -> str:
    if math.isnan(tau.tau):
        return "–"
    interval = "" if math.isnan(tau.low) else f" [{tau.low:+.2f}, {tau.high:+.2f}]"
    return f"{tau.tau:+.2f}{interval}"
