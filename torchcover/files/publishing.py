"""Files and folders that are whole whenever they are looked at, after a kill or a loss of power too.

What is written lies aside until all of it is on the disk. Of a file, one rename puts it in its place. Of a folder of
several, one rename says that they are its new content; whoever looks next moves them to their places if the process
that wrote them could not.
"""

import errno
import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path, PurePosixPath
from shutil import copyfileobj, rmtree
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, Self
from uuid import uuid4

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Lists the files of a folder. Put in its place last, and taken away first: without it a folder is not complete.
SUMMARY = "summary.json"
LOCK = ".lock"
# What a file or a folder begins with that is not complete yet.
PARTIAL = ".partial_"
# Where files are that are the new content of their folder, and not yet in their places; and the summary before theirs.
WHOLE = ".whole"
BEFORE = ".before.json"

# Folders that this process has claimed.
_claims: list[Path] = []


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
    aside = path.with_name(f"{PARTIAL}{path.name}")
    try:
        with _naming(path):
            with aside.open("wb") as file:
                write(file)
                file.flush()
                os.fsync(file.fileno())
            os.replace(aside, path)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Keep other processes from writing to a folder; a process that dies lets go of it.

    What an earlier process had completed, and could not put in its place, is put there first.

    Args:
        folder: Made if it does not exist, and taken away again if nothing is written to it.

    Raises:
        ValueError: Another process has claimed it.
        OSError: It cannot be written to.
    """
    from filelock import FileLock, Timeout  # takes longer to import than all else that readers need

    made = [place for place in (folder, *folder.parents) if not place.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK, timeout=0, is_singleton=True)  # one for the whole process: it may claim it twice
    try:
        with lock:
            _claims.append(folder)
            try:
                if lock.lock_counter == 1:
                    _finish(folder)
                yield
            finally:
                _claims.remove(folder)
                if lock.lock_counter == 1:
                    (folder / LOCK).unlink(missing_ok=True)
    except Timeout as error:
        raise ValueError(
            f"{folder}: another run is writing there; wait for its end, or choose another folder"
        ) from error
    finally:
        with suppress(OSError):
            for place in made:
                place.rmdir()


def written_since(start_s: float) -> list[Path]:
    """Files in the folders that this process has claimed, written since a time; none that lies aside.

    Args:
        start_s: As `time.time` gives it.
    """
    return [
        folder / path.name
        for folder in dict.fromkeys(_claims)
        for place in (folder, folder / WHOLE)
        for path in sorted(place.glob("[!.]*"))
        if path.is_file() and path.stat().st_mtime >= start_s
    ]


class Publication:
    """Makes files the content of a folder, all at once. A context manager, which claims the folder.

    Until `publish`, what an earlier one has published stays as it is; from then on it is gone, as its `summary.json`
    lists it. Other files stay. There is no moment in which a kill leaves neither; see `settled`, too.

    Args:
        folder: Where to write; made if it does not exist.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, Publication(Path(folder, "out")) as files:
        ...     files.add("a.txt", lambda path: path.write_text("a"))
        ...     files.publish({"complete": True})
        ...     [path.name for path in files.paths]
        ['a.txt', 'summary.json']
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.paths: list[Path] = []
        self._names: dict[str, None] = {}

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            stack.enter_context(claimed(self.folder))
            for left in self.folder.glob(f"{PARTIAL}*"):  # by a process that was killed
                rmtree(left, ignore_errors=True) if left.is_dir() else left.unlink()
            # In the folder itself, which may be of another file system than what it lies in.
            self._aside = self.folder / f"{PARTIAL}{uuid4().hex}"
            self._until_exit = stack.pop_all()
        return self

    def add(self, name: str, write: Callable[[Path], object]) -> None:
        """Write a file aside.

        Args:
            name: Its path within the folder, which may have one folder in it.
            write: Writes it to the path that it is given.

        Raises:
            OSError: It cannot be written, for want of room for example.
        """
        path = self._aside / name
        with _naming(self.folder / name):
            path.parent.mkdir(parents=True, exist_ok=True)
            write(path)
            with path.open("r+b") as file:
                os.fsync(file.fileno())
        self._names[name] = None

    def add_text(self, name: str, text: str) -> None:
        """Write a text aside."""
        self.add(name, lambda path: path.write_text(text, encoding="utf-8"))

    def add_figure(self, name: str, figure: "Figure") -> None:
        """Draw a figure aside."""
        self.add(name, lambda path: figure.savefig(path, dpi=figure.dpi))

    def publish(self, record: Mapping[str, Any]) -> None:
        """Make what was added content of the folder, in `summary.json` the record and the names of all its files.

        More may be added, and published, after it.
        """
        names = [name for name in self._names if name != SUMMARY]
        text = json.dumps({**record, "files": names}, indent=2, allow_nan=False) + "\n"
        self.add_text(SUMMARY, text)
        for place in {path.parent for path in self._aside.rglob("*")}:
            _sync_folder(place)
        os.rename(self._aside, self.folder / WHOLE)  # from here on nothing is lost
        _sync_folder(self.folder)
        _finish(self.folder)
        self.paths = [self.folder / name for name in (*names, SUMMARY)]

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        with self._until_exit:
            rmtree(self._aside, ignore_errors=True)
            _finish(self.folder)  # if Ctrl-C has come in between


