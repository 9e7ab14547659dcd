"""What the adapters to all frameworks need of batches and frames."""

from torch import Tensor

from torchcover.frames import Frame
from torchcover.geometry import transform_points_tensor

# In place of the index of a frame that only has a name, or not even that.
UNKNOWN_INDEX = -1


def extract_frames(batch: object) -> tuple[Frame, ...]:
    """The frames of a `FrameBatch` or another object with `frames`, of a sequence of `Frame`, or one `Frame`."""
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
    """A frame out of another framework's (N, 3 + ...) points of the rig and (M, 3 + ...) of the reference sensor.

    `name` is what that calls the sample, and its index if it is a number; None: neither is known. Without
    `vehicle_T_lidar` the points are in the vehicle frame already.
    """
    name = "" if name is None else str(name)
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
    if vehicle_T_lidar.shape != (4, 4):
        raise ValueError(f"vehicle_T_lidar: shape (4, 4) is needed; got {tuple(vehicle_T_lidar.shape)}")
    # From the points as they came: rounded first, UTM-sized ones would lose decimetres.
    return transform_points_tensor(vehicle_T_lidar, points[:, :3].double()).float()
