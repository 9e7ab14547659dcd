"""Instants of many worlds that any rig is scored on: held once, with their reference."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from torchcover.evaluation.progress import held_back
from torchcover.placement.bits import Bits
from torchcover.placement.held_worlds import Look
from torchcover.placement.objective import Objective
from torchcover.placement.question_grid import ReferencePoints
from torchcover.placement.scores import Scores
from torchcover.placement.sites import Site, instants_of
from torchcover.placement.world_process import Holder, WorldProcess, WorldsHere, answers
from torchcover.simulation import Rig, Scenario, with_ego

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
        budget_bytes: What all worlds may take, about 35 MB for one of `urban`. All are held: to build one again takes
            five times as long as to score a rig on three instants of it.
        workers: Processes that hold the worlds; 0 holds them in this one.

    Attributes:
        sites: The scenarios with their egos, what is asked about around these, and the settings.
        instants: Which step of which site each instant is, and its world.
        references: What the reference points of each instant count for.
        questions: All that the objectives ask: bands in regions, each with a threshold.
        parts: For each objective, by name, the numbers of its questions.
        thresholds_m: The thresholds, in the order of the rows of bits.
        unknown_worlds: Name of each objective -> how many worlds show nothing of one of its regions and bands; they
            have no value, of any rig, and are in no difference.

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
        if workers < 0:
            raise ValueError(f"workers: a number >= 0 is needed; got {workers}")
        self.scenarios = tuple(one if isinstance(one, Scenario) else Scenario.load(one) for one in given)
        self.objectives = dict(objectives)
        self.vehicle = vehicle
        self.seed = seed
        self._per_world, self._every_s, self._rays = per_world, every_s, rays
        self._budget_bytes, self._workers = budget_bytes, workers
        self.sites = [
            Site.of(one, objectives, vehicle, rays=rays, seed=seed, every_s=every_s) for one in self.scenarios
        ]
        self.instants = instants_of(self.sites, worlds, per_world)
        self.questions = self.sites[0].grid.questions
        self.parts = {name: tuple(map(self.questions.index, one.questions)) for name, one in objectives.items()}
        self.thresholds_m = tuple(dict.fromkeys(question.threshold_m for question in self.questions))
        self._holders = self._hold(budget_bytes)
        held: dict[int, ReferencePoints] = {}
        for of_holder in answers(self._holders):
            held |= of_holder
        self.references = tuple(held[number] for number in range(len(self)))
        self._check_known()

    def _hold(self, budget_bytes: float) -> list[Holder]:
        """Build all worlds, here or in other processes, which take them in turn."""
        worlds = self.instants[-1].world + 1
        if self._workers == 0:
            return [WorldsHere(self.sites, self.instants, budget_bytes)]
        count = min(self._workers, worlds)
        shares = [[one for one in self.instants if one.world % count == k] for k in range(count)]
        return [
            WorldProcess(self.sites, share, budget_bytes * len(range(k, worlds, count)) / worlds)
            for k, share in enumerate(shares)
        ]

    def _check_known(self) -> None:
        unseen = Bits(
            np.arange(len(self), dtype=np.int64),
            np.zeros((len(self.thresholds_m), sum(one.bytes_of_bits for one in self.references)), dtype=np.uint8),
            np.zeros(len(self), dtype=np.int64),
            rays=1,
        )
        unknown = np.isnan(self.scores(unseen).by_world())
        self.unknown_worlds = dict(zip(self.objectives, unknown.sum(axis=0).tolist(), strict=True))
        for column, (name, objective) in enumerate(self.objectives.items()):
            if unknown[:, column].all():
                asked = ", ".join(f"{one.band} in {one.region}" for one in objective.questions)
                raise ValueError(
                    f"objective {name!r}: of {len(unknown)} worlds, none shows some surface in each of: {asked}; use "
                    "more worlds or instants, or larger regions"
                )

    @property
    def world_of(self) -> NDArray[np.int64]:
        """(instants,) int64 which world each instant is of: worlds are independent of each other."""
        return np.array([instant.world for instant in self.instants], dtype=np.int64)

    def __len__(self) -> int:
        return len(self.instants)

    def anew(self, seed: int, worlds: int) -> "CommonInstants":
        """The same questions at as many instants in each of other worlds.

        Args:
            seed: Another one, so that no world is the same.
            worlds: Worlds of each scenario with traffic; others are the same world for any seed, and are left out.

        Raises:
            ValueError: The seed that these have; no scenario with traffic.
        """
        if seed == self.seed:
            raise ValueError(f"seed: another one than that of these worlds is needed; got {seed} for both")
        if not (fresh := [one for one in self.scenarios if not one.repeats]):
            names = ", ".join(repr(one.name) for one in self.scenarios)
            raise ValueError(f"scenarios: one whose worlds are drawn is needed; {names} is the same for any seed")
        return CommonInstants(
            fresh,
            self.objectives,
            vehicle=self.vehicle,
            worlds=worlds,
            per_world=self._per_world,
            every_s=self._every_s,
            seed=seed,
            rays=self._rays,
            budget_bytes=self._budget_bytes,
            workers=self._workers,
        )

    def close(self) -> None:
        """End the processes that hold the worlds; without it they end with this object."""
        for holder in self._holders:
            holder.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

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
        if not numbers or not all(0 <= number < len(self) for number in numbers):
            raise ValueError(f"instants: numbers from 0 to {len(self) - 1} are needed; got {numbers[:20]}")
        self._check_vehicle(rig)
        looks = self._looks(rig, numbers)
        return Bits(
            np.array(numbers, dtype=np.int64),
            np.concatenate([looks[number].seen for number in numbers], axis=1),
            np.array([looks[number].self_hits for number in numbers], dtype=np.int64),
            looks[numbers[0]].rays,
        )

    def _check_vehicle(self, rig: Rig) -> None:
        """The rig's own vehicle counts where nothing else decides: then it must have been known from the start."""
        if rig.vehicle is None or self.vehicle is not None:
            return
        for scenario, site in zip(self.scenarios, self.sites, strict=True):
            if with_ego(scenario, {rig.name: rig}).ego != site.scenario.ego:
                raise ValueError(
                    f"rig {rig.name!r} is for the vehicle {rig.vehicle}, and these instants have "
                    f"{site.scenario.ego_name}: say which by vehicle="
                )

    def _looks(self, rig: Rig, numbers: Sequence[int]) -> dict[int, Look]:
        shares: list[list[int]] = [[] for _ in self._holders]
        for number in dict.fromkeys(numbers):
            shares[self.instants[number].world % len(shares)].append(number)
        asked = [(holder, share) for holder, share in zip(self._holders, shares, strict=True) if share]
        with held_back():  # or an answer would be left for the next question
            for holder, share in asked:
                holder.ask(rig, share)
            of_holders = answers([holder for holder, _ in asked])
        looks: dict[int, Look] = {}
        for (_, share), of_holder in zip(asked, of_holders, strict=True):
            looks |= zip(share, of_holder, strict=True)
        return looks

    def scores(self, bits: Bits) -> Scores:
        """What it is worth to see some reference points.

        Args:
            bits: From `bits`, or the OR of several.
        """
        numbers = bits.instants.tolist()
        questions = self.questions
        seen_m2, visible_m2, known = np.empty((3, len(numbers), len(questions)))
        start = 0
        for row, number in enumerate(numbers):
            reference = self.references[number]
            end = start + reference.bytes_of_bits
            packed, start = bits.seen[:, start:end], end
            seen = np.unpackbits(packed, axis=1, count=reference.points).astype(bool)
            cell_seen_m2 = {
                threshold: np.bincount(
                    reference.cell, reference.m2 * hit[reference.of], minlength=len(reference.cell_m2)
                )
                for threshold, hit in zip(self.thresholds_m, seen, strict=True)
            }
            for column, (question, cells) in enumerate(zip(questions, reference.cells_of, strict=True)):
                of_cells, cell_m2 = cell_seen_m2[question.threshold_m][cells], reference.cell_m2[cells]
                seen_m2[row, column], visible_m2[row, column] = of_cells.sum(), cell_m2.sum()
                known[row, column] = (of_cells / cell_m2).mean() if len(cells) else np.nan
        return Scores(
            instants=bits.instants,
            world=self.world_of[numbers],
            parts=self.parts,
            seen_m2=seen_m2,
            visible_m2=visible_m2,
            known_share=known,
            self_hit_share=float(bits.self_hits.sum() / (len(numbers) * bits.rays)),
            rays=bits.rays,
        )
