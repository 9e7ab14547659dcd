"""What the commands that measure share: the recording, the checkpoint, the processes, the end."""

import json
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from collections.abc import Iterator

    from torchcover.evaluation import Checkpoint, Ranks, Result
    from torchcover.evaluation.observers import AnyObserver
    from torchcover.evaluation.rerun_log import RerunLog
    from torchcover.frames import FrameSource


def opened(
    frames: Path | None,
    recording_format: str | None,
    sensors: list[str] | None,
    reference: str | None,
    window_s: float | None,
) -> "FrameSource | None":
    """The recording of a command line, if it names one.

    Raises:
        ValueError: Options for recordings without one; what `open_recording` raises.
    """
    if frames is None:
        for option, given in (("format", recording_format), ("sensors", sensors), ("window", window_s)):
            if given is not None:
                raise ValueError(f"--{option}: for a recording, which --frames gives")
        return None
    from rich.console import Console
    from rich.markup import escape

    from torchcover.recordings import RecordedFrames, open_recording, reference_of_recording

    with Console(stderr=True).status(f"opening {escape(str(frames))}"):  # seconds, where there are 100,000 frames
        recording = open_recording(frames, recording_format)
    return RecordedFrames(
        recording,
        rigs={names: names.split(",") for names in sensors} if sensors else None,
        reference=reference_of_recording(reference, window_s),
    )


def checkpoint_in(out: Path, *, resume: bool) -> "Checkpoint":
    """The checkpoint in the folder of the results; one line if it is not what the user may think."""
    from torchcover.evaluation import Checkpoint

    path = out / "checkpoint.npz"
    if resume and not path.exists():
        typer.echo(f"torchcover: {path} is not there: the run starts with its first step", err=True)
    elif path.exists() and not resume and not _complete(out):
        typer.echo(f"torchcover: {path} will be replaced; to go on from it, stop now and add --resume", err=True)
    return Checkpoint(path, resume)


def _complete(out: Path) -> bool:
    """Whether the run of a folder has come to its end; nothing of it is lost if another one takes its place."""
    try:
        return json.loads((out / "summary.json").read_text(encoding="utf-8"))["complete"] is True
    except (OSError, ValueError, LookupError, TypeError):
        return False


@contextmanager
def sharing(out: Path) -> "Iterator[Ranks | None]":
    """The folder, kept for this run; and the processes that share it, the first of which writes."""
    from torchcover.evaluation import claimed, joined_ranks

    with joined_ranks() as ranks, claimed(out) if ranks is None or ranks.rank == 0 else nullcontext():
        yield ranks


def logged(path: Path | None, ranks: "Ranks | None") -> "RerunLog | None":
    """The recording for the Rerun viewer, if there is to be one.

    Raises:
        ValueError: Several processes share the run, or rerun-sdk is not installed.
    """
    if path is None:
        return None
    if ranks is not None:
        raise ValueError(f"--rerun {path}: several processes cannot write one file; run it without torchrun")
    from torchcover.evaluation.rerun_log import RerunLog

    try:
        return RerunLog(path)
    except ImportError as error:
        raise ValueError(f"--rerun {error}") from error


def watching(log: "RerunLog | None") -> "dict[str, AnyObserver] | None":
    """What looks at the frames beside the coverage."""
    return None if log is None else {"rerun": log}


def finish(
    result: "Result",
    out: Path,
    ranks: "Ranks | None",
    log: "RerunLog | None" = None,
    *,
    error_maps: bool,
    explain: bool,
) -> None:
    """Results are safe before anything is printed; then the command ends as the run did."""
    from torchcover.cli.printing import print_result

    if ranks is None or ranks.rank == 0:
        files = result.save(out, error_maps=error_maps)
        print_result(result, files, out, explain=explain)
        if log is not None:
            log.finish(result)
    if result.run is not None:
        result.run.raise_failure()
