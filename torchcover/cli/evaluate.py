"""Commands `evaluate` and `compare`; heavy modules are imported when a command runs."""

import inspect
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchcover.cli import options
from torchcover.cli.options import build_setting_options, format_option_name, get_parameters, with_options
from torchcover.evaluation.config import load_config
from torchcover.evaluation.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from torchcover.evaluation import Checkpoint, Ranks, Result
    from torchcover.evaluation.rerun_log import RerunLog
    from torchcover.recordings import RecordedFrames, RecordingSettings


def _run_evaluation(
    rigs: list[str] | None,
    min_rigs: int,
    frames: Annotated[
        Path | None, typer.Option(help="Recording instead of a simulation; formats: docs/recordings.md.")
    ] = None,
    sensors: Annotated[
        list[str] | None,
        typer.Option(help="Sensors of the recording that form a rig, as in `roof,left`; may be repeated (all)."),
    ] = None,
    region: Annotated[
        list[str] | None, typer.Option(help="Region NAME:x0,x1,y0,y1 in meters instead of --regions; may be repeated.")
    ] = None,
    out: options.OutOption = Path("out"),
    files: options.FilesOption = options.ALL_FILES,
    explain: Annotated[
        bool, typer.Option("--explain", help="Print the work that was skipped because the scene did not need it.")
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue from the checkpoint in --out, also with more --num-frames.")
    ] = False,
    config: options.ConfigOption = None,
    assignments: options.AssignmentsOption = None,
    **option_values: Any,  # noqa: ANN401
) -> None:
    """Evaluate rigs in the same frames, save the result, and print it."""
    from torchcover import evaluation

    loaded = load_config(config, assignments or (), options.find_changed_settings(option_values))
    settings = {**loaded.config.get_changed_settings(), "config_record": loaded.record}
    recording = open_frames(frames, settings, loaded.config.recording, sensors)
    rig_names = list(rigs or (() if recording is None else recording.sensors_by_rig))
    weather = settings.get("weather") or ()
    # `compare` of one rig in one weather compares the weather with clear air.
    if len(rig_names) == 1 and min_rigs > 1 and len(weather) == 1:
        weather = settings["weather"] = ["clear", *weather]
    if 0 < len(rig_names) * max(1, len(weather)) < min_rigs:
        raise ValueError(
            f"compare: at least two rigs are needed; got only {rig_names[0]} (use `evaluate` for one; each --sensors "
            "makes a rig of a recording)"
        )
    regions = options.combine_regions(settings.get("regions"), region)
    if regions is not None:
        settings["regions"] = regions
    with join_run(out) as ranks:
        log = open_rerun_log(loaded.config.rerun, ranks)
        # Several scenarios have one checkpoint each; other settings do not matter here.
        checkpoint = prepare_checkpoint(out, Settings(scenario=settings.get("scenario")), resume=resume)
        result = evaluation.evaluate(
            rigs,
            frames=recording,
            checkpoint=checkpoint,
            ranks=ranks,
            observers={} if log is None else {"rerun": log},
            progress=True,
            **settings,
        )
        save_and_print(result, out, ranks, log, checkpoint, file_kinds=files, explain=explain)


EVALUATION_OPTIONS = [
    *(item for item in get_parameters(_run_evaluation) if item.default is not inspect.Parameter.empty),
    *build_setting_options(
        "scenario",
        "vehicle",
        "weather",
        "regions",
        "thresholds_m",
        "reference",
        "redundancy",
        "num_frames",
        "num_rays",
        "seed",
        "target_error",
        "device",
        "num_workers",
    ),
]


@with_options(EVALUATION_OPTIONS)
def evaluate(
    rigs: Annotated[
        list[str] | None,
        typer.Argument(help="Rigs: built-in names (see `list`) or YAML files; with --frames, rigs of it (all)."),
    ] = None,
    **option_values: Any,  # noqa: ANN401
) -> None:
    """Evaluate the coverage of one or more rigs: table, maps, and files for `compare`."""
    _run_evaluation(rigs, 1, **option_values)


@with_options(EVALUATION_OPTIONS)
def compare(
    rigs: Annotated[
        list[str] | None,
        typer.Argument(help="Two or more rigs as in `evaluate`, or coverage.npz files of runs over the same frames."),
    ] = None,
    **option_values: Any,  # noqa: ANN401
) -> None:
    """Compare rigs in the same frames: table with the better values marked, maps side by side, differences."""
    files = [rig for rig in rigs or () if Path(rig).suffix == ".npz"]
    if not files:
        _run_evaluation(rigs, 2, **option_values)
        return
    defaults = {item.name: item.default for item in EVALUATION_OPTIONS}
    values = {**defaults, **option_values}
    # Options that only affect the output are allowed; any other would need a new evaluation.
    changed = []
    for name, value in values.items():
        if value != defaults[name] and name not in ("out", "files", "explain"):
            changed.append(format_option_name(name))
    if changed or len(files) < len(rigs or ()):
        raise ValueError(
            f"{files[0]} is measured already: compare coverage files with each other, without "
            f"{', '.join(changed) or 'rigs'}; or `evaluate` rigs in the same frames first"
        )
    from torchcover import evaluation

    out = values["out"]
    with join_run(out) as ranks:
        result = evaluation.compare(files)
        save_and_print(result, out, ranks, file_kinds=values["files"], explain=values["explain"])


