"""What a user writes, under `mypy --strict` (`make types`): nothing that is right needs a cast or an ignore."""

from pathlib import Path

import torch
from torchmetrics import MetricCollection
from torchmetrics.wrappers import MetricTracker

from torchcover import BevGrid, Coverage, CoverageMetric, Region, compare, evaluate
from torchcover.coverage import CoverageNumberMetric
from torchcover.data import Frame, FrameDataset, FrameMetadata, RecordedFrames, SimulatedFrames


def measured(frames: FrameDataset) -> Coverage:
    """A loop over any source of frames."""
    metric = CoverageMetric(BevGrid(x_m=(0.0, 20.0), y_m=(-5.0, 5.0)), max_radius_m=25.0)
    for frame in frames:
        metric.update(frame.sensor, frame.reference, weights=frame.reference_weights, block_index=frame.block_index)
    return metric.compute()


def compared(rigs: list[Path], frames: SimulatedFrames) -> list[float]:
    """Arguments in each of their forms, and what `evaluate` gives."""
    one = evaluate(
        "front_roof_128", "urban", num_frames=64, thresholds_m=0.4, device=torch.device("cpu"), metrics="all"
    )
    several = evaluate(
        rigs, frames=frames, thresholds_m=(0.4, 1.0), regions="regions.yaml", target_error=["1%", "0.02m"]
    )
    evaluate("front_roof_128", stepz=64)  # type: ignore[call-arg]  # an argument that there is not
    evaluate("front_roof_128", num_frames="64")  # type: ignore[arg-type]
    return [float(coverage.radius.nanmean()) for coverage in compare([one, several, "saved.npz"]).coverages.values()]


class ConstantFrames(FrameDataset):
    """A source of frames that a user writes."""

    metadata = FrameMetadata(rigs=("roof",), description={"frames": "constant"})

    def __len__(self) -> int:
        return 2

    def make_frame(self, index: int) -> Frame:
        return Frame({"roof": torch.zeros(1, 3)}, torch.ones(1, 3), index, f"frame {index}")


def names(frames: RecordedFrames) -> list[str]:
    """What is in a loop is a frame."""
    first: Frame = next(iter(frames))
    return [first.name, *(frame.name for frame in frames)]


def best(frames: RecordedFrames) -> object:
    """The best of several runs by torchmetrics' tracker, and a picture of what was measured."""
    grid, near = BevGrid(x_m=(0.0, 20.0), y_m=(-5.0, 5.0)), Region("near", x_m=(0.0, 20.0), y_m=(-5.0, 5.0))
    tracker = MetricTracker(MetricCollection({"near": CoverageNumberMetric("detection_0.4m", near, "ground", grid)}))
    tracker.increment()
    for frame in frames:
        tracker.update(frame.sensor, frame.reference, weights=frame.reference_weights)
    figure, axes = CoverageMetric(grid).plot(band="ground")
    figure.suptitle(axes.get_title())
    return tracker.best_metric()
