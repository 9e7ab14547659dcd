"""Comparison of metrics: rankings of rigs, rank correlations, tables and files."""

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

TITLE = "Published metrics"
TAU_TITLE = "Kendall's tau-b with the coverage numbers, 95 % over scenes"

NOT_VALIDATED = "None of these metrics is validated; docs/metrics.md lists their limitations."
TOO_FEW = "Kendall's tau needs at least three rigs, since two have only two orders; got {}"
# Columns of a table with a row for each rig and number.
COLUMNS = (
    *("rig", "metric", "name", "value", "error", "low", "high", "unit", "lower_is_better"),
    *("count", "counted_items", "parameters", "warning", "rank"),
)


class KendallTau(NamedTuple):
    """Kendall's tau-b of two numbers over rigs, with its 95 % interval over scenes.

    The interval is NaN if one of the two numbers has no bootstrap values.
    """

    first: str
    second: str
    tau: float
    low: float
    high: float
    rig_count: int


@dataclass(frozen=True, eq=False)
class MetricComparison:
    """Published metrics of the rigs of a run, compared with the coverage numbers of regions.

    Args:
        rigs: Names of the rigs.
        rankings: Rankings by the published metrics.
        coverage_rankings: Rankings by coverage numbers.
        omissions: Name of a metric that could not be built -> reason.
    """

    rigs: tuple[str, ...]
    rankings: Sequence[Ranking]
    coverage_rankings: Sequence[Ranking] = ()
    omissions: Mapping[str, str] | None = None

    @property
    def main_rankings(self) -> list[Ranking]:
        """Rankings by numbers over all data, without numbers of a category or a region."""
        return [ranking for ranking in self.rankings if not ranking.is_part]

    def compute_taus(self) -> list[KendallTau]:
        """Compute tau for all pairs of main and coverage numbers; empty for fewer than three rigs."""
        if len(self.rigs) < LEAST:
            return []
        pairs = combinations([*self.main_rankings, *self.coverage_rankings], 2)
        return [compute_tau(first, second) for first, second in pairs]

    def iterate_rows(self) -> Iterator[dict[str, Any]]:
        """Iterate over rows with `COLUMNS`, one for each rig and number; NaN if unknown."""
        for ranking in (*self.rankings, *self.coverage_rankings):
            for rig, number, rank in zip(self.rigs, ranking.numbers, ranking.ranks.tolist(), strict=True):
                row = {**number.quantity._asdict(), **number._asdict(), "rig": rig, "rank": rank}
                row |= {"metric": ranking.metric, "name": ranking.name}
                yield {column: row[column] for column in COLUMNS}

    @property
    def notes(self) -> list[str]:
        """Notes for the reader: validation, warnings and omitted metrics."""
        too_few_rigs = [] if len(self.rigs) >= LEAST else [f"{TOO_FEW.format(len(self.rigs))}."]
        warned: dict[str, dict[str, None]] = {}  # metrics by warning
        for ranking in self.rankings:
            for number in ranking.numbers:
                if number.warning:
                    warned.setdefault(number.warning, {})[ranking.metric] = None
        warnings = [f"{', '.join(metrics)}: {warning}" for warning, metrics in warned.items()]
        ray_notes = []
        for ranking in self.main_rankings:
            if ranking.metric.startswith("s_mig"):
                note = describe_unequal_rays(dict(zip(self.rigs, ranking.numbers, strict=True)))
                ray_notes += [note] if note else []
        missing = [f"Without {name}: {reason}" for name, reason in (self.omissions or {}).items()]
        return [NOT_VALIDATED, *too_few_rigs, *warnings, *ray_notes, *missing]

    def build_page_tables(self, *, include_parts: bool = True) -> list[PageTable]:
        """Build the table of numbers, and the table of Kendall's tau for at least three rigs.

        Args:
            include_parts: True: include numbers of a category or a region.

        Returns:
            The tables.
        """
        rows = [_format_row(ranking) for ranking in (self.rankings if include_parts else self.main_rankings)]
        headings = ["metric", "unit", "better", *self.rigs]
        title = f"{TITLE} (rank)" if len(self.rigs) > 1 else TITLE
        return [PageTable(title, headings, rows, 3, self.notes), *_build_tau_tables(self)]

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
    """Compute Kendall's tau-b of two numbers, with the sign for which higher is better, and its bootstrap interval.

    Args:
        first: Ranking of the rigs.
        second: Ranking of the same rigs.

    Returns:
        Tau with its 95 % interval over scenes.
    """
    value = float(compute_kendall_tau_b(first.scores, second.scores))
    num_known = int((~np.isnan(first.scores + second.scores)).sum())
    low = high = math.nan
    if first.sampled_scores is not None and second.sampled_scores is not None:
        low, high = compute_bootstrap_interval95(
            value, compute_kendall_tau_b(first.sampled_scores, second.sampled_scores)
        )
    return KendallTau(first.name, second.name, value, low, high, num_known)


def _format_row(ranking: Ranking) -> list[TextCell]:
    """Format the cells of a table for one ranking."""
    better = "less" if ranking.quantity.lower_is_better else "more"
    ranks = ranking.ranks.tolist() if len(ranking.numbers) > 1 else [math.nan]
    cells = [TextCell(ranking.name), TextCell(get_display_unit(ranking.quantity.unit).name), TextCell(better)]
    for number, rank in zip(ranking.numbers, ranks, strict=True):
        cells.append(TextCell(_format_ranked_number(number, rank)))
    return cells


def _format_ranked_number(number: Number, rank: float) -> str:
    """Format a number with its rank in brackets."""
    if not number.has_value:
        return "–"
    return format_number(number) if math.isnan(rank) else f"{format_number(number)} ({rank:g})"


def _build_tau_tables(comparison: MetricComparison) -> list[PageTable]:
    """Build the table with a row for each main number; none without taus."""
    taus = {(tau.first, tau.second): tau for tau in comparison.compute_taus()}
    # The table shows detection rates only, for lack of space.
    columns = [ranking.name for ranking in comparison.coverage_rankings if not ranking.quantity.lower_is_better]
    rows = []
    for ranking in comparison.main_rankings if taus else ():
        cells = [TextCell(_format_tau(taus[ranking.name, column])) for column in columns]
        rows.append([TextCell(ranking.name), *cells])
    return [PageTable(TAU_TITLE, ["metric", *columns], rows)] if rows else []


def _format_tau(tau: KendallTau) -> str:
    """Format a correlation with its interval."""
    if math.isnan(tau.tau):
        return "–"
    interval = "" if math.isnan(tau.low) else f" [{tau.low:+.2f}, {tau.high:+.2f}]"
    return f"{tau.tau:+.2f}{interval}"
