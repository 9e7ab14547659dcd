"""Ctrl-C between two frames, never within one."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def held_back() -> Iterator[None]:
    """Hold Ctrl-C back until the block is done: no frame may count for some observers, or some sums, only."""
    if threading.current_thread() is not threading.main_thread():  # where it never arrives
        yield
        return
    pressed = False

    def press(*_: Any) -> None:  # noqa: ANN401
        nonlocal pressed
        pressed = True

    before = signal.signal(signal.SIGINT, press)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if pressed:
        signal.raise_signal(signal.SIGINT)  # what it would have done: nothing, where it is ignored
