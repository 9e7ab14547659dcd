"""Choice of the search backend by device, type and size of the clouds."""

import logging
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib import import_module

import torch
from torch import Tensor

# Module of each backend; it is imported at first use, so that an unused library costs nothing.
BACKENDS = {
    "cdist": "torchcover.neighbors.cdist",
    "kdtree": "torchcover.neighbors.kdtree",
    "packets": "torchcover.neighbors.packets",
    "warp": "torchcover.neighbors.warp",
}
# Device types of each backend; backends that are missing here run on any device.
DEVICE_TYPES = {"kdtree": ("cpu",), "packets": ("cpu",), "warp": ("cpu", "cuda")}
# Commands that install optional libraries.
INSTALL = {"packets": "pip install 'torchcover[fast]'", "warp": "pip install 'torchcover[warp]'"}

Search = Callable[[Tensor, Tensor, float, float], Tensor]
log = logging.getLogger("torchcover")


@dataclass(frozen=True)
class BackendParams:
    """Cost model of the choice between backends, measured in docs/measured/speed.md and docs/measured/gpu.md.

    Packets are faster than the KD-tree for nearly all clouds, but loading numba takes each process half a second,
    which about a hundred calls should save. The choice depends on the clouds alone: a choice by earlier searches would
    change the last bits of a run with its number of workers.

    If points are flat along an axis, so are the boxes of the KD-tree, while a packet compares all its queries with all
    points near any of them. In practice packets gain more than the model counts, and lose only beyond
    `max_loss_per_query_s` and `max_loss_per_point_s`.

    Args:
        gain_per_query_s: Time that packets save per query, at least.
        gain_per_point_s: Time that packets save per point, at least.
        min_gain_s: Saved time per call from which packets are used.
        flat_ratio: Largest ratio of the extents of points and queries along an axis at which the points count as flat.
        time_per_pair_s: Time to compare a query of a packet with a point near the packet.
        max_loss_per_query_s: Lost time per query up to which packets are used.
        max_loss_per_point_s: Lost time per point up to which packets are used.
        packet_size: Queries per packet.
        sample_size: Number of points from which the extent of a cloud is estimated.
        max_device_pairs: Pairs of a query and a point up to which a device without Warp compares them all. An H200
            needs 14 ms for 1e9 pairs, as long as 16 CPU cores need to search.
    """

    gain_per_query_s: float = 3e-7
    gain_per_point_s: float = 8e-9
    min_gain_s: float = 5e-3
    flat_ratio: float = 1e-3
    time_per_pair_s: float = 6e-11
    max_loss_per_query_s: float = 2e-7
    max_loss_per_point_s: float = 4e-8
    packet_size: int = 64
    sample_size: int = 1024
    max_device_pairs: int = 10**9


def choose_search(query: Tensor, points: Tensor, backend: str, params: BackendParams = BackendParams()) -> Search:
    """Return the search function of a backend.

    Args:
        query: (N, 3) query coordinates.
        points: (M, 3) point coordinates on the same device.
        backend: A name in `BACKENDS`, or "auto".
        params: Cost model of "auto".

    Raises:
        ValueError: The backend is unknown, or runs on other devices than that of the clouds.
        ImportError: The library of a named backend is missing or does not work.
    """
    on_cpu = query.device.type == "cpu"
    if backend == "auto":
        return _choose_on_cpu(query, points, params) if on_cpu else _choose_on_device(query, points, params)
    if backend not in BACKENDS:
        raise ValueError(f"backend: one of {', '.join(['auto', *BACKENDS])} is needed; got {backend!r}")
    device_types = DEVICE_TYPES.get(backend)
    if device_types and query.device.type not in device_types:
        raise ValueError(
            f"backend {backend!r} runs on {' and '.join(device_types)}; the clouds are on {query.device}: use 'cdist' "
            "or 'auto'"
        )
    try:
        return _load_search(backend)
    except ModuleNotFoundError:  # its message names the package to install
        raise
    except Exception as error:  # a broken compiler may raise anything
        raise ImportError(
            f"backend {backend!r} does not work here ({_get_first_line(error)}); try 'auto', or reinstall it: "
            f"{INSTALL.get(backend, 'pip install torchcover')}"
        ) from error


def choose_shared_backend(query: Tensor, clouds: Sequence[Tensor], params: BackendParams = BackendParams()) -> str:
    """Choose one backend for the same queries in several clouds, by the total cost.

    Args:
        query: (N, 3) query coordinates.
        clouds: (M, 3) coordinates of each cloud.
        params: Cost model.

    Returns:
        A value for the `backend` argument of `nearest`.
    """
    return "packets" if query.device.type == "cpu" and _should_use_packets(query, clouds, params) else "auto"


