"""Frames from batches of MMDetection3D; neither MMDetection3D nor MMEngine is needed."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchcover.frames import FrameBatch
from torchcover.training.batches import build_frame


def convert_data_batch(
    data_batch: Mapping[str, Any],
    data_samples: Sequence[Mapping[str, Any]],
    *,
    reference_key: str = "reference_points",
    vehicle_T_lidar: Tensor | None = None,
) -> FrameBatch:
    """Convert a batch of MMDetection3D, as MMEngine passes it to a metric, to frames.

    Args:
        data_batch: Batch with `inputs["points"]`: one (N, 3 + ...) cloud per sample in meters.
        data_samples: One dict per sample with (M, 3 + ...) reference points, which `PackWithReference` of
            `torchcover.training.mmengine` adds, and `sample_idx`.
        reference_key: Key of the reference points, which a custom dataset has to add.
        vehicle_T_lidar: (4, 4) pose of the frame of the points; by default they are in the vehicle frame.

    Returns:
        One frame per sample. Its name is the `sample_idx`, which is also its index if it is an integer; otherwise the
        index is -1.

    Raises:
        ValueError: Points or reference points are missing, or the numbers of clouds and samples differ.
    """
    clouds = data_batch.get("inputs", {}).get("points")
    if clouds is None or len(clouds) != len(data_samples):
        raise ValueError(
            f"inputs['points']: a cloud for each of the {len(data_samples)} samples is needed; "
            f"got {'none' if clouds is None else len(clouds)}"
        )
    frames = []
    for index, (cloud, sample) in enumerate(zip(clouds, data_samples, strict=True)):
        if reference_key not in sample:
            raise ValueError(
                f"sample {index} has no {reference_key!r}; add it to the results in the pipeline, and pack them with "
                "PackWithReference of torchcover.training.mmengine"
            )
        points, reference = _to_tensor(cloud), _to_tensor(sample[reference_key])
        frames.append(build_frame(points, reference, sample.get("sample_idx"), vehicle_T_lidar))
    return FrameBatch(tuple(frames))


def _to_tensor(points: object) -> Tensor:
    return points if isinstance(points, Tensor) else torch.as_tensor(points, device="cpu")
