"""Atomic writes: a file, or a folder of files with a manifest, is old, new, or recognizable as incomplete.

Files are written to a temporary directory, synced, and moved one by one. The manifest is marked as unfinished before
and replaced last.
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
SUMMARY = "summary.json"  # manifest of a result
RECORDING = "recording.json"  # manifest of a recording
WRITING = "writing"  # key of a manifest while its files are written
MAX_MANIFEST_BYTES = 70_000_000  # a million files take 60 MB, and 2 GB when parsed; larger files are no manifests

_locked: set[Path] = set()  # folders that this process has locked


def reject_links(path: Path) -> None:
    """Reject symbolic links, except links in the root folder.

    Args:
        path: Path that is written to.

    Raises:
        ValueError: The path is a symbolic link, or leads through one.
    """
    for part in (path, *path.parents):
        if part.is_symlink() and len(part.absolute().parts) > 2:
            raise ValueError(f"{part}: a symbolic link; nothing is written through links: name its target instead")


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Lock a folder against writes of other processes until the block or the process ends.

    Args:
        folder: Folder; created if it does not exist, and removed again if it stays empty.

    Raises:
        ValueError: Another process has locked the folder; or the folder, or a file of its manifest, is a link.
        PermissionError: The folder is not writable.
    """
    import fcntl

    reject_links(folder)
    manifest = read_manifest(folder / SUMMARY) or {"files": {}}
    for name in {name.partition("/")[0] for name in manifest["files"]}:
        if (folder / name).is_symlink():
            reject_links(folder / name)
    key = folder.resolve()
    if key in _locked:
        yield
        return
    created_folders = [path for path in (folder, *folder.parents) if not path.exists()]
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
        for leftover in folder.glob(f"{TEMPORARY}*"):  # of a process that was killed
            if stat.S_ISDIR(leftover.lstat().st_mode):  # rmtree would open a FIFO
                rmtree(leftover, ignore_errors=True)
        _locked.add(key)
        yield
    finally:
        _locked.discard(key)
        with suppress(OSError):
            fcntl.flock(lock, fcntl.LOCK_UN)  # forked processes hold the lock, too
        os.close(lock)
        with suppress(OSError):
            for path in created_folders:
                path.rmdir()


def list_written(start_s: float) -> list[Path]:
    """List the files that were written in the folders that this process has locked.

    Args:
        start_s: Earliest time of modification, as `time.time`.
    """
    visible = [path for folder in sorted(_locked) for path in sorted(folder.glob("[!.]*"))]
    return [path for path in visible if path.lstat().st_mtime >= start_s]


def read_manifest(path: Path, max_bytes: int = MAX_MANIFEST_BYTES) -> dict[str, Any] | None:
    """Read a manifest.

    Args:
        path: File.
        max_bytes: Size limit; larger files are no manifests.

    Returns:
        Record with `files` by name, each with `bytes` and `sha256`, without hidden files and files outside of the
        folder. None if there is no regular file, or it has other content.
    """
    try:
        status = path.lstat()
    except OSError:
        return None
    if not stat.S_ISREG(status.st_mode) or status.st_size > max_bytes:
        return None
    return _parse_manifest(path, status.st_ino, status.st_size, status.st_mtime_ns)


@lru_cache(maxsize=4)
def _parse_manifest(path: Path, *_: int) -> dict[str, Any] | None:
    """Parse a manifest; the status of the file is a part of the cache key."""
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW), "rb") as file:
            record = json.loads(file.read(MAX_MANIFEST_BYTES))
        files = {str(name): entry for name, entry in record["files"].items() if _is_entry(name, entry)}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    return {**record, "files": files}


def _is_entry(name: str, entry: object) -> bool:
    is_short = len(os.fsencode(name)) <= 255  # limit of file systems for a name
    is_in_folder = is_short and "\0" not in name and all(part[:1] not in ("", ".") for part in name.split("/"))
    if not is_in_folder or not isinstance(entry, dict):
        return False
    return isinstance(entry.get("bytes"), int) and isinstance(entry.get("sha256"), str)


def is_unchanged(path: Path, entry: Mapping[str, Any]) -> bool:
    """Return whether a path is a regular file with the size and SHA-256 of a manifest.

    Args:
        path: File.
        entry: `bytes` and `sha256` of the file.
    """
    try:
        status = path.lstat()
        if not stat.S_ISREG(status.st_mode) or status.st_size != entry["bytes"]:
            return False
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW), "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest() == str(entry["sha256"])
    except OSError:
        return False


