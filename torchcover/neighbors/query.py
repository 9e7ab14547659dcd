"""The blind spot radius, the exact nearest-neighbour search beneath it, and what clouds have to be for both."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchcover.devices import run_with_float64
from torchcover.neighbors.choice import choose_search

# Queries that are measured together on a CPU.
PART = 32_768
# Fewer queries than this at a time do not make much room on a GPU.
LEAST_PART = 1024


class NearestPoints(NamedTuple):
    """Result of `nearest`: `distance` (N,) and `index` (N,) int64; inf and -1 where no point is within reach."""

    distance: Tensor
    index: Tensor  # type: ignore[assignment]  # hides tuple.index, as torch.return_types do


def blind_spot_radius(
    reference: Tensor,
    sensor: Tensor,
    *,
    max_radius: float = math.inf,
    backend: str = "auto",
    memory_mb: float = 256.0,
) -> Tensor:
    """Radius of the largest ball around each reference point that holds no sensor point.

    r(q) = min over p in sensor of ||q - p||  (Uecker & Zöllner 2024, section III).

    Args:
        reference: (N, 3) points of the reference sensor in metres.
        sensor: (M, 3) points of the rig in metres, in the same frame. Never crop it to the region of interest: the
            nearest point may lie outside.
        max_radius: Saturation in metres. A search that ends there is faster. An empty `sensor` gives `max_radius`
            everywhere: a rig that saw nothing is blind.
        backend: As in `nearest`.
        memory_mb: As in `nearest`.

    Returns:
        (N,) radius in metres, differentiable in both clouds where it is below `max_radius`.

    Raises:
        ValueError: As `nearest`.
        TypeError: As `nearest`.

    Example:
        >>> reference = torch.tensor([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]])
        >>> blind_spot_radius(reference, torch.zeros(1, 3))
        tensor([0., 5.])
    """
    distance = _nearest(reference, sensor, max_radius, backend, memory_mb, ("reference", "sensor")).distance
    return distance.clamp(max=distance.new_tensor(max_radius))


def nearest(
    query: Tensor,
    points: Tensor,
    *,
    max_distance: float = math.inf,
    backend: str = "auto",
    memory_mb: float = 256.0,
) -> NearestPoints:
    """Distance from each query to its nearest point, and the index of that point. Exact.

    The backend finds the index; the distance is then computed from the coordinate differences in float64 and rounded
    once. So backends agree to the last bits, and gradients flow to both inputs whichever backend was used.

    * Ties: any one of the points at the same distance; which one depends on the backend, the distance does not.
      "packets" and "warp" name the smallest index among those at the same distance in the type of the search.
    * `max_distance` is inclusive, and compared after rounding it to the type of the distance.
    * float16 and bfloat16 coordinates are widened to float32 (exactly), mixed types to the wider one.
    * At distance 0 the gradient is taken as 0.
    * Any finite coordinates are allowed; a distance beyond the type's range is inf. Differences whose squares vanish
      count as ties: below 1e-19 in float32, 1e-154 in float64 (times the largest coordinate where that is over 1e77).

    Args:
        query: (N, 3) floating-point coordinates, any strides, any device.
        points: (M, 3) floating-point coordinates on the same device. M = 0 is allowed.
        max_distance: Only points within this distance count. A finite value makes the search faster.
        backend: "cdist" (any device), "kdtree" (CPU), "packets" (CPU, float32; needs `torchcover[fast]`; wider types
            are left to the KD-tree), "warp" (CUDA, and slowly CPU; needs `torchcover[warp]`) or
            "auto" (by device, type and size; packets and Warp only where they are installed).
        memory_mb: Most memory in megabytes that "cdist" may use for the pairs under comparison, beside a few arrays as
            long as the clouds.

    Returns:
        `Nearest(distance, index)`: (N,) distances (float32 or float64) and (N,) int64 indices; inf and -1 where no
        point is within `max_distance`.

    Raises:
        ValueError: A shape other than (N, 3); NaN or infinite coordinates; two devices; a negative or NaN
            `max_distance`; an unknown backend, or one for other devices than that of the tensors.
        TypeError: An input is not a tensor of a floating-point type.
        ImportError: "packets" without numba, "warp" without Warp, or where these do not work.
        MemoryError: The memory of a GPU is too small, even for a few queries at a time.

    Example:
        >>> points = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
        >>> nearest(torch.tensor([[0.9, 0.0, 0.0], [9.0, 0.0, 0.0]]), points, max_distance=1.0)
        Nearest(distance=tensor([0.1000,    inf]), index=tensor([ 1, -1]))
    """
    return _nearest(query, points, max_distance, backend, memory_mb, ("query", "points"))


@run_with_float64
def _nearest(
    query: Tensor, points: Tensor, max_distance: float, backend: str, memory_mb: float, names: tuple[str, str]
) -> NearestPoints:
    for cloud, name in zip((query, points), names, strict=True):
        check_shape(cloud, name)
    query, points = _check_together(query, points, max_distance, memory_mb)
    # A custom operator costs 30 us a call, and a second at the first one: it is for traces and transforms only.
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
        max_distance: As in `nearest`, and so are the next two.
        backend: Likewise.
        memory_mb: Likewise.
        query_name: What messages call `query`.
        points_name: What messages call `points`.

    Returns:
        (N,) int64 index of the nearest point; -1, or the index of any point, where none is within `max_distance`.
    """
    check_finite(query, query_name)
    check_finite(points, points_name)
    search = choose_search(query, points, backend)
    if len(query) == 0 or len(points) == 0:
        return torch.full((len(query),), -1, dtype=torch.int64, device=query.device)

    def find(query: Tensor, memory_mb: float) -> Tensor:
        # Autocast is for networks: no coordinate may be rounded to bfloat16.
        with torch.no_grad(), torch.autocast(query.device.type, enabled=False):
            scaled, among, bound = _rescale(query, points, max_distance)
            # A search compares squares in its own type, `_measure_distance` the differences: the bound is a little
            # larger, but no so little that its square vanishes, for 0 still finds a point at distance 0.
            reach = max(bound * (1 + 1e-5), 2 * math.sqrt(torch.finfo(scaled.dtype).tiny))
            return search(scaled, among, reach, memory_mb)

    return _in_parts_that_fit(find, query, points, memory_mb)


