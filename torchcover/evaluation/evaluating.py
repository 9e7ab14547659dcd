"""Evaluate a rig, or compare several: what a notebook calls, and the command line too."""

from collections.abc import Sequence
from pathlib import Path

from torchcover.coverage import Aggregation, Measure
from torchcover.evaluation.checkpoint import AnyCheckpoint
from torchcover.evaluation.measuring import Observers, measured
from torchcover.evaluation.ranks import Ranks
from torchcover.evaluation.result import Result
from torchcover.evaluation.rig_names import AnyRig, given_as
from torchcover.evaluation.saved import compare_saved, saved_among
from torchcover.evaluation.settings import AnyAsk, AnyDevice, AnyMetrics, AnyThresholds, Settings
from torchcover.evaluation.target_error import AnyTargetError
from torchcover.evaluation.task import AnyFrames, AnyScenario, task_of


def evaluate(
    rig: AnyRig | None = None,
    scenario: AnyScenario | None = None,
    *,
    frames: AnyFrames | None = None,
    steps: int | None = None,
    seed: int = 0,
    vehicle: str | Path | None = None,
    ask: AnyAsk | None = None,
    cell_m: float | None = None,
    thresholds: AnyThresholds = (0.4,),
    aggregations: Sequence[Aggregation] = (),
    reference_sensor: str | None = None,
    rays: int | None = None,
    estimate: Measure | None = None,
    every_s: float | None = None,
    target_error: AnyTargetError | None = None,
    redundancy: bool = False,
    metrics: AnyMetrics = (),
    device: AnyDevice = "cpu",
    workers: int = 0,
    skip_bad_frames: bool = False,
    observers: Observers | None = None,
    checkpoint: AnyCheckpoint | None = None,
    ranks: Ranks | None = None,
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
        vehicle: What carries the rig: a built-in vehicle, the YAML file of one, or a mesh file. Not given: the
            scenario's own ego, else the vehicle that the rig names, else an SUV.
        ask: Regions, height bands and grid: `RegionsOfInterest`, or the path of a YAML file; not given: the paper's
            regions in front, and the near field on the four sides of the vehicle.
        cell_m: Side of a grid cell in metres, whatever `ask` says; 0.25 if neither does.
        thresholds: Detection thresholds in metres, or a single one.
        aggregations: Maps beside the mean of means, as in `CoverageMetric`.
        reference_sensor: Name of the reference sensor, as in `torchcover.simulation.REFERENCE_SENSORS`; "surface" if
            not given.
        rays: Its rays at each step; as many as it does best with if not given.
        estimate: What the number of a region is a mean over: "area", its visible surface, or "known", its known cells.
            Not given: the surface, if the reference points have square metres.
        every_s: Time between two steps in seconds; not given: 10 in traffic, else what spreads them over the scenario.
        target_error: End once every number, of the usual regions those in front, is this good: a `TargetError`,
            "0.1%", or ["0.1%", "0.02m"].
        redundancy: Whether to find out by how many sensors places are seen, and what is lost when each sensor fails:
            `Result.table.redundancy` and `Coverage.redundancy`.
        metrics: Metrics that others published, by their names in `torchcover.published.PUBLISHED`, or "all" of them:
            `Result.metrics`.
        device: Where the search and the sums run: "cpu", "cuda", ...
        workers: Processes that make frames; 0 makes them in this one.
        skip_bad_frames: Skip and note frames that cannot be read, instead of ending with the first.
        observers: What else looks at the same frames, by name; what they compute is in `Result.observed`.
        checkpoint: File (`.npz`) that the run is saved to every minute and at its end. If it is there, the run goes on
            from it, to the same bits, and with more steps if that is asked for; or `Checkpoint(path, resume=False)`.
            Observers need `state_dict` and `load_state_dict` then.
        ranks: Processes that share the run, from `joined_ranks()`; all of them call this, and get the same result.
        progress: Whether to show a bar.

    Returns:
        Numbers, maps, and how the run went. Whatever ends it after the first step, a bad frame, Ctrl-C or an error, is
        noted in `result.run.failure`, with a RuntimeWarning, and what was measured until then is there.

    Raises:
        ValueError: Settings that make no sense, not a single good frame, or a checkpoint of another run.
        FileNotFoundError: An unknown name or file.
        TypeError: A setting of a wrong kind, or an observer whose state cannot be saved.

    Example:
        >>> result = evaluate("front_roof_32", steps=2, cell_m=1.0, rays=1024)
        >>> result.coverage.counts["steps"], [row["region"] for row in result.summary][::2]
        (2, ['20m', '80m', '160m', 'front_3m', 'rear_3m', 'left_3m', 'right_3m'])
    """
    settings = Settings.among(locals())
    named = [] if rig is None else [rig]
    if saved_among(named):
        raise ValueError(f"{rig} is measured already: read it by Coverage.load, or compare it with others")
    task = task_of(named, scenario, frames, settings)
    if len(task.rigs) > 1:
        raise ValueError(f"{task.place} holds the rigs {', '.join(task.rigs)}: say which, or compare them")
    return measured(task, settings, observers or {}, checkpoint, ranks, progress=progress)


def compare(
    rigs: Sequence[AnyRig] = (),
    scenario: AnyScenario | None = None,
    *,
    frames: AnyFrames | None = None,
    steps: int | None = None,
    seed: int = 0,
    vehicle: str | Path | None = None,
    ask: AnyAsk | None = None,
    cell_m: float | None = None,
    thresholds: AnyThresholds = (0.4,),
    aggregations: Sequence[Aggregation] = (),
    reference_sensor: str | None = None,
    rays: int | None = None,
    estimate: Measure | None = None,
    every_s: float | None = None,
    target_error: AnyTargetError | None = None,
    redundancy: bool = False,
    metrics: AnyMetrics = (),
    device: AnyDevice = "cpu",
    workers: int = 0,
    skip_bad_frames: bool = False,
    observers: Observers | None = None,
    checkpoint: AnyCheckpoint | None = None,
    ranks: Ranks | None = None,
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
        vehicle: What carries all rigs; needed where they name different ones.
        ask: Regions, height bands and grid.
        cell_m: Side of a grid cell in metres.
        thresholds: Detection thresholds in metres.
        aggregations: Maps beside the mean of means.
        reference_sensor: Name of the reference sensor.
        rays: Its rays at each step.
        estimate: What the numbers are means over.
        every_s: Time between two steps in seconds.
        target_error: End once every number, and every difference, is this good.
        redundancy: Whether to find out what is lost when each sensor of each rig fails.
        metrics: Metrics that others published; the result has how alike their orders of the rigs are, too.
        device: Where the search and the sums run.
        workers: Processes that make frames.
        skip_bad_frames: Whether to skip bad frames.
        observers: What else looks at the same frames.
        checkpoint: File that the run is saved to, and goes on from.
        ranks: Processes that share the run.
        progress: Whether to show a bar.

    Returns:
        As `evaluate`; its rows have the differences to the first rig and whether they are more than chance.

    Raises:
        ValueError: Fewer than two rigs, or as `evaluate`.
        FileNotFoundError: An unknown name or file.
        TypeError: A single rig, or a setting of a wrong kind.
    """
    settings = Settings.among(locals())
    if isinstance(rigs, AnyRig):
        raise TypeError(f"rigs: a list of two or more is needed; got {given_as(rigs)!r} (for one: `evaluate`)")
    if saved := saved_among(rigs):
        _check_saved_only(saved, rigs, observers, (scenario, frames), settings)
        return compare_saved(saved)
    task = task_of(rigs, scenario, frames, settings)
    if len(task.rigs) < 2:
        raise ValueError(
            f"compare needs at least two rigs; got {task.rigs[0]!r} only (for one: `evaluate`; of a recording, each "
            "--sensors makes a rig)"
        )
    return measured(task, settings, observers or {}, checkpoint, ranks, progress=progress)


def _check_saved_only(
    saved: Sequence[str],
    rigs: Sequence[AnyRig],
    observers: Observers | None,
    world: tuple[AnyScenario | None, AnyFrames | None],
    settings: Settings,
) -> None:
    if len(saved) < len(rigs):
        raise ValueError(
            f"{', '.join(saved)}: coverage files are compared with coverage files only; `evaluate` the rigs in the "
            "same frames first, and compare their files"
        )
    if observers or any(given is not None for given in world) or settings != Settings():
        raise ValueError(
            "coverage files are measured already: leave out the scenario, the frames, their settings and observers"
        )
