"""What the commands that measure share: the recording, the checkpoint, the processes, the end."""

from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from collections.abc import Iterator

    from torchcover.data import FrameSource
    from torchcover.evaluation import Checkpoint, Ranks, Result


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
    from torchcover.data import RecordedFrames, open_recording, reference_of_recording

    return RecordedFrames(
        open_recording(frames, recording_format),
        rigs={names: names.split(",") for names in sensors} if sensors else None,
        reference=reference_of_recording(reference, window_s),
    )


def checkpoint_in(out: Path, *, resume: bool) -> "Checkpoint":
    """The checkpoint in the folder of the results; one line if it is not what the user may think."""
    from torchcover.evaluation import Checkpoint

    path = out / "checkpoint.npz"
    if resume and not path.exists():
        typer.echo(f"torchcover: {path} is not there: the run starts with its first step", err=True)
    elif path.exists() and not resume:
        typer.echo(f"torchcover: {path} will be replaced; to go on from it, stop now and add --resume", err=True)
    return Checkpoint(path, resume)


@contextmanager
def sharing(out: Path) -> "Iterator[Ranks | None]":
    """The folder, kept for this run; and the processes that share it, the first of which writes."""
    from torchcover.evaluation import claimed, joined_ranks

    with joined_ranks() as ranks, claimed(out) if ranks is None or ranks.rank == 0 else nullcontext():
        yield ranks


def finish(result: "Result", out: Path, ranks: "Ranks | None", *, error_maps: bool, explain: bool) -> None:
    """Results are safe before anything is printed; then the command ends as the run did."""
    from torchcover.cli.printing import print_result

    if ranks is None or ranks.rank == 0:
        files = result.save(out, error_maps=error_maps)
        print_result(result, files, out, explain=explain)
    if result.run is not None:
        result.run.raise_failure()
