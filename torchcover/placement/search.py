"""Placement search with Optuna: candidates are proposed, scored on common frames, and compared with the start."""

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
    """A candidate and its scores.

    Args:
        number: Its position in the search; 0 is the start.
        strategy: "start", "optimizer" or "random".
        values: Values of the variables.
        rig: The rig, until it is scored.
        estimate: The numbers of the space on all frames; None if it was not scored.
        self_hit_share: Share of its rays that end on the vehicle.
        infeasible_reason: Reason why the rig is impossible; empty if it is possible.
        shortfalls: Requirement of targets or encounters -> relative shortfall, of those that are not met.
        duration_s: Time that the evaluation took.
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
        """Whether the rig is possible and was scored."""
        return self.estimate is not None and not self.infeasible_reason

    def to_record(self) -> dict[str, Any]:
        """Return everything but the rig, for JSON."""
        names = ("number", "strategy", "values", "self_hit_share", "infeasible", "shortfalls", "seconds")
        record: dict[str, Any] = {name: getattr(self, name) for name in names}
        if self.estimate is not None:
            tensors = self.estimate.value, self.estimate.jackknife_values, self.estimate.frame_counts
            record["estimate"] = [[*map(list, self.estimate.quantities)], *(tensor.tolist() for tensor in tensors)]
        return record

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Self:
        """Return the evaluation that `record` described."""
        given = dict(record)
        if (parts := given.pop("estimate", None)) is not None:
            quantities, value, left_out, steps = parts
            tensors = [torch.tensor(numbers, dtype=torch.float64, device="cpu") for numbers in (value, left_out)]
            left_out = tensors[1].view(-1, len(value))
            estimate = Estimate(
                tuple(Quantity(*each) for each in quantities), tensors[0], left_out, torch.tensor(steps, device="cpu")
            )
            given["estimate"] = estimate
        return cls(**given)


class PlacementSearch:
    """Looks for a better rig in a space by Bayesian optimization.

    Evaluation 0 is the start. Proposals depend on the space, the seed and the scores so far, and on nothing else.

    Args:
        space: Free variables, constraints and objectives.
        plan: Budget, worlds and seeds; or, instead of it, its arguments by name.

    Raises:
        ValueError: Values of the plan that are out of range.
        ImportError: Optuna is not installed.

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
        """Return the next possible rig; impossible ones before it are recorded as infeasible.

        Returns:
            A candidate; None when the budget is spent, or no combination of choices is left.
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
        """Record the score of a candidate; with too many rays on the vehicle, it is infeasible.

        Args:
            candidate: The last that `ask` returned, with its shortfalls.
            score: From `frames.score`.
            duration_s: Time that it took.

        Raises:
            ValueError: Another candidate; of the start, an unknown objective.
        """
        self._check_turn(candidate)
        estimate, limit = score.estimate, self.space.constraints.max_self_hit_share
        reasons = [] if candidate.number else list(self.space.find_violations(self.space.start))
        if limit is not None and score.self_hit_share > limit:
            reasons.append(
                f"{score.self_hit_share:.1%} of its rays end on the vehicle; max_self_hit_share is {limit:.1%}"
            )
        if candidate.number == 0:
            self._check_start(estimate)
        scored = replace(
            candidate, rig=None, estimate=estimate, self_hit_share=score.self_hit_share, duration_s=duration_s
        )
        self.evaluations.append(replace(scored, infeasible_reason="; ".join(reasons)))

    def reject(self, candidate: Evaluation, reason: str, *, duration_s: float = 0.0) -> None:
        """Record that a candidate is impossible.

        Raises:
            ValueError: Another than the last that `ask` returned, or it is the start.
        """
        self._check_turn(candidate)
        if candidate.number == 0:
            raise ValueError(f"the start, {self.space.start.name}, cannot be scored: {reason}")
        self.evaluations.append(replace(candidate, rig=None, infeasible_reason=reason, duration_s=duration_s))

    def evaluate(self, candidate: Evaluation) -> None:
        """Score a candidate on all frames, check the requirements of targets and encounters, and record both."""
        assert candidate.rig is not None  # until it is scored
        began_s = time.perf_counter()
        try:
            score = self.frames.score(candidate.rig)
        except ValueError as error:
            self.reject(candidate, str(error), duration_s=time.perf_counter() - began_s)
            return
        checked = replace(candidate, shortfalls=self._check_requirements(candidate.rig))
        self.tell(checked, score, duration_s=time.perf_counter() - began_s)

    @property
    def improvements(self) -> Float64:
        """(evaluations, objectives) improvement over the start, in units of the objectives.

        All of a row are NaN if the rig is infeasible or one of its objectives is unknown.
        """
        count = len(self.space.objectives)
        rows = [
            self.compare_with_start(each)[0][:count] if each.is_valid else np.full(count, np.nan)
            for each in self.evaluations
        ]
        gains = np.array(rows).reshape(-1, count)
        return np.where(np.isnan(gains).any(axis=1, keepdims=True), np.nan, gains)

    def compare_with_start(self, evaluation: Evaluation) -> tuple[Float64, Float64]:
        """Return (numbers,) improvements of a scored candidate over the start, and their standard errors."""
        start = self.evaluations[0].estimate
        assert evaluation.estimate is not None
        assert start is not None
        return compute_improvements(evaluation.estimate, start)

    def find_shortfalls(self, evaluation: Evaluation) -> dict[str, float]:
        """Return what a candidate misses of what must be kept, by name, relative to it."""
        margins = self._margins(evaluation)
        return {name: margin for name, margin in margins.items() if margin > ROUNDING} | dict(evaluation.shortfalls)

    def find_best(self, strategies: tuple[str, ...] = (START, OPTIMIZER, RANDOM)) -> list[int]:
        """Return numbers of the candidates that no other dominates, among those with the least total shortfall.

        With one objective they are the best and its equals; with several the Pareto front.
        """
        is_known = ~np.isnan(self.improvements[:, 0])
        valid = [at for at, each in enumerate(self.evaluations) if is_known[at] and each.strategy in strategies]
        missing = [sum(self.find_shortfalls(self.evaluations[at]).values()) for at in valid]
        valid = [at for at, miss in zip(valid, missing, strict=True) if miss <= min(missing) + ROUNDING]
        front = find_non_dominated(self.improvements[valid]).tolist()
        return [at for at, is_on_front in zip(valid, front, strict=True) if is_on_front]

    def select_compromise(self, front: list[int]) -> int | None:
        """Return the candidate of a front whose worst objective is best, each relative to the front's span."""
        moved = [at for at in front if at] or front if len(self.space.objectives) > 1 else front
        if not moved:
            return None
        gains = self.improvements[front]
        low, span = gains.min(axis=0), np.ptp(gains, axis=0)
        scaled = (self.improvements[moved] - low) / np.where(span > 0, span, 1.0)
        return moved[int(np.argmax(scaled.min(axis=1) + 0.05 * scaled.mean(axis=1)))]

    def _margins(self, evaluation: Evaluation) -> dict[str, float]:
        """Return for each number with a bound how far the candidate is on its wrong side, relative to the bound.

        Bounds are those of the requirements, and values of the start that must not become worse. Unknown counts as 1.
        """
        start = self.evaluations[0].estimate
        if evaluation.estimate is None or start is None:
            return {}
        margins: dict[str, float] = {}
        for at, quantity in enumerate(start.quantities):
            if quantity.key in self.space.objectives:
                continue
            bound = self.space.bounds.get(quantity.key, float(start.value[at]))
            margin = -quantity.compute_improvement(float(evaluation.estimate.value[at]) - bound) / max(
                abs(bound), ROUNDING
            )
            margins[quantity.key] = 1.0 if math.isnan(margin) else margin
        return margins

    def _check_requirements(self, rig: Rig) -> dict[str, float]:
        """Return shortfalls of targets and encounters: mean of the failed share and of the worst relative margin."""
        shortfalls, required = dict[str, float](), self.space.non_region_requirements
        if required is None:
            return shortfalls
        for verdict in check_requirements(rig, required, self.space.scenarios[0], self.plan.sensor_model):
            if verdict.state == "kept":
                continue
            margin = -verdict.margin / (abs(verdict.bound.value) or 1.0)
            worst = 1.0 if math.isnan(margin) else max(margin, 0.0)
            failed_share = (verdict.not_met_count + verdict.undecided_count) / max(verdict.total_count, 1)
            shortfalls[f"{verdict.requirement}, {verdict.bound.text}"] = (worst + failed_share) / 2
        return shortfalls

    def _propose(self, number: int) -> tuple[str, dict[str, VariableValue] | None]:
        """Return the strategy and the values of a candidate, which was not proposed before; None if none is left."""
        seed = int(np.random.SeedSequence([self.plan.seed, number]).generate_state(1)[0])
        trials, params = self._trials(), self.plan.optimizer_params
        if number <= params.num_startup_candidates or number % params.random_interval == 0 or not trials:
            strategy, values = RANDOM, self._random_values(seed, number)
        else:
            strategy, values = OPTIMIZER, self._round(propose_by_model(self.space, trials, seed))
        known = [evaluation.values for evaluation in self.evaluations]
        if values not in known:
            return strategy, values
        options = [variable.options for variable in self.space.variables if isinstance(variable, FreeChoice)]
        count = math.prod(map(len, options))
        if len(options) < len(self.space.variables) or count > params.max_combinations:
            return RANDOM, self._random_values(seed + 1, number)
        names = [variable.name for variable in self.space.variables]
        unknown = [
            each for each in (dict(zip(names, one, strict=True)) for one in product(*options)) if each not in known
        ]
        return strategy, unknown[seed % len(unknown)] if unknown else None

    def _random_values(self, seed: int, number: int) -> dict[str, VariableValue]:
        """Return uniformly distributed values; those of the startup are a Latin hypercube, which covers all options."""
        variables, startup = self.space.variables, self.plan.optimizer_params.num_startup_candidates
        shares = np.random.default_rng(seed).random(len(variables))
        if number <= startup:
            order = np.random.default_rng(self.plan.seed)
            strata = np.array([order.permutation(startup)[number - 1] for _ in variables])
            shares = (strata + shares) / startup
        return {
            variable.name: variable.get_value(share) for variable, share in zip(variables, shares.tolist(), strict=True)
        }

    def _round(self, values: Mapping[str, VariableValue]) -> dict[str, VariableValue]:
        return {variable.name: variable.round_value(values[variable.name]) for variable in self.space.variables}

    def _trials(self) -> list[tuple[dict[str, VariableValue], list[float], dict[str, float]]]:
        """Return values, gains and constraints of all candidates, for the model.

        An infeasible rig counts as the worst that was scored. A constraint is met if it is not above 0; before any
        rig meets all, the model learns the total shortfall alone.
        """
        gains = self.improvements
        if np.isnan(gains).all():
            return []
        worst = np.nanmin(gains, axis=0)
        constraints = [self._constraints(evaluation) for evaluation in self.evaluations]
        largest = {name: max(each.get(name, 0.0) for each in constraints) for each in constraints for name in each}
        complete = [
            evaluation for evaluation in self.evaluations if len(evaluation.values) == len(self.space.variables)
        ]
        trials = [
            (
                each.values,
                np.where(np.isnan(gains[each.number]), worst, gains[each.number]).tolist(),
                constraints[each.number] or {name: max(value, 1.0) for name, value in largest.items()},
            )
            for each in complete
        ]
        missing = [sum(max(value, 0.0) for value in limits.values()) for _, _, limits in trials]
        if min(missing, default=0.0) > 0:
            return [(values, [-miss], {}) for (values, _, _), miss in zip(trials, missing, strict=True)]
        return trials

    def _constraints(self, evaluation: Evaluation) -> dict[str, float]:
        if not evaluation.is_valid:
            return {}
        of_bodies = (
            {} if self.space.non_region_requirements is None else {"requirements": sum(evaluation.shortfalls.values())}
        )
        return self._margins(evaluation) | of_bodies

    def _is_budget_left(self) -> bool:
        if self._is_exhausted or time.monotonic() > self.deadline_s:
            return False
        return self.plan.num_evaluations is None or len(self.evaluations) <= self.plan.num_evaluations

    def _check_turn(self, candidate: Evaluation) -> None:
        if candidate.number != len(self.evaluations):
            raise ValueError(f"candidate {len(self.evaluations)} is to be told next; got candidate {candidate.number}")

    def _check_start(self, estimate: Estimate) -> None:
        for name, value in zip(self.space.scored_objectives, estimate.value.tolist(), strict=True):
            if not math.isnan(value):
                continue
            objective = self.space.scored_objectives[name]
            why = "one of its regions and bands is never visible; take larger ones, more worlds or more rays"
            if objective.requirement:
                why = "there is no room for the target anywhere; take another place"
            raise ValueError(f"objectives.{name}: unknown in all {len(self.frames)} frames: {why}")


def compute_improvements(estimate: Estimate, baseline: Estimate) -> tuple[Float64, Float64]:
    """Return (numbers,) paired improvements of one rig over another on the same frames, and their standard errors.

    In units of the numbers; more is better. NaN where one is unknown; errors need three worlds.
    """
    between = estimate.subtract(baseline)
    sign = [quantity.compute_improvement(1.0) for quantity in between.quantities]
    return between.value.numpy() * sign, between.compute_errors(3).numpy()


def find_non_dominated(values: Float64) -> Bools:
    """Return which of (candidates, objectives) no other equals everywhere and exceeds somewhere. Higher is better.

    Example:
        >>> find_non_dominated(np.array([[1.0, 2.0], [2.0, 1.0], [1.0, 1.0]])).tolist()
        [True, True, False]
    """
    is_as_good = np.all(values[:, None] >= values[None], axis=2)
    is_better = np.any(values[:, None] > values[None], axis=2)
    return np.asarray(~(is_as_good & is_better).any(axis=0), dtype=bool)
