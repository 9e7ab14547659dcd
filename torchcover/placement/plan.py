"""Plan of a placement search, and its optimizer: a Gaussian process of Optuna."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from hashlib import sha256
from types import ModuleType
from typing import Any, Literal

import numpy as np

from torchcover import __version__
from torchcover.coverage import Average
from torchcover.placement.common_frames import EVERY_S, FRAMES_PER_WORLD, MEASURES, RAYS, WORLDS, CommonFrames
from torchcover.placement.free_sensor import FreeChoice, VariableValue
from torchcover.placement.host_vehicle import PlacementSpace
from torchcover.placement.space import SearchSpace
from torchcover.simulation.regions_of_interest import DEFAULT_BAND_FRAME

FrameFactory = Callable[[SearchSpace, "SearchPlan", int, int], CommonFrames]


@dataclass(frozen=True)
class OptimizerParams:
    """Parameters of the optimizer, a Gaussian process with log expected improvement (Optuna's GPSampler).

    Args:
        num_startup_candidates: Number of random candidates before the first model.
        random_interval: Every so many candidates one more is random: a control of the optimizer, which learns from it.
        max_combinations: A space of choices alone with at most so many rigs is searched without repetition.
    """

    num_startup_candidates: int = 5
    random_interval: int = 3
    max_combinations: int = 4096


def make_common_frames(space: PlacementSpace, plan: "SearchPlan", seed: int, num_scenes: int) -> CommonFrames:
    """Return frames of the scenarios of a space, for a seed and a number of worlds."""
    names = ("per_world", "frame_interval_s", "rays", "estimate", "sensor_model", "workers")
    settings: dict[str, Any] = {name: getattr(plan, name) for name in names}
    return CommonFrames(space.scenarios, space.scored_objectives, num_scenes=num_scenes, seed=seed, **settings)


@dataclass(frozen=True)
class SearchPlan:
    """Budget, worlds and seeds of a placement search.

    Args:
        num_evaluations: Number of candidates after the start; or
        budget_s: seconds for the whole search with its frames and the test on held-out worlds. One of both is needed.
        seed: Seed of the worlds that candidates are scored in and of the candidates; held-out worlds have the next.
        average: Average of a score: "area", the visible surface, or "cells", the mean of the observed cells.
        sensor_model: "ideal" or "real"; if not given, real where the rig's range limits are known.
        num_scenes: Worlds of each scenario to search in.
        num_held_out_scenes: Held-out worlds of each scenario to test in.
        frames_per_scene: Frames of each world.
        frame_interval_s: Time between them in seconds.
        rays: Approximate number of reference rays of each frame.
        workers: Processes that score; 0 scores in this one. Results do not depend on it.
        optimizer_params: Parameters of the optimizer.
        make_frames: Factory of the frames.

    Raises:
        ValueError: Values out of range.
    """

    num_evaluations: int | None = None
    budget_s: float | None = None
    seed: int = 0
    average: Average = "area"
    sensor_model: Literal["ideal", "real"] | None = None
    num_scenes: int = WORLDS
    num_held_out_scenes: int = 16
    frames_per_scene: int = FRAMES_PER_WORLD
    frame_interval_s: float = EVERY_S
    rays: int = RAYS
    workers: int = 0
    optimizer_params: OptimizerParams = OptimizerParams()
    make_frames: FrameFactory = make_common_frames

    def __post_init__(self) -> None:
        if (self.num_evaluations is None) == (self.budget_s is None):
            given = "neither" if self.num_evaluations is None else "both"
            raise ValueError(f"budget: seconds or a number of evaluations is needed; got {given}")
        if self.num_evaluations is not None and self.num_evaluations < 1:
            raise ValueError(f"evaluations: 1 or more is needed; got {self.num_evaluations}")
        if self.budget_s is not None and not self.budget_s > 0:
            raise ValueError(f"budget: more than 0 s is needed; got {self.budget_s:g}")
        if self.average not in MEASURES:
            raise ValueError(f"estimate: one of {', '.join(MEASURES)} is needed; got {self.average!r}")

    @property
    def test_seed(self) -> int:
        """Seed of the held-out worlds, which differs from that of the search."""
        return self.seed + 1

    def collect_settings(self, space: SearchSpace) -> dict[str, Any]:
        """Return everything that decides which candidates are proposed, for JSON.

        Raises:
            ValueError: The sensor model is "real", and no sensor of the start has known range limits.
        """
        content = {
            "space": space.collect_content(),
            "scenarios": [scenario.collect_content() for scenario in space.scenarios],
        }
        text = json.dumps(content, sort_keys=True, default=str)
        return {
            "torchcover": __version__,
            "space": space.name,
            "space_sha256": sha256(text.encode()).hexdigest(),
            "optimizer": str(self.optimizer_params),
            "estimate": self.average,
            "sensor_model": space.start.apply_sensor_model(self.sensor_model).sensor_model,
            "band_frame": DEFAULT_BAND_FRAME,
            **{name: getattr(self, name) for name in ("seed", "worlds", "per_world", "frame_interval_s", "rays")},
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
    space: SearchSpace, observations: list[tuple[dict[str, VariableValue], list[float], dict[str, float]]], seed: int
) -> dict[str, VariableValue]:
    """Return the values with the largest expected improvement, by a Gaussian process of all candidates so far.

    Args:
        space: Its variables and objectives.
        observations: Values, gains, and constraints, of which each is met if it is not above 0.
        seed: Seed of the optimization.
    """
    optuna = import_optuna()
    spans = build_distributions(space)
    sampler = optuna.samplers.GPSampler(seed=seed, n_startup_trials=1, warn_independent_sampling=False)
    directions = ["maximize"] * len(observations[0][1])
    study = run_quietly(optuna, lambda: optuna.create_study(directions=directions, sampler=sampler))
    study.add_trials(
        optuna.create_trial(params=values, distributions=spans, values=gains, constraints=constraints or None)
        for values, gains, constraints in observations
    )
    return dict(run_quietly(optuna, lambda: study.ask(spans)).params)


def build_distributions(space: SearchSpace) -> dict[str, Any]:
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
