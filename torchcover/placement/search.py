"""A placement search: it asks for candidates, is told their scores, and spends half of its budget on a control."""

import time
from collections.abc import Iterable
from functools import cached_property
from typing import Any

import numpy as np

from torchcover.placement.arm import Arm
from torchcover.placement.evaluation import (
    OPTIMISER,
    RANDOM,
    START,
    Candidate,
    Evaluation,
    Float64,
    Instants,
    Numbers,
)
from torchcover.placement.optimisers import Cube, RandomSearch
from torchcover.placement.plan import SearchPlan, levels_of
from torchcover.placement.racing import batches
from torchcover.placement.scores import Scores
from torchcover.placement.space import SearchSpace

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
        ...     search.tell(candidate, search.instants.score(candidate.rig).area)
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
        self._makes_optimiser(Cube(levels_of(space), self._start_unit), self.plan.seed)  # fails now, if it does

    @cached_property
    def instants(self) -> Instants:
        """What candidates are scored on: built when first asked for."""
        return self.plan.instants(self.space, self.plan, self.plan.seed, self.plan.worlds)

    @property
    def spent_s(self) -> float:
        """Seconds that the evaluations took."""
        return sum(evaluation.seconds for evaluation in self.evaluations)

    @property
    def share_saved(self) -> float:
        """Of the instants that candidates would have been scored at without racing."""
        looked_at = [one for one in self.evaluations[1:] if len(one.instants)]
        if not looked_at:
            return 0.0
        return 1.0 - sum(len(one.instants) for one in looked_at) / (len(looked_at) * len(self.instants))

    def ask(self) -> Candidate | None:
        """The next candidate that can be mounted and keeps to the constraints; those before are noted as infeasible.

        Returns:
            It; None when the evaluations are spent, or the optimiser has nothing left to ask for.
        """
        if not self.evaluations:
            values = self.space.start_values()
            return Candidate(0, START, self._start_unit, values, self.space.start)
        while (number := len(self.evaluations)) <= (self.plan.evaluations or number) and not self._exhausted:
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
            self._note(Evaluation(number, arm.name, unit, values, *self._nothing, infeasible=why))
        return None

    def tell(
        self,
        candidate: Candidate,
        scores: Float64,
        instants: Numbers | None = None,
        *,
        self_hit_share: float = float("nan"),
        seconds: float = 0.0,
    ) -> None:
        """What a candidate scored.

        Args:
            candidate: The last that was asked for.
            scores: (n, objectives); NaN where one is unknown.
            instants: (n,) numbers of the instants; all of them if not given.
            self_hit_share: Share of its rays that the vehicle took; beyond `max_self_hits` it cannot be.
            seconds: What it took.

        Raises:
            ValueError: Another candidate, scores of another shape, or an objective that nobody knows of the start.
        """
        self._check_turn(candidate)
        numbers = np.arange(len(self.instants)) if instants is None else np.asarray(instants, dtype=np.int64)
        expected = len(numbers), len(self.space.objectives)
        if np.shape(scores) != expected:
            raise ValueError(f"scores: {expected} are needed, instants and objectives; got {np.shape(scores)}")
        evaluation = Evaluation(
            candidate.number,
            candidate.arm,
            candidate.unit,
            candidate.values,
            numbers,
            np.asarray(scores, dtype=np.float64),
            self._why_not(candidate, self_hit_share),
            self_hit_share,
            seconds,
        )
        self._note(evaluation)

    def refuse(self, candidate: Candidate, why: str, seconds: float = 0.0) -> None:
        """Say that a candidate cannot be.

        Raises:
            ValueError: Another than the last that was asked for, or it is the start.
        """
        self._check_turn(candidate)
        if candidate.number == 0:
            raise ValueError(f"the start, {self.space.start.name}, cannot be scored: {why}")
        unit, values = candidate.unit, candidate.values
        self._note(
            Evaluation(candidate.number, candidate.arm, unit, values, *self._nothing, infeasible=why, seconds=seconds)
        )

    def evaluate(self, candidate: Candidate) -> None:
        """Score a candidate and tell it: a few instants at a time, until it is beaten or all are done."""
        began, scores = time.perf_counter(), None
        for batch in batches(self.instants.world_of, self.plan.seed, candidate.number):
            try:
                more = self.instants.score(candidate.rig, batch)
            except ValueError as error:
                self.refuse(candidate, str(error), time.perf_counter() - began)
                return
            scores = more if scores is None else scores.joined(more)
            if candidate.number and self._is_done(candidate, scores):
                break
        assert scores is not None  # there is an instant at least
        self.tell(
            candidate,
            self.measured(scores),
            scores.instants,
            self_hit_share=scores.self_hit_share,
            seconds=time.perf_counter() - began,
        )

    def measured(self, scores: Scores) -> Float64:
        """(n, objectives) in the measure of the plan."""
        return scores.area if self.plan.measure == "area" else scores.known

    def replay(self, evaluations: Iterable[Evaluation]) -> None:
        """Go on from those of a search that was ended, all of them from the start on."""
        for evaluation in evaluations:
            self._note(evaluation)

    def _is_done(self, candidate: Candidate, scores: Scores) -> bool:
        if self._why_not(candidate, scores.self_hit_share):
            return True
        return self.arms[candidate.arm].beaten(scores.instants, self.measured(scores))

    def _why_not(self, candidate: Candidate, self_hit_share: float) -> str:
        most = self.space.constraints.max_self_hits
        why = [] if candidate.number else list(self.space.violations(candidate.rig))
        if most is not None and self_hit_share > most:
            why.append(f"{self_hit_share:.1%} of its rays end on the vehicle; max_self_hits is {most:.1%}")
        return "; ".join(why)

    @cached_property
    def _start_unit(self) -> Float64 | None:
        values = self.space.start_values()
        if len(values) < len(self.space.variables):
            return None
        return np.array([variable.unit(values[variable.name]) for variable in self.space.variables])

    @property
    def _nothing(self) -> tuple[Numbers, Float64]:
        return np.zeros(0, dtype=np.int64), np.zeros((0, len(self.space.objectives)))

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
        unknown = np.isnan(start.scores).all(axis=0).tolist()
        for name, is_unknown in zip(self.space.objectives, unknown, strict=True):
            if is_unknown:
                raise ValueError(
                    f"objectives.{name}: unknown at all {len(start.instants)} instants: none shows its regions and "
                    "bands; take larger ones, more worlds or more rays"
                )
        makes = {OPTIMISER: self._makes_optimiser, RANDOM: RandomSearch}
        cube = Cube(levels_of(self.space), None if start.infeasible else start.unit)
        for name, each in makes.items():
            seed = int(np.random.SeedSequence([self.plan.seed, SEEDS[name]]).generate_state(1)[0])
            self.arms[name] = Arm(name, each, cube, seed, start, self.instants.world_of)
