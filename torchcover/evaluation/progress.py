"""Progress bar of a run, and signals that end it between two frames."""

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

# Signals that end a run: Ctrl-C, the end of a job or container, and a closed terminal.
END_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class Progress:
    """Progress bar of a run: frames, rate, largest error and remaining time; a context manager around the run.

    The bar is on stderr, in a notebook below the cell.

    Args:
        total: Expected number of frames.
        title: Text in front of the bar.
        num_done: Frames that are done before the start.
        is_shown: Show the bar; otherwise calls have no effect.
        num_workers: Worker processes, whose first frames arrive at the same time.
    """

    def __init__(self, total: int, title: str, *, num_done: int = 0, is_shown: bool, num_workers: int = 0) -> None:
        self._bar = None
        # The rate is averaged over several rounds of all workers, or since the start if that is shorter.
        self._times_s = deque([time.monotonic()], maxlen=1 + max(20, 4 * num_workers))
        if not is_shown:
            return
        # Importing rich takes 0.1 s, which only runs with a bar need.
        from rich import progress

        from torchcover.report import Terminal

        self._bar = progress.Progress(
            progress.TextColumn("{task.description}", markup=False),
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TextColumn("{task.fields[rate]}"),
            progress.TextColumn("{task.fields[status]}", markup=False),
            progress.TextColumn("{task.fields[remaining]}"),
            console=Terminal(stderr=True),
        )
        self._task = self._bar.add_task(title, total=total, completed=num_done, rate="", status="", remaining="")

    def __enter__(self) -> Self:
        if self._bar:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar:
            self._bar.stop()

    def advance(self, expected_total: int, status: str = "") -> None:
        """Count one more frame.

        Args:
            expected_total: Expected number of frames in total.
            status: Text behind the rate, such as the largest error.
        """
        if not self._bar:
            return
        self._times_s.append(time.monotonic())
        frames_per_s = (len(self._times_s) - 1) / max(self._times_s[-1] - self._times_s[0], 1e-9)
        self._bar.advance(self._task)
        remaining_s = max(0.0, expected_total - self._bar.tasks[0].completed) / frames_per_s
        self._bar.update(
            self._task,
            total=expected_total,
            rate=f"{frames_per_s:.2f}/s",
            status=status,
            remaining=f"{timedelta(seconds=math.ceil(remaining_s))} left",
        )


@contextmanager
def show_wait(title: str, *, is_shown: bool) -> Iterator[None]:
    """Show the elapsed time of a block without frames, on stderr if it is a terminal.

    Args:
        title: Description of the block.
        is_shown: Show it; otherwise the call has no effect.
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
    """Treat SIGTERM (from a scheduler or `docker stop`) and SIGHUP (from a lost connection) like Ctrl-C.

    For programs only; a library does not change signals. Ignored signals remain ignored, as under `nohup`.

    Args:
        on_signal: Function that is called at once at every signal, with the numbers of all signals that arrived.

    Returns:
        Context manager with the list of the signals that arrived.
    """
    handler = _TerminationHandler(on_signal)
    numbers = [number for number in END_SIGNALS if signal.getsignal(number) not in (signal.SIG_IGN, None)]
    with _set_handlers(numbers, handler):
        yield handler.arrived


@contextmanager
def defer_signals() -> Iterator[list[int]]:
    """Defer signals to the end of the block, so that no frame counts for some observers or sums only.

    Returns:
        Context manager with the list of the signals that arrived; clearing the list drops them.
    """
    arrived: list[int] = []
    if threading.current_thread() is not threading.main_thread():  # other threads never receive signals
        yield arrived
        return
    # The end of a worker is deferred too: torch turns it into an error.
    deferred = [*END_SIGNALS, *([signal.SIGCHLD] if hasattr(signal, "SIGCHLD") else [])]
    handlers = {number: signal.getsignal(number) for number in deferred}

    def record_signal(number: int, _: FrameType | None) -> None:
        """Record a signal that would end the program."""
        handler = handlers[number]
        if not isinstance(handler, _TerminationHandler) or handler.register(number):
            arrived.append(number)

    with _set_handlers([number for number, handler in handlers.items() if handler is not None], record_signal):
        yield arrived
    for number in arrived:
        if isinstance(handlers[number], _TerminationHandler):
            raise KeyboardInterrupt
        signal.raise_signal(number)  # the original handler decides; it may ignore the signal


@contextmanager
def _set_handlers(numbers: Sequence[int], handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Set a handler of signals within a block."""
    previous = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, previous_handler in previous.items():
            signal.signal(number, previous_handler)


class _TerminationHandler:
    """Handler that turns signals into KeyboardInterrupt, one for several signals in a short time."""

    # Some programs send a signal twice, to the process and to its group, or SIGTERM and SIGHUP together.
    repeat_interval_s = 1.0

    def __init__(self, on_signal: Callable[[Sequence[int]], object]) -> None:
        self.arrived: list[int] = []
        self._on_signal = on_signal
        self._ignored_until_s = 0.0

    def register(self, number: int) -> bool:
        """Register a signal; return True if it ends the program, False if it repeats the previous one."""
        self.arrived.append(number)
        self._on_signal(self.arrived)
        now_s = time.monotonic()
        is_repeated = number != signal.SIGINT and now_s < self._ignored_until_s
        self._ignored_until_s = now_s + self.repeat_interval_s
        return not is_repeated

    def __call__(self, number: int, _: FrameType | None) -> None:
        if self.register(number):
            raise KeyboardInterrupt
