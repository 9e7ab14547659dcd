"""Who waits for a run: a bar that says how far it is, and signals that end it, never within a frame."""

import math
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from types import FrameType
from typing import Self

# Ctrl-C, a scheduler, and a terminal that is gone.
ENDS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
# Those that come so soon after another one mean the same.
TOGETHER_S = 1.0
# The end of a worker too, which torch turns into an error.
HELD_BACK = [*ENDS, *([signal.SIGCHLD] if hasattr(signal, "SIGCHLD") else [])]


class Progress:
    """Is told of every step of a run: a bar with steps a second, the worst error and the time that is left, or nothing.

    A context manager around the run. The bar is on stderr, in a notebook below the cell.

    Args:
        steps: Steps that the run is thought to have.
        title: What stands before it.
        done: Steps that are done before.
        shown: Whether anybody sees it.
        workers: Processes that make the steps, whose first ones arrive together.
    """

    def __init__(self, total: int, title: str, *, num_done: int = 0, is_shown: bool, num_workers: int = 0) -> None:
        self._rich = None
        # The rate is a mean over several rounds of all workers; before those, since the run began.
        self._times_s = deque([time.monotonic()], maxlen=1 + max(20, 4 * num_workers))
        if not is_shown:
            return
        # rich takes 0.1 s to import, which nobody should wait for who wants no bar.
        from rich import progress

        from torchcover.report import Terminal

        self._rich = progress.Progress(
            progress.TextColumn("{task.description}", markup=False),
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TextColumn("{task.fields[rate]}"),
            progress.TextColumn("{task.fields[words]}", markup=False),
            progress.TextColumn("{task.fields[left]}"),
            console=Terminal(stderr=True),
        )
        self._task = self._rich.add_task(title, total=total, completed=num_done, rate="", words="", left="")

    def __enter__(self) -> Self:
        if self._rich:
            self._rich.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._rich:
            self._rich.stop()

    def advance(self, expected_total: int, status: str = "") -> None:
        """A step is done.

        Args:
            expected_total: Steps that the run is thought to have in all.
            status: How good its numbers are, if anybody looks.
        """
        if self._rich:
            self._times_s.append(time.monotonic())
            rate = (len(self._times_s) - 1) / max(self._times_s[-1] - self._times_s[0], 1e-9)
            self._rich.advance(self._task)
            seconds = max(0.0, expected_total - self._rich.tasks[0].completed) / rate
            left = f"{timedelta(seconds=math.ceil(seconds))} left"
            self._rich.update(self._task, total=expected_total, rate=f"{rate:.2f} steps/s", words=status, left=left)


@contextmanager
def show_wait(title: str, *, is_shown: bool) -> Iterator[None]:
    """Show on stderr, if that is a terminal, for how long a block without steps has run.

    Args:
        title: What the block does.
        is_shown: Whether anybody sees it.
    """
    if not is_shown:
        yield
        return
    from rich import progress

    from torchcover.report import Terminal

    terminal = Terminal(stderr=True)
    if not terminal.is_terminal:  # rich would print an empty line
        yield
        return
    columns = progress.TextColumn("{task.description}", markup=False), progress.SpinnerColumn()
    with progress.Progress(*columns, progress.TimeElapsedColumn(), console=terminal, transient=True) as line:
        line.add_task(title, total=None)
        yield


@contextmanager
def handle_termination(on_signal: Callable[[Sequence[int]], object]) -> Iterator[list[int]]:
    """Treat SIGTERM, as a scheduler or `docker stop` sends it, and SIGHUP, of a lost connection, as Ctrl-C.

    For a program: a library leaves them alone. What is ignored stays so, as under `nohup`.

    `on_signal`: called whenever one comes, at once, with all that have come. Returns a list of those that have come.
    """
    program = _Program(on_signal)
    taken = [number for number in ENDS if signal.getsignal(number) not in (signal.SIG_IGN, None)]
    with _handled(taken, program):
        yield program.arrived


@contextmanager
def defer_signals() -> Iterator[list[int]]:
    """Hold them back until the block is done: no frame may count for some observers, or some sums, only.

    Returns a list of those that have come; who clears it has them forgotten.
    """
    arrived: list[int] = []
    if threading.current_thread() is not threading.main_thread():  # where they never arrive
        yield arrived
        return
    before = {number: signal.getsignal(number) for number in HELD_BACK}

    def hold(number: int, _: FrameType | None) -> None:
        handler = before[number]
        if not isinstance(handler, _Program) or handler.ends(number):
            arrived.append(number)

    with _handled([number for number, handler in before.items() if handler is not None], hold):
        yield arrived
    for number in arrived:
        if isinstance(before[number], _Program):
            raise KeyboardInterrupt
        signal.raise_signal(number)  # what it would have done: nothing, where it is ignored


@contextmanager
def _handled(numbers: Sequence[int], handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, own in before.items():
            signal.signal(number, own)


class _Program:
    def __init__(self, told: Callable[[Sequence[int]], object]) -> None:
        self.arrived: list[int] = []
        self._told = told
        self._ignored_until_s = 0.0

    def ends(self, number: int) -> bool:
        """Whether it ends the program; some send it twice, to the process and to its group, or another one with it."""
        self.arrived.append(number)
        self._told(self.arrived)
        now_s = time.monotonic()
        again = number != signal.SIGINT and now_s < self._ignored_until_s
        self._ignored_until_s = now_s + TOGETHER_S
        return not again

    def __call__(self, number: int, _: FrameType | None) -> None:
        if self.ends(number):
            raise KeyboardInterrupt
