"""Devices without float64, such as Apple's GPUs (MPS): what needs it is computed on the CPU."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

ParamsT = ParamSpec("ParamsT")
ResultT = TypeVar("ResultT")


def has_float64(device: torch.device) -> bool:
    """Whether tensors of float64 can be on a device.

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
    """Run a function on the CPU where an argument is on a device without float64.

    Tensors among the arguments and the results, also within tuples, lists and mappings, are moved there and back;
    results of float64 become float32.
    """

    @wraps(function)
    def run(*args: ParamsT.args, **kwargs: ParamsT.kwargs) -> ResultT:
        devices = [tensor.device for tensor in _tensors_in((*args, *kwargs.values()))]
        narrow = [device for device in devices if not has_float64(device)]
        if not narrow:
            return function(*args, **kwargs)
        result = function(*map_tensors(args, Tensor.cpu), **map_tensors(kwargs, Tensor.cpu))
        return map_tensors(result, lambda tensor: move_tensor(tensor, narrow[0]))  # type: ignore[no-any-return]

    return run


def move_tensor(value: Tensor, device: torch.device | str) -> Tensor:
    """Move a tensor to a device; as float32 if it is of float64, which that device lacks."""
    is_too_wide = value.dtype == torch.float64 and not has_float64(torch.device(device))
    return (value.float() if is_too_wide else value).to(device)


def ensure_float64(tensor: Tensor) -> Tensor:
    """The tensor itself, or on the CPU if its device has no float64."""
    return tensor if has_float64(tensor.device) else tensor.cpu()


def _tensors_in(values: Iterable[Any]) -> Iterator[Tensor]:
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, list | tuple):
            yield from _tensors_in(value)
        elif isinstance(value, Mapping):
            yield from _tensors_in(value.values())


def map_tensors(value: Any, function: Callable[[Tensor], Tensor]) -> Any:  # noqa: ANN401
    """Change the tensors within tuples, lists and mappings."""
    if isinstance(value, Tensor):
        return function(value)
    if isinstance(value, Mapping):
        return {name: map_tensors(entry, function) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        entries = [map_tensors(entry, function) for entry in value]
        return type(value)(*entries) if hasattr(value, "_fields") else type(value)(entries)
    return value
