"""The command line as a program: its commands, and how they end."""

import gc
import io
import os
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Any, TextIO

import typer

from torchcover.cli import commands
from torchcover.cli.evaluate import compare, evaluate
from torchcover.evaluation.cpu_cores import set_threads
from torchcover.evaluation.progress import handle_termination


class ExitCode(IntEnum):
    """Exit codes of every command; a signal ends a command with 128 + its number."""

    SUCCESS = 0
    REQUIREMENT_NOT_MET = 1
    USER_ERROR = 2
    INTERNAL_ERROR = 70  # EX_SOFTWARE of sysexits.h
    BROKEN_PIPE = 128 + 13  # SIGPIPE, as of programs that this signal ends


EXIT_CODE_HELP = (
    "Exit codes: 0 success, or all requirements met; 1 a requirement is not met (`check`); 2 user error; "
    "70 internal error; 141 the reader of the output is gone; 128 + n ended by signal n."
)

app = typer.Typer(
    name="torchcover",
    help="Blind spots and coverage of a vehicle's sensor rig, measured against a random reference sensor.",
    epilog=EXIT_CODE_HELP,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

ENDED_BY = {"SIGINT": "interrupted", "SIGTERM": "terminated", "SIGHUP": "hung up"}

# What is raised for any mistake in options and arguments. Typer names only descendants of it.
USAGE_ERROR: type[Exception] = typer.BadParameter.__bases__[0]

# A run holds hardly anything in circles: looking for these as often as Python does takes a fortieth of it.
OBJECTS_BETWEEN_LOOKS = 100_000

# Of what a mistake is told in: whoever gave a name of thousands does not want it back.
MAX_LINE_CHARS = 2000


def main() -> None:
    """Run the command line and end with an `ExitCode`; a user error or a warning is one line on stderr."""
    open_closed_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # where there is no –, a result with ? is better than none
    set_threads()
    gc.set_threshold(OBJECTS_BETWEEN_LOOKS)
    signals: Sequence[int] = ()
    try:
        with warnings.catch_warnings(), handle_termination(_on_signals()) as signals:
            warnings.showwarning = _warn
            warnings.filterwarnings("ignore", "The run was cut short", RuntimeWarning)  # the last line says it
            code = run_command(sys.argv[1:])
            sys.stdout.flush()
    except (Exception, KeyboardInterrupt) as error:
        code, message = resolve_exit_code(error, signals)
        if code == ExitCode.INTERNAL_ERROR:
            traceback.print_exc()
        print_error(message)
    for stream in (sys.stdout, sys.stderr):
        flush_or_discard(stream)
    sys.exit(code)


def run_command(arguments: Sequence[str]) -> int:
    """Run the command of a command line; typer's own `main` would end a broken pipe with the code of a verdict.

    Returns:
        The exit code that the command asks for.
    """
    command = typer.main.get_command(app)
    try:
        with command.make_context("torchcover", list(arguments)) as context:
            command.invoke(context)
    except typer.Exit as end:
        return int(end.exit_code)
    return ExitCode.SUCCESS


def resolve_exit_code(error: BaseException, signals: Sequence[int] = ()) -> tuple[int, str]:
    """Decide how the program ends after an error.

    Args:
        error: The exception that ended the command.
        signals: Numbers of the signals that arrived.

    Returns:
        The exit code, and the line for stderr; empty if there is nothing to say.
    """
    if isinstance(error, KeyboardInterrupt):
        first = signals[0] if signals else signal.SIGINT
        return 128 + first, ENDED_BY[signal.Signals(first).name]
    if isinstance(error, BrokenPipeError):
        return ExitCode.BROKEN_PIPE, ""
    message = _mistake(error)
    if message is not None:
        return ExitCode.USER_ERROR, message
    return ExitCode.INTERNAL_ERROR, f"internal error ({type(error).__name__}: {error}); please report the lines above"


def open_closed_streams() -> None:
    """Connect closed standard streams to the null device; a file that is opened later would take their place."""
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        try:
            os.fstat(number)
        except OSError:
            null = os.open(os.devnull, os.O_RDWR)
            if null != number:
                os.dup2(null, number)
                os.close(null)
            os.set_inheritable(number, True)
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115  (for the whole process)


def flush_or_discard(stream: TextIO) -> None:
    """Write what a stream holds, or drop it if nobody can take it: Python would fail with code 120 at exit."""
    try:
        stream.flush()
    except OSError:
        with suppress(OSError), open(os.devnull, "wb") as null:
            os.dup2(null.fileno(), stream.fileno())


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
            from torchcover.files import list_written  # which nobody needs who asks for help

            files = list_written(start_s)
            kept = f"kept is {', '.join(map(str, files))}" if files else "nothing of this run is kept"
            cursor = "\x1b[?25h" * (2 in terminals)  # a bar hides it
            os.write(2, f"{cursor}\ntorchcover: ended at once: {kept}\n".encode())
            os._exit(128 + signal.SIGINT)

    return told


def _mistake(error: BaseException) -> str | None:
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
def handle_global_options(
    show_version: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False,
    allow_links: Annotated[
        list[Path] | None,
        typer.Option("--allow-links", help="Folder that links in a recording may lead to; may be repeated."),
    ] = None,
) -> None:
    """Blind spots and coverage of a vehicle's sensor rig, measured against a random reference sensor."""
    if allow_links:
        from torchcover.files import common_link_roots  # with NumPy, which help does not need

        common_link_roots[:] = allow_links
    if show_version:
        from torchcover import __version__

        typer.echo(__version__)
        raise typer.Exit


for command in (commands.report, evaluate, compare, commands.study, commands.config, commands.record, commands.rig,
                commands.robot, commands.calibrate, commands.world, commands.show, commands.targets, commands.check,
                commands.encounter, commands.search):  # fmt: skip
    app.command(epilog=EXIT_CODE_HELP)(command)
app.command("list", epilog=EXIT_CODE_HELP)(commands.list_builtin)


def _warn(message: Warning | str, *_: Any, **__: Any) -> None:  # noqa: ANN401  (where in our code: of no use to a user)
    typer.echo(f"torchcover: warning: {_one_line(str(message))}", err=True)


def print_error(message: str) -> None:
    """Print one line on stderr: none where no command was given, for which the help was printed."""
    line = _one_line(message)
    if line:
        with suppress(OSError):  # a terminal that is gone
            typer.echo(
                f"torchcover: {line if len(line) <= MAX_LINE_CHARS else line[:MAX_LINE_CHARS] + ' ...'}", err=True
            )


def _one_line(words: str) -> str:
    from torchcover.files import escape_control_chars  # with NumPy, which nobody needs who asks for help

    return escape_control_chars(" ".join(words.split()))
