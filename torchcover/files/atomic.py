"""Atomic writes: a file, or a folder of files with a manifest, is old, new, or recognizable as incomplete.

Files are written into a temporary directory, synced, and moved one by one, the manifest last, which says so meanwhile.
"""

import errno
import hashlib
import json
import os
import stat
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import lru_cache, partial
from pathlib import Path
from shutil import rmtree
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


SUMMARY = "summary.json"  # of a result
RECORDING = "recording.json"
WRITING = "writing"  # key of a manifest while its files are written
MAX_MANIFEST_BYTES = 70_000_000  # larger files are not manifests; a million files take 60 MB, and 2 GB as empty lists
MAX_NAME_BYTES = 255  # of a listed path; what file systems allow for a name
FOLDER_DEPTH = 3  # files are listed at most this deep


def read_manifest(path: Path) -> dict[str, Any] | None:
    """Read a manifest: `files` by name, each with `bytes` and `sha256`, and its record.

    Returns None where there is none: no regular file, or another content. Entries of hidden files, and of files outside
    of the folder, are dropped.
    """
    try:
        status = path.lstat()
    except OSError:
        return None
    if not stat.S_ISREG(status.st_mode) or status.st_size > MAX_MANIFEST_BYTES:
        return None
    return _parse_manifest(path, status.st_ino, status.st_size, status.st_mtime_ns)


@lru_cache(maxsize=4)
def _parse_manifest(path: Path, *_: int) -> dict[str, Any] | None:
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW), "rb") as file:
            record = json.loads(file.read(MAX_MANIFEST_BYTES))
        files = {str(name): entry for name, entry in record["files"].items() if _is_entry(name, entry)}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    return {**record, "files": files}


def _is_entry(name: str, entry: object) -> bool:
    is_short = len(os.fsencode(name)) <= MAX_NAME_BYTES
    is_within = is_short and "\0" not in name and all(part[:1] not in ("", ".") for part in name.split("/"))
    is_whole = isinstance(entry, dict) and isinstance(entry.get("bytes"), int) and isinstance(entry.get("sha256"), str)
    return is_within and is_whole


def matches_entry(path: Path, entry: Mapping[str, Any]) -> bool:
    """Return whether a path is a regular file with the listed size and SHA-256."""
    try:
        status = path.lstat()
        if not stat.S_ISREG(status.st_mode) or status.st_size != entry["bytes"]:
            return False
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW), "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest() == str(entry["sha256"])
    except OSError:
        return False


def find_changed(folder: Path, files: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Find the listed files that are missing, no regular files, or of another size."""
    sizes = {name: os.path.getsize(folder / name) if os.path.isfile(folder / name) else None for name in files}
    return [name for name, size_bytes in sizes.items() if size_bytes != files[name]["bytes"]]


def check_listed(path: Path) -> None:
    """Refuse a file of a result whose manifest lists another content, or that was not written to its end.

    A YAML document may have been edited on purpose, which is a warning.
    """
    path = path.absolute()
    for folder in path.parents[:FOLDER_DEPTH]:
        manifest = read_manifest(folder / SUMMARY)
        name = path.relative_to(folder).as_posix()
        entry = manifest["files"].get(name) if manifest else None
        if manifest and manifest.get(WRITING) and (entry is not None or name == SUMMARY):
            raise ValueError(f"an incomplete result: the process that wrote {folder} was ended; run it again")
        if entry is None or matches_entry(path, entry):
            continue
        if path.suffix != ".yaml":
            raise ValueError(
                f"an incomplete result: {folder / SUMMARY} lists this file with another content; run it again"
            )
        warnings.warn(f"{path}: edited since {SUMMARY} beside it was written", stacklevel=4)


PNG_LEVEL = 3  # zlib level of figures: the default 6 takes as long as plotting, for 20 % smaller files


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Write a temporary file, sync it, and replace `path` by it; `write` gets the temporary path.

    OSError: the file cannot be written, and is unchanged. ValueError: the path leads through a symbolic link.

    Example:
        >>> with TemporaryDirectory() as folder:
        ...     write_atomically(Path(folder, "a.txt"), lambda path: path.write_text("content"))
        ...     assert Path(folder, "a.txt").read_text() == "content"
    """
    refuse_links(path)
    with _name_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=TEMPORARY, dir=path.parent, ignore_cleanup_errors=True) as temporary:
            _write_synced(Path(temporary, path.name), write)
            _replace([(Path(temporary, path.name), path)])


