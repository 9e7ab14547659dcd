"""Processes that do not outlive the one that has started them."""

import ctypes
import os
import signal
import sys
from collections.abc import Callable
from functools import partial

# Of Linux: the signal that a process gets when the thread that has started it ends, or its whole process does.
PR_SET_PDEATHSIG = 1
_prctl = ctypes.CDLL(None).prctl if sys.platform == "linux" else None


def end_with_parent() -> Callable[..., None] | None:
    """What a process that this one starts has to call first, to be killed when this one ends, however that ends.

    Returns:
        For the `preexec_fn` of `subprocess` and the `worker_init_fn` of a `DataLoader`; None where the system, any but
        Linux, cannot do so.

    Example:
        >>> import subprocess
        >>> subprocess.run([sys.executable, "-c", ""], preexec_fn=end_with_parent()).returncode
        0
    """
    return partial(_end_with, os.getpid()) if _prctl else None


def _end_with(parent: int, *_: object) -> None:
    assert _prctl is not None  # or nobody would have been given this
    _prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # which has ended before this was asked for
        os.kill(os.getpid(), signal.SIGKILL)
