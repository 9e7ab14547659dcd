"""Files that are whole whenever they are looked at, after a loss of power too."""

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO

# What a file that is not complete yet begins with.
ASIDE = ".partial_"


def write_durably(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Write a file aside, see it onto the disk, and put it in the place of the one that is there.

    Whatever happens meanwhile, `path` is what it was before, or all of what it is to be. A process that is killed
    leaves the file aside, which the next one writes over.

    Args:
        path: The file; no other process may be writing it.
        write: Writes its content.

    Raises:
        OSError: It cannot be written, for want of room for example; the file aside is taken away.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_durably(Path(folder, "a.txt"), lambda file: file.write(b"all of it"))
        ...     Path(folder, "a.txt").read_text()
        'all of it'
    """
    aside = path.with_name(f"{ASIDE}{path.name}")
    try:
        with aside.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(aside, path)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise
    with suppress(OSError):  # not every system knows how to do this to a folder
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
