"""One measurement: a task and its settings in, a result out; from a checkpoint, and over ranks."""

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import replace
from pathlib import Path

from torchcover.coverage import CoverageSums
from torchcover.evaluation.checkpoint import Checkpoint, CheckpointManager
from torchcover.evaluation.cpu_cores import compute_num_workers
from torchcover.evaluation.observers import AnyObserver, CoverageObserver
from torchcover.evaluation.pipeline import Run, StoppingRule, observe
from torchcover.evaluation.ranks import Ranks
from torchcover.evaluation.result import Result
from torchcover.evaluation.result_page import check_drawable, list_omissions
from torchcover.evaluation.settings import Settings, load_contrib
from torchcover.evaluation.target_error import TargetErrorRule
from torchcover.evaluation.task import CALLER, Task, build_run_identity, find_ray_device, get_device
from torchcover.files import lock_folder
from torchcover.frames import BadFrameError, FrameSource
from torchcover.simulation import QueryPlan, SimulatedFrames
from torchcover.simulation.memory import check_memory_fits
from torchcover.targets import NearFieldObserver, Target

Observers = Mapping[str, AnyObserver]
# For standard errors: at least half as many are in use at the end of a long run.
BLOCKS = 16
# The sums are over what was touched, but maps are made of all cells, several of which are there at a time.
BYTES_A_CELL = 64
# Beside the vehicle, unless others are asked for; and what a run calls who puts them there.
PROBES = ("child", "adult", "cyclist", "pole")
BODIES = "bodies beside the vehicle"
# To see of how many worlds they are.
ENOUGH_FRAMES = 256


def measure_coverage(task: Task[FrameSource], settings: Settings, stopping_rule: StoppingRule | None = None) -> Result:
    """Measure it, or less if a rule says so. ValueError: as `evaluate`."""
    ranks = settings.ranks
    frames = task.frames
    sensors = [sensor for of_rig in task.sensors.values() for sensor in of_rig]
    check_drawable(sensors)
    settings = replace(settings, num_workers=_workers(task, settings))
    metrics = load_contrib().build_metrics(task, settings) if settings.metrics else None
    others = {**settings.observers, **(metrics.observers if metrics else {}), **_probes(task, settings)}
    with ranks.abort_on_error() if ranks else nullcontext():
        coverage, seen, run = _observed(task, settings, others, stopping_rule)
    coverages = {name: observer.compute() for name, observer in coverage.items()}
    if isinstance(probes := seen.get(BODIES), NearFieldObserver):
        for name, one in coverages.items():
            one.target_sums = probes.get_target_sums(name)
    if len({coverage.counts["num_frames"] for coverage in coverages.values()}) > 1:
        run.raise_failure()  # within a step: the rigs have not seen the same
    report = None
    if metrics is not None:
        after = metrics.update_from(seen)
        report = load_contrib().compare_metrics(after, coverages, task.query_plan.target_regions, settings.seed)
    result = Result(
        coverages=coverages,
        regions=task.query_plan.regions,
        run=run,
        rigs=task.rig_sources,
        source=task.description,
        reference_record=frames.reference_record,
        device=settings.device,
        target_error=settings.target_error,
        target_regions=task.query_plan.target_regions,
        sensors=task.sensors,
        ego_outline_m=frames.ego_outline_m,
        observer_results={name: seen[name].compute() for name in settings.observers},
        metrics=report,
        omissions=list_omissions(
            run.counts,
            list(coverages.values()),
            settings.aggregations,
            sensors,
            num_workers=settings.num_workers or 0,
            num_ranks=ranks.num_ranks if ranks else 1,
        ),
        block_ends=find_block_ends(frames),
    )
    if result.cut_short:
        warnings.warn(result.cut_short, RuntimeWarning, stacklevel=CALLER)
    return result


def find_block_ends(frames: FrameSource, max_blocks: int = 80, max_frames: int = 10_000) -> list[int]:
    """Find after how many frames of a source one block of time after the other is complete.

    Args:
        frames: The source.
        max_blocks: Blocks that are looked for: more than any advice on the number of frames names.
        max_frames: Frames that are looked at; a scenario that repeats has no further block.

    Returns:
        Numbers of frames, one for each block; the last may be the number of all frames.
    """
    places, ends, index = set[int](), list[int](), 0
    with suppress(IndexError):
        while index < max_frames and len(ends) < max_blocks:
            place = frames.get_block_index(index)
            if place not in places and places:
                ends.append(index)
            places.add(place)
            index += 1
    return ends if len(ends) == max_blocks else [*ends, index]


def _workers(task: Task[FrameSource], settings: Settings) -> int:
    """Processes that make the frames: recordings may share open files, and ranks share the cores."""
    if settings.num_workers is not None:
        return settings.num_workers
    frames = task.frames
    if settings.ranks or not isinstance(frames, SimulatedFrames) or find_ray_device(settings):
        return 0
    most = min(len(frames), task.num_frames or len(frames), ENOUGH_FRAMES)
    whole = bool(settings.observers or settings.metrics) or not settings.device.startswith("cpu")
    return compute_num_workers(most, len({frames.get_scene_id(index) for index in range(most)}), sends_frames=whole)