# `_find_indices` as one opaque step of torch.compile, torch.func and vmap.
_find_indices_operator = torch.library.custom_op("torchcover::find_indices", _find_indices, mutates_args=())


@_find_indices_operator.register_fake
def _(query: Tensor, points: Tensor, *_: object) -> Tensor:
    return query.new_empty(query.shape[0], dtype=torch.int64)


@_find_indices_operator.register_vmap
def _(info: Any, in_dims: Any, query: Tensor, points: Tensor, *rest: Any) -> tuple[Tensor, int]:  # noqa: ANN401
    clouds = zip((query, points), in_dims, strict=False)
    batches = [[cloud] * info.batch_size if dim is None else cloud.unbind(dim) for cloud, dim in clouds]
    return torch.stack([_find_indices_operator(*pair, *rest) for pair in zip(*batches, strict=True)]), 0


def _in_parts_that_fit(
    find: Callable[[Tensor, float], Tensor], query: Tensor, points: Tensor, memory_mb: float
) -> Tensor:
    """All queries at once, or as many as there is memory for on the device."""
    part = max(1, len(query))
    while True:
        try:
            return torch.cat([find(some, memory_mb) for some in torch.split(query, part)])
        except torch.cuda.OutOfMemoryError as error:
            # Nothing of the error is kept, for its traceback holds on to the memory.
            said = str(error).partition("\n")[0]
        if part <= LEAST_PART:
            raise MemoryError(
                f"{query.device}: the search among {len(points):,} points for {len(query):,} queries, {part:,} at a "
                f"time: {said}"
            )
        part, memory_mb = -(-part // 2), memory_mb / 2


def _check_together(query: Tensor, points: Tensor, max_distance: float, memory_mb: float) -> tuple[Tensor, Tensor]:
    if query.device != points.device:
        raise ValueError(f"the clouds are on {query.device} and on {points.device}; move them to one device")
    if not max_distance >= 0:
        raise ValueError(f"max_distance (max_radius): a distance >= 0 is needed; got {max_distance}")
    if not memory_mb > 0:
        raise ValueError(f"memory_mb: a positive number of megabytes is needed; got {memory_mb}")
    common = torch.promote_types(torch.promote_types(query.dtype, points.dtype), torch.float32)
    return query.to(common), points.to(common)


def _rescale(query: Tensor, points: Tensor, max_distance: float) -> tuple[Tensor, Tensor, float]:
    """Keep squares of coordinates from overflowing or vanishing in the search: widen, else scale by a power of two."""
    bounds = [bound for cloud in (query, points) for bound in cloud.aminmax()]
    largest = float(torch.stack(bounds).abs().amax())
    limit = float(torch.finfo(query.dtype).max) ** 0.25
    if largest == 0.0 or 1 / limit < largest < limit:
        return query, points, max_distance
    if query.dtype == torch.float32:  # any square of it fits float64
        return query.double(), points.double(), max_distance
    scale = -math.frexp(largest)[1]
    # Two steps: 2^scale itself may lie outside the type's range when the coordinates are subnormal.
    half = 2.0 ** (scale // 2)
    rest = 2.0 ** (scale - scale // 2)
    return query * half * rest, points * half * rest, max_distance * half * rest


def _measure_distance(query: Tensor, points: Tensor, index: Tensor, max_distance: float) -> NearestPoints:
    """Measure from the differences, in float64; mask what is out of reach."""
    if len(points) == 0:
        return NearestPoints(query.new_full((len(query),), math.inf), index)
    # Squares of float32 differences always fit float64; only float64 input can need scaling.
    norm = _scaled_norm if query.dtype == torch.float64 else _norm
    # In parts that stay in the processor's cache; a GPU takes all at once, a trace knows no number of parts.
    in_parts = query.device.type == "cpu" and not torch.compiler.is_compiling()
    part = PART if in_parts else max(1, len(query))
    parts = zip(torch.split(query, part), torch.split(index.clamp(min=0), part), strict=True)
    distance = torch.cat([norm(q.double() - points.index_select(0, i).double()).to(query.dtype) for q, i in parts])
    within = (index >= 0) & (distance.detach() <= distance.new_tensor(max_distance))
    return NearestPoints(distance.where(within, math.inf), index.where(within, -1))


def _norm(difference: Tensor) -> Tensor:
    """Euclidean norm of (N, 3) rows, whose gradient torch defines as 0 at 0."""
    norm: Tensor = torch.linalg.vector_norm(difference, dim=1)
    return norm


def _scaled_norm(difference: Tensor) -> Tensor:
    """The same, without overflow or underflow of the squares: rows are scaled by their largest entry where needed."""
    largest = difference.detach().abs().amax(dim=1)
    scale = largest.clamp(max=torch.finfo(torch.float64).max)
    scale = scale.where(((scale < 1e-140) | (scale > 1e140)) & (scale > 0), 1.0)
    return _norm(difference / scale[:, None]) * scale


def check_tensor(value: object, name: str, *, is_floating: bool = False) -> None:
    """Raise unless what arrived, which the caller calls so, is a tensor, of a floating-point type if it has to be.

    Raises:
        TypeError: It is none; of an array of NumPy's the message says how it becomes one.

    Example:
        >>> check_tensor(np.zeros((2, 3)), "sensor")
        Traceback (most recent call last):
        TypeError: sensor: a torch tensor is needed; got a NumPy array of float64; torch.from_numpy(array) makes it one
    """
    if isinstance(value, Tensor) and (value.is_floating_point() or not is_floating):
        return
    wanted = "a floating-point torch tensor" if is_floating else "a torch tensor"
    if isinstance(value, np.ndarray):
        makes = "torch.from_numpy(array)" + (".float()" if is_floating and value.dtype.kind != "f" else "")
        raise TypeError(f"{name}: {wanted} is needed; got a NumPy array of {value.dtype}; {makes} makes it one")
    arrived = value.dtype if isinstance(value, Tensor) else type(value).__name__
    raise TypeError(f"{name}: {wanted} is needed; got {arrived}")


def check_weights(weights: Tensor | None, num_points: int, name: str) -> None:
    """Raise unless there are none, or positive, finite ones: one for each reference point."""
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
    """Raise unless `cloud` is a floating-point tensor of shape (N, 3) with finite coordinates.

    Raises:
        TypeError: Not a tensor of a floating-point type.
        ValueError: Another shape, or NaN or infinite coordinates (the message says how many points have them).
    """
    check_shape(cloud, name)
    check_finite(cloud, name)


def check_shape(cloud: Tensor, name: str) -> None:
    """Raise unless `cloud` is a floating-point tensor of shape (N, 3); looks at no coordinate."""
    check_tensor(cloud, name, is_floating=True)
    if cloud.ndim != 2 or cloud.shape[1] != 3:
        raise ValueError(f"{name}: shape (N, 3) is needed; got {tuple(cloud.shape)}")


def check_finite(cloud: Tensor, name: str) -> None:
    """Raise if coordinates of `cloud` are NaN or infinite."""
    # A sum is finite only if all its terms are; one that overflows is looked at term by term.
    if not cloud.detach().sum().isfinite() and not cloud.isfinite().all():
        bad = int((~cloud.detach().isfinite()).any(dim=1).sum())
        raise ValueError(f"{name}: {bad} of {len(cloud)} points have NaN or infinite coordinates; drop them first")
