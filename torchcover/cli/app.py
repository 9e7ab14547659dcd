"""The commands and their options."""

import io
import os
import signal
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from torchcover.cli import options
from torchcover.cli.agree import agree
from torchcover.cli.asking import asked
from torchcover.cli.record import record
from torchcover.cli.running import checkpoint_in, finish, logged, opened, sharing, watching
from torchcover.cli.search import search
from torchcover.cli.study import study
from torchcover.cli.targets import targets
from torchcover.evaluation.interrupt import terminable
from torchcover.files import written_since

app = typer.Typer(
    name="torchcover",
    help="Blind spots and coverage of a vehicle's sensor rig, measured against a random reference sensor.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

# Exit codes; those of signals are 128 and their number.
MISTAKE, INTERRUPTED = 2, 130
ENDED_BY = {"SIGINT": "interrupted", "SIGTERM": "terminated", "SIGHUP": "hung up"}

# What is raised for any mistake in options and arguments. Typer names only descendants of it.
USAGE_ERROR: type[Exception] = typer.BadParameter.__bases__[0]

# Of what a mistake is told in: whoever gave a name of thousands does not want it back.
MAX_LINE_CHARS = 2000


def main() -> None:
    """Run the command line; a user's mistake ends in one line on stderr and exit code 2, a warning is one line too."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # where there is no ±, a result with ? is better than none
    try:
        with warnings.catch_warnings(), terminable(_on_signals()) as signals:
            warnings.showwarning = _warn
            warnings.filterwarnings("ignore", "The run was cut short", RuntimeWarning)  # the last line says it
            code = typer.main.get_command(app).main(standalone_mode=False)
        sys.stdout.flush()
    except Exception as error:
        message = _mistake(error)
        if message is None:
            raise
        _fail(message)
    if code == INTERRUPTED:  # what typer makes of KeyboardInterrupt
        first = signals[0] if signals else signal.SIGINT
        _fail(ENDED_BY[signal.Signals(first).name], 128 + first)
    sys.exit(code if isinstance(code, int) else 0)


def _on_signals() -> Callable[[Sequence[int]], None]:
    """What to do at once when a signal comes: with a terminal that is gone, and when Ctrl-C comes again."""
    start_s, terminals = time.time(), [stream for stream in (1, 2) if os.isatty(stream)]

    def told(arrived: Sequence[int]) -> None:
        name = signal.Signals(arrived[-1]).name
        if name == "SIGHUP":
            nowhere = os.open(os.devnull, os.O_WRONLY)
            for stream in terminals:  # or an error in writing would be the end
                os.dup2(nowhere, stream)
        if name == "SIGINT" and len(arrived) > 1:
            files = written_since(start_s)
            kept = f"kept is {', '.join(map(str, files))}" if files else "nothing of this run is kept"
            cursor = "\x1b[?25h" * (2 in terminals)  # a bar hides it
            os.write(2, f"{cursor}\ntorchcover: ended at once: {kept}\n".encode())
            os._exit(INTERRUPTED)

    return told


def _mistake(error: Exception) -> str | None:
    """What a user did wrong, or lacks; None if it is a mistake of ours."""
    if isinstance(error, USAGE_ERROR):
        return str(error.format_message())  # type: ignore[attr-defined]  # the typed name is private
    if isinstance(error, ValueError | TypeError | OSError):
        return str(error)
    if isinstance(error, ImportError) and "pip install" in str(error):
        return str(error)  # of an extra
    if isinstance(error, MemoryError):
        return f"there is not enough memory ({error or 'for what was asked'}); ask for less, or use a larger machine"
    if type(error).__name__ == "OutOfMemoryError":  # of torch, which most mistakes are told without
        return f"there is not enough memory ({str(error).splitlines()[0]}); ask for less, or use --device cpu"
    if isinstance(error, OverflowError | RecursionError):
        return f"a number is too large, or a file nested too deeply ({error})"
    return None


@app.callback(invoke_without_command=True)
def version(show: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False) -> None:
    """Blind spots and coverage of a vehicle's sensor rig, measured against a random reference sensor."""
    if show:
        from torchcover import __version__

        typer.echo(__version__)
        raise typer.Exit


@app.command()
def evaluate(
    rig: options.RigOrNone = None,
    scenario: options.ScenarioOrNone = None,
    frames: options.Frames = None,
    recording_format: options.Format = None,
    sensors: options.Sensors = None,
    window: options.Window = None,
    steps: options.Steps = None,
    seed: options.Seed = 0,
    vehicle: options.Vehicle = None,
    out: options.Out = Path("out"),
    region: options.Regions = None,
    height: options.Heights = None,
    grid: options.Grid = None,
    ask: options.Ask = None,
    cell: options.Cell = None,
    threshold: options.Thresholds = None,
    reference: options.Reference = None,
    rays: options.Rays = None,
    estimate: options.Estimate = None,
    every: options.Every = None,
    target_error: options.TargetErrors = None,
    redundancy: options.Redundancy = False,
    metrics: options.Metrics = None,
    error_maps: options.ErrorMaps = False,
    rerun: options.Rerun = None,
    explain: options.Explain = False,
    device: options.Device = "cpu",
    workers: options.Workers = 0,
    skip_bad_frames: options.SkipBadFrames = False,
    resume: options.Resume = False,
) -> None:
    """Measure the coverage of a rig: a table, maps, and files to compare and to log."""
    from torchcover.evaluation import evaluate

    with sharing(out) as ranks:
        log = logged(rerun, ranks)
        result = evaluate(
            rig,
            scenario,
            frames=opened(frames, recording_format, sensors, reference, window),
            steps=steps,
            seed=seed,
            vehicle=vehicle,
            ask=asked(ask, region, height, grid),
            cell_m=cell,
            thresholds=threshold or (0.4,),
            reference_sensor=None if frames else reference,
            rays=rays,
            estimate=estimate,
            every_s=every,
            target_error=target_error,
            redundancy=redundancy,
            metrics=metrics or (),
            device=device,
            workers=workers,
            skip_bad_frames=skip_bad_frames,
            checkpoint=checkpoint_in(out, resume=resume),
            ranks=ranks,
            observers=watching(log),
            progress=True,
        )
        finish(result, out, ranks, log, error_maps=error_maps, explain=explain)


@app.command()
def compare(
    rigs: options.Rigs = None,
    scenario: options.ScenarioOrNone = None,
    frames: options.Frames = None,
    recording_format: options.Format = None,
    sensors: options.Sensors = None,
    window: options.Window = None,
    steps: options.Steps = None,
    seed: options.Seed = 0,
    vehicle: options.Vehicle = None,
    out: options.Out = Path("out"),
    region: options.Regions = None,
    height: options.Heights = None,
    grid: options.Grid = None,
    ask: options.Ask = None,
    cell: options.Cell = None,
    threshold: options.Thresholds = None,
    reference: options.Reference = None,
    rays: options.Rays = None,
    estimate: options.Estimate = None,
    every: options.Every = None,
    target_error: options.TargetErrors = None,
    redundancy: options.Redundancy = False,
    metrics: options.Metrics = None,
    error_maps: options.ErrorMaps = False,
    rerun: options.Rerun = None,
    explain: options.Explain = False,
    device: options.Device = "cpu",
    workers: options.Workers = 0,
    skip_bad_frames: options.SkipBadFrames = False,
    resume: options.Resume = False,
) -> None:
    """Compare rigs in the same frames: a table with the better values marked, maps side by side, differences."""
    from torchcover.evaluation import compare

    with sharing(out) as ranks:
        log = logged(rerun, ranks)
        result = compare(
            rigs or (),
            scenario,
            frames=opened(frames, recording_format, sensors, reference, window),
            steps=steps,
            seed=seed,
            vehicle=vehicle,
            ask=asked(ask, region, height, grid),
            cell_m=cell,
            thresholds=threshold or (0.4,),
            reference_sensor=None if frames else reference,
            rays=rays,
            estimate=estimate,
            every_s=every,
            target_error=target_error,
            redundancy=redundancy,
            metrics=metrics or (),
            device=device,
            workers=workers,
            skip_bad_frames=skip_bad_frames,
            checkpoint=checkpoint_in(out, resume=resume),
            ranks=ranks,
            observers=watching(log),
            progress=True,
        )
        finish(result, out, ranks, log, error_maps=error_maps, explain=explain)


app.command()(study)
app.command()(record)


@app.command()
def rig(
    frames: options.RecordingFrames,
    recording_format: options.Format = None,
    sensors: options.SensorsOfRig = None,
    lidar: Annotated[
        list[str] | None,
        typer.Option(help="SENSOR=MODEL: a LiDAR scans as this model (see `list`), and is not estimated."),
    ] = None,
) -> None:
    """Print the sensors of a recording as a rig: mounts, LiDARs and cameras for `show` and `evaluate`."""
    from torchcover.cli.rig import run

    run(frames, recording_format, sensors or (), lidar or ())


@app.command()
def show(
    name: Annotated[str, typer.Argument(help="Rig, scenario or vehicle: a built-in name (see `list`) or a YAML file.")],
    scenario: Annotated[
        str | None, typer.Option(help="For a rig: the scenario whose ego carries it and that it sees (courtyard).")
    ] = None,
    rig: Annotated[str | None, typer.Option(help="For a scenario: whose points to draw (front_roof_128).")] = None,
    vehicle: options.Vehicle = None,
    step: Annotated[int | None, typer.Option(min=0, help="Time step of the scenario or the depth images (0).")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the simulation, likewise (0).")] = None,
    film: Annotated[
        Path | None, typer.Option(help="For a scenario: 10 s of it from that step on, as a .gif or .mp4 (ffmpeg) file.")
    ] = None,
    out: options.Out = Path("out"),
) -> None:
    """Draw a rig and the depth images of its cameras, a frame of a scenario, or the mount regions of a vehicle."""
    from torchcover.cli.show import run

    run(name, scenario=scenario, rig=rig, vehicle=vehicle, step=step, seed=seed, film=film, out=out)


app.command()(targets)
app.command()(search)
app.command()(agree)


@app.command("list")
def list_builtin(
    word: Annotated[
        str | None, typer.Argument(help="Only those with this word, with all that is said of them.")
    ] = None,
) -> None:
    """List the built-in rigs, scenarios, LiDAR models and vehicles."""
    from torchcover.cli.listing import run

    run(word)


def _warn(message: Warning | str, *_: Any, **__: Any) -> None:  # noqa: ANN401  (where in our code: of no use to a user)
    typer.echo(f"torchcover: warning: {' '.join(str(message).split())}", err=True)


def _fail(message: str, code: int = MISTAKE) -> None:
    line = " ".join(message.split())
    if line:  # none where no command was given: the help has been printed
        typer.echo(f"torchcover: {line if len(line) <= MAX_LINE_CHARS else line[:MAX_LINE_CHARS] + ' ...'}", err=True)
    sys.exit(code)
