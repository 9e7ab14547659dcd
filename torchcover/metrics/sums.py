"""Sums with a meaning: merged and loaded exactly, or refused. Needs nothing of torchmetrics."""

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

# What fills a table up to the length of another one; no row holds it.
FILLER = math.inf

Reduction = Callable[[Sequence[Tensor]], Tensor]


class MergeableSums:
    """Sums over steps, and the parameters that say what they are sums of.

    * Two of them over different steps merge exactly: `merge_state`.
    * Sums that mean different things are never added: a fingerprint of class and parameters is part of the state.
    * States are copies: nothing that is loaded or merged is written to later.
    * On a device without float64 (MPS) the sums stay on the CPU, to which clouds follow.

    A subclass passes its parameters to `__init__`, adds its states with `define_sum`, and counts `num_frames`. Their size is
    fixed; only a table (`define_table`) grows. `MergeableMetric` before it in the bases makes a torchmetrics metric of it.

    Args:
        definition: What the sums depend on, by the name of the parameter; compared by `==` and `repr`.
        kwargs: For the next base.

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

    def __init__(self, definition: Mapping[str, object], **kwargs: Any) -> None:  # noqa: ANN401  (of the next base)
        self._defaults = {}
        super().__init__(**kwargs)
        self.definition = dict(definition)
        self._tables: dict[str, Reduction] = {}
        self._largest: set[str] = set()
        # (32,) int64 numbers in [0, 256), equal for two metrics exactly if their sums mean the same.
        words = repr((type(self).__name__, sorted(self.definition.items())))
        fingerprint = torch.tensor(list(hashlib.sha256(words.encode()).digest()), device="cpu")
        self.define_state("fingerprint", fingerprint, "max")
        self.define_sum("num_frames", (), torch.int64)

    @torch.inference_mode(False)  # here and below: a tensor made under it could not be added to outside of it
    def define_state(self, name: str, default: Tensor, dist_reduce_fx: str | Callable[..., Tensor]) -> None:
        """Add a state.

        Args:
            name: Of the state, an attribute from here on.
            default: What it starts from. One number that is expanded takes the memory of one number.
            dist_reduce_fx: "sum", "max", or how torchmetrics makes one table of those of all ranks.
        """
        if dist_reduce_fx == "max":
            self._largest.add(name)
        if default.is_contiguous() or any(default.stride()):
            self._register_state(name, default.clone(), dist_reduce_fx)
            return
        number = default[(0,) * default.dim()].clone()
        self._register_state(name, number, dist_reduce_fx)
        if default.device.type == "cpu" and not number:  # zeros that take memory once they are written to
            state = torch.from_numpy(np.zeros(default.shape, number.numpy().dtype))
        else:
            state = torch.empty_like(default, memory_format=torch.contiguous_format).fill_(number)
        setattr(self, name, state)
        self._defaults[name] = number.expand(default.shape)

    def _register_state(self, name: str, default: Tensor, dist_reduce_fx: object) -> None:
        self._defaults[name] = default
        setattr(self, name, default.clone())

    def define_sum(self, name: str, shape: tuple[int, ...], dtype: torch.dtype = torch.float64) -> None:
        """Add a state that starts at zero and adds up; float64 or int64, for sums grow."""
        self.define_state(name, torch.zeros((), dtype=dtype, device="cpu").expand(shape), "sum")

    def define_table(self, name: str, num_columns: int, reduction: Reduction | None = None) -> None:
        """Add a float64 state of rows that begin with a finite number, none at first.

        Args:
            name: Of the state.
            num_columns: Numbers in a row.
            reduction: How several tables become one. Not given: all rows are kept, in the order of
                `torchcover.metrics.insert_rows`.
        """
        self._tables[name] = reduction or concat_tables
        none = torch.empty((0, num_columns), dtype=torch.float64, device="cpu")
        self.define_state(name, none, partial(_of_filled, reduction=self._tables[name]))

    @property
    def device(self) -> torch.device:
        """Where the sums are."""
        return self.fingerprint.device

    @property
    def metric_state(self) -> dict[str, Any]:
        """The states by their names."""
        return {name: getattr(self, name) for name in self._defaults}

    @torch.inference_mode(False)
    def reset(self) -> None:
        """Forget every step."""
        for name, default in self._defaults.items():
            setattr(self, name, default.clone().to(getattr(self, name).device))

    def to(self, device: torch.device | str) -> Self:
        """Move the sums to another device, if that has float64."""
        if has_float64(torch.device(device)):
            for name, state in self.metric_state.items():
                setattr(self, name, state.to(device))
        return self

    def state_dict(self) -> dict[str, Any]:
        """What `load_state_dict` takes: the states by their names."""
        return self.metric_state

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Take the sums of another one with the same parameters.

        Raises:
            ValueError: Other parameters, or a state that lacks something.
        """
        copies = self._copied(state_dict)
        for name, state in copies.items():
            setattr(self, name, state)
        self._follow_steps()

    @torch.inference_mode(False)
    def merge_state(self, incoming_state: Any) -> None:  # noqa: ANN401  (so that another kind is refused by name)
        """Add the steps of another metric with the same parameters, which is left as it was.

        Args:
            incoming_state: Such a metric, or its `metric_state`.

        Raises:
            ValueError: Another kind of metric, other parameters, or a state that lacks something.
        """
        if hasattr(incoming_state, "metric_state"):
            self._check_meaning(incoming_state)
            incoming_state = incoming_state.metric_state
        if not isinstance(incoming_state, Mapping):
            raise ValueError(
                f"a {type(self).__name__} or its metric_state is needed; got {type(incoming_state).__name__}"
            )
        self._reduce_states(self._copied(incoming_state))
        self._follow_steps()

    def _reduce_states(self, incoming_state: dict[str, Any]) -> None:
        # A copy already, here and in torchmetrics' `forward`.
        self._align_with(incoming_state)
        for name in self._defaults:
            pair = incoming_state[name], getattr(self, name)
            if name in self._tables:
                both = self._tables[name](pair[::-1])
            else:
                both = torch.maximum(*pair) if name in self._largest else torch.add(*pair)
            setattr(self, name, both)

    def _align_with(self, incoming: dict[str, Any]) -> None:
        """Bring this state and another one, a copy, into a form in which they can be added up."""

    def _align_ranks(self, gather: Callable[[Tensor], Sequence[Tensor]]) -> None:
        """Bring the states of all ranks, of which `gather` gives one, into a form in which they can be added up."""

    def _check_meaning(self, other: object) -> None:
        if not isinstance(other, MergeableSums) or type(other) is not type(self):
            raise ValueError(f"cannot merge a {type(other).__name__} into a {type(self).__name__}")
        for name, mine in self.definition.items():
            if mine != other.definition.get(name):
                raise ValueError(f"cannot merge metrics with different {name}: {mine} and {other.definition.get(name)}")

    def _copied(self, states: Mapping[str, Tensor]) -> dict[str, Any]:
        """The states of a metric, once they are known to mean the same, on this device and in these types."""
        fingerprint = states.get("fingerprint")
        if fingerprint is None or not torch.equal(fingerprint.to(self.fingerprint), self.fingerprint):
            raise ValueError(
                f"the state was made by another metric than this {type(self).__name__}, or with other "
                f"{', '.join(self.definition)}"
            )
        copies = {}
        for name in self._defaults:
            mine, other = getattr(self, name), states.get(name)
            needed = tuple(mine.shape)
            if name in self._tables and other is not None:
                needed = (*other.shape[:1], *needed[1:])
            if other is None or tuple(other.shape) != needed:
                arrived = "none" if other is None else tuple(other.shape)
                raise ValueError(f"state {name!r} of shape {needed} is needed; got {arrived}")
            copies[name] = other.to(device=mine.device, dtype=mine.dtype, copy=True)
        return copies

    def _follow_steps(self) -> None:
        """Take notice of steps that were added otherwise than by `update`."""


