"""A folder of results: it is of one run only, and `summary.json` says that it is complete."""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, Self

from filelock import FileLock, Timeout

# Written last, and taken away first: without it the folder is not complete.
SUMMARY = "summary.json"
LOCK = ".lock"


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
    """Writes the files of a run into a folder, each of them whole or not at all. A context manager.

    What an earlier run has written here, as its `summary.json` lists it, and this one does not write, is deleted at the
    end. If it is left by an error, that stays, and there is no `summary.json`. See `claimed`, too.

    Args:
        folder: Where to write; made if it does not exist.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.paths: list[Path] = []
        self._earlier = _listed(folder / SUMMARY)

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            stack.enter_context(claimed(self.folder))
            (self.folder / SUMMARY).unlink(missing_ok=True)
            # In the folder itself, so that what is done can be renamed.
            self._partial = Path(stack.enter_context(TemporaryDirectory(dir=self.folder, prefix=".partial_")))
            self._until_exit = stack.pop_all()
        return self

    def add(self, name: str, write: Callable[[Path], object]) -> None:
        """Write a file.

        Args:
            name: Its path within the folder.
            write: Writes it to the path that it is given.
        """
        path = self.folder / name
        partial = self._partial / path.name
        write(partial)
        path.parent.mkdir(exist_ok=True)
        os.replace(partial, path)
        self.paths.append(path)

    def finish(self, record: Mapping[str, Any]) -> None:
        """Delete what is left of an earlier run, and write `summary.json`: the record, and the names of all files."""
        names = [path.relative_to(self.folder).as_posix() for path in self.paths]
        for path in {self.folder / name for name in self._earlier}.difference(self.paths):
            if path.is_file():
                path.unlink()
        text = json.dumps({**record, "files": names}, indent=2, allow_nan=False) + "\n"
        self.add(SUMMARY, lambda path: path.write_text(text, encoding="utf-8"))

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
