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
from shutil import copyfile, rmtree
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self
from uuid import uuid4

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# List the files of a result, and of a recording. Put in their places last, and taken away first: without one of them a
# folder is not complete.
SUMMARY, RECORDING = MARKERS = "summary.json", "recording.json"
LOCK = ".lock"
# What a file or a folder begins with that is not complete yet.
PARTIAL = ".partial_"
# Where files are that are the new content of their folder, and not yet in their places; and the marker before theirs.
WHOLE = ".whole"
BEFORE = ".before.json"
# What is aside of a publication that may be gone on with, and how far it is.
PART = ".partial_to_go_on_with"
NOTES = ".notes.jsonl"
# Of pictures: with the usual 6, compressing one takes as long as drawing it, for a fifth less.
PNG_LEVEL = 3

# Folders that this process has claimed.
_claims: list[Path] = []


def write_durably(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file aside, see it onto the disk, and put it in the place of the one that is there.

    Whatever happens meanwhile, `path` is what it was before, or all of what it is to be. A process that is killed
    leaves the file aside, which the next one writes over. No other process may be writing it.

    `write` writes it to the path that it is given. OSError: it cannot be written, for want of room for example; the
    file aside is taken away.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_durably(Path(folder, "a.txt"), lambda path: path.write_text("all of it"))
        ...     Path(folder, "a.txt").read_text()
        'all of it'
    """
    aside = path.with_name(f"{PARTIAL}{path.name}")
    with _naming(path):
        try:
            _write_synced(aside, write)
            os.replace(aside, path)
        except BaseException:
            aside.unlink(missing_ok=True)
            raise
    _sync_folder(path.parent)


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Keep other processes from writing to a folder; a process that dies lets go of it.

    What an earlier process had completed, and could not put in its place, is put there first.

    `folder`: made if it does not exist, and taken away again if nothing is written to it. ValueError: another process
    has claimed it. OSError: it cannot be written to.
    """
    from filelock import FileLock, Timeout  # takes longer to import than all else that readers need

    made = [place for place in (folder, *folder.parents) if not place.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK, timeout=0, is_singleton=True)  # one for the whole process: it may claim it twice
    try:
        with _naming(folder / LOCK), ExitStack() as stack:
            try:
                stack.enter_context(lock)
            except Timeout as error:
                raise ValueError(
                    f"{folder}: another run is writing there; wait for its end, or choose another folder"
                ) from error
            until_exit = stack.pop_all()
        with until_exit:
            _claims.append(folder)
            try:
                if lock.lock_counter == 1:
                    _finish(folder)
                yield
            finally:
                _claims.remove(folder)
                if lock.lock_counter == 1:
                    (folder / LOCK).unlink(missing_ok=True)
    finally:
        with suppress(OSError):
            for place in made:
                place.rmdir()


def written_since(start_s: float) -> list[Path]:
    """Files in the folders that this process has claimed, written since a time; none that lies aside.

    `start_s`: as `time.time` gives it.
    """
    return [
        folder / path.name
        for folder in dict.fromkeys(_claims)
        for place in (folder, folder / WHOLE)
        for path in sorted((*place.glob("[!.]*"), *place.glob(PART)))
        if path.stat().st_mtime >= start_s
    ]


class Publication:
    """Makes files the content of a folder, all at once. A context manager, which claims the folder.

    Until `publish`, what an earlier one has published stays as it is; from then on it is gone, as its marker lists it.
    Other files stay. There is no moment in which a kill leaves neither; see `settled`, too.

    Args:
        folder: Where to write; made if it does not exist.
        marker: The file that lists the others: `SUMMARY` or `RECORDING`.
        goes_on: Whether what was added until a `note` is kept if this ends without `publish`, and gone on with.

    Attributes:
        paths: The files that are published, last the marker.
        notes: What was noted, by the processes that this one goes on for too, each with its `files`.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, Publication(Path(folder, "out")) as files:
        ...     files.add_text("a.txt", "a")
        ...     files.publish({"complete": True})
        ...     [path.name for path in files.paths]
        ['a.txt', 'summary.json']
    """

    def __init__(self, folder: Path, marker: str = SUMMARY, *, goes_on: bool = False) -> None:
        self.folder = folder
        self.paths: list[Path] = []
        self.notes: list[dict[str, Any]] = []
        self._marker = marker
        self._goes_on = goes_on
        # In the folder itself, which may be of another file system than what it lies in.
        self._aside = folder / (PART if goes_on else f"{PARTIAL}{uuid4().hex}")
        self._names: dict[str, None] = {}
        self._noted = 0

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            stack.enter_context(claimed(self.folder))
            for left in self.folder.glob(f"{PARTIAL}*"):  # by a process that was killed
                if left.name != PART:
                    rmtree(left, ignore_errors=True) if left.is_dir() else left.unlink()
            if self._goes_on and (lines := self._aside / NOTES).exists():
                self.notes = noted(self.folder)
                os.truncate(lines, len(_whole_lines(lines)))
                self._names = dict.fromkeys(name for note in self.notes for name in note["files"])
                self._noted = len(self._names)
            self._until_exit = stack.pop_all()
        return self

    def add(self, name: str, write: Callable[[Path], object]) -> None:
        """Write a file aside.

        `name`: its path within the folder; `write`: writes it to the path that it is given. OSError: it cannot be
        written, for want of room for example.
        """
        with _naming(self.folder / name):
            _write_synced(self._aside / name, write)
        self._names[name] = None

    def add_text(self, name: str, text: str) -> None:
        """Write a text aside."""
        self.add(name, lambda path: path.write_text(text, encoding="utf-8"))

    def add_figure(self, name: str, figure: "Figure") -> None:
        """Draw a figure aside."""
        self.add(name, lambda path: figure.savefig(path, dpi=figure.dpi, pil_kwargs={"compress_level": PNG_LEVEL}))

    def note(self, record: Mapping[str, Any]) -> None:
        """Note that what was added until now is kept, and what else is to be known when this is gone on with."""
        note = {**record, "files": list(self._names)[self._noted :]}
        self._aside.mkdir(exist_ok=True)
        with (self._aside / NOTES).open("ab") as file:
            file.write(f"{json.dumps(note, allow_nan=False)}\n".encode())
            file.flush()
            os.fsync(file.fileno())
        self.notes.append(note)
        self._noted = len(self._names)

    def publish(self, record: Mapping[str, Any]) -> None:
        """Make what was added content of the folder, in the marker the record and the names of all its files.

        More may be added, and published, after it.
        """
        names = [name for name in self._names if name != self._marker]
        text = json.dumps({**record, "files": names}, indent=2, allow_nan=False) + "\n"
        self.add_text(self._marker, text)
        for place in {path.parent for path in self._aside.rglob("*")}:
            _sync_folder(place)
        os.rename(self._aside, self.folder / WHOLE)  # from here on nothing is lost
        _sync_folder(self.folder)
        _finish(self.folder)
        self.paths = [self.folder / name for name in (*names, self._marker)]

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        with self._until_exit:
            if not self._goes_on:
                rmtree(self._aside, ignore_errors=True)
            _finish(self.folder)  # if Ctrl-C has come in between


def noted(folder: Path) -> list[dict[str, Any]]:
    """What was noted of a publication that may be gone on with; nothing where there is none, or nothing noted."""
    try:
        return [json.loads(line) for line in _whole_lines(folder / PART / NOTES).splitlines()]
    except FileNotFoundError:
        return []


def settled(path: Path) -> Path:
    """Where to read a file that may be one of a `Publication`: in its place, once all of them are in theirs.

    Returns the same, but of a folder that cannot be written to, or that another process is writing to, where it lies
    now. FileNotFoundError: it was one of the publication before.
    """
    for folder in path.absolute().parents[:2]:
        if (listed := _waiting(folder)) is None:
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
    if (listed := _waiting(folder)) is not None:
        marker = _marker(whole)
        names = [name for name in listed if (whole / name).is_file()]
        earlier, outdated = _listed(folder / marker) or set(), _outdated(folder, listed)
        if not earlier or outdated or not earlier.isdisjoint(names):  # else what it says holds until it is replaced
            with suppress(FileNotFoundError):
                os.replace(folder / marker, whole / BEFORE)
        for name in names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            _move(whole / name, folder / name)
        for name in outdated:
            (folder / name).unlink(missing_ok=True)
        for place in {(folder / name).parent for name in names}:
            _sync_folder(place)
        os.replace(whole / marker, folder / marker)
        _sync_folder(folder)
    rmtree(whole, ignore_errors=True)


def _marker(whole: Path) -> str:
    return next((name for name in MARKERS if (whole / name).is_file()), SUMMARY)


def _waiting(folder: Path) -> set[str] | None:
    """What a publication lists that is to be finished; None where there is none, or somebody has taken away some."""
    whole = folder / WHOLE
    listed = _listed(whole / _marker(whole))
    if listed is None or not all((whole / name).is_file() or (folder / name).is_file() for name in listed):
        return None
    return listed


def _move(source: Path, target: Path) -> None:
    try:
        os.replace(source, target)
    except OSError as error:
        if error.errno != errno.EXDEV:  # what a folder in the folder leads to may be of another file system
            raise
        write_durably(target, partial(copyfile, source))
        source.unlink()


def _outdated(folder: Path, listed: set[str]) -> set[str]:
    """Files of an earlier publication that are not among those of the one which is to be finished."""
    marker, before = folder / _marker(folder / WHOLE), folder / WHOLE / BEFORE
    earlier = (_listed(marker) or set()) | (_listed(before) or set())
    return {name for name in earlier - listed if (folder / name).is_file()}


def _listed(marker: Path) -> set[str] | None:
    """The files that a marker lists; None where there is no such list. Nothing outside of the folder is in it."""
    try:
        names = json.loads(marker.read_text(encoding="utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if not isinstance(names, list):
        return None
    paths = [PurePosixPath(name) for name in names if isinstance(name, str)]
    return {
        str(path) for path in paths if not path.is_absolute() and ".." not in path.parts and str(path) not in MARKERS
    }


def _whole_lines(path: Path) -> bytes:
    """What a file has but for a line without an end, which was being written when the process was killed."""
    content = path.read_bytes()
    return content[: content.rfind(b"\n") + 1]


def _write_synced(path: Path, write: Callable[[Path], object]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write(path)
    with path.open("r+b") as file:
        os.fsync(file.fileno())


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