class AtomicOutput:
    """Files that replace those which the manifest of a folder lists; a context manager that locks the folder.

    Args:
        folder: Where to write; made if it does not exist. Files that no manifest lists stay.
        manifest: Name of the manifest, which lists size and SHA-256 of each other file.
        files: Entries of an unfinished manifest to go on from.

    Attributes:
        paths: The published files, the manifest last.

    Example:
        >>> with TemporaryDirectory() as folder, AtomicOutput(Path(folder, "out")) as files:
        ...     files.add_text("a.txt", "a")
        ...     files.publish({"complete": True})
        ...     [path.name for path in files.paths]
        ['a.txt', 'summary.json']
    """

    def __init__(self, folder: Path, manifest: str = SUMMARY, files: Mapping[str, Any] | None = None) -> None:
        self.folder, self.paths, self._manifest = folder, list[Path](), manifest
        self._files, self._pending = dict(files or {}), dict[str, None]()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            stack.enter_context(lock_folder(self.folder))
            temporary = TemporaryDirectory(prefix=TEMPORARY, dir=self.folder, ignore_cleanup_errors=True)
            self._temporary = Path(stack.enter_context(temporary))
            self._until_exit = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._until_exit.close()

    def add(self, name: str, write: Callable[[Path], object]) -> None:
        """Write a temporary file that is published as `name`, a path in the folder; `write` gets its path."""
        with _name_errors(self.folder / name):
            self._files[name] = _write_synced(self._temporary / name, write)
        self._pending[name] = None

    def add_text(self, name: str, text: str) -> None:
        """Write a text; see `add`."""
        self.add(name, lambda path: path.write_text(text, encoding="utf-8"))

    def add_figure(self, name: str, figure: "Figure") -> None:
        """Write a figure; see `add`."""
        self.add(name, lambda path: figure.savefig(path, dpi=figure.dpi, pil_kwargs={"compress_level": PNG_LEVEL}))

    def publish(self, record: Mapping[str, Any]) -> None:
        """Move the files to their names, then the manifest with the record; more may be added and published."""
        manifest, earlier = self.folder / self._manifest, read_manifest(self.folder / self._manifest)
        listed = earlier["files"] if earlier else {}
        outdated = [name for name in listed.keys() - self._files if matches_entry(self.folder / name, listed[name])]
        for path in (self.folder / name for name in (*self._pending, *outdated, self._manifest)):
            refuse_links(path)
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.is_dir():
                raise IsADirectoryError(errno.EISDIR, "a folder in the place of a file", str(path))
        unfinished, finished = self._temporary / ".unfinished", self._temporary / ".finished"
        with _name_errors(manifest):
            _write_synced(unfinished, partial(_write_json, {WRITING: True, "files": {**listed, **self._files}}))
            _write_synced(finished, partial(_write_json, {**record, "files": self._files}))
            if earlier is None or outdated or not listed.keys().isdisjoint(self._pending):
                _replace([(unfinished, manifest)])
            _replace([(self._temporary / name, self.folder / name) for name in self._pending])
            for name in outdated:
                (self.folder / name).unlink()
            _replace([(finished, manifest)])
        self._pending.clear()
        self.paths = [*(self.folder / name for name in self._files), manifest]


def _write_json(content: Mapping[str, Any], path: Path) -> None:
    path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _replace(moves: Sequence[tuple[Path, Path]]) -> None:
    """Move files to their names, and sync the folders of these."""
    for source, target in moves:
        os.replace(source, target)
    for folder in {target.parent for _, target in moves}:
        with suppress(OSError):  # not every system can sync a folder
            descriptor = os.open(folder, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)


def _write_synced(path: Path, write: Callable[[Path], object]) -> dict[str, Any]:
    """Write a file and wait until it is on the disk; returns its entry in a manifest."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write(path)
    with path.open("r+b") as file:
        os.fsync(file.fileno())
        return {"bytes": os.fstat(file.fileno()).st_size, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}


@contextmanager
def _name_errors(path: Path) -> Iterator[None]:
    """Let errors name the file instead of the temporary one, or none at all."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise OSError(f"{path}: {error}") from error
        raise OSError(error.errno, error.strerror, str(path)) from error
