"""Frames out of MMDetection3D's batches. Needs nothing of MMDetection3D or MMEngine."""

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
    """The frames of a batch of MMDetection3D, as MMEngine hands it to a metric.

    Args:
        data_batch: With `inputs["points"]`: one (N, 3 + ...) cloud for each sample, in metres.
        data_samples: One dict for each sample, with the (M, 3 + ...) reference points, which `PackWithReference` of
            `torchcover.training.mmengine` carries there, and `sample_idx`.
        reference_key: Key of the reference points, which a dataset of one's own has to add.
        vehicle_T_lidar: (4, 4) pose of the points' frame; by default they are in the vehicle frame already.

    Returns:
        One frame for each sample. Its name is the `sample_idx`, and so is its index if that is a number; else it is -1.

    Raises:
        ValueError: No points, no reference points, or not as many clouds as samples.
    """
    clouds = data_batch.get("inputs", {}).get("points")
    if clouds is None or len(clouds) != len(data_samples):
        raise ValueError(
            f"inputs['points']: a cloud for each of the {len(data_samples)} samples is needed; "
            f"got {'none' if clouds is None else len(clouds)}"
        )
    frames = []
    for k, (cloud, sample) in enumerate(zip(clouds, data_samples, strict=True)):
        if reference_key not in sample:
            raise ValueError(
                f"sample {k} has no {reference_key!r}; add it to the results in the pipeline, and pack them with "
                "PackWithReference of torchcover.training.mmengine"
            )
        points, reference_points = (
            each if isinstance(each, Tensor) else torch.as_tensor(each, device="cpu")
            for each in (cloud, sample[reference_key])
        )
        frames.append(build_frame(points, reference_points, sample.get("sample_idx"), vehicle_T_lidar))
    return FrameBatch(tuple(frames))
