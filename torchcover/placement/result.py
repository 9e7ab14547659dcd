"""The result of a placement search: its best rig, tables, sentences and pictures."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from torchcover.evaluation.result import describe_sensor_models
from torchcover.placement.free_sensor import FreeNumber
from torchcover.placement.report_files import OF_THE_RUN, PlacementReport, ReportMixin
from torchcover.placement.search import OPTIMIZER, RANDOM, START, Evaluation, PlacementSearch
from torchcover.placement.validation import (
    HeldOutImprovement,
    ValidationResult,
    describe_improvement,
    format_improvement,
    format_unit,
)
from torchcover.report import PageTable, TextCell, build_file_stems, plot_fronts, plot_progress
from torchcover.report.wording import UNKNOWN, get_display_unit
from torchcover.simulation import Rig

BOUND_SHARE = 0.005  # a number closer to an end of its range, as a share of that, lies on the end
HEADINGS = ("rig", "objective", "estimate", "gain in\nthe search", "gain on\nheld-out worlds", "t",
            "better in\n(worlds)", "optimism")  # fmt: skip


@dataclass(frozen=True, eq=False)
class Finalist:
    """A rig of a search that is tested on held-out worlds.

    Args:
        role: "best"; "random", the best random candidate; of several objectives "compromise" or the name of the
            objective that the rig is best in.
        evaluation: Its scores in the search.
        rig: The rig.
        improvements: Gains on held-out worlds; empty if it was not tested.
    """

    role: str
    evaluation: Evaluation
    rig: Rig
    improvements: Sequence[HeldOutImprovement] = ()

    @property
    def is_start(self) -> bool:
        """Whether nothing better than the start was found."""
        return self.evaluation.strategy == START


@dataclass(frozen=True, eq=False, repr=False)
class SearchResult(ReportMixin):
    """Result of `run_search`. Its first picture shows the progress of the search.

    Args:
        search: The search with all its evaluations.
        finalists: The best first; of several objectives the compromise.
        test: Side effects of the first finalist on held-out worlds.
        no_test_reason: Reason why there is no test; empty if there is one.
        duration_s: Duration, with the time before it was resumed.
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
    def improvements(self) -> Any:  # noqa: ANN401  (an array; see `PlacementSearch.gains`)
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
        assert start is not None  # it always is scored
        return [quantity.unit for quantity in start.quantities[: len(self.search.space.objectives)]]

    @property
    def summary(self) -> str:
        """The summary: the gain on held-out worlds, side effects, and what random candidates reached."""
        return " ".join(self._sentences())

    def _sentences(self) -> Iterator[str]:
        search, best = self.search, self.best
        others = search.evaluations[1:]
        reasons = [evaluation.infeasible_reason for evaluation in others if evaluation.infeasible_reason]
        if others and len(reasons) == len(others):
            yield f"None of {len(others)} candidates is possible, the last for this reason: {reasons[-1]}."
            return
        if best is None:
            yield f"None of {len(others)} candidates is possible."
            return
        if best.is_start:
            yield f"Nothing better than {search.space.start.name} was found in {len(others)} candidates."
        elif not best.improvements:
            yield f"Found in {len(others)} candidates, but not tested, so that no gain is shown: {self.no_test_reason}."
        else:
            yield f"{self._describe(best, optimism=True)}."
        if missing := self._describe_shortfalls(best.evaluation):
            yield f"No candidate keeps all that must be kept; this one misses the least: {missing}."
        if self.test is not None:
            yield f"{self.test.summary}."
        if bounds := self._find_bounds(best.evaluation):
            yield f"On the bounds of their ranges ended {', '.join(bounds)}: more room may be worth more."
        yield self._compare_random()
        rigs = {"start": search.space.start, **{finalist.role: finalist.rig for finalist in self.finalists}}
        is_ideal = search.plan.sensor_model == "ideal"
        yield from describe_sensor_models(
            {name: "ideal" if is_ideal else rig.sensor_model for name, rig in rigs.items()}
        )

    def _find_bounds(self, evaluation: Evaluation) -> list[str]:
        """Return the numbers of a candidate that lie at an end of their range."""
        bounds = []
        for variable in self.search.space.variables:
            if evaluation.number == 0 or not isinstance(variable, FreeNumber):
                continue
            value = float(evaluation.values[variable.name])
            if min(value - variable.low, variable.high - value) < BOUND_SHARE * (variable.high - variable.low):
                bounds.append(f"{variable.name} ({value:g})")
        return bounds

    def _compare_random(self) -> str:
        """Return what random candidates reached: the control of the optimizer."""
        count = f"{self.strategy_counts[RANDOM]} random candidates"
        if len(self.search.space.objectives) > 1:
            front = [self.search.evaluations[at].strategy for at in self.search.find_best()]
            return f"Of the front's {len(front)} rigs, {front.count(RANDOM)} are among the {count}."
        finalist = self.finalists[-1]
        if finalist.is_start:
            return f"The {count} are not better than the start."
        if self.best is not None and finalist.evaluation is self.best.evaluation:
            return f"It is one of the {count}: the optimizer found nothing better."
        gain = f": {self._describe(finalist, optimism=False)}" if finalist.improvements else " was not tested"
        return f"The best of {count}{gain}."

    def _describe(self, finalist: Finalist, *, optimism: bool) -> str:
        gains = finalist.improvements[: len(self.search.space.objectives)]
        return "; ".join(f"{gain.objective}: {describe_improvement(gain, optimism=optimism)}" for gain in gains)

    def _describe_shortfalls(self, evaluation: Evaluation) -> str:
        """Return what a candidate misses of what must be kept, the largest first; empty if it keeps all."""
        missing = self.search.find_shortfalls(evaluation)
        names = sorted(missing, key=lambda name: -missing[name])
        return "; ".join(f"{missing[name]:.2%} of {name}" for name in names)

    @property
    def report(self) -> PlacementReport:
        """Tables, files and pictures of the result."""
        search, settings = self.search, self.search.plan.collect_settings(self.search.space)
        ends = [finalist for finalist in self.finalists[1:] if finalist.role != RANDOM]
        best_of = zip(build_file_stems([finalist.role for finalist in ends]), ends, strict=True)
        of_plan = {name: getattr(search.plan, name) for name in ("evaluations", "budget_s", "num_held_out_scenes")}
        rigs = {finalist.role: finalist.rig for finalist in self.finalists}
        return PlacementReport(
            title=f"{search.space.name}: where should the sensors go?",
            summary=self.summary,
            record={
                **settings,
                **of_plan,
                "test_seed": search.plan.test_seed,
                "seconds": round(self.duration_s, 3),
                "candidates": self.strategy_counts,
                "infeasible": sum(bool(evaluation.infeasible_reason) for evaluation in search.evaluations[1:]),
                "changes": self.test and self.test.record,
                "found": [self._record_finalist(finalist) for finalist in self.finalists],
                "untested": self.no_test_reason or None,
            },
            setting_names=[name for name in (*settings, *of_plan, "test_seed") if name not in OF_THE_RUN],
            rigs={"best.yaml": self.rig} | {f"best_{stem}.yaml": end.rig for stem, end in best_of},
            page_rigs={"start": search.space.start} | rigs,
            tables=[
                PageTable(f"{search.space.name}: against {search.space.start.name}", HEADINGS, self._gain_rows(), 3),
                *([self.test.table] if self.test else ()),
                self._values_table(),
            ],
            csv_tables={"evaluations.csv": self._evaluation_rows(), "pareto.csv": self._pareto_rows()},
            render_plots=self._pictures,
            ego_outline_m=search.space.host.outline_m,
        )

    def __repr__(self) -> str:
        return f"SearchResult in {self.search.space.name}: {self.summary}"

    def _record_finalist(self, finalist: Finalist) -> dict[str, Any]:
        gains: dict[str, dict[str, Any]] = {}
        for gain in finalist.improvements:
            gains.setdefault(gain.objective, {})[gain.average] = gain.record
        return {
            "role": finalist.role,
            "strategy": finalist.evaluation.strategy,
            "evaluation": finalist.evaluation.number,
            "values": finalist.evaluation.values,
            "cost_eur": self._cost(finalist.evaluation),
            "gains": gains or None,
        }

    def _gain_rows(self) -> list[tuple[TextCell, ...]]:
        """Return cells below `HEADINGS`; those of the test are "-" for a finalist that was not tested."""
        rows, objectives = [], self.search.space.objectives
        for finalist in self.finalists:
            for gain in finalist.improvements:
                test, unit = gain.difference, gain.difference.quantity.unit
                cells = (
                    finalist.role,
                    f"{gain.objective} ({format_unit(unit)})",
                    gain.average,
                    format_improvement(gain.search_improvement, unit),
                    gain.description,
                    f"{gain.t_statistic:.1f}",
                    f"{test.better_count} of {test.block_count}",
                    format_improvement(gain.optimism, unit),
                )
                known = ["-" if cell in ("nan", "+nan", UNKNOWN) else cell.replace("nan", "?") for cell in cells]
                styles = ["significant" if at == 4 and test.is_significant else "" for at in range(len(cells))]
                rows.append(tuple(map(TextCell, known, styles)))
            if finalist.improvements:
                continue
            name = finalist.role + " (the start)" * finalist.is_start
            gains = self.improvements[finalist.evaluation.number].tolist()
            for (objective, asked), unit, gained in zip(objectives.items(), self.units, gains, strict=True):
                estimate = asked.fixed_average or self.search.plan.average
                row = (name, f"{objective} ({format_unit(unit)})", estimate, format_improvement(gained, unit), *"----")
                rows.append(tuple(map(TextCell, row)))
        return rows

    def _values_table(self) -> PageTable:
        columns: dict[str, Mapping[str, object]] = {"start": self.search.space.get_start_values()}
        columns |= {finalist.role: finalist.evaluation.values for finalist in self.finalists}
        names = [variable.name for variable in self.search.space.variables]
        rows = [
            (TextCell(name), *(TextCell(_format_value(column.get(name))) for column in columns.values()))
            for name in names
        ]
        return PageTable("Values", ("variable", *columns), rows)

    def _evaluation_rows(self) -> Iterator[Sequence[object]]:
        """Yield the heading, and a row for each candidate: gains are in the units of the objectives."""
        search = self.search
        names, variables = list(search.space.objectives), [variable.name for variable in search.space.variables]
        of_objectives = [f"{name}_{what}" for name in names for what in ("value", "gain", "gain_error")]
        yield [
            "number",
            "strategy",
            "state",
            *variables,
            *of_objectives,
            "self_hit_share",
            "cost_eur",
            "seconds",
            "why",
        ]
        for one in search.evaluations:
            numbers: list[object] = [None] * len(of_objectives)
            if one.estimate is not None:
                gains, errors = search.compare_with_start(one)
                triples = zip(one.estimate.value.tolist(), gains.tolist(), errors.tolist(), strict=True)
                numbers = [number for triple in list(triples)[: len(names)] for number in triple]
            missing = "" if one.infeasible_reason else self._describe_shortfalls(one)
            state = "infeasible" if one.infeasible_reason else "misses bounds" if missing else "complete"
            values = [one.values.get(name) for name in variables]
            last = (one.self_hit_share, self._cost(one), round(one.duration_s, 3), one.infeasible_reason or missing)
            yield [one.number, one.strategy, state, *values, *numbers, *last]

    def _pareto_rows(self) -> Iterator[Sequence[object]]:
        """Yield the heading, and the candidates that no other dominates."""
        variables = [variable.name for variable in self.search.space.variables]
        gains = [f"{name}_gain" for name in self.search.space.objectives]
        yield ["number", "strategy", *gains, "cost_eur", *variables]
        for at in self.search.find_best():
            one = self.search.evaluations[at]
            values = [one.values.get(variable) for variable in variables]
            yield [one.number, one.strategy, *self.improvements[at].tolist(), self._cost(one), *values]

    def _cost(self, one: Evaluation) -> float | None:
        space = self.search.space
        if not space.prices_eur or one.infeasible_reason:
            return None
        return space.compute_cost_eur(space.start if one.number == 0 else space.build_rig(one.values, str(one.number)))

    def _pictures(self) -> Iterator[tuple[str, str, Figure]]:
        """Yield stem, description and figure: progress, and of several objectives the front."""
        search, names = self.search, list(self.search.space.objectives)
        factors = np.array([get_display_unit(unit).factor for unit in self.units])
        labels = [f"gain in {name} ({format_unit(unit)})" for name, unit in zip(names, self.units, strict=True)]
        gains = factors * self.improvements
        best_so_far = np.maximum.accumulate(np.nan_to_num(gains, nan=-np.inf), axis=0)
        lines = {
            label: np.column_stack([np.arange(len(line)), line])
            for label, line in zip(labels, best_so_far.T, strict=True)
        }
        yield "progress", "The best so far over the candidates", plot_progress(lines, title=search.space.name)
        if len(names) > 1:
            strategies = np.array([evaluation.strategy for evaluation in search.evaluations])
            groups = {name: strategies == name for name in (OPTIMIZER, RANDOM)}
            is_on_front = np.isin(np.arange(len(gains)), search.find_best())
            every = {name: gains[group] for name, group in groups.items()}
            fronts = {name: gains[group & is_on_front] for name, group in groups.items()}
            yield "pareto", "Trade-off of the objectives", plot_fronts(labels, every, fronts, title=search.space.name)


def _format_value(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)
