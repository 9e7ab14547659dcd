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
    """Measures the coverage of the frames that a model trains or is validated on, and logs it.

    At the end of an epoch every number of `Coverage.scalars(regions)` and the number of frames go to `self.log_dict`
    under `coverage/val/`, `coverage/test/` (in `trainer.test`) or `coverage/train/`, so that loggers, `ModelCheckpoint`
    and `EarlyStopping` see them; the maps go to the loggers that take figures or images, from rank zero. The other
    loggers get the numbers, and one warning says so.

    With several processes each measures its own frames and the sums are added up. The samples that a
    `DistributedSampler` repeats to fill the last batch are left out, see `FrameDeduplicator`. A checkpoint within an epoch
    holds the sums so far of all processes, so that a resumed run ends with the same numbers; other checkpoints hold
    nothing. The sanity check before training is not measured.

    Args:
        metric: What to measure. The callback resets it at the start of each epoch, or of each fit with `has_fixed_frames`,
            and moves it to the model's device.
        regions: Regions to log; those of the paper that fit the grid if not given.
        stage: `"validation"` or `"train"`: whose batches to measure; the former also in `trainer.test`.
        every_n_epochs: Measure the last of every n epochs. The others cost nothing.
        every_n_steps: With `stage="train"`: also log the coverage of the epoch so far after every n batches.
        has_fixed_frames: With `stage="validation"`: say that the frames are the same at every epoch. Each is then measured
            when it first comes in a fit, later epochs log the numbers again, and maps are logged where frames were
            added; a warning says so. They do not depend on the model: `ModelCheckpoint` has nothing to monitor in
            them. With several processes, the sampler must not shuffle.
        should_log_maps: Whether to log maps.
        rig_name: Which of several rigs in a frame; part of the tags if given.
        get_frames: Gives the frames of a batch: a `FrameBatch` or a sequence of `Frame`, one for each sample, in order.
            If not given, the batch is one of the two or has them as `frames`.

    Attributes:
        coverage: The last `Coverage` that was logged, the same on every process; None before.

    Raises:
        ValueError: An unknown stage, a number of epochs or steps below 1, steps outside training, fixed frames in it.
            While it measures: reference points without the square metres that the metric wants.
        ImportError: On import, without Lightning.

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
        self._epoch: int | None = None  # being measured; the same on every process, as collective calls need it
        self._once = FrameDeduplicator()
        self._prefix = self.tag  # of what is logged: in `trainer.test` another one
        self._logged: dict[str, float] = {}  # the last numbers of this fit
        self._added = False  # whether there are frames that are not in them
        self._warned: set[str] = set()

    @property
    def state_key(self) -> str:
        """Where a checkpoint keeps the state: one place for each tag."""
        return self._generate_state_key(tag=self.tag)

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Forget what came before; a checkpoint is restored after this."""
        self._prefix = f"{self.tag.rpartition('/')[0]}/test" if stage == "test" else self.tag
        self._epoch = None
        self._logged = {}

    def _start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.metric.to(pl_module.device)  # where the processes can exchange the sums
        if self._epoch == trainer.current_epoch:
            return
        due = trainer.state.fn != "fit" or (trainer.current_epoch + 1) % self.every_n_epochs == 0
        self._epoch = trainer.current_epoch if due and not trainer.sanity_checking else None
        if self._epoch is None:
            return
        if self.has_fixed_frames and self._logged:
            self._once.start_epoch(clear_history=False)
        else:
            self._once.start_epoch()
            self._logged, self._added = {}, True
            self.metric.reset()

    def _add(self, trainer: Trainer, pl_module: LightningModule, batch: object, loader_index: int) -> None:
        # After a checkpoint at the last batch of an epoch, Lightning leaves out the hook for its start.
        self._start(trainer, pl_module)
        if self._epoch is None:
            return
        frames = extract_frames(batch if self.get_frames is None else self.get_frames(batch))
        new = FrameBatch(tuple(self._once.select_new(frames, self._shard(trainer, loader_index), loader_index)))
        if not new.frames:
            return
        self._added = True
        indices = [frame.index for frame in new.frames]
        self.metric.update(
            new.get_clouds(self.rig_name),
            new.reference,
            errors_m=new.get_errors_m(self.rig_name),
            weights=new.weights,
            heights_m=new.get_heights_m(self.metric.grid.band_frame),
            block_index=None if UNKNOWN_INDEX in indices else new.block_indices,
        )

    def _shard(self, trainer: Trainer, loader_index: int) -> Shard | None:
        evaluated = trainer.test_dataloaders if trainer.testing else trainer.val_dataloaders
        loaders: Any = trainer.train_dataloader if self.stage == "train" else evaluated
        flat = CombinedLoader(loaders, "sequential").flattened
        # A batch of several training loaders side by side does not say which frame came from which.
        shard = None if self.stage == "train" and len(flat) > 1 else find_shard(flat[loader_index])
        if shard is None and trainer.world_size > 1:
            self._warn_once(
                "not one loader with a DistributedSampler: a frame that several processes get is counted several times"
            )
        return shard

    def _finish(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._epoch is None:
            return
        self._epoch = None
        # Whether there is something new has the same answer on all processes, as collective calls need it.
        if not self.has_fixed_frames or trainer.strategy.reduce_boolean_decision(self._added, all=False):
            if self.has_fixed_frames and self._logged:
                self._warn_once("fixed_frames: an epoch had frames that were not there before; they are added")
            coverage = self._compute()
            self._logged, self._added = self._scalars(coverage), False
            self._log_maps(trainer, coverage)
        # All processes log the same values, so that their maximum is the value, not rounded; Lightning wants some
        # reduction to be named.
        pl_module.log_dict(self._logged, on_step=False, on_epoch=True, sync_dist=True, reduce_fx="max")

    def _compute(self) -> Coverage:
        self.metric.update([], [], weights=[])  # a process that was dealt nothing but padding has not updated yet
        coverage: Coverage = self.metric.compute()
        self.coverage = coverage
        if not len(coverage.observed_cells.cell_indices):
            self._warn_once("no reference point lies in the grid: the coverage of these frames is unknown (NaN)")
        return coverage

    def _scalars(self, coverage: Coverage) -> dict[str, float]:
        scalars = {**coverage.scalars(self.regions), "num_frames": float(coverage.counts["num_frames"])}
        return {f"{self._prefix}/{name}": value for name, value in scalars.items()}

    def _log_maps(self, trainer: Trainer, coverage: Coverage) -> None:
        if not (self.should_log_maps and trainer.is_global_zero and trainer.loggers):
            return
        from torchcover.training.figures import log_maps  # matplotlib only where there is something to draw

        if refused := log_maps(coverage, trainer.loggers, self._prefix, _step(trainer)):
            self._warn_once(f"{', '.join(refused)} takes neither figures nor images: it gets the numbers alone")

    def _warn_once(self, text: str) -> None:
        if text not in self._warned:
            self._warned.add(text)
            rank_zero_warn(f"{self.tag}: {text}")

    def state_dict(self) -> dict[str, Any]:
        """The sums so far of all processes, within an epoch; every process must call it, as Lightning does."""
        if self._epoch is None:
            return {}
        with self.metric.sync_context():
            sums = {
                name: torch.as_tensor(total, device="cpu").clone() for name, total in self.metric.metric_state.items()
            }
        return {"epoch": self._epoch, "metric": sums, "frames": self._once.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on within an epoch: rank zero takes over the sums, the others start from nothing."""
        self._epoch, self._added = state_dict["epoch"], True
        self._once.load_state_dict(state_dict["frames"])
        self.metric.reset()
        if not is_distributed() or torch.distributed.get_rank() == 0:
            sums = {name: total.to(self.metric.device) for name, total in state_dict["metric"].items()}
            self.metric.merge_state(sums)

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start from nothing, or go on with fixed frames."""
        if self.stage == "validation":
            self._start(trainer, pl_module)

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
            self._add(trainer, pl_module, batch, dataloader_idx)

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log."""
        if self.stage == "validation":
            self._finish(trainer, pl_module)

    def on_test_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start from nothing."""
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
        """Log."""
        self.on_validation_epoch_end(trainer, pl_module)

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start from nothing, unless the epoch was resumed."""
        if self.stage == "train":
            self._start(trainer, pl_module)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        """Add the frames of a batch, and log if it is time."""
        if self.stage != "train":
            return
        self._add(trainer, pl_module, batch, 0)
        if self._epoch is not None and self.every_n_steps and (batch_idx + 1) % self.every_n_steps == 0:
            coverage = self._compute()
            # `log_dict` would drop the values of steps that are no multiples of the trainer's log_every_n_steps.
            for logger in trainer.loggers:
                logger.log_metrics(self._scalars(coverage), step=_step(trainer))
            self._log_maps(trainer, coverage)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log."""
        if self.stage == "train":
            self._finish(trainer, pl_module)


def _step(trainer: Trainer) -> int:
    """Where Lightning puts what `log_dict` logs now: steps count from 0, and the last one has been taken."""
    return max(trainer.global_step - 1, 0)


def _check_arguments(stage: str, every_n_epochs: int, every_n_steps: int | None, fixed_frames: bool) -> None:
    if stage not in STAGES:
        raise ValueError(f"stage: one of {', '.join(STAGES)} is needed; got {stage!r}")
    if every_n_epochs < 1:
        raise ValueError(f"every_n_epochs: at least 1 is needed; got {every_n_epochs}")
    if every_n_steps is not None and every_n_steps < 1:
        raise ValueError(f"every_n_steps: at least 1 is needed; got {every_n_steps}")
    if every_n_steps is not None and stage != "train":
        raise ValueError("every_n_steps: needs stage='train'; a validation is logged at its end")
    if fixed_frames and stage != "validation":
        raise ValueError("fixed_frames: needs stage='validation'; the frames of a training are shuffled and augmented")
