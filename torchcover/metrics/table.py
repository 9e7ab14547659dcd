"""Rows of numbers as the state of a metric: as many as there are, in an order that does not depend on their coming."""

import math

import numpy as np
import torch
from torch import Tensor

# What fills a table up to the length of another one; no row holds it.
FILLER = math.inf


def with_rows(table: Tensor, rows: Tensor) -> Tensor:
    """A table with some more rows, in ascending order: by the first column, then by the second, and so on.

    Args:
        table: (K, C) float64 finite rows in that order.
        rows: (N, C) more of them, in any order.

    Example:
        >>> with_rows(torch.tensor([[1.0, 5.0]]), torch.tensor([[1.0, 3.0], [0.0, 9.0]])).tolist()
        [[0.0, 9.0], [1.0, 3.0], [1.0, 5.0]]
    """
    both = torch.cat([table, rows.to(table)])
    order = np.lexsort(both.cpu().numpy().T[::-1])
    return both[torch.from_numpy(order).to(both.device)]


def filled(table: Tensor, length: int) -> Tensor:
    """The table, filled up to a length."""
    return torch.nn.functional.pad(table, (0, 0, 0, length - len(table)), value=FILLER)


def joined(tables: Tensor) -> Tensor:
    """One table from several, (parts, K, C), that were filled up to the same length."""
    rows = tables.flatten(0, 1)
    return with_rows(rows[:0], rows[rows[:, 0] != FILLER])
