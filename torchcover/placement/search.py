"""Placement search with Optuna: candidates are proposed, scored on common frames, and kept in a journal."""

import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import sha256
from itertools import product
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
import torch

from torchcover import __version__
from torchcover.coverage import Measure
from torchcover.estimation import Estimate, Quantity
from torchcover.evaluation.checkpoint import differences
from torchcover.evaluation.progress import held_back
from torchcover.files import BadFileError, check_memory, reads
from torchcover.geometry.arrays import Bools, Float64
from torchcover.placement.common_frames import EVERY_S, FRAMES_PER_WORLD, MEASURES, RAYS, WORLDS, CommonFrames, Score
from torchcover.placement.free_sensor import FreeChoice, Value
from torchcover.placement.host_vehicle import VehicleSpace
from torchcover.placement.objective import check_requirements
from torchcover.placement.space import SearchSpace
from torchcover.simulation import Rig
from torchcover.simulation.regions_of_interest import DEFAULT_BAND_FRAME

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial

START = "start"
OPTIMIZER = "optimizer"
RANDOM = "random"
JOURNAL = "search.journal"
STUDY = "placement"
ROUNDING = 1e-9  # relative; smaller shortfalls are rounding errors

MakeFrames = Callable[[SearchSpace, "SearchPlan", int, int], CommonFrames]


@dataclass(frozen=True)
class OptimizerParams:
    """Parameters of the optimizer, a Gaussian process with log expected improvement (Optuna's GPSampler).

    Args:
        startup: Number of random candidates before the first model.
        control_every: Every so many candidates one more is random: a control of the optimizer, which learns from it.
        max_combinations: A space of choices alone with at most so many rigs is searched without repetition.
    """

    startup: int = 5
    control_every: int = 3
    max_combinations: int = 4096


def make_common_frames(space: VehicleSpace, plan: "SearchPlan", seed: int, worlds: int) -> CommonFrames:
    """Return frames of the scenarios of a space, for a seed and a number of worlds."""
    names = ("per_world", "every_s", "rays", "estimate", "sensor_model", "workers")
    settings: dict[str, Any] = {name: getattr(plan, name) for name in names}
    return CommonFrames(space.scenarios, space.numbers, worlds=worlds, seed=seed, **settings)


