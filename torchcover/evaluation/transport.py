"""Sums on their way to a file or to another process: most of them are zero, and stay behind; the rest to the bit."""

import io
import math
import pickle
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

# Zeros are left out where they are this share at least: a place takes up to as much room as a value.
MIN_ZEROS = 0.5
_WORDS = {1: np.uint8, 2: np.uint16, 4: np.uint32, 8: np.uint64}


class Bits(NamedTuple):
    """The bits of an array.

    Args:
        words: (N,) unsigned integers of the size of its elements.
        at: (N,) where they are in the flat array; None if they are all of it.
    """

    words: NDArray[Any]
    at: NDArray[Any] | None


def words_of(array: NDArray[Any]) -> Bits:
    """The bits of an array of real numbers or truth values.

    Example:
        >>> words_of(np.array([[0.0, 0.0], [0.0, -0.0]])).at  # minus zero is not zero
        array([3], dtype=uint32)
    """
    words = np.ascontiguousarray(array).view(_WORDS[array.itemsize]).reshape(-1)
    if words.size - np.count_nonzero(words) < MIN_ZEROS * words.size:
        return Bits(words, None)
    at = np.flatnonzero(words)
    return Bits(words[at], at.astype(np.uint32 if words.size < 2**32 else np.uint64))


def spread(words: Bits, dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """The array again.

    Raises:
        ValueError: Words that do not fit into this shape.
        IndexError: Likewise.
    """
    flat = words.words
    if words.at is not None:
        flat = np.zeros(math.prod(shape), words.words.dtype)
        flat[words.at] = words.words
    array: NDArray[Any] = flat.view(dtype).reshape(shape)
    return array


def packed(value: object) -> Tensor:
    """(N,) uint8: any object that can be pickled, its tensors on the CPU and without the zeros."""
    stream = io.BytesIO()
    _Pickler(stream, protocol=pickle.HIGHEST_PROTOCOL).dump(value)
    return torch.frombuffer(stream.getbuffer(), dtype=torch.uint8)


def unpacked(data: Tensor) -> Any:  # noqa: ANN401  (whatever was packed)
    """The object, as a process of the same run has packed it; nobody else's may be given to it."""
    return pickle.loads(data.numpy().data)


class _Pickler(pickle.Pickler):
    def reducer_override(self, value: Any) -> Any:  # noqa: ANN401  (as pickle has it)
        if (
            type(value) is Tensor
            and value.layout is torch.strided
            and value.is_contiguous()
            and not value.requires_grad
        ):
            try:
                array = value.cpu().numpy()
            except TypeError:  # a type that NumPy has not
                return NotImplemented
            return _tensor, (words_of(array), array.dtype.str, tuple(value.shape))
        return NotImplemented


def _tensor(words: Bits, dtype: str, shape: tuple[int, ...]) -> Tensor:
    return torch.from_numpy(spread(words, np.dtype(dtype), shape))
