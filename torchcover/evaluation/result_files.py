"""A folder of results: it is of one run only, and `summary.json` says that it is complete."""

import os
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Self

# Written last, and taken away first: without it the folder is not complete.
SUMMARY = "summary.json"
# What an earlier run may have left that the next does not write.
MAYBE_LEFT_OVER = ("coverage.npz", "coverage/*.npz", "maps/*.png")


class ResultFiles:
    """Writes the files of a run into a folder, each of them whole or not at all. A context manager.

    Files of an earlier run that this one does not write are deleted at the end: `coverage.npz`, `coverage/*.npz` and
    `maps/*.png`. If it is left by an error, they stay, and there is no `summary.json`.

    Args:
        folder: Where to write; made if it does not exist.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.paths: list[Path] = []

    def __enter__(self) -> Self:
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / SUMMARY).unlink(missing_ok=True)
        # In the folder itself, so that what is done can be renamed.
        self._partial = TemporaryDirectory(dir=self.folder, prefix=".partial_")
        return self

    def add(self, name: str, write: Callable[[Path], object]) -> None:
        """Write a file.

        Args:
            name: Its path within the folder.
            write: Writes it to the path that it is given.
        """
        path = self.folder / name
        partial = Path(self._partial.name) / path.name
        write(partial)
        path.parent.mkdir(exist_ok=True)
        os.replace(partial, path)
        self.paths.append(path)

    def finish(self, summary: str) -> None:
        """Delete what is left of an earlier run, and write `summary.json`."""
        for pattern in MAYBE_LEFT_OVER:
            for path in set(self.folder.glob(pattern)).difference(self.paths):
                path.unlink()
        self.add(SUMMARY, lambda path: path.write_text(summary, encoding="utf-8"))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self._partial.cleanup()