@dataclass(frozen=True)
class SearchPlan:
    """Budget, worlds and seeds of a placement search.

    Args:
        evaluations: Number of candidates after the start; or
        budget_s: seconds for the whole search with its frames and the test on held-out worlds. One of both is needed.
        seed: Seed of the worlds that candidates are scored in and of the candidates; held-out worlds have the next.
        estimate: Average of a score: "area", the visible surface, or "known", the mean of the observed cells.
        sensor_model: "ideal" or "real"; if not given, real where the rig's range limits are known.
        worlds: Worlds of each scenario to search in.
        fresh_worlds: Held-out worlds of each scenario to test in.
        per_world: Frames of each world.
        every_s: Time between them in seconds.
        rays: Approximate number of reference rays of each frame.
        workers: Processes that score; 0 scores in this one. Results do not depend on it.
        optimizer: Parameters of the optimizer.
        make_frames: Factory of the frames.

    Raises:
        ValueError: Values out of range.
    """

    evaluations: int | None = None
    budget_s: float | None = None
    seed: int = 0
    estimate: Measure = "area"
    sensor_model: Literal["ideal", "real"] | None = None
    worlds: int = WORLDS
    fresh_worlds: int = 16
    per_world: int = FRAMES_PER_WORLD
    every_s: float = EVERY_S
    rays: int = RAYS
    workers: int = 0
    optimizer: OptimizerParams = OptimizerParams()
    make_frames: MakeFrames = make_common_frames

    def __post_init__(self) -> None:
        if (self.evaluations is None) == (self.budget_s is None):
            given = "neither" if self.evaluations is None else "both"
            raise ValueError(f"budget: seconds or a number of evaluations is needed; got {given}")
        if self.evaluations is not None and self.evaluations < 1:
            raise ValueError(f"evaluations: 1 or more is needed; got {self.evaluations}")
        if self.budget_s is not None and not self.budget_s > 0:
            raise ValueError(f"budget: more than 0 s is needed; got {self.budget_s:g}")
        if self.estimate not in MEASURES:
            raise ValueError(f"estimate: one of {', '.join(MEASURES)} is needed; got {self.estimate!r}")

    @property
    def seed_of_test(self) -> int:
        """Seed of the held-out worlds, which differs from that of the search."""
        return self.seed + 1

    def settings(self, space: SearchSpace) -> dict[str, Any]:
        """Return everything that decides which candidates are proposed, for JSON.

        Raises:
            ValueError: The sensor model is "real", and no sensor of the start has known range limits.
        """
        content = {"space": space.content(), "scenarios": [scenario.content() for scenario in space.scenarios]}
        text = json.dumps(content, sort_keys=True, default=str)
        return {
            "torchcover": __version__,
            "space": space.name,
            "space_sha256": sha256(text.encode()).hexdigest(),
            "optimizer": str(self.optimizer),
            "estimate": self.estimate,
            "sensor_model": space.start.sensing(self.sensor_model).sensor_model,
            "band_frame": DEFAULT_BAND_FRAME,
            **{name: getattr(self, name) for name in ("seed", "worlds", "per_world", "every_s", "rays")},
        }


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
        infeasible: Reason why the rig is impossible; empty if it is possible.
        shortfalls: Requirement of targets or encounters -> relative shortfall, of those that are not met.
        seconds: Time that the evaluation took.
    """

    number: int
    strategy: str
    values: dict[str, Value]
    rig: Rig | None = None
    estimate: Estimate | None = None
    self_hit_share: float = math.nan
    infeasible: str = ""
    shortfalls: Mapping[str, float] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def is_valid(self) -> bool:
        """Whether the rig is possible and was scored."""
        return self.estimate is not None and not self.infeasible

    def record(self) -> dict[str, Any]:
        """Return everything but the rig, for JSON."""
        names = ("number", "strategy", "values", "self_hit_share", "infeasible", "shortfalls", "seconds")
        record: dict[str, Any] = {name: getattr(self, name) for name in names}
        if self.estimate is not None:
            tensors = self.estimate.value, self.estimate.left_out, self.estimate.steps
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
        self.until_s = math.inf  # time of the monotonic clock after which nothing is proposed
        self._is_exhausted = False
        import_optuna()

    @cached_property
    def frames(self) -> CommonFrames:
        """Frames that candidates are scored on, made when first used."""
        return self.plan.make_frames(self.space, self.plan, self.plan.seed, self.plan.worlds)

    def ask(self) -> Evaluation | None:
        """Return the next possible rig; impossible ones before it are recorded as infeasible.

        Returns:
            A candidate; None when the budget is spent, or no combination of choices is left.
        """
        if not self.evaluations:
            if self.plan.budget_s is not None:
                self.until_s = time.monotonic() + self.plan.budget_s
            return Evaluation(0, START, self.space.start_values(), self.space.start)
        while self._is_budget_left():
            number = len(self.evaluations)
            strategy, values = self._propose(number)
            if values is None:
                self._is_exhausted = True
                break
            try:
                rig = self.space.rig(values, f"{self.space.name}_{number}")
                reason = "; ".join(self.space.violations(rig))
            except ValueError as error:
                reason = str(error)
            if not reason:
                return Evaluation(number, strategy, values, rig)
            self.evaluations.append(Evaluation(number, strategy, values, infeasible=reason))
        return None

    def tell(self, candidate: Evaluation, score: Score, *, seconds: float = 0.0) -> None:
        """Record the score of a candidate; with too many rays on the vehicle, it is infeasible.

        Args:
            candidate: The last that `ask` returned, with its shortfalls.
            score: From `frames.score`.
            seconds: Time that it took.

        Raises:
            ValueError: Another candidate; of the start, an unknown objective.
        """
        self._check_turn(candidate)
        estimate, limit = score.estimate, self.space.constraints.max_self_hits
        reasons = [] if candidate.number else list(self.space.violations(self.space.start))
        if limit is not None and score.self_hit_share > limit:
            reasons.append(f"{score.self_hit_share:.1%} of its rays end on the vehicle; max_self_hits is {limit:.1%}")
        if candidate.number == 0:
            self._check_start(estimate)
        scored = replace(candidate, rig=None, estimate=estimate, self_hit_share=score.self_hit_share, seconds=seconds)
        self.evaluations.append(replace(scored, infeasible="; ".join(reasons)))

    def refuse(self, candidate: Evaluation, reason: str, *, seconds: float = 0.0) -> None:
        """Record that a candidate is impossible.

        Raises:
            ValueError: Another than the last that `ask` returned, or it is the start.
        """
        self._check_turn(candidate)
        if candidate.number == 0:
            raise ValueError(f"the start, {self.space.start.name}, cannot be scored: {reason}")
        self.evaluations.append(replace(candidate, rig=None, infeasible=reason, seconds=seconds))

    def evaluate(self, candidate: Evaluation) -> None:
        """Score a candidate on all frames, check the requirements of targets and encounters, and record both."""
        assert candidate.rig is not None  # until it is scored
        began_s = time.perf_counter()
        try:
            score = self.frames.score(candidate.rig)
        except ValueError as error:
            self.refuse(candidate, str(error), seconds=time.perf_counter() - began_s)
            return
        checked = replace(candidate, shortfalls=self._check_requirements(candidate.rig))
        self.tell(checked, score, seconds=time.perf_counter() - began_s)

    @property
    def gains(self) -> Float64:
        """(evaluations, objectives) improvement over the start, in units of the objectives.

        All of a row are NaN if the rig is infeasible or one of its objectives is unknown.
        """
        count = len(self.space.objectives)
        rows = [self.compare(each)[0][:count] if each.is_valid else np.full(count, np.nan) for each in self.evaluations]
        gains = np.array(rows).reshape(-1, count)
        return np.where(np.isnan(gains).any(axis=1, keepdims=True), np.nan, gains)

    def compare(self, evaluation: Evaluation) -> tuple[Float64, Float64]:
        """Return (numbers,) improvements of a scored candidate over the start, and their standard errors."""
        start = self.evaluations[0].estimate
        assert evaluation.estimate is not None
        assert start is not None
        return measure_gains(evaluation.estimate, start)

    def shortfalls(self, evaluation: Evaluation) -> dict[str, float]:
        """Return what a candidate misses of what must be kept, by name, relative to it."""
        margins = self._margins(evaluation)
        return {name: margin for name, margin in margins.items() if margin > ROUNDING} | dict(evaluation.shortfalls)

    def best_of(self, strategies: tuple[str, ...] = (START, OPTIMIZER, RANDOM)) -> list[int]:
        """Return numbers of the candidates that no other dominates, among those with the least total shortfall.

        With one objective they are the best and its equals; with several the Pareto front.
        """
        is_known = ~np.isnan(self.gains[:, 0])
        valid = [at for at, each in enumerate(self.evaluations) if is_known[at] and each.strategy in strategies]
        missing = [sum(self.shortfalls(self.evaluations[at]).values()) for at in valid]
        valid = [at for at, miss in zip(valid, missing, strict=True) if miss <= min(missing) + ROUNDING]
        front = find_non_dominated(self.gains[valid]).tolist()
        return [at for at, is_on_front in zip(valid, front, strict=True) if is_on_front]

    def pick_compromise(self, front: list[int]) -> int | None:
        """Return the candidate of a front whose worst objective is best, each relative to the front's span."""
        moved = [at for at in front if at] or front if len(self.space.objectives) > 1 else front
        if not moved:
            return None
        gains = self.gains[front]
        low, span = gains.min(axis=0), np.ptp(gains, axis=0)
        scaled = (self.gains[moved] - low) / np.where(span > 0, span, 1.0)
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
            margin = -quantity.gain(float(evaluation.estimate.value[at]) - bound) / max(abs(bound), ROUNDING)
            margins[quantity.key] = 1.0 if math.isnan(margin) else margin
        return margins

    def _check_requirements(self, rig: Rig) -> dict[str, float]:
        """Return shortfalls of targets and encounters: mean of the failed share and of the worst relative margin."""
        shortfalls, required = dict[str, float](), self.space.to_check
        if required is None:
            return shortfalls
        for verdict in check_requirements(rig, required, self.space.scenarios[0], self.plan.sensor_model):
            if verdict.state == "kept":
                continue
            margin = -verdict.margin / (abs(verdict.bound.value) or 1.0)
            worst = 1.0 if math.isnan(margin) else max(margin, 0.0)
            failed_share = (verdict.failed + verdict.unknown) / max(verdict.count, 1)
            shortfalls[f"{verdict.requirement}, {verdict.bound.words}"] = (worst + failed_share) / 2
        return shortfalls

    def _propose(self, number: int) -> tuple[str, dict[str, Value] | None]:
        """Return the strategy and the values of a candidate, which was not proposed before; None if none is left."""
        seed = int(np.random.SeedSequence([self.plan.seed, number]).generate_state(1)[0])
        trials, params = self._trials(), self.plan.optimizer
        if number <= params.startup or number % params.control_every == 0 or not trials:
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

    def _random_values(self, seed: int, number: int) -> dict[str, Value]:
        """Return uniformly distributed values; those of the startup are a Latin hypercube, which covers all options."""
        variables, startup = self.space.variables, self.plan.optimizer.startup
        shares = np.random.default_rng(seed).random(len(variables))
        if number <= startup:
            order = np.random.default_rng(self.plan.seed)
            strata = np.array([order.permutation(startup)[number - 1] for _ in variables])
            shares = (strata + shares) / startup
        return {variable.name: variable.at(share) for variable, share in zip(variables, shares.tolist(), strict=True)}

    def _round(self, values: Mapping[str, Value]) -> dict[str, Value]:
        return {variable.name: variable.rounded(values[variable.name]) for variable in self.space.variables}

    def _trials(self) -> list[tuple[dict[str, Value], list[float], dict[str, float]]]:
        """Return values, gains and constraints of all candidates, for the model.

        An infeasible rig counts as the worst that was scored. A constraint is met if it is not above 0; before any
        rig meets all, the model learns the total shortfall alone.
        """
        gains = self.gains
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
        of_bodies = {} if self.space.to_check is None else {"requirements": sum(evaluation.shortfalls.values())}
        return self._margins(evaluation) | of_bodies

    def _is_budget_left(self) -> bool:
        if self._is_exhausted or time.monotonic() > self.until_s:
            return False
        return self.plan.evaluations is None or len(self.evaluations) <= self.plan.evaluations

    def _check_turn(self, candidate: Evaluation) -> None:
        if candidate.number != len(self.evaluations):
            raise ValueError(f"candidate {len(self.evaluations)} is to be told next; got candidate {candidate.number}")

    def _check_start(self, estimate: Estimate) -> None:
        for name, value in zip(self.space.numbers, estimate.value.tolist(), strict=True):
            if not math.isnan(value):
                continue
            objective = self.space.numbers[name]
            why = "one of its regions and bands is never visible; take larger ones, more worlds or more rays"
            if objective.requires:
                why = "there is no room for the target anywhere; take another place"
            raise ValueError(f"objectives.{name}: unknown in all {len(self.frames)} frames: {why}")


