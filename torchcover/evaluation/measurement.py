"""Measurement of the coverage of rigs: frames in, a result out.

Every frame has the points of each rig and the reference points. `measure_coverage` passes the frames to one coverage
metric per rig, to the near-field test targets, to published metrics and to the observers of the user, and collects
their results.
"""

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

from torchcover.coverage import CoverageSums
from torchcover.evaluation.checkpoint import Checkpoint, CheckpointManager
from torchcover.evaluation.cpu_cores import compute_num_workers
from torchcover.evaluation.observers import AnyObserver, CoverageObserver
from torchcover.evaluation.omissions import list_omissions
from torchcover.evaluation.pipeline import Run, StoppingRule, observe
from torchcover.evaluation.ranks import Ranks
from torchcover.evaluation.result import Result
from torchcover.evaluation.result_page import check_drawable
from torchcover.evaluation.settings import Settings, load_contrib
from torchcover.evaluation.target_error import TargetErrorRule
from torchcover.evaluation.task import CALLER, Task, build_run_identity, find_ray_device, get_device
from torchcover.files import lock_folder
from torchcover.frames import BadFrameError, FrameDataset
from torchcover.simulation import QueryPlan, SimulatedFrames
from torchcover.simulation.memory import check_memory_fits
from torchcover.targets import NearFieldObserver, Target

Observers = Mapping[str, AnyObserver]

# Blocks of the block jackknife; at least half of them are in use at the end of a long run.
NUM_BLOCKS = 16
# Name of the observer of the test targets in checkpoints.
NEAR_FIELD_TARGETS = "near-field test targets"


@dataclass(frozen=True)
class MeasurementParams:
    """Defaults of a measurement.

    Args:
        test_targets: Test targets in the near field, unless the settings name others.
        bytes_per_cell: Memory for maps of a cell: sums only contain observed cells, but maps contain all cells, and
            several maps exist at a time.
        max_inspected_frames: Frames whose scenes are counted for the number of workers.
    """

    test_targets: tuple[str, ...] = ("child", "adult", "cyclist", "pole")
    bytes_per_cell: int = 64
    max_inspected_frames: int = 256


@dataclass(frozen=True)
class _ObservedRun:
    """Observers after a run.

    Args:
        coverage: Name of each rig -> its coverage observer.
        further_observers: Name -> further observer.
        run: Outcome of the run.
    """

    coverage: Observers
    further_observers: Observers
    run: Run


def measure_coverage(
    task: Task[FrameDataset],
    settings: Settings,
    stopping_rule: StoppingRule | None = None,
    params: MeasurementParams = MeasurementParams(),
) -> Result:
    """Measure the coverage of all rigs of a task in the same frames.

    Args:
        task: Frames, rigs and regions.
        settings: Settings of `evaluate`.
        stopping_rule: Rule that may end the run early; a target error of the settings takes precedence.
        params: Defaults.

    Returns:
        The result. If an error ended the run early, the result has the frames until then, with a warning.

    Raises:
        ValueError: As in `evaluate`.
    """
    ranks, metadata = settings.ranks, task.metadata
    sensors = list(chain.from_iterable(metadata.sensors.values()))
    check_drawable(sensors)  # before the run, which may take hours
    settings = replace(settings, num_workers=_choose_num_workers(task, settings, params))
    metrics = load_contrib().build_metrics(task, settings) if settings.metrics else None
    metric_observers = metrics.observers if metrics else {}
    further_observers = {**settings.observers, **metric_observers, **_build_target_observers(task, settings, params)}
    # An error of one rank must end the others, which would wait for its part of the sums.
    with ranks.abort_on_error() if ranks else nullcontext():
        observed = _observe_frames(task, settings, further_observers, stopping_rule)
    coverages = {name: observer.compute() for name, observer in observed.coverage.items()}
    target_observer = observed.further_observers.get(NEAR_FIELD_TARGETS)
    target_sums = {}
    if isinstance(target_observer, NearFieldObserver):
        target_sums = {name: target_observer.get_target_sums(name) for name in coverages}
    if len({coverage.counts["num_frames"] for coverage in coverages.values()}) > 1:
        observed.run.raise_failure()  # an observer failed within a frame, so that rigs differ in their frames
    metric_report = None
    if metrics is not None:
        metric_report = load_contrib().compare_metrics(
            metrics.update_from(observed.further_observers), coverages, task.query_plan.target_regions, settings.seed
        )
    result = Result(
        coverages=coverages,
        regions=task.query_plan.regions,
        run=observed.run,
        rigs=task.rig_sources,
        source=metadata.description,
        reference_record=task.frames.describe_reference(),
        device=settings.device,
        target_sums=target_sums,
        target_error=settings.target_error,
        target_regions=task.query_plan.target_regions,
        sensors=metadata.sensors,
        ego_outline_m=metadata.ego_outline_m,
        observer_results={name: observed.further_observers[name].compute() for name in settings.observers},
        metrics=metric_report,
        omissions=list_omissions(
            observed.run.counts,
            list(coverages.values()),
            settings.aggregations,
            sensors,
            num_workers=settings.num_workers or 0,
            num_ranks=ranks.num_ranks if ranks else 1,
        ),
        block_ends=find_block_ends(task.frames),
    )
    if result.cut_short:
        warnings.warn(result.cut_short, RuntimeWarning, stacklevel=CALLER)
    return result


