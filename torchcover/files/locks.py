"""Locks of folders that are written to, and the refusal of links on the way there."""

import errno
import os
import stat
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from shutil import rmtree

from torchcover.files.manifests import SUMMARY, read_manifest

TEMPORARY = ".torchcover_"  # prefix of temporary directories

_locked: set[Path] = set()  # folders that this process has locked


def refuse_links(path: Path) -> None:
    """Raise a ValueError if a path is or leads through a symbolic link, except links in the root folder."""
    for place in (path, *path.parents):
        if place.is_symlink() and len(place.absolute().parts) > 2:
            raise ValueError(f"{place}: a symbolic link; nothing is written through links: name its target instead")


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Make a folder if needed, and keep other processes from writing to it until the block or the process ends.

    ValueError: another process has locked it; it, or a file that its manifest lists, is reached through a link.
    """
    import fcntl

    refuse_links(folder)
    for name in {name.partition("/")[0] for name in (read_manifest(folder / SUMMARY) or {"files": ()})["files"]}:
        if (folder / name).is_symlink():
            refuse_links(folder / name)
    if (key := folder.resolve()) in _locked:
        yield
        return
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK):
        raise PermissionError(errno.EACCES, "may not be written to", str(folder))
    lock = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(lock)
        raise ValueError(f"{folder}: another run is writing there; wait for its end, or choose another") from error
    except OSError as error:
        warnings.warn(f"{folder}: start no other run there, for it cannot be locked ({error.strerror})", stacklevel=3)
    try:
        for left in folder.glob(f"{TEMPORARY}*"):  # by a process that was killed
            if stat.S_ISDIR(left.lstat().st_mode):  # rmtree would open a FIFO
                rmtree(left, ignore_errors=True)
        _locked.add(key)
        yield
    finally:
        _locked.discard(key)
        with suppress(OSError):
            fcntl.flock(lock, fcntl.LOCK_UN)  # forked processes hold it, too
        os.close(lock)
        with suppress(OSError):
            for place in made:
                place.rmdir()


def list_written(start_s: float) -> list[Path]:
    """List what was written since a time (as `time.time`) in the folders that this process has locked."""
    visible = [path for folder in sorted(_locked) for path in sorted(folder.glob("[!.]*"))]
    return [path for path in visible if path.lstat().st_mtime >= start_s]
