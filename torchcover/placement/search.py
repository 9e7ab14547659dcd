"""A placement search: it asks for candidates, is told their scores, and spends half of its budget on a control."""

import math
import time
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchcover.placement.arm import Arm
from torchcover.placement.evaluation import (
    OPTIMISER,
    RANDOM,
    START,
    Candidate,
    Evaluation,
    Numbers,
)
from torchcover.placement.instants import Instants
from torchcover.placement.optimisers import Cube, RandomSearch
from torchcover.placement.optimisers.optimiser import Unit
from torchcover.placement.plan import SearchPlan, levels_of
from torchcover.placement.racing import paired, race, racing_order
from torchcover.placement.scores import Scores
from torchcover.placement.space import SearchSpace

if TYPE_CHECKING:
    from torchcover.placement.result import SearchResult

# What is drawn by the control is nothing that the optimiser draws.
SEEDS = {OPTIMISER: 0, RANDOM: 1}


class PlacementSearch:
    """Looks for a better rig in a space, beside a random search with the same budget.

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
        ...     search.tell(candidate, search.instants.score(candidate.rig))
        >>> [evaluation.arm for evaluation in search.evaluations]
        ['start', 'optimiser', 'random']
    """

    def __init__(self, space: SearchSpace, plan: SearchPlan | None = None, **settings: Any) -> None:  # noqa: ANN401
        self.space = space
        self.plan = SearchPlan(**settings) if plan is None else plan
        self.optimiser_name, self._makes_optimiser = self.plan.optimiser_in(space)
        self.evaluations: list[Evaluation] = []
        self.arms: dict[str, Arm] = {}
        self._exhausted = False
        self.until = math.inf  # by the monotonic clock: when nothing more is asked for
        self._makes_optimiser(self._cube(), self.plan.seed)  # fails now, if it does

    @cached_property
    def instants(self) -> Instants:
        """What candidates are scored on: built when first asked for."""
        return self.plan.instants(self.space, self.plan, self.plan.seed, self.plan.worlds)

    @property
    def share_saved(self) -> float:
        """Of the instants that candidates would have been scored at without racing."""
        spent = [one.instants for one in self.evaluations[1:] if one.instants]
        return 1.0 - sum(spent) / (len(spent) * len(self.instants)) if spent else 0.0

    def run(self, out: str | Path | None = None, *, resume: bool = False, progress: bool = False) -> "SearchResult":
        """Spend the budget and test what was found in fresh worlds; see `run_search`."""
        from torchcover.placement.running import run_search

        return run_search(self, None if out is None else Path(out), resume=resume, progress=progress)

    def ask(self) -> Candidate | None:
        """The next candidate that can be mounted and keeps to the constraints; those before are noted as infeasible.

        Returns:
            It; None when the evaluations are spent, or the optimiser has nothing left to ask for.
        """
        if not self.evaluations:
            if self.plan.budget_s is not None:
                self.until = time.monotonic() + self.plan.budget_s
            values = self.space.start_values()
            return Candidate(0, START, self._start_unit, values, self.space.start)
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
                return Candidate(number, arm.name, unit, values, rig)
            self._note(Evaluation(number, arm.name, unit, values, None, why))
        return None

    def tell(self, candidate: Candidate, scores: Scores, *, seconds: float = 0.0) -> None:
        """What a candidate scored; with too many rays on the vehicle, it cannot be.

        Args:
            candidate: The last that was asked for.
            scores: From `instants.score`, at all instants or at some; of the start at all.
            seconds: What it took.

        Raises:
            ValueError: Another candidate; of the start, scores at some instants only, or an unknown objective.
        """
        self._check_turn(candidate)
        wrong = [] if candidate.number else list(self.space.violations(candidate.rig))
        wrong += [why] if (why := self._too_many_self_hits(scores)) else []
        self._note(_evaluation(candidate, scores, "; ".join(wrong), seconds))

    def refuse(self, candidate: Candidate, why: str, *, seconds: float = 0.0) -> None:
        """Say that a candidate cannot be.

        Raises:
            ValueError: Another than the last that was asked for, or it is the start.
        """
        self._check_turn(candidate)
        if candidate.number == 0:
            raise ValueError(f"the start, {self.space.start.name}, cannot be scored: {why}")
        self._note(_evaluation(candidate, None, why, seconds))

    def evaluate(self, candidate: Candidate) -> None:
        """Score a candidate and tell it: at a few instants at a time, until it is beaten or was scored at all."""
        began = time.perf_counter()
        draws = np.random.SeedSequence([self.plan.seed, candidate.number]).generate_state(1)
        order = racing_order(self.instants.world_of, int(draws[0]))
        incumbents = self.arms[candidate.arm].incumbents if candidate.number else []
        try:
            (raced,) = race(self._scored, [candidate], order, incumbents=incumbents, measure=self.plan.measure)
        except ValueError as error:
            self.refuse(candidate, str(error), seconds=time.perf_counter() - began)
        else:
            self.tell(candidate, raced.scores, seconds=time.perf_counter() - began)

    def replay(self, evaluations: Iterable[Evaluation]) -> None:
        """Go on from those of a search that was ended, all of them from the start on."""
        for evaluation in evaluations:
            self._note(evaluation)

    def _scored(self, candidate: Candidate, instants: Numbers) -> Scores:
        scores = self.instants.score(candidate.rig, instants)
        if candidate.number and (why := self._too_many_self_hits(scores)):
            raise ValueError(why)  # no need to look at more instants
        return scores

    def _too_many_self_hits(self, scores: Scores) -> str:
        most = self.space.constraints.max_self_hits
        if most is None or scores.self_hit_share <= most:
            return ""
        return f"{scores.self_hit_share:.1%} of its rays end on the vehicle; max_self_hits is {most:.1%}"

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

    def _check_turn(self, candidate: Candidate) -> None:
        if candidate.number != len(self.evaluations):
            raise ValueError(f"candidate {len(self.evaluations)} is to be told next; got candidate {candidate.number}")

    def _note(self, evaluation: Evaluation) -> None:
        if evaluation.number == 0:
            self._begin(evaluation)
        else:
            self.arms[evaluation.arm].tell(evaluation)
        self.evaluations.append(evaluation)

    def _begin(self, start: Evaluation) -> None:
        scores = start.scores
        if scores is None or len(scores.instants) != len(self.instants):
            raise ValueError(f"the start is to be scored at all {len(self.instants)} instants; got {start.instants}")
        known = paired(scores, scores, self.plan.measure).worlds.tolist()
        for name, worlds in zip(self.space.objectives, known, strict=True):
            if not worlds:
                raise ValueError(
                    f"objectives.{name}: unknown at all {start.instants} instants: none shows all of its regions and "
                    "bands; take larger ones, more worlds or more rays"
                )
        makes = {OPTIMISER: self._makes_optimiser, RANDOM: RandomSearch}
        for name, each in makes.items():
            seed = int(np.random.SeedSequence([self.plan.seed, SEEDS[name]]).generate_state(1)[0])
            self.arms[name] = Arm(name, each, self._cube(start.infeasible), seed, start, self.plan.measure)

    def _cube(self, start_infeasible: str = "") -> Cube:
        return Cube(levels_of(self.space), None if start_infeasible else self._start_unit)


def _evaluation(candidate: Candidate, scores: Scores | None, infeasible: str, seconds: float) -> Evaluation:
    return Evaluation(candidate.number, candidate.arm, candidate.unit, candidate.values, scores, infeasible, seconds)
