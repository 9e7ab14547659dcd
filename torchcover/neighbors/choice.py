"""Which backend searches, by device, type and size of the clouds."""

import logging
import warnings
from collections.abc import Callable, Sequence
from functools import lru_cache
from importlib import import_module

import torch
from torch import Tensor

# backend -> its module; imported when first used, so that an unused library costs nothing.
BACKENDS = {
    "cdist": "torchcover.neighbors.cdist",
    "kdtree": "torchcover.neighbors.kdtree",
    "packets": "torchcover.neighbors.packets",
    "warp": "torchcover.neighbors.warp",
}
# The kinds of devices that each runs on; "cdist" on any.
DEVICES = {"kdtree": ("cpu",), "packets": ("cpu",), "warp": ("cpu", "cuda")}

# Once loaded, packets are faster than the KD-tree for nearly any clouds, by at least so much
# (docs/measured/speed.md). Loading numba takes each process half a second, which a hundred calls should
# earn. By the clouds alone: a choice by what was searched before would change the last bits of a run with its workers.
GAINED_PER_QUERY_S = 3e-7
GAINED_PER_POINT_S = 8e-9
LEAST_GAIN_S = 5e-3
# Points that are flat along an axis, next to the queries, fill flat boxes of the KD-tree, while all queries of a packet
# are compared with what is near any of them: this takes so long for each query and point near it. In practice packets
# gain more than is counted above, and are slower only if that is more than so much.
FLAT_SHARE = 1e-3
NEAR_S = 6e-11
LOST_PER_QUERY_S, LOST_PER_POINT_S = 2e-7, 4e-8
# Queries of a packet, and by how many points the extent of a cloud is told.
PACKET, SAMPLE = 64, 1024
# So many pairs take as long to compare on an H200 as 16 cores take to search: 14 ms (docs/measured/gpu.md).
MAX_PAIRS_ON_THE_DEVICE = 10**9

# What brings the libraries that are not always there.
INSTALL = {"packets": "pip install 'torchcover[fast]'", "warp": "pip install 'torchcover[warp]'"}

Search = Callable[[Tensor, Tensor, float, float], Tensor]
log = logging.getLogger("torchcover")


def choose_search(query: Tensor, points: Tensor, backend: str) -> Search:
    """The search of a backend: a name in `BACKENDS`, or "auto".

    ValueError: an unknown backend, or one for other devices than that of the clouds. ImportError: a backend was named
    whose library is missing, or does not work.
    """
    on_cpu = query.device.type == "cpu"
    if backend == "auto":
        return _on_the_cpu(query, points) if on_cpu else _on_a_device(query, points)
    if backend not in BACKENDS:
        raise ValueError(f"backend: one of {', '.join(['auto', *BACKENDS])} is needed; got {backend!r}")
    kinds = DEVICES.get(backend)
    if kinds and query.device.type not in kinds:
        raise ValueError(
            f"backend {backend!r} runs on {' and '.join(kinds)}; the clouds are on {query.device}: use 'cdist' or "
            "'auto'"
        )
    try:
        return _search_of(backend)
    except ModuleNotFoundError:  # which says what to install
        raise
    except Exception as error:  # whatever a broken compiler raises
        raise ImportError(
            f"backend {backend!r} does not work here ({_first_line(error)}); try 'auto', or "
            f"{INSTALL.get(backend, 'pip install torchcover')} anew"
        ) from error


def choose_shared_backend(query: Tensor, clouds: Sequence[Tensor]) -> str:
    """The backend for the same queries in several clouds, one after the other: what pays for all together."""
    return "packets" if query.device.type == "cpu" and _packets_pay(query, clouds) else "auto"


def _packets_pay(query: Tensor, clouds: Sequence[Tensor]) -> bool:
    gain_s = GAINED_PER_QUERY_S * len(query) * len(clouds) + GAINED_PER_POINT_S * sum(map(len, clouds))
    if query.dtype == torch.float64 or gain_s < LEAST_GAIN_S:  # packets are for float32
        return False
    lost_s = sum(_lost_s(query, cloud) for cloud in clouds)
    if lost_s > LOST_PER_QUERY_S * len(query) * len(clouds) + LOST_PER_POINT_S * sum(map(len, clouds)):
        return False
    return _works("packets", query.device, "the KD-tree searches")


def _lost_s(query: Tensor, points: Tensor) -> float:
    """What packets lose to the KD-tree where points lie on a line or in a plane along the axes, and queries do not."""
    if len(query) == 0 or len(points) == 0:
        return 0.0
    (low, high), (least, most) = (
        cloud.detach()[:: max(1, len(cloud) // SAMPLE)].double().aminmax(dim=0) for cloud in (query, points)
    )
    asked, extent = high - low, most - least
    flat = (extent <= FLAT_SHARE * asked) & (asked > 0)
    if not flat.any():
        return 0.0
    spread = asked[asked > 0]
    packet = (PACKET / len(query) * spread.prod()) ** (1 / len(spread))
    # What is as near to one query of a packet as to another, seen from half of the way to the farthest point.
    away = torch.maximum(most - low, high - least)[flat].norm() / 2
    reach = packet + (2 * away * packet).sqrt()
    near = len(points) * (reach / extent[~flat]).clamp(max=1).prod()
    return float(NEAR_S * len(query) * near)


def _search_of(backend: str) -> Search:
    search: Search = import_module(BACKENDS[backend]).search
    return search


def _on_the_cpu(query: Tensor, points: Tensor) -> Search:
    return _search_of("packets" if _packets_pay(query, [points]) else "kdtree")


def _on_a_device(query: Tensor, points: Tensor) -> Search:
    if query.device.type == "cuda" and _works("warp", query.device, "all pairs are compared, or the CPU searches"):
        return _search_of("warp")
    if len(query) * len(points) <= MAX_PAIRS_ON_THE_DEVICE:
        return _search_of("cdist")
    _say_that_the_cpu_searches(query.device)
    return _through_the_cpu


def _through_the_cpu(query: Tensor, points: Tensor, max_distance: float, memory_mb: float) -> Tensor:
    there, cloud = query.cpu(), points.cpu()
    return _on_the_cpu(there, cloud)(there, cloud, max_distance, memory_mb).to(query.device)


@lru_cache
def _say_that_the_cpu_searches(device: torch.device) -> None:
    faster = f"; faster still: {INSTALL['warp']}" if device.type == "cuda" else ""
    warnings.warn(
        f"nearest: clouds on {device} with more than {MAX_PAIRS_ON_THE_DEVICE:,} pairs are searched on the CPU, which "
        f"is faster than to compare them all{faster}",
        stacklevel=2,
    )


@lru_cache
def _works(backend: str, device: torch.device, instead: str) -> bool:
    """Whether a backend finds a point here; says once what is used instead."""
    try:
        point = torch.zeros(1, 3, device=device)
        _search_of(backend)(point, point, 1.0, 1.0)
    except ModuleNotFoundError as error:
        log.info("nearest: %s; %s is faster: %s (%s)", instead, backend, INSTALL[backend], error)
        return False
    except Exception as error:  # whatever a broken compiler raises: the others are as exact
        warnings.warn(
            f"nearest: {instead}, as backend {backend!r} does not work here: {_first_line(error)}", stacklevel=2
        )
        return False
    return True


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0] or type(error).__name__
