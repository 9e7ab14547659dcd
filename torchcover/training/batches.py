"""Frames from batches, also of OpenPCDet and MMDetection3D; neither framework is needed."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchcover.frames import Frame, FrameBatch
from torchcover.geometry import transform_points_tensor

# Index of a frame that has no number.
UNKNOWN_INDEX = -1


def extract_frames(batch: object) -> tuple[Frame, ...]:
    """Return the frames of a batch.

    Args:
        batch: `FrameBatch` or another object with `frames`, a sequence of `Frame`, or one `Frame`.

    Returns:
        The frames in order.

    Raises:
        TypeError: Another type of batch.
    """
    frames = getattr(batch, "frames", batch)
    if isinstance(frames, Frame):
        return (frames,)
    if isinstance(frames, list | tuple) and all(isinstance(frame, Frame) for frame in frames):
        return tuple(frames)
    raise TypeError(
        f"a FrameBatch or a sequence of Frame is needed; got {type(batch).__name__}; say how to get them from a batch, "
        "for example get_frames=lambda batch: batch['frames']"
    )


def build_frame(sensor: Tensor, reference: Tensor, name: object, vehicle_T_lidar: Tensor | None) -> Frame:
    """Build a frame from the points of another framework.

    Args:
        sensor: (N, 3 + ...) points of the rig.
        reference: (M, 3 + ...) points of the reference sensor.
        name: Name of the sample; a number becomes its index; None if unknown.
        vehicle_T_lidar: (4, 4) pose of the frame of the points; None: they are in the vehicle frame.

    Returns:
        Frame with the rig `rig`.
    """
    name = "" if name is None else str(name)
    return Frame(
        {"rig": _transform_to_vehicle_frame(sensor, vehicle_T_lidar)},
        _transform_to_vehicle_frame(reference, vehicle_T_lidar),
        index=int(name) if name.isdecimal() else UNKNOWN_INDEX,
        name=name,
    )


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


def _transform_to_vehicle_frame(points: Tensor, vehicle_T_lidar: Tensor | None) -> Tensor:
    """Transform points from the LiDAR frame to the vehicle frame."""
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(f"points of shape (N, 3 + ...) are needed; got {tuple(points.shape)}")
    if vehicle_T_lidar is None:
        return points[:, :3].float()
    if vehicle_T_lidar.shape != (4, 4):
        raise ValueError(f"vehicle_T_lidar: shape (4, 4) is needed; got {tuple(vehicle_T_lidar.shape)}")
    # The transform precedes the conversion to float32, in which UTM coordinates would lose decimeters.
    return transform_points_tensor(vehicle_T_lidar, points[:, :3].double()).float()


def _split_samples(points: object, batch_size: int, name: str) -> list[Tensor]:
    """Split collated points by the sample index in their first column."""
    array = _to_tensor(points)
    if array.ndim != 2 or array.shape[1] < 4:
        raise ValueError(
            f"{name}: shape (N, 1 + 3 + ...), the number of the sample first, is needed; got {tuple(array.shape)}"
        )
    sample_indices = array[:, 0].long()
    if bool(((sample_indices < 0) | (sample_indices >= batch_size)).any()):
        low, high = int(sample_indices.min()), int(sample_indices.max())
        raise ValueError(f"{name}: sample numbers 0 to {batch_size - 1} are needed; got {low} to {high}")
    return [array[sample_indices == index, 1:] for index in range(batch_size)]


def _to_tensor(points: object) -> Tensor:
    return points if isinstance(points, Tensor) else torch.as_tensor(points, device="cpu")
