"""What a search has found, in numbers, words and tables."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from torchcover.evaluation.result import sensor_model_words
from torchcover.placement.arm import Arm
from torchcover.placement.evaluation import OPTIMISER, RANDOM, START, Evaluation
from torchcover.placement.fresh import FreshGain, FreshTest, amount, told, unit_words
from torchcover.placement.pareto import hypervolume
from torchcover.placement.report_files import OF_THE_RUN, PlacementReport, Reported
from torchcover.placement.result_pictures import search_pictures
from torchcover.placement.search import PlacementSearch
from torchcover.placement.variables import FreeNumber
from torchcover.report import PageTable, Words, file_stems
from torchcover.report.wording import UNKNOWN
from torchcover.simulation import Rig

# Of a range: nearer to its end, a number is on it.
BOUND = 0.005
HEADINGS = ("found by", "objective", "estimate", "gain in\nthe search", "gain on\nfresh worlds", "t",
            "better in\n(worlds)", "optimism")  # fmt: skip


@dataclass(frozen=True, eq=False)
class Pick:
    """A rig that was found by an arm, "optimiser" or "random".

    `role` is, of several objectives, "middle" of the front, or the name of the objective that it is best in. `gains`
    are on fresh worlds, by the estimate of the search first; empty if it was not tested, as the start itself.
    """

    arm: str
    role: str
    evaluation: Evaluation
    rig: Rig
    gains: Sequence[FreshGain] = ()

    @property
    def is_start(self) -> bool:
        """Whether nothing better was found."""
        return self.evaluation.arm == START

    @property
    def name(self) -> str:
        """What tables call it."""
        return f"{self.arm}: {self.role}" if self.role else self.arm


@dataclass(frozen=True, eq=False, repr=False)
class SearchResult(Reported):
    """What `run_search` returns. Its first picture shows how the search went.

    Args:
        search: With all its evaluations.
        picks: What was found, the better of both first, of several objectives the middle of a front.
        test: Of them, on fresh worlds: what else the first that is not the start has changed.
        untested: Why there is no test on fresh worlds; empty if there is one.
        seconds: What it took, with what was spent before it was resumed.
    """

    search: PlacementSearch
    picks: Sequence[Pick]
    test: FreshTest | None
    untested: str
    seconds: float

    @property
    def best(self) -> Pick | None:
        """The better of what both arms found, in the search; None if no candidate can be, nor the start."""
        return self.picks[0] if self.picks else None

    @property
    def rig(self) -> Rig:
        """The best, or the start if nothing better was found."""
        return self.search.space.start if self.best is None else self.best.rig

    @property
    def hypervolumes(self) -> dict[str, float]:
        """Of the front of each arm, above the least that any candidate of both gained in each objective."""
        gains = {name: arm.gains[arm.complete] for name, arm in self.search.arms.items()}
        every = np.vstack([*gains.values(), np.zeros((1, len(self.search.space.objectives)))])
        return {name: hypervolume(values, every.min(axis=0)) for name, values in gains.items()}

    @property
    def units(self) -> list[str]:
        """Of the objectives."""
        return [each.unit for each in self.search.evaluations[0].prefixes[-1].estimate.quantities]

    @property
    def sentence(self) -> str:
        """The last line: what was gained on fresh worlds, and what random search got with the same budget."""
        return " ".join(self._sentences())

    def _sentences(self) -> Iterator[str]:
        search, best = self.search, self.best
        others = search.evaluations[1:]
        refused = [one.infeasible for one in others if one.infeasible]
        if others and len(refused) == len(others):
            yield f"None of {len(others)} candidates can be, the last for this reason: {refused[-1]}."
            return
        if best is None:
            yield f"None of {len(others)} candidates can be."
        elif best.is_start:
            yield f"Nothing better than {search.space.start.name} was found in {self._spent(OPTIMISER)}."
        elif not best.gains:
            yield f"Found in {self._spent(best.arm)}, but not tested, so that no gain is shown: {self.untested}."
        else:
            yield f"{self._told(best, optimism=True)}."
        if best is not None and (lacks := _lacks(search.leader, search.leader.best)):
            yield f"No candidate keeps all that must be kept; this one lacks the least: {lacks}."
        if self.test is not None:
            yield f"{self.test.sentence}."
        if best is not None and (bounds := self._on_bounds(best.evaluation)):
            yield f"On the bounds of their ranges ended {', '.join(bounds)}: more room may be worth more."
        yield self._control()
        yield f"Racing saved {search.share_saved:.0%} of the instants."
        asked = {"start": search.space.start, **{pick.name: pick.rig for pick in self.picks}}
        ideal = search.plan.sensor_model == "ideal"
        yield from sensor_model_words({name: "ideal" if ideal else rig.sensor_model for name, rig in asked.items()})

    def _on_bounds(self, found: Evaluation) -> list[str]:
        """Numbers that are at an end of their range."""
        if found.unit is None or found.number == 0:
            return []
        pairs = zip(self.search.space.variables, found.unit.tolist(), strict=True)
        ends = ((one.name, min(share, 1 - share)) for one, share in pairs if isinstance(one, FreeNumber))
        return [f"{name} ({found.values[name]:g})" for name, away in ends if away < BOUND]

    def _control(self) -> str:
        """What the other arm got: random search, unless that found the best."""
        if len(self.search.space.objectives) > 1:
            volumes = self.hypervolumes
            shares = ", ".join(
                f"{100 * volume / (max(volumes.values()) or 1):.0f} by {name}" for name, volume in volumes.items()
            )
            return f"Hypervolume of the fronts, with the same budget, in per cent of the larger: {shares}."
        is_random = self.best is not None and self.best.arm == RANDOM
        name = OPTIMISER if is_random else RANDOM
        who = "Random search found that, and the optimiser" if is_random else "Random search"
        other = next((pick for pick in self.picks if pick.arm == name), None)
        if other is not None and other.gains:
            return f"{who} with the same budget: {self._told(other, optimism=False)}."
        what = "no rig" if other is None else "nothing better" if other.is_start else "a rig that was not tested"
        return f"{who} with the same budget found {what} in {self._spent(name)}."

    def _told(self, pick: Pick, *, optimism: bool) -> str:
        gains = pick.gains[: len(self.search.space.objectives)]
        return "; ".join(f"{gain.objective}: {told(gain, optimism=optimism)}" for gain in gains)

    def _spent(self, arm: str) -> str:
        return f"{len(self.search.arms[arm].evaluations) - 1} candidates"

    @property
    def report(self) -> PlacementReport:
        """For its files, its page, and the terminal."""
        search, settings = self.search, self.search.plan.settings(self.search.space)
        ends = [pick for pick in self.picks if pick.arm == search.leader.name][1:]
        best_of = zip(file_stems([pick.role for pick in ends]), ends, strict=True)
        several = len(search.space.objectives) > 1
        volumes = self.hypervolumes if several else None
        of_plan = {name: getattr(search.plan, name) for name in ("evaluations", "budget_s", "fresh_worlds")}
        return PlacementReport(
            title=f"{search.space.name}: where should the sensors go?",
            sentence=self.sentence,
            record={
                **settings,
                **of_plan,
                "test_seed": search.plan.seed_of_test,
                "seconds": round(self.seconds, 3),
                "arms": {name: _arm_record(arm) for name, arm in search.arms.items()},
                "share_of_instants_saved": search.share_saved,
                "hypervolume": volumes,
                "changes": self.test and self.test.record,
                "found": [self._pick_record(pick) for pick in self.picks],
                "untested": self.untested or None,
            },
            settings=[name for name in (*settings, *of_plan, "test_seed") if name not in OF_THE_RUN],
            rigs={"best.yaml": self.rig} | {f"best_{stem}.yaml": end.rig for stem, end in best_of},
            shown={"start": search.space.start, **{pick.name: pick.rig for pick in self.picks}},
            tables=[
                PageTable(f"{search.space.name}: against {search.space.start.name}", HEADINGS, self._gain_rows(), 3),
                *([self.test.table] if self.test else ()),
                self._values(),
                _spent_table(search, volumes),
            ],
            rows={"evaluations.csv": self._evaluation_rows(), "pareto.csv": self._pareto_rows()},
            pictures=partial(search_pictures, search, None if self.best is None else self.best.evaluation),
            ego_outline_m=search.space.scenarios[0].ego_box().outline_m,
        )

    def __repr__(self) -> str:
        return f"SearchResult in {self.search.space.name}: {self.sentence}"

    def _pick_record(self, pick: Pick) -> dict[str, Any]:
        gains: dict[str, dict[str, Any]] = {}
        for gain in pick.gains:
            gains.setdefault(gain.objective, {})[gain.estimate] = gain.record
        return {
            "arm": pick.arm,
            "role": pick.role or None,
            "evaluation": pick.evaluation.number,
            "values": pick.evaluation.values,
            "cost_eur": None if pick.is_start else self.search.space.cost_eur(pick.rig),
            "gains": gains or None,
        }

    def _gain_rows(self) -> list[tuple[Words, ...]]:
        """Cells below `HEADINGS`; of what was not tested too."""
        rows, objectives = [], self.search.space.objectives
        for pick in self.picks:
            for gain in pick.gains:
                test, unit = gain.test, gain.test.quantity.unit
                words = (
                    pick.name,
                    f"{gain.objective} ({unit_words(unit)})",
                    gain.estimate,
                    amount(gain.search_gain, unit),
                    gain.words,
                    f"{gain.t:.1f}",
                    f"{test.better} of {test.blocks}",
                    amount(gain.optimism, unit),
                )
                known = ["-" if word in ("nan", "+nan", UNKNOWN) else word.replace("nan", "?") for word in words]
                marked = ["significant" if at == 4 and test.significant else "" for at in range(len(words))]
                rows.append(tuple(map(Words, known, marked)))
            if not pick.gains:
                arm = self.search.arms[pick.arm]
                gained = arm.gains[arm.evaluations.index(pick.evaluation)].tolist()
                name = pick.name + " (the start)" * pick.is_start
                for (objective, asked), unit, each in zip(objectives.items(), self.units, gained, strict=False):
                    estimate = asked.own_estimate or self.search.plan.estimate
                    cells = (name, f"{objective} ({unit_words(unit)})", estimate, amount(each, unit), *"----")
                    rows.append(tuple(map(Words, cells)))
        return rows

    def _values(self) -> PageTable:
        columns: dict[str, Mapping[str, object]] = {"start": self.search.space.start_values()}
        columns |= {pick.name: pick.evaluation.values for pick in self.picks}
        names = [variable.name for variable in self.search.space.variables]
        rows = [(Words(name), *(Words(_value(values.get(name))) for values in columns.values())) for name in names]
        return PageTable("Values", ("variable", *columns), rows)

    def _evaluation_rows(self) -> Iterator[Sequence[object]]:
        """A row for each candidate, with a heading: gains over the start are in the units of the objectives."""
        search = self.search
        names, variables = list(search.space.objectives), [variable.name for variable in search.space.variables]
        of_objectives = [f"{name}_{what}" for name in names for what in ("value", "gain", "gain_error")]
        at_end = ("instants", "self_hit_share", "cost_eur", "seconds", "why")
        yield ["number", "arm", "state", *variables, *of_objectives, *at_end]
        places = {one.number: (arm, at) for arm in search.arms.values() for at, one in enumerate(arm.evaluations)}
        for one in search.evaluations:
            arm, at = places[one.number]
            pair, unknown = arm.against_start(at), [None] * len(names)
            values = one.prefixes[-1].estimate.value.tolist()[: len(names)] if one.prefixes else unknown
            errors = unknown if pair is None else pair[1].tolist()
            each = [value for triple in zip(values, arm.gains[at].tolist(), errors, strict=True) for value in triple]
            state, why = self._state(one, _lacks(arm, at))
            hits = one.prefixes[-1].self_hit_share if one.prefixes else None
            own = [one.values.get(name) for name in variables]
            costs = self._cost(one), round(one.seconds, 3)
            yield [one.number, one.arm, state, *own, *each, one.instants, hits, *costs, why]

    def _pareto_rows(self) -> Iterator[Sequence[object]]:
        """Candidates of each arm that no other of it beats, with a heading."""
        search = self.search
        variables = [variable.name for variable in search.space.variables]
        yield ["arm", "number", *(f"{name}_gain" for name in search.space.objectives), "cost_eur", *variables]
        for name, arm in search.arms.items():
            for at in arm.front:
                one = arm.evaluations[at]
                values = [one.values.get(variable) for variable in variables]
                yield [name, one.number, *arm.gains[at].tolist(), self._cost(one), *values]

    def _state(self, one: Evaluation, lacks: str) -> tuple[str, str]:
        if one.infeasible:
            return "infeasible", one.infeasible
        if lacks:
            return "lacking", lacks
        if one.instants < len(self.search.instants):
            return "dropped", "two standard errors below the best so far"
        return "complete", ""

    def _cost(self, one: Evaluation) -> float | None:
        space = self.search.space
        if not space.cost or one.infeasible:
            return None
        return space.cost_eur(space.start if one.number == 0 else space.rig(one.values, str(one.number)))


def _arm_record(arm: Arm) -> dict[str, Any]:
    others = arm.evaluations[1:]
    return {
        "candidates": len(others),
        "infeasible": sum(bool(one.infeasible) for one in others),
        "scored at all instants": len(arm.complete) - (0 in arm.complete),
        "instants": sum(one.instants for one in others),
        "seconds": round(sum(one.seconds for one in others), 3),
    }


def _lacks(arm: Arm, at: int | None) -> str:
    """What a candidate lacks of what must be kept, the most first; nothing if it keeps all."""
    each = {} if at is None else arm.lacking(at)
    return "; ".join(f"{each[name]:.2%} of {name}" for name in sorted(each, key=lambda name: -each[name]))


def _value(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def _spent_table(search: PlacementSearch, volumes: Mapping[str, float] | None) -> PageTable:
    arms = {name: _arm_record(arm) for name, arm in search.arms.items()}
    rows = [(Words(name), *(Words(f"{value:g}") for value in arm.values())) for name, arm in arms.items()]
    notes = [f"Racing saved {search.share_saved:.0%} of the instants."]
    if volumes:
        notes.append("Hypervolume: " + ", ".join(f"{name} {volume:.3g}" for name, volume in volumes.items()) + ".")
    return PageTable("What was spent", ("arm", *next(iter(arms.values()))), rows, notes=notes)
