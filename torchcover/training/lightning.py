"""Lightning callback that evaluates and logs coverage during training and validation."""

from collections.abc import Callable, Sequence
from typing import Any

import torch

try:
    from lightning.pytorch import Callback, LightningModule, Trainer
except ImportError as error:
    raise ImportError("CoverageCallback needs Lightning: pip install 'torchcover[lightning]'") from error
from lightning.pytorch.utilities import CombinedLoader, rank_zero_warn

from torchcover.coverage import Coverage, CoverageMetric, Region
from torchcover.frames import FrameBatch
from torchcover.training.batches import UNKNOWN_INDEX, extract_frames
from torchcover.training.counting import FrameDeduplicator, Shard, find_shard, is_distributed

# Names of the stages in tags, as Lightning users write them.
STAGES = {"validation": "val", "train": "train"}


class CoverageCallback(Callback):
    """Lightning callback that measures and logs the coverage of training or validation frames.

    At the end of an epoch, every number of `Coverage.scalars(regions)` and the number of frames are logged by
    `self.log_dict` under `coverage/val/`, `coverage/test/` (in `trainer.test`) or `coverage/train/`, so that loggers,
    `ModelCheckpoint` and `EarlyStopping` can use them. Maps are logged from rank zero by loggers that accept figures or
    images; other loggers get the numbers alone, with one warning.

    With several processes, each measures its own frames and the sums are added. Samples that a `DistributedSampler`
    repeats to fill the last batch are excluded, see `FrameDeduplicator`. A checkpoint within an epoch contains the sums
    of all processes, so that a resumed run gives the same numbers; other checkpoints contain no sums. The sanity check
    before training is not measured.

    Args:
        metric: Metric. The callback resets it at the start of each epoch, or of each fit with `has_fixed_frames`, and
            moves it to the device of the model.
        regions: Regions to log; by default the regions of the paper that fit the grid.
        stage: `"validation"` to measure validation batches and, in `trainer.test`, test batches; or `"train"`.
        every_n_epochs: Measure the last of every n epochs; other epochs have no cost.
        every_n_steps: With `stage="train"`: also log the coverage of the current epoch after every n batches.
        has_fixed_frames: With `stage="validation"`: declare that all epochs have the same frames. Each frame is then
            measured once per fit, later epochs log the same numbers, and maps are logged, with a warning, only if
            frames were added. The numbers do not depend on the model, so that `ModelCheckpoint` should not monitor
            them. With several processes, the sampler must not shuffle.
        should_log_maps: Log maps.
        rig_name: Name of the rig, if frames have several; it becomes a part of the tags.
        get_frames: Function from a batch to a `FrameBatch` or a sequence with one `Frame` per sample, in order. By
            default the batch is one of these or has the attribute or key `frames`.

    Attributes:
        coverage: Last logged `Coverage`, equal on every process; None before.

    Raises:
        ValueError: The stage is unknown, a number of epochs or steps is below 1, or steps or fixed frames do not match
            the stage. During measurement: the reference points lack the area weights of the metric.
        ImportError: On import, if Lightning is not installed.

    Example:
        >>> from torchcover import BevGrid
        >>> metric = CoverageMetric(BevGrid(x_m=(0.0, 20.0), y_m=(-5.0, 5.0)), max_radius_m=25.0)
        >>> CoverageCallback(metric, every_n_epochs=5).tag
        'coverage/val'
    """

    def __init__(
        self,
        metric: CoverageMetric,
        *,
        regions: Sequence[Region] | None = None,
        stage: str = "validation",
        every_n_epochs: int = 1,
        every_n_steps: int | None = None,
        has_fixed_frames: bool = False,
        should_log_maps: bool = True,
        rig_name: str | None = None,
        get_frames: Callable[[Any], Any] | None = None,
    ) -> None:
        _check_arguments(stage, every_n_epochs, every_n_steps, has_fixed_frames)
        self.metric = metric
        self.regions = regions
        self.stage = stage
        self.every_n_epochs = every_n_epochs
        self.every_n_steps = every_n_steps
        self.has_fixed_frames = has_fixed_frames
        self.should_log_maps = should_log_maps
        self.rig_name = rig_name
        self.get_frames = get_frames
        self.tag = "/".join(["coverage", *([rig_name] if rig_name else []), STAGES[stage]])
        self.coverage: Coverage | None = None
        self._measured_epoch: int | None = None  # equal on every process, as collective calls require
        self._deduplicator = FrameDeduplicator()
        self._prefix = self.tag  # prefix of logged names, which differs in `trainer.test`
        self._logged_scalars: dict[str, float] = {}  # last numbers of this fit
        self._has_new_frames = False  # frames were added since these numbers
        self._warned: set[str] = set()

    @property
    def state_key(self) -> str:
        """Key of the state in checkpoints, one per tag."""
        return self._generate_state_key(tag=self.tag)

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Reset the callback; Lightning restores checkpoints afterwards."""
        self._prefix = f"{self.tag.rpartition('/')[0]}/test" if stage == "test" else self.tag
        self._measured_epoch = None
        self._logged_scalars = {}

    def _start_epoch(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Decide whether the epoch is measured, and reset the metric."""
        self.metric.to(pl_module.device)  # processes exchange the sums on this device
        if self._measured_epoch == trainer.current_epoch:
            return
        is_due = trainer.state.fn != "fit" or (trainer.current_epoch + 1) % self.every_n_epochs == 0
        self._measured_epoch = trainer.current_epoch if is_due and not trainer.sanity_checking else None
        if self._measured_epoch is None:
            return
        if self.has_fixed_frames and self._logged_scalars:
            self._deduplicator.start_epoch(clear_history=False)
        else:
            self._deduplicator.start_epoch()
            self._logged_scalars, self._has_new_frames = {}, True
            self.metric.reset()

    def _add_batch(self, trainer: Trainer, pl_module: LightningModule, batch: object, loader_index: int) -> None:
        """Add the new frames of a batch to the metric."""
        # After a checkpoint at the last batch of an epoch, Lightning does not call the hook for the epoch start.
        self._start_epoch(trainer, pl_module)
        if self._measured_epoch is None:
            return
        frames = extract_frames(batch if self.get_frames is None else self.get_frames(batch))
        shard = self._find_shard(trainer, loader_index)
        new_frames = FrameBatch(tuple(self._deduplicator.select_new(frames, shard, loader_index)))
        if not new_frames.frames:
            return
        self._has_new_frames = True
        indices = [frame.index for frame in new_frames.frames]
        self.metric.update(
            new_frames.get_clouds(self.rig_name),
            new_frames.reference,
            errors_m=new_frames.get_errors_m(self.rig_name),
            weights=new_frames.weights,
            heights_m=new_frames.get_heights_m(self.metric.grid.band_frame),
            block_index=None if UNKNOWN_INDEX in indices else new_frames.block_indices,
        )

    def _find_shard(self, trainer: Trainer, loader_index: int) -> Shard | None:
        """Find the shard of a loader of the current stage."""
        evaluation_loaders = trainer.test_dataloaders if trainer.testing else trainer.val_dataloaders
        loaders: Any = trainer.train_dataloader if self.stage == "train" else evaluation_loaders
        flat_loaders = CombinedLoader(loaders, "sequential").flattened
        # A combined batch of several training loaders does not tell the loader of each frame.
        shard = None if self.stage == "train" and len(flat_loaders) > 1 else find_shard(flat_loaders[loader_index])
        if shard is None and trainer.world_size > 1:
            self._warn_once(
                "not one loader with a DistributedSampler: a frame that several processes get is counted several times"
            )
        return shard

    def _finish_epoch(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the numbers of a measured epoch."""
        if self._measured_epoch is None:
            return
        self._measured_epoch = None
        # The decision is reduced over all processes, as collective calls require.
        if not self.has_fixed_frames or trainer.strategy.reduce_boolean_decision(self._has_new_frames, all=False):
            if self.has_fixed_frames and self._logged_scalars:
                self._warn_once("has_fixed_frames: an epoch had frames that were not there before; they are added")
            coverage = self._compute()
            self._logged_scalars, self._has_new_frames = self._get_scalars(coverage), False
            self._log_maps(trainer, coverage)
        # Since all processes log equal values, the maximum is the value without rounding; Lightning requires a
        # reduction.
        pl_module.log_dict(self._logged_scalars, on_step=False, on_epoch=True, sync_dist=True, reduce_fx="max")

    def _compute(self) -> Coverage:
        self.metric.update([], [], weights=[])  # torchmetrics requires an update, even with padding only
        coverage: Coverage = self.metric.compute()
        self.coverage = coverage
        if not len(coverage.observed_cells.cell_indices):
            self._warn_once("no reference point lies in the grid: the coverage of these frames is unknown (NaN)")
        return coverage

    def _get_scalars(self, coverage: Coverage) -> dict[str, float]:
        scalars = {**coverage.scalars(self.regions), "num_frames": float(coverage.counts["num_frames"])}
        return {f"{self._prefix}/{name}": value for name, value in scalars.items()}

    def _log_maps(self, trainer: Trainer, coverage: Coverage) -> None:
        """Log maps from rank zero."""
        if not (self.should_log_maps and trainer.is_global_zero and trainer.loggers):
            return
        from torchcover.training.figures import log_maps  # imports matplotlib

        unsupported = log_maps(coverage, trainer.loggers, self._prefix, _get_logged_step(trainer))
        if unsupported:
            self._warn_once(f"{', '.join(unsupported)} takes neither figures nor images: it gets the numbers alone")

    def _warn_once(self, text: str) -> None:
        if text not in self._warned:
            self._warned.add(text)
            rank_zero_warn(f"{self.tag}: {text}")

    def state_dict(self) -> dict[str, Any]:
        """Return the sums of all processes within an epoch; every process must call it, as Lightning does."""
        if self._measured_epoch is None:
            return {}
        sums = {}
        with self.metric.sync_context():
            for name, total in self.metric.metric_state.items():
                sums[name] = torch.as_tensor(total, device="cpu").clone()
        return {"epoch": self._measured_epoch, "metric": sums, "frames": self._deduplicator.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue within an epoch: rank zero restores the sums, all other ranks start with empty sums."""
        self._measured_epoch, self._has_new_frames = state_dict["epoch"], True
        self._deduplicator.load_state_dict(state_dict["frames"])
        self.metric.reset()
        if not is_distributed() or torch.distributed.get_rank() == 0:
            sums = {name: total.to(self.metric.device) for name, total in state_dict["metric"].items()}
            self.metric.merge_state(sums)

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the epoch; fixed frames keep their sums."""
        if self.stage == "validation":
            self._start_epoch(trainer, pl_module)

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: object,
        batch: object,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Add the frames of a batch."""
        if self.stage == "validation":
            self._add_batch(trainer, pl_module, batch, dataloader_idx)

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the numbers and maps of the epoch."""
        if self.stage == "validation":
            self._finish_epoch(trainer, pl_module)

    def on_test_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the epoch."""
        self.on_validation_epoch_start(trainer, pl_module)

    def on_test_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: object,
        batch: object,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Add the frames of a batch."""
        self.on_validation_batch_end(trainer, pl_module, outputs, batch, batch_idx, dataloader_idx)

    def on_test_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the numbers and maps of the epoch."""
        self.on_validation_epoch_end(trainer, pl_module)

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the epoch, unless it was resumed."""
        if self.stage == "train":
            self._start_epoch(trainer, pl_module)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        """Add the frames of a batch, and log after every n batches."""
        if self.stage != "train":
            return
        self._add_batch(trainer, pl_module, batch, 0)
        if self._measured_epoch is not None and self.every_n_steps and (batch_idx + 1) % self.every_n_steps == 0:
            coverage = self._compute()
            # `log_dict` would drop values at steps that are no multiples of `log_every_n_steps` of the trainer.
            for logger in trainer.loggers:
                logger.log_metrics(self._get_scalars(coverage), step=_get_logged_step(trainer))
            self._log_maps(trainer, coverage)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the numbers and maps of the epoch."""
        if self.stage == "train":
            self._finish_epoch(trainer, pl_module)


def _get_logged_step(trainer: Trainer) -> int:
    """Return the step of `log_dict`: steps count from 0, and `global_step` is already the next one."""
    return max(trainer.global_step - 1, 0)


def _check_arguments(stage: str, every_n_epochs: int, every_n_steps: int | None, has_fixed_frames: bool) -> None:
    if stage not in STAGES:
        raise ValueError(f"stage: one of {', '.join(STAGES)} is needed; got {stage!r}")
    if every_n_epochs < 1:
        raise ValueError(f"every_n_epochs: at least 1 is needed; got {every_n_epochs}")
    if every_n_steps is not None and every_n_steps < 1:
        raise ValueError(f"every_n_steps: at least 1 is needed; got {every_n_steps}")
    if every_n_steps is not None and stage != "train":
        raise ValueError("every_n_steps: needs stage='train'; a validation is logged at its end")
    if has_fixed_frames and stage != "validation":
        raise ValueError(
            "has_fixed_frames: needs stage='validation'; the frames of a training are shuffled and augmented"
        )
