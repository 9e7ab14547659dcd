"""Signals that end a run: between two frames, never within one."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

# Ctrl-C, a scheduler, and the end of a worker, which torch turns into an error.
HELD_BACK = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGCHLD") if hasattr(signal, name)]


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
