"""The result of a placement search: its best rig, tables, sentences and pictures."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from torchcover.evaluation.result_notes import describe_sensor_models
from torchcover.placement.free_sensor import FreeNumber
from torchcover.placement.report_files import RUN_KEYS, PlacementReport, ReportMixin
from torchcover.placement.search import OPTIMIZER, RANDOM, START, Evaluation, PlacementSearch
from torchcover.placement.validation import (
    HeldOutImprovement,
    ValidationResult,
    describe_improvement,
    format_improvement,
    format_unit,
)
from torchcover.report import PageTable, TextCell, build_file_stems, plot_fronts, plot_progress
from torchcover.report.number_format import UNKNOWN, get_display_unit
from torchcover.simulation import Rig

HEADINGS = (
    "rig",
    "objective",
    "average",
    "improvement in\nthe search",
    "improvement on\nheld-out scenes",
    "t statistic",
    "better in\n(blocks)",
    "optimism",
)


@dataclass(frozen=True, eq=False)
class Finalist:
    """Rig of a search that is tested on held-out scenes.

    Args:
        role: "best"; "random", the best random candidate; of several objectives "compromise" or the name of the
            objective in which the rig is best.
        evaluation: Scores in the search.
        rig: The rig.
        improvements: Improvements on held-out scenes; empty without a test.
    """

    role: str
    evaluation: Evaluation
    rig: Rig
    improvements: Sequence[HeldOutImprovement] = ()

    @property
    def is_start(self) -> bool:
        """True if the rig is the start, since no candidate is better."""
        return self.evaluation.strategy == START


@dataclass(frozen=True, eq=False, repr=False)
class SearchResult(ReportMixin):
    """Result of `run_search`. Its first plot shows the progress of the search.

    Args:
        search: The search with all evaluations.
        finalists: Finalists, the best or the compromise first.
        test: Validation on held-out scenes; None without a test.
        no_test_reason: Reason why there is no test; empty if there is one.
        duration_s: Duration in seconds, including the time before the search was resumed.
    """

    search: PlacementSearch
    finalists: Sequence[Finalist]
    test: ValidationResult | None
    no_test_reason: str
    duration_s: float

    @property
    def best(self) -> Finalist | None:
        """The best rig of the search; None if no rig is possible, not even the start."""
        return self.finalists[0] if self.finalists else None

    @property
    def rig(self) -> Rig:
        """The best rig, or the start if nothing better was found."""
        return self.search.space.start if self.best is None else self.best.rig

    @cached_property
    def improvements(self) -> Any:  # noqa: ANN401  (an array, see `PlacementSearch.improvements`)
        """(evaluations, objectives) improvements over the start in the search."""
        return self.search.improvements

    @cached_property
    def strategy_counts(self) -> dict[str, int]:
        """Number of candidates of each strategy."""
        strategies = [evaluation.strategy for evaluation in self.search.evaluations]
        return {name: strategies.count(name) for name in (OPTIMIZER, RANDOM)}

    @property
    def units(self) -> list[str]:
        """Units of the objectives."""
        start = self.search.evaluations[0].estimate
        assert start is not None  # the start always has a score
        return [quantity.unit for quantity in start.quantities[: len(self.search.space.objectives)]]

    @property
    def summary(self) -> str:
        """Summary: improvement on held-out scenes, side effects, and the result of random candidates."""
        return " ".join(self._build_sentences())

    def _build_sentences(self) -> Iterator[str]:
        """Yield the sentences of the summary, the result first."""
        search, best = self.search, self.best
        candidates = search.evaluations[1:]
        reasons = [candidate.infeasible_reason for candidate in candidates if candidate.infeasible_reason]
        if candidates and len(reasons) == len(candidates):
            yield f"All {len(candidates)} candidates are infeasible; reason of the last: {reasons[-1]}."
            return
        if best is None:
            yield f"All {len(candidates)} candidates are infeasible."
            return
        if best.is_start:
            yield f"None of {len(candidates)} candidates is better than {search.space.start.name}."
        elif not best.improvements:
            yield f"Best of {len(candidates)} candidates, without validation: {self.no_test_reason}."
        else:
            yield f"{self._describe_improvements(best, optimism=True)}."
        if shortfalls := self._describe_shortfalls(best.evaluation):
            yield f"No candidate meets all bounds; this one has the smallest shortfall: {shortfalls}."
        if self.test is not None:
            yield f"{self.test.summary}."
        if variables := self._find_variables_on_bounds(best.evaluation):
            yield f"Variables at the end of their range: {', '.join(variables)}; a wider range may be better."
        yield self._describe_random_candidates()
        rigs = {"start": search.space.start, **{finalist.role: finalist.rig for finalist in self.finalists}}
        is_ideal = search.plan.sensor_model == "ideal"
        yield from describe_sensor_models(
            {name: "ideal" if is_ideal else rig.sensor_model for name, rig in rigs.items()}
        )

    def _find_variables_on_bounds(self, evaluation: Evaluation) -> list[str]:
        """Return the variables of a candidate that are within 0.5 % of an end of their range."""
        variables = []
        for variable in self.search.space.variables:
            if evaluation.number == 0 or not isinstance(variable, FreeNumber):
                continue
            value = float(evaluation.values[variable.name])
            if min(value - variable.low, variable.high - value) < 0.005 * (variable.high - variable.low):
                variables.append(f"{variable.name} ({value:g})")
        return variables

    def _describe_random_candidates(self) -> str:
        """Describe the result of random candidates, the control of the optimizer."""
        count = self.strategy_counts[RANDOM]
        if len(self.search.space.objectives) > 1:
            front = [self.search.evaluations[number].strategy for number in self.search.find_best()]
            return f"Control: {front.count(RANDOM)} of {len(front)} rigs of the front are random candidates ({count})."
        finalist = self.finalists[-1]
        if finalist.is_start:
            return f"Control: none of {count} random candidates is better than the start."
        if self.best is not None and finalist.evaluation is self.best.evaluation:
            return f"Control: it is one of {count} random candidates; the optimizer found nothing better."
        if not finalist.improvements:
            return f"Control: the best of {count} random candidates was not validated."
        return f"Control, the best of {count} random candidates: {self._describe_improvements(finalist)}."

    def _describe_improvements(self, finalist: Finalist, *, optimism: bool = False) -> str:
        """Describe the improvement in each objective on held-out scenes."""
        texts = []
        for improvement in finalist.improvements[: len(self.search.space.objectives)]:
            texts.append(f"{improvement.objective}: {describe_improvement(improvement, optimism=optimism)}")
        return "; ".join(texts)

    def _describe_shortfalls(self, evaluation: Evaluation) -> str:
        """Describe the shortfalls of a candidate, the largest first; empty if it has none."""
        shortfalls = self.search.find_shortfalls(evaluation)
        names = sorted(shortfalls, key=shortfalls.__getitem__, reverse=True)
        return "; ".join(f"{shortfalls[name]:.2%} of {name}" for name in names)

    @property
    def report(self) -> PlacementReport:
        """Tables, files and plots of the result."""
        search, space, plan = self.search, self.search.space, self.search.plan
        settings = plan.collect_settings(space)
        budget = {
            "num_evaluations": plan.num_evaluations,
            "budget_s": plan.budget_s,
            "num_held_out_scenes": plan.num_held_out_scenes,
            "test_seed": plan.test_seed,
        }
        front_ends = [finalist for finalist in self.finalists[1:] if finalist.role != RANDOM]
        stems = build_file_stems([finalist.role for finalist in front_ends])
        files = {f"best_{stem}.yaml": end.rig for stem, end in zip(stems, front_ends, strict=True)}
        improvements = PageTable(f"{space.name}: against {space.start.name}", HEADINGS, self._build_rows(), 3)
        return PlacementReport(
            title=f"{space.name}: sensor placement",
            summary=self.summary,
            record={
                **settings,
                **budget,
                "duration_s": round(self.duration_s, 3),
                "strategy_counts": self.strategy_counts,
                "infeasible_count": sum(bool(evaluation.infeasible_reason) for evaluation in search.evaluations[1:]),
                "side_effects": self.test and self.test.record,
                "finalists": [self._record_finalist(finalist) for finalist in self.finalists],
                "no_test_reason": self.no_test_reason or None,
            },
            setting_names=[name for name in (*settings, *budget) if name not in RUN_KEYS],
            rigs={"best.yaml": self.rig} | files,
            page_rigs={"start": space.start} | {finalist.role: finalist.rig for finalist in self.finalists},
            tables=[improvements, *([self.test.table] if self.test else ()), self._build_values_table()],
            csv_tables={"evaluations.csv": self._yield_evaluations(), "pareto.csv": self._yield_front()},
            render_plots=self._render_plots,
            ego_outline_m=space.host.outline_m,
        )

    def __repr__(self) -> str:
        return f"SearchResult in {self.search.space.name}: {self.summary}"

    def _record_finalist(self, finalist: Finalist) -> dict[str, Any]:
        """Build the record of a finalist for search.json."""
        improvements: dict[str, dict[str, Any]] = {}
        for improvement in finalist.improvements:
            improvements.setdefault(improvement.objective, {})[improvement.average] = improvement.record
        return {
            "role": finalist.role,
            "strategy": finalist.evaluation.strategy,
            "evaluation": finalist.evaluation.number,
            "values": finalist.evaluation.values,
            "cost_eur": self._compute_cost_eur(finalist.evaluation),
            "improvements": improvements or None,
        }

    def _build_rows(self) -> list[tuple[TextCell, ...]]:
        """Build the rows below `HEADINGS`; cells of the test are "-" for a finalist that was not tested."""
        rows: list[tuple[TextCell, ...]] = []
        for finalist in self.finalists:
            rows += [self._build_tested_row(finalist.role, improvement) for improvement in finalist.improvements]
            if finalist.improvements:
                continue
            role = finalist.role + " (the start)" * finalist.is_start
            values = self.improvements[finalist.evaluation.number].tolist()
            for (name, objective), unit, value in zip(
                self.search.space.objectives.items(), self.units, values, strict=True
            ):
                average = objective.fixed_average or self.search.plan.average
                cells = (role, f"{name} ({format_unit(unit)})", average, format_improvement(value, unit), *"----")
                rows.append(tuple(TextCell(cell) for cell in cells))
        return rows

    def _build_tested_row(self, role: str, improvement: HeldOutImprovement) -> tuple[TextCell, ...]:
        """Build the row of one improvement on held-out scenes."""
        difference, unit = improvement.difference, improvement.difference.quantity.unit
        cells = (
            role,
            f"{improvement.objective} ({format_unit(unit)})",
            improvement.average,
            format_improvement(improvement.search_improvement, unit),
            improvement.description,
            f"{improvement.t_statistic:.1f}",
            f"{difference.better_count} of {difference.block_count}",
            format_improvement(improvement.optimism, unit),
        )
        texts = ["-" if cell in ("nan", "+nan", UNKNOWN) else cell.replace("nan", "?") for cell in cells]
        row = [TextCell(text) for text in texts]
        if difference.is_significant:
            row[4] = TextCell(texts[4], "significant")
        return tuple(row)

    def _build_values_table(self) -> PageTable:
        """Build the table of all variables of the start and the finalists."""
        columns: dict[str, Mapping[str, object]] = {"start": self.search.space.get_start_values()}
        columns |= {finalist.role: finalist.evaluation.values for finalist in self.finalists}
        rows = []
        for variable in self.search.space.variables:
            values = [_format_value(column.get(variable.name)) for column in columns.values()]
            rows.append(tuple(TextCell(text) for text in (variable.name, *values)))
        return PageTable("Values", ("variable", *columns), rows)

    def _yield_evaluations(self) -> Iterator[Sequence[object]]:
        """Yield the headings, and a row for each candidate: improvements are in the units of the objectives."""
        search = self.search
        variables = [variable.name for variable in search.space.variables]
        columns: list[str] = []
        for name in search.space.objectives:
            columns += [f"{name}_value", f"{name}_improvement", f"{name}_improvement_error"]
        first, last = ("number", "strategy", "state"), ("self_hit_share", "cost_eur", "duration_s", "reason")
        yield [*first, *variables, *columns, *last]
        for evaluation in search.evaluations:
            numbers: list[object] = [None] * len(columns)
            if evaluation.estimate is not None:
                numbers = []
                improvements, errors = search.compare_with_start(evaluation)
                for index in range(len(search.space.objectives)):
                    numbers += [
                        float(evaluation.estimate.value[index]),
                        float(improvements[index]),
                        float(errors[index]),
                    ]
            shortfalls = "" if evaluation.infeasible_reason else self._describe_shortfalls(evaluation)
            state = "infeasible" if evaluation.infeasible_reason else "violates bounds" if shortfalls else "complete"
            yield [
                evaluation.number,
                evaluation.strategy,
                state,
                *(evaluation.values.get(name) for name in variables),
                *numbers,
                evaluation.self_hit_share,
                self._compute_cost_eur(evaluation),
                round(evaluation.duration_s, 3),
                evaluation.infeasible_reason or shortfalls,
            ]

    def _yield_front(self) -> Iterator[Sequence[object]]:
        """Yield the headings, and the candidates that no other dominates."""
        variables = [variable.name for variable in self.search.space.variables]
        columns = [f"{name}_improvement" for name in self.search.space.objectives]
        yield ["number", "strategy", *columns, "cost_eur", *variables]
        for number in self.search.find_best():
            evaluation = self.search.evaluations[number]
            values = [evaluation.values.get(variable) for variable in variables]
            cost_eur = self._compute_cost_eur(evaluation)
            yield [number, evaluation.strategy, *self.improvements[number].tolist(), cost_eur, *values]

    def _compute_cost_eur(self, evaluation: Evaluation) -> float | None:
        """Compute the cost of a candidate; None without prices or for an infeasible candidate."""
        space = self.search.space
        if not space.prices_eur or evaluation.infeasible_reason:
            return None
        if evaluation.number == 0:
            return space.compute_cost_eur(space.start)
        return space.compute_cost_eur(space.build_rig(evaluation.values, str(evaluation.number)))

    def _render_plots(self) -> Iterator[tuple[str, str, Figure]]:
        """Yield stem, description and figure: progress, and of several objectives the front."""
        search, names = self.search, list(self.search.space.objectives)
        factors = np.array([get_display_unit(unit).factor for unit in self.units])
        labels = [f"improvement in {name} ({format_unit(unit)})" for name, unit in zip(names, self.units, strict=True)]
        improvements = factors * self.improvements
        best_so_far = np.maximum.accumulate(np.nan_to_num(improvements, nan=-np.inf), axis=0)
        lines = {}
        for label, line in zip(labels, best_so_far.T, strict=True):
            lines[label] = np.column_stack([np.arange(len(line)), line])
        yield "progress", "Best improvement so far", plot_progress(lines, title=search.space.name)
        if len(names) > 1:
            strategies = np.array([evaluation.strategy for evaluation in search.evaluations])
            is_on_front = np.isin(np.arange(len(improvements)), search.find_best())
            candidates, fronts = {}, {}
            for name in (OPTIMIZER, RANDOM):
                candidates[name] = improvements[strategies == name]
                fronts[name] = improvements[(strategies == name) & is_on_front]
            figure = plot_fronts(labels, candidates, fronts, title=search.space.name)
            yield "pareto", "Trade-off between the objectives", figure


def _format_value(value: object) -> str:
    """Format a value of a variable; "-" if the rig has none."""
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)
