"""A progress bar by rich."""

from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


class RichBar:
    """A bar with the steps done, steps a second, the worst error, and the time that is left; on stderr.

    Args:
        steps: Steps that the run is thought to have.
        title: What stands before it.
    """

    def __init__(self, steps: int, title: str) -> None:
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TextColumn("{task.fields[words]}"),
            TimeRemainingColumn(),
            TextColumn("left"),
            console=Console(stderr=True),
        )
        self._task = self._progress.add_task(title, total=steps, rate="", words="")

    def advance(self, expected_steps: int, words: str = "") -> None:
        """Move on by a step."""
        self._progress.advance(self._task)
        speed = self._progress.tasks[0].speed
        rate = f"{speed:.2f} steps/s" if speed else ""
        self._progress.update(self._task, total=expected_steps, rate=rate, words=words)

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self._progress.stop()
