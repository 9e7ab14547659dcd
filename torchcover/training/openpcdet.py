"""Frames from batches of OpenPCDet; OpenPCDet itself is not needed."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchcover.frames import FrameBatch
from torchcover.training.batches import build_frame


def convert_batch_dict(
    batch_dict: Mapping[str, Any], *, reference_key: str = "reference_points", vehicle_T_lidar: Tensor | None = None
) -> FrameBatch:
    """Convert a `batch_dict` of OpenPCDet to frames, before or after `load_data_to_gpu`.

    `points` and the reference points have the layout of `collate_batch` of OpenPCDet: the points of all samples in one
    array, with the index of the sample in the first column. The points come from the data pipeline: cropped to
    POINT_CLOUD_RANGE, and augmented in training.

    Args:
        batch_dict: `points` (N, 1 + 3 + ...) in meters, reference points (M, 1 + 3 + ...), `batch_size`, and optionally
            `frame_id` (B,); arrays or tensors.
        reference_key: Key of the reference points, which a custom dataset has to add.
        vehicle_T_lidar: (4, 4) pose of the frame of the points; by default they are in the vehicle frame.

    Returns:
        One frame per sample. Its name is the `frame_id`, which is also its index if it is an integer; otherwise the
        index is -1. Without `frame_id` the name is empty, and `FrameDeduplicator` cannot recognize repeated samples.

    Raises:
        ValueError: A key is missing, an array has another shape, or a sample index is outside of the batch.

    Example:
        >>> points = torch.tensor([[0.0, 1.0, 2.0, 0.0, 0.3], [1.0, 4.0, 5.0, 0.0, 0.9], [1.0, 6.0, 5.0, 0.0, 0.9]])
        >>> batch = convert_batch_dict({"points": points, "reference_points": points[:, :4], "batch_size": 2})
        >>> [len(cloud) for cloud in batch.sensor]
        [1, 2]
    """
    for key in ("points", reference_key, "batch_size"):
        if key not in batch_dict:
            raise ValueError(f"batch_dict has no {key!r}; it has {', '.join(str(name) for name in batch_dict)}")
    batch_size = int(batch_dict["batch_size"])
    names = batch_dict.get("frame_id")
    if names is None:
        names = [None] * batch_size
    clouds = _split_samples(batch_dict["points"], batch_size, "points")
    references = _split_samples(batch_dict[reference_key], batch_size, reference_key)
    frames = []
    for index in range(batch_size):
        frames.append(build_frame(clouds[index], references[index], names[index], vehicle_T_lidar))
    return FrameBatch(tuple(frames))


def _split_samples(points: object, batch_size: int, name: str) -> list[Tensor]:
    """Split collated points by the sample index in their first column."""
    array = points if isinstance(points, Tensor) else torch.as_tensor(points, device="cpu")
    if array.ndim != 2 or array.shape[1] < 4:
        raise ValueError(
            f"{name}: shape (N, 1 + 3 + ...), the number of the sample first, is needed; got {tuple(array.shape)}"
        )
    sample_indices = array[:, 0].long()
    if bool(((sample_indices < 0) | (sample_indices >= batch_size)).any()):
        low, high = int(sample_indices.min()), int(sample_indices.max())
        raise ValueError(f"{name}: sample numbers 0 to {batch_size - 1} are needed; got {low} to {high}")
    return [array[sample_indices == index, 1:] for index in range(batch_size)]
