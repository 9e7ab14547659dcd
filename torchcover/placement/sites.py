"""Where rigs are scored: scenarios, the worlds in them, and the instants of these."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Self

from torchcover.placement.objective import Objective
from torchcover.placement.question_grid import QuestionGrid
from torchcover.simulation import Scenario, Simulator, with_ego


class Site(NamedTuple):
    """A scenario in which rigs are scored.

    Args:
        scenario: With its ego.
        grid: What is asked about around that.
        rays: About how many rays the reference casts at an instant.
        seed: Seed of traffic and reference.
        every_s: Time between two steps.
    """

    scenario: Scenario
    grid: QuestionGrid
    rays: int
    seed: int
    every_s: float

    @classmethod
    def of(
        cls,
        scenario: Scenario,
        objectives: Mapping[str, Objective],
        vehicle: str | Path | None,
        *,
        rays: int,
        seed: int,
        every_s: float,
    ) -> Self:
        """Where rigs on a vehicle are scored by some objectives; see `CommonInstants`."""
        world = with_ego(scenario, {}, vehicle)
        return cls(world, QuestionGrid.around(world.ego_box().outline_m, objectives), rays, seed, every_s)

    def simulator(self) -> Simulator:
        """It with no rig; what was built is kept for good."""
        reference = self.grid.reference_sensor(self.rays)
        return Simulator(self.scenario, {}, reference, seed=self.seed, every_s=self.every_s, kept_bytes=float("inf"))


class HeldInstant(NamedTuple):
    """Which instant: `number` among all, `site`, `step` there, and `world` among all worlds."""

    number: int
    site: int
    step: int
    world: int


def instants_of(sites: Sequence[Site], worlds: int, per_world: int) -> list[HeldInstant]:
    """The instants of all sites, world by world.

    Args:
        sites: Where.
        worlds: Worlds of each with traffic.
        per_world: Instants in each.

    Raises:
        ValueError: A run through a scenario has fewer instants.
    """
    instants: list[HeldInstant] = []
    first_world = 0
    for number, site in enumerate(sites):
        of_worlds = _steps(site.simulator(), site, worlds, per_world)
        for world, indices in enumerate(of_worlds, first_world):
            instants += [HeldInstant(len(instants) + k, number, index, world) for k, index in enumerate(indices)]
        first_world += len(of_worlds)
    return instants


def _steps(simulator: Simulator, site: Site, worlds: int, per_world: int) -> list[list[int]]:
    """Numbers of the steps of each world."""
    if site.scenario.repeats:
        # Where nothing moves every step draws another reference.
        distinct = simulator.distinct_steps
        return [list(range(per_world if distinct in (None, 1) else min(per_world, distinct or 0)))]
    of_worlds: list[list[int]] = [[] for _ in range(worlds)]
    index = 0
    while (world := simulator.run_of(index)) < worlds:
        if len(of_worlds[world]) < per_world:
            of_worlds[world].append(index)
        index += 1
    if (fewest := min(map(len, of_worlds))) < per_world:
        raise ValueError(
            f"per_world: a run of {site.scenario.name!r} has {fewest} instants that are {site.every_s:g} s apart; got "
            f"{per_world}"
        )
    return of_worlds
