"""Coverage in Lightning runs: measured frames, logged numbers and maps, and checkpoints."""

import gc
import math
from dataclasses import replace
from types import SimpleNamespace

import lightning.pytorch as pl
import numpy as np
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger
from lightning.pytorch.utilities import CombinedLoader
from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.utils.data import DataLoader, Dataset, DistributedSampler

from torchcover import BevGrid, CoverageMetric, Region
from torchcover.data import Frame, collate_frames
from torchcover.training import CoverageCallback

GRID = {"x_m": (0.0, 8.0), "y_m": (-2.0, 2.0), "cell_m": 1.0}
REGIONS = [Region("near", x_m=(0.0, 4.0), y_m=(-2.0, 2.0)), Region("all", x_m=(0.0, 8.0), y_m=(-2.0, 2.0))]
SIZE = torch.tensor([8.0, 4.0, 2.0])
CORNER = torch.tensor([0.0, -2.0, -0.2])


class RandomFrames(Dataset):
    """Frames of random points; frame k is always the same."""

    def __init__(self, frames, reference_points=40):
        self.frames = frames
        self.reference_points = reference_points

    def __len__(self):
        return self.frames

    def __getitem__(self, index):
        if index >= self.frames:
            raise IndexError(index)
        generator = torch.Generator().manual_seed(index)
        sensor = torch.rand(20 + index, 3, generator=generator) * SIZE + CORNER
        reference = torch.rand(self.reference_points, 3, generator=generator) * SIZE + CORNER
        return Frame({"rig": sensor}, reference, index=index, name="random")


