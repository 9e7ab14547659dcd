"""What `CoverageCallback` adds to the epochs of a small bird's-eye-view network, as a share of their time."""

import logging
import tempfile
import time
import warnings

import lightning.pytorch as pl
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from torch import nn
from torch.utils.data import DataLoader

from benchmarks.timing import table
from torchcover import BevGrid, CoverageMetric, forward_regions
from torchcover.data import SimulatedFrames, collate_frames
from torchcover.simulation import PaperReference
from torchcover.training import CoverageCallback

GRID = BevGrid(x=(0.0, 80.0), y=(-20.0, 20.0), cell=0.5)
TRAIN_FRAMES = 96
VALIDATION_FRAMES = 32
EPOCHS = 3


class TimedCallback(CoverageCallback):
    """Adds up the seconds in the hooks that do something, and those of the epochs."""

    def on_fit_start(self, trainer, pl_module):
        self.epochs = []

    def on_train_epoch_start(self, trainer, pl_module):
        self.start, self.inside, self.drawing = time.perf_counter(), 0.0, 0.0

    def on_validation_epoch_start(self, *arguments):
        self._timed(super().on_validation_epoch_start, *arguments)

    def on_validation_batch_end(self, *arguments):
        self._timed(super().on_validation_batch_end, *arguments)

    def on_validation_epoch_end(self, *arguments):
        self._timed(super().on_validation_epoch_end, *arguments)

    def on_train_epoch_end(self, trainer, pl_module):
        self.epochs.append((time.perf_counter() - self.start, self.inside, self.drawing))

    def _log_maps(self, trainer, coverage):
        start = time.perf_counter()
        super()._log_maps(trainer, coverage)
        self.drawing += time.perf_counter() - start

    def _timed(self, hook, *arguments):
        start = time.perf_counter()
        hook(*arguments)
        self.inside += time.perf_counter() - start


class Network(pl.LightningModule):
    """Learns from how many points there are in a cell how many there are around it: work like a detector's."""

    def __init__(self):
        super().__init__()
        layers = [nn.Conv2d(2, 48, 3, padding=1), nn.ReLU()]
        for _ in range(4):
            layers += [nn.Conv2d(48, 48, 3, padding=1), nn.BatchNorm2d(48), nn.ReLU()]
        self.layers = nn.Sequential(*layers, nn.Conv2d(48, 1, 1))

    def loss(self, batch):
        cells = torch.zeros(len(batch), GRID.cells)
        for row, cloud in enumerate(batch.sensor):
            cell = GRID.cell_of(cloud)
            cells[row] = torch.bincount(cell[cell >= 0], minlength=GRID.cells)
        image = cells.view(-1, *GRID.shape).log1p()
        target = nn.functional.avg_pool2d(image.sum(dim=1, keepdim=True), 5, stride=1, padding=2)
        return nn.functional.mse_loss(self.layers(image), target)

    def training_step(self, batch, batch_idx):
        return self.loss(batch)

    def validation_step(self, batch, batch_idx):
        self.loss(batch)

    def configure_optimizers(self):
        return torch.optim.Adam(self.parameters())


def measure(frames):
    """Seconds of an epoch, of the callback in it, and of its maps: means over epochs, of which the first warms up."""
    train, validation = frames[:TRAIN_FRAMES], frames[TRAIN_FRAMES:]
    metric = CoverageMetric(GRID, max_radius=GRID.diagonal_m)
    callback = TimedCallback(metric, regions=forward_regions((20, 80)))
    with tempfile.TemporaryDirectory() as folder:
        trainer = pl.Trainer(
            accelerator="cpu",
            max_epochs=EPOCHS + 1,
            num_sanity_val_steps=0,
            callbacks=[callback],
            logger=TensorBoardLogger(folder),
            log_every_n_steps=1,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
        )
        batches = {"batch_size": 4, "collate_fn": collate_frames}
        trainer.fit(Network(), DataLoader(train, shuffle=True, **batches), DataLoader(validation, **batches))
    return [sum(column) / EPOCHS for column in zip(*callback.epochs[1:], strict=True)]


def main():
    """Print the shares."""
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", "The '.*dataloader' does not have many workers")
    warnings.filterwarnings("ignore", ".*isinstance.treespec, LeafSpec.. is deprecated", FutureWarning)
    dataset = SimulatedFrames(
        "courtyard",
        "front_roof_32",
        steps=TRAIN_FRAMES + VALIDATION_FRAMES,
        reference_sensor=PaperReference(rows=128, columns=128),
    )
    frames = [dataset[index] for index in range(len(dataset))]
    epoch, inside, drawing = measure(frames)
    rest = epoch - inside
    rows = [
        ("numbers alone", inside - drawing, 100 * (inside - drawing) / rest),
        ("numbers and maps", inside, 100 * inside / rest),
    ]
    print(f"{TRAIN_FRAMES} frames to train on, {VALIDATION_FRAMES} to validate and measure; {rest:.1f} s an epoch.\n")
    table(("logged each epoch", "seconds", "share of the epoch without them (%)"), rows)


if __name__ == "__main__":
    main()
