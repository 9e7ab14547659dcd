"""Frames out of the batches of other people's loops. Imports none of their frameworks."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchcover.data import Frame, FrameBatch

# In place of the index of a frame that only has a name.
UNKNOWN_INDEX = -1


def frames_in(batch: object) -> tuple[Frame, ...]:
    """The frames of a batch that holds frames.

    Args:
        batch: A `FrameBatch` or another object with `frames`, a sequence of `Frame`, or one `Frame`.

    Raises:
        TypeError: Anything else.
    """
    frames = getattr(batch, "frames", batch)
    if isinstance(frames, Frame):
        return (frames,)
    if isinstance(frames, list | tuple) and all(isinstance(frame, Frame) for frame in frames):
        return tuple(frames)
    raise TypeError(
        f"a FrameBatch or a sequence of Frame is needed; got {type(batch).__name__}; say how to get them from a batch, "
        "for example frames_of=lambda batch: batch['frames']"
    )


def sensor_of(frame: Frame, rig: str | None = None) -> Tensor:
    """(N, 3) points of a rig, or of the only one.

    Raises:
        ValueError: The frame has no such rig, or several and none is named.
    """
    if rig is None:
        return frame.sensor
    if rig not in frame.clouds:
        raise ValueError(f"frame {frame.name!r} has no rig {rig!r}; it has {', '.join(frame.clouds)}")
    return frame.clouds[rig]


def frames_of_batch_dict(
    batch_dict: Mapping[str, Any], *, reference: str = "reference_points", vehicle_T_lidar: Tensor | None = None
) -> FrameBatch:
    """The frames of a `batch_dict` of OpenPCDet, before or after `load_data_to_gpu`.

    `points` and the reference have the layout of OpenPCDet's `collate_batch`: the points of all samples in one array,
    the number of the sample in the first column. The points are as the data pipeline left them: cropped to
    POINT_CLOUD_RANGE, and augmented in training.

    Args:
        batch_dict: With `points` (N, 1 + 3 + ...) in metres, the reference (M, 1 + 3 + ...), `batch_size`, and
            `frame_id` (B,) if there are any; arrays or tensors.
        reference: Key of the reference points, which a dataset of one's own has to add.
        vehicle_T_lidar: (4, 4) pose of the points' frame; by default they are in the vehicle frame already.

    Returns:
        One frame for each sample. Its name is the `frame_id`, and so is its index if that is a number; else it is -1.

    Raises:
        ValueError: A key is missing, an array of another shape, a sample number beyond the batch.

    Example:
        >>> points = torch.tensor([[0.0, 1.0, 2.0, 0.0, 0.3], [1.0, 4.0, 5.0, 0.0, 0.9], [1.0, 6.0, 5.0, 0.0, 0.9]])
        >>> batch = frames_of_batch_dict({"points": points, "reference_points": points[:, :4], "batch_size": 2})
        >>> [len(cloud) for cloud in batch.sensor]
        [1, 2]
    """
    for key in ("points", reference, "batch_size"):
        if key not in batch_dict:
            raise ValueError(f"batch_dict has no {key!r}; it has {', '.join(map(str, batch_dict))}")
    size = int(batch_dict["batch_size"])
    names = batch_dict.get("frame_id")
    sensors = _split(batch_dict["points"], size, "points")
    references = _split(batch_dict[reference], size, reference)
    return FrameBatch(
        tuple(
            _frame(sensors[k], references[k], str(names[k]) if names is not None else f"sample {k}", vehicle_T_lidar)
            for k in range(size)
        )
    )


def frames_of_data_batch(
    data_batch: Mapping[str, Any],
    data_samples: Sequence[Mapping[str, Any]],
    *,
    reference: str = "reference_points",
    vehicle_T_lidar: Tensor | None = None,
) -> FrameBatch:
    """The frames of a batch of MMDetection3D, as MMEngine hands it to a metric.

    Args:
        data_batch: With `inputs["points"]`: one (N, 3 + ...) cloud for each sample, in metres.
        data_samples: One dict for each sample, with the (M, 3 + ...) reference points and `sample_idx`. The
            `meta_keys` of `Pack3DDetInputs` carry both there.
        reference: Key of the reference points, which a dataset of one's own has to add.
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
        if reference not in sample:
            raise ValueError(
                f"sample {k} has no {reference!r}; add it to the results in the pipeline and to the meta_keys of "
                "Pack3DDetInputs"
            )
        name = str(sample.get("sample_idx", f"sample {k}"))
        frames.append(_frame(torch.as_tensor(cloud), torch.as_tensor(sample[reference]), name, vehicle_T_lidar))
    return FrameBatch(tuple(frames))


def _split(points: object, size: int, name: str) -> list[Tensor]:
    array = torch.as_tensor(points)
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


def _frame(sensor: Tensor, reference: Tensor, name: str, vehicle_T_lidar: Tensor | None) -> Frame:
    return Frame(
        {"rig": _in_vehicle_frame(sensor, vehicle_T_lidar)},
        _in_vehicle_frame(reference, vehicle_T_lidar),
        index=int(name) if name.isdecimal() else UNKNOWN_INDEX,
        name=name,
    )


def _in_vehicle_frame(points: Tensor, vehicle_T_lidar: Tensor | None) -> Tensor:
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(f"points of shape (N, 3 + ...) are needed; got {tuple(points.shape)}")
    if vehicle_T_lidar is None:
        return points[:, :3].float()
    pose = vehicle_T_lidar.to(points.device).double()
    if pose.shape != (4, 4):
        raise ValueError(f"vehicle_T_lidar: shape (4, 4) is needed; got {tuple(pose.shape)}")
    return (points[:, :3].double() @ pose[:3, :3].T + pose[:3, 3]).float()
