"""Logging of maps, figures and tables of results with different loggers."""

from collections.abc import Callable, Sequence
from functools import partial
from html import escape
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from torchcover.coverage import Coverage
from torchcover.report import plot_band_maps

# Function that logs a figure with a tag at a step.
FigureLogger = Callable[[str, Figure, int], Any]


def log_maps(coverage: Coverage, loggers: Sequence[Any], prefix: str, step: int) -> list[str]:
    """Log coverage maps with every logger that accepts figures or images.

    The first available method of a logger is used:

    * `log_image(key, images, step)`, as in Weights & Biases;
    * `add_figure(tag, figure, step)` of the logger or of its `experiment`, as in TensorBoard;
    * `experiment.log_figure(run_id, figure, artifact_file)` of loggers with a `run_id`, as in MLflow: the file
      `TAG/step_STEP.png` of the run;
    * `experiment.log_figure(figure_name, figure, step)`, as in Comet.

    Args:
        coverage: Result of `CoverageMetric.compute`.
        loggers: Loggers of Lightning, or similar objects.
        prefix: Prefix of the tags of `plot_band_maps`, separated by a slash.
        step: Step on the axis of the logger.

    Returns:
        Class names of the loggers without any of these methods.
    """
    figure_loggers, unsupported = [], []
    for logger in loggers:
        log_figure = _find_figure_logger(logger)
        if log_figure is None:
            unsupported.append(type(logger).__name__)
        else:
            figure_loggers.append(log_figure)
    if figure_loggers:
        for tag, figure in plot_band_maps(coverage):
            for log_figure in figure_loggers:
                log_figure(f"{prefix}/{tag}", figure, step)
    return unsupported


def log_result(result: Any, logger: Any, *, step: int = 0, tag: str = "torchcover") -> None:  # noqa: ANN401  (see below)
    """Log the table and the figure of a result as `TAG/rows` and `TAG/picture`.

    Args:
        result: Object with `to_dataframe()` and `plot()`: the result of `evaluate`, `map_target_visibility`,
            `evaluate_encounters` or a search.
        logger: TensorBoard `SummaryWriter`, run of Weights & Biases, module `mlflow` with an active run, or the
            Lightning logger of one of them.
        step: Step on the axis of the logger.
        tag: Prefix of the names, separated by a slash.

    Raises:
        TypeError: The logger has another type.
        ModuleNotFoundError: pandas is not installed.
    """
    table, figure = result.to_dataframe(), result.plot()
    experiment = getattr(logger, "experiment", logger)
    if callable(getattr(experiment, "add_text", None)):
        experiment.add_text(f"{tag}/rows", _format_markdown(table), step)
        experiment.add_figure(f"{tag}/picture", figure, step)
    elif callable(getattr(experiment, "log_table", None)):  # the mlflow module, or its client, which needs the run id
        run_id = [logger.run_id] if hasattr(logger, "run_id") else []
        experiment.log_table(*run_id, data=table, artifact_file=f"{tag}/rows_{step:08d}.json")
        experiment.log_figure(*run_id, figure, f"{tag}/picture_{step:08d}.png")
    elif type(experiment).__module__.partition(".")[0] == "wandb":
        from wandb import Image, Table

        media = {f"{tag}/rows": Table(dataframe=table), f"{tag}/picture": Image(render_rgb_image(figure))}
        experiment.log(media, step=step)
    else:
        raise TypeError(
            "logger: a SummaryWriter, a run of Weights & Biases, mlflow, or Lightning's logger of one of them is "
            f"needed; got {type(logger).__name__}"
        )


def _format_markdown(table: Any) -> str:  # noqa: ANN401  (a DataFrame)
    """Format a table for TensorBoard, which renders HTML; bars would end a cell."""
    rows = [list(table.columns), ["---"] * len(table.columns), *table.round(4).astype(str).values.tolist()]
    lines = []
    for row in rows:
        cells = [escape(str(cell)).replace("|", "&#124;") for cell in row]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _find_figure_logger(logger: Any) -> FigureLogger | None:  # noqa: ANN401  (any logger)
    """Find the function with which a logger logs figures; None without one."""
    experiment = getattr(logger, "experiment", None)
    if callable(getattr(logger, "log_image", None)):
        return partial(_log_with_wandb, logger)
    for owner in (logger, experiment):
        add_figure: FigureLogger | None = getattr(owner, "add_figure", None)
        if callable(add_figure):
            return add_figure
    if callable(getattr(experiment, "log_figure", None)):
        return partial(_log_with_mlflow if hasattr(logger, "run_id") else _log_with_comet, logger)
    return None


def _log_with_wandb(logger: Any, tag: str, figure: Figure, step: int) -> None:  # noqa: ANN401  (any logger)
    logger.log_image(key=tag, images=[render_rgb_image(figure)], step=step)


def _log_with_mlflow(logger: Any, tag: str, figure: Figure, step: int) -> None:  # noqa: ANN401  (any logger)
    logger.experiment.log_figure(logger.run_id, figure, f"{tag}/step_{step:08d}.png")


def _log_with_comet(logger: Any, tag: str, figure: Figure, step: int) -> None:  # noqa: ANN401  (any logger)
    logger.experiment.log_figure(figure_name=tag, figure=figure, step=step)


def render_rgb_image(figure: Figure) -> NDArray[np.uint8]:
    """Render a figure to pixels.

    Args:
        figure: Figure, rendered at its own resolution.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    canvas: Any = FigureCanvasAgg(figure)  # the stubs do not describe the buffer
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
