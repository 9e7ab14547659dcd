"""Sums with a definition that are merged and loaded exactly, or refused; independent of torchmetrics."""

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor

from torchcover.devices import has_float64

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# First entry of the rows that pad a table; no other row has it.
PADDING = math.inf

Reduction = Callable[[Sequence[Tensor]], Tensor]


class MergeableSums:
    """Sums over frames, and the parameters that define them.

    * Two objects over different frames merge exactly: `merge_state`.
    * Sums with different definitions are never added: a fingerprint of class and parameters is part of the state.
    * States are copies: nothing that is loaded or merged is modified later.
    * On a device without float64 (MPS) the sums stay on the CPU, to which clouds are moved.

    A subclass passes its parameters to `__init__`, adds its states with `define_sum`, and counts `num_frames`. The size
    of a state is fixed; only a table (`define_table`) grows. With `MergeableMetric` before it in the bases it is a
    torchmetrics metric.

    Args:
        definition: Name and value of each parameter that the sums depend on; compared by `==` and `repr`.
        kwargs: Keyword arguments of the next base class.

    Example:
        >>> class Points(MergeableSums):
        ...     def __init__(self, above_m: float) -> None:
        ...         super().__init__({"above_m": above_m})
        ...         self.define_sum("points", (), torch.int64)
        ...     def update(self, cloud):
        ...         self.points += (cloud[:, 2] > self.definition["above_m"]).sum()
        ...         self.num_frames += 1
        ...     def compute(self):
        ...         return int(self.points)
        >>> low, high = Points(0.0), Points(1.0)
        >>> low.update(torch.ones(5, 3))
        >>> low.compute()
        5
        >>> high.merge_state(low)
        Traceback (most recent call last):
        ValueError: cannot merge metrics with different above_m: 1.0 and 0.0
    """

    fingerprint: Tensor
    num_frames: Tensor
    _defaults: dict[str, Any]

    def __init__(self, definition: Mapping[str, object], **kwargs: Any) -> None:  # noqa: ANN401
        self._defaults = {}
        super().__init__(**kwargs)
        self.definition = dict(definition)
        self._tables: dict[str, Reduction] = {}
        self._maxima: set[str] = set()
        # (32,) int64 numbers in [0, 256), equal for two metrics exactly if their definitions are equal.
        description = repr((type(self).__name__, sorted(self.definition.items())))
        fingerprint = torch.tensor(list(hashlib.sha256(description.encode()).digest()), device="cpu")
        self.define_state("fingerprint", fingerprint, "max")
        self.define_sum("num_frames", (), torch.int64)

    @torch.inference_mode(False)  # here and below: such a tensor cannot be changed outside of inference mode
    def define_state(self, name: str, default: Tensor, dist_reduce_fx: str | Callable[..., Tensor]) -> None:
        """Add a state.

        Args:
            name: Name of the state, an attribute from here on.
            default: Initial value. An expanded number takes the memory of one number.
            dist_reduce_fx: "sum", "max", or a function that merges the tables of all ranks.
        """
        if dist_reduce_fx == "max":
            self._maxima.add(name)
        if default.is_contiguous() or any(default.stride()):
            self._register_state(name, default.clone(), dist_reduce_fx)
            return
        number = default[(0,) * default.dim()].clone()
        self._register_state(name, number, dist_reduce_fx)
        if default.device.type == "cpu" and not number:  # such zeros take memory only once they are written to
            state = torch.from_numpy(np.zeros(default.shape, number.numpy().dtype))
        else:
            state = torch.empty_like(default, memory_format=torch.contiguous_format).fill_(number)
        setattr(self, name, state)
        self._defaults[name] = number.expand(default.shape)

    def _register_state(self, name: str, default: Tensor, dist_reduce_fx: object) -> None:
        self._defaults[name] = default
        setattr(self, name, default.clone())

    def define_sum(self, name: str, shape: tuple[int, ...], dtype: torch.dtype = torch.float64) -> None:
        """Add a state that is zero at first and adds up.

        Args:
            name: Name of the state, an attribute from here on.
            shape: Shape of the state.
            dtype: float64 or int64, since sums grow.
        """
        self.define_state(name, torch.zeros((), dtype=dtype, device="cpu").expand(shape), "sum")

    def define_table(self, name: str, num_columns: int, reduction: Reduction | None = None) -> None:
        """Add a float64 state of rows that begin with a finite number; it has no rows at first.

        Args:
            name: Name of the state, an attribute from here on.
            num_columns: Numbers per row.
            reduction: Function that merges several tables. By default all rows are kept, in the order of
                `torchcover.metrics.insert_rows`.
        """
        self._tables[name] = reduction or concat_tables
        empty = torch.empty((0, num_columns), dtype=torch.float64, device="cpu")
        self.define_state(name, empty, partial(_reduce_padded_tables, reduction=self._tables[name]))

    @property
    def device(self) -> torch.device:
        """Device of the sums."""
        return self.fingerprint.device

    @property
    def metric_state(self) -> dict[str, Any]:
        """States by name."""
        return {name: getattr(self, name) for name in self._defaults}

    @torch.inference_mode(False)
    def reset(self) -> None:
        """Remove all frames."""
        for name, default in self._defaults.items():
            setattr(self, name, default.clone().to(getattr(self, name).device))

    def to(self, device: torch.device | str) -> Self:
        """Move the sums to another device; they stay where they are if it has no float64.

        Args:
            device: Target device.
        """
        if has_float64(torch.device(device)):
            for name, state in self.metric_state.items():
                setattr(self, name, state.to(device))
        return self

    def state_dict(self) -> dict[str, Any]:
        """Return the states by name, for `load_state_dict`."""
        return self.metric_state

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Replace the sums by those of another object with the same parameters.

        Args:
            state_dict: States by name.

        Raises:
            ValueError: The states have other parameters, or are incomplete.
        """
        copies = self._copy_states(state_dict)
        for name, state in copies.items():
            setattr(self, name, state)
        self._handle_added_frames()

    @torch.inference_mode(False)
    def merge_state(self, incoming_state: Any) -> None:  # noqa: ANN401  (anything else is refused by name)
        """Add the frames of another metric with the same parameters; that metric does not change.

        Args:
            incoming_state: The other metric, or its `metric_state`.

        Raises:
            ValueError: Another class, other parameters, or an incomplete state.
        """
        if hasattr(incoming_state, "metric_state"):
            self._check_definition(incoming_state)
            incoming_state = incoming_state.metric_state
        if not isinstance(incoming_state, Mapping):
            raise ValueError(
                f"a {type(self).__name__} or its metric_state is needed; got {type(incoming_state).__name__}"
            )
        self._reduce_states(self._copy_states(incoming_state))
        self._handle_added_frames()

    def _reduce_states(self, incoming_state: dict[str, Any]) -> None:
        # `incoming_state` is a copy, here and in the `forward` of torchmetrics.
        self._align_with(incoming_state)
        for name in self._defaults:
            incoming, state = incoming_state[name], getattr(self, name)
            if name in self._tables:
                merged = self._tables[name]((state, incoming))
            else:
                merged = torch.maximum(incoming, state) if name in self._maxima else torch.add(incoming, state)
            setattr(self, name, merged)

    def _align_with(self, incoming: dict[str, Any]) -> None:
        """Convert this state and a copy of another one so that they can be added up."""

    def _align_ranks(self, gather: Callable[[Tensor], Sequence[Tensor]]) -> None:
        """Convert this state so that those of all ranks, which `gather` returns, can be added up."""

    def _check_definition(self, metric: object) -> None:
        if not isinstance(metric, MergeableSums) or type(metric) is not type(self):
            raise ValueError(f"cannot merge a {type(metric).__name__} into a {type(self).__name__}")
        for name, value in self.definition.items():
            if value != metric.definition.get(name):
                raise ValueError(
                    f"cannot merge metrics with different {name}: {value} and {metric.definition.get(name)}"
                )

    def _copy_states(self, states: Mapping[str, Tensor]) -> dict[str, Any]:
        """Copy the states of a metric with the same definition to this device and these types."""
        fingerprint = _get_stored_tensor(states.get("fingerprint"))
        if (
            fingerprint is None
            or fingerprint.shape != self.fingerprint.shape
            or not torch.equal(fingerprint.to(self.fingerprint), self.fingerprint)
        ):
            raise ValueError(
                f"the state belongs to another metric than this {type(self).__name__}, or to one with other "
                f"{', '.join(self.definition)}"
            )
        copies = {}
        for name in self._defaults:
            state, incoming = getattr(self, name), _get_stored_tensor(states.get(name))
            needed = tuple(state.shape)
            if name in self._tables and incoming is not None:
                needed = (*incoming.shape[:1], *needed[1:])
            if incoming is None or tuple(incoming.shape) != needed:
                arrived = "none" if incoming is None else tuple(incoming.shape)
                raise ValueError(f"state {name!r} of shape {needed} is needed; got {arrived}")
            copies[name] = incoming.to(device=state.device, dtype=state.dtype, copy=True)
        return copies

    def _handle_added_frames(self) -> None:
        """React to frames that were not added by `update`."""


def _get_stored_tensor(value: object) -> Tensor | None:
    """Return a tensor whose elements are all stored, since a few bytes may claim any size; None for other values."""
    if not isinstance(value, Tensor) or value.layout != torch.strided or value.is_meta:
        return None
    return value if value.nbytes <= value.untyped_storage().nbytes() else None


def insert_rows(table: Tensor, new_rows: Tensor) -> Tensor:
    """Insert rows into a table that is sorted by the first column, then by the second, and so on.

    Args:
        table: (K, C) float64 finite rows in that order.
        new_rows: (N, C) rows to be inserted, in any order.

    Returns:
        (K + N, C) sorted rows.

    Example:
        >>> insert_rows(torch.tensor([[1.0, 5.0]]), torch.tensor([[1.0, 3.0], [0.0, 9.0]])).tolist()
        [[0.0, 9.0], [1.0, 3.0], [1.0, 5.0]]
    """
    rows = torch.cat([table, new_rows.to(table)])
    order = np.lexsort(rows.cpu().numpy().T[::-1])
    return rows[torch.from_numpy(order).to(rows.device)]


def pad_table(table: Tensor, length: int) -> Tensor:
    """Pad a table.

    Args:
        table: (K, C) rows.
        length: Number of rows of the result, K at least.
    """
    return torch.nn.functional.pad(table, (0, 0, 0, length - len(table)), value=PADDING)


def concat_tables(tables: Sequence[Tensor]) -> Tensor:
    """Join the rows of several tables in sorted order.

    Args:
        tables: (K, C) each.
    """
    return insert_rows(tables[0][:0], torch.cat(list(tables)))


def _reduce_padded_tables(tables: Tensor, reduction: Reduction) -> Tensor:
    """Merge (parts, N, C) tables that were padded to the same length."""
    return reduction([rows[rows[:, 0] != PADDING] for rows in tables])


def get_figure(ax: "Axes | None") -> "tuple[Figure, Axes]":
    """Return a figure and its axes.

    Args:
        ax: Existing axes; without them pyplot creates a figure, as in torchmetrics.
    """
    if ax is None:
        import matplotlib.pyplot as plt

        return plt.subplots(layout="constrained")
    figure = ax.get_figure(root=True)
    assert figure is not None, "the axes were removed from their figure"
    return figure, ax
