"""Adapter that makes a torchmetrics metric of `MergeableSums`: for modules, collections and ranks."""

from collections.abc import Callable
from functools import partial
from typing import Any, Self

import torch
from torch import Tensor
from torch.nn.modules.module import register_module_module_registration_hook
from torchmetrics import Metric
from torchmetrics.utilities.distributed import gather_all_tensors

from torchcover.devices import has_float64
from torchcover.metrics.sums import MergeableSums, pad_table


def _refuse_resampling(module: torch.nn.Module, _name: str, submodule: torch.nn.Module | None) -> None:
    """Refuse a `BootStrapper` around a mergeable metric: it resamples the points of a cloud, not the frames."""
    is_bootstrap = type(module).__name__ == "BootStrapper" and isinstance(module, Metric)
    if not is_bootstrap or submodule is None:
        return
    if any(isinstance(part, MergeableMetric) for part in submodule.modules()):
        raise TypeError(
            "BootStrapper resamples the points of each frame, not the frames; use num_blocks= of the metric, whose "
            "results have standard errors"
        )


register_module_module_registration_hook(_refuse_resampling)


class MergeableMetric(MergeableSums, Metric):
    """Base class of the torchmetrics metrics: `MergeableSums` for ranks, collections and modules.

    `class Mine(MergeableMetric, MySums)` makes a metric of existing sums; `class Mine(MergeableMetric)` defines sums
    itself.

    * `compute` adds up the sums of all ranks. The fingerprint of the definition is compared there and in
      `load_state_dict`. It also keeps a `MetricCollection` from sharing the sums of metrics that happen to agree after
      the first frame.
    * As for any torchmetrics metric, states are part of `state_dict` only after `metric.persistent(True)`.
    * `.to(torch.float16)` moves the sums but does not round them.
    * `torch.inference_mode` changes nothing, and frames may be added outside of it afterwards.

    Args:
        definition: Parameters that define the sums, as in `MergeableSums`.
        kwargs: Options of `torchmetrics.Metric` (`sync_on_compute`, `dist_sync_fn`, ...).
    """

    is_differentiable = False
    higher_is_better = None
    full_state_update = False

    # Methods of torchmetrics take precedence over those of the sums.
    reset = torch.inference_mode(False)(Metric.reset)
    state_dict = Metric.state_dict
    load_state_dict = Metric.load_state_dict

    def __init__(self, *args: Any, **kwargs: Any) -> None:  # noqa: ANN401  (of the bases)
        super().__init__(*args, **kwargs)
        self._device = torch.device("cpu")  # states are created there, whatever the default device is

    def _register_state(self, name: str, default: Tensor, dist_reduce_fx: Any) -> None:  # noqa: ANN401
        Metric.add_state(self, name, default, dist_reduce_fx)

    def to(self, *args: Any, **kwargs: Any) -> Self:  # noqa: ANN401
        """Move the sums to another device with float64; their type does not change.

        Args:
            args: Arguments of `torch.nn.Module.to`.
            kwargs: Likewise.
        """
        metric: Self = Metric.to(self, *args, **kwargs)
        return metric

    @torch.inference_mode(False)
    def forward(self, *args: Any, **kwargs: Any) -> Any:  # noqa: ANN401
        """Add frames and return the result of these frames alone.

        Args:
            args: Arguments of `update`.
            kwargs: Likewise.

        Returns:
            The result of `compute` over these frames.
        """
        return Metric.forward(self, *args, **kwargs)

    def _sync_dist(self, dist_sync_fn: Callable[..., Any] = gather_all_tensors, process_group: Any = None) -> None:  # noqa: ANN401
        gather = partial(dist_sync_fn, group=process_group or self.process_group)
        # Each rank gets the fingerprints of all ranks, so that all of them raise and none waits for the others.
        fingerprints = gather(self.fingerprint)
        for rank, fingerprint in enumerate(fingerprints):
            if not torch.equal(fingerprint, fingerprints[0]):
                raise ValueError(
                    f"{type(self).__name__} has other parameters on rank {rank} than on rank 0, so their sums cannot "
                    "be added; create it with the same arguments on each rank"
                )
        self._align_ranks(gather)
        for name in self._tables:
            table = getattr(self, name)
            lengths = gather(self.num_frames.new_tensor(len(table)))
            setattr(self, name, pad_table(table, max(map(int, lengths))))
        Metric._sync_dist(self, dist_sync_fn, process_group)

    @torch.inference_mode(False)
    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:  # noqa: ANN401
        # torchmetrics would keep the passed tensors themselves, of any shape, and ignore missing ones.
        states = {name: state_dict[prefix + name] for name in self._defaults if prefix + name in state_dict}
        try:
            copies = self._copy_states(states) if states else {}
        except ValueError as error:
            # Treated like unexpected keys: refused by name, or ignored with strict=False.
            unexpected_keys: list[str] = args[-2]
            unexpected_keys.extend(f"{prefix}{name} ({error})" for name in states)
            return
        state_dict.update({prefix + name: state for name, state in copies.items()})
        Metric._load_from_state_dict(self, state_dict, prefix, *args)
        self._handle_added_frames()

    def _handle_added_frames(self) -> None:
        # torchmetrics would return the result that it cached before.
        self._computed = None
        self._update_count = int(self.num_frames)

    @torch.inference_mode(False)
    def _apply(self, fn: Callable[[Tensor], Tensor], *args: Any, **kwargs: Any) -> Self:  # noqa: ANN401
        """Move the state to another device with float64; its type does not change."""
        if not has_float64(fn(torch.empty(0, dtype=torch.int64, device=self.device)).device):
            return self

        def convert_device(state: Tensor) -> Tensor:
            converted = fn(state)
            return converted if converted.dtype == state.dtype else state.to(converted.device)

        Metric._apply(self, convert_device, *args, **kwargs)
        return self
