"""Program `torchcover`: its commands, signals and exit codes."""

import gc
import io
import os
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from contextlib import chdir, suppress
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Any, TextIO

import typer

from torchcover.cli import commands, recording_commands
from torchcover.cli.evaluate import compare, evaluate
from torchcover.evaluation.cpu_cores import set_threads
from torchcover.evaluation.progress import handle_termination


class ExitCode(IntEnum):
    """Exit codes of all commands; a signal ends a command with 128 + its number."""

    SUCCESS = 0
    REQUIREMENT_NOT_MET = 1
    USER_ERROR = 2
    INTERNAL_ERROR = 70  # EX_SOFTWARE of sysexits.h
    BROKEN_PIPE = 128 + 13  # like a program that SIGPIPE ends


EXIT_CODE_HELP = (
    "Exit codes: 0 success, or all requirements met; 1 a requirement is not met (`check`); 2 user error; "
    "70 internal error; 141 the reader of the output has closed it; 128 + n ended by signal n."
)

app = typer.Typer(
    name="torchcover",
    help="Coverage and blind spots of the sensor rig of a vehicle, relative to a reference sensor.",
    epilog=EXIT_CODE_HELP,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

# Base class of all errors in options and arguments, which typer does not export.
USAGE_ERROR: type[Exception] = typer.BadParameter.__bases__[0]


def main() -> None:
    """Run the command line and end with an `ExitCode`; a user error or a warning is one line on stderr."""
    open_closed_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # characters outside the encoding become question marks
    set_threads()
    # A run creates few reference cycles; searching them as often as by default takes 2.5 % of its time.
    gc.set_threshold(100_000)
    signals: Sequence[int] = ()
    try:
        with warnings.catch_warnings(), handle_termination(_make_signal_callback()) as signals:
            warnings.showwarning = _print_warning
            # The last line of the program reports the interruption.
            warnings.filterwarnings("ignore", "The run was cut short", RuntimeWarning)
            ignore_local_matplotlibrc()
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
    """Run one command; in contrast to `main` of typer, a broken pipe has an exit code of its own.

    Args:
        arguments: Arguments of the program.

    Returns:
        Exit code of the command.
    """
    command = typer.main.get_command(app)
    try:
        with command.make_context("torchcover", list(arguments)) as context:
            command.invoke(context)
    except typer.Exit as end:
        return int(end.exit_code)
    return ExitCode.SUCCESS


def resolve_exit_code(error: BaseException, signals: Sequence[int] = ()) -> tuple[int, str]:
    """Determine exit code and message after an error.

    Args:
        error: Exception that ended the command.
        signals: Numbers of the signals that arrived.

    Returns:
        The exit code, and the line for stderr, which may be empty.
    """
    if isinstance(error, KeyboardInterrupt):
        number = signal.Signals(signals[0] if signals else signal.SIGINT)
        descriptions = {"SIGINT": "interrupted", "SIGTERM": "terminated", "SIGHUP": "hung up"}
        return 128 + number, descriptions[number.name]
    if isinstance(error, BrokenPipeError):
        return ExitCode.BROKEN_PIPE, ""
    message = _explain_user_error(error)
    if message is not None:
        return ExitCode.USER_ERROR, message
    return ExitCode.INTERNAL_ERROR, f"internal error ({type(error).__name__}: {error}); please report the lines above"


def open_closed_streams() -> None:
    """Connect closed standard streams to the null device; otherwise files that are opened later take their numbers."""
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
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115  (open as long as the process)


def ignore_local_matplotlibrc() -> None:
    """Import matplotlib without the `matplotlibrc` of the working directory, which may name programs to start.

    The working directory may be a downloaded data set. The user's own settings and MATPLOTLIBRC apply.
    """
    file = Path("matplotlibrc")
    if os.path.lexists(file):
        warnings.warn(f"{file}: not read in the working directory; set MATPLOTLIBRC to use it", stacklevel=1)
        with chdir(Path(__file__).parent):
            import matplotlib  # noqa: F401  (reads its settings at import)


def flush_or_discard(stream: TextIO) -> None:
    """Flush a stream, or discard its buffer if it cannot be written; otherwise Python fails at exit with code 120."""
    try:
        stream.flush()
    except OSError:
        with suppress(OSError), open(os.devnull, "wb") as null:
            os.dup2(null.fileno(), stream.fileno())


def _make_signal_callback() -> Callable[[Sequence[int]], None]:
    """Make a function that reacts at once to a closed terminal and to a second Ctrl-C."""
    start_s = time.time()
    terminals = [stream for stream in (1, 2) if os.isatty(stream)]

    def handle_signal(arrived: Sequence[int]) -> None:
        """Redirect output after SIGHUP; stop at once after the second SIGINT."""
        name = signal.Signals(arrived[-1]).name
        if name == "SIGHUP":
            null = os.open(os.devnull, os.O_WRONLY)
            for stream in terminals:  # writing to a closed terminal would end the program
                os.dup2(null, stream)
        if name == "SIGINT" and len(arrived) > 1:
            from torchcover.files import list_written  # imports NumPy, which `--help` does not need

            files = ", ".join(str(path) for path in list_written(start_s))
            text = f"kept {files}" if files else "no file of this run is kept"
            show_cursor = "\x1b[?25h" if 2 in terminals else ""  # a progress bar hides the cursor
            os.write(2, f"{show_cursor}\ntorchcover: stopped immediately: {text}\n".encode())
            os._exit(128 + signal.SIGINT)

    return handle_signal


def _explain_user_error(error: BaseException) -> str | None:
    """Explain an error of the user or of his installation; None for an internal error."""
    if isinstance(error, USAGE_ERROR):
        return _explain_usage_error(error)
    if isinstance(error, ValueError | TypeError | OSError):
        return str(error)
    if isinstance(error, ImportError) and "pip install" in str(error):  # a missing extra
        return str(error)
    if isinstance(error, MemoryError):
        detail = f" ({error})" if str(error) else ""
        return f"not enough memory{detail}; reduce the size of the run, or use a larger machine"
    if type(error).__name__ == "OutOfMemoryError":  # of torch, which many errors occur without
        return f"not enough memory ({str(error).splitlines()[0]}); reduce the size of the run, or use --device cpu"
    if isinstance(error, OverflowError | RecursionError):
        return f"a number is too large, or a file is nested too deeply ({error})"
    return None


def _explain_usage_error(error: Exception) -> str:
    """Explain an error in options and arguments."""
    cause: Any = error.__cause__
    if not hasattr(cause, "errors"):
        return str(error.format_message())  # type: ignore[attr-defined]  # `str(error)` lacks the name of the option
    from torchcover.files import explain_validation_error

    # Typer validates values with pydantic, whose own messages name neither the option nor the value.
    return f"{error.param.opts[0]}: {explain_validation_error(cause)[0]}"  # type: ignore[attr-defined]


@app.callback(invoke_without_command=True)
def handle_global_options(
    show_version: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False,
    allow_links: Annotated[
        list[Path] | None,
        typer.Option("--allow-links", help="Folder to which links in a recording may lead; may be repeated."),
    ] = None,
) -> None:
    """Coverage and blind spots of the sensor rig of a vehicle, relative to a reference sensor."""
    if allow_links:
        from torchcover.files import common_link_roots  # imports NumPy, which `--help` does not need

        common_link_roots[:] = allow_links
    if show_version:
        from torchcover import __version__

        typer.echo(__version__)
        raise typer.Exit


for command in (commands.report, evaluate, compare, commands.study, commands.config, recording_commands.record,
                recording_commands.rig, recording_commands.robot, recording_commands.calibrate,
                recording_commands.world, commands.show, commands.targets, commands.check, commands.encounter,
                commands.search):  # fmt: skip
    app.command(epilog=EXIT_CODE_HELP if command is commands.check else None)(command)
app.command("list")(commands.list_builtin)


def _print_warning(message: Warning | str, *_: Any, **__: Any) -> None:  # noqa: ANN401  (the line of code)
    """Print a warning of the library as one line on stderr."""
    typer.echo(f"torchcover: warning: {_join_lines(str(message))}", err=True)


def print_error(message: str, max_chars: int = 2000) -> None:
    """Print one line on stderr; nothing for an empty message, as after `torchcover` without a command.

    Args:
        message: The message; line breaks become blanks.
        max_chars: Maximum length; the remainder becomes "...".
    """
    line = _join_lines(message)
    if len(line) > max_chars:
        line = f"{line[:max_chars]} ..."
    if line:
        with suppress(OSError):  # a closed terminal
            typer.echo(f"torchcover: {line}", err=True)


def _join_lines(text: str) -> str:
    """Join the lines of a text and escape control characters."""
    from torchcover.files import escape_control_chars  # imports NumPy, which `--help` does not need

    return escape_control_chars(" ".join(text.split()))
