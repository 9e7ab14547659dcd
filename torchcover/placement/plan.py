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
from torchcover.placement.common_frames import CommonFrames
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
        random_interval: Every n-th candidate is random: a control of the optimizer, which learns from it too.
        max_combinations: Maximum number of combinations of a space of choices that is searched without repetition.
    """

    num_startup_candidates: int = 5
    random_interval: int = 3
    max_combinations: int = 4096


def make_common_frames(space: PlacementSpace, plan: "SearchPlan", seed: int, num_scenes: int) -> CommonFrames:
    """Build the frames on which candidates of a space are scored.

    Args:
        space: Its scenarios and objectives.
        plan: Settings of the frames.
        seed: Seed of the scenes.
        num_scenes: Number of scenes of each scenario.
    """
    return CommonFrames(
        space.scenarios,
        space.scored_objectives,
        num_scenes=num_scenes,
        frames_per_scene=plan.frames_per_scene,
        frame_interval_s=plan.frame_interval_s,
        seed=seed,
        num_rays=plan.num_rays,
        average=plan.average,
        sensor_model=plan.sensor_model,
        num_workers=plan.num_workers,
    )


@dataclass(frozen=True)
class SearchPlan:
    """Budget, scenes and seeds of a placement search.

    Args:
        num_evaluations: Number of candidates after the start; either this or `budget_s` is needed.
        budget_s: Time in seconds for the whole search, including its frames and the validation.
        seed: Seed of the scenes of the search and of the candidates; held-out scenes have the next seed.
        average: Average of a score: "area" over visible surface, "cells" over observed cells.
        sensor_model: "ideal" or "real"; None takes "real" where the range limits of the rig are known.
        num_scenes: Number of scenes of each scenario in the search.
        num_held_out_scenes: Number of held-out scenes of each scenario in the validation.
        frames_per_scene: Number of frames of each scene.
        frame_interval_s: Time between two frames in seconds.
        num_rays: Approximate number of reference rays of each frame.
        num_workers: Number of processes that score; 0 scores in this one. Results do not depend on it.
        optimizer_params: Parameters of the optimizer.
        make_frames: Factory of the frames.

    Raises:
        ValueError: A value is out of range.
    """

    num_evaluations: int | None = None
    budget_s: float | None = None
    seed: int = 0
    average: Average = "area"
    sensor_model: Literal["ideal", "real"] | None = None
    num_scenes: int = 6
    num_held_out_scenes: int = 16
    frames_per_scene: int = 3
    frame_interval_s: float = 20.0
    num_rays: int = 16_384
    num_workers: int = 0
    optimizer_params: OptimizerParams = OptimizerParams()
    make_frames: FrameFactory = make_common_frames

    def __post_init__(self) -> None:
        if (self.num_evaluations is None) == (self.budget_s is None):
            arrived = "neither" if self.num_evaluations is None else "both"
            raise ValueError(f"budget, num_evaluations: got {arrived}; give one of the two")
        if self.num_evaluations is not None and self.num_evaluations < 1:
            raise ValueError(f"num_evaluations: got {self.num_evaluations}; give 1 or more")
        if self.budget_s is not None and not self.budget_s > 0:
            raise ValueError(f"budget: got {self.budget_s:g} s; give more than 0 s")
        if self.average not in ("area", "cells"):
            raise ValueError(f"average: got {self.average!r}; give area or cells")

    @property
    def test_seed(self) -> int:
        """Seed of the held-out scenes, which differs from the seed of the search."""
        return self.seed + 1

    def collect_settings(self, space: SearchSpace) -> dict[str, Any]:
        """Collect everything that determines the proposed candidates, for JSON.

        Args:
            space: The search space.

        Raises:
            ValueError: The sensor model is "real", but the start rig has no sensor with a known detection range.
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
            "average": self.average,
            "sensor_model": space.start.apply_sensor_model(self.sensor_model).sensor_model,
            "band_frame": DEFAULT_BAND_FRAME,
            "seed": self.seed,
            "num_scenes": self.num_scenes,
            "frames_per_scene": self.frames_per_scene,
            "frame_interval_s": self.frame_interval_s,
            "num_rays": self.num_rays,
        }


def import_optuna() -> ModuleType:
    """Import the package Optuna. ImportError: it is not installed."""
    try:
        import optuna
    except ImportError as error:
        raise ImportError("a placement search needs Optuna: pip install 'torchcover[search]'") from error
    module: ModuleType = optuna
    return module


def propose_by_model(
    space: SearchSpace, observations: list[tuple[dict[str, VariableValue], list[float], dict[str, float]]], seed: int
) -> dict[str, VariableValue]:
    """Propose the values with the largest expected improvement, by a Gaussian process of all candidates.

    Args:
        space: Its variables and objectives.
        observations: Values, improvements and constraints of each candidate; a constraint is met if it is at most 0.
        seed: Seed of the optimization.

    Returns:
        Values by variable.
    """
    optuna = import_optuna()
    distributions = build_distributions(space)
    sampler = optuna.samplers.GPSampler(seed=seed, n_startup_trials=1, warn_independent_sampling=False)
    directions = ["maximize"] * len(observations[0][1])
    study = run_quietly(optuna, optuna.create_study, directions=directions, sampler=sampler)
    for values, improvements, constraints in observations:
        trial = optuna.create_trial(
            params=values, distributions=distributions, values=improvements, constraints=constraints or None
        )
        study.add_trial(trial)
    return dict(run_quietly(optuna, study.ask, distributions).params)


def build_distributions(space: SearchSpace) -> dict[str, Any]:
    """Build the Optuna distribution of each variable.

    Args:
        space: Its variables.

    Returns:
        Distributions by the name of the variable.
    """
    optuna = import_optuna()
    distributions: dict[str, Any] = {}
    for variable in space.variables:
        if isinstance(variable, FreeChoice):
            distributions[variable.name] = optuna.distributions.CategoricalDistribution(variable.options)
        else:
            distributions[variable.name] = optuna.distributions.FloatDistribution(variable.low, variable.high)
    return distributions


def run_quietly(optuna: ModuleType, action: Callable[..., Any], *args: Any, **options: Any) -> Any:  # noqa: ANN401
    """Call a function of Optuna without its log messages, such as those on new studies.

    Args:
        optuna: The package.
        action: The function.
        *args: Its positional arguments.
        **options: Its keyword arguments.

    Returns:
        Result of the function.
    """
    level = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        with np.errstate(all="ignore"):  # acquisition values are 0 nearly everywhere
            return action(*args, **options)
    finally:
        optuna.logging.set_verbosity(level)
