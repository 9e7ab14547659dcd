"""A placement search: it asks for candidates, is told their scores, and spends half of its budget on a control."""

import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from torchcover.geometry.arrays import Float64
from torchcover.placement.arm import Arm
from torchcover.placement.common_instants import CommonInstants
from torchcover.placement.evaluation import OPTIMISER, RANDOM, START, Evaluation
from torchcover.placement.objective import looked_for
from torchcover.placement.optimisers import Cube, RandomSearch
from torchcover.placement.optimisers.optimiser import Unit
from torchcover.placement.plan import SearchPlan, levels_of
from torchcover.placement.racing import ERRORS_BELOW, Prefix, race
from torchcover.placement.space import SearchSpace
from torchcover.simulation import Rig

# What is drawn by the control is nothing that the optimiser draws.
SEEDS = {OPTIMISER: 0, RANDOM: 1}


class PlacementSearch:
    """Looks for a better rig in a space, next to a random search with the same budget.

    Evaluation 0 is the start. From then on the arm that has spent fewer instants asks, the optimiser first. What is
    asked for depends on the space, the seed and the scores so far, and on nothing else.

    Args:
        space: What is free, and what a good rig is.
        plan: Budget, worlds and seeds; or, instead of it, its arguments by name.

    Raises:
        ValueError: A plan that makes no sense, or an optimiser that cannot search this space.

    Example:
        >>> space = SearchSpace(
        ...     name="pitch",
        ...     start="front_roof_32",
        ...     scenario="courtyard",
        ...     free={"roof": {"pitch_deg": (-10.0, 15.0)}},
        ...     objectives={"near": {"band": "ground", "region": "20m"}},
        ... )
        >>> search = PlacementSearch(space, evaluations=2, per_world=1, rays=1024)
        >>> while (candidate := search.ask()) is not None:
        ...     search.tell(candidate, tuple(search.instants.prefixes(candidate.rig)))
        >>> [evaluation.arm for evaluation in search.evaluations]
        ['start', 'optimiser', 'random']
    """

    def __init__(self, space: SearchSpace, plan: SearchPlan | None = None, **settings: Any) -> None:  # noqa: ANN401
        self.space = space
        self.plan = SearchPlan(**settings) if plan is None else plan
        self.evaluations: list[Evaluation] = []
        self.arms: dict[str, Arm] = {}
        self._exhausted = False
        self.until = math.inf  # by the monotonic clock: when nothing more is asked for
        self.plan.makes_optimiser(self._cube(), self.plan.seed)  # fails now, if it does

    @cached_property
    def instants(self) -> CommonInstants:
        """What candidates are scored on: built when first asked for."""
        return self.plan.instants(self.space, self.plan, self.plan.seed, self.plan.worlds)

    @property
    def leader(self) -> Arm:
        """The arm whose best lacks less, or else gains more; of several objectives the optimiser if both lack alike."""
        several = len(self.space.objectives) > 1

        def worth(arm: Arm) -> tuple[float, float]:
            at = arm.best
            return (-math.inf, 0.0) if at is None else (-arm.lacks[at], 0.0 if several else arm.gains[at, 0])

        return max(self.arms.values(), key=worth)

    @property
    def share_saved(self) -> float:
        """Of the instants that candidates would have been scored at without racing."""
        spent = [one.instants for one in self.evaluations[1:] if one.instants]
        return 1.0 - sum(spent) / (len(spent) * len(self.instants)) if spent else 0.0

    def ask(self) -> Evaluation | None:
        """The next rig that can be mounted and keeps to the constraints; those before are noted as infeasible.

        Returns:
            It; None when the evaluations are spent, or the optimiser has nothing left to ask for.
        """
        if not self.evaluations:
            if self.plan.budget_s is not None:
                self.until = time.monotonic() + self.plan.budget_s
            values = self.space.start_values()
            return Evaluation(0, START, self._start_unit, values, self.space.start)
        while self._is_budget_left():
            number = len(self.evaluations)
            arm = min(self.arms.values(), key=lambda each: each.charge)
            unit = arm.ask(number)
            if unit is None:
                self._exhausted = True
                break
            pairs = zip(self.space.variables, unit.tolist(), strict=True)
            values = {variable.name: variable.at(share) for variable, share in pairs}
            try:
                rig = self.space.rig(values, f"{self.space.name}_{number}")
                why = "; ".join(self.space.violations(rig))
            except ValueError as error:
                why = str(error)
            if not why:
                return Evaluation(number, arm.name, unit, values, rig)
            self._note(Evaluation(number, arm.name, unit, values, infeasible=why))
        return None

    def tell(self, candidate: Evaluation, prefixes: tuple[Prefix, ...], *, seconds: float = 0.0) -> None:
        """What a candidate scored; with too many rays on the vehicle, it cannot be.

        Args:
            candidate: The last that was asked for, with what it lacks.
            prefixes: From `instants.prefixes`, all or the first of them; of the start all.
            seconds: What it took.

        Raises:
            ValueError: Another candidate; of the start, scores at some instants only, or an unknown objective.
        """
        self._check_turn(candidate)
        wrong = [] if candidate.number else list(self.space.violations(self.space.start))
        wrong += [why] if (why := self._too_many_self_hits(prefixes[-1])) else []
        why = "; ".join(wrong)
        self._note(replace(candidate, rig=None, prefixes=prefixes, infeasible=why, seconds=seconds))

    def refuse(self, candidate: Evaluation, why: str, *, seconds: float = 0.0) -> None:
        """Say that a candidate cannot be.

        Raises:
            ValueError: Another than the last that was asked for, or it is the start.
        """
        self._check_turn(candidate)
        if candidate.number == 0:
            raise ValueError(f"the start, {self.space.start.name}, cannot be scored: {why}")
        self._note(replace(candidate, rig=None, infeasible=why, seconds=seconds))

    def evaluate(self, candidate: Evaluation) -> None:
        """Score a candidate and tell it: at a few instants at a time, until it is beaten or was scored at all."""
        began = time.perf_counter()
        incumbents, lacks = self.arms[candidate.arm].incumbents if candidate.number else [], dict[str, float]()
        try:
            prefixes = race(self._scored(candidate, lacks), incumbents, len(self.space.objectives))
        except ValueError as error:
            self.refuse(candidate, str(error), seconds=time.perf_counter() - began)
        else:
            self.tell(replace(candidate, lacks=lacks), prefixes, seconds=time.perf_counter() - began)

    def _scored(self, candidate: Evaluation, lacks: dict[str, float]) -> Iterator[Prefix]:
        """Until it cannot win; `lacks` becomes what it lacks, looked at where that decides, as it takes so long."""
        assert candidate.rig is not None  # while it is asked for
        known, arm, looked = list[Prefix](), self.arms.get(candidate.arm), False
        for prefix in self.instants.prefixes(candidate.rig):
            if arm and (why := self._too_many_self_hits(prefix)):
                raise ValueError(why)  # no need to look at more instants
            known.append(prefix)
            yield prefix
            if not looked and (arm is None or arm.may_lead(known)):
                lacks |= self._lacks(candidate.rig)
                looked = True
            if arm and (arm.is_worse(known, ERRORS_BELOW) or sum(lacks.values()) > arm.least_lack):
                return

    def _lacks(self, rig: Rig) -> dict[str, float]:
        """Of what bodies and encounters require.

        Of each bound that is not kept, the mean of the share of places that do not keep it and of what the worst lacks.
        """
        lacks, required = dict[str, float](), self.space.to_check
        if required is None:
            return lacks
        for one in looked_for(rig, required, self.space.scenarios[0], self.plan.sensor_model):
            worst = 1.0 if math.isnan(one.margin) else max(-one.margin / (abs(one.bound.value) or 1.0), 0.0)
            if one.state != "kept":
                share = (one.failed + one.unknown) / max(one.count, 1)
                lacks[f"{one.requirement}, {one.bound.words}"] = (worst + share) / 2
        return lacks

    def state_dict(self) -> dict[str, Any]:
        """All that a checkpoint keeps: the evaluations."""
        return {"evaluations": [evaluation.record() for evaluation in self.evaluations]}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on from those of a search that was ended."""
        for record in state_dict["evaluations"]:
            self._note(Evaluation.of_record(record))

    def _too_many_self_hits(self, prefix: Prefix) -> str:
        most = self.space.constraints.max_self_hits
        if most is None or prefix.self_hit_share <= most:
            return ""
        return f"{prefix.self_hit_share:.1%} of its rays end on the vehicle; max_self_hits is {most:.1%}"

    @cached_property
    def _start_unit(self) -> Unit | None:
        values = self.space.start_values()
        if len(values) < len(self.space.variables):
            return None
        return np.array([variable.unit(values[variable.name]) for variable in self.space.variables])

    def _is_budget_left(self) -> bool:
        if self._exhausted or time.monotonic() > self.until:
            return False
        return self.plan.evaluations is None or len(self.evaluations) <= self.plan.evaluations

    def _check_turn(self, candidate: Evaluation) -> None:
        if candidate.number != len(self.evaluations):
            raise ValueError(f"candidate {len(self.evaluations)} is to be told next; got candidate {candidate.number}")

    def _note(self, evaluation: Evaluation) -> None:
        if evaluation.number == 0:
            self._begin(evaluation)
        else:
            self.arms[evaluation.arm].tell(evaluation)
        self.evaluations.append(evaluation)

    def _begin(self, start: Evaluation) -> None:
        if start.instants != len(self.instants):
            raise ValueError(f"the start is to be scored at all {len(self.instants)} instants; got {start.instants}")
        for name, value in zip(self.space.asked, start.prefixes[-1].estimate.value.tolist(), strict=True):
            if math.isnan(value):
                why = "one of its regions and bands is never seen; take larger ones, more worlds or more rays"
                if self.space.asked[name].requires:
                    why = "nowhere is room for the body; take another place"
                raise ValueError(f"objectives.{name}: unknown at all {start.instants} instants: {why}")
        makes = {OPTIMISER: self.plan.makes_optimiser, RANDOM: RandomSearch}
        for name, each in makes.items():
            seed = int(np.random.SeedSequence([self.plan.seed, SEEDS[name]]).generate_state(1)[0])
            cube = self._cube(start.infeasible)
            self.arms[name] = Arm(name, each, cube, seed, start, len(self.space.objectives), self._floors(start))

    def _floors(self, start: Evaluation) -> Float64:
        """(numbers,) what each must not be worse than: what is required, what it is at the start; NaN of objectives."""
        value, kept = start.prefixes[-1].estimate.value.tolist(), self.space.floors
        pairs = zip(self.space.asked, value, strict=True)
        return np.array([math.nan if name in self.space.objectives else kept.get(name, own) for name, own in pairs])

    def _cube(self, start_infeasible: str = "") -> Cube:
        return Cube(levels_of(self.space), None if start_infeasible else self._start_unit)
