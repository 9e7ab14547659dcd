"""Nearest-neighbor queries and the blind spot radius: input checks, scaling, distances and gradients."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchcover.devices import run_with_float64
from torchcover.neighbors.backend_choice import choose_search


class NearestPoints(NamedTuple):
    """Result of `nearest`.

    Args:
        distance: (N,) distance to the nearest point in meters; inf where no point is within reach.
        index: (N,) int64 index of that point; -1 where no point is within reach.
    """

    distance: Tensor
    index: Tensor  # type: ignore[assignment]  # hides tuple.index, as torch.return_types do


def blind_spot_radius(
    sensor: Tensor,
    reference: Tensor,
    *,
    max_radius: float = math.inf,
    backend: str = "auto",
    memory_mb: float = 256.0,
) -> Tensor:
    """Compute the radius of the largest ball around each reference point that contains no sensor point.

    r(q) = min over p in sensor of ||q - p||  (Uecker & Zöllner 2024, section III).

    Args:
        sensor: (N, 3) points of the rig in meters. Do not crop them to the region of interest: the nearest point may
            lie outside.
        reference: (M, 3) points of the reference sensor in meters, in the same frame.
        max_radius: Radius in meters at which the result saturates; a finite value makes the search faster. An empty
            `sensor` gives `max_radius` everywhere, since a rig without points is blind.
        backend: Search backend, see `nearest`.
        memory_mb: Memory limit in megabytes, see `nearest`.

    Returns:
        (M,) radius in meters, differentiable in both clouds where it is below `max_radius`.

    Raises:
        ValueError: As in `nearest`.
        TypeError: As in `nearest`.

    Example:
        >>> reference = torch.tensor([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]])
        >>> blind_spot_radius(torch.zeros(1, 3), reference)
        tensor([0., 5.])
    """
    distance = _search_nearest(reference, sensor, max_radius, backend, memory_mb, ("reference", "sensor")).distance
    return distance.clamp(max=distance.new_tensor(max_radius))


def nearest(
    query: Tensor,
    points: Tensor,
    *,
    max_distance: float = math.inf,
    backend: str = "auto",
    memory_mb: float = 256.0,
) -> NearestPoints:
    """Find the nearest point of each query and its distance; the result is exact.

    The backend finds the index. The distance is then computed from the coordinate differences in float64 and rounded
    once, so backends agree to the last bits, and gradients flow to both inputs whichever backend was used.

    * Ties: the index is that of any point at the same distance and may depend on the backend; the distance does not.
      "packets" and "warp" return the smallest index among points at the same distance in the type of the search.
    * `max_distance` is inclusive and compared after rounding to the type of the distance.
    * float16 and bfloat16 coordinates are converted to float32 (exactly), mixed types to the wider one.
    * At distance 0 the gradient is defined as 0.
    * Any finite coordinates are allowed; a distance beyond the range of the type is inf. Differences whose squares
      underflow count as ties: below 1e-19 in float32, 1e-154 in float64 (times the largest coordinate where that
      exceeds 1e77).

    Args:
        query: (N, 3) floating-point coordinates in meters, any strides, any device.
        points: (M, 3) floating-point coordinates on the same device. M = 0 is allowed.
        max_distance: Largest distance in meters that counts. A finite value makes the search faster.
        backend: "cdist" (any device), "kdtree" (CPU), "packets" (CPU, float32; needs `torchcover[fast]`; wider types
            use the KD-tree), "warp" (CUDA, and slowly CPU; needs `torchcover[warp]`) or "auto" (by device, type and
            size; packets and Warp only if they are installed).
        memory_mb: Largest memory in megabytes that "cdist" uses for compared pairs, in addition to a few arrays as
            long as the clouds.

    Returns:
        (N,) distances (float32 or float64) and (N,) int64 indices; inf and -1 where no point is within
        `max_distance`.

    Raises:
        ValueError: A shape other than (N, 3); NaN or infinite coordinates; two devices; a negative or NaN
            `max_distance`; an unknown backend, or one for other devices than that of the tensors.
        TypeError: An input is not a tensor of a floating-point type.
        ImportError: "packets" without numba, "warp" without Warp, or a library that does not work.
        MemoryError: The memory of a GPU is too small, even for a few queries at a time.

    Example:
        >>> points = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
        >>> nearest(torch.tensor([[0.9, 0.0, 0.0], [9.0, 0.0, 0.0]]), points, max_distance=1.0)
        NearestPoints(distance=tensor([0.1000,    inf]), index=tensor([ 1, -1]))
    """
    return _search_nearest(query, points, max_distance, backend, memory_mb, ("query", "points"))


@run_with_float64
def _search_nearest(
    query: Tensor, points: Tensor, max_distance: float, backend: str, memory_mb: float, names: tuple[str, str]
) -> NearestPoints:
    for cloud, name in zip((query, points), names, strict=True):
        check_shape(cloud, name)
    query, points = _convert_to_common_type(query, points, max_distance, memory_mb)
    # A custom operator costs 30 us per call and a second for the first call: only traces and transforms use it.
    is_traced = torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active()
    search = _find_indices_operator if is_traced else _find_indices
    index = search(query.detach(), points.detach(), max_distance, backend, memory_mb, *names)
    return _measure_distance(query, points, index, max_distance)


def _find_indices(
    query: Tensor,
    points: Tensor,
    max_distance: float,
    backend: str,
    memory_mb: float,
    query_name: str,
    points_name: str,
) -> Tensor:
    """Search clouds of one type and device, without gradients.

    Args:
        query: (N, 3) coordinates.
        points: (M, 3) coordinates.
        max_distance: Largest distance in meters that counts.
        backend: Search backend, see `nearest`.
        memory_mb: Memory limit in megabytes, see `nearest`.
        query_name: Name of `query` in messages.
        points_name: Name of `points` in messages.

    Returns:
        (N,) int64 index of the nearest point; -1, or the index of any point, where none is within `max_distance`.
    """
    check_finite(query, query_name)
    check_finite(points, points_name)
    search = choose_search(query, points, backend)
    if len(query) == 0 or len(points) == 0:
        return torch.full((len(query),), -1, dtype=torch.int64, device=query.device)

    def search_chunk(query: Tensor, memory_mb: float) -> Tensor:
        # Autocast is made for networks: no coordinate may be rounded to bfloat16.
        with torch.no_grad(), torch.autocast(query.device.type, enabled=False):
            scaled_query, scaled_points, bound = _rescale(query, points, max_distance)
            # A search compares squares in its own type, `_measure_distance` the differences. The bound is therefore
            # slightly larger, and its square must not underflow: a bound of 0 still finds a point at distance 0.
            reach = max(bound * (1 + 1e-5), 2 * math.sqrt(torch.finfo(scaled_query.dtype).tiny))
            return search(scaled_query, scaled_points, reach, memory_mb)

    return _search_in_chunks_that_fit(search_chunk, query, points, memory_mb)


# `_find_indices` as one opaque step of torch.compile, torch.func and vmap.
_find_indices_operator = torch.library.custom_op("torchcover::find_indices", _find_indices, mutates_args=())


@_find_indices_operator.register_fake
def _(query: Tensor, points: Tensor, *_: object) -> Tensor:
    return query.new_empty(query.shape[0], dtype=torch.int64)


@_find_indices_operator.register_vmap
def _(info: Any, in_dims: Any, query: Tensor, points: Tensor, *options: Any) -> tuple[Tensor, int]:  # noqa: ANN401
    batches = []
    for cloud, batch_dim in zip((query, points), in_dims, strict=False):
        batches.append([cloud] * info.batch_size if batch_dim is None else cloud.unbind(batch_dim))
    return torch.stack([_find_indices_operator(*pair, *options) for pair in zip(*batches, strict=True)]), 0


def _search_in_chunks_that_fit(
    search_chunk: Callable[[Tensor, float], Tensor], query: Tensor, points: Tensor, memory_mb: float
) -> Tensor:
    """Search all queries at once, or in chunks that fit the memory of the device."""
    min_chunk_size = 1024  # smaller chunks save hardly any memory on a GPU
    chunk_size = max(1, len(query))
    while True:
        try:
            return torch.cat([search_chunk(chunk, memory_mb) for chunk in torch.split(query, chunk_size)])
        except torch.cuda.OutOfMemoryError as error:
            # Only the text is stored: the traceback of the error keeps tensors alive.
            reason = str(error).partition("\n")[0]
        if chunk_size <= min_chunk_size:
            raise MemoryError(
                f"{query.device}: not enough memory to search {len(points):,} points for {len(query):,} queries, "
                f"{chunk_size:,} at a time: {reason}"
            )
        chunk_size, memory_mb = -(-chunk_size // 2), memory_mb / 2


def _convert_to_common_type(
    query: Tensor, points: Tensor, max_distance: float, memory_mb: float
) -> tuple[Tensor, Tensor]:
    """Check devices and limits, and convert both clouds to the wider of their types, float32 at least."""
    if query.device != points.device:
        raise ValueError(f"the clouds are on {query.device} and on {points.device}; move them to one device")
    if not max_distance >= 0:
        raise ValueError(f"max_distance (max_radius): a distance >= 0 is needed; got {max_distance}")
    if not memory_mb > 0:
        raise ValueError(f"memory_mb: a positive number of megabytes is needed; got {memory_mb}")
    common = torch.promote_types(torch.promote_types(query.dtype, points.dtype), torch.float32)
    return query.to(common), points.to(common)


def _rescale(query: Tensor, points: Tensor, max_distance: float) -> tuple[Tensor, Tensor, float]:
    """Convert or scale coordinates by a power of two so that their squares neither overflow nor underflow."""
    bounds = [*query.aminmax(), *points.aminmax()]
    largest = float(torch.stack(bounds).abs().amax())
    limit = float(torch.finfo(query.dtype).max) ** 0.25
    if largest == 0.0 or 1 / limit < largest < limit:
        return query, points, max_distance
    if query.dtype == torch.float32:  # the square of any float32 fits float64
        return query.double(), points.double(), max_distance
    exponent = -math.frexp(largest)[1]
    # Two factors: 2^exponent itself may lie outside the range of the type when the coordinates are subnormal.
    first_factor = 2.0 ** (exponent // 2)
    second_factor = 2.0 ** (exponent - exponent // 2)
    scaled_query, scaled_points = query * first_factor * second_factor, points * first_factor * second_factor
    return scaled_query, scaled_points, max_distance * first_factor * second_factor


def _measure_distance(query: Tensor, points: Tensor, index: Tensor, max_distance: float) -> NearestPoints:
    """Compute distances from coordinate differences in float64, and mask points beyond `max_distance`."""
    if len(points) == 0:
        return NearestPoints(query.new_full((len(query),), math.inf), index)
    # Squares of float32 differences always fit float64; only float64 input can need scaling.
    compute_norm = _compute_scaled_norm if query.dtype == torch.float64 else _compute_norm
    # Chunks of this size stay in the cache of a CPU; a GPU takes all points at once, and a trace cannot count chunks.
    is_chunked = query.device.type == "cpu" and not torch.compiler.is_compiling()
    chunk_size = 32_768 if is_chunked else max(1, len(query))
    distances = []
    index_chunks = torch.split(index.clamp(min=0), chunk_size)
    for query_chunk, index_chunk in zip(torch.split(query, chunk_size), index_chunks, strict=True):
        difference = query_chunk.double() - points.index_select(0, index_chunk).double()
        distances.append(compute_norm(difference).to(query.dtype))
    distance = torch.cat(distances)
    is_within = (index >= 0) & (distance.detach() <= distance.new_tensor(max_distance))
    return NearestPoints(distance.where(is_within, math.inf), index.where(is_within, -1))


def _compute_norm(difference: Tensor) -> Tensor:
    """Compute the Euclidean norm of (N, 3) rows, whose gradient torch defines as 0 at 0."""
    norm: Tensor = torch.linalg.vector_norm(difference, dim=1)
    return norm


def _compute_scaled_norm(difference: Tensor) -> Tensor:
    """Compute the norm without overflow or underflow: rows are scaled by their largest entry where needed."""
    largest = difference.detach().abs().amax(dim=1)
    scale = largest.clamp(max=torch.finfo(torch.float64).max)
    scale = scale.where(((scale < 1e-140) | (scale > 1e140)) & (scale > 0), 1.0)
    return _compute_norm(difference / scale[:, None]) * scale


def check_tensor(value: object, name: str, *, is_floating: bool = False) -> None:
    """Raise unless a value is a tensor.

    Args:
        value: Value to be checked.
        name: Name of the value in messages.
        is_floating: Require a floating-point type.

    Raises:
        TypeError: The value is no such tensor; for a NumPy array the message shows the conversion.

    Example:
        >>> check_tensor(np.zeros((2, 3)), "sensor")
        Traceback (most recent call last):
        TypeError: sensor: a torch tensor is needed; got a NumPy array of float64; torch.from_numpy(array) makes it one
    """
    if isinstance(value, Tensor) and (value.is_floating_point() or not is_floating):
        return
    wanted = "a floating-point torch tensor" if is_floating else "a torch tensor"
    if isinstance(value, np.ndarray):
        conversion = "torch.from_numpy(array)" + (".float()" if is_floating and value.dtype.kind != "f" else "")
        raise TypeError(f"{name}: {wanted} is needed; got a NumPy array of {value.dtype}; {conversion} makes it one")
    arrived = value.dtype if isinstance(value, Tensor) else type(value).__name__
    raise TypeError(f"{name}: {wanted} is needed; got {arrived}")


def check_weights(weights: Tensor | None, num_points: int, name: str) -> None:
    """Raise unless weights are missing, or are one finite, positive number per reference point.

    Args:
        weights: (M,) weights, or None.
        num_points: Number M of reference points.
        name: Name of the weights in messages.

    Raises:
        TypeError: Not a tensor.
        ValueError: Another shape, or a weight that is not finite and positive.
    """
    if weights is None:
        return
    check_tensor(weights, name)
    if weights.shape != (num_points,):
        raise ValueError(
            f"{name}: shape ({num_points},), one for each reference point, is needed; got {tuple(weights.shape)}"
        )
    if not bool((weights.isfinite() & (weights > 0)).all()):
        raise ValueError(f"{name}: finite weights > 0 are needed")


def check_cloud(cloud: Tensor, name: str) -> None:
    """Raise unless a cloud is a floating-point tensor of shape (N, 3) with finite coordinates.

    Args:
        cloud: Tensor to be checked.
        name: Name of the cloud in messages.

    Raises:
        TypeError: Not a tensor of a floating-point type.
        ValueError: Another shape, or NaN or infinite coordinates; the message counts the points concerned.
    """
    check_shape(cloud, name)
    check_finite(cloud, name)


def check_shape(cloud: Tensor, name: str) -> None:
    """Raise unless a cloud is a floating-point tensor of shape (N, 3); coordinates are not read.

    Args:
        cloud: Tensor to be checked.
        name: Name of the cloud in messages.
    """
    check_tensor(cloud, name, is_floating=True)
    if cloud.ndim != 2 or cloud.shape[1] != 3:
        raise ValueError(f"{name}: shape (N, 3) is needed; got {tuple(cloud.shape)}")


def check_finite(cloud: Tensor, name: str) -> None:
    """Raise if coordinates of a cloud are NaN or infinite.

    Args:
        cloud: (N, 3) coordinates.
        name: Name of the cloud in messages.
    """
    # A sum is finite only if all its terms are; only a sum that is not finite needs a check of each term.
    if not cloud.detach().sum().isfinite() and not cloud.isfinite().all():
        num_bad = int((~cloud.detach().isfinite()).any(dim=1).sum())
        raise ValueError(f"{name}: {num_bad} of {len(cloud)} points have NaN or infinite coordinates; drop them first")
