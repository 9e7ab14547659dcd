"""A torchmetrics metric whose state is sums with a meaning: merged, loaded and synchronised exactly, or refused."""

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.modules.module import register_module_module_registration_hook

from torchcover.devices import has_float64
from torchcover.metrics.lean import Metric, gather_all_tensors

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# What fills a table up to the length of another one; no row holds it.
FILLER = math.inf

Reduction = Callable[[Sequence[Tensor]], Tensor]


def _refuse_resampling(module: torch.nn.Module, _name: str, submodule: torch.nn.Module | None) -> None:
    """Refuse to be wrapped in a `BootStrapper`: it resamples the points of a cloud, not the frames."""
    is_bootstrap = type(module).__name__ == "BootStrapper" and isinstance(module, Metric)
    if is_bootstrap and submodule is not None and any(isinstance(one, MergeableMetric) for one in submodule.modules()):
        raise TypeError(
            "BootStrapper resamples the points of each frame, not the frames; use blocks= of the metric, whose results "
            "have standard errors"
        )


register_module_module_registration_hook(_refuse_resampling)


class MergeableMetric(Metric):
    """Base of the metrics: sums over steps, and the parameters that say what they are sums of.

    * Two metrics over different steps merge exactly: `merge_state`, or over ranks when `compute` is called.
    * Sums that mean different things are never added: a fingerprint of class and parameters is part of the state. It
      is compared in `merge_state`, `load_state_dict` and the synchronisation of ranks, and it keeps a
      `MetricCollection` from sharing the sums of metrics that happen to agree after the first step.
    * As of any torchmetrics metric, states are no part of `state_dict` unless `metric.persistent(True)` says so.
    * States are copies: nothing that is loaded or merged is written to later.
    * `.to(torch.float16)` moves the sums but does not round them; on a device without float64 (MPS) they stay on the
      CPU, to which clouds follow.
    * Under `torch.inference_mode` everything works as outside of it, and steps may be added outside afterwards.

    A metric passes its parameters to `__init__`, adds its states with `add_sum`, and counts `steps`. Their size is
    fixed; only a table (`add_table`) grows.

    Args:
        meaning: What the sums depend on, by the name of the parameter; compared by `==` and `repr`.
        kwargs: For `torchmetrics.Metric` (`sync_on_compute`, `dist_sync_fn`, ...).

    Example:
        >>> class Points(MergeableMetric):
        ...     def __init__(self, above_m: float) -> None:
        ...         super().__init__({"above_m": above_m})
        ...         self.add_sum("points", (), torch.int64)
        ...     def update(self, cloud):
        ...         self.points += (cloud[:, 2] > self.meaning["above_m"]).sum()
        ...         self.steps += 1
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

    is_differentiable = False
    higher_is_better = None
    full_state_update = False

    fingerprint: Tensor
    steps: Tensor

    def __init__(self, meaning: Mapping[str, object], **kwargs: Any) -> None:  # noqa: ANN401  (whatever torchmetrics takes)
        super().__init__(**kwargs)
        self._device = torch.device("cpu")  # where the states are, whatever the default device is
        self.meaning = dict(meaning)
        self._tables: dict[str, Reduction] = {}
        # (32,) int64 numbers in [0, 256), equal for two metrics exactly if their sums mean the same.
        words = repr((type(self).__name__, sorted(self.meaning.items())))
        fingerprint = torch.tensor(list(hashlib.sha256(words.encode()).digest()), device="cpu")
        self.add_state("fingerprint", fingerprint, dist_reduce_fx="max")
        self.add_sum("steps", (), torch.int64)

    @torch.inference_mode(False)  # here and below: a tensor made under it could not be added to outside of it
    def add_state(self, name: str, default: Tensor | list[Any], *args: Any, **kwargs: Any) -> None:  # noqa: ANN401
        """Add a state, as torchmetrics does; of one number that is expanded it would keep a second copy."""
        if not isinstance(default, Tensor) or default.is_contiguous() or any(default.stride()):
            super().add_state(name, default.clone() if isinstance(default, Tensor) else default, *args, **kwargs)
            return
        number = default[(0,) * default.dim()].clone()
        super().add_state(name, number, *args, **kwargs)
        if default.device.type == "cpu" and not number:  # zeros that take memory once they are written to
            state = torch.from_numpy(np.zeros(default.shape, number.numpy().dtype))
        else:
            state = torch.empty_like(default, memory_format=torch.contiguous_format)
            # The device `meta` keeps no numbers, and would import half of torch to fill in none.
            state = state if state.is_meta else state.fill_(number)
        setattr(self, name, state)
        self._defaults[name] = number.expand(default.shape)

    def add_sum(self, name: str, shape: tuple[int, ...], dtype: torch.dtype = torch.float64) -> None:
        """Add a state that starts at zero and adds up; float64 or int64, for sums grow."""
        self.add_state(name, torch.zeros((), dtype=dtype, device="cpu").expand(shape), dist_reduce_fx="sum")

    def add_table(self, name: str, columns: int, reduction: Reduction | None = None) -> None:
        """Add a float64 state of rows that begin with a finite number, none at first.

        Args:
            name: Of the state.
            columns: Numbers in a row.
            reduction: How several tables become one. Not given: all rows are kept, in the order of
                `torchcover.metrics.with_rows`.
        """
        self._tables[name] = reduction or joined
        none = torch.empty((0, columns), dtype=torch.float64, device="cpu")
        of_ranks = partial(_of_filled, reduction=self._tables[name])
        self.add_state(name, none, dist_reduce_fx=of_ranks)

    @torch.inference_mode(False)
    def reset(self) -> None:
        """Forget every step."""
        super().reset()

    @torch.inference_mode(False)
    def forward(self, *args: Any, **kwargs: Any) -> Any:  # noqa: ANN401  (what `update` takes, and what `compute` gives)
        """Add steps as `update` does, and return what `compute` gives for these steps alone."""
        return super().forward(*args, **kwargs)

    @torch.inference_mode(False)
    def merge_state(self, incoming_state: "dict[str, Any] | Metric") -> None:
        """Add the steps of another metric with the same parameters, which is left as it was.

        Args:
            incoming_state: Such a metric, or its `metric_state`.

        Raises:
            ValueError: Another kind of metric, other parameters, or a state that lacks something.
        """
        if isinstance(incoming_state, Metric):
            self._check_meaning(incoming_state)
            incoming_state = incoming_state.metric_state
        if not isinstance(incoming_state, dict):
            raise ValueError(
                f"a {type(self).__name__} or its metric_state is needed; got {type(incoming_state).__name__}"
            )
        super().merge_state(self._copied(incoming_state))
        self._follow_steps()

    def _reduce_states(self, incoming_state: dict[str, Any]) -> None:
        # A copy already, here and in torchmetrics' `forward`.
        self._align_with(incoming_state)
        both = {name: reduced([getattr(self, name), incoming_state[name]]) for name, reduced in self._tables.items()}
        for name, table in both.items():  # torchmetrics would want them of one length
            setattr(self, name, table[:0])
            incoming_state[name] = table[:0]
        super()._reduce_states(incoming_state)
        for name, table in both.items():
            setattr(self, name, table)

    def _align_with(self, incoming: dict[str, Any]) -> None:
        """Bring this state and another one, a copy, into a form in which they can be added up."""

    def _sync_dist(self, dist_sync_fn: Callable[..., Any] = gather_all_tensors, process_group: Any = None) -> None:  # noqa: ANN401
        # Every rank sees the fingerprints of all, so that all of them raise and none waits for the others.
        first, *others = dist_sync_fn(self.fingerprint, group=process_group or self.process_group)
        for rank, other in enumerate(others, 1):
            if not torch.equal(other, first):
                raise ValueError(
                    f"{type(self).__name__} has other parameters on rank {rank} than on rank 0: their sums do not mean "
                    "the same; make it with the same arguments on every rank"
                )
        self._align_ranks(dist_sync_fn, process_group)
        for name in self._tables:
            table = getattr(self, name)
            lengths = dist_sync_fn(self.steps.new_tensor(len(table)), group=process_group or self.process_group)
            setattr(self, name, filled(table, max(map(int, lengths))))
        super()._sync_dist(dist_sync_fn, process_group)

    def _align_ranks(self, dist_sync_fn: Callable[..., Any], process_group: Any) -> None:  # noqa: ANN401
        """Bring the states of all ranks into a form in which they can be added up."""

    @torch.inference_mode(False)
    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:  # noqa: ANN401
        # torchmetrics would keep the very tensors it is given, of any shape, and pass over those that are missing.
        given = {name: state_dict[prefix + name] for name in self._defaults if prefix + name in state_dict}
        try:
            state_dict.update({prefix + name: value for name, value in (self._copied(given) if given else {}).items()})
        except ValueError as error:
            # As all that is not expected: refused by name, or passed over with strict=False.
            unexpected_keys: list[str] = args[-2]
            unexpected_keys.extend(f"{prefix}{name} ({error})" for name in given)
            return
        super()._load_from_state_dict(state_dict, prefix, *args)
        self._follow_steps()

    def _check_meaning(self, other: Metric) -> None:
        if not isinstance(other, MergeableMetric) or type(other) is not type(self):
            raise ValueError(f"cannot merge a {type(other).__name__} into a {type(self).__name__}")
        for name, mine in self.meaning.items():
            if mine != other.meaning.get(name):
                raise ValueError(f"cannot merge metrics with different {name}: {mine} and {other.meaning.get(name)}")

    def _copied(self, states: Mapping[str, Tensor]) -> dict[str, Any]:
        """The states of a metric, once they are known to mean the same, on this device and in these types."""
        fingerprint = states.get("fingerprint")
        if fingerprint is None or not torch.equal(fingerprint.to(self.fingerprint), self.fingerprint):
            raise ValueError(
                f"the state was made by another metric than this {type(self).__name__}, or with other "
                f"{', '.join(self.meaning)}"
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
        # torchmetrics would go on answering from the result it had cached.
        self._computed = None
        self._update_count = int(self.steps)

    @torch.inference_mode(False)
    def _apply(self, fn: Callable[[Tensor], Tensor], *args: Any, **kwargs: Any) -> "MergeableMetric":  # noqa: ANN401
        """Move the state to another device, if that has float64, but leave its type."""
        if not has_float64(fn(torch.empty(0, dtype=torch.int64, device=self.device)).device):
            return self

        def moved(state: Tensor) -> Tensor:
            converted = fn(state)
            return converted if converted.dtype == state.dtype else state.to(converted.device)

        super()._apply(moved, *args, **kwargs)
        return self


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


def joined(tables: Sequence[Tensor]) -> Tensor:
    """One table with the rows of several."""
    return with_rows(tables[0][:0], torch.cat(list(tables)))


def _of_filled(tables: Tensor, reduction: Reduction) -> Tensor:
    """One table of several, (parts, N, C), that were filled up to the same length."""
    return reduction([rows[rows[:, 0] != FILLER] for rows in tables])


def figure_of(ax: "Axes | None") -> "tuple[Figure, Axes]":
    """The axes that a metric was given and their figure, or new ones of pyplot's, as torchmetrics has it."""
    if ax is None:
        import matplotlib.pyplot as plt

        return plt.subplots(layout="constrained")
    figure = ax.get_figure(root=True)
    assert figure is not None, "axes that were removed from their figure"
    return figure, ax
