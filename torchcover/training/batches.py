"""Construction of frames from batches, shared by the adapters to all frameworks."""

from torch import Tensor

from torchcover.frames import Frame
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
