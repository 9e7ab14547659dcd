"""The door of the readers: what is refused unread, the memory a file may take, and the one error that leaves it."""

import os
import stat
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import wraps
from pathlib import Path
from typing import Concatenate, ParamSpec, TypeVar

import numpy as np

from torchcover.files.atomic import check_listed

Arguments = ParamSpec("Arguments")
Content = TypeVar("Content")
Reader = Callable[Concatenate[Path, Arguments], Content]
Door = Callable[Concatenate[str | os.PathLike[str], Arguments], Content]

common_link_roots: list[Path] = []  # folders that links in any recording may lead to
_link_roots: dict[Path, list[Path]] = {}  # folders that links in each recording may lead to

MAX_REASON_CHARS = 500  # libraries may quote the whole file
VARIABLE = "TORCHCOVER_MAX_FILE_GB"
# A scan takes megabytes; a saved result with eight thresholds in the command line's grid, which is much, twice a
# thousand of them.
DEFAULT_GB = 2.0
LIBRARIES_GB = 1.0
# A calibration has kilobytes; what is parsed slowly must not be long.
MAX_SHORT_BYTES = 1_000_000


class BadFileError(ValueError):
    """A file is not what it is meant to be; the message names it, what arrived and what is needed.

    Example:
        >>> isinstance(BadFileError("scan.pcd: an empty file (0 bytes)"), ValueError)
        True
    """


def reads(content: str) -> Callable[[Reader[Arguments, Content]], Door[Arguments, Content]]:
    """Make a function the door through which one kind of file is read.

    The function gets the path of a regular file that is not empty. It says what is wrong as a ValueError that does not
    name the file, and may let through whatever its libraries raise.

    Args:
        content: What the file is meant to be, for messages: "a depth image".

    Returns:
        A decorator. The function then raises

            FileNotFoundError: There is no such file.
            IsADirectoryError: A folder.
            ImportError: A package that the reader needs is missing.
            BadFileError: Anything else: a device or a FIFO (which would never end), an empty file, a file that may not
                be opened, one that needs more memory than `check_memory` allows, damaged content, a link out of a
                recording (see `allow_links`), a file of an incomplete result.

    Example:
        >>> import tempfile
        >>> read = reads("a number")(lambda path: float(path.read_text()))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "number.txt")
        ...     _ = path.write_text("7.5")
        ...     read(path)
        7.5
    """

    def decorate(read: Reader[Arguments, Content]) -> Door[Arguments, Content]:
        @wraps(read)
        def door(path: str | os.PathLike[str], *args: Arguments.args, **kwargs: Arguments.kwargs) -> Content:
            path = Path(path)
            # Numbers of damaged files overflow; what they become is infinite or NaN, and judged as such.
            with naming(path, content), np.errstate(all="ignore"):
                check_regular(path, content)
                check_listed(path)
                return read(path, *args, **kwargs)

        return door  # type: ignore[return-value]  # which would have the path without a name

    return decorate


@contextmanager
def naming(path: Path, content: str) -> Iterator[None]:
    """Turn whatever goes wrong into a `BadFileError` that names the file; a missing one, a folder and a package aside.

    `path`: the file, or the folder of several; `content`: what it is meant to be.
    """
    try:
        yield
    except (BadFileError, FileNotFoundError, IsADirectoryError, ImportError):
        raise
    except MemoryError as error:
        raise BadFileError(
            f"{path}: there is not enough memory to read {content} of this size: use a smaller one, or set the "
            f"environment variable {VARIABLE} above {said_gb(VARIABLE, DEFAULT_GB):g}"
        ) from error
    except Exception as error:
        reason = " ".join(str(error).split())[:MAX_REASON_CHARS] or type(error).__name__
        if not isinstance(error, ValueError) or isinstance(error, UnicodeError):
            reason = f"not readable as {content} ({type(error).__name__}: {reason}); is it damaged, or another format?"
        raise BadFileError(f"{path}: {reason}") from error


def allow_links(recording: Path, roots: Iterable[Path] = ()) -> None:
    """Refuse files of a recording from now on whose links lead out of it and of the roots."""
    _link_roots[recording.absolute()] = [place.resolve() for place in (recording, *common_link_roots, *roots)]


def find_link_roots(recording: Path) -> list[Path]:
    """Return the roots that `allow_links` was given for a recording."""
    return _link_roots.get(recording.absolute(), [])


def _check_links(path: Path) -> None:
    for recording, roots in _link_roots.items():
        target = path.resolve()
        if path.absolute().is_relative_to(recording) and not any(target.is_relative_to(root) for root in roots):
            raise ValueError(
                f"a link to {target}, outside of the recording; to read it: torchcover --allow-links FOLDER ..."
            )


def check_regular(path: Path, content: str) -> None:
    """Refuse what is no file, an empty one, or a link that leads out of a recording."""
    _check_links(path)
    status = path.stat() if path.exists() else None
    if status is None:
        raise FileNotFoundError(f"{path}: no such file; {content} is needed")
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(f"{path}: a folder; {content} is one file")
    if not stat.S_ISREG(status.st_mode):
        raise ValueError(f"a pipe, a socket or a device; {content} has to be a regular file")
    if status.st_size == 0:
        raise ValueError(f"an empty file (0 bytes); {content} is needed")


class TooLargeError(ValueError):
    """Reading a file takes more memory than one may take."""


def check_memory(needed_bytes: int) -> None:
    """Refuse to read a file that needs more memory than one may take, before any of it is reserved.

    `needed_bytes`: what reading it takes at its largest, the file's own bytes included where they are held.
    TooLargeError: more than 2 GB, or than the environment variable TORCHCOVER_MAX_FILE_GB says.

    Example:
        >>> check_memory(16 * 100_000)  # a scan
    """
    allowed_gb = said_gb(VARIABLE, DEFAULT_GB)
    if needed_bytes > allowed_gb * 1e9:
        needed_gb = f"{needed_bytes / 1e9:.3g}" if needed_bytes < 10**300 else "endless"
        raise TooLargeError(
            f"reading it takes {needed_gb} GB of memory, more than the {allowed_gb:g} GB that one file may take; "
            f"use a smaller one, or set the environment variable {VARIABLE}"
        )


def most_gb() -> float:
    """What a process of its own may take that reads a file: beside what a file may take, its libraries."""
    return said_gb(VARIABLE, DEFAULT_GB) + LIBRARIES_GB


def said_gb(variable: str, usual_gb: float) -> float:
    """Gigabytes that an environment variable says, or what is usual without it.

    ValueError: it is no number of at least 0.
    """
    given = os.environ.get(variable, usual_gb)
    with suppress(ValueError):
        if (limit_gb := float(given)) >= 0:
            return limit_gb
    raise ValueError(f"the environment variable {variable} has to be a number of gigabytes; got {given!r}")


def decode(data: bytes) -> str:
    """Decode UTF-8, with or without a byte order mark. ValueError: not UTF-8."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"not text in UTF-8: byte {error.start} is 0x{data[error.start]:02x}") from error


def read_short_text(path: Path) -> str:
    """Text of a file that people write, or could have written. ValueError: more than a megabyte, or not UTF-8."""
    size_bytes = path.stat().st_size
    if size_bytes > MAX_SHORT_BYTES:
        raise ValueError(f"{size_bytes} bytes; at most {MAX_SHORT_BYTES} are read of such a file")
    return decode(path.read_bytes())
