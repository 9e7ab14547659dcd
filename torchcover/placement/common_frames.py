"""Frames of many scenes that any rig is scored on, built once together with their reference points."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

from torch.utils.data import DataLoader, Dataset

from torchcover.coverage import Average
from torchcover.estimation import Estimate
from torchcover.evaluation import CoverageObserver
from torchcover.evaluation.cpu_cores import get_start_method
from torchcover.evaluation.frame_workers import FramesOrErrors, find_killed_worker, iterate_batches
from torchcover.evaluation.pipeline import MeasuredFrame
from torchcover.frames import Frame
from torchcover.placement.host_vehicle import HostVehicle
from torchcover.placement.objective import Objective
from torchcover.placement.queries import Queries
from torchcover.simulation import Rig, Scenario, SimulatedFrames, Simulator, set_ego
from torchcover.simulation.culling import SearchSpheres
from torchcover.simulation.simulated_frames import build_rig_fields

AnyScenario = Scenario | str | Path


class Score(NamedTuple):
    """Numbers of a rig over all frames.

    Args:
        estimate: Numbers of the objectives.
        self_hit_share: Share of the rig's rays that hit the vehicle.
    """

    estimate: Estimate
    self_hit_share: float


class FrameIndex(NamedTuple):
    """Indices of a frame.

    Args:
        scenario_index: Index of the scenario.
        frame_index: Index of the frame in the simulation of the scenario.
        scene_id: Number of the scene among all scenes of all scenarios.
    """

    scenario_index: int
    frame_index: int
    scene_id: int


class FrameRequest(NamedTuple):
    """Request for one frame.

    Args:
        rig: The rig; None requests the reference points alone, with the memory of the scene in `counts`.
        position: Position of the frame in `CommonFrames.indices`.
        is_measured: Whether the coverage is summed in the process that builds the frame, which then keeps the points.
    """

    rig: Rig | None
    position: int
    is_measured: bool = False


class CachedFrames(Dataset[Frame | MeasuredFrame]):
    """Frames of any rig whose scenes and reference points stay in the process that built them.

    Coverage is measured in that process too, so that sums are sent instead of point clouds. Only reference points in
    the queried regions and bands are stored.

    Args:
        simulations: One simulation without rigs for each scenario.
        indices: Indices of all frames.
        queries: Regions, bands and numbers to measure.
        average: Average of the numbers, "area" or "cells".
    """

    def __init__(
        self,
        simulations: Sequence[SimulatedFrames],
        indices: Sequence[FrameIndex],
        queries: Queries,
        average: Average,
    ) -> None:
        self._simulations = simulations
        self._indices = indices
        self._queries = queries
        self._average = average
        self._references: dict[int, tuple[Frame, SearchSpheres | None]] = {}
        self._rig: Rig | None = None
        self._simulators: dict[int, Simulator] = {}
        self._observer: CoverageObserver | None = None

    def __getitem__(self, request: FrameRequest) -> Frame | MeasuredFrame:
        frame = self._build_frame(request.rig, request.position)
        if request.rig is None or not request.is_measured:
            return frame
        if self._observer is None:
            self._observer = self._queries.build_observer(request.rig, self._average)
        return MeasuredFrame(None, frame.counts, {self._average: self._observer.compute_sums(frame)}, 0.0)

    def _build_frame(self, rig: Rig | None, position: int) -> Frame:
        """Build the frame of a rig; without a rig, the reference alone."""
        index = self._indices[position]
        if position not in self._references:
            reference, radius_m = self._build_reference(index, position), self._queries.search_radius_m
            # A tensor that is sent to another process loses its memory, so the search structure gets a copy.
            points = reference.reference.numpy().copy()
            self._references[position] = (
                reference,
                None if radius_m is None else SearchSpheres.from_points(points, radius_m),
            )
        reference, relevant_space = self._references[position]
        if rig is None:
            return reference
        scans = self._get_simulator(rig, index.scenario_index).simulate_scans(index.frame_index, relevant_space)[
            rig.name
        ]
        counts = {"rays": sum(scan.num_rays for scan in scans), "self_hits": sum(scan.self_hits for scan in scans)}
        return replace(reference, **build_rig_fields({rig.name: rig}, {rig.name: scans}), counts=counts)

    def _build_reference(self, index: FrameIndex, position: int) -> Frame:
        """Build a frame without sensors whose reference points are limited to the queried regions and bands."""
        frames = self._simulations[index.scenario_index]
        frame = frames[index.frame_index]
        heights_m = frame.get_heights_m(self._queries.grid.band_frame)
        mask = self._queries.mask_points(frame.reference, heights_m)
        assert frame.reference_weights is not None  # a SurfaceReference always has weights
        return replace(
            frame,
            reference=frame.reference[mask],
            reference_weights=frame.reference_weights[mask],
            reference_heights_m=None if heights_m is None else heights_m[mask],
            index=position,
            block_index=index.scene_id,
            counts={"scene_bytes": frames.simulator.get_scene_geometry(index.frame_index)[0].num_bytes},
        )

    def _get_simulator(self, rig: Rig, scenario_index: int) -> Simulator:
        """Return the simulator of a scenario with the rig; it is cached until another rig is requested."""
        if rig != self._rig:
            self._rig, self._simulators, self._observer = rig, {}, None
        if scenario_index not in self._simulators:
            simulator = self._simulations[scenario_index].simulator
            self._simulators[scenario_index] = simulator.replace_rigs({rig.name: rig})
        return self._simulators[scenario_index]


class CommonFrames:
    """Frames of many scenes on which rigs are compared.

    All rigs are scored on the same frames of `SimulatedFrames` with the same reference points, so that differences are
    paired and numbers equal those of `evaluate`. Scenes are built once; scoring a rig costs one scan and one nearest
    neighbor search per frame. Numbers depend on the arguments, not on the number of workers.

    Args:
        scenarios: One or several scenarios.
        objectives: Numbers that rigs are scored by, by name.
        vehicle: Host vehicle: a built-in vehicle, its YAML file, or a mesh file; None takes the ego vehicle of each
            scenario, or an SUV.
        num_scenes: Number of scenes of each scenario with random traffic; any other scenario is one scene.
        frames_per_scene: Number of frames of each scene.
        frame_interval_s: Time between two frames in seconds.
        seed: Seed of traffic and reference points.
        num_rays: Approximate number of reference rays of each frame.
        average: Average of the numbers: "area" over visible surface, "cells" over observed cells.
        sensor_model: "ideal"; None takes the model of each rig, as in `evaluate`.
        budget_bytes: Memory for all scenes, about 35 MB for a scene of `urban`. All scenes stay in memory, because
            building one takes five times as long as scoring a rig on three frames of it.
        num_workers: Number of processes that hold the scenes; 0 holds them in this process.

    Attributes:
        queries: Regions, bands and numbers of the objectives.
        indices: Indices of each frame.

    Raises:
        FileNotFoundError: A scenario, vehicle or file is unknown.
        ValueError: A number is out of range, the scenarios have different ego vehicles, a region or band is unknown, a
            scenario has too few frames, or the scenes exceed `budget_bytes`.

    Example:
        >>> near = Objective(region="20m", band="ground")
        >>> frames = CommonFrames(["courtyard"], {"near": near}, frames_per_scene=1, num_rays=2048)
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
        num_scenes: int = 6,
        frames_per_scene: int = 3,
        frame_interval_s: float = 20.0,
        seed: int = 0,
        num_rays: int = 16_384,
        average: Average = "area",
        sensor_model: Literal["ideal", "real"] | None = None,
        budget_bytes: float = 2e9,
        num_workers: int = 0,
    ) -> None:
        scenarios = (scenarios,) if isinstance(scenarios, Scenario | str | Path) else tuple(scenarios)
        for name, count in (("scenarios", len(scenarios)), ("objectives", len(objectives))):
            if count == 0:
                raise ValueError(f"{name}: got none; give at least one")
        for name, count in (("num_scenes", num_scenes), ("frames_per_scene", frames_per_scene)):
            if count < 1:
                raise ValueError(f"{name}: got {count}; give at least 1")
        if num_workers < 0:
            raise ValueError(f"num_workers: got {num_workers}; give 0 or more")
        self.scenarios = tuple(
            scenario if isinstance(scenario, Scenario) else Scenario.load(scenario) for scenario in scenarios
        )
        self.seed, self.average, self.objectives = seed, average, dict(objectives)
        self.sensor_model = sensor_model
        self._vehicle = vehicle
        self._create_similar = partial(
            CommonFrames,
            vehicle=vehicle,
            frames_per_scene=frames_per_scene,
            frame_interval_s=frame_interval_s,
            num_rays=num_rays,
            average=average,
            sensor_model=sensor_model,
            budget_bytes=budget_bytes,
            num_workers=num_workers,
        )
        self._accepted_vehicles: set[str | None] = {None}
        self._host_scenarios = [set_ego(scenario, {}, vehicle) for scenario in self.scenarios]
        host = HostVehicle.from_scenarios(self._host_scenarios)
        self.queries = Queries.from_objectives(objectives, host.outline_m)
        reference_sensor = self.queries.build_reference_sensor(num_rays)
        simulations = [
            SimulatedFrames(
                scenario,
                rigs={},
                num_frames=10**9,  # more frames than any search uses
                seed=seed,
                frame_interval_s=frame_interval_s,
                max_cached_bytes=float("inf"),
                reference_sensor=reference_sensor,
            )
            for scenario in self._host_scenarios
        ]
        self.indices = _index_frames([simulation.simulator for simulation in simulations], num_scenes, frames_per_scene)
        self._batches: list[list[FrameRequest]] = []
        self._num_processes = min(num_workers, self.indices[-1].scene_id + 1)
        self._loader = DataLoader(
            FramesOrErrors(CachedFrames(simulations, self.indices, self.queries, average)),
            batch_sampler=self._batches,
            collate_fn=list,
            num_workers=self._num_processes,
            multiprocessing_context=get_start_method() if self._num_processes else None,
            prefetch_factor=1 if num_workers else None,
            persistent_workers=num_workers > 0,
        )
        self._build_scenes(budget_bytes)

    def _build_scenes(self, budget_bytes: float) -> None:
        """Build all scenes, one in each process at a time, and raise as soon as they will exceed the budget."""
        scene_count = self.indices[-1].scene_id + 1
        scene_bytes: dict[int, float] = {}
        batch_size = max(self._num_processes, 1)
        for first in range(0, scene_count, batch_size):
            scene_ids = range(first, first + batch_size)
            positions = [position for position, index in enumerate(self.indices) if index.scene_id in scene_ids]
            for frame in self.iterate_frames(None, positions):
                scene_bytes[frame.block_index] = frame.counts["scene_bytes"]
            largest = max(scene_bytes.values())
            expected = sum(scene_bytes.values()) + largest * (scene_count - len(scene_bytes))
            if expected > budget_bytes:
                raise ValueError(
                    f"budget_bytes: {scene_count} scenes need about {expected / 1e6:.0f} MB; got "
                    f"{budget_bytes / 1e6:.0f} MB, enough for {int(budget_bytes // largest)}; use fewer scenes"
                )

    def __len__(self) -> int:
        return len(self.indices)

    def resample(self, seed: int, num_scenes: int, extra_objectives: Mapping[str, Objective]) -> "CommonFrames":
        """Build frames of other scenes for the same and further objectives.

        Args:
            seed: Another seed, so that no scene is the same.
            num_scenes: Number of scenes of each scenario with random traffic. Other scenarios are excluded, because
                they are the same scene for any seed.
            extra_objectives: Further objectives, by name.

        Raises:
            ValueError: The seed is that of these frames, or no scenario has random traffic.
        """
        if seed == self.seed:
            raise ValueError(f"seed: got {seed}, the seed of these frames; give another one")
        random_scenarios = [scenario for scenario in self.scenarios if not scenario.is_repeating]
        if not random_scenarios:
            names = ", ".join(repr(scenario.name) for scenario in self.scenarios)
            raise ValueError(f"scenarios: {names} is the same for any seed; add a scenario with random traffic")
        objectives = {**self.objectives, **extra_objectives}
        return self._create_similar(random_scenarios, objectives, num_scenes=num_scenes, seed=seed)

    def score(self, rig: Rig) -> Score:
        """Compute the numbers of a rig over all frames.

        Args:
            rig: The rig.

        Raises:
            ValueError: A sensor lies inside the vehicle or another body, or below the ground.
        """
        met_shares = {}
        for name, objective in self.objectives.items():
            if objective.requirement:
                met_shares[name] = objective.compute_met_share(rig, self._host_scenarios[0], self.sensor_model)
        observer = self.queries.build_observer(rig, self.average)
        ray_count = self_hit_count = 0
        for measured in self._compute(self._apply_sensor_model(rig), range(len(self)), is_measured=True):
            observer.add_sums(measured.sums[self.average])
            ray_count += measured.counts["rays"]
            self_hit_count += measured.counts["self_hits"]
        return Score(self.queries.estimate(observer.metric, met_shares), self_hit_count / ray_count)

    def iterate_frames(self, rig: Rig | None = None, positions: Sequence[int] | None = None) -> Iterator[Frame]:
        """Yield frames of a rig, in order, with the reference points in the queried regions.

        Args:
            rig: The rig; None yields the reference alone.
            positions: Positions of the frames in `indices`; None yields all frames.

        Raises:
            ValueError: As in `score`.
        """
        rig = rig and self._apply_sensor_model(rig)
        positions = range(len(self)) if positions is None else positions
        batch_size = 3  # frames whose point clouds are in memory together
        for start in range(0, len(positions), batch_size):
            yield from self._compute(rig, positions[start : start + batch_size])

    def _apply_sensor_model(self, rig: Rig) -> Rig:
        """Replace the sensors of a rig by ideal ones if the search uses the ideal model."""
        self._check_vehicle(rig)
        return rig.apply_sensor_model("ideal") if self.sensor_model == "ideal" else rig

    def _compute(self, rig: Rig | None, positions: Sequence[int], *, is_measured: bool = False) -> list[Any]:
        """Return frames or their measurements; an error of a frame is raised."""
        shares: list[list[int]] = [[] for _ in range(max(self._num_processes, 1))]
        for position in positions:
            shares[self.indices[position].scene_id % len(shares)].append(position)
        # The loader sends the k-th batch to the k-th process, which has built these scenes.
        self._batches.clear()
        for share in shares:
            self._batches.append([FrameRequest(rig, position, is_measured) for position in share])
        results: dict[int, Frame | MeasuredFrame | ValueError] = {}
        try:
            for share, batch in zip(shares, iterate_batches(self._loader), strict=True):
                results |= zip(share, batch, strict=True)
        except Exception as error:
            if killed := find_killed_worker(error, self._num_processes, num_frames=len(results)):
                raise killed from error
            raise
        frames = []
        for position in positions:
            result = results[position]
            if isinstance(result, ValueError):
                raise result
            frames.append(result)
        return frames

    def _check_vehicle(self, rig: Rig) -> None:
        """Raise ValueError if the vehicle of a rig decides the ego vehicle and these frames have another one."""
        if rig.vehicle in self._accepted_vehicles or self._vehicle is not None:
            return
        for scenario, host_scenario in zip(self.scenarios, self._host_scenarios, strict=True):
            if set_ego(scenario, {rig.name: rig}).ego != host_scenario.ego:
                raise ValueError(
                    f"rig {rig.name!r}: its vehicle is {rig.vehicle}, and that of these frames {host_scenario.ego_name}"
                    "; set vehicle="
                )
        self._accepted_vehicles.add(rig.vehicle)

    def close(self) -> None:
        """End the processes that hold the scenes; otherwise they end with this object."""
        vars(self).pop("_loader", None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _index_frames(simulators: Sequence[Simulator], num_scenes: int, frames_per_scene: int) -> list[FrameIndex]:
    """List the frames of all scenarios, scene by scene."""
    indices: list[FrameIndex] = []
    scene_id = 0
    for scenario_index, simulator in enumerate(simulators):
        for frame_indices in _select_frames(simulator, num_scenes, frames_per_scene):
            indices += [FrameIndex(scenario_index, frame_index, scene_id) for frame_index in frame_indices]
            scene_id += 1
    return indices


def _select_frames(simulator: Simulator, num_scenes: int, frames_per_scene: int) -> list[list[int]]:
    """Return the frame indices of each scene of a scenario. ValueError: a scene has too few frames."""
    if simulator.scenario.is_repeating:
        # In a static scene each frame has other reference points, so all frames are used.
        distinct = simulator.num_distinct_frames
        return [list(range(frames_per_scene if distinct in (None, 1) else min(frames_per_scene, distinct or 0)))]
    selected: list[list[int]] = [[] for _ in range(num_scenes)]
    frame_index = 0
    while (scene := simulator.get_run_index(frame_index)) < num_scenes:
        if len(selected[scene]) < frames_per_scene:
            selected[scene].append(frame_index)
        frame_index += 1
    fewest = min(len(indices) for indices in selected)
    if fewest < frames_per_scene:
        raise ValueError(
            f"frames_per_scene: got {frames_per_scene}, but a run of {simulator.scenario.name!r} has {fewest} frames "
            f"at intervals of {simulator.frame_interval_s:g} s; use fewer frames or a shorter interval"
        )
    return selected