def find_changed(folder: Path, files: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Find files of a manifest that are missing, no regular files, or of another size.

    Args:
        folder: Folder of the files.
        files: Entries of the manifest by name.

    Returns:
        Names of these files.
    """
    changed = []
    for name, entry in files.items():
        if not os.path.isfile(folder / name) or os.path.getsize(folder / name) != entry["bytes"]:
            changed.append(name)
    return changed


def check_manifest_entry(path: Path) -> None:
    """Check that a file of a result is complete and has the content in the manifest of the result.

    Args:
        path: File; files without a manifest pass.

    Raises:
        ValueError: The result is incomplete, or the content differs.

    Warns:
        UserWarning: The content of a YAML document differs, which may be an intended edit.
    """
    path = path.absolute()
    # Results have far fewer files than recordings. Three manifests of this size take 1.4 GB when parsed.
    max_summary_bytes = 16_000_000
    for folder in path.parents[:3]:  # manifests list files at most this deep
        manifest = read_manifest(folder / SUMMARY, max_summary_bytes)
        name = path.relative_to(folder).as_posix()
        entry = manifest["files"].get(name) if manifest else None
        if manifest and manifest.get(WRITING) and (entry is not None or name == SUMMARY):
            raise ValueError(f"an incomplete result: the process that wrote {folder} was ended; run it again")
        if entry is None or is_unchanged(path, entry):
            continue
        if path.suffix != ".yaml":
            raise ValueError(
                f"an incomplete result: {folder / SUMMARY} lists this file with another content; run it again"
            )
        warnings.warn(f"{path}: edited since {SUMMARY} beside it was written", stacklevel=4)


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file atomically: write a temporary file, sync it, and replace `path` by it.

    Args:
        path: File; its folder is created if needed.
        write: Function that writes to the temporary path.

    Raises:
        OSError: The file cannot be written, and is unchanged.
        ValueError: The path leads through a symbolic link.

    Example:
        >>> with TemporaryDirectory() as folder:
        ...     write_atomically(Path(folder, "a.txt"), lambda path: path.write_text("content"))
        ...     assert Path(folder, "a.txt").read_text() == "content"
    """
    reject_links(path)
    with _name_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=TEMPORARY, dir=path.parent, ignore_cleanup_errors=True) as temporary:
            _write_synced(Path(temporary, path.name), write)
            _replace([(Path(temporary, path.name), path)])


class AtomicOutput:
    """Files that replace those in the manifest of a folder; a context manager that locks the folder.

    Args:
        folder: Output folder; created if it does not exist. Files outside of the manifest are not changed.
        manifest: Name of the manifest, which lists size and SHA-256 of all other files.
        files: Entries of an unfinished manifest that is continued.

    Attributes:
        paths: Published files, the manifest last.

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
        """Write a temporary file for the next `publish`.

        Args:
            name: Path relative to the folder.
            write: Function that writes to the temporary path.
        """
        with _name_errors(self.folder / name):
            self._files[name] = _write_synced(self._temporary / name, write)
        self._pending[name] = None

    def add_text(self, name: str, text: str) -> None:
        """Add a text file.

        Args:
            name: As in `add`.
            text: Content.
        """
        self.add(name, partial(Path.write_text, data=text, encoding="utf-8"))

    def add_figure(self, name: str, figure: "Figure") -> None:
        """Add a PNG file.

        Args:
            name: As in `add`.
            figure: Figure, saved at its own resolution.
        """
        # The default level 6 of zlib takes as long as plotting, for 20 % smaller files.
        self.add(name, partial(figure.savefig, dpi=figure.dpi, pil_kwargs={"compress_level": 3}))

    def publish(self, record: Mapping[str, Any]) -> None:
        """Move the added files to their names, then the manifest; further files may be added and published later.

        Args:
            record: Content of the manifest in addition to `files`.
        """
        manifest = self.folder / self._manifest
        earlier = read_manifest(manifest)
        listed = earlier["files"] if earlier else {}
        outdated = [name for name in listed.keys() - self._files if is_unchanged(self.folder / name, listed[name])]
        for name in (*self._pending, *outdated, self._manifest):
            path = self.folder / name
            reject_links(path)
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
    """Move files, and sync the folders of the targets."""
    for source, target in moves:
        os.replace(source, target)
    for folder in {target.parent for _, target in moves}:
        with suppress(OSError):  # some systems cannot sync a folder
            descriptor = os.open(folder, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)


def _write_synced(path: Path, write: Callable[[Path], object]) -> dict[str, Any]:
    """Write and sync a file, and return its entry in a manifest."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write(path)
    with path.open("r+b") as file:
        os.fsync(file.fileno())
        return {"bytes": os.fstat(file.fileno()).st_size, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}


@contextmanager
def _name_errors(path: Path) -> Iterator[None]:
    """Replace the temporary path, or a missing path, in messages of OSError."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise OSError(f"{path}: {error}") from error
        raise OSError(error.errno, error.strerror, str(path)) from error
