"""Coverage as a metric of MMEngine, for MMDetection3D, and a transform that it needs. Importing this registers both."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch

try:
    from mmengine.evaluator import BaseMetric
    from mmengine.registry import METRICS, TRANSFORMS
except ImportError as error:
    raise ImportError("MMEngineCoverage needs MMEngine: pip install mmengine (or mmengine-lite)") from error
from mmengine.dist import get_comm_device, get_dist_info

from torchcover.coverage import BevGrid, Coverage, CoverageMetric, Region
from torchcover.frames import Frame
from torchcover.training.batches import UNKNOWN_INDEX, extract_frames
from torchcover.training.counting import FrameDeduplicator, Shard
from torchcover.training.mmdetection3d import convert_data_batch


@TRANSFORMS.register_module()
class PackWithReference:
    """The last transform of a pipeline: packs as another does, and keeps the reference points beside its `meta_keys`.

    Args:
        pack: The other, such as `Pack3DDetInputs`, or its config.
        reference_key: Key of the reference points, which a dataset of one's own has to add.

    Raises:
        ValueError: When it is called: the results have no reference points.
    """

    def __init__(self, pack: Any, reference_key: str = "reference_points") -> None:  # noqa: ANN401  (any transform)
        self.pack = TRANSFORMS.build(pack) if isinstance(pack, Mapping) else pack
        self.reference_key = reference_key

    def __call__(self, results: Any) -> Any:  # noqa: ANN401  (of one sample, or of each augmentation of it)
        """What the other packs of it; `data_samples` has the reference points, too."""
        each = results if isinstance(results, list) else [results]
        if any(self.reference_key not in one for one in each):
            raise ValueError(
                f"the results have no {self.reference_key!r}: let the dataset, or a transform before, add it"
            )
        references = [one[self.reference_key] for one in each]
        packed = self.pack(results)
        for one, reference in zip(packed if isinstance(packed, list) else [packed], references, strict=True):
            one["data_samples"].set_metainfo({self.reference_key: reference})
        return packed


@METRICS.register_module()
class MMEngineCoverage(BaseMetric):  # type: ignore[misc]  # MMEngine has no types
    """Coverage of the frames that a model is validated on, under the names of `Coverage.scalars`.

    Where a `BaseMetric` gathers a result for each sample, this adds up fixed-size sums, which are reduced over the
    processes. Padding samples and those that come again are left out, see `FrameDeduplicator`.

    Args:
        metric: A `CoverageMetric`, or its arguments as a config has them, with `grid` as a dict of those of `BevGrid`.
        regions: Regions to report, or dicts of their arguments; those of the paper that fit the grid if not given.
        vehicle_T_lidar: (4, 4) pose of the points' frame, as `convert_data_batch` takes it.
        get_frames: Gives the frames from `data_batch` and `data_samples`; `convert_data_batch` if not given.
        prefix: In front of the names, with a slash between; "coverage" if not given.

    Attributes:
        coverage: The last `Coverage` that was evaluated; None before.

    Example:
        >>> metric = MMEngineCoverage({"grid": {"x_m": (0.0, 20.0), "y_m": (-5.0, 5.0)}, "max_radius_m": 25.0})
        >>> points = torch.tensor([[3.0, 1.0, 0.0], [7.0, 0.0, 0.0]])
        >>> sample = {"sample_idx": 0, "reference_points": torch.tensor([[3.0, 1.0, 0.3]])}
        >>> metric.process({"inputs": {"points": [points]}}, [sample])
        >>> round(metric.evaluate(size=1)["coverage/radius_m/20m/ground"], 3)
        0.3
    """

    default_prefix = "coverage"

    def __init__(
        self,
        metric: CoverageMetric | Mapping[str, Any],
        *,
        regions: Sequence[Region | Mapping[str, Any]] | None = None,
        vehicle_T_lidar: Sequence[Sequence[float]] | None = None,
        get_frames: Callable[[Any, Any], Any] | None = None,
        prefix: str | None = None,
    ) -> None:
        super().__init__(prefix=prefix)
        self.metric = metric if isinstance(metric, CoverageMetric) else _metric_of(metric)
        self.regions = None if regions is None else [r if isinstance(r, Region) else Region(**r) for r in regions]
        pose = None if vehicle_T_lidar is None else torch.as_tensor(vehicle_T_lidar, dtype=torch.float64, device="cpu")
        self.get_frames = get_frames or partial(convert_data_batch, vehicle_T_lidar=pose)
        self.coverage: Coverage | None = None
        self._once = FrameDeduplicator()

    def process(self, data_batch: Any, data_samples: Sequence[Mapping[str, Any]]) -> None:  # noqa: ANN401  (MMEngine's)
        """Add the frames of a batch.

        Raises:
            ValueError: As `CoverageMetric.update`, or reference points without the square metres that the metric wants.
        """
        self._add(extract_frames(self.get_frames(data_batch, data_samples)), size=None)

    def _add(self, frames: Sequence[Frame], size: int | None) -> None:
        rank, processes = get_dist_info()
        for frame in self._once.select_new(frames, Shard(rank, processes, size)):
            index = None if frame.index == UNKNOWN_INDEX else frame.block_index
            self.metric.update(
                frame.sensor,
                frame.reference,
                errors_m=frame.get_errors_m(),
                weights=frame.reference_weights,
                heights_m=frame.get_heights_m(self.metric.grid.band_frame),
                block_index=index,
            )

    def compute_metrics(self, results: list[Any]) -> dict[str, float]:
        """The coverage so far of all processes; `results` stays empty."""
        coverage: Coverage = self.metric.compute()
        self.coverage = coverage
        return coverage.scalars(self.regions)

    def evaluate(self, size: int) -> dict[str, float]:
        """Add what was held back unless it is padding, add up the processes, and start anew.

        Args:
            size: Number of samples in the dataset. Of what a sampler deals out in turns, the rest is padding.

        Returns:
            The numbers under `prefix/`, the same on every process.
        """
        self._add([], size)
        self.metric.to(get_comm_device())  # processes on GPUs exchange nothing that lies on the CPU
        self.metric.update([], [], weights=[])  # a process that was dealt nothing but padding has not updated yet
        scalars = self.compute_metrics(self.results)
        self.metric.reset()
        self._once.start_epoch()
        return {f"{self.prefix}/{name}": value for name, value in scalars.items()}


def _metric_of(arguments: Mapping[str, Any]) -> CoverageMetric:
    grid = arguments["grid"]
    return CoverageMetric(**{**arguments, "grid": grid if isinstance(grid, BevGrid) else BevGrid(**grid)})
