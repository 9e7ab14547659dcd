"""Fallback to the CPU for devices without float64, such as Apple GPUs (MPS)."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial, wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

ParamsT = ParamSpec("ParamsT")
ResultT = TypeVar("ResultT")


def has_float64(device: torch.device) -> bool:
    """Return whether a device supports float64 tensors.

    Args:
        device: Device.

    Example:
        >>> has_float64(torch.device("cpu"))
        True
    """
    if device.type in ("cpu", "cuda", "meta"):
        return True
    try:
        torch.empty(0, dtype=torch.float64, device=device)
    except (TypeError, RuntimeError):
        return False
    return True


def run_with_float64(function: Callable[ParamsT, ResultT]) -> Callable[ParamsT, ResultT]:
    """Run a function on the CPU if an argument is on a device without float64.

    Tensors in arguments and results, also within tuples, lists and mappings, are moved to the CPU and back; float64
    results become float32.

    Args:
        function: Function that needs float64.
    """

    @wraps(function)
    def run(*args: ParamsT.args, **kwargs: ParamsT.kwargs) -> ResultT:
        for tensor in _iterate_tensors((*args, *kwargs.values())):
            if not has_float64(tensor.device):
                result = function(*map_tensors(args, Tensor.cpu), **map_tensors(kwargs, Tensor.cpu))
                return map_tensors(result, partial(move_tensor, device=tensor.device))  # type: ignore[no-any-return]
        return function(*args, **kwargs)

    return run


def move_tensor(value: Tensor, device: torch.device | str) -> Tensor:
    """Move a tensor to a device, as float32 if it is float64 and the device does not support it.

    Args:
        value: Tensor.
        device: Target device.
    """
    is_too_wide = value.dtype == torch.float64 and not has_float64(torch.device(device))
    return (value.float() if is_too_wide else value).to(device)


def ensure_float64(tensor: Tensor) -> Tensor:
    """Return the tensor, on the CPU if its device does not support float64.

    Args:
        tensor: Tensor of any dtype.
    """
    return tensor if has_float64(tensor.device) else tensor.cpu()


def _iterate_tensors(values: Iterable[Any]) -> Iterator[Tensor]:
    """Yield the tensors in values and in their lists and tuples."""
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, list | tuple):
            yield from _iterate_tensors(value)
        elif isinstance(value, Mapping):
            yield from _iterate_tensors(value.values())


def map_tensors(value: Any, function: Callable[[Tensor], Tensor]) -> Any:  # noqa: ANN401
    """Apply a function to all tensors within tuples, lists and mappings.

    Args:
        value: Tensor, container of tensors, or any other value, which is returned unchanged.
        function: Function from tensor to tensor.
    """
    if isinstance(value, Tensor):
        return function(value)
    if isinstance(value, Mapping):
        return {name: map_tensors(entry, function) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        entries = [map_tensors(entry, function) for entry in value]
        return type(value)(*entries) if hasattr(value, "_fields") else type(value)(entries)
    return value
