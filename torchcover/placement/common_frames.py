"""Frames of many worlds that any rig is scored on: made once, with their reference points."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

from torch.utils.data import DataLoader, Dataset

from torchcover.coverage import Average
from torchcover.estimation import Estimate
from torchcover.evaluation import CoverageObserver
from torchcover.evaluation.cores import get_start_method
from torchcover.evaluation.pipeline import FramesOrErrors, MeasuredFrame, find_killed_worker, iterate_batches
from torchcover.frames import Frame
from torchcover.placement.host_vehicle import HostVehicle
from torchcover.placement.objective import Objective
from torchcover.placement.queries import Queries
from torchcover.simulation import Rig, Scenario, SimulatedFrames, Simulator, set_ego
from torchcover.simulation.rays import SearchSpheres
from torchcover.simulation.simulated_frames import build_rig_fields

WORLDS = 6
FRAMES_PER_WORLD = 3
EVERY_S = 20.0
RAYS = 16_384
BATCH = 3  # frames with their clouds that are in memory together
BUDGET_BYTES = 2e9
MEASURES: tuple[Average, Average] = ("area", "cells")
MANY = 10**9  # steps of a simulation, of which a few of many worlds are used

AnyScenario = Scenario | str | Path


class Score(NamedTuple):
    """The numbers of a rig on all frames.

    Args:
        estimate: The numbers.
        self_hit_share: Share of the rig's rays that end on the vehicle.
    """

    estimate: Estimate
    self_hit_share: float


class FrameIndex(NamedTuple):
    """A frame by the number of its scenario, the step there, and its world among all worlds."""

    scenario_index: int
    frame_index: int
    scene_id: int


class FrameRequest(NamedTuple):
    """Request for the frame of a rig, or without one for the reference, with the bytes of its world.

    If it is to be measured, the coverage is summed up where the frame is made, and the frame itself stays there.
    """

    rig: Rig | None
    position: int
    is_measured: bool = False


class CachedFrames(Dataset[Frame | MeasuredFrame]):
    """Frames of any rig; their worlds and reference points stay in the process that made them.

    Frames are measured there, too, so that sums travel and not clouds.
    Simulations have no rigs. Only reference points inside the queried regions and bands are kept.
    """

    def __init__(
        self,
        simulations: Sequence[SimulatedFrames],
        indices: Sequence[FrameIndex],
        queries: Queries,
        average: Average,
    ) -> None:
        self._simulations, self._indices, self._queries, self._estimate = simulations, indices, queries, average
        self._held: dict[int, tuple[Frame, SearchSpheres | None]] = {}
        self._rig: Rig | None = None
        self._mounted: dict[int, Simulator] = {}
        self._observer: CoverageObserver | None = None

    def __getitem__(self, request: FrameRequest) -> Frame | MeasuredFrame:
        frame = self._frame(request.rig, request.position)
        if request.rig is None or not request.is_measured:
            return frame
        if self._observer is None:
            self._observer = self._queries.build_observer(request.rig, self._estimate)
        return MeasuredFrame(None, frame.counts, {self._estimate: self._observer.compute_sums(frame)}, 0.0)

    def _frame(self, rig: Rig | None, number: int) -> Frame:
        index = self._indices[number]
        if number not in self._held:
            built, within_m = self._build(index, number), self._queries.search_radius_m
            # The memory of a tensor that travels to another process is given up.
            points = built.reference.numpy().copy()
            self._held[number] = built, None if within_m is None else SearchSpheres.from_points(points, within_m)
        held, within = self._held[number]
        if rig is None:
            return held
        scans = self._mount(rig, index.scenario_index).simulate_scans(index.frame_index, within)[rig.name]
        counts = {"rays": sum(scan.num_rays for scan in scans), "self_hits": sum(scan.self_hits for scan in scans)}
        return replace(held, **build_rig_fields({rig.name: rig}, {rig.name: scans}), counts=counts)

    def _build(self, index: FrameIndex, number: int) -> Frame:
        frames = self._simulations[index.scenario_index]
        frame = frames[index.frame_index]
        heights_m = frame.get_heights_m(self._queries.grid.band_frame)
        mask = self._queries.mask_points(frame.reference, heights_m)
        assert frame.reference_weights is not None  # those of a SurfaceReference
        return replace(
            frame,
            reference=frame.reference[mask],
            reference_weights=frame.reference_weights[mask],
            reference_heights_m=None if heights_m is None else heights_m[mask],
            index=number,
            block_index=index.scene_id,
            counts={"world_bytes": frames.simulator.get_scene_geometry(index.frame_index)[0].num_bytes},
        )

    def _mount(self, rig: Rig, scenario: int) -> Simulator:
        """Return a scenario with the rig, which is kept until another rig comes."""
        if rig != self._rig:
            self._rig, self._mounted, self._observer = rig, {}, None
        if scenario not in self._mounted:
            self._mounted[scenario] = self._simulations[scenario].simulator.replace_rigs({rig.name: rig})
        return self._mounted[scenario]


class CommonFrames:
    """Frames of many worlds, made once with their reference points; a rig costs one scan and one search each.

    Every rig is scored on the same frames of `SimulatedFrames` and the same reference points by `CoverageMetric`,
    so that differences are paired, and numbers are those of `evaluate`. They depend on the
    arguments alone, and not on the number of workers.

    Args:
        scenarios: One or several.
        objectives: Numbers that rigs are scored by, by name.
        vehicle: Host vehicle: a built-in vehicle, the YAML file of one, or a mesh file. Not given: each
            scenario's own ego, else an SUV.
        worlds: Worlds of each scenario that has traffic; any other scenario is one world.
        per_world: Frames in each.
        frame_interval_s: Time between them.
        seed: Seed of the traffic and of the reference.
        rays: Approximate number of reference rays of each frame.
        average: Average of the numbers: "area", the visible surface, or "cells", the observed cells.
        sensor_model: "ideal", or else each rig as it is, as in `evaluate`.
        budget_bytes: What all worlds may take, about 35 MB for one of `urban`. All are held: to build one again takes
            five times as long as to score a rig on three frames of it.
        workers: Processes that hold the worlds; 0 holds them in this one.

    Attributes:
        queries: Regions, bands and numbers of the objectives.
        indices: Scenario, step and world of each frame.

    Raises:
        FileNotFoundError: An unknown name or file.
        ValueError: No scenario, objective or world; scenarios with different egos; a region or a band that is none; a
            run with fewer frames; worlds beyond the budget.

    Example:
        >>> near = Objective(region="20m", band="ground")
        >>> frames = CommonFrames(["courtyard"], {"near": near}, per_world=1, rays=2048)
        >>> estimate = frames.score(Rig.load("front_roof_128")).estimate
        >>> len(frames), bool(0.5 < estimate.value[0] < 1)
        (1, True)
    """

    def __init__(
        self,
        scenarios: AnyScenario | Sequence[AnyScenario],
        objectives: Mapping[str, Objective],
        *,
        vehicle: str | Path | None = None,
        num_scenes: int = WORLDS,
        frames_per_scene: int = FRAMES_PER_WORLD,
        frame_interval_s: float = EVERY_S,
        seed: int = 0,
        rays: int = RAYS,
        average: Average = "area",
        sensor_model: Literal["ideal", "real"] | None = None,
        budget_bytes: float = BUDGET_BYTES,
        workers: int = 0,
    ) -> None:
        given = (scenarios,) if isinstance(scenarios, Scenario | str | Path) else tuple(scenarios)
        for name, number in (("scenarios", len(given)), ("objectives", len(objectives))):
            if number == 0:
                raise ValueError(f"{name}: at least one is needed; got none")
        for name, number in (("worlds", num_scenes), ("per_world", frames_per_scene)):
            if number < 1:
                raise ValueError(f"{name}: at least 1 is needed; got {number}")
        if workers < 0:
            raise ValueError(f"workers: a number >= 0 is needed; got {workers}")
        self.scenarios = tuple(one if isinstance(one, Scenario) else Scenario.load(one) for one in given)
        self.seed, self.average, self.objectives = seed, average, dict(objectives)
        self.sensor_model = sensor_model
        self._settings: dict[str, Any] = {
            "vehicle": vehicle,
            "per_world": frames_per_scene,
            "frame_interval_s": frame_interval_s,
            "rays": rays,
        }
        self._settings |= {"estimate": average, "sensor_model": sensor_model}
        self._settings |= {"budget_bytes": budget_bytes, "workers": workers}
        self._vehicles: set[str | None] = {None}  # that were found to be that of these worlds
        self._worlds = [set_ego(one, {}, vehicle) for one in self.scenarios]
        self.queries = Queries.from_objectives(HostVehicle.from_scenarios(self._worlds).outline_m, objectives)
        shown: dict[str, Any] = {
            "num_frames": MANY,
            "seed": seed,
            "frame_interval_s": frame_interval_s,
            "max_cached_bytes": float("inf"),
        }
        shown |= {"reference_sensor": self.queries.build_reference_sensor(rays)}
        simulations = [SimulatedFrames(one, rigs={}, **shown) for one in self._worlds]
        self.indices = _index_frames([simulation.simulator for simulation in simulations], num_scenes, frames_per_scene)
        self._batches: list[list[FrameRequest]] = []
        self._processes = min(workers, self.indices[-1].scene_id + 1)
        self._loader = DataLoader(
            FramesOrErrors(CachedFrames(simulations, self.indices, self.queries, average)),
            batch_sampler=self._batches,
            collate_fn=list,
            num_workers=self._processes,
            multiprocessing_context=get_start_method() if self._processes else None,
            prefetch_factor=1 if workers else None,
            persistent_workers=workers > 0,
        )
        self._hold(budget_bytes)

    def _hold(self, budget_bytes: float) -> None:
        """Build all worlds, as many at a time as there are processes, unless they take more than there is room for."""
        worlds, bytes_of = self.indices[-1].scene_id + 1, dict[int, float]()
        together = max(self._processes, 1)
        for first in range(0, worlds, together):
            some = [at for at, one in enumerate(self.indices) if first <= one.scene_id < first + together]
            for frame in self.iterate_frames(None, some):
                bytes_of[frame.block_index] = frame.counts["world_bytes"]
            largest = max(bytes_of.values())
            expected = sum(bytes_of.values()) + largest * (worlds - len(bytes_of))
            if expected > budget_bytes:
                raise ValueError(
                    f"budget_bytes: {worlds} worlds take about {expected / 1e6:.0f} MB, and there are "
                    f"{budget_bytes / 1e6:.0f} MB, in which {int(budget_bytes // largest)} fit; use fewer worlds"
                )

    def __len__(self) -> int:
        return len(self.indices)

    def resample(self, seed: int, num_scenes: int, extra_objectives: Mapping[str, Objective]) -> "CommonFrames":
        """Return the same queries, and more, on as many frames in each of other worlds.

        Args:
            seed: Another one, so that no world is the same.
            num_scenes: Worlds of each scenario with traffic; others are the same world for any seed, and are left out.
            extra_objectives: Other objectives, by name.

        Raises:
            ValueError: The seed that these have; no scenario with traffic.
        """
        if seed == self.seed:
            raise ValueError(f"seed: another one than that of these worlds is needed; got {seed} for both")
        if not (fresh := [one for one in self.scenarios if not one.is_repeating]):
            names = ", ".join(repr(one.name) for one in self.scenarios)
            raise ValueError(f"scenarios: one whose worlds are drawn is needed; {names} is the same for any seed")
        return CommonFrames(
            fresh, {**self.objectives, **extra_objectives}, num_scenes=num_scenes, seed=seed, **self._settings
        )

    def score(self, rig: Rig) -> Score:
        """Return the numbers of a rig on all frames, and its share of self-hits.

        Raises:
            ValueError: A sensor lies inside the vehicle or another body, or below the ground.
        """
        required = {name: one for name, one in self.objectives.items() if one.requirement}
        kept = {name: one.compute_met_share(rig, self._worlds[0], self.sensor_model) for name, one in required.items()}
        observer, rays, self_hits = self.queries.build_observer(rig, self.average), 0, 0
        for measured in self._compute(self._as_requested(rig), range(len(self)), is_measured=True):
            observer.add_sums(measured.sums[self.average])
            rays, self_hits = rays + measured.counts["rays"], self_hits + measured.counts["self_hits"]
        return Score(self.queries.estimate(observer.metric, kept), self_hits / rays)

    def iterate_frames(self, rig: Rig | None = None, positions: Sequence[int] | None = None) -> Iterator[Frame]:
        """Yield frames of a rig, in order, with the reference points inside the queried regions.

        Args:
            rig: The sensors; none gives the reference alone.
            positions: Numbers of the frames; all if not given.

        Raises:
            ValueError: As `score`.
        """
        rig, wanted = rig and self._as_requested(rig), range(len(self)) if positions is None else positions
        for start in range(0, len(wanted), BATCH):
            yield from self._compute(rig, wanted[start : start + BATCH])

    def _as_requested(self, rig: Rig) -> Rig:
        self._check_vehicle(rig)
        return rig.apply_sensor_model("ideal") if self.sensor_model == "ideal" else rig

    def _compute(self, rig: Rig | None, numbers: Sequence[int], *, is_measured: bool = False) -> list[Any]:
        shares: list[list[int]] = [[] for _ in range(max(self._processes, 1))]
        for number in numbers:
            shares[self.indices[number].scene_id % len(shares)].append(number)
        # The k-th batch goes to the k-th process, which has built these worlds.
        self._batches[:] = [[FrameRequest(rig, number, is_measured) for number in share] for share in shares]
        made: dict[int, Frame | MeasuredFrame | ValueError] = {}
        try:
            for share, batch in zip(shares, iterate_batches(self._loader), strict=True):
                made |= zip(share, batch, strict=True)
        except Exception as error:
            if killed := find_killed_worker(error, self._processes, num_frames=len(made)):
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
            if set_ego(scenario, {rig.name: rig}).ego != world.ego:
                raise ValueError(
                    f"rig {rig.name!r} is for the vehicle {rig.vehicle}, and these frames have {world.ego_name}: say "
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


def _index_frames(simulators: Sequence[Simulator], worlds: int, per_world: int) -> list[FrameIndex]:
    """Return the frames of all scenarios, world by world. ValueError: a run through a scenario has fewer frames."""
    of_worlds = [(k, steps) for k, one in enumerate(simulators) for steps in _steps(one, worlds, per_world)]
    return [FrameIndex(scenario, step, world) for world, (scenario, steps) in enumerate(of_worlds) for step in steps]


def _steps(simulator: Simulator, worlds: int, per_world: int) -> list[list[int]]:
    """Numbers of the steps of each world."""
    if simulator.scenario.is_repeating:
        # Where nothing moves every step draws another reference.
        distinct = simulator.num_distinct_frames
        return [list(range(per_world if distinct in (None, 1) else min(per_world, distinct or 0)))]
    of_worlds: list[list[int]] = [[] for _ in range(worlds)]
    index = 0
    while (world := simulator.get_run_index(index)) < worlds:
        if len(of_worlds[world]) < per_world:
            of_worlds[world].append(index)
        index += 1
    if (fewest := min(map(len, of_worlds))) < per_world:
        raise ValueError(
            f"per_world: a run of {simulator.scenario.name!r} has {fewest} frames that are {simulator.frame_interval_s:g} s "
            f"apart; got {per_world}"
        )
    return of_worlds