def find_block_ends(frames: FrameDataset, max_blocks: int = 80, max_frames: int = 10_000) -> list[int]:
    """Find the frames of a source after which the blocks of time are complete.

    Args:
        frames: Source of the frames.
        max_blocks: Number of blocks to find; advice on the number of frames never names more.
        max_frames: Number of frames to inspect; a scenario that repeats has no further block.

    Returns:
        Number of frames at the end of each block; the last may be the number of all frames.
    """
    block_indices, ends, index = set[int](), list[int](), 0
    with suppress(IndexError):  # the end of the source
        while index < max_frames and len(ends) < max_blocks:
            block_index = frames.get_block_index(index)
            if block_index not in block_indices and block_indices:
                ends.append(index)
            block_indices.add(block_index)
            index += 1
    return ends if len(ends) == max_blocks else [*ends, index]


def _choose_num_workers(task: Task[FrameDataset], settings: Settings, params: MeasurementParams) -> int:
    """Choose the number of worker processes; recordings may share open files, and ranks share the cores."""
    if settings.num_workers is not None:
        return settings.num_workers
    frames = task.frames
    if settings.ranks or not isinstance(frames, SimulatedFrames) or find_ray_device(settings):
        return 0
    num_frames = min(len(frames), task.num_frames or len(frames), params.max_inspected_frames)
    scene_ids = {frames.get_scene_id(index) for index in range(num_frames)}
    sends_frames = bool(settings.observers or settings.metrics) or not settings.device.startswith("cpu")
    return compute_num_workers(num_frames, len(scene_ids), sends_frames=sends_frames)


def _build_target_observers(
    task: Task[FrameDataset], settings: Settings, params: MeasurementParams
) -> dict[str, NearFieldObserver]:
    """Build the observer of test targets in the near field; a recording has no scene in which to place them."""
    has_own_regions = bool(settings.regions and settings.regions.regions)
    names: Sequence[str | Path] = () if settings.only_detection or has_own_regions else params.test_targets
    if settings.test_targets is not None:
        names = settings.test_targets
    if not (names and isinstance(task.frames, SimulatedFrames)):
        return {}
    targets = [Target.load(name) for name in names]
    target_names = [target.name for target in targets]
    if len(set(target_names)) < len(target_names):
        raise ValueError(f"test_targets: a test target is given twice: {', '.join(target_names)}")
    return {NEAR_FIELD_TARGETS: NearFieldObserver(task.frames.simulator, targets, NUM_BLOCKS)}


def _observe_frames(
    task: Task[FrameDataset], settings: Settings, further_observers: Observers, stopping_rule: StoppingRule | None
) -> _ObservedRun:
    """Pass all frames to the coverage metrics and the other observers, from and to a checkpoint, over all ranks."""
    ranks, checkpoint = settings.ranks, settings.checkpoint
    if ranks:
        # Each rank of a machine has its own GPU.
        settings = replace(settings, device=ranks.get_device(settings.device))
    coverage = _build_coverage_observers(task, settings)
    target_rule = None
    if settings.target_error:
        target_rule = TargetErrorRule(settings.target_error, coverage, task.query_plan.target_regions)
    observers: Sequence[AnyObserver] = [*coverage.values(), *further_observers.values()]
    identity: dict[str, str] = {}
    if ranks or checkpoint:
        identity = build_run_identity(task, settings, further_observers, ranks.num_ranks if ranks else 1)
    if ranks:
        if settings.target_error:
            raise ValueError("target error: a rank only has its share of the frames; omit it, or run without torchrun")
        ranks.check_identity({**identity, "num_frames": str(task.num_frames or len(task.frames))})
    with ExitStack() as stack:
        journal = None
        if checkpoint is not None:
            file = checkpoint if isinstance(checkpoint, Checkpoint) else Checkpoint(Path(checkpoint))
            file = file.for_rank(ranks.rank if ranks else 0)
            if ranks is None or ranks.rank == 0:
                stack.enter_context(lock_folder(file.path.parent))
            journal = CheckpointManager(file, identity, _name_states(coverage, further_observers, target_rule))
        run = observe(
            task.frames,
            observers,
            num_frames=task.num_frames,
            num_workers=settings.num_workers or 0,
            device=settings.device,
            skip_bad_frames=settings.skip_bad_frames,
            stopping_rule=target_rule or stopping_rule,
            show_progress=settings.progress and (ranks is None or ranks.rank == 0),
            keep_partial=True,
            journal=journal,
            ranks=ranks,
        )
        if ranks:
            run, observers = _merge_ranks(run, observers, ranks)
    num_rigs = len(coverage)
    return _ObservedRun(
        dict(zip(coverage, observers[:num_rigs], strict=True)),
        dict(zip(further_observers, observers[num_rigs:], strict=True)),
        run,
    )