def open_frames(
    frames: Path | None, settings: dict[str, Any], recording_settings: "RecordingSettings", sensors: list[str] | None
) -> "RecordedFrames | None":
    """Open the recording of `--frames`.

    Args:
        frames: Folder or file of the recording; None: no recording.
        settings: Settings of the run; `vehicle` and `reference` are removed from it if there is a recording.
        recording_settings: Settings of the recording.
        sensors: Texts with names of sensors, one for each rig; None: all sensors.

    Returns:
        The frames; None without a recording.

    Raises:
        ValueError: Settings of a recording without one, or as in `open_recording`.
    """
    if frames is None:
        names = [f"recording.{name}" for name in recording_settings.model_fields_set]
        if sensors or names:
            raise ValueError(f"{', '.join(names) or '--sensors'}: only for a recording, which --frames names")
        return None
    from rich.markup import escape

    from torchcover.recordings import RecordedFrames, create_reference, merge_recording_settings
    from torchcover.report import Terminal

    with Terminal(stderr=True).status(f"opening {escape(str(frames))}"):  # takes seconds for 100,000 frames
        recording = options.open_recording(frames, recording_settings, settings.pop("vehicle", None))
    window_s = merge_recording_settings(frames, recording_settings).window_s
    return RecordedFrames(
        recording,
        rigs={names: names.split(",") for names in sensors} if sensors else None,
        reference=create_reference(settings.pop("reference", None), window_s),
    )


def prepare_checkpoint(out: Path, settings: Settings, *, resume: bool) -> "Checkpoint":
    """Create the checkpoint in the folder of the results.

    A line on stderr reports a missing checkpoint to resume, and an incomplete one that will be replaced.

    Args:
        out: Folder of the results.
        settings: Settings with the scenario.
        resume: Continue from the checkpoint.
    """
    from torchcover.evaluation import Checkpoint
    from torchcover.files import SUMMARY, read_manifest

    checkpoint = Checkpoint(out / "checkpoint.npz", resume, keep=resume)
    is_complete = (read_manifest(out / SUMMARY) or {}).get("complete") is True
    for path in _list_checkpoint_paths(checkpoint, list(settings.mixture or ())):
        if resume and not path.exists():
            typer.echo(f"torchcover: {path} does not exist: the run starts with its first frame", err=True)
        elif path.exists() and not resume and not is_complete:
            typer.echo(f"torchcover: {path} will be replaced; to continue from it, stop now and add --resume", err=True)
    return checkpoint


def _list_checkpoint_paths(checkpoint: "Checkpoint", scenario_names: "Sequence[str]") -> list[Path]:
    """List the files of a checkpoint: one for each of several scenarios."""
    from torchcover.report import build_file_stems

    if not scenario_names:
        return [checkpoint.path]
    return [checkpoint.in_folder(stem).path for stem in build_file_stems(scenario_names)]


@contextmanager
def join_run(out: Path) -> "Iterator[Ranks | None]":
    """Join the processes that share the run, and lock the folder of the results in the process that writes.

    Args:
        out: Folder of the results.
    """
    from torchcover.evaluation import join_ranks
    from torchcover.files import lock_folder

    with join_ranks() as ranks, lock_folder(out) if ranks is None or ranks.rank == 0 else nullcontext():
        yield ranks


def open_rerun_log(path: str | None, ranks: "Ranks | None") -> "RerunLog | None":
    """Open the file for the Rerun viewer.

    Args:
        path: The file; None: no file.
        ranks: Processes that share the run.

    Raises:
        ValueError: Several processes share the run, or rerun-sdk is not installed.
    """
    if path is None:
        return None
    if ranks is not None:
        raise ValueError(f"rerun {path}: several processes cannot write one file; run it without torchrun")
    from torchcover.evaluation.rerun_log import RerunLog

    try:
        return RerunLog(Path(path))
    except ImportError as error:
        raise ValueError(f"rerun {error}") from error


def save_and_print(
    result: "Result",
    out: Path,
    ranks: "Ranks | None",
    rerun_log: "RerunLog | None" = None,
    checkpoint: "Checkpoint | None" = None,
    *,
    file_kinds: str,
    explain: bool,
) -> None:
    """Save a result, print it, and raise the error that ended the run, if any.

    Args:
        result: The result.
        out: Folder of the results.
        ranks: Processes that share the run; only rank 0 saves and prints.
        rerun_log: File for the Rerun viewer.
        checkpoint: Checkpoint of the run; a complete run deletes it unless `keep` is set.
        file_kinds: Files in addition to `summary.json`.
        explain: Print the omissions.
    """
    from torchcover.cli.printing import print_result
    from torchcover.evaluation import MixedResult
    from torchcover.evaluation.result_page import describe_rendering_cost

    # Every rank has the same result; the first one writes it.
    is_mixed = isinstance(result, MixedResult)
    results = result.scenario_results if isinstance(result, MixedResult) else {"": result}
    if ranks is None or ranks.rank == 0:
        for scenario_result in results.values():
            if announcement := describe_rendering_cost(scenario_result.coverages, file_kinds):
                typer.echo(f"torchcover: {announcement}", err=True)
        written = result.save(out, file_kinds=file_kinds)
        print_result(result, written, out, explain=explain)
        if rerun_log is not None and not is_mixed:
            rerun_log.finish(result)
    delete_checkpoint = checkpoint is not None and not checkpoint.keep
    if is_mixed:  # an incomplete mixture has no result
        if checkpoint is not None and delete_checkpoint:
            for path in _list_checkpoint_paths(checkpoint, list(results)):
                path.unlink(missing_ok=True)
    elif result.run is not None:
        if checkpoint is not None and delete_checkpoint and result.run.is_complete:
            checkpoint.for_rank(ranks.rank if ranks else 0).path.unlink(missing_ok=True)
        result.run.raise_failure()
