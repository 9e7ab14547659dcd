"""CPU cores of a run: their number, the way in which their threads wait, and the number of worker processes."""

import inspect
import multiprocessing
import os
import sys
import warnings
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from torchcover.evaluation.settings import BYTES_PER_WORKER
from torchcover.simulation.memory import find_memory_limit_bytes

# Files with the CPU limit of a container: microseconds of CPU time, and the period to which they refer. Version 2 of
# cgroups has both in one file, version 1 has two files.
CPU_QUOTAS = (
    (Path("/sys/fs/cgroup/cpu.max"),),
    (Path("/sys/fs/cgroup/cpu/cpu.cfs_quota_us"), Path("/sys/fs/cgroup/cpu/cpu.cfs_period_us")),
)
# Environment variables that define how threads of OpenMP wait: the standard's, GNU's, and Intel's and LLVM's.
WAIT_VARIABLES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")
# Folder of the memory through which workers send frames.
SHARED_MEMORY = "/dev/shm"


@dataclass(frozen=True)
class WorkerParams:
    """Parameters of the number of worker processes.

    Args:
        min_frames: Fewest frames of a worker; with fewer, its start takes longer than it saves.
        max_memory_share: Maximum share of the memory for all workers.
        shared_bytes: Shared memory of a worker that sends whole frames; a container often has only 64 MB.
    """

    min_frames: int = 8
    max_memory_share: float = 0.5
    shared_bytes: float = 256e6


def count_cores() -> int:
    """Count the cores that this process may use, from its affinity and the CPU limit of its container."""
    num_cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for files in CPU_QUOTAS:
        try:
            quota_us, period_us = map(float, " ".join(file.read_text() for file in files).split())
        except (OSError, ValueError):  # no such file, or no limit ("max")
            continue
        if quota_us > 0 and period_us > 0:  # -1 means no limit
            num_cores = min(num_cores, max(1, int(quota_us / period_us)))
    return num_cores


def set_threads() -> None:
    """Set one thread per core, without busy waiting; call it before torch and NumPy are imported.

    Environment variables that are set already keep their values. OpenBLAS, which NumPy uses, gets one thread: its
    threads wait busily and do not make transforms of points faster.
    """
    if not _is_wait_policy_set():
        os.environ["OMP_WAIT_POLICY"] = "passive"
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_NUM_THREADS", str(count_cores()))


def get_start_method() -> str:
    """Return the start method of workers: the program's choice, else fork where possible, also since Python 3.14.

    A forked worker shares everything that is loaded, and accepts frames that cannot be pickled. Forking is safe because
    no other thread holds a lock: Embree has no threads (see `raycaster`), and torch starts its threads at its first
    parallel sum.
    """
    default = "fork" if sys.platform == "linux" else multiprocessing.get_all_start_methods()[0]
    return multiprocessing.get_start_method(allow_none=True) or default


def compute_num_workers(
    num_frames: int, num_scenes: int, *, sends_frames: bool, params: WorkerParams = WorkerParams()
) -> int:
    """Compute the default number of worker processes of a simulation.

    Args:
        num_frames: Number of frames.
        num_scenes: Number of scenes, each of which is built by one worker.
        sends_frames: Workers send whole frames, not sums.
        params: Limits.

    Returns:
        The number of workers; 0 if a single process is as good, or if processes cannot be forked: a started process
        would run the program of the user again.
    """
    if get_start_method() != "fork" or multiprocessing.current_process().daemon:  # daemons cannot have children
        return 0
    memory_bytes = params.max_memory_share * find_memory_limit_bytes()
    num_workers = min(count_cores(), num_scenes, num_frames // params.min_frames, int(memory_bytes / BYTES_PER_WORKER))
    if sends_frames and os.path.isdir(SHARED_MEMORY):
        status = os.statvfs(SHARED_MEMORY)
        num_workers = min(num_workers, int(status.f_bavail * status.f_frsize / params.shared_bytes))
    return num_workers if num_workers > 1 else 0


def warn_about_spinning(num_threads: int) -> None:
    """Warn once per process if threads of torch will wait busily because no environment variable forbids it.

    Args:
        num_threads: Number of threads of torch.
    """
    if num_threads > 1 and not _is_wait_policy_set():
        _warn_about_spinning_once()


def _is_wait_policy_set() -> bool:
    """Return True if the environment defines how threads wait."""
    return any(name in os.environ for name in WAIT_VARIABLES)


@cache
def _warn_about_spinning_once() -> None:
    """Warn at the first call; the cache drops later calls."""
    # The user has to change the program: the warning points to the first line outside this package.
    frame, level = inspect.currentframe(), 1
    while frame and frame.f_globals.get("__name__", "").partition(".")[0] in ("torchcover", "contextlib"):
        frame, level = frame.f_back, level + 1
    warnings.warn(
        "waiting threads of OpenMP keep their cores busy, which takes a third of the CPU time of a run: set "
        'os.environ["OMP_WAIT_POLICY"] = "passive" before torch is imported',
        stacklevel=level,
    )