def _build_coverage_observers(task: Task[FrameDataset], settings: Settings) -> dict[str, CoverageObserver]:
    """Build the coverage observer of each rig."""
    metadata = task.metadata
    sensor_names = metadata.sensor_names if settings.redundancy else dict.fromkeys(metadata.rigs, ())
    if unknown := [rig for rig in metadata.rigs if rig not in sensor_names]:
        raise ValueError(f"redundancy: unknown which points of {', '.join(unknown)} are of which sensor")
    observers = {}
    for name in metadata.rigs:
        metric = build_metric(settings, task.query_plan, sensor_names[name], has_area_weights=metadata.has_area_weights)
        observers[name] = CoverageObserver(metric, name)
    return observers


def _merge_ranks(run: Run, observers: Sequence[AnyObserver], ranks: Ranks) -> tuple[Run, Sequence[AnyObserver]]:
    """Merge the runs and the observers of all ranks, as if one process had received all frames."""
    if isinstance(run.failure, KeyboardInterrupt):
        raise run.failure  # Ctrl-C ends all ranks, so this one must not wait for the others
    if run.failure:
        ranks.report_failure(run.failure)
    parts = ranks.gather((run.num_frames, run.counts, run.skipped_frames, run.duration_s))
    observers = ranks.merge(observers)
    failure = ranks.failure
    merged = Run(failure=run.failure or (ChildProcessError(failure) if failure else None))
    counts = Counter[str]()
    for num_frames, part_counts, skipped_frames, duration_s in parts:
        counts.update(part_counts)  # the operator + would drop counts of 0
        merged.num_frames += num_frames
        merged.skipped_frames += skipped_frames
        merged.duration_s = max(merged.duration_s, duration_s)
    merged.counts = counts
    merged.skipped_frames.sort(key=lambda reason: BadFrameError(reason).index)
    if not merged.num_frames:
        merged.raise_failure()
        raise ValueError("no frame could be used, so there is no result")
    return merged, observers


def _name_states(
    coverage: Observers, further_observers: Observers, target_rule: TargetErrorRule | None
) -> dict[str, Any]:
    """Name the parts of a checkpoint, as its file and messages call them."""
    states: dict[str, Any] = {f"coverage of {name}": observer for name, observer in coverage.items()}
    states |= {f"observer {name}": observer for name, observer in further_observers.items()}
    if target_rule:
        states["target error"] = target_rule
    return states


def build_metric(
    settings: Settings,
    query_plan: QueryPlan,
    sensors: Sequence[str] = (),
    *,
    has_area_weights: bool,
    num_blocks: int = NUM_BLOCKS,
    params: MeasurementParams = MeasurementParams(),
) -> CoverageSums:
    """Build the coverage metric of one rig.

    Args:
        settings: Settings of `evaluate`.
        query_plan: Grid and regions.
        sensors: Names of the sensors, for redundancy.
        has_area_weights: Whether reference points have area weights.
        num_blocks: Blocks of the block jackknife.
        params: Defaults.

    Raises:
        ValueError: Area average without area weights, unavailable device, invalid threshold, or more cells than
            fit into memory.
    """
    if settings.average == "area" and not has_area_weights:
        raise ValueError(
            "average area: it needs area weights of the reference points, which the surface reference of a simulation "
            "provides; omit it for averages over observed cells"
        )
    device, grid = get_device(settings.device), query_plan.grid
    metric = CoverageSums(
        grid,
        settings.thresholds_m,
        max_radius_m=grid.diagonal_m,
        num_blocks=num_blocks,
        aggregations=settings.aggregations,
        regions=query_plan.regions,
        sensor_names=sensors,
        needs_radii=not settings.only_detection,
        has_area_weights=has_area_weights and settings.average != "cells",
    )
    map_bytes = params.bytes_per_cell * grid.num_cells
    check_memory_fits(f"maps of {grid.num_cells:,} cells", map_bytes, "use larger cells, or a smaller grid")
    return metric.to(device)
