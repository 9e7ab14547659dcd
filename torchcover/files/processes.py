"""Processes that do not outlive the one that has started them, and that are reported while they are stopped."""

import ctypes
import math
import os
import signal
import sys
import warnings
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing import parent_process
from multiprocessing.process import BaseProcess
from pathlib import Path
from threading import Event, Thread

if sys.platform == "linux":
    import resource
else:
    resource = None

# Of Linux: the signal that a process gets when the thread that has started it ends, or its whole process does.
PR_SET_PDEATHSIG = 1
MOST_FILES = 1024  # libraries are files, too, and a bag may be split into hundreds
_prctl = ctypes.CDLL(None).prctl if sys.platform == "linux" else None


def end_with_parent(
    memory_gb: float = math.inf, cpu_s: float = math.inf, *, can_write: bool = True
) -> Callable[..., None] | None:
    """What a process that this one starts has to call first, to be killed when this one ends, however that ends.

    `memory_gb`: what it may take in all; `can_write`: whether it may write files. Returns for the `preexec_fn` of
    `subprocess` and the `worker_init_fn` of a `DataLoader`; None where the system, any but Linux, cannot do so.

    Example:
        >>> import subprocess
        >>> subprocess.run([sys.executable, "-c", ""], preexec_fn=end_with_parent()).returncode
        0
    """
    return partial(_end_with, os.getpid(), memory_gb, cpu_s, can_write) if _prctl else None


def is_stopped(pid: int) -> bool:
    """Whether a process is stopped by a signal, as by SIGSTOP; False where the system, any but Linux, does not tell.

    Example:
        >>> is_stopped(os.getpid())
        False
    """
    try:
        state = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:  # it has ended
        return False
    return state.rpartition(")")[2].split()[0] == "T"


@contextmanager
def report_stopped_processes(pids: Collection[int], role: str, poll_interval_s: float = 5.0) -> Iterator[None]:
    """Warn about processes that this one waits for, and that someone has stopped: nothing else would end the silence.

    Args:
        pids: Process numbers.
        role: What they are, for the warning: "a worker".
        poll_interval_s: Seconds between two looks; a process that is stopped at two of them in a row is reported, so that
            Ctrl-Z and `fg`, which stop and continue all processes of a command, are not.
    """
    if not pids:
        yield
        return
    ended = Event()

    def watch() -> None:
        looks = dict.fromkeys(pids, 0)
        while not ended.wait(poll_interval_s):
            for pid in pids:
                looks[pid] = looks[pid] + 1 if is_stopped(pid) else 0
                if looks[pid] == 2:
                    warnings.warn(
                        f"{role} (process {pid}) is stopped, and the run waits for it: continue it with "
                        f"`kill -CONT {pid}`, or end the run with Ctrl-C",
                        RuntimeWarning,
                        stacklevel=2,
                    )

    watcher = Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        ended.set()
        watcher.join()


def limit_resources(memory_gb: float) -> None:
    """Limit what this process may take from now on: memory beyond what it has, files that are open; and write none."""
    if resource is not None:
        now_bytes = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        _lower(resource.RLIMIT_AS, now_bytes + int(memory_gb * 1e9))
        _lower(resource.RLIMIT_NOFILE, MOST_FILES)
        _lower(resource.RLIMIT_CORE, 0)
        _lower(resource.RLIMIT_FSIZE, 0)


def get_used_bytes() -> int:
    """Return the resident memory of this process; 0 where the system, any but Linux, does not say it."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() if resource else 0


def _lower(what: int, most: int) -> None:
    _, hard = resource.getrlimit(what)
    resource.setrlimit(what, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


def _end_with(parent: int, memory_gb: float, cpu_s: float, writes: bool, *_: object) -> None:
    assert _prctl is not None  # or nobody would have been given this
    if cpu_s < math.inf:
        _lower(resource.RLIMIT_CPU, math.ceil(cpu_s))
    if memory_gb < math.inf:
        _lower(resource.RLIMIT_AS, int(memory_gb * 1e9))
    if not writes:
        _lower(resource.RLIMIT_FSIZE, 0)
    _prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # which has ended before this was asked for, or had a server fork this one
        if (starter := parent_process()) and starter.pid == parent:
            Thread(target=_end_after, args=(starter,), daemon=True).start()
        else:
            os.kill(os.getpid(), signal.SIGKILL)


def _end_after(starter: BaseProcess) -> None:
    starter.join()
    os.kill(os.getpid(), signal.SIGKILL)
