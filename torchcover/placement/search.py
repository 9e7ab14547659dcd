"""Placement search with Optuna: propose candidates, score them on common frames, and compare them with the start."""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Any, Self

import numpy as np
import torch

from torchcover.estimation import Estimate, Quantity
from torchcover.geometry.arrays import Bools, Float64
from torchcover.placement.common_frames import CommonFrames, Score
from torchcover.placement.free_sensor import FreeChoice, VariableValue
from torchcover.placement.objective import check_requirements
from torchcover.placement.plan import SearchPlan, import_optuna, propose_by_model
from torchcover.placement.space import SearchSpace
from torchcover.simulation import Rig

START = "start"
OPTIMIZER = "optimizer"
RANDOM = "random"
ROUNDING = 1e-9  # relative; smaller shortfalls are rounding errors


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Candidate with its scores.

    Args:
        number: Position in the search; 0 is the start.
        strategy: "start", "optimizer" or "random".
        values: Values of the variables.
        rig: The rig; None once it is scored.
        estimate: Numbers of the space over all frames; None without a score.
        self_hit_share: Share of rays that hit the vehicle.
        infeasible_reason: Reason why the rig is impossible; empty if it is possible.
        shortfalls: Requirement of targets or encounters that is not met -> relative shortfall.
        duration_s: Duration of the evaluation in seconds.
    """

    number: int
    strategy: str
    values: dict[str, VariableValue]
    rig: Rig | None = None
    estimate: Estimate | None = None
    self_hit_share: float = math.nan
    infeasible_reason: str = ""
    shortfalls: Mapping[str, float] = field(default_factory=dict)
    duration_s: float = 0.0

    @property
    def is_valid(self) -> bool:
        """True if the rig is possible and was scored."""
        return self.estimate is not None and not self.infeasible_reason

    def to_record(self) -> dict[str, Any]:
        """Return everything but the rig, for JSON."""
        record: dict[str, Any] = {
            "number": self.number,
            "strategy": self.strategy,
            "values": self.values,
            "self_hit_share": self.self_hit_share,
            "infeasible_reason": self.infeasible_reason,
            "shortfalls": self.shortfalls,
            "duration_s": self.duration_s,
        }
        if self.estimate is not None:
            tensors = self.estimate.value, self.estimate.jackknife_values, self.estimate.frame_counts
            quantities = [list(quantity) for quantity in self.estimate.quantities]
            record["estimate"] = [quantities, *(tensor.tolist() for tensor in tensors)]
        return record

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Self:
        """Build an evaluation from its record.

        Args:
            record: Result of `to_record`.
        """
        fields = dict(record)
        parts = fields.pop("estimate", None)
        if parts is not None:
            quantities, value, left_out, steps = parts
            fields["estimate"] = Estimate(
                tuple(Quantity(*quantity) for quantity in quantities),
                torch.tensor(value, dtype=torch.float64, device="cpu"),
                torch.tensor(left_out, dtype=torch.float64, device="cpu").view(-1, len(value)),
                torch.tensor(steps, device="cpu"),
            )
        return cls(**fields)


class PlacementSearch:
    """Bayesian optimization of a rig in a search space.

    Evaluation 0 is the start. Proposals depend only on the space, the seed and the previous scores.

    Args:
        space: Free variables, constraints and objectives.
        plan: Budget, scenes and seeds; None takes the arguments of `SearchPlan` from `settings`.
        **settings: Arguments of `SearchPlan`.

    Raises:
        ValueError: A value of the plan is out of range.
        ImportError: Optuna is not installed.

    Example:
        >>> space = SearchSpace(
        ...     name="pitch",
        ...     start="front_roof_32",
        ...     scenario="courtyard",
        ...     free={"roof": {"pitch_deg": (-10.0, 15.0)}},
        ...     objectives={"near": {"band": "ground", "region": "20m"}},
        ... )
        >>> search = PlacementSearch(space, num_evaluations=2, frames_per_scene=1, num_rays=1024)
        >>> while (candidate := search.ask()) is not None:
        ...     search.tell(candidate, search.frames.score(candidate.rig))
        >>> [evaluation.strategy for evaluation in search.evaluations]
        ['start', 'random', 'random']
    """

    def __init__(self, space: SearchSpace, plan: SearchPlan | None = None, **settings: Any) -> None:  # noqa: ANN401
        self.space = space
        self.plan = SearchPlan(**settings) if plan is None else plan
        self.evaluations: list[Evaluation] = []
        self.deadline_s = math.inf  # time of the monotonic clock after which nothing is proposed
        self._is_exhausted = False
        import_optuna()

    @cached_property
    def frames(self) -> CommonFrames:
        """Frames that candidates are scored on, made when first used."""
        return self.plan.make_frames(self.space, self.plan, self.plan.seed, self.plan.num_scenes)

    def ask(self) -> Evaluation | None:
        """Propose the next possible rig; impossible ones before it are recorded as infeasible.

        Returns:
            A candidate; None when the budget is spent or no combination of choices is left.
        """
        if not self.evaluations:
            if self.plan.budget_s is not None:
                self.deadline_s = time.monotonic() + self.plan.budget_s
            return Evaluation(0, START, self.space.get_start_values(), self.space.start)
        while self._is_budget_left():
            number = len(self.evaluations)
            strategy, values = self._propose(number)
            if values is None:
                self._is_exhausted = True
                break
            try:
                rig = self.space.build_rig(values, f"{self.space.name}_{number}")
                reason = "; ".join(self.space.find_violations(rig))
            except ValueError as error:
                reason = str(error)
            if not reason:
                return Evaluation(number, strategy, values, rig)
            self.evaluations.append(Evaluation(number, strategy, values, infeasible_reason=reason))
        return None

    def tell(self, candidate: Evaluation, score: Score, *, duration_s: float = 0.0) -> None:
        """Record the score of a candidate; too many self hits make it infeasible.

        Args:
            candidate: The last result of `ask`, with its shortfalls.
            score: Result of `frames.score`.
            duration_s: Duration of the evaluation in seconds.

        Raises:
            ValueError: It is another candidate, or an objective of the start is unknown.
        """
        self._check_turn(candidate)
        estimate, limit = score.estimate, self.space.constraints.max_self_hit_share
        reasons = [] if candidate.number else list(self.space.find_violations(self.space.start))
        if limit is not None and score.self_hit_share > limit:
            reasons.append(f"{score.self_hit_share:.1%} of its rays hit the vehicle; max_self_hit_share is {limit:.1%}")
        if candidate.number == 0:
            self._check_start(estimate)
        scored = replace(
            candidate, rig=None, estimate=estimate, self_hit_share=score.self_hit_share, duration_s=duration_s
        )
        self.evaluations.append(replace(scored, infeasible_reason="; ".join(reasons)))

    def reject(self, candidate: Evaluation, reason: str, *, duration_s: float = 0.0) -> None:
        """Record that a candidate is impossible.

        Args:
            candidate: The last result of `ask`.
            reason: Reason in words.
            duration_s: Duration of the evaluation in seconds.

        Raises:
            ValueError: It is another candidate, or the start.
        """
        self._check_turn(candidate)
        if candidate.number == 0:
            raise ValueError(f"the start, {self.space.start.name}, cannot be scored: {reason}")
        self.evaluations.append(replace(candidate, rig=None, infeasible_reason=reason, duration_s=duration_s))

    def evaluate(self, candidate: Evaluation) -> None:
        """Score a candidate on all frames, check the requirements of targets and encounters, and record both.

        Args:
            candidate: The last result of `ask`.
        """
        assert candidate.rig is not None  # a candidate without a score has its rig
        start_s = time.perf_counter()
        try:
            score = self.frames.score(candidate.rig)
        except ValueError as error:
            self.reject(candidate, str(error), duration_s=time.perf_counter() - start_s)
            return
        checked = replace(candidate, shortfalls=self._check_requirements(candidate.rig))
        self.tell(checked, score, duration_s=time.perf_counter() - start_s)

    @property
    def improvements(self) -> Float64:
        """(evaluations, objectives) improvement over the start, in units of the objectives.

        A row is NaN if the rig is infeasible or one of its objectives is unknown.
        """
        improvements = np.full((len(self.evaluations), len(self.space.objectives)), np.nan)
        for row, evaluation in zip(improvements, self.evaluations, strict=True):
            if evaluation.is_valid:
                row[:] = self.compare_with_start(evaluation)[0][: len(row)]
        return np.where(np.isnan(improvements).any(axis=1, keepdims=True), np.nan, improvements)

    def compare_with_start(self, evaluation: Evaluation) -> tuple[Float64, Float64]:
        """Compute the improvements of a scored candidate over the start.

        Args:
            evaluation: The candidate.

        Returns:
            (numbers,) improvements and (numbers,) standard errors.
        """
        start = self.evaluations[0].estimate
        assert evaluation.estimate is not None
        assert start is not None
        return compute_improvements(evaluation.estimate, start)

    def find_shortfalls(self, evaluation: Evaluation) -> dict[str, float]:
        """Compute the relative shortfalls of a candidate below its bounds.

        Args:
            evaluation: The candidate.

        Returns:
            Name of a bounded number or requirement -> shortfall, only where there is one.
        """
        shortfalls = self._compute_shortfalls(evaluation)
        large = {name: shortfalls[name] for name in shortfalls if shortfalls[name] > ROUNDING}
        return {**large, **evaluation.shortfalls}

    def find_best(self, strategies: tuple[str, ...] = (START, OPTIMIZER, RANDOM)) -> list[int]:
        """Find the candidates that no other dominates, among those with the smallest total shortfall.

        Args:
            strategies: Strategies whose candidates are compared.

        Returns:
            Numbers of the candidates: with one objective the best and its equals, with several the Pareto front.
        """
        is_known = ~np.isnan(self.improvements[:, 0])
        valid = []
        for number, evaluation in enumerate(self.evaluations):
            if is_known[number] and evaluation.strategy in strategies:
                valid.append(number)
        totals = {number: sum(self.find_shortfalls(self.evaluations[number]).values()) for number in valid}
        smallest_total = min(totals.values(), default=0.0)
        valid = [number for number in valid if totals[number] <= smallest_total + ROUNDING]
        is_on_front = find_non_dominated(self.improvements[valid])
        return [valid[index] for index in np.flatnonzero(is_on_front)]

    def select_compromise(self, front: list[int]) -> int | None:
        """Select the candidate of a front whose worst objective is best, each relative to the range of the front.

        Args:
            front: Numbers of candidates.

        Returns:
            Number of the candidate; None if the front is empty.
        """
        candidates = front
        if len(self.space.objectives) > 1:  # the start is no compromise if there is another candidate
            candidates = [number for number in front if number] or front
        if not candidates:
            return None
        improvements = self.improvements[front]
        low, span = improvements.min(axis=0), np.ptp(improvements, axis=0)
        scaled = (self.improvements[candidates] - low) / np.where(span > 0, span, 1.0)
        # The mean decides between candidates with the same worst objective.
        return candidates[int(np.argmax(scaled.min(axis=1) + 0.05 * scaled.mean(axis=1)))]

    def _compute_shortfalls(self, evaluation: Evaluation) -> dict[str, float]:
        """Compute for each bounded number the shortfall relative to its bound; negative if the bound is met.

        Bounds are those of the requirements, and values of the start that must not become worse. An unknown number
        has the shortfall 1.
        """
        start = self.evaluations[0].estimate
        if evaluation.estimate is None or start is None:
            return {}
        shortfalls: dict[str, float] = {}
        for index, quantity in enumerate(start.quantities):
            if quantity.key in self.space.objectives:
                continue
            bound = self.space.bounds.get(quantity.key, float(start.value[index]))
            margin = quantity.compute_improvement(float(evaluation.estimate.value[index]) - bound)
            shortfall = -margin / max(abs(bound), ROUNDING)
            shortfalls[quantity.key] = 1.0 if math.isnan(shortfall) else shortfall
        return shortfalls

    def _check_requirements(self, rig: Rig) -> dict[str, float]:
        """Return shortfalls of targets and encounters: mean of the failed share and of the worst relative margin."""
        shortfalls: dict[str, float] = {}
        requirements = self.space.non_region_requirements
        if requirements is None:
            return shortfalls
        for verdict in check_requirements(rig, requirements, self.space.scenarios[0], self.plan.sensor_model):
            if verdict.state == "met":
                continue
            margin = -verdict.margin / (abs(verdict.bound.value) or 1.0)
            worst = 1.0 if math.isnan(margin) else max(margin, 0.0)
            failed_share = (verdict.not_met_count + verdict.undecided_count) / max(verdict.total_count, 1)
            shortfalls[f"{verdict.requirement}, {verdict.bound.text}"] = (worst + failed_share) / 2
        return shortfalls

    def _propose(self, number: int) -> tuple[str, dict[str, VariableValue] | None]:
        """Propose the strategy and new values of a candidate; the values are None if none are left."""
        seed = int(np.random.SeedSequence([self.plan.seed, number]).generate_state(1)[0])
        observations, params = self._collect_observations(), self.plan.optimizer_params
        if number <= params.num_startup_candidates or number % params.random_interval == 0 or not observations:
            strategy, values = RANDOM, self._sample_values(seed, number)
        else:
            proposed = propose_by_model(self.space, observations, seed)
            values = {variable.name: variable.round_value(proposed[variable.name]) for variable in self.space.variables}
            strategy = OPTIMIZER
        evaluated = [evaluation.values for evaluation in self.evaluations]
        if values not in evaluated:
            return strategy, values
        options = [variable.options for variable in self.space.variables if isinstance(variable, FreeChoice)]
        combination_count = math.prod(len(names) for names in options)
        if len(options) < len(self.space.variables) or combination_count > params.max_combinations:
            return RANDOM, self._sample_values(seed + 1, number)
        names = [variable.name for variable in self.space.variables]
        combinations = [dict(zip(names, combination, strict=True)) for combination in product(*options)]
        remaining = [combination for combination in combinations if combination not in evaluated]
        return strategy, remaining[seed % len(remaining)] if remaining else None

    def _sample_values(self, seed: int, number: int) -> dict[str, VariableValue]:
        """Sample uniform values; the startup values form a Latin hypercube, which contains all options."""
        variables, startup_count = self.space.variables, self.plan.optimizer_params.num_startup_candidates
        fractions = np.random.default_rng(seed).random(len(variables))
        if number <= startup_count:
            generator = np.random.default_rng(self.plan.seed)
            strata = np.array([generator.permutation(startup_count)[number - 1] for _ in variables])
            fractions = (strata + fractions) / startup_count
        pairs = zip(variables, fractions.tolist(), strict=True)
        return {variable.name: variable.get_value(fraction) for variable, fraction in pairs}

    def _collect_observations(self) -> list[tuple[dict[str, VariableValue], list[float], dict[str, float]]]:
        """Return values, improvements and constraints of all candidates, for the model.

        An infeasible rig gets the worst improvement of all rigs. A constraint is met if it is at most 0. As long as no
        rig meets all constraints, the model learns only the total shortfall.
        """
        improvements = self.improvements
        if np.isnan(improvements).all():
            return []
        worst = np.nanmin(improvements, axis=0)
        constraints = [self._get_constraints(evaluation) for evaluation in self.evaluations]
        infeasible: dict[str, float] = {}  # largest constraint of any rig, at least 1
        for values_by_name in constraints:
            for name, value in values_by_name.items():
                infeasible[name] = max(infeasible.get(name, 1.0), value)
        observations = []
        for evaluation in self.evaluations:
            if len(evaluation.values) < len(self.space.variables):
                continue  # the start may lie outside the space
            row = improvements[evaluation.number]
            targets = np.where(np.isnan(row), worst, row).tolist()
            observations.append((evaluation.values, targets, constraints[evaluation.number] or dict(infeasible)))
        totals = []
        for _, _, limits in observations:
            totals.append(sum(max(value, 0.0) for value in limits.values()))
        if min(totals, default=0.0) > 0:
            return [(values, [-total], {}) for (values, _, _), total in zip(observations, totals, strict=True)]
        return observations

    def _get_constraints(self, evaluation: Evaluation) -> dict[str, float]:
        """Return the shortfalls that the sampler models; empty for an infeasible candidate."""
        if not evaluation.is_valid:
            return {}
        constraints = self._compute_shortfalls(evaluation)
        if self.space.non_region_requirements is not None:
            constraints["requirements"] = sum(evaluation.shortfalls.values())
        return constraints

    def _is_budget_left(self) -> bool:
        """Return whether another candidate may be evaluated."""
        if self._is_exhausted or time.monotonic() > self.deadline_s:
            return False
        return self.plan.num_evaluations is None or len(self.evaluations) <= self.plan.num_evaluations

    def _check_turn(self, candidate: Evaluation) -> None:
        """Raise ValueError if a candidate is not the last of `ask`."""
        if candidate.number != len(self.evaluations):
            raise ValueError(
                f"candidate: got number {candidate.number}; give the last of `ask`, {len(self.evaluations)}"
            )

    def _check_start(self, estimate: Estimate) -> None:
        """Raise ValueError if an objective is unknown for the start."""
        for name, value in zip(self.space.scored_objectives, estimate.value.tolist(), strict=True):
            if not math.isnan(value):
                continue
            objective = self.space.scored_objectives[name]
            reason = "a region and band is never visible; use larger regions, more scenes or more rays"
            if objective.requirement:
                reason = "no position is free for the target; use other positions"
            raise ValueError(f"objectives.{name}: unknown in all {len(self.frames)} frames: {reason}")


def compute_improvements(estimate: Estimate, baseline: Estimate) -> tuple[Float64, Float64]:
    """Compute the paired improvements of one rig over another on the same frames.

    Args:
        estimate: Numbers of the rig.
        baseline: Numbers of the other rig.

    Returns:
        (numbers,) improvements, positive if better, in units of the numbers, NaN where one is unknown; and (numbers,)
        standard errors, NaN with fewer than three scenes.
    """
    difference = estimate.subtract(baseline)
    signs = [quantity.compute_improvement(1.0) for quantity in difference.quantities]
    return difference.value.numpy() * signs, difference.compute_errors(3).numpy()


def find_non_dominated(values: Float64) -> Bools:
    """Find the candidates that no other equals or exceeds everywhere and exceeds somewhere.

    Args:
        values: (candidates, objectives); higher is better.

    Returns:
        (candidates,) bool.

    Example:
        >>> find_non_dominated(np.array([[1.0, 2.0], [2.0, 1.0], [1.0, 1.0]])).tolist()
        [True, True, False]
    """
    is_as_good = np.all(values[:, None] >= values[None], axis=2)
    is_better = np.any(values[:, None] > values[None], axis=2)
    return np.asarray(~(is_as_good & is_better).any(axis=0), dtype=bool)
