"""Instants of many worlds that any rig is scored on: held once, with their reference."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchcover.placement.bits import Bits
from torchcover.placement.held_worlds import HeldInstant, HeldWorlds, Look, Site
from torchcover.placement.objective import Objective
from torchcover.placement.question_grid import QuestionGrid, ReferencePoints
from torchcover.placement.scores import Scores
from torchcover.simulation import Rig, Scenario, Simulator, with_ego

WORLDS = 6
PER_WORLD = 3
EVERY_S = 20.0
RAYS = 16_384
BUDGET_BYTES = 2e9

AnyScenario = Scenario | str | Path


class CommonInstants:
    """Instants of many worlds, held once with the points of their reference; a rig costs one scan and one search each.

    Every rig sees the same instants as `SimulatedFrames` shows them and is measured against the same reference points,
    so that differences are paired. Scores depend on the arguments alone, and not on the number of workers.

    Args:
        scenarios: What is played, one or several.
        objectives: What rigs are scored by, by name.
        vehicle: What carries the rigs: a built-in vehicle, the YAML file of one, or a mesh file. Not given: each
            scenario's own ego, else an SUV.
        worlds: Worlds of each scenario that has traffic; any other scenario is one world.
        per_world: Instants in each.
        every_s: Time between them.
        seed: Seed of the traffic and of the reference.
        rays: About how many rays the reference casts at each instant.
        budget_bytes: What all worlds may take.
        workers: Processes that hold the worlds; 0 holds them in this one.

    Raises:
        FileNotFoundError: An unknown name or file.
        ValueError: No scenario, objective or world; a region or a band that nobody knows; a run with fewer instants;
            worlds beyond the budget; an objective that is unknown in every world.

    Example:
        >>> near = Objective(region="20m", band="ground")
        >>> instants = CommonInstants(["courtyard"], {"near": near}, per_world=1, rays=2048)
        >>> scores = instants.score(Rig.load("front_roof_128"))
        >>> len(instants), scores.area.shape, bool(0.5 < scores.area[0, 0] < 1)
        (1, (1, 1), True)
    """

    def __init__(
        self,
        scenarios: AnyScenario | Sequence[AnyScenario],
        objectives: Mapping[str, Objective],
        *,
        vehicle: str | Path | None = None,
        worlds: int = WORLDS,
        per_world: int = PER_WORLD,
        every_s: float = EVERY_S,
        seed: int = 0,
        rays: int = RAYS,
        budget_bytes: float = BUDGET_BYTES,
        workers: int = 0,
    ) -> None:
        given = (scenarios,) if isinstance(scenarios, Scenario | str | Path) else tuple(scenarios)
        for name, number in (("scenarios", len(given)), ("objectives", len(objectives))):
            if number == 0:
                raise ValueError(f"{name}: at least one is needed; got none")
        for name, number in (("worlds", worlds), ("per_world", per_world)):
            if number < 1:
                raise ValueError(f"{name}: at least 1 is needed; got {number}")
        loaded = [one if isinstance(one, Scenario) else Scenario.load(one) for one in given]
        self.seed = seed
        self.objectives = dict(objectives)
        self._takes_any_ego = [vehicle is None and (one.ego is None or one.ego.shape is None) for one in loaded]
        self.sites = [_site(one, objectives, vehicle, rays, seed, every_s) for one in loaded]
        self._instants = _instants(self.sites, worlds, per_world)
        questions = self.sites[0].grid.questions
        self._parts = {name: tuple(map(questions.index, one.questions)) for name, one in objectives.items()}
        self._thresholds_m = tuple(dict.fromkeys(question.threshold_m for question in questions))
        self._here = HeldWorlds(self.sites, self._instants, budget_bytes)
        self.references: tuple[ReferencePoints, ...] = tuple(
            self._here.references[number] for number in range(len(self._instants))
        )

    @property
    def world_of(self) -> NDArray[np.int64]:
        """(instants,) int64 which world each instant is of: worlds are independent of each other."""
        return np.array([instant.world for instant in self._instants], dtype=np.int64)

    def __len__(self) -> int:
        return len(self._instants)

    def score(self, rig: Rig, instants: Sequence[int] | NDArray[np.int64] | None = None) -> Scores:
        """What a rig scores.

        Args:
            rig: The sensors.
            instants: Numbers of the instants; all if not given.

        Raises:
            ValueError: The rig cannot be mounted: a sensor inside the vehicle or another body, or below the ground; an
                instant that there is none of.
        """
        return self.scores(self.bits(rig, instants))

    def bits(self, rig: Rig, instants: Sequence[int] | NDArray[np.int64] | None = None) -> Bits:
        """Which reference points a rig sees; `scores` says what that is worth.

        Args:
            rig: The sensors.
            instants: Numbers of the instants; all if not given.

        Raises:
            ValueError: As in `score`.
        """
        numbers = list(range(len(self))) if instants is None else [int(number) for number in instants]
        looks: list[Look] = self._here.look(rig, numbers)
        return Bits(
            np.array(numbers, dtype=np.int64),
            np.concatenate([look.seen for look in looks], axis=1),
            np.array([look.self_hits for look in looks], dtype=np.int64),
            looks[0].rays,
        )

    def scores(self, bits: Bits) -> Scores:
        """What it is worth to see some reference points.

        Args:
            bits: From `bits`, or the OR of several.
        """
        numbers = bits.instants.tolist()
        questions = self.sites[0].grid.questions
        seen_m2, visible_m2, known = np.empty((3, len(numbers), len(questions)))
        start = 0
        for row, number in enumerate(numbers):
            reference = self.references[number]
            end = start + -(-reference.points // 8)
            packed, start = bits.seen[:, start:end], end
            seen = np.unpackbits(packed, axis=1, count=reference.points).astype(bool)
            cell_seen_m2 = {
                threshold: np.bincount(
                    reference.cell, reference.m2 * hit[reference.of], minlength=len(reference.cell_m2)
                )
                for threshold, hit in zip(self._thresholds_m, seen, strict=True)
            }
            for column, (question, cells) in enumerate(zip(questions, reference.cells_of, strict=True)):
                of_cells, cell_m2 = cell_seen_m2[question.threshold_m][cells], reference.cell_m2[cells]
                seen_m2[row, column], visible_m2[row, column] = of_cells.sum(), cell_m2.sum()
                known[row, column] = (of_cells / cell_m2).mean() if len(cells) else np.nan
        return Scores(
            instants=bits.instants,
            world=self.world_of[numbers],
            parts=self._parts,
            seen_m2=seen_m2,
            visible_m2=visible_m2,
            known_share=known,
            self_hit_share=float(bits.self_hits.sum() / (len(numbers) * bits.rays)),
            rays=bits.rays,
        )


def _site(
    scenario: Scenario,
    objectives: Mapping[str, Objective],
    vehicle: str | Path | None,
    rays: int,
    seed: int,
    every_s: float,
) -> Site:
    world = with_ego(scenario, {}, vehicle)
    return Site(world, QuestionGrid.around(world.ego_box().outline_m, objectives), rays, seed, every_s)


def _instants(sites: Sequence[Site], worlds: int, per_world: int) -> list[HeldInstant]:
    """The instants of all sites, world by world."""
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
    if site.scenario.traffic is None:
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
