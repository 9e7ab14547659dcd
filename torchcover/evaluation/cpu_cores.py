"""The cores of a run: how many there are, how their threads wait, and how many processes are to make frames."""

import inspect
import multiprocessing
import os
import sys
import warnings
from functools import cache
from pathlib import Path

from torchcover.evaluation.settings import BYTES_PER_WORKER
from torchcover.simulation.memory import find_memory_limit_bytes

# What a container may take, where the system tells: microseconds of processor time, and of the time that they are for.
# Of cgroups of version 2 in one file, of version 1 in two.
CPU_QUOTAS = (
    (Path("/sys/fs/cgroup/cpu.max"),),
    (Path("/sys/fs/cgroup/cpu/cpu.cfs_quota_us"), Path("/sys/fs/cgroup/cpu/cpu.cfs_period_us")),
)
# Each of these says how threads of OpenMP wait: of the standard, of GNU, of Intel and LLVM.
WAITING = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")
# Of each worker, or it is not worth its start; and of the memory, of all.
LEAST_FRAMES = 8
MOST_MEMORY = 0.5
# Where the frames of a worker wait that are handed over whole, if the system tells; a container often has 64 MB of it.
SHARED_MEMORY = "/dev/shm"
SHARED_BYTES = 256e6


def count_cores() -> int:
    """Cores that this process may use: those that it is bound to, at most as many as its container is given."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for files in CPU_QUOTAS:
        try:
            quota, period = map(float, " ".join(file.read_text() for file in files).split())
        except (OSError, ValueError):  # there is none; or "max"
            continue
        if quota > 0 and period > 0:  # -1 is none
            count = min(count, max(1, int(quota / period)))
    return count


def set_threads() -> None:
    """Before torch and NumPy are loaded: as many threads as cores, none that spins; what the environment says, stays.

    NumPy's OpenBLAS has spinning threads of its own. They turn a matrix of three columns no sooner than one does.
    """
    if not _is_said():
        os.environ["OMP_WAIT_POLICY"] = "passive"
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_NUM_THREADS", str(count_cores()))


def get_start_method() -> str:
    """How workers start: as the program said, else forked where that can be, also since Python 3.14.

    A forked worker has what was loaded, and takes frames that cannot be pickled. What else is in its way, threads that
    hold locks, is not there: Embree has none (see `raycaster`), and torch has its own from its first parallel sum on.
    """
    usual = "fork" if sys.platform == "linux" else multiprocessing.get_all_start_methods()[0]
    return multiprocessing.get_start_method(allow_none=True) or usual


def compute_num_workers(num_frames: int, num_scenes: int, *, sends_frames: bool) -> int:
    """Processes that make the frames of a simulation, if nobody says how many.

    None where a process can only be started anew: a program that is not made for that would start itself.

    `num_frames`: how many; `num_scenes`: how many they are of; a world is built by one process; `sends_frames`: whether frames are
    handed over, rather than sums of them.
    """
    if get_start_method() != "fork" or multiprocessing.current_process().daemon:  # which may start none
        return 0
    workers = min(
        count_cores(),
        num_scenes,
        num_frames // LEAST_FRAMES,
        int(MOST_MEMORY * find_memory_limit_bytes() / BYTES_PER_WORKER),
    )
    if sends_frames and os.path.isdir(SHARED_MEMORY):
        room = os.statvfs(SHARED_MEMORY)
        workers = min(workers, int(room.f_bavail * room.f_frsize / SHARED_BYTES))
    return workers if workers > 1 else 0


def warn_about_spinning(num_threads: int) -> None:
    """Tell, once a process, that threads of torch are about to spin: the environment does not say how they wait."""
    if num_threads > 1 and not _is_said():
        _warn_once()


def _is_said() -> bool:
    return any(name in os.environ for name in WAITING)


@cache
def _warn_once() -> None:
    frame, level = inspect.currentframe(), 1
    while frame and frame.f_globals.get("__name__", "").partition(".")[0] in ("torchcover", "contextlib"):
        frame, level = frame.f_back, level + 1  # to the user's line
    warnings.warn(
        "threads of OpenMP keep their cores busy while they wait, for a third of a run's processor time: set "
        'os.environ["OMP_WAIT_POLICY"] = "passive" before torch is imported',
        stacklevel=level,
    )
