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


def progress_of(steps: int, title: str, *, shown: bool) -> AbstractContextManager[Progress]:
    """A bar on stderr (in a notebook: below the cell), or nothing."""
    return _bar(steps, title) if shown else _silence()


@contextmanager
def _silence() -> Iterator[Progress]:
    yield Silence()


@contextmanager
def _bar(steps: int, title: str) -> Iterator[Progress]:
    from torchcover.evaluation.bar import RichBar  # rich takes 0.1 s to import

    with RichBar(steps, title) as bar:
        yield bar