def _probes(task: Task[FrameSource], settings: Settings) -> dict[str, NearFieldObserver]:
    """Who puts bodies beside the vehicle; nobody where there is no scene to put them into."""
    usual = () if settings.only_detection or (settings.regions and settings.regions.regions) else PROBES
    names = usual if settings.test_targets is None else settings.test_targets
    if not (names and isinstance(task.frames, SimulatedFrames)):
        return {}
    bodies = [Target.load(name) for name in names]
    if len({body.name for body in bodies}) < len(bodies):
        raise ValueError(f"probe: one is given twice: {', '.join(body.name for body in bodies)}")
    return {BODIES: NearFieldObserver(task.frames.simulator, bodies, BLOCKS)}


def _observed(
    task: Task[FrameSource], settings: Settings, others: Observers, until: StoppingRule | None
) -> tuple[Observers, Observers, Run]:
    ranks, checkpoint = settings.ranks, settings.checkpoint
    if ranks:
        settings = replace(settings, device=ranks.get_device(settings.device))
    sensors = task.get_sensor_names() if settings.redundancy else {}
    has_areas = task.frames.has_area_weights
    coverage = {
        name: CoverageObserver(
            build_metric(settings, task.query_plan, sensors.get(name, ()), has_area_weights=has_areas), name
        )
        for name in task.rigs
    }
    target = settings.target_error
    watch = TargetErrorRule(target, coverage, task.query_plan.target_regions) if target else None
    observers: Sequence[AnyObserver] = [*coverage.values(), *others.values()]
    identity = (
        build_run_identity(task, settings, others, ranks.num_ranks if ranks else 1) if ranks or checkpoint else {}
    )
    if ranks:
        if target:
            raise ValueError("target error: every rank sees its share only; leave it out, or run without torchrun")
        ranks.check_identity({**identity, "num_frames": str(task.num_frames or len(task.frames))})
    with ExitStack() as stack:
        journal = None
        if checkpoint is not None:
            place = checkpoint if isinstance(checkpoint, Checkpoint) else Checkpoint(Path(checkpoint))
            place = place.for_rank(ranks.rank if ranks else 0)
            if ranks is None or ranks.rank == 0:
                stack.enter_context(lock_folder(place.path.parent))
            journal = CheckpointManager(place, identity, _states(coverage, others, watch))
        run = observe(
            task.frames,
            observers,
            num_frames=task.num_frames,
            num_workers=settings.num_workers or 0,
            device=settings.device,
            skip_bad_frames=settings.skip_bad_frames,
            stopping_rule=watch or until,
            show_progress=settings.progress and (ranks is None or ranks.rank == 0),
            keep_partial=True,
            journal=journal,
            ranks=ranks,
        )
        if ranks:
            run, observers = _whole(run, observers, ranks)
    rigs = len(coverage)
    return dict(zip(coverage, observers[:rigs], strict=True)), dict(zip(others, observers[rigs:], strict=True)), run


def _whole(run: Run, observers: Sequence[AnyObserver], ranks: Ranks) -> tuple[Run, Sequence[AnyObserver]]:
    """What all ranks have seen, as if one had."""
    if isinstance(run.failure, KeyboardInterrupt):
        raise run.failure  # whoever ends one rank ends all, and does not wait for them
    if run.failure:
        ranks.report_failure(run.failure)
    parts = ranks.gather((run.num_frames, run.counts, run.skipped_frames, run.duration_s))
    observers = ranks.merge(observers)
    words, counts = ranks.failure, Counter[str]()
    for part in parts:
        counts.update(part[1])  # + would forget what was never counted
    whole = Run(
        num_frames=sum(steps for steps, *_ in parts),
        counts=counts,
        skipped_frames=sorted((line for part in parts for line in part[2]), key=lambda line: BadFrameError(line).index),
        failure=run.failure or (ChildProcessError(words) if words else None),
        duration_s=max(seconds for *_, seconds in parts),
    )
    if not whole.num_frames:
        whole.raise_failure()
        raise ValueError("no frame could be used, so there is no result")
    return whole, observers


def _states(coverage: Observers, others: Observers, watch: TargetErrorRule | None) -> dict[str, object]:
    """What a checkpoint keeps, by the names that its file and messages have."""
    rigs = {f"coverage of {name}": one for name, one in coverage.items()}
    return {**rigs, **{f"observer {name}": one for name, one in others.items()}, **({"watch": watch} if watch else {})}


def build_metric(
    settings: Settings,
    query_plan: QueryPlan,
    sensors: Sequence[str] = (),
    *,
    has_area_weights: bool,
    num_blocks: int = BLOCKS,
) -> CoverageSums:
    """An empty metric of what `evaluate` is to measure, with the names of the sensors for redundancy.

    ValueError: an estimate by area is wanted, and there are no square metres; a device that cannot be used; a threshold
    that makes no sense, or more cells than there is memory for maps of.
    """
    if settings.average == "area" and not has_area_weights:
        raise ValueError(
            "estimate area: it needs the square metres of reference points, which the surface reference of a "
            "simulation gives; leave it out for means over the known cells"
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
    check_memory_fits(
        f"maps of {grid.num_cells:,} cells", BYTES_A_CELL * grid.num_cells, "use larger cells, or a smaller grid"
    )
    return metric.to(device)