class Model(pl.LightningModule):
    """Model with one parameter that ignores the frames."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.tensor(1.0))

    def training_step(self, batch, batch_idx):
        return self.weight**2 * len(batch)

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.01)


class Validated(Model):
    """Model with a validation step."""

    def validation_step(self, batch, batch_idx, dataloader_idx=0):
        pass


class BothSides(Model):
    """Model with two batches per step."""

    def training_step(self, batch, batch_idx):
        return self.weight**2


def loader(frames, batch_size=2, **options):
    dataset = RandomFrames(frames) if isinstance(frames, int) else frames
    return DataLoader(dataset, batch_size=batch_size, collate_fn=collate_frames, **options)


def make_metric(**options):
    return CoverageMetric(BevGrid(**GRID), max_radius_m=9.0, **options)


def expected(frames):
    metric = make_metric()
    for frame in frames:
        metric.update(frame.sensor, frame.reference, block_index=frame.index)
    return metric.compute()


def assert_same(coverage, other):
    for name in ("observed_frames", "point_counts", "radius", "detection"):
        np.testing.assert_allclose(getattr(coverage, name), getattr(other, name), rtol=1e-12, err_msg=name)
    assert coverage.counts == other.counts


def make_trainer(folder, *callbacks, logger=False, **options):
    options = {"max_epochs": 1, "num_sanity_val_steps": 0, "enable_checkpointing": False, **options}
    return pl.Trainer(
        default_root_dir=folder,
        accelerator="cpu",
        callbacks=list(callbacks),
        logger=logger,
        log_every_n_steps=1,
        enable_progress_bar=False,
        enable_model_summary=False,
        **options,
    )


def test_a_validation_logs_the_coverage_of_its_frames(tmp_path):
    callback = CoverageCallback(make_metric(), regions=REGIONS)
    trainer = make_trainer(tmp_path, callback, num_sanity_val_steps=2)
    trainer.fit(Validated(), loader(3), loader(5))
    truth = expected(RandomFrames(5))
    assert_same(callback.coverage, truth)
    logged = {name: float(value) for name, value in trainer.callback_metrics.items()}
    scalars = {f"coverage/val/{name}": value for name, value in truth.scalars(REGIONS).items()}
    assert logged == pytest.approx({**scalars, "coverage/val/num_frames": 5.0}, rel=1e-6)


def test_numbers_can_be_monitored(tmp_path):
    callback = CoverageCallback(make_metric(), regions=REGIONS)
    monitor = ModelCheckpoint(tmp_path / "best", monitor="coverage/val/detection_0.4m/near/ground", mode="max")
    trainer = make_trainer(tmp_path, callback, monitor, enable_checkpointing=True)
    trainer.fit(Validated(), loader(2), loader(3))
    assert float(monitor.best_model_score) == pytest.approx(
        callback.coverage.scalars(REGIONS)["detection_0.4m/near/ground"], rel=1e-6
    )
    callback.coverage.radius[0, 0, 0] = 1.0
    callback.metric.update(torch.zeros(1, 3), torch.zeros(1, 3))


def test_epochs_reset_and_skipped_ones_cost_nothing(tmp_path):
    seen = []

    class Spy(CoverageMetric):
        def update(self, sensor, *arguments, **options):
            seen.append((trainer.current_epoch, len(sensor)))
            super().update(sensor, *arguments, **options)

    callback = CoverageCallback(Spy(BevGrid(**GRID), max_radius_m=9.0), every_n_epochs=2)
    trainer = make_trainer(tmp_path, callback, max_epochs=5)
    trainer.fit(Validated(), loader(2), loader(5))
    measured = [epoch for epoch, frames in seen if frames]
    assert measured == [1, 1, 1, 3, 3, 3]
    assert_same(callback.coverage, expected(RandomFrames(5)))
    # `trainer.validate` is always measured.
    callback.coverage = None
    make_trainer(tmp_path, callback).validate(Validated(), loader(4), verbose=False)
    assert_same(callback.coverage, expected(RandomFrames(4)))


def measured_frames(trainer, metric):
    """Record the number of frames per epoch that a metric gets."""
    seen, update = [], metric.update

    def spy(sensor, *arguments, **options):
        seen.extend([trainer.current_epoch] * len(sensor))
        update(sensor, *arguments, **options)

    metric.update = spy
    return seen


def test_fixed_frames_are_measured_once(tmp_path, blank_maps):
    callback = CoverageCallback(make_metric(), regions=REGIONS, has_fixed_frames=True)
    logger = TensorBoardLogger(tmp_path, name="", version="run")
    trainer = make_trainer(tmp_path, callback, logger=logger, max_epochs=3)
    seen = measured_frames(trainer, callback.metric)
    trainer.fit(Validated(), loader(2), loader(5))
    assert seen == [0] * 5
    truth = expected(RandomFrames(5))
    assert_same(callback.coverage, truth)
    events = EventAccumulator(logger.log_dir, size_guidance={"images": 0})
    events.Reload()
    for name, value in truth.scalars(REGIONS).items():
        logged = [event.value for event in events.Scalars(f"coverage/val/{name}")]
        assert logged == pytest.approx([value] * 3, rel=1e-6, nan_ok=True)
    assert [event.step for event in events.Images("coverage/val/radius")] == [0]
    # Another fit is measured again, with its own maps.
    trainer = make_trainer(tmp_path, callback, logger=TensorBoardLogger(tmp_path, name="", version="other"))
    trainer.fit(Validated(), loader(2), loader(5))
    assert_same(callback.coverage, truth)
    events = EventAccumulator(str(tmp_path / "other"))
    events.Reload()
    assert len(events.Images("coverage/val/radius")) == 1


def test_new_frames_are_added_to_fixed_frames(tmp_path, blank_maps):
    class Alternating(Validated):
        def val_dataloader(self):
            return loader([RandomFrames(5)[2 * min(self.current_epoch, 1) + k] for k in range(3)])

    callback = CoverageCallback(make_metric(), has_fixed_frames=True)
    logger = TensorBoardLogger(tmp_path, name="", version="run")
    trainer = make_trainer(tmp_path, callback, logger=logger, max_epochs=3, reload_dataloaders_every_n_epochs=1)
    seen = measured_frames(trainer, callback.metric)
    with pytest.warns(UserWarning, match="an epoch had frames that were not there before"):
        trainer.fit(Alternating(), loader(2))
    assert seen == [0, 0, 0, 1, 1]
    assert_same(callback.coverage, expected(RandomFrames(5)))
    events = EventAccumulator(logger.log_dir)
    events.Reload()
    assert [event.step for event in events.Images("coverage/val/radius")] == [0, 1]


def test_frames_that_a_sampler_repeats_are_counted_once(tmp_path):
    callback = CoverageCallback(make_metric(), stage="train")
    make_trainer(tmp_path, callback).fit(Model(), loader(4, sampler=[0, 1, 2, 3, 0, 1, 2]))
    assert_same(callback.coverage, expected(RandomFrames(4)))


def test_frames_of_two_loaders_are_different_ones(tmp_path):
    callback = CoverageCallback(make_metric())
    make_trainer(tmp_path, callback).fit(Validated(), loader(2), [loader(3), loader(4)])
    assert_same(callback.coverage, expected([*RandomFrames(3), *RandomFrames(4)]))


def test_frames_of_loaders_within_loaders_are_measured(tmp_path):
    callback = CoverageCallback(make_metric())
    make_trainer(tmp_path, callback).fit(Validated(), loader(2), {"a": [loader(3), loader(4)], "b": loader(5)})
    assert_same(callback.coverage, expected([*RandomFrames(3), *RandomFrames(4), *RandomFrames(5)]))


def test_combined_training_loaders_have_no_padding(tmp_path):
    """Seven frames for two processes are four each; positions in combined batches reach eight."""
    sides = {
        side: loader(
            [replace(frame, name=side) for frame in RandomFrames(7)], sampler=DistributedSampler(range(7), 2, 0)
        )
        for side in ("left", "right")
    }
    callback = CoverageCallback(
        make_metric(), stage="train", get_frames=lambda batch: [f for side in batch.values() for f in side.frames]
    )
    trainer = make_trainer(tmp_path, callback, use_distributed_sampler=False)
    seen = measured_frames(trainer, callback.metric)
    trainer.fit(BothSides(), CombinedLoader(sides, "min_size"))
    assert len(seen) == 8


def test_sums_follow_the_device_of_the_model(tmp_path):
    class Moved(CoverageMetric):
        devices = ()

        def to(self, device):
            self.devices = (*self.devices, str(device))
            return super().to(device)

    callback = CoverageCallback(Moved(BevGrid(**GRID), max_radius_m=9.0))
    padding = DistributedSampler(range(1), num_replicas=2, rank=1, shuffle=False)
    with pytest.warns(UserWarning, match="no reference point lies in the grid"):
        make_trainer(tmp_path, callback, use_distributed_sampler=False).fit(
            Validated(), loader(2), loader(1, sampler=padding)
        )
    assert callback.coverage.counts["num_frames"] == 0
    assert set(callback.metric.devices) == {"cpu"}


def test_the_weights_of_reference_points_count(tmp_path):
    weights = torch.linspace(0.1, 3.0, 40)
    frames = [replace(frame, reference_weights=weights) for frame in RandomFrames(3)]
    callback = CoverageCallback(make_metric())
    make_trainer(tmp_path, callback).fit(Validated(), loader(2), loader(frames))
    metric = make_metric()
    for frame in frames:
        metric.update(frame.sensor, frame.reference, weights=weights, block_index=frame.index)
    assert_same(callback.coverage, metric.compute())
    assert not torch.equal(callback.coverage.radius, expected(frames).radius)


def test_frames_need_area_weights_of_the_metric(tmp_path):
    callback = CoverageCallback(make_metric(has_area_weights=True))
    without, other = RandomFrames(2)
    weighted = replace(other, reference_weights=torch.ones(40))
    for frames in ([without], [without, weighted], [weighted, without]):
        with pytest.raises(ValueError, match=r"of (each|its) reference point"):
            make_trainer(tmp_path, callback).fit(Validated(), loader(2), loader(frames))


def test_every_n_steps_logs_the_epoch_so_far(tmp_path, blank_maps):
    callback = CoverageCallback(make_metric(), regions=REGIONS, stage="train", every_n_steps=2)
    logger = TakesImages()
    make_trainer(tmp_path, callback, logger=logger).fit(Model(), loader(9))
    tag = "coverage/train/radius_m/all/ground"
    frames = list(RandomFrames(9))
    # Batches count from 0: after two of them, after four, and at the end.
    truth = {k: expected(frames[: 2 * k + 2]).scalars(REGIONS)["radius_m/all/ground"] for k in (1, 3, 4)}
    assert {step: values[tag] for step, values in logger.scalars if tag in values} == pytest.approx(truth, rel=1e-6)
    assert [step for key, step, _ in logger.images if key == "coverage/train/radius"] == [1, 3, 4]


def test_another_rig_other_batches_and_frames(tmp_path):
    def frames_of(batch):
        return [Frame({"a": f.sensor, "b": f.sensor[:5]}, f.reference, f.index, f.name) for f in batch["frames"]]

    def collate(frames):
        return {"frames": frames, "target": torch.zeros(len(frames))}

    batches = DataLoader(RandomFrames(3), batch_size=2, collate_fn=collate)
    callback = CoverageCallback(make_metric(), rig_name="b", get_frames=frames_of)
    trainer = make_trainer(tmp_path, callback, CoverageCallback(make_metric(), rig_name="a", get_frames=frames_of))
    trainer.fit(Validated(), loader(2), batches)
    truth = expected([Frame({"b": f.sensor[:5]}, f.reference, f.index, f.name) for f in RandomFrames(3)])
    assert_same(callback.coverage, truth)
    assert {name.split("/")[1] for name in trainer.callback_metrics} == {"a", "b"}


class TakesImages(Logger):
    """Logger with `log_image`, as in Weights & Biases."""

    name, version = "images", 0

    def __init__(self):
        super().__init__()
        self.images, self.scalars = [], []

    def log_metrics(self, metrics, step=None):
        self.scalars.append((step, metrics))

    def log_hyperparams(self, *arguments, **options):
        pass

    def log_image(self, key, images, step=None):
        self.images += [(key, step, image) for image in images]


def test_tensorboard_holds_the_tags_values_and_maps(tmp_path):
    logger = TensorBoardLogger(tmp_path, name="", version="run")
    callback = CoverageCallback(make_metric(thresholds_m=(0.4, 0.8)), regions=REGIONS)
    make_trainer(tmp_path, callback, logger=logger).fit(Validated(), loader(4), loader(5))
    events = EventAccumulator(str(tmp_path / "run"))
    events.Reload()
    truth = callback.coverage.scalars(REGIONS)
    tags = {f"coverage/val/{name}" for name in truth} | {"coverage/val/num_frames"}
    assert {tag for tag in events.Tags()["scalars"] if tag.startswith("coverage")} == tags
    for name, value in truth.items():
        last = events.Scalars(f"coverage/val/{name}")
        assert [event.value for event in last] == pytest.approx([value], rel=1e-6)
        assert [event.step for event in last] == [1]
    maps = {f"coverage/val/{name}" for name in ("radius_m", "detection_0.4m", "detection_0.8m")}
    assert set(events.Tags()["images"]) == maps
    for tag in maps:
        images = events.Images(tag)
        assert [event.step for event in images] == [1]
        assert images[0].encoded_image_string.startswith(b"\x89PNG")
        assert min(images[0].width, images[0].height) > 100


def test_a_logger_that_takes_images_gets_pixels(tmp_path):
    logger = TakesImages()
    make_trainer(tmp_path, CoverageCallback(make_metric()), logger=logger).fit(Validated(), loader(2), loader(3))
    assert [key for key, _, _ in logger.images] == ["coverage/val/radius_m", "coverage/val/detection_0.4m"]
    for _, _, image in logger.images:
        assert image.dtype == np.uint8
        assert image.shape[2] == 3
        assert image.std() > 20, "an empty picture"


class TakesFigures(TakesImages):
    """Logger whose experiment has a `log_figure` with a given signature."""

    log_image = None

    def __init__(self, log_figure, **attributes):
        super().__init__()
        self.experiment = SimpleNamespace(log_figure=log_figure)
        vars(self).update(attributes)


def test_mlflow_gets_a_file_per_figure_and_step(tmp_path, blank_maps):
    taken = {}

    def log_figure(run_id, figure, artifact_file, *, save_kwargs=None):  # signature of MlflowClient
        figure.savefig(tmp_path / "drawn.png")
        taken[artifact_file] = run_id

    logger = TakesFigures(log_figure, run_id="a1b2")
    make_trainer(tmp_path, CoverageCallback(make_metric()), logger=logger, max_epochs=2).fit(
        Validated(), loader(2), loader(3)
    )
    names = [f"coverage/val/{name}/step_0000000{step}.png" for step in (0, 1) for name in ("radius", "blank")]
    assert taken == dict.fromkeys(names, "a1b2")
    assert (tmp_path / "drawn.png").stat().st_size > 100


def test_comet_gets_figures_by_name_and_step(tmp_path, blank_maps):
    taken = []

    def log_figure(figure_name=None, figure=None, overwrite=False, step=None):  # signature of comet_ml.Experiment
        taken.append((figure_name, type(figure), step))

    logger = TakesFigures(log_figure)
    make_trainer(tmp_path, CoverageCallback(make_metric()), logger=logger, max_epochs=2).fit(
        Validated(), loader(2), loader(3)
    )
    assert taken == [(f"coverage/val/{name}", Figure, step) for step in (0, 1) for name in ("radius", "blank")]


def test_loggers_without_figures_get_numbers_and_a_warning(tmp_path):
    logger = CSVLogger(tmp_path, name="", version="run")
    trainer = make_trainer(tmp_path, CoverageCallback(make_metric()), logger=logger, max_epochs=3)
    with pytest.warns(UserWarning, match="the numbers alone") as caught:
        trainer.fit(Validated(), loader(2), loader(3))
    assert sum("CSVLogger takes neither figures nor images" in str(warning.message) for warning in caught) == 1
    rows = (tmp_path / "run" / "metrics.csv").read_text().splitlines()
    assert "coverage/val/num_frames" in rows[0]
    assert len(rows) == 4


def test_without_maps_nothing_is_drawn(tmp_path):
    logger = TakesImages()
    make_trainer(tmp_path, CoverageCallback(make_metric(), should_log_maps=False), logger=logger).fit(
        Validated(), loader(2), loader(3)
    )
    assert logger.images == []
    assert any("coverage/val/num_frames" in values for _, values in logger.scalars)


def test_frames_without_reference_points_cause_one_warning(tmp_path):
    callback = CoverageCallback(make_metric(), regions=REGIONS)
    trainer = make_trainer(tmp_path, callback, max_epochs=2)
    with pytest.warns(UserWarning, match="is unknown") as caught:
        trainer.fit(Validated(), loader(2), loader(RandomFrames(3, reference_points=0)))
    assert sum("no reference point lies in the grid" in str(warning.message) for warning in caught) == 1
    assert math.isnan(trainer.callback_metrics["coverage/val/radius_m/all/ground"])
    assert trainer.callback_metrics["coverage/val/observed_share/all/ground"] == 0
    assert callback.coverage.counts["empty_reference_frames"] == 3


class Save(pl.Callback):
    """Callback that saves a checkpoint after a number of steps, as `ModelCheckpoint`."""

    def __init__(self, path, step):
        self.path, self.step = path, step

    def on_train_batch_end(self, trainer, *arguments):
        if trainer.global_step == self.step:
            trainer.save_checkpoint(self.path)


class Resumable(DataLoader):
    """Loader that resumes at a checkpoint with the two methods that Lightning calls."""

    start = 0

    def __iter__(self):
        self.given = self.start
        first, self.start = self.start, 0
        for position, batch in enumerate(super().__iter__()):
            if position >= first:
                self.given += 1
                yield batch

    def state_dict(self):
        return {"given": self.given}

    def load_state_dict(self, state):
        self.start = state["given"] % len(self)


class SevenAnEpoch:
    """Sampler with other frames in every epoch, set by Lightning."""

    epoch = 0

    def set_epoch(self, epoch):
        self.epoch = epoch

    def __len__(self):
        return 7

    def __iter__(self):
        return iter(range(7 * self.epoch, 7 * self.epoch + 7))


@pytest.mark.parametrize("at", [1, 2, 3, 4, 6, 7])
def test_resumed_epochs_give_equal_numbers(tmp_path, at):
    """Train two epochs of four batches, with a checkpoint after one of the batches."""
    path = tmp_path / "within.ckpt"

    def run(*callbacks, ckpt_path=None):
        results = {}

        class Keep(CoverageCallback):
            def on_train_epoch_end(self, trainer, pl_module):
                super().on_train_epoch_end(trainer, pl_module)
                results[trainer.current_epoch] = self.coverage

        trainer = make_trainer(tmp_path, Keep(make_metric(), stage="train"), *callbacks, max_epochs=2)
        batches = Resumable(RandomFrames(14), batch_size=2, collate_fn=collate_frames, sampler=SevenAnEpoch())
        trainer.fit(Model(), batches, ckpt_path=ckpt_path)
        return results

    whole = run(Save(path, at))
    resumed = run(ckpt_path=path)
    assert (sorted(whole), sorted(resumed)) == ([0, 1], [0, 1] if at < 4 else [1])
    for epoch, coverage in [*whole.items(), *resumed.items()]:
        assert_same(coverage, expected(list(RandomFrames(14))[7 * epoch : 7 * epoch + 7]))


def test_repeated_frames_of_resumed_loaders_count_once(tmp_path):
    callback = CoverageCallback(make_metric(), stage="train")
    make_trainer(tmp_path, callback, Save(tmp_path / "within.ckpt", 2)).fit(Model(), loader(8))
    with pytest.warns(UserWarning, match="your dataloader is not resumable"):
        make_trainer(tmp_path, callback).fit(Model(), loader(8), ckpt_path=tmp_path / "within.ckpt")
    # The loader repeats the first batches instead of the last two.
    assert_same(callback.coverage, expected(RandomFrames(4)))


def test_only_checkpoints_within_epochs_contain_sums(tmp_path):
    callback = CoverageCallback(make_metric(), stage="train")
    trainer = make_trainer(tmp_path, callback)
    trainer.fit(Model(), loader(4))
    assert callback.state_dict() == {}
    assert CoverageCallback(make_metric()).state_key != callback.state_key


def test_memory_does_not_grow_over_epochs(tmp_path, blank_maps):
    counts, counted = [], []

    class Count(pl.Callback):
        def on_train_batch_end(self, *arguments):
            counted.append(len(callback.state_dict()["frames"]["counted"]))

        def on_train_epoch_end(self, trainer, pl_module):
            gc.collect()
            # `type`, as `isinstance` asks deprecated objects of torch for their class; and some tensors have no data.
            tensors = [thing for thing in gc.get_objects() if issubclass(type(thing), torch.Tensor)]
            size = sum(tensor.untyped_storage().nbytes() for tensor in tensors if tensor.layout == torch.strided)
            counts.append((len(tensors), size))

    callback = CoverageCallback(make_metric(), stage="train")
    logger = TensorBoardLogger(tmp_path, name="", version="run")
    trainer = make_trainer(tmp_path, callback, Count(), logger=logger, max_epochs=3)
    gc.freeze()  # Tensors of other tests do not count; with torch 2.4 some of them are invalid.
    try:
        trainer.fit(Model(), loader(6))
    finally:
        gc.unfreeze()
    assert counts[1:] == [counts[1]] * 2
    assert counted == [2, 4, 6] * 3


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"stage": "test"}, "one of validation, train"),
        ({"every_n_epochs": 0}, "at least 1"),
        ({"stage": "train", "every_n_steps": 0}, "at least 1"),
        ({"every_n_steps": 5}, "needs stage='train'"),
        ({"stage": "train", "has_fixed_frames": True}, "needs stage='validation'"),
    ],
)
def test_wrong_arguments_are_refused(options, complaint):
    with pytest.raises(ValueError, match=complaint):
        CoverageCallback(make_metric(), **options)


def test_batches_without_frames_and_unknown_rigs_are_refused(tmp_path):
    plain = DataLoader(RandomFrames(2), batch_size=2, collate_fn=lambda frames: {"points": [f.sensor for f in frames]})
    with pytest.raises(TypeError, match=r"got dict; say how.*get_frames"):
        make_trainer(tmp_path, CoverageCallback(make_metric())).fit(Validated(), loader(2), plain)
    with pytest.raises(ValueError, match="has no rig 'roof'; it has rig"):
        make_trainer(tmp_path, CoverageCallback(make_metric(), rig_name="roof")).fit(Validated(), loader(2), loader(2))


# Batch sizes in Lightning


class LogsOwn(Validated):
    """Model that logs a number, and passes clouds to a layer in the requested precision."""

    def validation_step(self, batch, batch_idx, dataloader_idx=0):
        assert {cloud.dtype for frame in batch.frames for cloud in (frame.sensor, frame.reference)} == {torch.float32}
        self.log("own", float(batch_idx), batch_size=len(batch))


@pytest.mark.parametrize("precision", ["64-true", "bf16-true", "16-true", "bf16-mixed"])
def test_batches_are_not_modified_in_any_precision(tmp_path, precision):
    requested = CoverageMetric(BevGrid(**GRID), max_radius_m=9.0)
    for frame in RandomFrames(5):
        requested.update(frame.sensor, frame.reference)
    callback = CoverageCallback(
        CoverageMetric(BevGrid(**GRID), max_radius_m=9.0), regions=REGIONS, should_log_maps=False
    )
    trainer = make_trainer(tmp_path, callback, precision=precision)
    trainer.fit(LogsOwn(), loader(3), loader(5))
    assert callback.coverage.scalars(REGIONS) == requested.compute().scalars(REGIONS)
    assert float(trainer.callback_metrics["own"]) == pytest.approx((2 * 0 + 2 * 1 + 1 * 2) / 5)


def test_unknown_batch_sizes_are_reported(tmp_path):
    class LogsNoSize(Validated):
        def validation_step(self, batch, batch_idx, dataloader_idx=0):
            self.log("own", float(batch_idx))

    with pytest.raises(Exception, match="batch_size"):
        make_trainer(tmp_path).fit(LogsNoSize(), loader(3), loader(5))


def test_test_stage_has_a_separate_tag(tmp_path):
    class Tested(Model):
        def test_step(self, batch, batch_idx):
            pass

    requested = CoverageMetric(BevGrid(**GRID), max_radius_m=9.0)
    for frame in RandomFrames(5):
        requested.update(frame.sensor, frame.reference)
    callback = CoverageCallback(
        CoverageMetric(BevGrid(**GRID), max_radius_m=9.0), regions=REGIONS, should_log_maps=False
    )
    trainer = make_trainer(tmp_path, callback)
    trainer.test(Tested(), loader(5), verbose=False)
    logged = {name: float(value) for name, value in trainer.callback_metrics.items()}
    expected = {f"coverage/test/{name}": value for name, value in requested.compute().scalars(REGIONS).items()}
    assert {name: logged[name] for name in expected} == pytest.approx(expected, rel=1e-6)
