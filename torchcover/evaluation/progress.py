"""How far a run is: for somebody who waits, or for nobody."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol


class Progress(Protocol):
    """Is told of every step of a run; a context manager around it."""

    def advance(self, expected_steps: int, words: str = "") -> None:
        """A step is done.

        Args:
            expected_steps: Steps that the run is thought to have in all.
            words: How good its numbers are, if anybody looks.
        """
        ...


class Silence:
    """Tells nobody."""

    def advance(self, expected_steps: int, words: str = "") -> None:
        """Nothing."""


class Bar:
    """A bar with the steps done, steps a second, the worst error, and the time that is left; on stderr.

    Args:
        steps: Steps that the run is thought to have.
        title: What stands before it.
        done: Steps that are done before.
    """

    def __init__(self, steps: int, title: str, done: int) -> None:
        # rich takes 0.1 s to import, which nobody should wait for who wants no bar.
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as RichProgress

        self.rich = RichProgress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TextColumn("{task.fields[words]}", markup=False),
            TimeRemainingColumn(),
            TextColumn("left"),
            console=Console(stderr=True),
        )
        self._task = self.rich.add_task(title, total=steps, completed=done, rate="", words="")

    def advance(self, expected_steps: int, words: str = "") -> None:
        """Move on by a step."""
        self.rich.advance(self._task)
        speed = self.rich.tasks[0].speed
        rate = f"{speed:.2f} steps/s" if speed else ""
        self.rich.update(self._task, total=expected_steps, rate=rate, words=words)


def progress_of(steps: int, title: str, *, done: int = 0, shown: bool) -> AbstractContextManager[Progress]:
    """A bar on stderr (in a notebook: below the cell), or nothing."""
    return _bar(steps, title, done) if shown else _silence()


@contextmanager
def _silence() -> Iterator[Progress]:
    yield Silence()


@contextmanager
def _bar(steps: int, title: str, done: int) -> Iterator[Progress]:
    bar = Bar(steps, title, done)
    with bar.rich:
        yield bar
