"""What a placement search is asked to do, without the space."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, cast

from torchcover import __version__
from torchcover.coverage import Measure
from torchcover.placement.choice_space import ChoiceSpace
from torchcover.placement.common_instants import EVERY_S, MEASURES, PER_WORLD, RAYS, WORLDS, CommonInstants
from torchcover.placement.optimisers import OPTIMISERS, MakesOptimiser
from torchcover.placement.space import SearchSpace
from torchcover.placement.variables import FreeChoice
from torchcover.simulation.regions_of_interest import DEFAULT_BAND_FRAME

FRESH_WORLDS = 16


MakesInstants = Callable[[SearchSpace, "SearchPlan", int, int], CommonInstants]


def common_instants(space: SearchSpace | ChoiceSpace, plan: "SearchPlan", seed: int, worlds: int) -> CommonInstants:
    """Instants of the worlds of a seed."""
    of_plan = ("per_world", "every_s", "rays", "estimate", "sensor_model", "workers")
    settings: dict[str, Any] = {name: getattr(plan, name) for name in of_plan}
    return CommonInstants(space.scenarios, space.asked, worlds=worlds, seed=seed, **settings)


@dataclass(frozen=True)
class SearchPlan:
    """Budget, worlds and seeds of a placement search.

    Args:
        evaluations: Candidates to look at after the start, those of the control included; or
        budget_s: seconds for all of it, the instants and the test on fresh worlds included. One of the two is needed.
        optimiser: A name in `OPTIMISERS`, or whatever makes an `Optimiser` from a `Cube` and a seed.
        seed: Of the worlds that candidates are scored in, and of all that is drawn; fresh worlds have the next.
        estimate: What a score is: "area", the share of the visible surface, or "known", the mean of the known cells.
        sensor_model: What sensors make of their hits, "ideal" or "real"; not given: real where that is known of them.
        worlds: Worlds of each scenario to search in.
        fresh_worlds: Worlds of each to test in.
        per_world: Instants of each world.
        every_s: Time between them.
        rays: About how many rays the reference casts at each.
        workers: Processes that score; 0 scores in this one. Results do not depend on it.
        instants: What makes instants: `CommonInstants`, or anything that can be asked for the same.

    Raises:
        ValueError: Values that make no sense.
    """

    evaluations: int | None = None
    budget_s: float | None = None
    optimiser: str | MakesOptimiser = "gp"
    seed: int = 0
    estimate: Measure = "area"
    sensor_model: Literal["ideal", "real"] | None = None
    worlds: int = WORLDS
    fresh_worlds: int = FRESH_WORLDS
    per_world: int = PER_WORLD
    every_s: float = EVERY_S
    rays: int = RAYS
    workers: int = 0
    instants: MakesInstants = common_instants

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
        if isinstance(self.optimiser, str) and self.optimiser not in OPTIMISERS:
            raise ValueError(f"optimiser: one of {', '.join(OPTIMISERS)} is needed; got {self.optimiser!r}")

    @property
    def seed_of_test(self) -> int:
        """Of the fresh worlds: another one than that of the search."""
        return self.seed + 1

    @property
    def optimiser_name(self) -> str:
        """What the optimiser is called."""
        name = self.optimiser if isinstance(self.optimiser, str) else getattr(self.optimiser, "__name__", None)
        return name or str(self.optimiser)

    @property
    def makes_optimiser(self) -> MakesOptimiser:
        """What makes it."""
        return OPTIMISERS[self.optimiser] if isinstance(self.optimiser, str) else self.optimiser

    def settings(self, space: SearchSpace) -> dict[str, Any]:
        """All that decides which candidates are asked for, for JSON.

        Raises:
            ValueError: The sensor model is to be real, and of no sensor of the start that is known.
        """
        content = {"space": space.content(), "scenarios": [scenario.content() for scenario in space.scenarios]}
        text = json.dumps(content, sort_keys=True, default=str)
        return {
            "torchcover": __version__,
            "space": space.name,
            "space_sha256": hashlib.sha256(text.encode()).hexdigest(),
            "optimiser": self.optimiser_name,
            "estimate": self.estimate,
            "sensor_model": space.start.sensing(self.sensor_model).sensor_model,
            "band_frame": DEFAULT_BAND_FRAME,
            **{name: getattr(self, name) for name in ("seed", "worlds", "per_world", "every_s", "rays")},
        }


def levels_of(space: SearchSpace) -> tuple[int, ...]:
    """As of `Cube`."""
    variables = cast("Sequence[object]", space.variables)
    return tuple(len(each.options) if isinstance(each, FreeChoice) else 0 for each in variables)
