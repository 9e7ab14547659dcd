"""Guards of readers: checks before a file is opened, memory limits, and a single error type."""

import os
import stat
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import wraps
from pathlib import Path
from typing import Concatenate, ParamSpec, TypeVar

import numpy as np

from torchcover.files.atomic import check_manifest_entry

Arguments = ParamSpec("Arguments")
Content = TypeVar("Content")
Reader = Callable[Concatenate[Path, Arguments], Content]
GuardedReader = Callable[Concatenate[str | os.PathLike[str], Arguments], Content]

common_link_roots: list[Path] = []  # folders that links in any recording may lead to
_link_roots: dict[Path, list[Path]] = {}  # folders that links in each recording may lead to

MAX_REASON_CHARS = 500  # libraries may quote the whole file
VARIABLE = "TORCHCOVER_MAX_FILE_GB"  # environment variable for the memory limit of a file
# A scan takes megabytes; a large saved result, with eight thresholds in the default grid, 2 GB.
DEFAULT_GB = 2.0
LIBRARIES_GB = 1.0  # memory of the libraries of an isolated reader
MAX_SHORT_BYTES = 1_000_000  # calibrations have kilobytes; parsers of text are slow


class BadFileError(ValueError):
    """Error of a file with other content than expected; the message has the path, the finding and the expectation.

    Example:
        >>> isinstance(BadFileError("scan.pcd: an empty file (0 bytes)"), ValueError)
        True
    """


def guard_reader(content: str) -> Callable[[Reader[Arguments, Content]], GuardedReader[Arguments, Content]]:
    """Create a decorator that guards a reader of one kind of file.

    The reader gets the path of a regular file that is not empty. It raises a ValueError without the path for unsuitable
    content, and may raise any error of its libraries.

    Args:
        content: Expected content, for messages: "a depth image".

    Returns:
        Decorator. The guarded reader raises

            FileNotFoundError: The file does not exist.
            IsADirectoryError: The path is a folder.
            ImportError: A package that the reader needs is not installed.
            BadFileError: In all other cases: a device or a FIFO (which may never end), an empty file, missing
                permissions, a file that needs more memory than `check_memory` allows, damaged content, a link out of a
                recording (see `allow_links`), a file of an incomplete result.

    Example:
        >>> import tempfile
        >>> read = guard_reader("a number")(lambda path: float(path.read_text()))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "number.txt")
        ...     _ = path.write_text("7.5")
        ...     read(path)
        7.5
    """

    def decorate(read: Reader[Arguments, Content]) -> GuardedReader[Arguments, Content]:
        @wraps(read)
        def read_guarded(path: str | os.PathLike[str], *args: Arguments.args, **kwargs: Arguments.kwargs) -> Content:
            path = Path(path)
            # Numbers of damaged files may overflow to infinity or NaN, which the readers check.
            with report_bad_file(path, content), np.errstate(all="ignore"):
                check_regular(path, content)
                check_manifest_entry(path)
                return read(path, *args, **kwargs)

        return read_guarded  # type: ignore[return-value]  # the type has the path as a positional parameter

    return decorate


@contextmanager
def report_bad_file(path: Path, content: str) -> Iterator[None]:
    """Convert errors to a `BadFileError` with the path, except errors of missing files, folders and packages.

    Args:
        path: File, or folder of several files.
        content: Expected content, for messages.
    """
    try:
        yield
    except (BadFileError, FileNotFoundError, IsADirectoryError, ImportError):
        raise
    except MemoryError as error:
        raise BadFileError(
            f"{path}: there is not enough memory to read {content} of this size: use a smaller one, or set the "
            f"environment variable {VARIABLE} above {read_limit_gb(VARIABLE, DEFAULT_GB):g}"
        ) from error
    except Exception as error:
        reason = " ".join(str(error).split())[:MAX_REASON_CHARS] or type(error).__name__
        if not isinstance(error, ValueError) or isinstance(error, UnicodeError):
            reason = f"not readable as {content} ({type(error).__name__}: {reason}); is it damaged, or another format?"
        raise BadFileError(f"{path}: {reason}") from error


