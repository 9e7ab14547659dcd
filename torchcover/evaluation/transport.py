"""Observers on the way from one process of a run to another: most of their cells are empty, and stay behind."""

import io
import pickle
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcover.evaluation.sparse_words import Words, spread, words_of


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


def _tensor(words: Words, dtype: str, shape: tuple[int, ...]) -> Tensor:
    return torch.from_numpy(spread(words, np.dtype(dtype), shape))