def _should_use_packets(query: Tensor, clouds: Sequence[Tensor], params: BackendParams) -> bool:
    num_searches, num_points = len(query) * len(clouds), sum(map(len, clouds))
    gain_s = params.gain_per_query_s * num_searches + params.gain_per_point_s * num_points
    if query.dtype == torch.float64 or gain_s < params.min_gain_s:  # packets are made for float32
        return False
    loss_s = sum(_estimate_packet_loss_s(query, cloud, params) for cloud in clouds)
    if loss_s > params.max_loss_per_query_s * num_searches + params.max_loss_per_point_s * num_points:
        return False
    return _can_search("packets", query.device, "the KD-tree searches")


def _estimate_packet_loss_s(query: Tensor, points: Tensor, params: BackendParams = BackendParams()) -> float:
    """Estimate the time that packets lose to the KD-tree if only the points lie on an axis-aligned line or plane."""
    if len(query) == 0 or len(points) == 0:
        return 0.0
    query_low, query_high = _estimate_bounds(query, params.sample_size)
    points_low, points_high = _estimate_bounds(points, params.sample_size)
    query_extent, points_extent = query_high - query_low, points_high - points_low
    is_flat = (points_extent <= params.flat_ratio * query_extent) & (query_extent > 0)
    if not is_flat.any():
        return 0.0
    spread = query_extent[query_extent > 0]
    packet_extent = (params.packet_size / len(query) * spread.prod()) ** (1 / len(spread))
    # Points that are as near to one query of a packet as to another one, at half of the largest distance.
    distance = torch.maximum(points_high - query_low, query_high - points_low)[is_flat].norm() / 2
    reach = packet_extent + (2 * distance * packet_extent).sqrt()
    num_near_points = len(points) * (reach / points_extent[~is_flat]).clamp(max=1).prod()
    return float(params.time_per_pair_s * len(query) * num_near_points)


def _estimate_bounds(cloud: Tensor, sample_size: int) -> tuple[Tensor, Tensor]:
    low, high = cloud.detach()[:: max(1, len(cloud) // sample_size)].double().aminmax(dim=0)
    return low, high


def _load_search(backend: str) -> Search:
    search: Search = import_module(BACKENDS[backend]).search
    return search


def _choose_on_cpu(query: Tensor, points: Tensor, params: BackendParams) -> Search:
    return _load_search("packets" if _should_use_packets(query, [points], params) else "kdtree")


def _choose_on_device(query: Tensor, points: Tensor, params: BackendParams) -> Search:
    is_cuda = query.device.type == "cuda"
    if is_cuda and _can_search("warp", query.device, "all pairs are compared, or the CPU searches"):
        return _load_search("warp")
    if len(query) * len(points) <= params.max_device_pairs:
        return _load_search("cdist")
    _warn_about_cpu_search(query.device, params.max_device_pairs)
    return partial(_search_on_cpu, params=params)


def _search_on_cpu(
    query: Tensor, points: Tensor, max_distance: float, memory_mb: float, params: BackendParams
) -> Tensor:
    """Search nearest neighbors on the CPU by the fastest implementation, and return the result to the device."""
    cpu_query, cpu_points = query.cpu(), points.cpu()
    search = _choose_on_cpu(cpu_query, cpu_points, params)
    return search(cpu_query, cpu_points, max_distance, memory_mb).to(query.device)


@lru_cache
def _warn_about_cpu_search(device: torch.device, max_device_pairs: int) -> None:
    advice = f"; faster still: {INSTALL['warp']}" if device.type == "cuda" else ""
    warnings.warn(
        f"nearest: clouds on {device} with more than {max_device_pairs:,} pairs are searched on the CPU, which is "
        f"faster than comparing all pairs{advice}",
        stacklevel=2,
    )


@lru_cache
def _can_search(backend: str, device: torch.device, fallback: str) -> bool:
    """Test once whether a backend finds a point on a device, and report the fallback if it does not."""
    try:
        point = torch.zeros(1, 3, device=device)
        _load_search(backend)(point, point, 1.0, 1.0)
    except ModuleNotFoundError as error:
        log.info("nearest: %s; %s is faster: %s (%s)", fallback, backend, INSTALL[backend], error)
        return False
    except Exception as error:  # a broken compiler may raise anything, and the other backends are as exact
        warnings.warn(
            f"nearest: {fallback}, as backend {backend!r} does not work here: {_get_first_line(error)}", stacklevel=2
        )
        return False
    return True


def _get_first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0] or type(error).__name__
