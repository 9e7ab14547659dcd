"""Coverage metric for MMEngine and MMDetection3D, with the transform that it needs; importing registers both."""

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
from torchcover.training.batches import UNKNOWN_INDEX, convert_data_batch, extract_frames
from torchcover.training.counting import FrameDeduplicator, Shard


@TRANSFORMS.register_module()
class PackWithReference:
    """Last transform of a pipeline: packs results with another transform, and adds the reference points.

    Args:
        pack: Packing transform, such as `Pack3DDetInputs`, or its config.
        reference_key: Key of the reference points, which a custom dataset has to add.

    Raises:
        ValueError: When it is called: the results have no reference points.
    """

    def __init__(self, pack: Any, reference_key: str = "reference_points") -> None:  # noqa: ANN401  (any transform)
        self.pack = TRANSFORMS.build(pack) if isinstance(pack, Mapping) else pack
        self.reference_key = reference_key

    def __call__(self, results: Any) -> Any:  # noqa: ANN401  (of one sample, or a list with one per augmentation)
        """Pack results, with the reference points in their `data_samples`."""
        references = []
        for result in results if isinstance(results, list) else [results]:
            if self.reference_key not in result:
                raise ValueError(
                    f"the results have no {self.reference_key!r}: let the dataset, or a transform before, add it"
                )
            references.append(result[self.reference_key])
        packed = self.pack(results)
        for inputs, reference in zip(packed if isinstance(packed, list) else [packed], references, strict=True):
            inputs["data_samples"].set_metainfo({self.reference_key: reference})
        return packed


@METRICS.register_module()
class MMEngineCoverage(BaseMetric):  # type: ignore[misc]  # MMEngine has no types
    """Coverage of the frames on which a model is validated, with the names of `Coverage.scalars`.

    Other than `BaseMetric`, which collects a result per sample, this metric adds up sums of fixed size, which are
    reduced over processes. Padding samples and repeated samples are excluded, see `FrameDeduplicator`.

    Args:
        metric: `CoverageMetric`, or its arguments as a config with `grid` as a dict of the arguments of `BevGrid`.
        regions: Regions to report, or dicts of their arguments; by default the regions of the paper that fit the grid.
        vehicle_T_lidar: (4, 4) pose of the frame of the points, as in `convert_data_batch`.
        get_frames: Function from `data_batch` and `data_samples` to frames; by default `convert_data_batch`.
        prefix: Prefix of the names, separated by a slash; by default "coverage".

    Attributes:
        coverage: Last evaluated `Coverage`; None before.

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
        self.metric = metric if isinstance(metric, CoverageMetric) else _build_metric(metric)
        self.regions: list[Region] | None = None
        if regions is not None:
            self.regions = [region if isinstance(region, Region) else Region(**region) for region in regions]
        transform = None
        if vehicle_T_lidar is not None:
            transform = torch.as_tensor(vehicle_T_lidar, dtype=torch.float64, device="cpu")
        self.get_frames = get_frames or partial(convert_data_batch, vehicle_T_lidar=transform)
        self.coverage: Coverage | None = None
        self._deduplicator = FrameDeduplicator()

    def process(self, data_batch: Any, data_samples: Sequence[Mapping[str, Any]]) -> None:  # noqa: ANN401  (MMEngine's)
        """Add the frames of a batch.

        Args:
            data_batch: Batch of the data loader.
            data_samples: Outputs of the model for each sample.

        Raises:
            ValueError: As in `CoverageMetric.update`, or the reference points lack the area weights of the metric.
        """
        self._add_frames(extract_frames(self.get_frames(data_batch, data_samples)), num_samples=None)

    def _add_frames(self, frames: Sequence[Frame], num_samples: int | None) -> None:
        """Add the frames that no other process counts."""
        rank, num_processes = get_dist_info()
        for frame in self._deduplicator.select_new(frames, Shard(rank, num_processes, num_samples)):
            block_index = None if frame.index == UNKNOWN_INDEX else frame.block_index
            self.metric.update(
                frame.sensor,
                frame.reference,
                errors_m=frame.get_errors_m(),
                weights=frame.reference_weights,
                heights_m=frame.get_heights_m(self.metric.grid.band_frame),
                block_index=block_index,
            )

    def compute_metrics(self, results: list[Any]) -> dict[str, float]:
        """Compute the scalars of all processes.

        Args:
            results: Unused; it stays empty.
        """
        coverage: Coverage = self.metric.compute()
        self.coverage = coverage
        return coverage.scalars(self.regions)

    def evaluate(self, size: int) -> dict[str, float]:
        """Evaluate all processes at the end of an epoch, and reset.

        Args:
            size: Number of samples in the dataset; further samples are padding.

        Returns:
            Scalars with the prefix, equal on every process.
        """
        self._add_frames([], size)
        self.metric.to(get_comm_device())  # processes on GPUs cannot exchange tensors on the CPU
        self.metric.update([], [], weights=[])  # torchmetrics requires an update, even with padding only
        scalars = self.compute_metrics(self.results)
        self.metric.reset()
        self._deduplicator.start_epoch()
        return {f"{self.prefix}/{name}": value for name, value in scalars.items()}


def _build_metric(arguments: Mapping[str, Any]) -> CoverageMetric:
    grid = arguments["grid"]
    return CoverageMetric(**{**arguments, "grid": grid if isinstance(grid, BevGrid) else BevGrid(**grid)})
