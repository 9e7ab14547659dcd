"""The commands `evaluate` and `compare`; and what else is run and shared like them. Heavy things are imported late."""

import inspect
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchcover.cli import options
from torchcover.cli.options import build_setting_options, get_parameters, with_options
from torchcover.evaluation.config import load_config
from torchcover.evaluation.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Iterator

    from torchcover.evaluation import Checkpoint, Ranks, Result
    from torchcover.evaluation.rerun_log import RerunLog
    from torchcover.frames import FrameSource
    from torchcover.recordings import RecordingSettings


def _measure(
    rigs: list[str] | None,
    at_least: int,
    frames: Annotated[
        Path | None, typer.Option(help="A recording instead of a simulation, of any layout in docs/recordings.md.")
    ] = None,
    sensors: Annotated[
        list[str] | None,
        typer.Option(
            help="With --frames: sensors of a rig, as in `roof,left`; once for each rig. Not given: those of the "
            "recording."
        ),
    ] = None,
    region: Annotated[
        list[str] | None,
        typer.Option(
            help="Region NAME:x0,x1,y0,y1 in metres, forward and to the left; may be repeated, and replaces those of "
            "--regions.",
        ),
    ] = None,
    out: options.OutOption = Path("out"),
    files: options.FilesOption = options.ALL_FILES,
    explain: Annotated[
        bool, typer.Option("--explain", help="Say what was left out because the scene did not need it.")
    ] = False,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Go on from the checkpoint in --out, whatever ended that run, and keep it at the end, so that more "
            "--num-frames can follow.",
        ),
    ] = False,
    config: options.ConfigOption = None,
    assignments: options.AssignmentsOption = None,
    **given: Any,  # noqa: ANN401
) -> None:
    """Measure rigs in the same frames, save what was measured, and print it."""
    from torchcover.evaluation import evaluate as evaluate_

    loaded = load_config(config, assignments or (), options.find_changed_settings(given))
    settings = {**loaded.config.get_changed_settings(), "config_record": loaded.record}
    recording = open_frames(frames, settings, loaded.config.recording, sensors)
    named = list(rigs or (() if recording is None else recording.rigs))
    if len(named) == 1 and at_least > 1 and len(settings.get("weather") or ()) == 1:
        settings["weather"] = ["clear", *settings["weather"]]
    if 0 < len(named) * max(1, len(settings.get("weather") or ())) < at_least:
        raise ValueError(
            f"compare: at least two rigs are needed; got {named[0]} only (for one: `evaluate`; of a recording, each "
            "--sensors makes a rig)"
        )
    if (asked := options.combine_regions(settings.get("regions"), region)) is not None:
        settings["regions"] = asked
    with join_run(out) as ranks:
        log = open_rerun_log(loaded.config.rerun, ranks)
        checkpoint = prepare_checkpoint(out, Settings(scenario=settings.get("scenario")), resume=resume)
        result = evaluate_(
            rigs,
            frames=recording,
            checkpoint=checkpoint,
            ranks=ranks,
            observers={} if log is None else {"rerun": log},
            progress=True,
            **settings,
        )
        save_and_print(result, out, ranks, log, checkpoint, file_kinds=files, explain=explain)


