"""Who waits for a run: a bar that says how far it is, and signals that end it, never within a frame."""

import signal
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol

# Ctrl-C, a scheduler, and the end of a worker, which torch turns into an error.
HELD_BACK = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGCHLD") if hasattr(signal, name)]


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


@contextmanager
def terminable() -> Iterator[list[int]]:
    """Treat SIGTERM, as a scheduler or `docker stop` sends it, as Ctrl-C; for a program: a library leaves it alone.

    Returns:
        A list that holds SIGTERM once it has come.
    """
    arrived: list[int] = []

    def terminate(number: int, _: object) -> None:
        arrived.append(number)
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, terminate)
    try:
        yield arrived
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def held_back() -> Iterator[None]:
    """Hold them back until the block is done: no frame may count for some observers, or some sums, only."""
    if threading.current_thread() is not threading.main_thread():  # where they never arrive
        yield
        return
    arrived: list[int] = []
    before = [(kind, signal.signal(kind, lambda number, _: arrived.append(number))) for kind in HELD_BACK]
    try:
        yield
    finally:
        for kind, handler in before:
            signal.signal(kind, handler)
    for number in arrived:
        signal.raise_signal(number)  # what it would have done: nothing, where it is ignored
