"""Atomic writes: a file, or a folder of files with a manifest, is old, new, or recognizable as incomplete.

Files are written into a temporary directory, synced, and moved one by one, the manifest last, which says so meanwhile.
"""

import errno
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Self

from torchcover.files.locks import TEMPORARY, lock_folder, refuse_links
from torchcover.files.manifests import SUMMARY, WRITING, matches_entry, read_manifest

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