def measure_gains(estimate: Estimate, other: Estimate) -> tuple[Float64, Float64]:
    """Return (numbers,) paired improvements of one rig over another on the same frames, and their standard errors.

    In units of the numbers; more is better. NaN where one is unknown; errors need three worlds.
    """
    between = estimate.minus(other)
    sign = [quantity.gain(1.0) for quantity in between.quantities]
    return between.value.numpy() * sign, between.errors(3).numpy()


def find_non_dominated(values: Float64) -> Bools:
    """Return which of (candidates, objectives) no other equals everywhere and exceeds somewhere. Higher is better.

    Example:
        >>> find_non_dominated(np.array([[1.0, 2.0], [2.0, 1.0], [1.0, 1.0]])).tolist()
        [True, True, False]
    """
    is_as_good = np.all(values[:, None] >= values[None], axis=2)
    is_better = np.any(values[:, None] > values[None], axis=2)
    return np.asarray(~(is_as_good & is_better).any(axis=0), dtype=bool)


def import_optuna() -> ModuleType:
    """Return the package Optuna. ImportError: it is not installed."""
    try:
        import optuna
    except ImportError as error:
        raise ImportError("a placement search needs Optuna: pip install 'torchcover[search]'") from error
    module: ModuleType = optuna
    return module


def propose_by_model(
    space: SearchSpace, trials: list[tuple[dict[str, Value], list[float], dict[str, float]]], seed: int
) -> dict[str, Value]:
    """Return the values with the largest expected improvement, by a Gaussian process of all candidates so far.

    Args:
        space: Its variables and objectives.
        trials: Values, gains, and constraints, of which each is met if it is not above 0.
        seed: Seed of the optimization.
    """
    optuna = import_optuna()
    spans = _distributions(space)
    sampler = optuna.samplers.GPSampler(seed=seed, n_startup_trials=1, warn_independent_sampling=False)
    directions = ["maximize"] * len(trials[0][1])
    study = _quietly(optuna, lambda: optuna.create_study(directions=directions, sampler=sampler))
    study.add_trials(
        optuna.create_trial(params=values, distributions=spans, values=gains, constraints=constraints or None)
        for values, gains, constraints in trials
    )
    return dict(_quietly(optuna, lambda: study.ask(spans)).params)


