"""Coverage maps as figures and images, for whichever logger takes them."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from torchcover.coverage import Coverage
from torchcover.report import band_figures

# Takes the tag of a figure, the figure, and where on its axis.
Taker = Callable[[str, Figure, int], Any]


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
        prefix: In front of the tags of `band_figures`, with a slash between.
        step: Where on the logger's axis.

    Returns:
        The names of the classes of the loggers that take neither.
    """
    takers = [(logger, _taker(logger)) for logger in loggers]
    able = [take for _, take in takers if take is not None]
    if able:
        for tag, figure in band_figures(coverage):
            for take in able:
                take(f"{prefix}/{tag}", figure, step)
    return [type(logger).__name__ for logger, take in takers if take is None]


def _taker(logger: Any) -> Taker | None:  # noqa: ANN401  (any logger)
    if callable(log_image := getattr(logger, "log_image", None)):
        return lambda tag, figure, step: log_image(key=tag, images=[rgb_image(figure)], step=step)
    experiment = getattr(logger, "experiment", None)
    for owner in (logger, experiment):
        if callable(add_figure := getattr(owner, "add_figure", None)):
            taker: Taker = add_figure
            return taker
    if callable(log_figure := getattr(experiment, "log_figure", None)):
        if hasattr(logger, "run_id"):
            return lambda tag, figure, step: log_figure(logger.run_id, figure, f"{tag}/step_{step:08d}.png")
        return lambda tag, figure, step: log_figure(figure_name=tag, figure=figure, step=step)
    return None


def rgb_image(figure: Figure) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 pixels of a figure."""
    canvas: Any = FigureCanvasAgg(figure)  # without types for what it draws
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
