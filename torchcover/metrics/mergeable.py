"""A torchmetrics metric over `MergeableSums`: for modules, collections and ranks."""

from collections.abc import Callable
from typing import Any, Self

import torch
from torch import Tensor
from torch.nn.modules.module import register_module_module_registration_hook
from torchmetrics import Metric
from torchmetrics.utilities.distributed import gather_all_tensors

from torchcover.devices import has_float64
from torchcover.metrics.sums import MergeableSums, pad_table


def _refuse_resampling(module: torch.nn.Module, _name: str, submodule: torch.nn.Module | None) -> None:
    """Refuse to be wrapped in a `BootStrapper`: it resamples the points of a cloud, not the frames."""
    is_bootstrap = type(module).__name__ == "BootStrapper" and isinstance(module, Metric)
    if is_bootstrap and submodule is not None and any(isinstance(one, MergeableMetric) for one in submodule.modules()):
        raise TypeError(
            "BootStrapper resamples the points of each frame, not the frames; use blocks= of the metric, whose results "
            "have standard errors"
        )


register_module_module_registration_hook(_refuse_resampling)


class MergeableMetric(MergeableSums, Metric):
    """Base of the metrics of torchmetrics: `MergeableSums` that ranks, collections and modules can use.

    `class Mine(MergeableMetric, MySums)` makes a metric of sums; `class Mine(MergeableMetric)` has them itself.

    * Sums are added up over ranks when `compute` is called. The fingerprint of their meaning is compared there and in
      `load_state_dict`, and keeps a `MetricCollection` from sharing the sums of metrics that happen to agree after the
      first step.
    * As of any torchmetrics metric, states are no part of `state_dict` unless `metric.persistent(True)` says so.
    * `.to(torch.float16)` moves the sums but does not round them.
    * Under `torch.inference_mode` everything works as outside of it, and steps may be added outside afterwards.

    Args:
        meaning: As in `MergeableSums`.
        kwargs: For `torchmetrics.Metric` (`sync_on_compute`, `dist_sync_fn`, ...).
    """

    is_differentiable = False
    higher_is_better = None
    full_state_update = False

    # Of torchmetrics, not of plain sums.
    reset = torch.inference_mode(False)(Metric.reset)
    state_dict = Metric.state_dict
    load_state_dict = Metric.load_state_dict

    def __init__(self, *args: Any, **kwargs: Any) -> None:  # noqa: ANN401  (of the sums, and of torchmetrics)
        super().__init__(*args, **kwargs)
        self._device = torch.device("cpu")  # where the states are, whatever the default device is

    def _register_state(self, name: str, default: Tensor, dist_reduce_fx: Any) -> None:  # noqa: ANN401
        Metric.add_state(self, name, default, dist_reduce_fx)

    def to(self, *args: Any, **kwargs: Any) -> Self:  # noqa: ANN401
        """Move the sums to another device, if that has float64, but leave their type."""
        moved: Self = Metric.to(self, *args, **kwargs)
        return moved

    @torch.inference_mode(False)
    def forward(self, *args: Any, **kwargs: Any) -> Any:  # noqa: ANN401  (what `update` takes, and what `compute` gives)
        """Add steps as `update` does, and return what `compute` gives for these steps alone."""
        return Metric.forward(self, *args, **kwargs)

    def _sync_dist(self, dist_sync_fn: Callable[..., Any] = gather_all_tensors, process_group: Any = None) -> None:  # noqa: ANN401
        # Every rank sees the fingerprints of all, so that all of them raise and none waits for the others.
        first, *others = dist_sync_fn(self.fingerprint, group=process_group or self.process_group)
        for rank, other in enumerate(others, 1):
            if not torch.equal(other, first):
                raise ValueError(
                    f"{type(self).__name__} has other parameters on rank {rank} than on rank 0: their sums do not mean "
                    "the same; make it with the same arguments on every rank"
                )
        self._align_ranks(lambda state: dist_sync_fn(state, group=process_group or self.process_group))
        for name in self._tables:
            table = getattr(self, name)
            lengths = dist_sync_fn(self.num_frames.new_tensor(len(table)), group=process_group or self.process_group)
            setattr(self, name, pad_table(table, max(map(int, lengths))))
        Metric._sync_dist(self, dist_sync_fn, process_group)

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
        Metric._load_from_state_dict(self, state_dict, prefix, *args)
        self._follow_steps()

    def _follow_steps(self) -> None:
        # torchmetrics would go on answering from the result it had cached.
        self._computed = None
        self._update_count = int(self.num_frames)

    @torch.inference_mode(False)
    def _apply(self, fn: Callable[[Tensor], Tensor], *args: Any, **kwargs: Any) -> Self:  # noqa: ANN401
        """Move the state to another device, if that has float64, but leave its type."""
        if not has_float64(fn(torch.empty(0, dtype=torch.int64, device=self.device)).device):
            return self

        def moved(state: Tensor) -> Tensor:
            converted = fn(state)
            return converted if converted.dtype == state.dtype else state.to(converted.device)

        Metric._apply(self, moved, *args, **kwargs)
        return self