def insert_rows(table: Tensor, new_rows: Tensor) -> Tensor:
    """A table with some more rows, in ascending order: by the first column, then by the second, and so on.

    Args:
        table: (K, C) float64 finite rows in that order.
        new_rows: (N, C) more of them, in any order.

    Example:
        >>> insert_rows(torch.tensor([[1.0, 5.0]]), torch.tensor([[1.0, 3.0], [0.0, 9.0]])).tolist()
        [[0.0, 9.0], [1.0, 3.0], [1.0, 5.0]]
    """
    both = torch.cat([table, new_rows.to(table)])
    order = np.lexsort(both.cpu().numpy().T[::-1])
    return both[torch.from_numpy(order).to(both.device)]


def pad_table(table: Tensor, length: int) -> Tensor:
    """The table, filled up to a length."""
    return torch.nn.functional.pad(table, (0, 0, 0, length - len(table)), value=FILLER)


def concat_tables(tables: Sequence[Tensor]) -> Tensor:
    """One table with the rows of several."""
    return insert_rows(tables[0][:0], torch.cat(list(tables)))


def _of_filled(tables: Tensor, reduction: Reduction) -> Tensor:
    """One table of several, (parts, N, C), that were filled up to the same length."""
    return reduction([rows[rows[:, 0] != FILLER] for rows in tables])


def get_figure(ax: "Axes | None") -> "tuple[Figure, Axes]":
    """The axes that a metric was given and their figure, or new ones of pyplot's, as torchmetrics has it."""
    if ax is None:
        import matplotlib.pyplot as plt

        return plt.subplots(layout="constrained")
    figure = ax.get_figure(root=True)
    assert figure is not None, "axes that were removed from their figure"
    return figure, ax
