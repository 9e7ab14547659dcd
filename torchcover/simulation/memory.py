"""What a run would need, asked before it starts: a process that is killed for its memory says nothing."""

import os
from functools import lru_cache
from pathlib import Path

# What containers and cluster jobs are limited to, where the system tells: cgroups of version 2, and of version 1.
CGROUP_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))
# Where no system call tells.
USUAL_BYTES = 16e9
# Of a step at its largest: 73 to 246 were measured, for a LiDAR, a camera and the reference sensors.
BYTES_PER_RAY = 300


@lru_cache
def find_memory_limit_bytes() -> float:
    """The memory that this process may take at most."""
    limits = []
    for path in CGROUP_LIMITS:
        try:
            limits.append(float(path.read_text()))
        except (OSError, ValueError):  # there is none; or "max"
            continue
    try:
        limits.append(float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, OSError, ValueError):  # not on Windows
        limits.append(USUAL_BYTES)
    return min(limits)


def check_memory_fits(description: str, needed_bytes: float, remedy: str) -> None:
    """Refuse what this machine has no memory for, before any of it is reserved."""
    if needed_bytes > find_memory_limit_bytes():
        raise ValueError(
            f"{description}: {needed_bytes / 1e9:.3g} GB of memory are needed, and this machine has "
            f"{find_memory_limit_bytes() / 1e9:.3g} GB; {remedy}"
        )
