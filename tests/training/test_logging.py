"""Tables and figures of results in different loggers."""

import importlib.machinery
import sys
import types

import pytest
from lightning.pytorch.loggers import TensorBoardLogger
from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.utils.tensorboard import SummaryWriter

from torchcover.notebooks import build_dataframe
from torchcover.training import log_result


class Result:
    """Result with two rows, one with markup in its name, and a figure."""

    def to_dataframe(self):
        return build_dataframe([{"rig": "<b>|", "radius_m": 0.123456}, {"rig": "b", "radius_m": float("nan")}])

    def plot(self):
        return Figure(figsize=(1.0, 0.5))


@pytest.mark.parametrize("logger_of", [SummaryWriter, TensorBoardLogger])
def test_tensorboard_gets_a_table_and_a_picture(logger_of, tmp_path):
    logger = logger_of(tmp_path)
    log_result(Result(), logger, step=3, tag="run")
    (logger.experiment if logger_of is TensorBoardLogger else logger).close()
    (folder,) = {path.parent for path in tmp_path.rglob("events*")}
    events = EventAccumulator(str(folder))
    events.Reload()
    assert events.Images("run/picture")[0].step == 3
    (told,) = events.Tensors("run/rows/text_summary")
    table = told.tensor_proto.string_val[0].decode().splitlines()
    assert table == ["| rig | radius_m |", "| --- | --- |", "| &lt;b&gt;&#124; | 0.1235 |", "| b | nan |"]


@pytest.mark.parametrize("of_lightning", [False, True])
def test_mlflow_gets_files_of_the_run(of_lightning):
    calls = []
    names = {
        "log_table": lambda *run, data, artifact_file: calls.append((run, len(data), artifact_file)),
        "log_figure": lambda *run_and_figure: calls.append(run_and_figure),
    }
    client = types.SimpleNamespace(**names)
    log_result(Result(), types.SimpleNamespace(experiment=client, run_id="r") if of_lightning else client, step=12)
    run = ("r",) if of_lightning else ()
    table, (*its_run, figure, file) = calls
    assert table == (run, 2, "torchcover/rows_00000012.json")
    assert (tuple(its_run), file) == (run, "torchcover/picture_00000012.png")
    assert isinstance(figure, Figure)


def test_wandb_gets_a_table_and_an_image(monkeypatch):
    wandb = types.ModuleType("wandb")
    wandb.__spec__ = importlib.machinery.ModuleSpec("wandb", None)
    wandb.Table, wandb.Image = (lambda dataframe: ("table", len(dataframe))), (lambda pixels: ("image", pixels.shape))
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    calls = []
    run = type(
        "Run", (), {"__module__": "wandb.sdk.wandb_run", "log": lambda _, shown, step: calls.append((shown, step))}
    )
    log_result(Result(), run(), step=5, tag="t")
    assert calls == [({"t/rows": ("table", 2), "t/picture": ("image", (50, 100, 3))}, 5)]


def test_another_logger_is_told():
    with pytest.raises(TypeError, match=r"a SummaryWriter, a run of Weights & Biases, mlflow, .*; got dict"):
        log_result(Result(), {})