def settled(path: Path) -> Path:
    """Where to read a file that may be one of a `Publication`: in its place, once all of them are in theirs.

    Args:
        path: The file.

    Returns:
        The same, but of a folder that cannot be written to, or that another process is writing to, where it lies now.

    Raises:
        FileNotFoundError: It was one of the publication before.
    """
    for folder in path.absolute().parents[:2]:
        if not (listed := _waiting(folder)):
            continue
        with suppress(OSError, ValueError), claimed(folder):
            return path
        name = path.absolute().relative_to(folder).as_posix()
        if name in _outdated(folder, listed):
            raise FileNotFoundError(f"{path}: no such file; it was part of an earlier result")
        if (folder / WHOLE / name).is_file():
            return folder / WHOLE / name
    return path


def _finish(folder: Path) -> None:
    """Put in their places the files that are the new content of a folder; done again, it does what is left to do."""
    whole = folder / WHOLE
    if listed := _waiting(folder):
        names = [path.relative_to(whole).as_posix() for path in whole.rglob("*") if path.is_file()]
        names = [name for name in names if name not in (SUMMARY, BEFORE)]
        earlier, outdated = _listed(folder / SUMMARY), _outdated(folder, listed)
        if not earlier or outdated or not earlier.isdisjoint(names):  # else what it says holds until it is replaced
            with suppress(FileNotFoundError):
                os.replace(folder / SUMMARY, whole / BEFORE)
        for name in names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            _move(whole / name, folder / name)
        for name in outdated:
            (folder / name).unlink(missing_ok=True)
        for place in {(folder / name).parent for name in names}:
            _sync_folder(place)
        os.replace(whole / SUMMARY, folder / SUMMARY)
        _sync_folder(folder)
    rmtree(whole, ignore_errors=True)


def _waiting(folder: Path) -> set[str]:
    """What a publication lists that is to be finished; nothing where somebody has taken away some of it."""
    whole = folder / WHOLE
    listed = _listed(whole / SUMMARY)
    return listed if all((whole / name).is_file() or (folder / name).is_file() for name in listed) else set()


def _move(source: Path, target: Path) -> None:
    try:
        os.replace(source, target)
    except OSError as error:
        if error.errno != errno.EXDEV:  # what a folder in the folder leads to may be of another file system
            raise
        with source.open("rb") as file:
            write_durably(target, partial(copyfileobj, file))
        source.unlink()


def _outdated(folder: Path, listed: set[str]) -> set[str]:
    """Files of an earlier publication that are not among those of the one which is to be finished."""
    earlier = _listed(folder / SUMMARY) | _listed(folder / WHOLE / BEFORE)
    return {name for name in earlier - listed if (folder / name).is_file()}


def _listed(summary: Path) -> set[str]:
    """The files that a summary lists; none where there is no such list. Nothing outside of the folder is in it."""
    try:
        names = json.loads(summary.read_text(encoding="utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError):
        return set()
    paths = [PurePosixPath(name) for name in names if isinstance(name, str)] if isinstance(names, list) else []
    return {str(path) for path in paths if not path.is_absolute() and ".." not in path.parts and path.name != SUMMARY}


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Have errors name the file: a full disk names none, others the one aside."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise OSError(f"{path}: {error}") from error
        raise OSError(error.errno, error.strerror, str(path)) from error


def _sync_folder(folder: Path) -> None:
    with suppress(OSError):  # not every system knows how to do this to a folder
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)