MEASURING = [
    *(each for each in get_parameters(_measure) if each.default is not inspect.Parameter.empty),
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
DEFAULTS = {each.name: each.default for each in MEASURING}
# Options that measure nothing.
SAVING = ("out", "files", "explain")


@with_options(MEASURING)
def evaluate(
    rigs: Annotated[
        list[str] | None,
        typer.Argument(
            help="A rig, or several in the same frames: built-in names (see `list`) or YAML files. With --frames those "
            "in it, all if not given."
        ),
    ] = None,
    **given: Any,  # noqa: ANN401
) -> None:
    """Measure the coverage of a rig, or of several: a table, maps, and files to compare and to log."""
    _measure(rigs, 1, **given)


@with_options(MEASURING)
def compare(
    rigs: Annotated[
        list[str] | None,
        typer.Argument(
            help="Rigs as in `evaluate`, two or more. Or coverage.npz files of runs over the same frames: nothing is "
            "measured then."
        ),
    ] = None,
    **given: Any,  # noqa: ANN401
) -> None:
    """Compare rigs in the same frames: a table with the better values marked, maps side by side, differences."""
    if saved := [rig for rig in rigs or () if Path(rig).suffix == ".npz"]:
        _compare_saved(
            saved, {each.name: each.default for each in MEASURING} | given, only=len(saved) == len(rigs or ())
        )
    else:
        _measure(rigs, 2, **given)


def _compare_saved(files: list[str], given: dict[str, Any], *, only: bool) -> None:
    from torchcover.evaluation import compare

    changed = [
        f"--{name.replace('_', '-')}" for name, value in DEFAULTS.items() if given[name] != value and name not in SAVING
    ]
    if changed or not only:
        raise ValueError(
            f"{files[0]} is measured already: compare coverage files with each other, without "
            f"{', '.join(changed) or 'rigs'}; or `evaluate` rigs in the same frames first"
        )
    with join_run(given["out"]) as ranks:
        result = compare(files)
        save_and_print(result, given["out"], ranks, file_kinds=given["files"], explain=given["explain"])


def open_frames(
    frames: Path | None, settings: dict[str, Any], recording_settings: "RecordingSettings", sensors: list[str] | None
) -> "FrameSource | None":
    """The recording of a command line, if it names one; `vehicle` and `reference` are taken out of the settings then.

    Raises:
        ValueError: Settings of a recording without one; what `open_recording` raises.
    """
    if frames is None:
        given = [f"recording.{name}" for name in recording_settings.model_fields_set]
        if sensors or given:
            raise ValueError(f"{', '.join(given) or '--sensors'}: for a recording, which --frames gives")
        return None
    from rich.markup import escape

    from torchcover.recordings import RecordedFrames, create_reference, merge_recording_settings
    from torchcover.report import Terminal

    with Terminal(stderr=True).status(f"opening {escape(str(frames))}"):  # seconds, where there are 100,000 frames
        recording = options.open_recording(frames, recording_settings, settings.pop("vehicle", None))
    window_s = merge_recording_settings(frames, recording_settings).window_s
    return RecordedFrames(
        recording,
        rigs={names: names.split(",") for names in sensors} if sensors else None,
        reference=create_reference(settings.pop("reference", None), window_s),
    )


def prepare_checkpoint(out: Path, settings: Settings, *, resume: bool) -> "Checkpoint":
    """The checkpoint in the folder of the results; one line if it is not what the user may think."""
    from torchcover.evaluation import Checkpoint
    from torchcover.report import build_file_stems

    checkpoint = Checkpoint(out / "checkpoint.npz", resume, keep=resume)
    for each in (
        map(checkpoint.in_folder, build_file_stems(list(settings.mixture))) if settings.mixture else [checkpoint]
    ):
        if resume and not each.path.exists():
            typer.echo(f"torchcover: {each.path} is not there: the run starts with its first step", err=True)
        elif each.path.exists() and not resume and not _complete(out):
            typer.echo(
                f"torchcover: {each.path} will be replaced; to go on from it, stop now and add --resume", err=True
            )
    return checkpoint


def _complete(out: Path) -> bool:
    """Whether the run of a folder has come to its end; nothing of it is lost if another one takes its place."""
    from torchcover.files import SUMMARY, read_manifest

    return (read_manifest(out / SUMMARY) or {}).get("complete") is True


@contextmanager
def join_run(out: Path) -> "Iterator[Ranks | None]":
    """The folder, kept for this run; and the processes that share it, the first of which writes."""
    from torchcover.evaluation import join_ranks
    from torchcover.files import lock_folder

    with join_ranks() as ranks, lock_folder(out) if ranks is None or ranks.rank == 0 else nullcontext():
        yield ranks


def open_rerun_log(path: str | None, ranks: "Ranks | None") -> "RerunLog | None":
    """The recording for the Rerun viewer, if there is to be one.

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
    """Results are safe before anything is printed; then the command ends as the run did."""
    from torchcover.cli.printing import print_result
    from torchcover.evaluation import MixedResult
    from torchcover.report import build_file_stems

    if ranks is None or ranks.rank == 0:
        for world in result.scenario_results.values() if isinstance(result, MixedResult) else [result]:
            if announcement := world.describe_rendering_cost(file_kinds):
                typer.echo(f"torchcover: {announcement}", err=True)
        written = result.save(out, file_kinds=file_kinds)
        print_result(result, written, out, explain=explain)
        if rerun_log is not None and not isinstance(result, MixedResult):
            rerun_log.finish(result)
    if isinstance(result, MixedResult):  # complete, for else there was none
        for each in (
            map(checkpoint.in_folder, build_file_stems(list(result.scenario_results)))
            if checkpoint and not checkpoint.keep
            else ()
        ):
            each.path.unlink(missing_ok=True)
        return
    if result.run is None:
        return
    if checkpoint and result.run.is_complete and not checkpoint.keep:
        checkpoint.for_rank(ranks.rank if ranks else 0).path.unlink(missing_ok=True)
    result.run.raise_failure()