def allow_links(recording: Path, roots: Iterable[Path] = ()) -> None:
    """Restrict links in a recording: files whose links lead out of it and of the roots are rejected from now on.

    Args:
        recording: Folder of the recording.
        roots: Further folders that links may lead to.
    """
    _link_roots[recording.absolute()] = [root.resolve() for root in (recording, *common_link_roots, *roots)]


def find_link_roots(recording: Path) -> list[Path]:
    """Return the folders that links in a recording may lead to.

    Args:
        recording: Folder as in `allow_links`; empty list for other folders.
    """
    return _link_roots.get(recording.absolute(), [])


def _check_links(path: Path) -> None:
    """Check that a link does not lead out of its recording."""
    for recording, roots in _link_roots.items():
        target = path.resolve()
        if path.absolute().is_relative_to(recording) and not any(target.is_relative_to(root) for root in roots):
            raise ValueError(
                f"a link to {target}, outside of the recording; to read it: torchcover --allow-links FOLDER ..."
            )


def check_regular(path: Path, content: str) -> None:
    """Check that a path is a regular file with content, and no link out of a recording.

    Args:
        path: Path.
        content: Expected content, for messages.

    Raises:
        FileNotFoundError: The file does not exist.
        IsADirectoryError: The path is a folder.
        ValueError: The path is a device, a pipe or a forbidden link, or the file is empty.
    """
    _check_links(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file; {content} is needed")
    status = path.stat()
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(f"{path}: a folder; {content} is one file")
    if not stat.S_ISREG(status.st_mode):
        raise ValueError(f"a pipe, a socket or a device; {content} has to be a regular file")
    if status.st_size == 0:
        raise ValueError(f"an empty file (0 bytes); {content} is needed")


class TooLargeError(ValueError):
    """Error of a file that needs more memory than the limit."""


def check_memory(needed_bytes: int) -> None:
    """Check that reading a file fits into the memory limit, before memory is allocated.

    Args:
        needed_bytes: Peak memory of reading, including the bytes of the file if they are held.

    Raises:
        TooLargeError: More than 2 GB, or than the environment variable TORCHCOVER_MAX_FILE_GB allows.

    Example:
        >>> check_memory(16 * 100_000)  # bytes of a scan
    """
    limit_gb = read_limit_gb(VARIABLE, DEFAULT_GB)
    if needed_bytes > limit_gb * 1e9:
        needed_gb = f"{needed_bytes / 1e9:.3g}" if needed_bytes < 10**300 else "endless"
        raise TooLargeError(
            f"reading it takes {needed_gb} GB of memory, more than the {limit_gb:g} GB that one file may take; "
            f"use a smaller one, or set the environment variable {VARIABLE}"
        )


def find_memory_limit_gb() -> float:
    """Return the memory limit of an isolated reader in gigabytes: the limit of a file plus the memory of libraries."""
    return read_limit_gb(VARIABLE, DEFAULT_GB) + LIBRARIES_GB


def read_limit_gb(variable: str, default_gb: float) -> float:
    """Read a limit in gigabytes from an environment variable.

    Args:
        variable: Name of the environment variable.
        default_gb: Limit without the variable.

    Raises:
        ValueError: The value is not a number of at least 0.
    """
    value = os.environ.get(variable, default_gb)
    with suppress(ValueError):
        limit_gb = float(value)
        if limit_gb >= 0:
            return limit_gb
    raise ValueError(f"the environment variable {variable} has to be a number of gigabytes; got {value!r}")


def decode_utf8(data: bytes) -> str:
    """Decode UTF-8, with or without a byte order mark.

    Args:
        data: Bytes of a file.

    Raises:
        ValueError: The bytes are not UTF-8.
    """
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"not text in UTF-8: byte {error.start} is 0x{data[error.start]:02x}") from error


def read_short_text(path: Path) -> str:
    """Read a text file of at most a megabyte, such as a calibration.

    Args:
        path: File.

    Raises:
        ValueError: The file is larger, or not UTF-8.
    """
    size_bytes = path.stat().st_size
    if size_bytes > MAX_SHORT_BYTES:
        raise ValueError(f"{size_bytes} bytes; at most {MAX_SHORT_BYTES} are read of such a file")
    return decode_utf8(path.read_bytes())
