"""Maps, pictures and rows of results, for whichever logger takes them."""

from collections.abc import Callable, Sequence
from html import escape
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from torchcover.coverage import Coverage
from torchcover.report import plot_band_maps

# Takes the tag of a figure, the figure, and where on its axis.
FigureLogger = Callable[[str, Figure, int], Any]


def log_maps(coverage: Coverage, loggers: Sequence[Any], prefix: str, step: int) -> list[str]:
    """Hand the maps to every logger that takes figures or images.

    A logger takes them by one of these, the first that it has:

    * `log_image(key, images, step)`, as that of Weights & Biases;
    * `add_figure(tag, figure, step)`, its own or that of its `experiment`, as TensorBoard's;
    * `experiment.log_figure(run_id, figure, artifact_file)`, if it has a `run_id`, as MLflow's: into the file
      `TAG/step_STEP.png` of the run;
    * `experiment.log_figure(figure_name, figure, step)`, as Comet's.

    Args:
        coverage: What `CoverageMetric.compute` returned.
        loggers: Lightning's loggers, or objects like them.
        prefix: In front of the tags of `plot_band_maps`, with a slash between.
        step: Where on the logger's axis.

    Returns:
        The names of the classes of the loggers that take neither.
    """
    takers = [(logger, _taker(logger)) for logger in loggers]
    able = [take for _, take in takers if take is not None]
    if able:
        for tag, figure in plot_band_maps(coverage):
            for take in able:
                take(f"{prefix}/{tag}", figure, step)
    return [type(logger).__name__ for logger, take in takers if take is None]


def log_result(result: Any, logger: Any, *, step: int = 0, tag: str = "torchcover") -> None:  # noqa: ANN401  (see below)
    """Hand the rows and the picture of a result to a logger: `TAG/rows` and `TAG/picture`.

    Args:
        result: Any with `to_dataframe()` and `plot()`: what `evaluate`, `map_target_visibility`, `encounter` or a search gave.
        logger: TensorBoard's `SummaryWriter`, a run of Weights & Biases, the module `mlflow` with an active run, or
            Lightning's logger of one of them.
        step: Where on the logger's axis.
        tag: In front of the names, with a slash between.

    Raises:
        TypeError: Another logger.
        ModuleNotFoundError: pandas is not there.
    """
    frame, figure = result.to_dataframe(), result.plot()
    experiment = getattr(logger, "experiment", logger)
    if callable(getattr(experiment, "add_text", None)):
        experiment.add_text(f"{tag}/rows", _markdown(frame), step)
        experiment.add_figure(f"{tag}/picture", figure, step)
    elif callable(getattr(experiment, "log_table", None)):  # the module, or a client that has to be told the run
        run = [logger.run_id] if hasattr(logger, "run_id") else []
        experiment.log_table(*run, data=frame, artifact_file=f"{tag}/rows_{step:08d}.json")
        experiment.log_figure(*run, figure, f"{tag}/picture_{step:08d}.png")
    elif type(experiment).__module__.partition(".")[0] == "wandb":
        from wandb import Image, Table

        shown = {f"{tag}/rows": Table(dataframe=frame), f"{tag}/picture": Image(render_rgb_image(figure))}
        experiment.log(shown, step=step)
    else:
        raise TypeError(
            "logger: a SummaryWriter, a run of Weights & Biases, mlflow, or Lightning's logger of one of them is "
            f"needed; got {type(logger).__name__}"
        )


def _markdown(frame: Any) -> str:  # noqa: ANN401  (a DataFrame)
    """A table as TensorBoard shows it; bars would end a cell, and it shows HTML as such."""
    rows = [list(frame.columns), ["---"] * len(frame.columns), *frame.round(4).astype(str).values.tolist()]
    return "\n".join("| " + " | ".join(escape(str(cell)).replace("|", "&#124;") for cell in row) + " |" for row in rows)


def _taker(logger: Any) -> FigureLogger | None:  # noqa: ANN401  (any logger)
    if callable(log_image := getattr(logger, "log_image", None)):
        return lambda tag, figure, step: log_image(key=tag, images=[render_rgb_image(figure)], step=step)
    experiment = getattr(logger, "experiment", None)
    for owner in (logger, experiment):
        if callable(add_figure := getattr(owner, "add_figure", None)):
            taker: FigureLogger = add_figure
            return taker
    if callable(log_figure := getattr(experiment, "log_figure", None)):
        if hasattr(logger, "run_id"):
            return lambda tag, figure, step: log_figure(logger.run_id, figure, f"{tag}/step_{step:08d}.png")
        return lambda tag, figure, step: log_figure(figure_name=tag, figure=figure, step=step)
    return None


def render_rgb_image(figure: Figure) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 pixels of a figure."""
    canvas: Any = FigureCanvasAgg(figure)  # without types for what it draws
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