def _distributions(space: SearchSpace) -> dict[str, Any]:
    kinds = import_optuna().distributions
    return {
        variable.name: kinds.CategoricalDistribution(variable.options)
        if isinstance(variable, FreeChoice)
        else kinds.FloatDistribution(variable.low, variable.high)
        for variable in space.variables
    }


def _quietly(optuna: ModuleType, action: Callable[[], Any]) -> Any:  # noqa: ANN401  (objects of Optuna)
    """Do something without Optuna's messages: new studies, and its missing optional package greenlet."""
    level = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        with np.errstate(all="ignore"):  # of acquisition values that are 0 nearly everywhere
            return action()
    finally:
        optuna.logging.set_verbosity(level)


class SearchJournal:
    """The evaluations of a search in a file: an Optuna study in a journal of JSON lines, one for each evaluation.

    Args:
        path: The file, in a folder that no other search writes to.
        search: The search that it belongs to.
    """

    def __init__(self, path: Path, search: PlacementSearch) -> None:
        self.path = path
        self._search = search
        self._written = 0
        self._study: Any = None
        settings = search.plan.settings(search.space)
        self._settings = {name: str(value) for name, value in settings.items()}

    def resume(self) -> None:
        """Load the evaluations of the file, if there is one.

        Raises:
            ValueError: It belongs to another search.
            BadFileError: It is damaged, or the start has another score today.
        """
        if not self.path.exists():
            return
        search = self._search
        self._study, evaluations, settings = load_study(self.path)
        if other := differences(self._settings, settings):
            raise ValueError(
                f"{self.path}: the journal of another search: {other}; resume with the settings of that search, or "
                "choose another folder"
            )
        earlier = evaluations[0].estimate
        today = search.frames.score(search.space.start).estimate
        if earlier is None or not torch.equal(today.value, earlier.value):
            raise BadFileError(
                f"{self.path}: the start has another score today: the version of a package, or a file that the space "
                "names, has changed; begin anew, without --resume"
            )
        drop_torn_line(self.path)
        search.evaluations[:] = evaluations
        self._written = len(evaluations)

    def write(self) -> None:
        """Append all evaluations that are not in the file yet."""
        with held_back():
            if self._study is None:
                self.path.unlink(missing_ok=True)
                self._study = self._create()
            for evaluation in self._search.evaluations[self._written :]:
                self._study.add_trial(self._trial(evaluation))
                self._written += 1

    def _create(self) -> Any:  # noqa: ANN401  (a study of Optuna)
        optuna = import_optuna()
        directions = ["maximize"] * len(self._search.space.objectives)
        make = optuna.create_study
        study = _quietly(optuna, lambda: make(storage=_storage(self.path), study_name=STUDY, directions=directions))
        study.set_user_attr("settings", self._settings)
        return study

    def _trial(self, evaluation: Evaluation) -> "FrozenTrial":
        optuna, spans = import_optuna(), _distributions(self._search.space)
        values = dict(evaluation.values)
        gains = self._search.gains[evaluation.number].tolist()
        state = optuna.trial.TrialState.COMPLETE
        if math.isnan(gains[0]):
            state, gains = optuna.trial.TrialState.FAIL, None
        known = {name: spans[name] for name in values}
        attributes = {"evaluation": evaluation.record()}
        trial: FrozenTrial = optuna.create_trial(
            params=values, distributions=known, values=gains, state=state, user_attrs=attributes
        )
        return trial


