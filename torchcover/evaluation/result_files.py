"""A folder of results: it is of one run only, and `summary.json` says that it is complete."""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path, PurePosixPath
from shutil import rmtree
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, Self

from filelock import FileLock, Timeout
from matplotlib.figure import Figure

from torchcover.evaluation.progress import held_back

# Written last, and taken away first: without it the folder is not complete.
SUMMARY = "summary.json"
LOCK = ".lock"
# What files that are not complete yet are in.
PARTIAL = ".partial_"


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Keep the runs of other processes out of a folder; a process that dies lets go of it.

    Args:
        folder: Made if it does not exist, and taken away again if nothing is written to it.

    Raises:
        ValueError: Another process has claimed it.
    """
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK, timeout=0, is_singleton=True)  # one for the whole process: it may claim it twice
    try:
        with lock:
            try:
                yield
            finally:
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


class ResultFiles:
    """Writes the files of a run into a folder. A context manager.

    They are written aside, and `publish` puts them in their places, which takes no time: until then what an earlier run
    has written stays as it is, and from then on it is gone, as its `summary.json` lists it. See `claimed`, too.

    Args:
        folder: Where to write; made if it does not exist.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.paths: list[Path] = []
        self._written: list[str] = []

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            stack.enter_context(claimed(self.folder))
            for left in self.folder.glob(f"{PARTIAL}*"):  # by a process that was killed
                rmtree(left, ignore_errors=True)
            # In the folder itself, so that what is done can be renamed.
            self._aside = Path(stack.enter_context(TemporaryDirectory(dir=self.folder, prefix=PARTIAL)))
            self._until_exit = stack.pop_all()
        return self

    def add(self, name: str, write: Callable[[Path], object]) -> None:
        """Write a file aside."""
        path = self._aside / name
        path.parent.mkdir(exist_ok=True)
        write(path)
        self._written.append(name)

    def add_text(self, name: str, text: str) -> None:
        """Write a text aside."""
        self.add(name, lambda path: path.write_text(text, encoding="utf-8"))

    def add_figure(self, name: str, figure: Figure) -> None:
        """Draw a figure aside."""
        self.add(name, lambda path: figure.savefig(path, dpi=figure.dpi))

    def publish(self, record: Mapping[str, Any]) -> None:
        """Put what was added in its place, last `summary.json`: the record, and the names of all files of this run."""
        earlier = {self.folder / name for name in _listed(self.folder / SUMMARY)}
        new = [self.folder / name for name in self._written]
        paths = [path for path in self.paths if path.name != SUMMARY] + new
        names = [path.relative_to(self.folder).as_posix() for path in paths]
        text = json.dumps({**record, "files": names}, indent=2, allow_nan=False) + "\n"
        (self._aside / SUMMARY).write_text(text, encoding="utf-8")
        only_adds = bool(self.paths) and set(self.paths).isdisjoint(new)  # what is listed already stays as it is
        with held_back():
            if not only_adds:
                (self.folder / SUMMARY).unlink(missing_ok=True)
            for name, path in zip(self._written, new, strict=True):
                path.parent.mkdir(exist_ok=True)
                os.replace(self._aside / name, path)
            for path in earlier.difference(paths):
                if path.is_file():
                    path.unlink()
            os.replace(self._aside / SUMMARY, self.folder / SUMMARY)
        self.paths, self._written = [*paths, self.folder / SUMMARY], []

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self._until_exit.close()


def _listed(summary: Path) -> list[str]:
    """The files that an earlier run lists; none where there is no such list. Nothing outside of the folder is in it."""
    try:
        names = json.loads(summary.read_text(encoding="utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError):
        return []
    paths = [PurePosixPath(name) for name in names if isinstance(name, str)] if isinstance(names, list) else []
    return [str(path) for path in paths if not path.is_absolute() and ".." not in path.parts]
