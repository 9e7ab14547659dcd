"""The command line as a program: its commands, and how they end."""

import gc
import io
import os
import signal
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import typer

from torchcover.cli import commands
from torchcover.cli.evaluate import compare, evaluate
from torchcover.evaluation.cores import set_threads
from torchcover.evaluation.progress import terminable

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

# A run holds hardly anything in circles: looking for these as often as Python does takes a fortieth of it.
OBJECTS_BETWEEN_LOOKS = 100_000

# Of what a mistake is told in: whoever gave a name of thousands does not want it back.
MAX_LINE_CHARS = 2000


def main() -> None:
    """Run the command line; a user's mistake ends in one line on stderr and exit code 2, a warning is one line too."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # where there is no –, a result with ? is better than none
    set_threads()
    gc.set_threshold(OBJECTS_BETWEEN_LOOKS)
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
            from torchcover.files import written_since  # which nobody needs who asks for help

            files = written_since(start_s)
            kept = f"kept is {', '.join(map(str, files))}" if files else "nothing of this run is kept"
            cursor = "\x1b[?25h" * (2 in terminals)  # a bar hides it
            os.write(2, f"{cursor}\ntorchcover: ended at once: {kept}\n".encode())
            os._exit(INTERRUPTED)

    return told


def _mistake(error: Exception) -> str | None:
    """What a user did wrong, or lacks; None if it is a mistake of ours."""
    if isinstance(error, USAGE_ERROR):
        # The typed name is private; of a choice it tells the kind of the exception, too.
        return str(error.format_message()).replace("Value error, ", "")  # type: ignore[attr-defined]
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


for command in (commands.report, evaluate, compare, commands.study, commands.record, commands.rig, commands.robot,
                commands.calibrate, commands.world, commands.show, commands.targets, commands.check, commands.encounter,
                commands.search):  # fmt: skip
    app.command()(command)
app.command("list")(commands.list_builtin)


def _warn(message: Warning | str, *_: Any, **__: Any) -> None:  # noqa: ANN401  (where in our code: of no use to a user)
    typer.echo(f"torchcover: warning: {_one_line(str(message))}", err=True)


def _fail(message: str, code: int = MISTAKE) -> None:
    line = _one_line(message)
    if line:  # none where no command was given: the help has been printed
        typer.echo(f"torchcover: {line if len(line) <= MAX_LINE_CHARS else line[:MAX_LINE_CHARS] + ' ...'}", err=True)
    sys.exit(code)


def _one_line(words: str) -> str:
    from torchcover.files import shown  # with NumPy, which nobody needs who asks for help

    return shown(" ".join(words.split()))
