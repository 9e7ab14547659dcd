"""Frames out of OpenPCDet's batches. Needs nothing of OpenPCDet."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchcover.frames import FrameBatch
from torchcover.training.batches import build_frame


def convert_batch_dict(
    batch_dict: Mapping[str, Any], *, reference_key: str = "reference_points", vehicle_T_lidar: Tensor | None = None
) -> FrameBatch:
    """The frames of a `batch_dict` of OpenPCDet, before or after `load_data_to_gpu`.

    `points` and the reference have the layout of OpenPCDet's `collate_batch`: the points of all samples in one array,
    the number of the sample in the first column. The points are as the data pipeline left them: cropped to
    POINT_CLOUD_RANGE, and augmented in training.

    Args:
        batch_dict: With `points` (N, 1 + 3 + ...) in metres, the reference (M, 1 + 3 + ...), `batch_size`, and
            `frame_id` (B,) if there are any; arrays or tensors.
        reference_key: Key of the reference points, which a dataset of one's own has to add.
        vehicle_T_lidar: (4, 4) pose of the points' frame; by default they are in the vehicle frame already.

    Returns:
        One frame for each sample. Its name is the `frame_id`, and so is its index if that is a number; else it is -1.
        Without `frame_id` the name is empty, and `FrameDeduplicator` cannot tell whether a sample comes again.

    Raises:
        ValueError: A key is missing, an array of another shape, a sample number beyond the batch.

    Example:
        >>> points = torch.tensor([[0.0, 1.0, 2.0, 0.0, 0.3], [1.0, 4.0, 5.0, 0.0, 0.9], [1.0, 6.0, 5.0, 0.0, 0.9]])
        >>> batch = convert_batch_dict({"points": points, "reference_points": points[:, :4], "batch_size": 2})
        >>> [len(cloud) for cloud in batch.sensor]
        [1, 2]
    """
    for key in ("points", reference_key, "batch_size"):
        if key not in batch_dict:
            raise ValueError(f"batch_dict has no {key!r}; it has {', '.join(map(str, batch_dict))}")
    size = int(batch_dict["batch_size"])
    names = batch_dict.get("frame_id")
    sensors = _split(batch_dict["points"], size, "points")
    references = _split(batch_dict[reference_key], size, reference_key)
    return FrameBatch(
        tuple(
            build_frame(sensors[k], references[k], None if names is None else names[k], vehicle_T_lidar)
            for k in range(size)
        )
    )


def _split(points: object, size: int, name: str) -> list[Tensor]:
    array = points if isinstance(points, Tensor) else torch.as_tensor(points, device="cpu")
    if array.ndim != 2 or array.shape[1] < 4:
        raise ValueError(
            f"{name}: shape (N, 1 + 3 + ...), the number of the sample first, is needed; got {tuple(array.shape)}"
        )
    sample = array[:, 0].long()
    if bool(((sample < 0) | (sample >= size)).any()):
        raise ValueError(
            f"{name}: sample numbers 0 to {size - 1} are needed; got {int(sample.min())} to {int(sample.max())}"
        )
    return [array[sample == k, 1:] for k in range(size)]
