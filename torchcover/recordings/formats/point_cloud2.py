"""The points of a message `sensor_msgs/msg/PointCloud2`."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.recordings.clouds.arrays import Points

# The data types of fields, by their numbers.
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
# What drivers call the time of a point: whole numbers are nanoseconds, others seconds, unless they are too large for
# that; since the time of the message, or since 1970. And the number of its laser.
TIME_FIELDS = ("t", "time", "timestamp", "time_stamp", "offset_time", "time_offset")
ROW_FIELDS = ("ring", "channel", "laser_number", "laser_id", "line")
ABSOLUTE_S, ABSOLUTE_NS = 1e6, 1e15
# No LiDAR takes longer for a turn.
LONGEST_TURN_S = 1.0


class CloudMessage(NamedTuple):
    """A cloud: (N, 3) points in the frame of the sensor, also those that are not finite, and (N,) the laser of each.

    `stamp_ns` is the time of the message, 0 if its sender gave none, `offsets_s` (N,) when each was measured since
    then.
    """

    points_m: Points
    stamp_ns: int
    offsets_s: NDArray[np.float64] | None
    rows: NDArray[np.integer] | None


def cloud_of(message: Any) -> CloudMessage:  # noqa: ANN401  (of a type that rosbags has made)
    """Read the fields x, y, z, and the time of each point if there is one."""
    fields = {field.name: field for field in message.fields}
    times = next((fields[name] for name in TIME_FIELDS if name in fields), None)
    wanted = [fields[axis] for axis in "xyz" if axis in fields]
    if len(wanted) < 3 or any(field.datatype not in (7, 8) for field in wanted):
        told = ", ".join(f"{field.name} ({TYPES.get(field.datatype, field.datatype)})" for field in message.fields)
        raise ValueError(f"fields x, y, z of float32 or float64 are needed; got {told or 'none'}")
    ring = next((fields[name] for name in ROW_FIELDS if name in fields), None)
    table = _table(message, [*wanted, *(field for field in (times, ring) if field is not None)])
    rows = table[ring.name].astype(np.int64) if ring is not None and ring.datatype < 7 else None
    points_m: Points = np.stack([table[axis] for axis in "xyz"], axis=1)
    if points_m.dtype.byteorder == ">":
        points_m = points_m.astype(points_m.dtype.newbyteorder("="))
    stamp_ns = stamp_of(message.header)
    if times is None:
        return CloudMessage(points_m, stamp_ns, None, rows)
    offsets_s = _checked(_offsets_s(table[times.name], stamp_ns), points_m, times.name)
    return CloudMessage(points_m, stamp_ns, offsets_s, rows)


def stamp_of(header: Any) -> int:  # noqa: ANN401
    """The time of a message in nanoseconds."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def _table(message: Any, fields: list[Any]) -> NDArray[Any]:  # noqa: ANN401
    """(N,) the points with these fields, without what lies between points and rows."""
    width, height, step, row = (int(getattr(message, name)) for name in ("width", "height", "point_step", "row_step"))
    data = np.asarray(message.data)
    if len(data) == width * height * step:  # without gaps; some senders leave row_step 0, or stale
        row = width * step
    if row * height != len(data) or width * step > row:
        raise ValueError(
            f"{height} rows of {row} bytes ({width} points of {step}) do not fit the {len(data)} bytes of the cloud"
        )
    types = [(">" if message.is_bigendian else "<") + TYPES.get(field.datatype, "V1") for field in fields]
    ends = [field.offset + np.dtype(kind).itemsize for field, kind in zip(fields, types, strict=True)]
    if max(ends) > step or any("V" in kind for kind in types):
        raise ValueError(f"fields within the {step} bytes of a point are needed; one ends at byte {max(ends)}")
    layout = np.dtype(
        {
            "names": [field.name for field in fields],
            "formats": types,
            "offsets": [int(field.offset) for field in fields],
            "itemsize": step,
        }
    )
    grid = np.ndarray((height, width), layout, data, strides=(row, step))
    return grid.reshape(-1)


def _offsets_s(stored: NDArray[Any], stamp_ns: int) -> NDArray[np.float64]:
    if stored.dtype.kind in "iu":
        nanoseconds = stored.astype(np.int64)
        since_ns = stamp_ns if nanoseconds.max(initial=0) > ABSOLUTE_NS else 0
        return np.asarray((nanoseconds - since_ns) * 1e-9, dtype=np.float64)
    values = stored.astype(np.float64)
    largest = np.abs(values[np.isfinite(values)]).max(initial=0.0)
    if largest > ABSOLUTE_NS:
        return (values - stamp_ns) * 1e-9
    # The whole seconds first: a float64 of both together would be off by 0.2 us.
    return values - stamp_ns // 1_000_000_000 - stamp_ns % 1_000_000_000 * 1e-9 if largest > ABSOLUTE_S else values


def _checked(offsets_s: NDArray[np.float64], points_m: Points, name: str) -> NDArray[np.float64]:
    of_points = offsets_s[np.isfinite(points_m).all(axis=1)]
    if not (np.abs(of_points) <= LONGEST_TURN_S).all():
        worst = of_points[np.argmax(~(np.abs(of_points) <= LONGEST_TURN_S))]
        raise ValueError(
            f"{name}: times of points within {LONGEST_TURN_S:g} s of the cloud are needed; got {worst:g} s"
        )
    return np.nan_to_num(offsets_s, nan=0.0, posinf=0.0, neginf=0.0).clip(-LONGEST_TURN_S, LONGEST_TURN_S)
