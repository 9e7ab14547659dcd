"""Memory checks before large allocations, since a process that the system kills cannot report an error."""

import os
from functools import lru_cache
from pathlib import Path

# Limits of containers and cluster jobs: control groups (cgroups) of version 2, and of version 1.
CGROUP_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))
# Peak memory of a frame; 73 to 246 bytes were measured for a LiDAR, a camera and the reference sensors.
BYTES_PER_RAY = 300


@lru_cache
def find_memory_limit_bytes() -> float:
    """Find the largest memory that this process may take, which a container may limit."""
    limits_bytes = []
    for path in CGROUP_LIMITS:
        try:
            limits_bytes.append(float(path.read_text()))
        except (OSError, ValueError):  # no such file, or "max" for no limit
            continue
    try:
        limits_bytes.append(float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, OSError, ValueError):  # Windows has no such call; assume a common size
        limits_bytes.append(16e9)
    return min(limits_bytes)


def check_memory_fits(description: str, needed_bytes: float, remedy: str) -> None:
    """Check before an allocation that this machine has enough memory.

    Args:
        description: Object that needs the memory.
        needed_bytes: Size of the memory.
        remedy: Advice for the user.

    Raises:
        ValueError: More memory is needed than the machine has.
    """
    if needed_bytes > find_memory_limit_bytes():
        raise ValueError(
            f"{description}: {needed_bytes / 1e9:.3g} GB of memory are needed, and this machine has "
            f"{find_memory_limit_bytes() / 1e9:.3g} GB; {remedy}"
        )
