"""What a user writes, under `mypy --strict` (`make types`): nothing in it may need a cast or an ignore."""

from torchmetrics import MetricCollection
from torchmetrics.wrappers import MetricTracker

from torchcover import BevGrid, Coverage, CoverageMetric, Region
from torchcover.coverage import CoverageNumber
from torchcover.data import ChosenRigs, Frame, RecordedFrames, SimulatedFrames


def measured(frames: SimulatedFrames | RecordedFrames | ChosenRigs) -> Coverage:
    """A loop over any source of frames."""
    metric = CoverageMetric(BevGrid(x=(0.0, 20.0), y=(-5.0, 5.0)), max_radius=25.0)
    for frame in frames:
        metric.update(frame.sensor, frame.reference, weights=frame.reference_weights, index=frame.place_in_time)
    return metric.compute()


def names(frames: RecordedFrames) -> list[str]:
    """What is in a loop is a frame."""
    first: Frame = next(iter(frames))
    return [first.name, *(frame.name for frame in frames)]


def best(frames: RecordedFrames) -> object:
    """The best of several runs by torchmetrics' tracker, and a picture of what was measured."""
    grid, near = BevGrid(x=(0.0, 20.0), y=(-5.0, 5.0)), Region("near", x=(0.0, 20.0), y=(-5.0, 5.0))
    tracker = MetricTracker(MetricCollection({"near": CoverageNumber("detection_0.4m", near, "ground", grid)}))
    tracker.increment()
    for frame in frames:
        tracker.update(frame.sensor, frame.reference, weights=frame.reference_weights)
    figure, axes = CoverageMetric(grid).plot(height="ground")
    figure.suptitle(axes.get_title())
    return tracker.best_metric()
