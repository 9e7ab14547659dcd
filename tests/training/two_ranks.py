"""Lightning run in two processes on the frames in FOLDER/frames.pt: `python two_ranks.py FOLDER`."""

import os
import socket
import sys
import warnings
from pathlib import Path

import lightning.pytorch as pl
import torch
from matplotlib.figure import Figure
from torch.utils.data import DataLoader

from torchcover import BevGrid, CoverageMetric, Region
from torchcover.data import Frame, collate_frames
from torchcover.training import CoverageCallback, figures

warnings.simplefilter("error")
warnings.filterwarnings("ignore", ".*isinstance.treespec, LeafSpec.. is deprecated", FutureWarning)
warnings.filterwarnings("ignore", "The '.*dataloader' does not have many workers")
folder = Path(sys.argv[1])
job = torch.load(folder / "frames.pt", weights_only=False)
frames = [Frame({"rig": sensor}, reference, k, "saved") for k, (sensor, reference) in enumerate(job["frames"])]


class Model(pl.LightningModule):
    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.tensor(1.0))

    def training_step(self, batch, batch_idx):
        return self.weight**2

    def validation_step(self, batch, batch_idx):
        pass

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.01)


class SaveWithinEpoch(pl.Callback):
    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        if batch_idx == 1:
            trainer.save_checkpoint(folder / "within.ckpt")


class TakesImages(pl.loggers.CSVLogger):
    images = 0

    def log_image(self, key, images, step):
        self.images += 1


class Resumable(DataLoader):
    """Loader that resumes after the batches of a checkpoint with the two methods that Lightning calls."""

    start = 0

    def __iter__(self):
        first, self.start = self.start, 0
        for self.given, batch in enumerate(super().__iter__(), 1):
            if self.given > first:
                yield batch

    def state_dict(self):
        return {"given": self.given}

    def load_state_dict(self, state):
        self.start = state["given"]


def fit(name, *callbacks, ckpt_path=None):
    def metric():
        return CoverageMetric(BevGrid(**job["grid"]), max_radius_m=9.0, num_blocks=8)

    regions = [Region("all", job["grid"]["x_m"], job["grid"]["y_m"])]
    train = CoverageCallback(metric(), regions=regions, stage="train", should_log_maps=False)
    validation = CoverageCallback(metric(), regions=regions, has_fixed_frames=True)
    logger = TakesImages(folder, name="", version=name)
    trainer = pl.Trainer(
        accelerator="cpu",
        devices=2,
        strategy="ddp",
        max_epochs=2,
        num_sanity_val_steps=0,
        callbacks=[train, validation, *callbacks],
        logger=logger,
        log_every_n_steps=1,
        default_root_dir=folder,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    # Lightning deals the frames out to the two processes; those of the training are shuffled.
    train_frames = Resumable(frames, shuffle=True, batch_size=1, collate_fn=collate_frames)
    validation_frames = DataLoader(frames, batch_size=2, collate_fn=collate_frames)
    trainer.fit(Model(), train_frames, validation_frames, ckpt_path=ckpt_path)
    blocks = {}
    for stage, callback in (("train", train), ("val", validation)):
        callback.coverage.save(folder / f"{name}_{stage}_{trainer.global_rank}.npz")
        blocks[stage] = callback.coverage.block_sums.sums
    logged = {tag: float(value) for tag, value in trainer.callback_metrics.items()}
    result = {"logged": logged, "images": logger.images, "blocks": blocks}
    torch.save(result, folder / f"{name}_{trainer.global_rank}.pt")


def two_processes():
    """Fork once everything is imported; the environment tells Lightning not to start processes itself."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    os.environ.update(MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port), WORLD_SIZE="2", NODE_RANK="0")
    child = os.fork()
    os.environ["LOCAL_RANK"] = "0" if child else "1"
    return child


if __name__ == "__main__":
    figures.plot_band_maps = lambda coverage: [("radius", Figure((1, 1))), ("detection", Figure((1, 1)))]
    child = two_processes()
    fit("whole", SaveWithinEpoch())
    fit("resumed", ckpt_path=folder / "within.ckpt")
    if child:
        sys.exit(os.waitpid(child, 0)[1])
