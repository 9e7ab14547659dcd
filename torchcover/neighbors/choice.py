"""Which backend searches, by device, type and size of the clouds."""

import logging
import warnings
from collections.abc import Callable
from functools import lru_cache
from importlib import import_module

import torch
from torch import Tensor

# backend -> its module; imported when first used, so that an unused library costs nothing.
BACKENDS = {
    "cdist": "torchcover.neighbors.cdist",
    "kdtree": "torchcover.neighbors.kdtree",
    "packets": "torchcover.neighbors.packets",
}
ON_THE_CPU = frozenset({"kdtree", "packets"})

# On the CPU brute force beats the tree only for few queries against many points, where building it does not pay
# (docs/measured/performance.md, crossover).
MAX_QUERIES_COMPARED = 16
MANY_POINTS = 10_000
# Packets are faster than the KD-tree from fewer points and queries, but take a second to load.
PACKETS_PAY = 20_000
# So many pairs take longer to compare on a GPU than to search on the CPU, by the bandwidth of its memory: 4 bytes a
# pair, written and read, at 1 TB/s. Never run on a GPU.
MAX_PAIRS_ON_THE_DEVICE = 10**9

Search = Callable[[Tensor, Tensor, float, float], Tensor]
log = logging.getLogger("torchcover")


def choose_search(query: Tensor, points: Tensor, backend: str) -> Search:
    """The search of a backend.

    Args:
        query: (N, 3) coordinates.
        points: (M, 3) coordinates of the same type and device.
        backend: A name in `BACKENDS`, or "auto".

    Returns:
        A function of query, points, largest distance and memory in megabytes.

    Raises:
        ValueError: An unknown backend, or one for the CPU where the clouds are on another device.
        ImportError: A backend was named whose library is missing.
    """
    on_cpu = query.device.type == "cpu"
    if backend == "auto":
        return _on_the_cpu(query, points) if on_cpu else _on_a_device(query, points)
    if backend not in BACKENDS:
        raise ValueError(f"backend: one of {', '.join(['auto', *BACKENDS])} is needed; got {backend!r}")
    if backend in ON_THE_CPU and not on_cpu:
        raise ValueError(
            f"backend {backend!r} runs on the CPU; the clouds are on {query.device}: use 'cdist' or 'auto'"
        )
    return _search_of(backend)


def _search_of(backend: str) -> Search:
    search: Search = import_module(BACKENDS[backend]).search
    return search


def _on_the_cpu(query: Tensor, points: Tensor) -> Search:
    if len(query) <= MAX_QUERIES_COMPARED and len(points) >= MANY_POINTS:
        return _search_of("cdist")
    # Packets are for float32, and where there are few queries, most of the time goes into sorting the points.
    if query.dtype != torch.float64 and len(query) + len(points) >= PACKETS_PAY and _packets_work():
        return _search_of("packets")
    return _search_of("kdtree")


def _on_a_device(query: Tensor, points: Tensor) -> Search:
    if len(query) * len(points) <= MAX_PAIRS_ON_THE_DEVICE:
        return _search_of("cdist")
    _say_that_the_cpu_searches(str(query.device))
    return _through_the_cpu


def _through_the_cpu(query: Tensor, points: Tensor, max_distance: float, memory_mb: float) -> Tensor:
    there, cloud = query.cpu(), points.cpu()
    return _on_the_cpu(there, cloud)(there, cloud, max_distance, memory_mb).to(query.device)


@lru_cache
def _say_that_the_cpu_searches(device: str) -> None:
    warnings.warn(
        f"nearest: clouds on {device} with more than {MAX_PAIRS_ON_THE_DEVICE:,} pairs are searched on the CPU, which "
        "is faster than to compare them all",
        stacklevel=2,
    )


@lru_cache
def _packets_work() -> bool:
    """Whether numba can be used; says once what is used instead."""
    try:
        _search_of("packets")
    except ModuleNotFoundError as error:
        log.info("nearest: the KD-tree searches; packets are faster: pip install 'torchcover[fast]' (%s)", error)
        return False
    except Exception as error:  # whatever a broken compiler raises: the KD-tree is as exact
        problem = str(error).strip().partition("\n")[0]
        warnings.warn(
            f"nearest: the KD-tree searches instead of packets, as numba does not work: {problem}", stacklevel=2
        )
        return False
    return True
