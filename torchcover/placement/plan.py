"""Plan of a placement search, and its optimizer: a Gaussian process of Optuna."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from hashlib import sha256
from types import ModuleType
from typing import Any, Literal

import numpy as np

from torchcover import __version__
from torchcover.coverage import Measure
from torchcover.placement.common_frames import EVERY_S, FRAMES_PER_WORLD, MEASURES, RAYS, WORLDS, CommonFrames
from torchcover.placement.free_sensor import FreeChoice, Value
from torchcover.placement.host_vehicle import VehicleSpace
from torchcover.placement.space import SearchSpace
from torchcover.simulation.regions_of_interest import DEFAULT_BAND_FRAME

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
    spans = distributions_of(space)
    sampler = optuna.samplers.GPSampler(seed=seed, n_startup_trials=1, warn_independent_sampling=False)
    directions = ["maximize"] * len(trials[0][1])
    study = run_quietly(optuna, lambda: optuna.create_study(directions=directions, sampler=sampler))
    study.add_trials(
        optuna.create_trial(params=values, distributions=spans, values=gains, constraints=constraints or None)
        for values, gains, constraints in trials
    )
    return dict(run_quietly(optuna, lambda: study.ask(spans)).params)


def distributions_of(space: SearchSpace) -> dict[str, Any]:
    """Return the distribution of Optuna of each variable, by name."""
    kinds = import_optuna().distributions
    return {
        variable.name: kinds.CategoricalDistribution(variable.options)
        if isinstance(variable, FreeChoice)
        else kinds.FloatDistribution(variable.low, variable.high)
        for variable in space.variables
    }


def run_quietly(optuna: ModuleType, action: Callable[[], Any]) -> Any:  # noqa: ANN401  (objects of Optuna)
    """Do something without Optuna's messages: new studies, and its missing optional package greenlet."""
    level = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        with np.errstate(all="ignore"):  # of acquisition values that are 0 nearly everywhere
            return action()
    finally:
        optuna.logging.set_verbosity(level)
