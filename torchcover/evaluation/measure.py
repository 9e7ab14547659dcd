"""Evaluate a rig, or compare several: what a notebook calls, and the command line too."""

from collections.abc import Mapping, Sequence

from torchcover.evaluation.observers import AnyObserver, CoverageObserver
from torchcover.evaluation.pipeline import observe
from torchcover.evaluation.result import Result
from torchcover.evaluation.rig_names import AnyRig
from torchcover.evaluation.saved import are_saved, compare_saved
from torchcover.evaluation.settings import Settings
from torchcover.evaluation.target_error import TargetError, TargetWatch
from torchcover.evaluation.task import AnyFrames, AnyScenario, Task, task_of

Observers = Mapping[str, AnyObserver]


def evaluate(
    rig: AnyRig | None = None,
    scenario: AnyScenario | None = None,
    *,
    frames: AnyFrames | None = None,
    steps: int | None = None,
    seed: int = 0,
    cell_m: float = 0.25,
    thresholds: Sequence[float] = (0.4,),
    reference: str | None = None,
    rays: int | None = None,
    every_s: float | None = None,
    target_error: TargetError | None = None,
    device: str = "cpu",
    workers: int = 0,
    skip_bad_frames: bool = False,
    observers: Observers | None = None,
    progress: bool = False,
) -> Result:
    """Measure the coverage of a rig, as `torchcover evaluate` does.

    Args:
        rig: A rig, the name of a built-in one, or the path of a YAML file. Optional with `frames`: which of several
            rigs of a recording, or what its only one is, so that the maps show its sensors.
        scenario: The world, likewise; the courtyard if not given.
        frames: A recording, or any source of frames, instead.
        steps: Steps to simulate (64; with a target error at most, 4096), or frames to use at most (all).
        seed: Seed of the simulation.
        cell_m: Side of a grid cell in metres.
        thresholds: Detection thresholds in metres.
        reference: Reference sensor: "even" (if not given) or "paper".
        rays: Its rays at each step (even: 262144; paper: 1048576, a square).
        every_s: Time between two steps in seconds; 10 in traffic if not given, else the scenario's own step.
        target_error: End once every number is this good.
        device: Where the search and the sums run: "cpu", "cuda", ...
        workers: Processes that make frames; 0 makes them in this one.
        skip_bad_frames: Skip and note frames that cannot be read, instead of ending with the first.
        observers: What else looks at the same frames, by name; what they compute is in `Result.observed`.
        progress: Whether to show a bar.

    Returns:
        Numbers, maps, and how the run went. Ctrl-C, or a bad frame, ends the run and not the evaluation: see
        `result.run.complete`.

    Raises:
        ValueError: Settings that make no sense, or not a single good frame.
        FileNotFoundError: An unknown name or file.

    Example:
        >>> result = evaluate("front_roof_32", steps=2, cell_m=1.0, rays=1024)
        >>> result.coverage.counts["steps"], [row["region"] for row in result.summary][::2]
        (2, ['20m', '80m', '160m'])
    """
    settings = Settings(
        steps, seed, cell_m, tuple(thresholds), reference, rays, every_s, target_error, device, workers, skip_bad_frames
    )
    task = task_of([] if rig is None else [rig], scenario, frames, settings)
    if len(task.clouds) > 1:
        raise ValueError(f"{frames} holds the rigs {', '.join(task.clouds)}: say which, or compare them")
    return _measured(task, settings, observers or {}, progress=progress)


def compare(
    rigs: Sequence[AnyRig] = (),
    scenario: AnyScenario | None = None,
    *,
    frames: AnyFrames | None = None,
    steps: int | None = None,
    seed: int = 0,
    cell_m: float = 0.25,
    thresholds: Sequence[float] = (0.4,),
    reference: str | None = None,
    rays: int | None = None,
    every_s: float | None = None,
    target_error: TargetError | None = None,
    device: str = "cpu",
    workers: int = 0,
    skip_bad_frames: bool = False,
    observers: Observers | None = None,
    progress: bool = False,
) -> Result:
    """Measure several rigs in the same frames, against the same reference, as `torchcover compare` does.

    Args:
        rigs: Two or more, each as in `evaluate`; the others are compared with the first. Of a recording: its rigs by
            name, all if not given. Or `.npz` files of `Coverage.save`, of rigs that were measured in the same frames:
            nothing is measured then, and nothing else may be set.
        scenario: As in `evaluate`, and so are all that follow.
        frames: Frames of several rigs.
        steps: Steps.
        seed: Seed.
        cell_m: Side of a grid cell in metres.
        thresholds: Detection thresholds in metres.
        reference: Reference sensor.
        rays: Its rays at each step.
        every_s: Time between two steps in seconds.
        target_error: End once every number, and every difference, is this good.
        device: Where the search and the sums run.
        workers: Processes that make frames.
        skip_bad_frames: Whether to skip bad frames.
        observers: What else looks at the same frames.
        progress: Whether to show a bar.

    Returns:
        As `evaluate`; its rows have the differences to the first rig and whether they are more than chance.

    Raises:
        ValueError: Fewer than two rigs, or as `evaluate`.
        FileNotFoundError: An unknown name or file.
    """
    settings = Settings(
        steps, seed, cell_m, tuple(thresholds), reference, rays, every_s, target_error, device, workers, skip_bad_frames
    )
    if are_saved(rigs):
        _check_unset(scenario, frames, settings)
        return compare_saved([str(rig) for rig in rigs])
    task = task_of(rigs, scenario, frames, settings)
    if len(task.clouds) < 2:
        raise ValueError(f"compare needs at least two rigs; got {next(iter(task.clouds))!r} only (for one: `evaluate`)")
    return _measured(task, settings, observers or {}, progress=progress)


def _check_unset(scenario: AnyScenario | None, frames: AnyFrames | None, settings: Settings) -> None:
    if scenario is not None or frames is not None or settings != Settings():
        raise ValueError("coverage files are measured already: leave out the scenario, the frames and their settings")


def _measured(task: Task, settings: Settings, others: Observers, *, progress: bool) -> Result:
    coverages = {name: CoverageObserver(settings.metric(), of) for name, of in task.clouds.items()}
    regions, target = settings.regions, settings.target_error
    run = observe(
        task.frames,
        [*coverages.values(), *others.values()],
        steps=task.steps,
        workers=settings.workers,
        device=settings.device,
        skip_bad_frames=settings.skip_bad_frames,
        until=TargetWatch(target, coverages, regions) if target else None,
        progress=progress,
    )
    return Result(
        coverages={name: observer.compute() for name, observer in coverages.items()},
        regions=regions,
        run=run,
        rigs=task.given,
        source=task.description,
        reference=task.frames.reference,
        device=settings.device,
        target_error=target,
        sensors=task.sensors,
        ego_outline_m=task.frames.ego_outline_m,
        observed={name: observer.compute() for name, observer in others.items()},
    )
