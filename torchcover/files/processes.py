"""Child processes: end with their parent, resource limits, and reports of stopped processes."""

import ctypes
import math
import os
import signal
import subprocess
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing import parent_process
from multiprocessing.process import BaseProcess
from pathlib import Path
from threading import Event, Thread
from typing import Any

if sys.platform == "linux":
    import resource
else:
    resource = None

_prctl = ctypes.CDLL(None).prctl if sys.platform == "linux" else None


def end_with_parent(
    memory_gb: float = math.inf, cpu_s: float = math.inf, *, can_write: bool = True
) -> Callable[..., None] | None:
    """Build a function that child processes call first, so that the kernel kills them when this process ends.

    Args:
        memory_gb: Limit of the address space in gigabytes.
        cpu_s: Limit of CPU time in seconds.
        can_write: Allow writing files.

    Returns:
        Function for the `preexec_fn` of `subprocess` or the `worker_init_fn` of a `DataLoader`; None on other systems
        than Linux.

    Example:
        >>> import subprocess
        >>> subprocess.run([sys.executable, "-c", ""], preexec_fn=end_with_parent()).returncode
        0
    """
    return partial(_set_up_child, os.getpid(), memory_gb, cpu_s, can_write) if _prctl else None


def is_stopped(pid: int) -> bool:
    """Return whether a signal such as SIGSTOP has stopped a process; always False on other systems than Linux.

    Args:
        pid: Process id.

    Example:
        >>> is_stopped(os.getpid())
        False
    """
    try:
        state = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:  # the process has ended
        return False
    return state.rpartition(")")[2].split()[0] == "T"


@contextmanager
def report_stopped_processes(
    pids: Collection[int] | Callable[[], Collection[int]], role: str, poll_interval_s: float = 5.0
) -> Iterator[None]:
    """Warn about stopped processes inside the block, since the program would wait for them silently.

    Args:
        pids: Process ids, or a function that returns them at each poll.
        role: Role of the processes for the warning: "a worker".
        poll_interval_s: Seconds between two polls. A process that is stopped at two successive polls is reported, so
            that Ctrl-Z and `fg`, which stop and continue all processes of a command, cause no warning.
    """
    if not pids:
        yield
        return
    ended = Event()

    def watch() -> None:
        stopped_polls = Counter[int]()
        while not ended.wait(poll_interval_s):
            for pid in pids() if callable(pids) else pids:
                stopped_polls[pid] = stopped_polls[pid] + 1 if is_stopped(pid) else 0
                if stopped_polls[pid] == 2:
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


def start_program(command: Sequence[str], role: str, **options: Any) -> "subprocess.Popen[Any]":  # noqa: ANN401
    """Start a program, and warn if it is stopped before it runs, since the start would wait for it silently.

    Args:
        command: Program and arguments.
        role: As in `report_stopped_processes`.
        options: Options of `subprocess.Popen`.

    Returns:
        The process.
    """
    earlier_children = _list_children()
    with report_stopped_processes(lambda: _list_children() - earlier_children, role):
        return subprocess.Popen(command, **options)


def _list_children() -> set[int]:
    """Return the ids of the child processes of this process; empty on other systems than Linux."""
    children = set[int]()
    for path in Path("/proc/self/task").glob("*/children"):
        with suppress(OSError):  # the thread has ended
            children.update(map(int, path.read_text().split()))
    return children


def limit_resources(memory_gb: float) -> None:
    """Limit the memory and the open files of this process, and prevent it from writing files.

    Args:
        memory_gb: Additional address space in gigabytes.
    """
    if resource is not None:
        used_bytes = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        _lower_limit(resource.RLIMIT_AS, used_bytes + int(memory_gb * 1e9))
        _lower_limit(
            resource.RLIMIT_NOFILE, 1024
        )  # libraries are open files, too, and a bag may have hundreds of parts
        _lower_limit(resource.RLIMIT_CORE, 0)
        _lower_limit(resource.RLIMIT_FSIZE, 0)


def get_used_bytes() -> int:
    """Return the resident memory of this process in bytes; 0 on other systems than Linux."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() if resource else 0


def _lower_limit(limit: int, value: int) -> None:
    _, hard = resource.getrlimit(limit)
    resource.setrlimit(limit, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))


def _set_up_child(parent_pid: int, memory_gb: float, cpu_s: float, can_write: bool, *_: object) -> None:
    """Limit resources, and let the kernel kill this process when its parent ends."""
    assert _prctl is not None  # checked by `end_with_parent`
    if cpu_s < math.inf:
        _lower_limit(resource.RLIMIT_CPU, math.ceil(cpu_s))
    if memory_gb < math.inf:
        _lower_limit(resource.RLIMIT_AS, int(memory_gb * 1e9))
    if not can_write:
        _lower_limit(resource.RLIMIT_FSIZE, 0)
    set_parent_death_signal = 1  # PR_SET_PDEATHSIG of Linux
    _prctl(set_parent_death_signal, signal.SIGKILL)
    if os.getppid() != parent_pid:  # the parent has ended already, or a fork server started this process for it
        parent = parent_process()
        if parent and parent.pid == parent_pid:
            Thread(target=_kill_after, args=(parent,), daemon=True).start()
        else:
            os.kill(os.getpid(), signal.SIGKILL)


def _kill_after(parent: BaseProcess) -> None:
    parent.join()
    os.kill(os.getpid(), signal.SIGKILL)