def _storage(path: Path) -> Any:  # noqa: ANN401  (a storage of Optuna)
    journal = import_optuna().storages.journal
    return import_optuna().storages.JournalStorage(journal.JournalFileBackend(str(path)))


def drop_torn_line(path: Path) -> None:
    """Cut off what a process was writing when it was ended: a last line without a line break."""
    with path.open("r+b") as file:
        file.truncate(file.read().rfind(b"\n") + 1)


@reads("the journal of a placement search")
def load_study(path: Path) -> tuple[Any, list[Evaluation], dict[str, str]]:
    """Return the study in a journal, its evaluations and its settings. Only JSON is read; no code is executed."""
    check_memory(4 * path.stat().st_size)
    optuna = import_optuna()
    study = _quietly(optuna, lambda: optuna.load_study(storage=_storage(path), study_name=STUDY))
    settings = study.user_attrs["settings"]
    records = [trial.user_attrs["evaluation"] for trial in study.trials]
    evaluations = [Evaluation.from_record(record) for record in records]
    if not evaluations or [evaluation.number for evaluation in evaluations] != list(range(len(evaluations))):
        raise ValueError("its evaluations are not numbered from 0 on")
    if not all(isinstance(value, str) for value in settings.values()):
        raise ValueError("its settings are not texts")
    return study, evaluations, settings
