"""Instants of many worlds that any rig is scored at: held once, with their reference."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

from torch.utils.data import DataLoader, Dataset

from torchcover.coverage import Measure
from torchcover.estimation import Estimate
from torchcover.evaluation import CoverageObserver
from torchcover.evaluation.cores import start_method
from torchcover.evaluation.pipeline import FramesOrErrors, MeasuredFrame, batches_of, killed_worker
from torchcover.frames import Frame
from torchcover.placement.carrier import Carrier
from torchcover.placement.objective import Objective
from torchcover.placement.questions import Questions, RigNumbers
from torchcover.placement.racing import TOGETHER, Prefix, racing_order
from torchcover.simulation import Rig, Scenario, SimulatedFrames, Simulator, with_ego
from torchcover.simulation.rays import Balls
from torchcover.simulation.simulated_frames import of_rigs

WORLDS = 6
PER_WORLD = 3
EVERY_S = 20.0
RAYS = 16_384
BUDGET_BYTES = 2e9
MEASURES: tuple[Measure, Measure] = ("area", "known")
# What a simulation that looks at a few instants of many worlds is asked for.
MANY = 10**9

AnyScenario = Scenario | str | Path


class HeldInstant(NamedTuple):
    """Which instant: the number of its scenario, the step there, and its world among all worlds."""

    scenario: int
    step: int
    world: int


class AskedInstant(NamedTuple):
    """What is asked of an instant: the frame of a rig, or without one the reference, with the bytes of its world.

    With `measures` the coverage is summed up where the frame is made, and the frame itself stays there.
    """

    rig: Rig | None
    number: int
    measures: tuple[Measure, ...] = ()


class HeldWorlds(Dataset[Frame | MeasuredFrame]):
    """What any rig sees at some instants, whose worlds and references are kept in the process that is asked.

    Frames are measured there, too, so that sums travel and not clouds.
    Simulations have no rigs; of the reference only the points are kept that questions are about.
    """

    def __init__(
        self, simulations: Sequence[SimulatedFrames], instants: Sequence[HeldInstant], questions: Questions
    ) -> None:
        self._simulations, self._instants, self._questions = simulations, instants, questions
        self._held: dict[int, tuple[Frame, Balls | None]] = {}
        self._rig: Rig | None = None
        self._mounted: dict[int, Simulator] = {}
        self._observers: dict[tuple[Measure, ...], Mapping[CoverageObserver, Measure]] = {}

    def __getitem__(self, asked: AskedInstant) -> Frame | MeasuredFrame:
        frame, measures = self._frame(asked.rig, asked.number), asked.measures
        if asked.rig is None or not measures:
            return frame
        if measures not in self._observers:
            coverage = self._questions.coverage_of(asked.rig, measures)
            self._observers[measures] = {observer: measure for measure, observer in coverage.items()}
        sums = {measure: observer.sums_of(frame) for observer, measure in self._observers[measures].items()}
        return MeasuredFrame(None, frame.counts, sums, 0.0)

    def _frame(self, rig: Rig | None, number: int) -> Frame:
        instant = self._instants[number]
        if number not in self._held:
            built, within_m = self._built(instant, number), self._questions.within_m
            # The memory of a tensor that travels to another process is given up.
            points = built.reference.numpy().copy()
            self._held[number] = built, None if within_m is None else Balls.around(points, within_m)
        held, within = self._held[number]
        if rig is None:
            return held
        scans = self._with(rig, instant.scenario).scans(instant.step, within)[rig.name]
        counts = {"rays": sum(scan.rays for scan in scans), "self_hits": sum(scan.self_hits for scan in scans)}
        return replace(held, **of_rigs({rig.name: rig}, {rig.name: scans}), counts=counts)

    def _built(self, instant: HeldInstant, number: int) -> Frame:
        frames = self._simulations[instant.scenario]
        seen = frames[instant.step]
        heights_m = seen.heights_in(self._questions.grid.band_frame)
        kept = self._questions.asked(seen.reference, heights_m)
        assert seen.reference_weights is not None  # those of a SurfaceReference
        return replace(
            seen,
            reference=seen.reference[kept],
            reference_weights=seen.reference_weights[kept],
            reference_heights_m=None if heights_m is None else heights_m[kept],
            index=number,
            place_in_time=instant.world,
            counts={"world_bytes": frames.simulator.scene_of(instant.step)[0].bytes},
        )

    def _with(self, rig: Rig, scenario: int) -> Simulator:
        """A scenario with the rig, which is kept until another one comes: a race asks about it again and again."""
        if rig != self._rig:
            self._rig, self._mounted, self._observers = rig, {}, {}
        if scenario not in self._mounted:
            self._mounted[scenario] = self._simulations[scenario].simulator.with_rigs({rig.name: rig})
        return self._mounted[scenario]


class CommonInstants:
    """Instants of many worlds, held once with the points of their reference; a rig costs one scan and one search each.

    Every rig sees the same instants as `SimulatedFrames` shows them, is measured against the same reference points, and
    observed by `CoverageMetric`, so that differences are paired, and numbers are those of
    `evaluate`. They depend on the arguments alone, and not on the number of workers.

    Args:
        scenarios: What is played, one or several.
        objectives: What rigs are scored by, by name.
        vehicle: What carries the rigs: a built-in vehicle, the YAML file of one, or a mesh file. Not given: each
            scenario's own ego, else an SUV.
        worlds: Worlds of each scenario that has traffic; any other scenario is one world.
        per_world: Instants in each.
        every_s: Time between them.
        seed: Seed of the traffic, of the reference, and of the order of the instants.
        rays: About how many rays the reference casts at each instant.
        estimate: What numbers of the coverage are means over: "area", the visible surface, or "known", the known cells.
        sensor_model: What sensors make of their hits, as of `evaluate`: "ideal", or else each rig as it is.
        budget_bytes: What all worlds may take, about 35 MB for one of `urban`. All are held: to build one again takes
            five times as long as to score a rig on three instants of it.
        workers: Processes that hold the worlds; 0 holds them in this one.

    Attributes:
        questions: What the objectives ask.
        instants: Which step of which scenario each instant is, and its world.
        order: (n,) int64 the one order in which all rigs are scored.

    Raises:
        FileNotFoundError: An unknown name or file.
        ValueError: No scenario, objective or world; scenarios with different egos; a region or a band that is none; a
            run with fewer instants; worlds beyond the budget.

    Example:
        >>> near = Objective(region="20m", band="ground")
        >>> instants = CommonInstants(["courtyard"], {"near": near}, per_world=1, rays=2048)
        >>> estimate = instants.estimates(Rig.load("front_roof_128"))["area"]
        >>> len(instants), bool(0.5 < estimate.value[0] < 1)
        (1, True)
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
        estimate: Measure = "area",
        sensor_model: Literal["ideal", "real"] | None = None,
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
        self.seed, self.estimate, self.objectives = seed, estimate, dict(objectives)
        self.sensor_model = sensor_model
        self._settings: dict[str, Any] = {"vehicle": vehicle, "per_world": per_world, "every_s": every_s, "rays": rays}
        self._settings |= {"estimate": estimate, "sensor_model": sensor_model}
        self._settings |= {"budget_bytes": budget_bytes, "workers": workers}
        self._vehicles: set[str | None] = {None}  # that were found to be that of these worlds
        self._worlds = [with_ego(one, {}, vehicle) for one in self.scenarios]
        self.questions = Questions.around(Carrier.of(self._worlds).outline_m, objectives)
        shown: dict[str, Any] = {"steps": MANY, "seed": seed, "every_s": every_s, "kept_bytes": float("inf")}
        shown |= {"reference_sensor": self.questions.reference_sensor(rays)}
        simulations = [SimulatedFrames(one, rigs={}, **shown) for one in self._worlds]
        self.instants = _instants_of([one.simulator for one in simulations], worlds, per_world)
        self.order = racing_order([instant.world for instant in self.instants], seed)
        self._batches: list[list[AskedInstant]] = []
        self._processes = min(workers, self.instants[-1].world + 1)
        self._loader = DataLoader(
            FramesOrErrors(HeldWorlds(simulations, self.instants, self.questions)),
            batch_sampler=self._batches,
            collate_fn=list,
            num_workers=self._processes,
            multiprocessing_context=start_method() if self._processes else None,
            prefetch_factor=1 if workers else None,
            persistent_workers=workers > 0,
        )
        self._hold(budget_bytes)

    def _hold(self, budget_bytes: float) -> None:
        """Build all worlds, as many at a time as there are processes, unless they take more than there is room for."""
        worlds, bytes_of = self.instants[-1].world + 1, dict[int, float]()
        together = max(self._processes, 1)
        for first in range(0, worlds, together):
            some = [at for at, one in enumerate(self.instants) if first <= one.world < first + together]
            for frame in self.frames(None, some):
                bytes_of[frame.place_in_time] = frame.counts["world_bytes"]
            largest = max(bytes_of.values())
            expected = sum(bytes_of.values()) + largest * (worlds - len(bytes_of))
            if expected > budget_bytes:
                raise ValueError(
                    f"budget_bytes: {worlds} worlds take about {expected / 1e6:.0f} MB, and there are "
                    f"{budget_bytes / 1e6:.0f} MB, in which {int(budget_bytes // largest)} fit; use fewer worlds"
                )

    def __len__(self) -> int:
        return len(self.instants)

    def anew(self, seed: int, worlds: int, more: Mapping[str, Objective]) -> "CommonInstants":
        """The same questions, and more, at as many instants in each of other worlds.

        Args:
            seed: Another one, so that no world is the same.
            worlds: Worlds of each scenario with traffic; others are the same world for any seed, and are left out.
            more: Other objectives, by name.

        Raises:
            ValueError: The seed that these have; no scenario with traffic.
        """
        if seed == self.seed:
            raise ValueError(f"seed: another one than that of these worlds is needed; got {seed} for both")
        if not (fresh := [one for one in self.scenarios if not one.repeats]):
            names = ", ".join(repr(one.name) for one in self.scenarios)
            raise ValueError(f"scenarios: one whose worlds are drawn is needed; {names} is the same for any seed")
        return CommonInstants(fresh, {**self.objectives, **more}, worlds=worlds, seed=seed, **self._settings)

    def prefixes(self, rig: Rig) -> Iterator[Prefix]:
        """What is known of a rig after three instants more at a time; nothing is scored before it is asked for.

        Raises:
            ValueError: The rig cannot be mounted: a sensor inside the vehicle or another body, or below the ground.
        """
        numbers, rays, self_hits = self._numbers(rig, [self.estimate]), 0, 0
        for start in range(0, len(self), TOGETHER):
            for seen in self._measured(rig, self.order[start : start + TOGETHER].tolist(), numbers):
                rays, self_hits = rays + seen.counts["rays"], self_hits + seen.counts["self_hits"]
            done = min(start + TOGETHER, len(self))
            yield Prefix(done, numbers.estimate(self.estimate), self_hits / rays)

    def estimates(self, rig: Rig) -> dict[Measure, Estimate]:
        """What is known of a rig after all instants, by either measure; ValueError as `prefixes`."""
        numbers = self._numbers(rig, MEASURES)
        for _ in self._measured(rig, self.order.tolist(), numbers):
            pass
        return {measure: numbers.estimate(measure) for measure in MEASURES}

    def _numbers(self, rig: Rig, measures: Sequence[Measure]) -> RigNumbers:
        required = {name: one for name, one in self.objectives.items() if one.requires}
        kept = {name: one.share_kept(rig, self._worlds[0], self.sensor_model) for name, one in required.items()}
        return replace(self.questions.numbers_of(rig, measures), kept=kept)

    def _measured(self, rig: Rig, numbers: Sequence[int], observed: RigNumbers) -> Iterator[MeasuredFrame]:
        """What is left of a rig's frames at some instants, in their order, each once it is added."""
        for seen in self._made(self._as_asked(rig), numbers, tuple(observed.coverage)):
            observed.add(seen)
            yield seen

    def frames(self, rig: Rig | None = None, numbers: Sequence[int] | None = None) -> Iterator[Frame]:
        """What a rig sees at some instants, in their order, with the points of the reference that are asked about.

        Args:
            rig: The sensors; none gives the reference alone.
            numbers: Of the instants; all if not given.

        Raises:
            ValueError: As `prefixes`.
        """
        rig, wanted = rig and self._as_asked(rig), range(len(self)) if numbers is None else numbers
        for start in range(0, len(wanted), TOGETHER):
            yield from self._made(rig, wanted[start : start + TOGETHER])

    def _as_asked(self, rig: Rig) -> Rig:
        self._check_vehicle(rig)
        return rig.sensing("ideal") if self.sensor_model == "ideal" else rig

    def _made(self, rig: Rig | None, numbers: Sequence[int], measures: tuple[Measure, ...] = ()) -> list[Any]:
        shares: list[list[int]] = [[] for _ in range(max(self._processes, 1))]
        for number in numbers:
            shares[self.instants[number].world % len(shares)].append(number)
        # The k-th batch goes to the k-th process, which has built these worlds.
        self._batches[:] = [[AskedInstant(rig, number, measures) for number in share] for share in shares]
        made: dict[int, Frame | MeasuredFrame | ValueError] = {}
        try:
            for share, batch in zip(shares, batches_of(self._loader), strict=True):
                made |= zip(share, batch, strict=True)
        except Exception as error:
            if killed := killed_worker(error, self._processes, steps=len(made)):
                raise killed from error
            raise
        frames = []
        for number in numbers:
            if isinstance(one := made[number], ValueError):
                raise one
            frames.append(one)
        return frames

    def _check_vehicle(self, rig: Rig) -> None:
        """The rig's own vehicle counts where nothing else decides: then it must have been known from the start."""
        if rig.vehicle in self._vehicles or self._settings["vehicle"] is not None:
            return
        for scenario, world in zip(self.scenarios, self._worlds, strict=True):
            if with_ego(scenario, {rig.name: rig}).ego != world.ego:
                raise ValueError(
                    f"rig {rig.name!r} is for the vehicle {rig.vehicle}, and these instants have {world.ego_name}: say "
                    "which by vehicle="
                )
        self._vehicles.add(rig.vehicle)

    def close(self) -> None:
        """End the processes that hold the worlds; without it they end with this object."""
        vars(self).pop("_loader", None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _instants_of(simulators: Sequence[Simulator], worlds: int, per_world: int) -> list[HeldInstant]:
    """The instants of all scenarios, world by world. ValueError: a run through a scenario has fewer instants."""
    of_worlds = [(k, steps) for k, one in enumerate(simulators) for steps in _steps(one, worlds, per_world)]
    return [HeldInstant(scenario, step, world) for world, (scenario, steps) in enumerate(of_worlds) for step in steps]


def _steps(simulator: Simulator, worlds: int, per_world: int) -> list[list[int]]:
    """Numbers of the steps of each world."""
    if simulator.scenario.repeats:
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
            f"per_world: a run of {simulator.scenario.name!r} has {fewest} instants that are {simulator.every_s:g} s "
            f"apart; got {per_world}"
        )
    return of_worlds
