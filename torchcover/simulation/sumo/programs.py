"""SUMO's programs, run as processes: where they are, and what they say when they fail."""

import os
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from shutil import which
from tempfile import TemporaryFile

from torchcover.files import end_with_parent

PIECE_BYTES = 1 << 18
MAX_TOLD_CHARS = 500
# They would look for schemas on the network.
ALWAYS = ("--xml-validation", "never")


def run(program: str, *options: str | Path) -> None:
    """Run a program to its end.

    Args:
        program: "netgenerate", "netconvert" or "sumo".
        options: Its options.

    Raises:
        ImportError: SUMO is not installed.
        ValueError: It fails; with its own message.
    """
    for _ in output_of(program, *options):
        pass


def output_of(program: str, *options: str | Path) -> Iterator[bytes]:
    """What a program writes to its standard output, piece by piece; whoever stops asking ends the program.

    Raises:
        ImportError: SUMO is not installed.
        ValueError: It fails; with its own message.
    """
    home = _home()
    command = [str(home / "bin" / program), *ALWAYS, *map(str, options)]
    with TemporaryFile() as said:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=said,
            env=_environment(home),
            preexec_fn=end_with_parent(),  # noqa: PLW1509  (one call of the system, no lock)
        )
        assert process.stdout is not None  # as asked for
        try:
            with closing(process.stdout):
                while piece := process.stdout.read(PIECE_BYTES):
                    yield piece
            failed = process.wait() != 0
        finally:
            process.kill()
            process.wait()
        if failed:
            said.seek(0)
            raise ValueError(f"SUMO's {program} fails: {_errors(said.read().decode('utf-8', 'replace').splitlines())}")


def _errors(lines: Sequence[str]) -> str:
    """What follows "Error:", in one line; a line that is indented goes on with the one before."""
    told: list[str] = []
    goes_on = False
    for line in lines:
        goes_on = line.startswith("Error:") or (goes_on and line.startswith(" "))
        if goes_on:
            told.append(line.removeprefix("Error:").strip())
    return " ".join(told or lines[-1:] or ["it says nothing"])[:MAX_TOLD_CHARS]


def _home() -> Path:
    """The folder of the installed package, else of the programs that the shell finds."""
    found = find_spec("sumo")
    if found is not None and found.origin is not None:
        return Path(found.origin).parent
    program = which("sumo")
    if program is None:
        raise ImportError("traffic of type 'sumo' needs SUMO: pip install 'torchcover[sumo]'")
    return Path(program).resolve().parent.parent


def _environment(home: Path) -> dict[str, str]:
    return {**os.environ, "SUMO_HOME": str(home)}
